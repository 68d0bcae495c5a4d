# SPDX-License-Identifier: MIT
"""Readers of all supported capture formats; ``read.py`` recognises the format and calls its module."""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    """``read_capture`` for other programs, imported on use: commands read ``options`` before all else."""
    if name == "read_capture":
        from model.reconstruction.captures.read import read_capture

        return read_capture
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

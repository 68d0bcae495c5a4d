# SPDX-License-Identifier: MIT
"""Readers of all supported capture formats; ``read.py`` detects the format and calls its reader."""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    """Import ``read_capture`` on first use, since commands import ``options`` without the readers."""
    if name == "read_capture":
        from model.reconstruction.captures.read import read_capture

        return read_capture
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

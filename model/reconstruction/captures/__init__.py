# SPDX-License-Identifier: MIT
"""Captures in all supported forms. ``read.py`` recognises a form and calls the module for it."""

from __future__ import annotations

from model.reconstruction.capture_options import CaptureOptions
from model.reconstruction.captures.read import (
    capture_file,
    open_capture,
    read_capture,
    shrunk_camera,
    write_capture,
)

__all__ = [
    "CaptureOptions",
    "capture_file",
    "open_capture",
    "read_capture",
    "shrunk_camera",
    "write_capture",
]

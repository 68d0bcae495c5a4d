# SPDX-License-Identifier: MIT
"""Readers of all supported capture formats; ``read.py`` recognises a format and calls its reader."""

from __future__ import annotations

from model.reconstruction.capture_options import CaptureOptions
from model.reconstruction.captures.read import (
    capture_file,
    open_capture,
    read_capture,
    shrunk_camera,
    write_capture,
)

__all__ = ["CaptureOptions", "capture_file", "open_capture", "read_capture", "shrunk_camera", "write_capture"]

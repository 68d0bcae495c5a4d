# SPDX-License-Identifier: MIT
"""Writes pixels for a page that opens from disk: one lossless file per buffer and view, loaded on demand.

Browsers forbid a page opened from disk to read files, but not to open them in frames: a tile is a page that
decompresses its bytes and passes them to the page that contains the frame (``page/tile.html``; decision 60).
The stored numbers are arranged in planes (channel by channel, rows top-down) and replaced by differences to
the left neighbour, modulo the word's size. The first (lowest) bytes of all words, then all second bytes and
so on, are compressed by deflate with a zlib header, and encoded in base64.
"""

from __future__ import annotations

import base64
import json
import zlib
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import write_bytes_atomically

_WORDS = {"float16": "half", "float32": "float", "uint32": "uint", "uint16": "ushort"}
_LEVEL = 4  # level 9 takes ten times as long for 3 % less


def encode_tile(array: NDArray) -> bytes:
    """Compress an array (H, W, C) of 16-bit or 32-bit floats or unsigned integers."""
    word = np.dtype(f"<u{array.dtype.itemsize}")
    planes = np.ascontiguousarray(np.moveaxis(array, -1, 0)).astype(array.dtype.newbyteorder("<")).view(word)
    differences = planes.copy()
    differences[:, :, 1:] -= planes[:, :, :-1]  # unsigned: sums invert differences that wrap
    by_byte = differences.reshape(-1, 1).view(np.uint8).T
    return zlib.compress(np.ascontiguousarray(by_byte).tobytes(), _LEVEL)


@cache
def _template() -> str:
    return (files("datagen.inspection.report") / "page" / "tile.html").read_text(encoding="utf-8")


def write_tile(path: Path, key: str, array: NDArray) -> int:
    """Write an array (H, W, C) as tile ``key`` (``configuration/view/buffer``); return the file's size."""
    height, width, channels = array.shape
    size = {"width": width, "height": height, "channels": channels}
    head = {"key": key, "dtype": _WORDS[array.dtype.name], **size}
    text = base64.b64encode(encode_tile(array)).decode()
    page = _template().replace("HEAD", json.dumps(head, separators=(",", ":")), 1)
    content = page.replace("BYTES", text, 1).encode()
    write_bytes_atomically(path, content, parents=True)
    return len(content)


def write_script(path: Path, before: str, data: dict[str, Any], after: str = ";") -> None:
    """Write a script that passes ``data`` to the page: ``REPORT.`` + ``before`` + JSON + ``after``."""
    text = json.dumps(data, separators=(",", ":"), sort_keys=True, allow_nan=False)
    write_bytes_atomically(path, f"REPORT.{before}{text}{after}\n".encode(), parents=True)

# SPDX-License-Identifier: MIT
"""Reads the tiles of reports, each of which stores one buffer of a view, as the report's page does."""

from __future__ import annotations

import base64
import json
import re
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.errors import input_error

_TYPES = {"half": "float16", "float": "float32", "uint": "uint32", "ushort": "uint16"}
_BYTES = re.compile(r'<script id="bytes" type="text/plain">([A-Za-z0-9+/=]*)</script>')
_HEAD = re.compile(r"^\}\)\((\{.*\})\);$", re.MULTILINE)


def decode_tile(data: bytes, dtype: str, width: int, height: int, channels: int) -> NDArray:
    """Invert ``encode_tile``; ``dtype`` is half, float, uint or ushort."""
    name = np.dtype(_TYPES[dtype])
    by_byte = np.frombuffer(zlib.decompress(data), np.uint8).reshape(name.itemsize, -1)
    word = np.dtype(f"<u{name.itemsize}")
    differences = np.ascontiguousarray(by_byte.T).view(word).reshape(channels, height, width)
    planes = np.cumsum(differences, axis=2, dtype=word).view(name.newbyteorder("<"))
    return np.moveaxis(planes, 0, -1).astype(name)


def read_tile(path: Path) -> NDArray:
    """Read a tile (H, W, C). Raises :class:`InputError` for other files."""
    page = path.read_text(encoding="utf-8")
    packed, head_text = _BYTES.search(page), _HEAD.search(page)
    if packed is None or head_text is None:
        raise input_error(path, "", "not a tile", "a page with bytes and head", "write the report again")
    head = json.loads(head_text[1])
    fields = (head[name] for name in ("dtype", "width", "height", "channels"))
    return decode_tile(base64.b64decode(packed[1]), *fields)

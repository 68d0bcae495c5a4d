# SPDX-License-Identifier: MIT
"""Encoder of binary glTF (GLB) files."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FLOAT, _UINT = 5126, 5125


class GlbWriter:
    """Collects the binary data of a GLB and the JSON tables that describe it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.images: list[dict[str, Any]] = []

    def _view(self, content: bytes, target: int | None = None) -> int:
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += content
        return len(self.views) - 1

    def array(self, rows: NDArray[Any], kind: str, *, has_bounds: bool = False) -> int:
        """Add an array (N, C) of vertex data (float32) or, if ``kind`` is ``SCALAR``, of indices (uint32).

        Returns the index of its accessor, which states the extrema if ``has_bounds``.
        """
        is_index = kind == "SCALAR"
        stored = np.ascontiguousarray(rows, "<u4" if is_index else "<f4")
        accessor: dict[str, Any] = {
            "bufferView": self._view(stored.tobytes(), 34963 if is_index else 34962),
            "componentType": _UINT if is_index else _FLOAT,
            "count": len(stored),
            "type": kind,
        }
        if has_bounds:
            accessor["min"], accessor["max"] = stored.min(axis=0).tolist(), stored.max(axis=0).tolist()
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def image(self, content: bytes, kind: str = "image/png") -> int:
        """Add an image of the media type ``kind``; return its index, also the index of its texture."""
        self.images.append({"bufferView": self._view(content), "mimeType": kind})
        return len(self.images) - 1

    def tables(self) -> dict[str, Any]:
        """Return the JSON tables of the collected objects."""
        return {
            "images": self.images,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data) + -len(self.data) % 4}],
        }

    def encode(self, document: dict[str, Any]) -> bytes:
        """Encode a GLB file from the JSON ``document`` and the collected data."""
        text = json.dumps(document, sort_keys=True, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.data) + bytes(-len(self.data) % 4)
        chunks = ((b"JSON", text), (b"BIN\0", binary))
        body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body

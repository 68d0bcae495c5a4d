# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes asset packages: JSON, PLY, PNG and EXR bytes from arrays. Needs NumPy only, no bpy.

Equal input yields equal bytes. A package is written atomically: to a temporary folder next to its path, which
is then renamed.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import shutil
import struct
import zlib
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SIGNIFICANT_DIGITS = 9


def ply_bytes(
    positions: NDArray[np.float32],
    normals: NDArray[np.float32],
    uv: NDArray[np.float32] | None,
    faces: NDArray[np.int32],
) -> bytes:
    """Encode positions and normals (N, 3), UVs (N, 2) if given, and faces (T, 3) as binary PLY."""
    names = ["x", "y", "z", "nx", "ny", "nz"] + (["u", "v"] if uv is not None else [])
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(positions)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    columns = [positions, normals] + ([uv] if uv is not None else [])
    vertices = np.concatenate(columns, axis=1).astype("<f4")
    table = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    table["count"], table["index"] = 3, faces
    return "\n".join(lines).encode() + vertices.tobytes() + table.tobytes()


def srgb_encoded(linear: NDArray) -> NDArray:
    """Encode linear values in [0, 1] with the sRGB transfer function."""
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(np.maximum(linear, 1e-12), 1 / 2.4) - 0.055
    )


def quantize(values: NDArray, bits: int) -> NDArray:
    """Round values in [0, 1] to unsigned integers of 8 or 16 bits."""
    top = (1 << bits) - 1
    return np.floor(np.clip(values, 0, 1) * top + 0.5).astype(np.uint8 if bits == 8 else np.uint16)


def png_bytes(pixels: NDArray) -> bytes:
    """Encode (H, W, C) uint8 or uint16, C = 1, 3 or 4, row 0 at the top, as PNG.

    Each row uses the one of the five filters that yields the smallest sum of absolute differences.
    """
    height, width, channels = pixels.shape
    depth = 8 * pixels.dtype.itemsize
    raw = np.ascontiguousarray(pixels.astype(">u2") if depth == 16 else pixels)
    rows = raw.view(np.uint8).reshape(height, -1)
    step = channels * pixels.dtype.itemsize
    left = np.zeros_like(rows)
    left[:, step:] = rows[:, :-step]
    above = np.zeros_like(rows)
    above[1:] = rows[:-1]
    corner = np.zeros_like(rows)
    corner[1:, step:] = rows[:-1, :-step]
    average = ((left.astype(np.int16) + above) // 2).astype(np.uint8)
    predictions = (np.zeros_like(rows), left, above, average, _paeth(left, above, corner))
    candidates = np.stack([rows - prediction for prediction in predictions])
    size = np.minimum(candidates, np.negative(candidates))  # absolute value of each byte as a signed number
    best = size.sum(axis=2, dtype=np.uint32).argmin(axis=0)
    filtered = candidates[best, np.arange(height)]
    data = np.concatenate([best[:, None].astype(np.uint8), filtered], axis=1).tobytes()
    colour_type = {1: 0, 3: 2, 4: 6}[channels]
    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(data, 9)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, body) for kind, body in chunks)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _paeth(left: NDArray, above: NDArray, corner: NDArray) -> NDArray:
    a, b, c = left.astype(np.int16), above.astype(np.int16), corner.astype(np.int16)
    # distances of a + b - c from a, b and c
    pa, pb = b - c, a - c
    pc = np.abs(pa + pb)
    pa, pb = np.abs(pa), np.abs(pb)
    return np.where((pa <= pb) & (pa <= pc), a, np.where(pb <= pc, b, c)).astype(np.uint8)


def exr_bytes(pixels: NDArray) -> bytes:
    """Encode (H, W, 3) linear Rec.709, row 0 at the top, as OpenEXR: half floats in [0, 65504], ZIP."""
    height, width, _ = pixels.shape
    half = np.clip(pixels, 0, 65504).astype("<f2")
    planes = half[..., ::-1]  # EXR sorts channels by name: B, G, R

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    channels = b"".join(c + b"\0" + struct.pack("<iB3xii", 1, 0, 1, 1) for c in (b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = b"".join(
        [
            struct.pack("<ii", 20000630, 2),
            attribute("channels", "chlist", channels),
            attribute("compression", "compression", b"\x03"),
            attribute("dataWindow", "box2i", window),
            attribute("displayWindow", "box2i", window),
            attribute("lineOrder", "lineOrder", b"\0"),
            attribute("pixelAspectRatio", "float", struct.pack("<f", 1)),
            attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
            attribute("screenWindowWidth", "float", struct.pack("<f", 1)),
            b"\0",
        ]
    )
    blocks = []
    for start in range(0, height, 16):
        block = np.ascontiguousarray(planes[start : start + 16].transpose(0, 2, 1)).tobytes()
        blocks.append((start, _exr_zip(block)))
    offset = len(header) + 8 * len(blocks)
    table, body = [], []
    for start, data in blocks:
        table.append(struct.pack("<Q", offset))
        body.append(struct.pack("<ii", start, len(data)) + data)
        offset += 8 + len(data)
    return header + b"".join(table) + b"".join(body)


def _exr_zip(block: bytes) -> bytes:
    """Compress bytes by OpenEXR's ZIP; unchanged if that is not smaller."""
    source = np.frombuffer(block, np.uint8)
    split = np.concatenate([source[0::2], source[1::2]]).astype(np.int16)
    split[1:] = (split[1:] - split[:-1] + (128 + 256)) % 256
    packed = zlib.compress(split.astype(np.uint8).tobytes(), 6)
    return packed if len(packed) < len(block) else block


def rounded(value: Any) -> Any:
    """Round the floats of JSON data to nine significant digits; NaN and Inf raise ``ValueError``."""
    if isinstance(value, bool) or value is None or isinstance(value, (str, int)):
        return value
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [rounded(entry) for entry in value]
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} in the description of an asset")
    return 0.0 if number == 0 else float(f"{number:.{_SIGNIFICANT_DIGITS}g}")


def json_bytes(data: dict[str, Any]) -> bytes:
    """Encode data as UTF-8 JSON with sorted keys, two-space indent and a final newline."""
    text = json.dumps(rounded(data), sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False)
    return (text + "\n").encode()


def _sync(path: Path) -> None:
    """Flush a file, or a folder's list of entries, to disk, to survive a power failure."""
    if os.name != "posix":  # not possible on Windows
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # unsupported by some network file systems
            raise
    finally:
        os.close(descriptor)


class PackageWriter:
    """Context manager that collects a package's files in a temporary folder, and renames it on success.

    An exception removes the files. Files of equal content are stored once.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self._partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
        self._by_content: dict[tuple[str, str], str] = {}
        self._names: set[str] = set()

    def __enter__(self) -> PackageWriter:
        shutil.rmtree(self._partial, ignore_errors=True)
        self._partial.mkdir(parents=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            shutil.rmtree(self._partial, ignore_errors=True)
            return
        previous = self.folder.with_name(f".{self.folder.name}.{os.getpid()}.previous")
        if self.folder.exists():
            self.folder.rename(previous)
        for path in (*self._partial.rglob("*"), self._partial):
            _sync(path)
        self._partial.rename(self.folder)
        _sync(self.folder.parent)
        shutil.rmtree(previous, ignore_errors=True)

    def add(self, group: str, stem: str, suffix: str, content: bytes) -> str:
        """Write ``{group}/{stem}{suffix}`` (numbered if taken by other content); returns the path used."""
        key = (group + suffix, hashlib.sha256(content).hexdigest())
        if key in self._by_content:
            return self._by_content[key]
        name, number = f"{group}/{stem}{suffix}", 1
        while name in self._names:
            number += 1
            name = f"{group}/{stem}_{number}{suffix}"
        self._names.add(name)
        self._by_content[key] = name
        path = self._partial / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return name

    def finish(self, description: dict[str, Any]) -> None:
        """Write ``asset.json`` with the content ``description``."""
        (self._partial / "asset.json").write_bytes(json_bytes(description))

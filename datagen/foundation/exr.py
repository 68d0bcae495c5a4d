# SPDX-License-Identifier: MIT
"""One multi-layer OpenEXR file per view: encoded to bytes and decoded, by buffer name.

Channels are named by the registry (``R, G, B`` for beauty, ``layer.channel`` for the rest), scan lines run
top-down, no timestamps are written: equal arrays give equal bytes with one OpenEXR version.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from datagen.foundation.buffers import BUFFERS, Buffer, get_buffer
from datagen.foundation.errors import InputError, Problem

MAX_SIDE_PX = 16384  # refuses headers with absurd sizes before any pixel is allocated
_MAX_COMPRESSION = 500  # of any file that is not a decompression bomb; halves count as floats here
_CLAIM_FREE_BYTES = 256 << 20
COMPRESSIONS = {
    "none": OpenEXR.NO_COMPRESSION,
    "rle": OpenEXR.RLE_COMPRESSION,
    "zips": OpenEXR.ZIPS_COMPRESSION,
    "zip": OpenEXR.ZIP_COMPRESSION,
    "piz": OpenEXR.PIZ_COMPRESSION,
}
_BLOCK_LINES = (1, 1, 1, 16, 32)
"""Scan lines that are compressed together, by the number of each of :data:`COMPRESSIONS` in files."""
_EXR_ERRORS = (
    RuntimeError, ValueError, OSError, MemoryError, TypeError, LookupError, OverflowError, struct.error,
)  # fmt: skip
_READ_REMEDY = "make the view again (remove it and rerun), or restore the file"


def to_storage(buffer: Buffer, array: NDArray) -> NDArray:
    """``array`` (H, W, C) as stored: cast to the buffer's dtype, halves clipped to their range.

    Stages that compute from a view use stored values, so that a resumed run equals an uninterrupted one.
    Raises ``ValueError`` on a wrong shape.
    """
    if array.ndim != 3 or array.shape[2] != buffer.num_channels:
        raise ValueError(f"{buffer.name}: got shape {array.shape}, expected (H, W, {buffer.num_channels})")
    if buffer.pixel_type == "half":
        array = np.clip(array, -65504.0, 65504.0)  # NaN passes through; later checks report it
    return np.ascontiguousarray(array, dtype=buffer.dtype)


def encode_view(buffers: Mapping[str, NDArray], compression: str = "zip", num_threads: int = 0) -> bytes:
    """Encode buffers (name to (H, W, C) array, all of one size) as the bytes of one EXR file.

    Raises ``ValueError`` on unknown names or differing sizes.
    """
    if not buffers:
        raise ValueError("expected at least one buffer")
    shape = next(iter(buffers.values())).shape[:2]
    channels = {}
    for name in sorted(buffers):
        buffer = get_buffer(name)
        stored = to_storage(buffer, np.asarray(buffers[name]))
        if stored.shape[:2] != shape:
            raise ValueError(f"{name}: got size {stored.shape[:2]}, expected {shape} as the other buffers")
        for index, channel in enumerate(buffer.exr_channels):
            channels[channel] = np.ascontiguousarray(stored[..., index])
    header = {"compression": COMPRESSIONS[compression], "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    with OpenEXR.File(header, channels, num_threads) as file:
        file.write(stream)
    return stream.getvalue()


def check_claim(size_px: tuple[int, int], pixel_bytes: int, num_bytes: int, where: Path | str) -> None:
    """Refuse an image whose header states more pixels than a file of ``num_bytes`` can plausibly contain,
    before they take memory.

    Raises :class:`InputError`.
    """
    width, height = size_px
    if width * height * pixel_bytes > _CLAIM_FREE_BYTES + _MAX_COMPRESSION * num_bytes:
        got = f"{width} x {height} pixels in {num_bytes} bytes"
        raise InputError(Problem(where, "size", got, "a size that the file can hold", _READ_REMEDY))


def claimed_size(data: bytes, where: Path | str) -> tuple[int, int]:
    """(width, height) from an EXR file's header, if plausible for its size. Raises :class:`InputError`."""
    OpenEXR.setMaxImageSize(MAX_SIDE_PX, MAX_SIDE_PX)
    try:
        with OpenEXR.File(io.BytesIO(data), header_only=True, separate_channels=True) as file:
            low, high = (np.asarray(corner, dtype=np.int64) for corner in file.header()["dataWindow"])
            width, height = (int(side) for side in high - low + 1)
            check_claim((width, height), 4 * len(file.header()["channels"]), len(data), where)
            return width, height
    except InputError:
        raise
    except _EXR_ERRORS as error:
        raise InputError(Problem(where, "", str(error), "an intact EXR file", _READ_REMEDY)) from None


def decode_channels(data: bytes, where: Path | str, num_threads: int = 0) -> dict[str, NDArray]:
    """Every channel (H, W) of an EXR file's bytes. Raises :class:`InputError` for a damaged file or a false
    header.
    """
    claimed_size(data, where)
    try:
        with OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=num_threads) as file:
            return {name: channel.pixels for name, channel in file.channels().items()}
    except _EXR_ERRORS as error:
        raise InputError(Problem(where, "", str(error), "an intact EXR file", _READ_REMEDY)) from None


def _blocks_of_rows(data: bytes, rows: tuple[int, int]) -> tuple[bytes, int]:
    """EXR file of the blocks of scan lines that contain ``rows`` (first, end), and its first row in ``data``.

    Blocks are copied compressed; the data window and the table of offsets are new. Raises one of
    ``_EXR_ERRORS`` for a damaged file.
    """
    places = {}
    at = 8
    while data[at]:  # attributes: name, type, size, value
        kind = data.index(0, at) + 1
        size = data.index(0, kind) + 1
        places[data[at : kind - 1]] = size + 4
        at = size + 4 + struct.unpack_from("<I", data, size)[0]
    table, window = at + 1, places[b"dataWindow"]
    left, top, right, bottom = struct.unpack_from("<4i", data, window)
    lines = _BLOCK_LINES[data[places[b"compression"]]]
    first, end = rows[0] // lines, -(-rows[1] // lines)
    starts = struct.unpack_from(f"<{end - first}Q", data, table + 8 * first)
    blocks = [data[start : start + 8 + struct.unpack_from("<I", data, start + 4)[0]] for start in starts]
    header = bytearray(data[:table])
    last = min(top + end * lines - 1, bottom)
    struct.pack_into("<4i", header, window, left, top + first * lines, right, last)
    offsets = np.cumsum([table + 8 * len(blocks), *map(len, blocks[:-1])], dtype="<u8")
    return b"".join((header, offsets.tobytes(), *blocks)), first * lines


def decode_view(
    source: bytes | Path,
    names: Iterable[str] | None = None,
    num_threads: int = 0,
    rows: tuple[int, int] | None = None,
) -> dict[str, NDArray]:
    """Decode an EXR file to buffers as stored (half stays float16); ``names`` None = all.

    ``rows`` (first, end): only these, in less time. Raises :class:`InputError` if the file is damaged, too
    large, or lacks a requested buffer or row.
    """
    where = source if isinstance(source, Path) else "EXR data"
    try:
        data = source if isinstance(source, bytes) else source.read_bytes()
    except OSError as error:
        raise InputError(Problem(where, "", str(error), "a readable EXR file", _READ_REMEDY)) from None
    kept = slice(None)
    if rows is not None:
        height = claimed_size(data, where)[1]
        if not 0 <= rows[0] < rows[1] <= height:
            raise InputError(Problem(where, "rows", f"{rows}", f"rows from 0 to {height}", _READ_REMEDY))
        try:
            data, first = _blocks_of_rows(data, rows)
        except _EXR_ERRORS as error:
            raise InputError(Problem(where, "", str(error), "an intact EXR file", _READ_REMEDY)) from None
        kept = slice(rows[0] - first, rows[1] - first)
    pixels = decode_channels(data, where, num_threads)
    wanted = (
        tuple(names)
        if names is not None
        else tuple(name for name, buffer in BUFFERS.items() if all(c in pixels for c in buffer.exr_channels))
    )
    result = {}
    problems = []
    for name in wanted:
        buffer = get_buffer(name)
        missing = [c for c in buffer.exr_channels if c not in pixels]
        if missing:
            problems.append(
                Problem(where, name, f"no channel {', '.join(missing)}", "all its channels", _READ_REMEDY)
            )
            continue
        planes = [pixels[c] for c in buffer.exr_channels]
        if any(plane is None or plane.dtype != buffer.dtype for plane in planes):
            got = ", ".join(str(getattr(plane, "dtype", None)) for plane in planes)
            problems.append(Problem(where, name, got, f"pixels of type {buffer.pixel_type}", _READ_REMEDY))
            continue
        result[name] = np.stack([plane[kept] for plane in planes], axis=-1)
    if problems:
        raise InputError(*problems)
    return result

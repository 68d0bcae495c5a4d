# SPDX-License-Identifier: MIT
"""Encoding and decoding of a view's buffers as one multi-layer OpenEXR file.

Channels are named by the registry (``R, G, B`` for beauty, ``layer.channel`` for the rest), scan lines run
top-down, and no timestamps are written: with one OpenEXR version, equal arrays produce equal bytes.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from datagen.foundation.buffers import BUFFERS, Buffer, get_buffer
from datagen.foundation.errors import Problems, input_error, raise_problems

MAX_SIDE_PX = 16384  # larger headers are refused before any pixel is allocated
_MAX_COMPRESSION = 500  # plausible decoded bytes per stored byte, with halves counted as floats
_CLAIM_FREE_BYTES = 256 << 20  # decoded size accepted for a file of any size
COMPRESSIONS = {
    "none": OpenEXR.NO_COMPRESSION,
    "rle": OpenEXR.RLE_COMPRESSION,
    "zips": OpenEXR.ZIPS_COMPRESSION,
    "zip": OpenEXR.ZIP_COMPRESSION,
    "piz": OpenEXR.PIZ_COMPRESSION,
}
_EXR_ERRORS = (RuntimeError, ValueError, OSError, MemoryError, TypeError, IndexError, KeyError)
_READ_REMEDY = "make the view again (remove it and rerun), or restore the file"


def to_storage(buffer: Buffer, array: NDArray[Any]) -> NDArray[Any]:
    """Return ``array`` (H, W, C) as stored: cast to the buffer's dtype, half floats clipped to their range.

    Stages that compute from a view use stored values, so a resumed run equals an uninterrupted one. Raises
    ``ValueError`` for a wrong shape.
    """
    if array.ndim != 3 or array.shape[2] != buffer.num_channels:
        raise ValueError(f"{buffer.name}: got shape {array.shape}, expected (H, W, {buffer.num_channels})")
    if buffer.pixel_type == "half":
        array = np.clip(array, -65504.0, 65504.0)  # NaN passes through; later checks report it
    return np.ascontiguousarray(array, dtype=buffer.dtype)


def encode_view(buffers: Mapping[str, NDArray[Any]], compression: str = "zip", num_threads: int = 0) -> bytes:
    """Encode buffers, arrays (H, W, C) of one size by name, as the bytes of one EXR file.

    Raises ``KeyError`` for an unknown name, ``ValueError`` for no buffers or wrong shapes.
    """
    if not buffers:
        raise ValueError("expected at least one buffer")
    shape = next(iter(buffers.values())).shape[:2]
    channels = {}
    for name in sorted(buffers):
        buffer = get_buffer(name)
        stored = to_storage(buffer, np.asarray(buffers[name]))
        if stored.shape[:2] != shape:
            raise ValueError(f"{name}: got size {stored.shape[:2]}, expected {shape} like the other buffers")
        for index, channel in enumerate(buffer.exr_channels):
            channels[channel] = stored[..., index]
    return encode_channels(channels, compression, num_threads)


def encode_channels(
    channels: Mapping[str, NDArray[Any]], compression: str = "zip", num_threads: int = 0
) -> bytes:
    """Encode channels as the bytes of one EXR file: arrays (H, W) by name, or (H, W, 3) for ``RGB``."""
    header = {"compression": COMPRESSIONS[compression], "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    planes = {name: np.ascontiguousarray(pixels) for name, pixels in channels.items()}
    with OpenEXR.File(header, planes, num_threads) as file:
        file.write(stream)
    return stream.getvalue()


def check_claim(size_px: tuple[int, int], pixel_bytes: int, num_bytes: int, where: Path | str) -> None:
    """Raise :class:`InputError` unless a file of ``num_bytes`` can contain an image of ``size_px``.

    ``size_px``: (width, height), checked before allocation; ``pixel_bytes``: decoded bytes per pixel.
    """
    width, height = size_px
    if width * height * pixel_bytes > _CLAIM_FREE_BYTES + _MAX_COMPRESSION * num_bytes:
        got = f"{width} x {height} pixels in {num_bytes} bytes"
        raise input_error(where, "size", got, "a size that the file can contain", _READ_REMEDY)


def claimed_size(data: bytes, where: Path | str) -> tuple[int, int]:
    """Return (width, height) in an EXR header. Raises :class:`InputError` if it is damaged or implausible."""
    OpenEXR.setMaxImageSize(MAX_SIDE_PX, MAX_SIDE_PX)
    try:
        with OpenEXR.File(io.BytesIO(data), header_only=True, separate_channels=True) as file:
            low, high = (np.asarray(corner, dtype=np.int64) for corner in file.header()["dataWindow"])
            width, height = (int(side) for side in high - low + 1)
            pixel_bytes = 4 * len(file.header()["channels"])
    except _EXR_ERRORS as error:
        raise input_error(where, "", error, "an intact EXR file", _READ_REMEDY) from None
    check_claim((width, height), pixel_bytes, len(data), where)
    return width, height


def decode_channels(data: bytes, where: Path | str, num_threads: int = 0) -> dict[str, NDArray[Any]]:
    """Decode an EXR file to channels (H, W) by name. Raises :class:`InputError` if it is damaged."""
    claimed_size(data, where)
    try:
        with OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=num_threads) as file:
            return {name: channel.pixels for name, channel in file.channels().items()}
    except _EXR_ERRORS as error:
        raise input_error(where, "", error, "an intact EXR file", _READ_REMEDY) from None


def decode_view(
    source: bytes | Path,
    names: Iterable[str] | None = None,
    num_threads: int = 0,
    where: Path | str = "EXR data",
) -> dict[str, NDArray[Any]]:
    """Decode the buffers ``names`` (None: all) of an EXR file: arrays (H, W, C) of the stored types, by name.

    ``where`` identifies a ``source`` of bytes in messages. Raises :class:`InputError` if the file is damaged,
    too large or lacks a requested buffer, and ``KeyError`` for an unknown name.
    """
    where = source if isinstance(source, Path) else where
    try:
        data = source if isinstance(source, bytes) else source.read_bytes()
    except OSError as error:
        raise input_error(where, "", error, "a readable EXR file", _READ_REMEDY) from None
    pixels = decode_channels(data, where, num_threads)
    complete = [name for name, buffer in BUFFERS.items() if all(c in pixels for c in buffer.exr_channels)]
    result = {}
    problems = Problems(where)
    for name in complete if names is None else names:
        buffer = get_buffer(name)
        missing = [c for c in buffer.exr_channels if c not in pixels]
        if missing:
            problems.add(name, f"no channel {', '.join(missing)}", "all its channels", _READ_REMEDY)
            continue
        planes = [pixels[c] for c in buffer.exr_channels]
        if any(plane is None or plane.dtype != buffer.dtype for plane in planes):
            got = ", ".join(str(getattr(plane, "dtype", None)) for plane in planes)
            problems.add(name, got, f"pixels of type {buffer.pixel_type}", _READ_REMEDY)
            continue
        result[name] = np.stack(planes, axis=-1)
    raise_problems(problems)
    return result

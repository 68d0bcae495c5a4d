# SPDX-License-Identifier: MIT
"""Writes atlases as image files: 8-bit PNG for viewers and packages, EXR for exact values.

PNG stores diffuse and specular albedo sRGB-encoded (error at most 1/510 in encoded values), roughness
linearly. Row 0 is at v = 1. Maps are quantised band by band, so a 16K atlas needs no float copy.
"""

from __future__ import annotations

import errno
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from datagen.formats.base import write_bytes_atomically
from datagen.foundation.color import srgb_from_linear
from datagen.foundation.durable import publish
from datagen.foundation.images import encode_png, quantized_bytes
from datagen.foundation.peak_memory import num_threads
from datagen.foundation.progress import Advance, no_advance
from model.reconstruction.atlas.atlas import MAP_CHANNELS, Atlas, release_memory

BAND = 1024
"""Number of rows of an atlas that are converted at once."""
MAX_TEXTURE = 4096
"""Maximum side of textures in a GLB or USDZ, in texels, a limit of most viewers; larger ones are reduced."""
CONFIDENCE = "confidence"
SEEN, FILLED, EMPTY = 255, 128, 0
"""Values of the mask for observed surface, filled surface and no surface."""


def map_bytes(name: str, array: NDArray) -> NDArray[np.uint8]:
    """Quantise the map ``name`` (H, W, C) to 8 bits, sRGB-encoded if it has three channels."""
    halves = np.arange(65536, dtype=np.uint32).astype(np.uint16).view(np.float16).astype(np.float32)
    values = np.nan_to_num(np.clip(halves, 0.0, 1.0))
    table = quantized_bytes(srgb_from_linear(values) if MAP_CHANNELS[name] == 3 else values)
    stored = np.empty(array.shape, np.uint8)[..., ::-1]  # B G R in memory, as the PNG writer needs it
    for top in range(0, array.shape[0], BAND):
        band = np.ascontiguousarray(array[top : top + BAND], np.float16)
        stored[top : top + BAND] = table[band.view(np.uint16)]
        release_memory(array)
    return stored


def texture_shrink(atlas: Atlas) -> int:
    """Return the smallest divisor of the atlas size that reduces it to at most :data:`MAX_TEXTURE` texels."""
    return next(k for k in range(-(-atlas.size // MAX_TEXTURE), atlas.size + 1) if atlas.size % k == 0)


def averaged(band: NDArray, shrink: int) -> NDArray[np.float32]:
    """Average ``band`` (H, W, C) over ``shrink`` x ``shrink`` texels to (H / shrink, W / shrink, C)."""
    values = np.asarray(band, np.float32)
    if shrink == 1:
        return values
    height, width, channels = values.shape
    return values.reshape(height // shrink, shrink, width // shrink, shrink, channels).mean(axis=(1, 3))


def reduced_png(atlas: Atlas, name: str) -> bytes:
    """Encode the map ``name``, reduced to at most :data:`MAX_TEXTURE` texels per side, as an 8-bit PNG."""
    shrink = texture_shrink(atlas)
    side = atlas.size // shrink
    stored = np.empty((side, side, MAP_CHANNELS[name]), np.uint8)
    for first in range(0, side, BAND):
        rows = atlas.maps[name][first * shrink : (first + BAND) * shrink]
        stored[first : first + BAND] = map_bytes(name, averaged(rows, shrink).astype(np.float16))
    atlas.release()
    return encode_png(stored)


def mask_png(atlas: Atlas) -> bytes:
    """Encode a grey PNG with the value :data:`SEEN`, :data:`FILLED` or :data:`EMPTY` at each texel."""
    mask = np.full(atlas.face.shape, EMPTY, np.uint8)
    for top in range(0, atlas.size, BAND):
        rows = slice(top, top + BAND)
        mask[rows][atlas.face[rows] >= 0] = FILLED
        mask[rows][atlas.count[rows] > 0] = SEEN
    return encode_png(mask)


def write_atlas_images(
    folder: Path,
    atlas: Atlas,
    *,
    has_exr: bool = True,
    progress: Advance = no_advance,
) -> list[Path]:
    """Write ``NAME.png`` and, with ``has_exr``, ``NAME.exr`` (half floats) of every map, and ``mask.png``.

    The confidence of D, S and R, if known, is written to ``confidence.png`` and ``.exr`` as R, G and B.
    Other images of an earlier atlas are removed. Returns the paths.
    """
    folder.mkdir(parents=True, exist_ok=True)

    def write(name: str) -> Path:
        path = folder / name
        if path.suffix == ".exr":
            _write_exr(path, _half(atlas, path.stem))
        elif path.stem == "mask":
            write_bytes_atomically(path, mask_png(atlas))
        elif path.stem == CONFIDENCE:
            write_bytes_atomically(path, encode_png(np.asarray(atlas.confidence)))
        else:
            write_bytes_atomically(path, encode_png(map_bytes(path.stem, atlas.maps[path.stem])))
        atlas.release()
        return path

    values = [*atlas.maps, *([CONFIDENCE] if atlas.confidence is not None else [])]
    names = [f"{name}.png" for name in (*values, "mask")]
    if has_exr:
        names += [f"{name}.exr" for name in values]
    earlier = {f"{name}.{suffix}" for name in (*atlas.maps, CONFIDENCE) for suffix in ("png", "exr")}
    for name in earlier - set(names):
        (folder / name).unlink(missing_ok=True)
    with ThreadPoolExecutor(num_threads()) as pool:
        paths = []
        for path in pool.map(write, names):
            paths.append(path)
            progress(len(paths), len(names))
        return paths


def _half(atlas: Atlas, name: str) -> NDArray[np.float16]:
    if name != CONFIDENCE:
        return np.asarray(atlas.maps[name], np.float16)
    table = (np.arange(256) / 255).astype(np.float16)
    return table[np.asarray(atlas.confidence)]


def _write_exr(path: Path, half: NDArray) -> None:
    channels = {"RGB": half} if half.shape[2] == 3 else {"Y": half[..., 0]}
    temporary = path.with_name(f".{path.name}.partial")
    try:
        with OpenEXR.File(
            {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels
        ) as file:
            file.write(str(temporary))
    except RuntimeError as error:  # OpenEXR embeds the system error in its message
        temporary.unlink(missing_ok=True)
        codes = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        code = next((code for code in codes if os.strerror(code) in str(error)), errno.EIO)
        raise OSError(code, os.strerror(code), str(path)) from None
    publish(temporary, path)

# SPDX-License-Identifier: MIT
"""The merged atlas, in memory or in memory-mapped files."""

from __future__ import annotations

import mmap
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.buffers import BUFFERS, MATERIAL_MAPS
from datagen.foundation.peak_memory import num_threads
from model.reconstruction.atlas.texels import TexelSurface

MAP_CHANNELS = {name: BUFFERS[name].num_channels for name in MATERIAL_MAPS}
"""Number of channels of each merged map; a packed array (..., 7) concatenates the maps in this order."""
MAP_COLUMNS = {
    name: slice(end - MAP_CHANNELS[name], end)
    for name, end in zip(MAP_CHANNELS, accumulate(MAP_CHANNELS.values()), strict=True)
}
"""Channels of each map in a packed array."""
ATLAS_DTYPE = np.float16
ConfidenceAt = Callable[[NDArray, NDArray], NDArray[np.uint8]]
"""Function from points and normals (..., 3) to the confidence (..., 3) of D, S and R, 0 to 255."""
TILE = 512
"""Side in texels of the squares that are processed at once."""


@dataclass(frozen=True)
class Atlas:
    """A merged atlas; row 0 is at v = 1.

    ``maps``: arrays (N, N, 3 or 1) in [0, 1] by name, 0 at unobserved texels until they are filled; ``count``
    (N, N): number of views merged in each texel; ``face`` (N, N): index of the texel's triangle, or -1;
    ``confidence`` (N, N, 3): confidence of D, S and R, 255 if fully determined by recorded light, or None.
    """

    maps: dict[str, NDArray]
    count: NDArray[np.uint16]
    face: NDArray[np.int32]
    confidence: NDArray[np.uint8] | None = None

    @property
    def size(self) -> int:
        """Number of texels along a side."""
        return int(self.count.shape[0])

    def release(self) -> None:
        """Release the memory of memory-mapped arrays; the next access reads them from disk again."""
        for array in (*self.maps.values(), self.count, self.face, self.confidence):
            if array is not None:
                release_memory(array)


def release_memory(array: NDArray) -> None:
    """Release the memory of an array if it is memory-mapped."""
    if isinstance(array.base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        array.base.madvise(mmap.MADV_DONTNEED)


def empty_atlas(size: int, folder: Path | None = None, *, has_confidence: bool = False) -> Atlas:
    """Make an empty atlas of ``size`` texels per side, with or without an array of confidence, in memory or
    in memory-mapped files in ``folder``."""
    shapes: dict[str, tuple[tuple[int, ...], Any]] = {
        name: ((size, size, channels), ATLAS_DTYPE) for name, channels in MAP_CHANNELS.items()
    }
    shapes["count"], shapes["face"] = ((size, size), np.uint16), ((size, size), np.int32)
    if has_confidence:
        shapes["confidence"] = ((size, size, 3), np.uint8)
    if folder is None:
        arrays: dict[str, NDArray] = {name: np.zeros(*shape) for name, shape in shapes.items()}
    else:
        folder.mkdir(parents=True, exist_ok=True)
        arrays = {
            name: np.lib.format.open_memmap(folder / f"{name}.npy", "w+", dtype, shape)
            for name, (shape, dtype) in shapes.items()
        }
    arrays["face"][...] = -1
    maps = {name: arrays[name] for name in MAP_CHANNELS}
    return Atlas(maps, arrays["count"], arrays["face"], arrays.get("confidence"))


def put_confidence(atlas: Atlas, surface: TexelSurface, confidence_at: ConfidenceAt) -> None:
    """Set ``atlas.confidence`` at observed texels to ``confidence_at`` of their points and normals on
    ``surface``. Raises :class:`ValueError` if the atlas has no array of confidence."""
    target = atlas.confidence
    if target is None:
        raise ValueError("expected an atlas with confidence")

    def put(top: int) -> None:
        for left in range(0, atlas.size, TILE):
            window = (slice(top, top + TILE), slice(left, left + TILE))
            face, seen = atlas.face[window], atlas.count[window] > 0
            if seen.any():
                points, normals = surface.points(np.ascontiguousarray(face), left, top)
                target[window][seen] = confidence_at(points[seen], normals[seen])

    tops = range(0, atlas.size, TILE)
    with ThreadPoolExecutor(num_threads()) as pool:
        deque(pool.map(put, tops), maxlen=0)
    atlas.release()

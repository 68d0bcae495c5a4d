# SPDX-License-Identifier: MIT
"""Sets the confidence of D, S and R at the texels of an atlas."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from datagen.multiview.compiled import num_threads
from model.reconstruction.atlas.atlas import Atlas
from model.reconstruction.atlas.texels import TexelSurface

ConfidenceAt = Callable[[NDArray, NDArray], NDArray[np.uint8]]
"""Function from points and normals (..., 3) to the confidence (..., 3) of D, S and R, 0 to 255."""
TILE = 512
"""Side in texels of the squares that are processed at once."""


def put_confidence(atlas: Atlas, surface: TexelSurface, confidence_at: ConfidenceAt) -> None:
    """Set ``confidence`` of the atlas at observed texels. Raises :class:`ValueError` if it is None."""
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

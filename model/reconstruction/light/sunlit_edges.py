# SPDX-License-Identifier: MIT
"""Replaces the materials at edges of sunlight, and of clipped sunlit surfaces, by those around them.

Errors of cameras and mesh move the edges of sunlight by centimetres, which turns them into stripes of wrong
albedo, and clipped pixels contain no texture.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.foundation.buffers import MATERIAL_MAPS, split_channels
from datagen.foundation.color import luminance
from datagen.light.lighting import Lit
from datagen.light.surfels import near_surfels, surfel_means
from model.reconstruction.light.view_maps import packed_maps

EDGE_NEIGHBOURS, EDGE_RANGE = 25, 0.1
"""Number of neighbouring surfels whose shares of visible sun differ by more than the second value at an
edge."""
NUM_AVERAGED, MAX_DISTANCE_CELLS = 16, 20
"""Number of surrounding surfels that are averaged, and maximum distance to the nearest in cells."""
NORMAL_SCALE_CELLS = 16
"""Distance in cells that counts like a difference of 1 between two normals."""


def without_sunlit_edges(
    maps: Sequence[dict[str, NDArray]], lit: Lit, region: NDArray, is_clipped: NDArray[np.bool_]
) -> list[dict[str, NDArray]]:
    """Return the views' ``maps`` with D, S and R at edges of sunlight from the same smooth ``region`` (N,).

    ``is_clipped`` (N,): whether a surfel's radiance is a lower bound; only sunlit ones are replaced.
    """
    surfels = lit.surfels
    is_replaced = _at_edge(lit) | (is_clipped & (lit.sunlight.max(axis=1) > 0))
    means = surfel_means(surfels, [packed_maps(view_maps) for view_maps in maps])
    place = np.column_stack([surfels.position_m, surfels.normal * surfels.grid.cell_m * NORMAL_SCALE_CELLS])
    far = 10 * float(np.ptp(place, axis=0).max()) + 1.0
    place = np.column_stack([place, far * np.unique(region, return_inverse=True)[1]])
    rows, others = np.flatnonzero(is_replaced), np.flatnonzero(~is_replaced)
    if not len(rows) or not len(others):
        return list(maps)
    distance, index = cKDTree(place[others]).query(place[rows], k=np.arange(NUM_AVERAGED) + 1, workers=-1)
    is_near = distance[:, 0] <= MAX_DISTANCE_CELLS * surfels.grid.cell_m
    rows, distance, index = rows[is_near], distance[is_near], index[is_near]
    weight = np.where(distance < far, 1 / np.maximum(distance, surfels.grid.cell_m) ** 2, 0)
    weight /= weight.sum(axis=1, keepdims=True)
    filled = np.full((len(surfels), means.shape[1]), np.nan, np.float32)
    around = others[np.minimum(index, len(others) - 1)]
    filled[rows] = np.einsum("nk,nkc->nc", weight, means[around])
    return [
        _filled(view_maps, filled, surfel)
        for view_maps, surfel in zip(maps, surfels.pixel_surfel, strict=True)
    ]


def _at_edge(lit: Lit) -> NDArray[np.bool_]:
    """Compute the mask (N,) of surfels at edges of sunlight."""
    assert lit.sun is not None
    facing = np.maximum(lit.surfels.normal @ lit.sun.direction, 0.1) * luminance(lit.sun.radiance)
    share = luminance(lit.sunlight) / facing
    of_neighbours = share[near_surfels(lit.surfels, EDGE_NEIGHBOURS)[1]]
    return np.asarray(np.ptp(of_neighbours, axis=1) > EDGE_RANGE, bool)


def _filled(view_maps: dict[str, NDArray], filled: NDArray, surfel: NDArray) -> dict[str, NDArray]:
    values = np.where(surfel[:, None] >= 0, filled[surfel], np.nan)
    packed = packed_maps(view_maps)
    values = values.reshape(packed.shape)
    packed = np.where(np.isnan(values), packed, values).astype(np.float16)
    return {**view_maps, **split_channels(packed, MATERIAL_MAPS)}

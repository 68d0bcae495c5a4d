# SPDX-License-Identifier: MIT
"""Detection of small bright surfaces: lamps not marked in the geometry, and sunlit spots.

Rays sampled from a lobe seldom hit a lamp of a few cells, which may emit most of a room's light. So each
cluster of adjacent bright cells of one side is enclosed in a rectangle perpendicular to the side's axis, and
directions towards the rectangle are sampled (:mod:`datagen.light.bright_guide`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from datagen.foundation.color import luminance
from datagen.light.bright_guide import BrightRectangle
from datagen.light.cells import Cells, cell_indices

BRIGHT = 10.0
"""Minimum luminance of a bright cell, relative to the median of all cells."""
MIN_VARIANCE, MAX_RECTANGLES = 1.0, 4
"""Minimum relative variance that a sampled cluster adds to the estimate from a single ray, and maximum number
of clusters. A cluster with share s of the power and share a of the area adds the variance s^2 (1 / a - 1).
"""


def bright_rectangles(cells: Cells) -> list[BrightRectangle]:
    """Rectangles around the clusters of bright ``cells`` that rays seldom hit, by decreasing variance.

    Emitters have no cells; they are sampled separately.
    """
    keys = np.flatnonzero(cells.index >= 0)
    if not len(keys):
        return []
    level = luminance(cells.radiance[cells.index[keys]].astype(np.float64))
    bright = level > BRIGHT * np.median(level)
    at, side = cell_indices(keys[bright], cells.shape)
    found = []
    for which in adjacent_cells(at, side):
        total = float(level[bright][which].sum())
        variance = (total / level.sum()) ** 2 * (len(level) / len(which) - 1)
        if variance >= MIN_VARIANCE:
            power = total * cells.cell_m**2
            found.append(_rectangle(cells, at[which], int(side[which[0]]), power, variance))
    return sorted(found, key=lambda rectangle: -rectangle.variance)[:MAX_RECTANGLES]


def _rectangle(
    cells: Cells, at: NDArray[np.int64], side: int, power: float, variance: float
) -> BrightRectangle:
    """Rectangle over the cells ``at`` (K, 3) of one ``side``, perpendicular to its axis at their median."""
    axis, is_upper = side // 2, side % 2 == 1
    low = cells.low + at.min(axis=0) * cells.cell_m
    high = cells.low + (at.max(axis=0) + 1) * cells.cell_m
    low[axis] = cells.low[axis] + (np.median(at[:, axis]) + 0.5) * cells.cell_m
    edges = np.zeros((2, 3))
    for edge, along in zip(edges, (k for k in range(3) if k != axis), strict=True):
        edge[along] = high[along] - low[along]
    normal = np.zeros(3)
    normal[axis] = 1 if is_upper else -1
    return BrightRectangle(low, edges[0], edges[1], normal, power, variance)


def adjacent_cells(at: NDArray[np.int64], side: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Ascending row indices of each cluster of adjacent cells ``at`` (K, 3) of the same ``side`` (K,)."""
    if not len(at):
        return []
    pairs = cKDTree(apart_by_side(at, side)).query_pairs(1.5, p=np.inf, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(at),) * 2)
    count, cluster = connected_components(graph, directed=False)
    return [np.flatnonzero(cluster == number) for number in range(count)]


def apart_by_side(at: NDArray[np.int64], side: NDArray[np.int64]) -> NDArray[np.int64]:
    """Points (K, 4) for neighbour searches among cells ``at`` (K, 3), with different sides (K,) far apart."""
    return np.column_stack([at, side * 4 * int(at.max() + 1)])

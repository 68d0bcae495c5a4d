# SPDX-License-Identifier: MIT
"""Detection of small bright surfaces (lamps not marked in the geometry, sunlit spots), and sampling of
directions towards rectangles around them.

Rays sampled from a lobe seldom hit a lamp of a few cells, which may emit most of a room's light. So each
cluster of adjacent bright cells whose normals are nearest to the same signed axis is enclosed in a rectangle
perpendicular to this axis. A rectangle is chosen with probability proportional to its estimated light at the
shading point. A sampled ray returns the radiance of the surface that it hits, so rectangles affect only the
noise. The balance heuristic combines these rays with those of other techniques.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from datagen.foundation.color import luminance
from datagen.light.cells import Cells, cell_indices

_ROWS, _NORMAL, _MIDDLE, _SQUARES, _POWER = 7, 3, 4, 5, 6  # vectors per rectangle, and indices of some
_MIN_FACING = 0.05  # lower bound on the cosine at a rectangle, even for points behind it
BRIGHT = 10.0
"""Minimum luminance of a bright cell, relative to the median of all cells."""
MIN_VARIANCE, MAX_RECTANGLES = 1.0, 4
"""Minimum relative variance of one-ray estimates due to a cluster with a rectangle, s^2 (1 / a - 1) for its
shares s of the power and a of the area of all cells, and maximum number of rectangles."""


@dataclass(frozen=True)
class BrightRectangle:
    """Rectangle with a corner, two edges and the unit normal of its bright side, (3,) each.

    ``power``: luminance times area, summed over its cells; ``variance``: relative variance of the irradiance
    estimated by one cosine-distributed ray (:data:`MIN_VARIANCE`).
    """

    corner_m: NDArray[np.float64]
    u_m: NDArray[np.float64]
    v_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    power: float
    variance: float

    @property
    def area_m2(self) -> float:
        return float(np.linalg.norm(np.cross(self.u_m, self.v_m)))


class BrightGuide:
    """Samples directions towards ``rectangles`` in Dr.Jit kernels."""

    def __init__(self, rectangles: Sequence[BrightRectangle]):
        import mitsuba as mi

        self.num = len(rectangles)
        rows = np.zeros((self.num, _ROWS, 3))
        for row, rectangle in zip(rows, rectangles, strict=True):
            u, v = rectangle.u_m, rectangle.v_m
            middle = rectangle.corner_m + 0.5 * (u + v)
            row[:_SQUARES] = rectangle.corner_m, u, v, rectangle.normal, middle
            row[_SQUARES] = u @ u, v @ v, rectangle.area_m2
            row[_POWER, 0] = rectangle.power
        self._rows = mi.Float(rows.astype(np.float32).ravel())

    def _row(self, rectangle: int, row: int) -> Any:
        import drjit as dr
        import mitsuba as mi

        return dr.gather(mi.Vector3f, self._rows, mi.UInt32(rectangle * _ROWS + row))

    def _shares(self, p: Any) -> list[Any]:
        """Probabilities of the rectangles at ``p``, proportional to power x cosine / (distance^2 + area)."""
        import drjit as dr

        found = []
        for k in range(self.num):
            away = p - self._row(k, _MIDDLE)
            distance2 = dr.squared_norm(away) + self._row(k, _SQUARES).z
            cosine = dr.dot(away, self._row(k, _NORMAL)) * dr.rsqrt(distance2)
            found.append(self._row(k, _POWER).x * dr.maximum(cosine, _MIN_FACING) / distance2)
        total = sum(found)
        return [share / total for share in found]

    def sample(self, p: Any, sample_1: Any, sample_2: Any) -> tuple[Any, Any]:
        """Draw a direction from ``p`` by numbers in [0, 1) and [0, 1)^2; return it and its density [1/sr]."""
        import drjit as dr
        import mitsuba as mi

        toward = mi.Vector3f(0.0, 0.0, 1.0)
        passed = mi.Float(0.0)
        for k, share in enumerate(self._shares(p)):
            point = self._row(k, 0) + self._row(k, 1) * sample_2.x + self._row(k, 2) * sample_2.y
            toward = dr.select(sample_1 >= passed, point - p, toward)
            passed += share
        direction = dr.normalize(toward)
        return direction, self.pdf(p, direction)

    def pdf(self, p: Any, direction: Any) -> Any:
        """Density [1/sr] with which :meth:`sample` samples ``direction`` from ``p``."""
        import drjit as dr
        import mitsuba as mi

        total = mi.Float(0.0)
        for k, share in enumerate(self._shares(p)):
            corner, u, v, normal = (self._row(k, row) for row in range(4))
            squares = self._row(k, _SQUARES)
            facing = dr.dot(direction, normal)
            distance = dr.dot(corner - p, normal) / dr.select(facing == 0, 1.0, facing)
            at = p + direction * distance - corner
            along_u, along_v = dr.dot(at, u) / squares.x, dr.dot(at, v) / squares.y
            hits = (facing != 0) & (distance > 0)
            hits &= (along_u >= 0) & (along_u <= 1) & (along_v >= 0) & (along_v <= 1)
            density = share * dr.square(distance) / (squares.z * dr.maximum(dr.abs(facing), 1e-6))
            total += dr.select(hits, density, 0.0)
        return total


def bright_rectangles(cells: Cells) -> list[BrightRectangle]:
    """Rectangles around the clusters of bright ``cells`` that rays seldom hit, sorted by decreasing variance.

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
    """Bounding rectangle of cells ``at`` (K, 3) of one ``side``, at their median along the side's axis."""
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
    """Row indices, ascending, of each cluster of adjacent cells ``at`` (K, 3) with the same ``side`` (K,)."""
    if not len(at):
        return []
    pairs = cKDTree(apart_by_side(at, side)).query_pairs(1.5, p=np.inf, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(at),) * 2)
    count, cluster = connected_components(graph, directed=False)
    return [np.flatnonzero(cluster == number) for number in range(count)]


def apart_by_side(at: NDArray[np.int64], side: NDArray[np.int64]) -> NDArray[np.int64]:
    """Points (K, 4) for neighbour searches among cells ``at`` (K, 3), far apart if ``side`` (K,) differs."""
    return np.column_stack([at, side * 4 * int(at.max() + 1)])

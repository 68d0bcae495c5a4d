# SPDX-License-Identifier: MIT
"""Sampling of directions towards rectangles around bright surfaces (:mod:`datagen.light.bright_cells`).

A rectangle is chosen with probability proportional to its estimated light at the point. A sampled ray returns
the radiance of the surface that it hits, so rectangles affect only the noise. The balance heuristic combines
such rays with those of other techniques.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ROWS, _NORMAL, _MIDDLE, _SQUARES, _POWER = 7, 3, 4, 5, 6  # vectors per rectangle, and indices of some
_MIN_FACING = 0.05  # minimum cosine at a rectangle, also for points not in front of it


@dataclass(frozen=True)
class BrightRectangle:
    """Rectangle with a corner, two edges and the unit normal of its bright side, (3,) each.

    ``power``: luminance times area, summed over its cells; ``variance``: relative variance of the irradiance
    estimated by one cosine-distributed ray (:data:`~datagen.light.bright_cells.MIN_VARIANCE`).
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

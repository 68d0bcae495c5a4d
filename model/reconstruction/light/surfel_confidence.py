# SPDX-License-Identifier: MIT
"""Compact copy of the surfels' confidence of D, S and R for look-up at any surface point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.light.surfels import Surfels, cell_of
from datagen.multiview.compiled import compiled

_STEPS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], np.int64)
_NEAREST_FIRST = np.ascontiguousarray(_STEPS[np.argsort((_STEPS**2).sum(axis=1), kind="stable")])


@dataclass(frozen=True)
class SurfelConfidence:
    """Confidence of N surfels by cell and side of the surfel grid.

    ``low`` (3,), ``cell_m`` and ``shape`` (3,): lower corner, cell size and number of cells of the grid;
    ``cell`` (N,): index of each surfel's cell and side, ascending; ``confidence`` (N, 3): D, S and R in steps
    of 1 / 255.
    """

    low: NDArray[np.float64]
    cell_m: float
    shape: NDArray[np.int64]
    cell: NDArray[np.int64]
    confidence: NDArray[np.uint8]

    @classmethod
    def of(cls, surfels: Surfels, confidence: NDArray) -> SurfelConfidence:
        """Store the ``confidence`` (N, 3), in [0, 1], of ``surfels``."""
        grid = surfels.grid
        stored = np.round(255 * np.clip(confidence, 0, 1)).astype(np.uint8)
        return cls(grid.low, grid.cell_m, grid.shape, np.flatnonzero(grid.surfel >= 0), stored)

    def at(self, points: NDArray, normals: NDArray) -> NDArray[np.uint8]:
        """Look up the confidence (..., 3), 0 to 255, at surface ``points`` with ``normals``, (..., 3) each.

        It is that of the surfel in the point's cell, else in the nearest adjacent cell with one, else 0.
        """
        flat = points.reshape(-1, 3).astype(np.float64)
        side = np.ascontiguousarray(normals.reshape(-1, 3), np.float32)
        found = _look_up(
            flat, side, self.low, self.cell_m, self.shape, self.cell, self.confidence, _NEAREST_FIRST
        )
        return found.reshape(points.shape)


@compiled
def _look_up(points, normals, low, cell_m, shape, cells, confidence, steps):
    found = np.zeros((len(points), 3), np.uint8)
    place = np.zeros(3)
    for index in range(len(points)):
        for step in range(len(steps)):
            for axis in range(3):
                place[axis] = points[index, axis] + steps[step, axis] * cell_m
            cell = cell_of(place, normals[index], low, cell_m, shape)
            if cell < 0:
                continue
            row = np.searchsorted(cells, cell)
            if row < len(cells) and cells[row] == cell:
                found[index] = confidence[row]
                break
    return found

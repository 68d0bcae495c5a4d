# SPDX-License-Identifier: MIT
"""Grids of cells that store the radiance of surfaces, for each of a cell's six sides: the cells of the
surfels, larger cells that enclose them, and larger cells outside the surfels' grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.light.surfels import NUM_SIDES, CellGrid, Surfels

NUM_LEVELS = 3
"""Number of cell sizes: one, two and four times the size of the surfels' cells."""
OUTER_CELLS, OUTER_MARGIN_CELLS = 8, 300
"""Size of the cells outside the surfels' grid, and distance to which they extend beyond it, both relative to
the size of the surfels' cells. The distance equals the diagonal of the photographed volume."""


@dataclass(frozen=True)
class Cells:
    """A grid of C cells; K of their 6 C sides have radiance.

    ``index`` (6 C,): row of each cell side in ``radiance`` (K, 3) and ``is_photographed`` (K,), -1 for none.
    ``low`` (3,): lower corner of the grid in metres; ``cell_m``: edge length of a cell; ``shape`` (3,): cells
    along each axis.
    """

    index: NDArray[np.int32]
    low: NDArray[np.float64]
    cell_m: float
    shape: NDArray[np.int64]
    radiance: NDArray[np.float32]
    is_photographed: NDArray[np.bool_]


def surfel_cells(surfels: Surfels) -> Cells:
    """Cells of all surfels."""
    grid = surfels.grid
    is_photographed = np.ones(len(surfels), dtype=bool)
    return Cells(grid.surfel, grid.low, grid.cell_m, grid.shape, surfels.radiance, is_photographed)


def unmixed_cells(surfels: Surfels) -> Cells:
    """Cells of all surfels except mixed ones, most of whose pixels are at depth edges."""
    cells = surfel_cells(surfels)
    is_mixed = (cells.index >= 0) & surfels.is_mixed[cells.index]
    return replace(cells, index=np.where(is_mixed, -1, cells.index).astype(np.int32))


def cell_keys(grid: CellGrid, position_m: NDArray, normal: NDArray) -> NDArray[np.int64]:
    """Keys (N,) of the cell sides at points (N, 3) with normals (N, 3); -1 outside the grid."""
    at = np.floor((position_m - grid.low) / grid.cell_m).astype(np.int64)
    inside = ((at >= 0) & (at < grid.shape)).all(axis=1)
    key = ((at[:, 0] * grid.shape[1] + at[:, 1]) * grid.shape[2] + at[:, 2]) * NUM_SIDES + side_of(normal)
    return np.where(inside, key, -1)


def cell_indices(keys: NDArray[np.int64], shape: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cell indices (K, 3) and sides (K,), 0 to 5, that ``keys`` (K,) encode in a grid of ``shape``."""
    *at, side = np.unravel_index(keys, (*shape, NUM_SIDES))
    return np.stack(at, axis=1), side


def side_of(normal: NDArray) -> NDArray[np.int64]:
    """Cell side (N,) of normals (N, 3): twice the axis of the largest component, plus 1 if it is positive."""
    axis = np.abs(normal).argmax(axis=1)
    return 2 * axis + (normal[np.arange(len(normal)), axis] > 0)


def surface_cells(grid: CellGrid, position_m: NDArray, normal: NDArray) -> NDArray[np.int64]:
    """Keys (N,) of the cell sides at points (N, 3) with normals (N, 3): in the surfels' ``grid``, or in the
    larger cells around it, whose keys follow those of the grid; -1 outside both.
    """
    keys = cell_keys(grid, position_m, normal)
    around = cell_keys(_outer_grid(grid), position_m, normal)
    return np.where(keys >= 0, keys, np.where(around >= 0, len(grid.surfel) + around, -1))


def _outer_grid(grid: CellGrid) -> CellGrid:
    """Grid of larger cells that covers the surfels' grid and its surroundings."""
    margin = -(-OUTER_MARGIN_CELLS // OUTER_CELLS)
    side_m = OUTER_CELLS * grid.cell_m
    shape = -(-grid.shape // OUTER_CELLS) + 2 * margin
    return CellGrid(grid.low - margin * side_m, side_m, shape, grid.surfel)


def outer_cells(grid: CellGrid, position_m: NDArray, normal: NDArray, radiance: NDArray) -> Cells | None:
    """Larger cells in and around ``grid`` at points (N, 3) with normals (N, 3), each with the estimated
    ``radiance`` (N, 3) of its first point; None if no point is in reach (:data:`OUTER_MARGIN_CELLS`).
    """
    outer = _outer_grid(grid)
    keys, first = np.unique(cell_keys(outer, position_m, normal), return_index=True)
    keys, first = keys[keys >= 0], first[keys >= 0]
    if not len(keys):
        return None
    index = np.full(int(np.prod(outer.shape)) * NUM_SIDES, -1, np.int32)
    index[keys] = np.arange(len(keys), dtype=np.int32)
    values, is_photographed = radiance[first].astype(np.float32), np.zeros(len(keys), dtype=bool)
    return Cells(index, outer.low, outer.cell_m, outer.shape, values, is_photographed)


def pyramid(cells: Cells) -> list[Cells]:
    """Return ``cells`` and grids of cells of two and four times the size, with the mean radiance inside."""
    levels = [cells]
    occupied = np.flatnonzero(cells.index >= 0)
    at, side = cell_indices(occupied, cells.shape)
    row = cells.index[occupied]
    for level in range(1, NUM_LEVELS):
        shape = (cells.shape + (1 << level) - 1) >> level
        key = np.ravel_multi_index((*(at >> level).T, side), (*shape, NUM_SIDES))
        keys, of_row = np.unique(key, return_inverse=True)
        num = np.bincount(of_row)
        radiance = np.stack([np.bincount(of_row, cells.radiance[row, c]) / num for c in range(3)], axis=1)
        index = np.full(int(np.prod(shape)) * NUM_SIDES, -1, np.int32)
        index[keys] = np.arange(len(keys), dtype=np.int32)
        is_photographed = np.bincount(of_row, cells.is_photographed[row]) > 0
        side_m = cells.cell_m * (1 << level)
        levels.append(Cells(index, cells.low, side_m, shape, radiance.astype(np.float32), is_photographed))
    return levels

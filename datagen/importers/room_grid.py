# SPDX-License-Identifier: MIT
"""Grid of cubes that locates a room's free space, floor, camera regions and ceiling from surface points.

Frame: metres, Z up. Grids are indexed [x, y, z].
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import Box, LightSlot
from datagen.formats.base import vector3
from datagen.foundation.rectangles import rectangles

SQUARE_M = 0.025  # minimum side of the squares on which surfaces are rasterised
MIN_CELL_M = 0.06
DIGITS = 6  # significant digits of derived positions and edges
_MAX_POINTS = 6_000_000  # maximum number of surface samples, which take about 100 MB
_MAX_GRID_CELLS = 6_000_000
_CAMERA_BAND_M = (0.7, 1.9)  # heights above the floor at which a camera region must be free
_CAMERA_MARGIN_M = 0.2
_SLOT_SIDE_M = 0.6


def surface_points(triangles: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.int64], float]:
    """Sample ``triangles`` (M, 3, 3); return points (P, 3), triangle indices (P,) and the spacing in metres.

    The spacing is ``0.8 * SQUARE_M``, or larger if this would exceed the maximum number of points.
    """
    lengths = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)  # edge k: corner k to k + 1
    order = (lengths.argmax(axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(triangles, order[:, :, None], axis=1).transpose(1, 0, 2)
    base = lengths.max(axis=1)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    height = 2 * area / np.maximum(base, 1e-30)
    spacing = 0.8 * SQUARE_M
    while (area / spacing**2 + base / spacing + 1).sum() > _MAX_POINTS:
        spacing *= 1.1
    num_rows = np.maximum(1, np.ceil(height / spacing)).astype(np.int64)  # rows run along the longest edge
    row_owner = np.repeat(np.arange(len(triangles)), num_rows)
    row_v = (_counted(num_rows) + 0.5) / num_rows[row_owner]
    num_columns = np.maximum(1, np.ceil(base[row_owner] * (1 - row_v) / spacing)).astype(np.int64)
    row = np.repeat(np.arange(len(row_owner)), num_columns)
    owner, v = row_owner[row], row_v[row][:, None]
    u = ((_counted(num_columns) + 0.5) / num_columns[row])[:, None] * (1 - v)
    points = a[owner] * (1 - u - v) + b[owner] * u + c[owner] * v
    return points.astype(np.float32), owner, spacing


def _counted(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the concatenation of ``arange(n)`` for each n of ``counts``."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


@dataclass(frozen=True)
class RoomGrid:
    """Grid of cubes of side ``cell_m`` from corner ``origin_m``; ``floor_m``: height of the floor.

    Masks (X, Y, Z): ``occupied`` cubes contain surface points, ``interior`` cubes are free and enclosed.
    """

    origin_m: NDArray[np.float64]
    cell_m: float
    occupied: NDArray[np.bool_]
    interior: NDArray[np.bool_]
    floor_m: float

    @classmethod
    def build(
        cls, points: NDArray[np.float32], seeds: NDArray[np.float64], min_cell_m: float
    ) -> RoomGrid | None:
        """Return the grid of the room with the most ``seeds`` (K, 3), or of the largest room if K = 0.

        Returns None without an enclosed space. ``min_cell_m`` must exceed the spacing of the surface
        ``points`` (P, 3), or walls have holes.
        """
        from scipy import ndimage

        lower, upper = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
        extent = np.maximum(upper - lower, 1e-3)
        cell = max(min_cell_m, float(np.cbrt(np.prod(extent) / _MAX_GRID_CELLS)))
        origin = lower - 1.5 * cell
        shape = tuple(int(n) for n in np.ceil(extent / cell) + 3)
        occupied = np.zeros(shape, dtype=bool)
        index = ((points - origin) / cell).astype(np.int64)
        occupied[index[:, 0], index[:, 1], index[:, 2]] = True
        walls = np.zeros(shape, dtype=np.int8)
        for axis in range(3):
            walls += np.logical_or.accumulate(occupied, axis=axis)
            walls += np.flip(np.logical_or.accumulate(np.flip(occupied, axis), axis=axis), axis)
        inside = ((seeds - origin) / cell).astype(np.int64) if len(seeds) else np.zeros((0, 3), np.int64)
        inside = inside[((inside >= 0) & (inside < shape)).all(axis=1)]
        for num_sides in (5, 4):  # enclosing sides (of 6); film sets lack a wall, or a wall and the ceiling
            labels, count = ndimage.label(~occupied & (walls >= num_sides))
            hits = labels[tuple(inside.T)]
            hits = hits[hits > 0]
            if len(hits) or (count and not len(inside)):
                break
        else:
            return None
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        interior = labels == (int(np.bincount(hits).argmax()) if len(hits) else int(sizes.argmax()))
        lowest = np.where(interior.any(axis=2), interior.argmax(axis=2), -1)
        levels = np.bincount(lowest[lowest >= 0])
        floor_cell = int(levels.argmax())
        edge = origin[2] + floor_cell * cell
        near = points[np.abs(points[:, 2] - edge) < 1.5 * cell][:, 2]
        if len(near):  # the most frequent height of points, more exact than a cube's face
            bins = np.round(near / 0.005).astype(np.int64)
            values, counts = np.unique(bins, return_counts=True)
            edge = float(near[bins == values[counts.argmax()]].mean())
        return cls(origin, cell, occupied, interior, float(edge))

    def is_interior(self, points: NDArray) -> NDArray[np.bool_]:
        """Return the mask (P,) of the ``points`` (P, 3) in the room's free space."""
        index = ((points - self.origin_m) / self.cell_m).astype(np.int64)
        valid = ((index >= 0) & (index < self.interior.shape)).all(axis=1)
        result = np.zeros(len(points), dtype=bool)
        result[valid] = self.interior[tuple(index[valid].T)]
        return result

    def _layer(self, height_m: float) -> int:
        return int(np.clip((height_m - self.origin_m[2]) / self.cell_m, 0, self.interior.shape[2] - 1))

    def camera_regions(self) -> Iterator[Box]:
        """Yield up to four boxes on the floor that are free at camera heights of 0.7 to 1.9 m above it."""
        from scipy import ndimage

        low, high = (self._layer(self.floor_m + height_m) for height_m in _CAMERA_BAND_M)
        band = self.interior[:, :, low : high + 1].all(axis=2)
        margin = max(1, math.ceil(_CAMERA_MARGIN_M / self.cell_m))
        free = ndimage.binary_erosion(band, iterations=margin)
        for x0, x1, y0, y1 in rectangles(free, 4, max(2, math.ceil(0.3 / self.cell_m))):
            column = self.interior[x0:x1, y0:y1, low:].all(axis=(0, 1))
            free_layers = len(column) if column.all() else int(np.argmin(column))
            top = self.origin_m[2] + (low + max(free_layers - 1, high + 1 - low)) * self.cell_m
            minimum = [*(self.origin_m[:2] + np.array([x0, y0]) * self.cell_m), self.floor_m]
            maximum = [*(self.origin_m[:2] + np.array([x1, y1]) * self.cell_m), top]
            yield Box(minimum_m=vector3(minimum, DIGITS), maximum_m=vector3(maximum, DIGITS))

    def ceiling_slots(self, regions: tuple[Box, ...]) -> Iterator[LightSlot]:
        """Yield square light slots below the ceiling, above the centres of the first two camera regions."""
        for number, region in enumerate(regions[:2]):
            x, y = ((a + b) / 2 for a, b in zip(region.minimum_m[:2], region.maximum_m[:2], strict=True))
            start = self._layer((region.minimum_m[2] + region.maximum_m[2]) / 2)
            cell = ((np.array([x, y]) - self.origin_m[:2]) / self.cell_m).astype(int)
            reach = max(1, round(_SLOT_SIDE_M / 2 / self.cell_m))
            block = self.occupied[
                max(0, cell[0] - reach) : cell[0] + reach + 1,
                max(0, cell[1] - reach) : cell[1] + reach + 1,
                start:,
            ].any(axis=(0, 1))
            if not block.any():
                continue
            height = self.origin_m[2] + (start + int(block.argmax())) * self.cell_m - 0.05
            half = _SLOT_SIDE_M / 2
            yield LightSlot(
                name=f"ceiling_{number}",
                kind="area",
                origin_m=vector3([x - half, y - half, height], DIGITS),
                edge_u_m=(0.0, _SLOT_SIDE_M, 0.0),
                edge_v_m=(_SLOT_SIDE_M, 0.0, 0.0),  # u x v points down
            )

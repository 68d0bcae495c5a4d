# SPDX-License-Identifier: MIT
"""Irradiance of a scene's surfaces, gathered once for all views of a configuration.

Most of a path's time and variance is due to the segments after its first bounce, where all views of a room
need the same quantity, the irradiance of the walls. Surfaces are divided into cells (cubes, each split by six
orientations), and the irradiance E of each cell is estimated beforehand from all cameras together
(:mod:`.irradiance_gathering`). Where a path has spread over more than a few cells, the diffuse lobe of the
surface reflects (1 - S) D E / pi, and only the specular lobe is traced further. This is final gathering
(Reichert 1992) from an irradiance cache (Ward, Rubinstein and Clear 1988) whose records are means over cells.
A path's spread is measured as in Mueller et al. (Real-time Neural Radiance Caching, 2021), by the area over
which its sampled directions scatter, 1 / density. docs/decisions/0075 states the neglected effects.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.transport.vertex import INVERSE_PI, facing_normal
from mitsuba_plugins.arrays import aligned

Array = Any

PRIOR_SAMPLES = 4.0
"""Weight, in samples, of the neighbourhood's mean as a prior for a cell's mean."""
LEVELS = 3
"""Number of nested neighbourhoods; each has twice the side of the next smaller one."""
MIN_SPREAD = 8.0
"""Minimum spread, in cell sides, for a path to end in the cache."""
MAX_SIDE_M, MIN_CELLS_ACROSS = 0.06, 80
"""Maximum side [m] of a cell, and minimum number of cells along the longest side of a scene. In very large
scenes, cells are larger, to bound memory."""
BRICK = 8
"""Number of cubes along each axis of a brick, the unit of storage."""
CELLS_PER_BRICK = 6 * BRICK**3
_UNKNOWN, _THIN, _UNIFORM = 0.0, 1.0, 2.0
"""States of records: unknown irradiance, thin cells (see :class:`IrradianceCache`), and all others."""
MAX_BRICKS, MAX_GRID = 1 << 12, 1 << 22
"""Maximum number of stored bricks, and of bricks in the whole grid, including empty ones."""


class SurfaceCells:
    """Cubes around points on surfaces, each split into six orientations.

    Cubes are stored in bricks, which exist only where there are points; ``side_m`` is the side of a cube.
    """

    def __init__(self, points_m: NDArray[np.float64]):
        """``points_m`` (N, 3) are points on surfaces, which must not all be equal."""
        longest = float(np.ptp(points_m, axis=0).max())
        side = min(MAX_SIDE_M, longest / MIN_CELLS_ACROSS)
        while True:
            low = points_m.min(axis=0) - 0.5 * side  # keeps walls off the border of the grid
            bricks = ((points_m - low) / (side * BRICK)).astype(np.int64)
            grid = bricks.max(axis=0) + 1
            if grid.prod(dtype=float) <= MAX_GRID:
                found = np.unique(np.ravel_multi_index(tuple(bricks.T), grid))
                if len(found) <= MAX_BRICKS:
                    break
            side *= 2.0
        self.side_m = side
        self.shape = tuple(int(n) for n in BRICK * grid)
        self.num_cells = CELLS_PER_BRICK * (len(found) + 1)
        self._low_of_brick = BRICK * np.stack(np.unravel_index(found, grid), axis=-1)
        brick_of_place = np.zeros(int(grid.prod()), np.uint32)
        brick_of_place[found] = np.arange(1, len(found) + 1)
        self.bricks = mi.UInt32(brick_of_place)  # numbered from 1; 0: none
        self.low = mi.Point3f(*(float(v) for v in low))
        self.side = mi.Float(side)
        self.counts = mi.Vector3u(*self.shape)
        dr.make_opaque(self.low, self.side, self.counts)

    def arrays(self) -> list[Any]:
        """Arrays that a recorded kernel reads."""
        return [self.low, self.side, self.counts, self.bricks]

    def cubes(self, cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Orientation (N,) in [0, 6) and integer coordinates (N, 3) of ``cells`` (N,)."""
        brick, orientation, *local = np.unravel_index(
            cells, (self.num_cells // CELLS_PER_BRICK, 6, BRICK, BRICK, BRICK)
        )
        return orientation, self._low_of_brick[brick - 1] + np.stack(local, axis=-1)

    def index(self, point: Array, normal: Array, active: Array = True) -> tuple[Any, Any]:
        """Return the cell index of a surface point with ``normal``, and whether the cell is in a brick."""
        position = dr.floor((point - self.low) / self.side)
        is_inside = dr.all((position >= 0.0) & (position < mi.Vector3f(self.counts))) & active
        cube: Any = mi.Vector3u(dr.select(is_inside, position, 0.0))
        size: Any = dr.abs(normal)
        is_x = (size.x >= size.y) & (size.x >= size.z)
        is_y = ~is_x & (size.y >= size.z)
        axis = dr.select(is_x, mi.UInt32(0), dr.select(is_y, mi.UInt32(1), mi.UInt32(2)))
        along = dr.select(is_x, normal.x, dr.select(is_y, normal.y, normal.z))
        orientation = 2 * axis + dr.select(along > 0.0, mi.UInt32(1), mi.UInt32(0))
        place, local, count = cube // BRICK, cube % BRICK, self.counts // BRICK
        place = (place.x * count.y + place.y) * count.z + place.z
        brick: Any = dr.gather(mi.UInt32, self.bricks, place, is_inside)
        local = (local.x * BRICK + local.y) * BRICK + local.z
        return (6 * brick + orientation) * BRICK**3 + local, is_inside & (brick > 0)


class IrradianceCache:
    """Irradiance by cell, as sums of samples and as means for kernels.

    Each cell with samples has a record, numbered from 1; all other cells share record 0. Irradiance varies
    strongly within *thin* cells, which contain opposite surfaces, such as blinds, boards and gaps; paths end
    there only at the maximum depth. ``light_weights`` (records + 1, T) are weights of the light sampler's T
    techniques, valid after :meth:`finish`: the square roots of their contributions' second moments.
    """

    def __init__(self, cells: SurfaceCells, num_techniques: int = 0):
        self.cells = cells
        self._record_of_cell = np.zeros(cells.num_cells, np.uint32)
        self.cell_of_record = np.zeros(1, np.int64)
        self._sums = np.zeros((1, 3 + num_techniques))
        self._counts = np.zeros(1)
        self.light_weights = np.zeros((1, num_techniques))
        self._upload(np.zeros((1, 3)))

    def arrays(self) -> list[Any]:
        """Arrays that a recorded kernel reads."""
        return [self.records, self.means, *self.cells.arrays()]

    @property
    def num_records(self) -> int:
        """Number of cells with known irradiance."""
        return len(self._counts) - 1

    def add(self, cells: NDArray[np.int64], samples: NDArray[np.float64]) -> None:
        """Add ``samples`` (N, 3 + T) to the means of ``cells`` (N,).

        Columns are irradiance and the squared contribution of each of the light sampler's T techniques.
        """
        new = np.unique(cells[self._record_of_cell[cells] == 0])
        self._record_of_cell[new] = np.arange(len(self._counts), len(self._counts) + len(new))
        self.cell_of_record = np.concatenate([self.cell_of_record, new])
        record, size = self._record_of_cell[cells], len(self.cell_of_record)
        self._sums = np.concatenate([self._sums, np.zeros((len(new), self._sums.shape[1]))])
        self._counts = np.concatenate([self._counts, np.zeros(len(new))])
        self._counts += np.bincount(record, minlength=size)
        for channel in range(self._sums.shape[1]):
            self._sums[:, channel] += np.bincount(record, samples[:, channel], size)
        self._upload(self._sums[:, :3] / np.maximum(self._counts, 1e-9)[:, None])

    def finish(self) -> None:
        """Shrink the means of cells with few samples towards those around them; compute ``light_weights``."""
        means = np.zeros_like(self._sums)
        orientation, cube = self.cells.cubes(self.cell_of_record[1:])
        counts, sums = self._counts[1:], self._sums[1:]
        around, prior = np.zeros_like(sums), 0.0
        for level in range(LEVELS, -1, -1):
            blocks = np.ravel_multi_index((orientation, *(cube.T >> level)), (6, *self.cells.shape))
            _, block = np.unique(blocks, return_inverse=True)
            total = np.bincount(block, counts)[block]
            added = np.stack([np.bincount(block, column)[block] for column in sums.T], axis=-1)
            around = (added + prior * around) / (total + prior)[:, None]
            prior = PRIOR_SAMPLES
        means[1:] = around
        means[0, 3:] = sums[:, 3:].sum(axis=0)  # cells without a record share the sum over all records
        self._upload(means[:, :3])
        self.light_weights = np.sqrt(means[:, 3:])

    def _upload(self, means: NDArray[np.float64]) -> None:
        state = np.concatenate([[_UNKNOWN], np.where(self._is_thin(), _THIN, _UNIFORM)])
        self.records = mi.UInt32(self._record_of_cell)
        self.means = mi.Float(aligned(np.column_stack([means, state]), np.float32))

    def _is_thin(self) -> NDArray[np.bool_]:
        """Mask (records,) of thin cells."""
        orientation, cube = self.cells.cubes(self.cell_of_record[1:])
        place = 6 * np.ravel_multi_index(tuple(cube.T), self.cells.shape)
        return np.isin(place + (orientation ^ 1), place + orientation)

    def record(self, point: Array, normal: Array, active: Array) -> Array:
        """Record number of a surface point with ``normal``; 0 for none."""
        cell, is_inside = self.cells.index(point, normal, active)
        return dr.gather(mi.UInt32, self.records, cell, is_inside)

    def irradiance(self, record: Array, is_last: Array, active: Array) -> tuple[Any, Any]:
        """Irradiance (Color3f) of a record, and whether a path may end there.

        In thin cells, only paths at their last vertex (``is_last``), which are truncated otherwise, may end.
        """
        found: Any = dr.gather(mi.Vector4f, self.means, record, active)
        allowed = (found.w == _UNIFORM) | (is_last & (found.w == _THIN))
        return mi.Color3f(found.x, found.y, found.z), active & allowed

    def mean_radiance(
        self,
        si: Any,
        direction: Array,
        record: Array,
        spread_m: Array,
        is_last: Array,
        sample: Array,
        active: Array,
    ) -> tuple[Any, Any]:
        """Mean incident radiance E / pi at a hit, and whether a path of spread ``spread_m`` may end there.

        At their last vertex (``is_last``), paths may end wherever E is known. The lookup is jittered by up to
        half a cell, by ``sample`` in [0, 1)^2, which blends neighbouring cells on average; if the jittered
        cell has no record, the hit's ``record`` is used.
        """
        normal = facing_normal(si, direction)
        is_wide = active & (is_last | (spread_m > MIN_SPREAD * self.cells.side))
        here, is_known = self.irradiance(record, is_last, is_wide)
        frame = mi.Frame3f(normal)
        shift = (sample - 0.5) * self.cells.side
        other = self.record(si.p + frame.s * shift.x + frame.t * shift.y, normal, is_known)
        jittered, is_jittered_known = self.irradiance(other, is_last, is_known)
        return INVERSE_PI * dr.select(is_jittered_known, jittered, here), is_known


def spread_of(previous: Any, pdf: Array, si: Any, direction: Array) -> Array:
    """Spread [m] at hit ``si``: root of the area 1 / density, with the direction's density ``pdf`` [1/sr]."""
    cosine = dr.maximum(dr.abs(dr.dot(si.n, direction)), 1e-3)
    return dr.norm(si.p - previous.p) * dr.rsqrt(dr.maximum(pdf * cosine, 1e-30))

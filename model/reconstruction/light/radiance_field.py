# SPDX-License-Identifier: MIT
"""Incident radiance of a photographed room: the radiance that a ray meets, as one Dr.Jit function.

A ray that hits an emitter meets the emitter's radiance; one that hits another surface meets the radiance of
the surfel there, else that of the cells twice and four times as large; one that leaves the mesh meets the
background in its direction. What no photograph shows is estimated (:meth:`RadianceField.extended`) or
unknown. Everything runs on the CPU and on CUDA from one source.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datagen.multiview.visibility import aligned
from model.reconstruction.light.background import Background
from model.reconstruction.light.emitters import Emitters
from model.reconstruction.light.surfels import NUM_SIDES, CellGrid, Surfels

if TYPE_CHECKING:
    import mitsuba as mi

NUM_LEVELS = 3
"""Cells of one, two and four times the surfels' side."""


class Met(NamedTuple):
    """Of a ray: ``radiance``, 0 where unknown; ``is_known`` and ``is_photographed`` (not estimated);
    ``is_front_of_emitter``, then ``face`` its triangle, ``distance_m`` and ``cosine`` at it."""

    radiance: Any
    is_known: Any
    is_photographed: Any
    is_front_of_emitter: Any
    face: Any
    distance_m: Any
    cosine: Any


@dataclass(frozen=True)
class Cells:
    """Radiance (K, 3) by cell: ``index`` (cells of a level) into it or -1, ``cell_m``, ``shape`` (3,)."""

    index: NDArray[np.int32]
    cell_m: float
    shape: NDArray[np.int64]
    radiance: NDArray[np.float32]
    is_photographed: NDArray[np.bool_]


class RadianceField:
    """The radiance that leaves the surfaces of ``surfels``, the ``emitters`` and the ``background``."""

    def __init__(
        self,
        scene: mi.Scene,
        surfels: Surfels,
        emitters: Emitters,
        background: Background,
        cells: Cells | None = None,
    ):
        self.scene = scene
        self.emitters = emitters
        self.background = background
        self._low = surfels.grid.low
        self.cells = cells or _surfel_cells(surfels)
        self._levels = [self._upload(level) for level in _pyramid(self.cells)]
        self._emitter_of_face = _int32(emitters.of_face)
        self._side_of_face = _float(emitters.side_of_face)
        self._emitter_radiance = _float(emitters.radiance.ravel() if len(emitters) else np.zeros(3))
        self._background = _float(background.radiance.ravel())
        known = background.is_known.astype(np.float32) + background.is_photographed
        self._background_known = _float(known)

    def _upload(self, cells: Cells) -> tuple[Any, ...]:
        return (
            _int32(cells.index),
            _float(cells.radiance.ravel()),
            _float(cells.is_photographed.astype(np.float32)),
            cells.cell_m,
            [int(n) for n in cells.shape],
        )

    def _lookup(self, position: Any, normal: Any, active: Any) -> tuple[Any, Any, Any]:
        """Radiance, and whether it is known and photographed, of surface at ``position`` on the side of
        ``normal``."""
        import drjit as dr
        import mitsuba as mi

        side = _side(normal)
        radiance, is_known, is_photographed = mi.Color3f(0.0), mi.Bool(False), mi.Bool(False)
        for index, table, photographed, cell_m, shape in self._levels:
            at = [
                mi.Int32(dr.floor((position[axis] - float(self._low[axis])) * (1.0 / cell_m)))
                for axis in range(3)
            ]
            wanted = active & ~is_known
            for axis in range(3):
                wanted &= (at[axis] >= 0) & (at[axis] < shape[axis])
            key = ((at[0] * shape[1] + at[1]) * shape[2] + at[2]) * NUM_SIDES + side
            row = dr.gather(mi.Int32, index, key, wanted)
            wanted &= row >= 0
            radiance = dr.select(wanted, dr.gather(mi.Color3f, table, row, wanted), radiance)
            is_photographed |= wanted & (dr.gather(mi.Float, photographed, row, wanted) > 0)
            is_known |= wanted
        return radiance, is_known, is_photographed

    def meet(self, ray: Any, active: Any) -> Met:
        """What ``ray`` meets."""
        import drjit as dr
        import mitsuba as mi

        pi = self.scene.ray_intersect_preliminary(ray, active=active)
        is_hit = active & pi.is_valid()
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, is_hit)
        emitter = dr.select(is_hit, dr.gather(mi.Int32, self._emitter_of_face, si.prim_index, is_hit), -1)
        emits = emitter >= 0
        normal = dr.select(dr.dot(si.sh_frame.n, ray.d) < 0, si.sh_frame.n, -si.sh_frame.n)
        radiance, is_known, is_photographed = self._lookup(si.p, normal, is_hit & ~emits)
        cosine = -dr.dot(si.n, ray.d) * dr.gather(mi.Float, self._side_of_face, si.prim_index, emits)
        front = emits & (cosine > 0)
        radiance = dr.select(front, dr.gather(mi.Color3f, self._emitter_radiance, emitter, front), radiance)
        missed = active & ~is_hit
        where = self.background.bin_of(ray.o, ray.d)
        knowledge = dr.gather(mi.Float, self._background_known, where, missed)
        radiance = dr.select(missed, dr.gather(mi.Color3f, self._background, where, missed), radiance)
        return Met(
            radiance,
            is_known | emits | (missed & (knowledge > 0.5)),
            is_photographed | emits | (missed & (knowledge > 1.5)),
            front,
            si.prim_index,
            si.t,
            cosine,
        )

    def unknown_hits(self, ray: Any) -> tuple[NDArray, NDArray]:
        """Where rays hit surface whose radiance is unknown: positions and normals (K, 3) towards the rays."""
        import drjit as dr
        import mitsuba as mi

        si = self.scene.ray_intersect(ray)
        is_hit = si.is_valid()
        normal = dr.select(dr.dot(si.sh_frame.n, ray.d) < 0, si.sh_frame.n, -si.sh_frame.n)
        is_surface = is_hit & (dr.gather(mi.Int32, self._emitter_of_face, si.prim_index, is_hit) < 0)
        _, is_known, _ = self._lookup(si.p, normal, is_surface)
        position = si.p
        dr.eval(position, normal, is_surface, is_known)
        chosen = np.asarray((is_surface & ~is_known).numpy(), dtype=bool)
        return (
            np.asarray(position.numpy()).reshape(3, -1).T[chosen],
            np.asarray(normal.numpy()).reshape(3, -1).T[chosen],
        )

    def extended(
        self, position_m: NDArray, normal: NDArray, surfels: Surfels, radiance: NDArray
    ) -> RadianceField:
        """The same with estimates of the radiance (K, 3) of surface that no photograph shows."""
        keys = cell_keys(surfels.grid, position_m, normal)
        inside = keys >= 0
        order = np.unique(keys[inside], return_index=True)
        chosen = np.flatnonzero(inside)[order[1]]
        index = self.cells.index.copy()
        free = index[order[0]] < 0
        index[order[0][free]] = len(self.cells.radiance) + np.arange(int(free.sum()), dtype=np.int32)
        cells = replace(
            self.cells,
            index=index,
            radiance=np.concatenate([self.cells.radiance, radiance[chosen[free]]]).astype(np.float32),
            is_photographed=np.concatenate([self.cells.is_photographed, np.zeros(int(free.sum()), bool)]),
        )
        return RadianceField(self.scene, surfels, self.emitters, self.background, cells)


def cell_keys(grid: CellGrid, position_m: NDArray, normal: NDArray) -> NDArray[np.int64]:
    """Cell and side (N,) of points, -1 outside of the grid."""
    at = np.floor((position_m - grid.low) / grid.cell_m).astype(np.int64)
    inside = ((at >= 0) & (at < grid.shape)).all(axis=1)
    axis = np.abs(normal).argmax(axis=1)
    side = 2 * axis + (normal[np.arange(len(normal)), axis] > 0)
    key = ((at[:, 0] * grid.shape[1] + at[:, 1]) * grid.shape[2] + at[:, 2]) * NUM_SIDES + side
    return np.where(inside, key, -1)


def _side(normal: Any) -> Any:
    """Side of a cell that a normal belongs to, as :func:`surfels.cell_of` has it."""
    import drjit as dr
    import mitsuba as mi

    x, y, z = dr.abs(normal.x), dr.abs(normal.y), dr.abs(normal.z)
    along_x = (x >= y) & (x >= z)
    along_y = ~along_x & (y >= z)
    part = dr.select(along_x, normal.x, dr.select(along_y, normal.y, normal.z))
    return mi.Int32(dr.select(along_x, 0, dr.select(along_y, 2, 4))) + dr.select(part > 0, mi.Int32(1), 0)


def _surfel_cells(surfels: Surfels) -> Cells:
    grid = surfels.grid
    return Cells(grid.surfel, grid.cell_m, grid.shape, surfels.radiance, np.ones(len(surfels), dtype=bool))


def _pyramid(cells: Cells) -> list[Cells]:
    """The cells, and those of twice and four times their side, whose radiance is the mean of theirs."""
    levels = [cells]
    occupied = np.flatnonzero(cells.index >= 0)
    side, rest = occupied % NUM_SIDES, occupied // NUM_SIDES
    z, rest = rest % cells.shape[2], rest // cells.shape[2]
    at = np.stack([rest // cells.shape[1], rest % cells.shape[1], z], axis=1)
    row = cells.index[occupied]
    for level in range(1, NUM_LEVELS):
        shape = (cells.shape + (1 << level) - 1) >> level
        coarse = at >> level
        key = ((coarse[:, 0] * shape[1] + coarse[:, 1]) * shape[2] + coarse[:, 2]) * NUM_SIDES + side
        keys, place = np.unique(key, return_inverse=True)
        num = np.bincount(place)
        radiance = np.stack([np.bincount(place, cells.radiance[row, c]) / num for c in range(3)], axis=1)
        index = np.full(int(np.prod(shape)) * NUM_SIDES, -1, np.int32)
        index[keys] = np.arange(len(keys), dtype=np.int32)
        photographed = np.bincount(place, cells.is_photographed[row]) > 0
        levels.append(
            Cells(index, cells.cell_m * (1 << level), shape, radiance.astype(np.float32), photographed)
        )
    return levels


def _float(values: NDArray) -> Any:
    import mitsuba as mi

    return mi.Float(aligned(np.ascontiguousarray(values), np.float32))


def _int32(values: NDArray) -> Any:
    import mitsuba as mi

    return mi.Int32(np.ascontiguousarray(values, np.int32))

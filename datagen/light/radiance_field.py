# SPDX-License-Identifier: MIT
"""Radiance along rays in a photographed room, evaluated by Dr.Jit kernels on CPU and CUDA.

A ray that hits an emitter returns the emitter's radiance. A ray that hits another surface returns the
radiance of the surfel there or, without a surfel, of the enclosing cell of twice or four times the size. A
ray that leaves the mesh returns the background in its direction. Unphotographed radiance is estimated
(:meth:`RadianceField.extended`) or unknown. At detected metals, whose radiance towards the cameras differs
from that along the ray, ``bake.Baker`` reflects rays once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datagen.light.background import Background
from datagen.light.cells import Cells, cell_keys, outer_cells, pyramid
from datagen.light.emitters import Emitters
from datagen.light.surfels import NUM_SIDES, Surfels
from mitsuba_plugins.arrays import aligned, point_argument, rows_from_vectors
from mitsuba_plugins.beckmann import (
    alpha_from_roughness,
    beckmann_d,
    smith_g1_over_cos,
)

if TYPE_CHECKING:
    import mitsuba as mi

MIN_COSINE = 0.02
"""Lower bound to which the cosine between normal and view direction is clamped."""


class RayResult(NamedTuple):
    """Result of tracing a ray: ``radiance`` is 0 unless known; ``is_photographed`` is False for estimates.

    ``face`` is the triangle hit; ``distance_m`` is infinite for a miss. ``cosine``, between the emitter's
    normal and the reversed ray, is valid only if ``is_front_of_emitter``.
    """

    radiance: Any
    is_known: Any
    is_photographed: Any
    is_front_of_emitter: Any
    face: Any
    distance_m: Any
    cosine: Any


@dataclass(frozen=True)
class Metals:
    """Specular parameters of a field's metals, for each of the K rows of ``Cells.radiance``.

    ``specular_albedo`` (K, 3), ``roughness`` (K,), ``is_metal`` (K,).
    """

    specular_albedo: NDArray[np.float32]
    roughness: NDArray[np.float32]
    is_metal: NDArray[np.bool_]


class Estimated(NamedTuple):
    """K rays whose radiance is estimated: their indices ``ray`` (K,) and their ``radiance`` (K, 3).

    ``background_bin`` (K,): bin of rays that leave the mesh; -1 for the others, which hit a surface at
    ``position_m`` (K, 3) with ``normal`` (K, 3).
    """

    ray: NDArray[np.int64]
    radiance: NDArray[np.float32]
    background_bin: NDArray[np.int64]
    position_m: NDArray[np.float32]
    normal: NDArray[np.float32]


class End(NamedTuple):
    """Endpoint of a ray: the ``result``, the ``row`` of the cell in ``Cells.radiance`` (-1 for none), the
    position, the normal facing the ray's origin, and whether the ray ``leaves`` the mesh.
    """

    result: RayResult
    row: Any
    position: Any
    normal: Any
    leaves: Any


class RadianceField:
    """Radiance along rays in ``scene``, from ``cells`` of surfaces, ``emitters`` and ``background``.

    ``cells`` may include estimates; ``outer``: larger cells outside their grid; ``metals`` reflect rays once.
    """

    def __init__(
        self,
        scene: mi.Scene,
        cells: Cells,
        emitters: Emitters,
        background: Background,
        metals: Metals | None = None,
        outer: Cells | None = None,
    ):
        self.scene = scene
        self.emitters = emitters
        self.background = background
        self.cells = cells
        self.outer = outer
        levels = pyramid(self.cells) + ([] if outer is None else [outer])
        self._levels = [self._upload(level) for level in levels]
        self._emitter_of_face = _int32(emitters.of_face)
        self._side_of_face = _float(emitters.side_of_face)
        self._emitter_radiance = _float(emitters.radiance.ravel() if len(emitters) else np.zeros(3))
        self._background = _float(background.radiance.ravel())
        known = background.is_known.astype(np.float32) + background.is_photographed
        self._background_known = _float(known)
        self.metals = metals
        if metals is not None:
            self._is_metal = _float(metals.is_metal.astype(np.float32))
            self._metal_albedo = _float(metals.specular_albedo.ravel())
            self._metal_roughness = _float(metals.roughness)

    def _upload(self, cells: Cells) -> tuple[Any, ...]:
        # opaque, since literals would cause a separate kernel for each room
        import drjit as dr
        import mitsuba as mi

        return (
            mi.Int32(cells.index),
            _float(cells.radiance.ravel()),
            _float(cells.is_photographed.astype(np.float32)),
            point_argument(cells.low),
            dr.opaque(mi.Float, 1.0 / cells.cell_m),
            [dr.opaque(mi.Int32, int(n)) for n in cells.shape],
        )

    def _lookup(self, position: Any, normal: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """Look up the radiance of the surface at ``position`` with ``normal``, whether it is known, whether
        it is photographed, and the row of the finest cell (-1 for none).
        """
        import drjit as dr
        import mitsuba as mi

        side = _side(normal)
        radiance, is_known, is_photographed = mi.Color3f(0.0), mi.Bool(False), mi.Bool(False)
        finest = mi.Int32(-1)
        for level, (index, table, photographed, low, cells_per_m, shape) in enumerate(self._levels):
            at = [mi.Int32(dr.floor((position[axis] - low[axis]) * cells_per_m)) for axis in range(3)]
            wanted = active & ~is_known
            for axis in range(3):
                wanted &= (at[axis] >= 0) & (at[axis] < shape[axis])
            key = ((at[0] * shape[1] + at[1]) * shape[2] + at[2]) * NUM_SIDES + side
            row = dr.gather(mi.Int32, index, key, wanted)
            wanted &= row >= 0
            radiance = dr.select(wanted, dr.gather(mi.Color3f, table, row, wanted), radiance)
            is_photographed |= wanted & (dr.gather(mi.Float, photographed, row, wanted) > 0)
            is_known |= wanted
            if level == 0:
                finest = dr.select(wanted, row, finest)
        return radiance, is_known, is_photographed, finest

    def metal_at(self, end: End) -> tuple[Any, Any, Any]:
        """Return whether a ray's ``end`` is on metal, the specular albedo there, and alpha, 1 elsewhere."""
        import drjit as dr
        import mitsuba as mi

        is_metal = end.row >= 0
        is_metal &= dr.gather(mi.Float, self._is_metal, end.row, is_metal) > 0
        albedo = dr.gather(mi.Color3f, self._metal_albedo, end.row, is_metal)
        alpha = alpha_from_roughness(dr.gather(mi.Float, self._metal_roughness, end.row, is_metal))
        return is_metal, albedo, dr.select(is_metal, alpha, 1.0)

    def trace(self, ray: Any, active: Any) -> End:
        """Trace ``ray`` into the field, without reflections at metals."""
        import drjit as dr
        import mitsuba as mi

        pi = self.scene.ray_intersect_preliminary(ray, active=active)
        is_hit = active & pi.is_valid()
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, is_hit)
        emitter = dr.select(is_hit, dr.gather(mi.Int32, self._emitter_of_face, si.prim_index, is_hit), -1)
        emits = emitter >= 0
        normal = dr.select(dr.dot(si.sh_frame.n, ray.d) < 0, si.sh_frame.n, -si.sh_frame.n)
        radiance, is_known, is_photographed, row = self._lookup(si.p, normal, is_hit & ~emits)
        cosine = -dr.dot(si.n, ray.d) * dr.gather(mi.Float, self._side_of_face, si.prim_index, emits)
        front = emits & (cosine > 0)
        radiance = dr.select(front, dr.gather(mi.Color3f, self._emitter_radiance, emitter, front), radiance)
        missed = active & ~is_hit
        where = self.background.bin_of(ray.o, ray.d)
        knowledge = dr.gather(mi.Float, self._background_known, where, missed)
        radiance = dr.select(missed, dr.gather(mi.Color3f, self._background, where, missed), radiance)
        result = RayResult(
            radiance,
            is_known | emits | (missed & (knowledge > 0.5)),
            is_photographed | emits | (missed & (knowledge > 1.5)),
            front,
            si.prim_index,
            si.t,
            cosine,
        )
        return End(result, row, si.p, normal, missed)

    def unknown_hits(self, ray: Any) -> tuple[NDArray, NDArray, NDArray[np.int64]]:
        """Return positions (K, 3), ray-facing normals (K, 3) and triangles (K,) of hits on surfaces of
        unknown radiance.
        """
        import drjit as dr
        import mitsuba as mi

        end = self.trace(ray, mi.Bool(True))
        is_unknown = ~end.leaves & ~end.result.is_known
        dr.eval(is_unknown, end)
        chosen = np.flatnonzero(is_unknown.numpy())
        position, normal = (rows_from_vectors(values)[chosen] for values in (end.position, end.normal))
        return position, normal, np.asarray(end.result.face.numpy())[chosen].astype(np.int64)

    def estimated(self, ray: Any) -> Estimated:
        """Trace ``ray``, and return the rays whose radiance is estimated rather than photographed."""
        import drjit as dr
        import mitsuba as mi

        end = self.trace(ray, mi.Bool(True))
        where = dr.select(end.leaves, mi.Int32(self.background.bin_of(ray.o, ray.d)), -1)
        is_estimated = end.result.is_known & ~end.result.is_photographed
        dr.eval(is_estimated, where, end)
        chosen = np.flatnonzero(is_estimated.numpy())
        radiance, position, normal = (
            rows_from_vectors(values)[chosen] for values in (end.result.radiance, end.position, end.normal)
        )
        bins = np.asarray(where.numpy())[chosen].astype(np.int64)
        return Estimated(chosen, radiance, bins, position, normal)

    def extended(
        self, position_m: NDArray, normal: NDArray, surfels: Surfels, radiance: NDArray
    ) -> RadianceField:
        """Return a field that adds the estimated ``radiance`` (K, 3) of unphotographed surfaces at positions
        (K, 3) with normals (K, 3), inside or outside the grid of the surfels."""
        keys = cell_keys(surfels.grid, position_m, normal)
        inside = keys >= 0
        outer = outer_cells(surfels.grid, position_m[~inside], normal[~inside], radiance[~inside])
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
        return self._changed(cells=cells, outer=outer)

    def with_radiance(self, surfels: Surfels, radiance: NDArray) -> RadianceField:
        """Return a field in which ``surfels`` have ``radiance`` (N, 3) instead of the photographed one."""
        rows = np.concatenate([radiance, self.cells.radiance[len(surfels) :]]).astype(np.float32)
        return self._changed(cells=replace(self.cells, radiance=rows))

    def with_background(self, background: Background) -> RadianceField:
        """Return the field with ``background`` instead of its own."""
        return self._changed(background=background)

    def with_metals(
        self,
        surfels: Surfels,
        specular_albedo: NDArray,
        roughness: NDArray,
        is_metal: NDArray[np.bool_],
    ) -> RadianceField:
        """Return a field in which metallic ``surfels`` reflect rays.

        Per surfel: ``specular_albedo`` (N, 3), ``roughness`` (N,) and ``is_metal`` (N,).
        """
        rest = len(self.cells.radiance) - len(surfels)  # rows of estimated surfaces
        metals = Metals(
            np.pad(specular_albedo, ((0, rest), (0, 0))).astype(np.float32),
            np.pad(roughness, (0, rest), constant_values=1.0).astype(np.float32),
            np.pad(is_metal, (0, rest)),
        )
        return self._changed(metals=metals)

    def _changed(self, **parts: Any) -> RadianceField:
        names = ("cells", "emitters", "background", "metals", "outer")
        return RadianceField(self.scene, **{name: getattr(self, name) for name in names} | parts)


def schlick_weight(cosine: Any) -> Any:
    """Schlick's Fresnel weight (1 - ``cosine``)^5, where ``cosine`` is wi.h."""
    import drjit as dr

    m = dr.clip(1.0 - cosine, 0.0, 1.0)
    return dr.square(dr.square(m)) * m


def lobe_pdf(wi: Any, wo: Any, h: Any, alpha: Any) -> Any:
    """Density [1/sr] of ``wo`` for ``h`` sampled from the visible normals: D(h) G1(wi) / (4 cos_i)."""
    import drjit as dr

    valid = (h.z > 0) & (wo.z > 0)
    return dr.select(valid, 0.25 * beckmann_d(h, alpha) * smith_g1_over_cos(wi, alpha), 0.0)


def _side(normal: Any) -> Any:
    """Index, from 0 to 5, of the cell side of a normal, consistent with :func:`surfels.cell_of`."""
    import drjit as dr
    import mitsuba as mi

    x, y, z = dr.abs(normal.x), dr.abs(normal.y), dr.abs(normal.z)
    along_x = (x >= y) & (x >= z)
    along_y = ~along_x & (y >= z)
    part = dr.select(along_x, normal.x, dr.select(along_y, normal.y, normal.z))
    return mi.Int32(dr.select(along_x, 0, dr.select(along_y, 2, 4))) + dr.select(part > 0, mi.Int32(1), 0)


def _float(values: NDArray) -> Any:
    import mitsuba as mi

    return mi.Float(aligned(np.ascontiguousarray(values), np.float32))


def _int32(values: NDArray) -> Any:
    import mitsuba as mi

    return mi.Int32(aligned(values, np.int32))

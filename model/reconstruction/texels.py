# SPDX-License-Identifier: MIT
"""Texels of an atlas and the surface under them: which triangle covers a texel's centre, and where it is.

The unwrap itself is a mesh in a plane, in units of texels, and rays dropped on it find the triangle and the
barycentric coordinates: a rasteriser that is exact at texel centres, tiles freely and runs where rays run.
Row 0 of an atlas is at v = 1. A triangle's height in that stack is its index, so that a ray from above and
one from below meet different triangles wherever two overlap.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datagen.meshes import Mesh
from model.reconstruction.geometry import copied, mesh_scene

if TYPE_CHECKING:
    import mitsuba as mi

_STACK_HEIGHT = 4.0  # of the pile of triangles: spacing stays above float32's for millions of them


class TexelTile(NamedTuple):
    """Covered texels of a tile, K of them (Dr.Jit arrays)."""

    texel: mi.UInt32
    """(K,) row * tile width + column."""
    face: mi.UInt32
    points: mi.Point3f
    normals: mi.Vector3f


class TexelSurface:
    """The surface of an unwrapped mesh by texel of a ``size`` x ``size`` atlas.

    ``normals`` (M, 3) are the triangles' unit normals. The Mitsuba variant must have been selected.
    """

    def __init__(self, mesh: Mesh, normals: NDArray[np.float32], size: int):
        import mitsuba as mi

        if mesh.uv is None:
            raise ValueError("expected a mesh with UVs")
        self.size, self.num_faces = size, len(mesh.faces)
        self._scene = _unwrapped_scene(mesh, size)
        self._faces = mi.UInt32(copied(mesh.faces, np.uint32))
        self._positions = mi.Float(copied(mesh.positions, np.float32))
        self._normals = mi.Float(copied(normals, np.float32))

    def tile(self, left: int, top: int, width: int, height: int) -> TexelTile:
        """The covered texels of a rectangle of the atlas."""
        import drjit as dr
        import mitsuba as mi

        index = dr.arange(mi.UInt32, width * height)
        hit = self._drop(index, left, top, width, is_from_above=True)
        dr.eval(hit)
        is_covered = hit.is_valid()
        chosen: Any = dr.compress(is_covered)
        face = dr.gather(mi.UInt32, hit.prim_index, chosen)
        weights = dr.gather(mi.Point2f, hit.prim_uv, chosen)
        corners = dr.gather(mi.Vector3u, self._faces, face)
        a, b, c = (dr.gather(mi.Point3f, self._positions, corners[k]) for k in range(3))
        points: Any = a + (b - a) * weights.x + (c - a) * weights.y
        normals = dr.gather(mi.Vector3f, self._normals, face)
        dr.eval(chosen, face, points, normals)
        return TexelTile(chosen, face, points, normals)

    def faces(self, left: int, top: int, width: int, height: int) -> NDArray[np.int32]:
        """Triangle of each texel of a rectangle, (height, width); -1 where none covers it."""
        import drjit as dr
        import mitsuba as mi

        hit = self._drop(dr.arange(mi.UInt32, width * height), left, top, width, is_from_above=True)
        covered = np.asarray(hit.is_valid().numpy(), dtype=bool)
        face = np.where(covered, np.asarray(hit.prim_index.numpy()).astype(np.int64), -1)
        return face.astype(np.int32).reshape(height, width)

    def overlap_mask(self, offset: tuple[float, float] = (0.5, 0.5)) -> tuple[NDArray, NDArray]:
        """(covered, covered by several triangles), each (size, size), at ``offset`` inside every texel."""
        import drjit as dr
        import mitsuba as mi

        index = dr.arange(mi.UInt32, self.size * self.size)
        above = self._drop(index, 0, 0, self.size, is_from_above=True, offset=offset)
        below = self._drop(index, 0, 0, self.size, is_from_above=False, offset=offset)
        covered = above.is_valid()
        several = covered & (above.prim_index != below.prim_index)
        shape = (self.size, self.size)
        return (
            np.asarray(covered.numpy(), dtype=bool).reshape(shape),
            np.asarray(several.numpy(), dtype=bool).reshape(shape),
        )

    def _drop(
        self,
        index: mi.UInt32,
        left: int,
        top: int,
        width: int,
        *,
        is_from_above: bool,
        offset: tuple[float, float] = (0.5, 0.5),
    ) -> mi.PreliminaryIntersection3f:
        import drjit as dr
        import mitsuba as mi

        columns = dr.opaque(mi.UInt32, width)
        row = index // dr.maximum(columns, 1)
        x = mi.Float(index - row * columns) + dr.opaque(mi.Float, left + offset[0])
        y = mi.Float(row) + dr.opaque(mi.Float, top + offset[1])
        start, way = (_STACK_HEIGHT + 1, -1.0) if is_from_above else (-1.0, 1.0)
        ray = mi.Ray3f(mi.Point3f(x, y, start), mi.Vector3f(0, 0, way))
        return self._scene.ray_intersect_preliminary(ray)


def _unwrapped_scene(mesh: Mesh, size: int) -> mi.Scene:
    """Every triangle flat at its UVs in texels, at a height of its own."""
    assert mesh.uv is not None
    num_faces = len(mesh.faces)
    corners = mesh.uv.astype(np.float64)[mesh.faces.ravel()]
    flat = np.empty((num_faces * 3, 3))
    flat[:, 0] = corners[:, 0] * size
    flat[:, 1] = (1.0 - corners[:, 1]) * size
    flat[:, 2] = np.repeat(np.arange(num_faces) * (_STACK_HEIGHT / max(num_faces, 1)), 3)
    faces = np.arange(num_faces * 3, dtype=np.int32).reshape(-1, 3)
    return mesh_scene(Mesh(flat.astype(np.float32), faces))

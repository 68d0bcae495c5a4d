# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads evaluated meshes as arrays, and splits them into triangles of one material with shared vertices.

Sizes: V vertices, C face corners, T triangles. Corners index vertices; triangles index corners. Coordinates
are in the object's frame, in Blender units.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import bpy
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
IntArray = NDArray[np.int32]


@dataclass(frozen=True)
class MeshArrays:
    """Arrays of an evaluated mesh.

    ``positions`` (V, 3). ``corner_vertices`` (C,): the vertex of each corner. ``normals``: unit normals,
    (V, 3) if the whole mesh is smooth, else (C, 3). ``triangles`` (T, 3): corners of each triangle.
    ``triangle_polygons`` (T,): polygon of each triangle. ``triangle_slots`` (T,): its material slot.
    ``uv_layers``: UVs (C, 2) by layer name, v upwards. ``active_uv``: the layer active in rendering, or "".
    """

    positions: FloatArray
    corner_vertices: IntArray
    normals: FloatArray
    triangles: IntArray
    triangle_polygons: IntArray
    triangle_slots: IntArray
    uv_layers: dict[str, FloatArray] = field(default_factory=dict)
    active_uv: str = ""

    @cached_property
    def used_slots(self) -> list[int]:
        return np.unique(self.triangle_slots).tolist()

    @property
    def is_smooth(self) -> bool:
        """True if normals belong to vertices rather than to corners."""
        return len(self.normals) == len(self.positions) and len(self.normals) != len(self.corner_vertices)


@dataclass(frozen=True)
class Submesh:
    """Triangles ``faces`` (T, 3) of one material; ``positions`` and ``normals`` (N, 3), ``uv`` (N, 2)."""

    positions: FloatArray
    normals: FloatArray
    uv: FloatArray | None
    faces: IntArray


def _read(
    collection: bpy.types.bpy_prop_collection, name: str, shape: tuple[int, ...], dtype: type
) -> NDArray:
    values: NDArray = np.empty(int(np.prod(shape)), dtype)
    collection.foreach_get(name, values)
    return values.reshape(shape)


def gather_mesh(mesh: bpy.types.Mesh) -> MeshArrays:
    """Read an evaluated mesh; polygons are triangulated as in Blender's renderer."""
    num_corners, num_triangles = len(mesh.loops), len(mesh.loop_triangles)
    corner_vertices = _read(mesh.attributes[".corner_vert"].data, "value", (num_corners,), np.int32)
    positions = _read(mesh.attributes["position"].data, "vector", (len(mesh.vertices), 3), np.float32)
    triangles = _read(mesh.loop_triangles, "loops", (num_triangles, 3), np.int32)
    polygons = _read(mesh.loop_triangle_polygons, "value", (num_triangles,), np.int32)
    if mesh.normals_domain == "POINT":
        normals = _read(mesh.vertex_normals, "vector", (len(mesh.vertices), 3), np.float32)
    else:
        normals = _read(mesh.corner_normals, "vector", (num_corners, 3), np.float32)
    slots = np.zeros(num_triangles, np.int32)
    if "material_index" in mesh.attributes:
        per_polygon = _read(mesh.attributes["material_index"].data, "value", (len(mesh.polygons),), np.int32)
        slots = per_polygon[polygons]
    last_slot = max(len(mesh.materials) - 1, 0)  # Blender uses the last slot for an index beyond the end
    layers = {layer.name: _read(layer.uv, "vector", (num_corners, 2), np.float32) for layer in mesh.uv_layers}
    active = next((layer.name for layer in mesh.uv_layers if layer.active_render), "")
    return MeshArrays(
        positions, corner_vertices, normals, triangles, polygons, np.clip(slots, 0, last_slot), layers, active
    )


def _hash_rows(*columns: NDArray) -> NDArray[np.uint64]:
    """Hash the bits of each row of float32 or int32 columns (N, k) to 64 bits (N,)."""
    result = np.zeros(len(columns[0]), np.uint64)
    multiplier = np.uint64(0x9E3779B97F4A7C15)
    for column in columns:
        bits = np.ascontiguousarray(column).view(np.uint32).reshape(len(column), -1)
        for index in range(bits.shape[1]):
            result ^= bits[:, index].astype(np.uint64) + np.uint64(0x7F4A7C15)
            result *= multiplier
            result ^= result >> np.uint64(29)
    return result


def submesh(
    mesh: MeshArrays, slot: int | None = None, uv: FloatArray | None = None, is_mirrored: bool = False
) -> Submesh:
    """Extract the triangles of one slot (None: all), with equal corners merged to one vertex.

    ``uv`` (C, 2) are the texture coordinates to write. ``is_mirrored`` negates x and reverses the winding,
    for instances with a mirroring matrix. Triangles that refer to a vertex twice are omitted.
    """
    triangles = mesh.triangles if slot is None else mesh.triangles[mesh.triangle_slots == slot]
    vertices = mesh.corner_vertices[triangles]
    is_proper = (vertices != np.roll(vertices, -1, axis=1)).all(axis=1)
    if not is_proper.all():
        triangles, vertices = triangles[is_proper], vertices[is_proper]
    if mesh.is_smooth and uv is None:
        used, faces = _compact(vertices.ravel(), len(mesh.positions))
        positions, normals, out_uv = mesh.positions[used], mesh.normals[used], None
    else:
        corners = triangles.ravel()
        corner_vertex = mesh.corner_vertices[corners]
        columns: list[NDArray] = [corner_vertex[:, None]]
        if not mesh.is_smooth:
            columns.append(mesh.normals[corners] + np.float32(0))  # adding 0 turns -0 into 0
        if uv is not None:
            columns.append(uv[corners] + np.float32(0))
        first, faces = _merge(columns)
        representative = corners[first]
        vertex = mesh.corner_vertices[representative]
        positions = mesh.positions[vertex]
        normals = mesh.normals[vertex] if mesh.is_smooth else mesh.normals[representative]
        out_uv = None if uv is None else uv[representative]
    faces = faces.reshape(-1, 3).astype(np.int32)
    if is_mirrored:
        mirror = np.array([-1, 1, 1], np.float32)
        positions, normals, faces = positions * mirror, normals * mirror, faces[:, ::-1]
    return Submesh(positions, normals, out_uv, np.ascontiguousarray(faces))


def _compact(indices: IntArray, size: int) -> tuple[IntArray, IntArray]:
    """The distinct ``indices`` (< ``size``) in increasing order, and each index's position among them."""
    is_used = np.zeros(size, bool)
    is_used[indices] = True
    number = np.cumsum(is_used, dtype=np.int32) - 1
    return np.flatnonzero(is_used).astype(np.int32), number[indices]


def _merge(columns: list[NDArray]) -> tuple[NDArray, NDArray]:
    """Indices of the first row of each group of equal rows, in order, and the group (N,) of each row."""
    hashes = _hash_rows(*columns)
    _, first, inverse = np.unique(hashes, return_index=True, return_inverse=True)
    inverse = inverse.reshape(-1)
    order = np.argsort(first, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    first, inverse = first[order], rank[inverse]
    for column in columns:  # nothing is merged after a hash collision, which would weld unequal vertices
        if not np.array_equal(column[first][inverse], column):
            return np.arange(len(hashes)), np.arange(len(hashes))
    return first, inverse


def is_unit_unwrap(mesh: MeshArrays, uv: FloatArray, slot: int | None = None) -> bool:
    """True if the UVs (C, 2) are in [0, 1]^2, with few degenerate triangles and little overlap."""
    triangles = mesh.triangles if slot is None else mesh.triangles[mesh.triangle_slots == slot]
    corners = uv[triangles]
    if not np.isfinite(corners).all() or corners.min() < -1e-5 or corners.max() > 1 + 1e-5:
        return False
    edge_a, edge_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.abs(edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0])
    if (area < 1e-12).mean() > 0.01:
        return False
    return _overlapping_share(corners, area) < 0.005


def _overlapping_share(corners: FloatArray, area: FloatArray, size: int = 256) -> float:
    """Share of the covered cells of a grid (size, size) that are covered by several triangles (T, 3, 2)."""
    covered = np.zeros((size, size), np.int32)
    low = np.clip(np.ceil(corners.min(axis=1) * size - 0.5).astype(int), 0, size - 1)
    high = np.clip(np.floor(corners.max(axis=1) * size - 0.5).astype(int), -1, size - 1)
    for index in np.flatnonzero((high >= low).all(axis=1) & (area > 0)):
        (u0, v0), (u1, v1) = low[index], high[index]
        grid_u = (np.arange(u0, u1 + 1) + 0.5) / size
        grid_v = (np.arange(v0, v1 + 1) + 0.5) / size
        a, b, c = corners[index].astype(np.float64)
        inside = None
        for p, q in ((a, b), (b, c), (c, a)):
            side = (q[0] - p[0]) * (grid_v[:, None] - p[1]) - (q[1] - p[1]) * (grid_u[None, :] - p[0])
            sign = side > 1e-9
            other = side < -1e-9
            inside = (sign, other) if inside is None else (inside[0] & sign, inside[1] & other)
        assert inside is not None
        covered[v0 : v1 + 1, u0 : u1 + 1] += inside[0] | inside[1]
    total = int((covered > 0).sum())
    return float((covered > 1).sum()) / total if total else 0.0

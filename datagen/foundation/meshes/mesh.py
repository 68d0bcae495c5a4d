# SPDX-License-Identifier: MIT
"""Triangle meshes in memory, and their faults.

Shapes: N vertices, M triangles. Texture coordinate v points up (see ``datagen.formats.asset``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

SINGULAR = 1e-15  # transforms of smaller determinant count as singular: they flatten the mesh
LYING_COSINE = 0.01  # a normal within 0.6 degrees of its triangle's plane cannot be used for shading


def area_vectors(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normals (M, 3) of triangles with corners (M, 3, 3); their lengths are twice the areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def unit_vectors(vectors: NDArray[np.float64], otherwise: ArrayLike = 0.0) -> NDArray[np.float64]:
    """Return vectors (..., 3) divided by their lengths, and ``otherwise`` in place of zero vectors."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: NDArray[np.float64] = np.where(length > 0, vectors / np.maximum(length, 1e-300), otherwise)
    return unit


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    ``positions`` (N, 3) float32; ``normals`` (N, 3) and ``uv`` (N, 2) float32 or None; ``faces`` (M, 3) int32
    vertex indices, counter-clockwise seen from outside.
    """

    positions: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32] | None = None
    uv: NDArray[np.float32] | None = None

    @property
    def weight(self) -> int:
        """Number of triangles charged to a budget: the faces or, if more, a third of the vertices."""
        return max(len(self.faces), -(-len(self.positions) // 3))

    def transformed(self, target_from_source: NDArray[np.float64]) -> Mesh:
        """Return the mesh under an affine (4, 4) transform; normals use its inverse transpose."""
        linear = np.asarray(target_from_source, dtype=np.float64)[:3, :3]
        offset = np.asarray(target_from_source, dtype=np.float64)[:3, 3]
        positions = self.positions.astype(np.float64) @ linear.T + offset
        normals = self.normals
        if normals is not None:
            rotated = normals.astype(np.float64) @ np.linalg.inv(linear)
            length = np.linalg.norm(rotated, axis=1, keepdims=True)
            normals = (rotated / np.maximum(length, 1e-30)).astype(np.float32)  # a zero normal stays zero
        return Mesh(positions.astype(np.float32), self.faces, normals, self.uv)

    def placed(self, target_from_source: NDArray[np.float64]) -> Mesh:
        """Return the transformed mesh; mirroring also reverses the winding, so front faces stay front."""
        mesh = self.transformed(target_from_source)
        if np.linalg.det(target_from_source[:3, :3]) < 0:
            return replace(mesh, faces=np.ascontiguousarray(mesh.faces[:, [0, 2, 1]]))
        return mesh

    def picked(self, vertices: NDArray[np.integer[Any]], corners: NDArray[np.integer[Any]]) -> Mesh:
        """Return a mesh of the vertices ``vertices`` (K,); ``corners`` (3 M,) are indices into these."""
        normals, uv = (None if array is None else array[vertices] for array in (self.normals, self.uv))
        return Mesh(self.positions[vertices], corners.reshape(-1, 3).astype(np.int32), normals, uv)

    def submesh(self, chosen: NDArray[np.bool_]) -> Mesh:
        """Return the triangles in the mask ``chosen`` (M,) with their vertices."""
        return self.picked(*np.unique(self.faces[chosen], return_inverse=True))

    def triangles(self) -> NDArray[np.float64]:
        """Return the positions of the triangles' corners, (M, 3 corners, 3)."""
        return self.positions.astype(np.float64)[self.faces]

    def areas(self) -> NDArray[np.float64]:
        """Return the area of every triangle, (M,)."""
        areas: NDArray[np.float64] = 0.5 * np.linalg.norm(area_vectors(self.triangles()), axis=1)
        return areas

    def uv_per_m(self) -> float | None:
        """Return the area-weighted median of UV units per metre; None if no triangle has an area in UV."""
        if self.uv is None:
            return None
        corners = self.uv.astype(np.float64)[self.faces]
        e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        uv_area = 0.5 * np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])
        area = self.areas()
        usable = (area > 0) & (uv_area > 0)
        if not usable.any():
            return None
        density, weight = np.sqrt(uv_area[usable] / area[usable]), area[usable]
        order = np.argsort(density)
        cumulative = np.cumsum(weight[order])
        return float(density[order][np.searchsorted(cumulative, 0.5 * cumulative[-1])])


def bounds(meshes: Sequence[Mesh]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and highest coordinates (3,) of all vertices of ``meshes``."""
    low = np.min([m.positions.min(axis=0) for m in meshes], axis=0).astype(np.float64)
    return low, np.max([m.positions.max(axis=0) for m in meshes], axis=0).astype(np.float64)


@dataclass(frozen=True)
class MeshFaults:
    """Numbers of a mesh's faults, from :func:`inspect_mesh`, which defines the kinds of edges.

    ``total``, ``degenerate`` and ``bad_indices`` count triangles, ``non_finite`` rows of the vertex arrays.
    """

    is_empty: bool = False
    non_finite: int = 0
    bad_indices: int = 0
    degenerate: int = 0
    total: int = 0
    non_manifold_edges: int = 0
    inconsistent_edges: int = 0
    boundary_edges: int = 0
    zero_normals: int = 0

    @property
    def is_unusable(self) -> bool:
        """True if the mesh has no surface, or has values that would invalidate a rendering."""
        return self.is_empty or self.non_finite > 0 or self.bad_indices > 0 or self.degenerate == self.total


def inspect_mesh(mesh: Mesh) -> MeshFaults:
    """Count a mesh's faults. Vertices at equal positions count as one, since files split them at seams.

    Edges of more than two triangles are non-manifold; an edge with the same direction in two triangles is
    inconsistent; an edge of one triangle is a boundary (harmless: open surfaces are allowed).
    """
    num_faces = len(mesh.faces)
    if num_faces == 0 or len(mesh.positions) == 0:
        return MeshFaults(is_empty=True)
    arrays = [a for a in (mesh.positions, mesh.normals, mesh.uv) if a is not None]
    non_finite = sum(int((~np.isfinite(a)).any(axis=1).sum()) for a in arrays)
    bad = int(((mesh.faces < 0) | (mesh.faces >= len(mesh.positions))).any(axis=1).sum())
    if non_finite or bad:
        return MeshFaults(non_finite=non_finite, bad_indices=bad, total=num_faces)
    faces = welded(mesh)[1][mesh.faces]
    collapsed = (faces == np.roll(faces, 1, axis=1)).any(axis=1) | (mesh.areas() == 0)
    faces = faces[~collapsed]
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    base = int(faces.max()) + 1 if len(faces) else 1
    keys = directed.min(axis=1) * base + directed.max(axis=1)
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    forward = np.bincount(inverse, weights=directed[:, 0] < directed[:, 1], minlength=len(counts))
    zero_normals = 0
    if mesh.normals is not None:
        zero_normals = int((np.linalg.norm(mesh.normals, axis=1) < 1e-6).sum())
    return MeshFaults(
        degenerate=int(collapsed.sum()),
        total=num_faces,
        non_manifold_edges=int((counts > 2).sum()),
        inconsistent_edges=int(((counts == 2) & (forward != 1)).sum()),
        boundary_edges=int((counts == 1).sum()),
        zero_normals=zero_normals,
    )


def welded(mesh: Mesh) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the distinct positions (K, 3) of a mesh, and the index (N,) of each vertex's position."""
    positions = np.ascontiguousarray(mesh.positions, dtype=np.float32) + np.float32(0.0)  # -0.0 becomes 0.0
    keys = positions.view(np.dtype((np.void, 12))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return positions[first], inverse.astype(np.int64)


def edge_pairs(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the pairs (P, 2) of triangles that share an edge; n triangles at one edge form n - 1 pairs.

    ``corners`` (M, 3) are vertex indices; if they are welded (:func:`welded`), pairs across seams count too.
    """
    ends = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    keys = ends[:, 0] * (int(corners.max(initial=0)) + 1) + ends[:, 1]
    order = np.argsort(keys, kind="stable")
    face = np.tile(np.arange(len(corners)), 3)[order]
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    return np.stack([face[same], face[same + 1]], axis=1)


def vertex_normals(mesh: Mesh) -> NDArray[np.float32]:
    """Return unit normals (N, 3): means of the adjacent triangles' normals, weighted by angle at the vertex.

    If a mean vanishes (folded sheets, inconsistent winding), the largest triangle's normal replaces it.
    """
    corners = mesh.triangles()
    cross = area_vectors(corners)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    unit = np.where(length > 0, cross / np.maximum(length, 1e-300), 0.0)
    total = np.zeros((len(mesh.positions), 3))
    for k in range(3):
        a = corners[:, (k + 1) % 3] - corners[:, k]
        b = corners[:, (k + 2) % 3] - corners[:, k]
        angle = np.arctan2(length[:, 0], (a * b).sum(axis=1))[:, None]
        for axis in range(3):
            total[:, axis] += np.bincount(
                mesh.faces[:, k], weights=(unit * angle)[:, axis], minlength=len(total)
            )
    size = np.linalg.norm(total, axis=1)
    lost = size < 1e-6  # the normals cancel up to rounding
    normals = total / np.maximum(size, 1e-300)[:, None]
    if lost.any():
        touching = np.flatnonzero(lost[mesh.faces].any(axis=1) & (length[:, 0] > 0))
        touching = touching[np.argsort(length[touching, 0], kind="stable")]
        normals[lost] = [0.0, 0.0, 1.0]  # for vertices without any surface
        corner, owner = mesh.faces[touching].ravel(), np.repeat(touching, 3)
        chosen = lost[corner]
        normals[corner[chosen]] = unit[owner[chosen]]  # ascending area: the largest is written last
    single: NDArray[np.float32] = normals.astype(np.float32)
    return single


def with_sound_normals(mesh: Mesh) -> tuple[Mesh, int]:
    """Return the mesh with valid normals, and the number of normals that were replaced.

    Zero, NaN and missing normals are taken from :func:`vertex_normals`; missing ones are not counted. A
    normal in the plane of its triangle (within ``LYING_COSINE``) may be parallel to the tangent, so that no
    shading frame exists; at that corner, the triangle's normal replaces it.
    """
    if mesh.normals is None:
        mesh = replace(mesh, normals=vertex_normals(mesh))
    assert mesh.normals is not None
    sound = np.linalg.norm(mesh.normals, axis=1) > 1e-6  # NaN compares false
    changed = int((~sound).sum())
    if changed:
        normals = np.where(sound[:, None], mesh.normals, vertex_normals(mesh)).astype(np.float32)
        mesh = Mesh(mesh.positions, mesh.faces, normals, mesh.uv)
    lying = lying_normals(mesh)
    if not lying.any():
        return mesh, changed
    flat = flat_shaded(mesh)
    assert flat.normals is not None and mesh.normals is not None
    corners = np.where(lying.reshape(-1, 1), flat.normals, mesh.normals[mesh.faces.ravel()])
    split = Mesh(flat.positions, flat.faces, corners.astype(np.float32), flat.uv)
    return compacted(split), changed + int(lying.sum())


def lying_normals(mesh: Mesh) -> NDArray[np.bool_]:
    """Return the mask (M, 3) of corners with a normal within ``LYING_COSINE`` of their triangle's plane."""
    if mesh.normals is None:
        return np.zeros(mesh.faces.shape, dtype=bool)
    cross = area_vectors(mesh.triangles())
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    normals = mesh.normals.astype(np.float64)[mesh.faces]
    size = np.linalg.norm(normals, axis=2)
    along = np.abs((normals * cross[:, None]).sum(axis=2))
    in_plane: NDArray[np.bool_] = (along < LYING_COSINE * length * size) & (length > 0)
    return in_plane


def flat_shaded(mesh: Mesh) -> Mesh:
    """Return the mesh with three unshared vertices per triangle, whose normals are the triangle's."""
    normal = unit_vectors(area_vectors(mesh.triangles()), [0.0, 0.0, 1.0])
    split = mesh.picked(mesh.faces.ravel(), np.arange(mesh.faces.size))
    return replace(split, normals=np.repeat(normal, 3, axis=0).astype(np.float32))


def compacted(mesh: Mesh) -> Mesh:
    """Return the mesh without unused vertices; vertices of equal position, normal and UV are merged."""
    columns = [a for a in (mesh.positions, mesh.normals, mesh.uv) if a is not None]
    table = np.ascontiguousarray(np.concatenate(columns, axis=1)[mesh.faces.ravel()]) + np.float32(0.0)
    keys = table.view(np.dtype((np.void, table.dtype.itemsize * table.shape[1]))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return mesh.picked(mesh.faces.ravel()[first], inverse)


def without_degenerate(mesh: Mesh) -> Mesh:
    """Return the mesh without triangles of zero area and without vertices that only such triangles use."""
    keep = mesh.areas() > 0
    return mesh if keep.all() else mesh.submesh(keep)


def joined(meshes: list[Mesh]) -> Mesh:
    """Concatenate meshes into one, with normals and UVs only if every mesh has them."""
    starts = np.cumsum([0] + [len(m.positions) for m in meshes[:-1]])
    faces = np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]).astype(np.int32)
    normals = [m.normals for m in meshes if m.normals is not None]
    uvs = [m.uv for m in meshes if m.uv is not None]
    return Mesh(
        np.concatenate([m.positions for m in meshes]),
        faces,
        np.concatenate(normals) if len(normals) == len(meshes) else None,
        np.concatenate(uvs) if len(uvs) == len(meshes) else None,
    )

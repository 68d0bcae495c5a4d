# SPDX-License-Identifier: MIT
"""Depth, normals and triangles of a capture's mesh at the pixel centres of its views, by ray tracing.

Buffers of rendered captures are not used, since the mesh may be coarser than the rendered room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import CaptureGeometry
from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.mesh import Mesh, area_vectors, edge_pairs, unit_vectors, welded
from datagen.geometry.crease_normals import with_normals
from mitsuba_plugins.arrays import point_argument, rows_from_vectors, vectors_from_rows
from mitsuba_plugins.variant import select_variant

if TYPE_CHECKING:
    import mitsuba as mi

PIXEL_RAYS = 16
"""Number of rays per pixel, at the points of a Hammersley set: 16 distinct positions along each axis."""


@dataclass(frozen=True)
class ViewGeometry:
    """First hits of rays through the pixel centres of a view.

    ``depth_z_m`` (H, W, 1), 0 where nothing is hit; ``normal_world`` (H, W, 3), unit, facing the camera, 0
    where nothing is hit; ``surface_mask`` (H, W, 1), 1 on surfaces that do not emit, else 0; ``face`` (H, W),
    index of the triangle, -1 where nothing is hit; ``is_front`` (H, W), True where the triangle appears
    counter-clockwise.
    """

    depth_z_m: NDArray[np.float32]
    normal_world: NDArray[np.float32]
    surface_mask: NDArray[np.float32]
    face: NDArray[np.int32]
    is_front: NDArray[np.bool_]

    def cosine(self, camera: Camera) -> NDArray[np.float64]:
        """Compute the cosine (H, W) of the rays' angle of incidence, 0 where nothing is hit."""
        return -(self.normal_world * camera.ray_directions()).sum(axis=-1)


def mesh_scene(mesh: Mesh) -> mi.Scene:
    """Return a Mitsuba scene for ray tracing that contains only ``mesh``."""
    select_variant()
    import mitsuba as mi

    has_normals = mesh.normals is not None
    props = mi.Properties()
    if not has_normals:
        props["face_normals"] = True
    shape = mi.Mesh("geometry", len(mesh.positions), len(mesh.faces), props, has_normals, False)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(mesh.positions, np.float32).ravel())
    if mesh.normals is not None:
        parameters["vertex_normals"] = mi.Float(np.ascontiguousarray(mesh.normals, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(mesh.faces, np.uint32).ravel())
    parameters.update()
    return mi.load_dict({"type": "scene", "geometry": shape}, optimize=False)


class TracedGeometry:
    """A capture's ``mesh``, with normals added if it has none, and the Mitsuba ``scene`` that contains it."""

    def __init__(self, geometry: CaptureGeometry):
        mesh = with_normals(geometry.mesh)
        self.mesh = mesh
        self.scene = mesh_scene(mesh)
        self._emits = geometry.emitter_mask()

    def trace_view(self, camera: Camera, valid_mask: NDArray[np.bool_] | None = None) -> ViewGeometry:
        """Trace the pixel centres of ``camera``; pixels outside ``valid_mask`` (H, W) count as misses."""
        import drjit as dr
        import mitsuba as mi

        directions = camera.ray_directions().reshape(-1, 3)
        origin = point_argument(camera.position_m)
        direction: Any = vectors_from_rows(directions)
        ray = mi.Ray3f(origin, direction)
        si = self.scene.ray_intersect(ray)
        valid = si.is_valid()
        outside = dr.dot(si.n, direction) < 0
        shading = dr.select(dr.dot(si.sh_frame.n, direction) < 0, si.sh_frame.n, -si.sh_frame.n)
        dr.eval(si.t, valid, outside, shading, si.prim_index)
        hit = np.asarray(valid.numpy(), dtype=bool)
        t = np.where(hit, np.asarray(si.t.numpy(), dtype=np.float64), 0.0)
        face = np.where(hit, np.asarray(si.prim_index.numpy()).astype(np.int64), -1)
        normal = np.where(hit[:, None], rows_from_vectors(shading), 0.0)
        if valid_mask is not None:
            hit &= valid_mask.ravel()
        shape = (camera.height_px, camera.width_px)
        surface = hit & ~self._emits[np.maximum(face, 0)]
        return ViewGeometry(
            np.where(hit, t * (directions @ camera.forward), 0.0).astype(np.float32).reshape(*shape, 1),
            np.where(hit[:, None], normal, 0.0).astype(np.float32).reshape(*shape, 3),
            surface.astype(np.float32).reshape(*shape, 1),
            np.where(hit, face, -1).astype(np.int32).reshape(shape),
            (hit & np.asarray(outside.numpy(), dtype=bool)).reshape(shape),
        )

    def faces_at(self, origin_m: NDArray, direction: NDArray) -> NDArray[np.int32]:
        """Return the index (K,) of the triangle that each ray hits first, -1 for none.

        Rays start at ``origin_m`` (K, 3) in unit directions ``direction`` (K, 3).
        """
        import mitsuba as mi

        ray = mi.Ray3f(mi.Point3f(vectors_from_rows(origin_m)), vectors_from_rows(direction))
        pi = self.scene.ray_intersect_preliminary(ray)
        hit = np.asarray(pi.is_valid().numpy(), dtype=bool)
        return np.where(hit, np.asarray(pi.prim_index.numpy()).astype(np.int64), -1).astype(np.int32)


def rays_within_pixels(camera: Camera, pixel: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return unit directions (K, :data:`PIXEL_RAYS`, 3) of rays through pixels with flat indices (K,)."""
    step = np.arange(PIXEL_RAYS)
    inverse = sum((step >> bit & 1) / 2 ** (bit + 1) for bit in range(PIXEL_RAYS.bit_length() - 1))
    x = (pixel % camera.width_px)[:, None] + (step + 0.5) / PIXEL_RAYS
    y = (pixel // camera.width_px)[:, None] + inverse + 0.5 / PIXEL_RAYS
    toward = camera.unproject(np.stack([x, y], axis=-1), np.ones(x.shape)) - camera.position_m
    unit: NDArray[np.float64] = toward / np.linalg.norm(toward, axis=-1, keepdims=True)
    return unit


def reachable_faces(
    geometry: TracedGeometry, position_m: NDArray, normal: NDArray, num_rays: int = 400_000
) -> NDArray[np.bool_]:
    """Return the mask (M,) of triangles hit by random rays from the points ``position_m`` (N, 3).

    Directions are cosine-distributed about the points' unit normals, ``normal`` (N, 3).
    """
    found = np.zeros(len(geometry.mesh.faces), dtype=bool)
    if not len(position_m):
        return found
    random = np.random.default_rng(0)
    point = random.integers(0, len(position_m), num_rays)
    sphere = random.normal(size=(num_rays, 3))
    direction = normal[point] + sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    size_m = float(np.linalg.norm(np.ptp(geometry.mesh.positions, axis=0)))
    start = position_m[point] + normal[point] * (1e-4 * size_m)
    face = geometry.faces_at(start, direction)
    found[face[face >= 0]] = True
    return found


def seen_sides(views: Sequence[ViewGeometry], num_faces: int) -> NDArray[np.float32]:
    """Return a sign (M,) per triangle: 1 if more pixels show its front than its back, -1 if fewer.

    The sign times the normal points to the visible side. Undecided triangles get the most frequent sign.
    """
    balance = np.zeros(num_faces, dtype=np.int64)
    for view in views:
        hit = view.face >= 0
        balance += np.bincount(view.face[hit & view.is_front], minlength=num_faces)
        balance -= np.bincount(view.face[hit & ~view.is_front], minlength=num_faces)
    usual = -1.0 if int(np.sign(balance).sum()) < 0 else 1.0
    return np.where(balance == 0, usual, np.sign(balance)).astype(np.float32)


def face_normals(mesh: Mesh, sides: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """Return the unit normals (M, 3) of the triangles, multiplied by the signs ``sides`` (M,) if given."""
    normal = unit_vectors(area_vectors(mesh.triangles()))
    if sides is not None:
        normal *= sides[:, None]
    return normal.astype(np.float32)


def smooth_regions(mesh: Mesh, max_angle_rad: float = np.pi / 4) -> NDArray[np.int32]:
    """Return the index (M,) of each triangle's smooth region.

    Triangles that share an edge belong to one region if their normals differ by less than ``max_angle_rad``,
    regardless of winding. Vertices at equal positions count as one.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    num = len(mesh.faces)
    a, b = edge_pairs(welded(mesh)[1][mesh.faces]).T
    normals = face_normals(mesh).astype(np.float64)
    smooth = np.abs((normals[a] * normals[b]).sum(axis=1)) > np.cos(max_angle_rad)
    graph = coo_array((np.ones(int(smooth.sum())), (a[smooth], b[smooth])), shape=(num, num))
    return connected_components(graph, directed=False)[1].astype(np.int32)

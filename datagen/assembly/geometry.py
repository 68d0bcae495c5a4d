# SPDX-License-Identifier: MIT
"""Meshes of assets for assembly: triangles in float64, ray casting with Embree, exact collision with FCL.

Shapes: N vertices, M triangles, R rays. Positions are in metres. Embree traces in float32; distances are then
computed from the triangle's plane in float64, which keeps rounding from affecting decisions. Neither library
depends on a Mitsuba variant, so plans are equal on machines with and without a GPU.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.formats.asset import GeometryAsset, Texture
from datagen.formats.package import Package
from datagen.foundation.errors import input_error
from datagen.foundation.meshes.mesh import Mesh, area_vectors, inspect_mesh
from datagen.foundation.meshes.ply import decode_ply

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_MIN_COSINE = 1e-3  # below this, Embree's distance is kept: the plane equation would divide by almost 0
T = TypeVar("T")


@dataclass(frozen=True)
class Hits:
    """First hits of R rays: distance (R,) and triangle index ``face`` (R,); inf and -1 for misses."""

    distance_m: Floats
    face: Ints

    @property
    def hit_mask(self) -> NDArray[np.bool_]:
        """Mask (R,) of the rays that hit a triangle."""
        return self.face >= 0


class RayScene:
    """Triangles for ray queries, with unit ``normals`` (M, 3) on the front side and ``areas`` (M,) in m²."""

    def __init__(self, vertices: Floats, faces: NDArray):
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        self.corners = np.asarray(vertices, dtype=np.float64)[self.faces]
        cross = area_vectors(self.corners)
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        self.areas = 0.5 * length[:, 0]
        self.normals = cross / np.maximum(length, 1e-300)  # degenerate triangles get a zero normal
        self._vertices = np.ascontiguousarray(vertices, dtype=np.float32)

    @cached_property
    def _embree(self) -> Any:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        scene = rtcore_scene.EmbreeScene()
        TriangleMesh(scene, self._vertices, self.faces)
        return scene

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_distance_m: ArrayLike = np.inf) -> Hits:
        """Cast rays of length ``max_distance_m`` from ``origins`` (R, 3) along unit ``directions`` (R, 3)."""
        directions = np.ascontiguousarray(directions, dtype=np.float64).reshape(-1, 3)
        origins = np.broadcast_to(np.asarray(origins, dtype=np.float64), directions.shape)
        count = len(directions)
        if count == 0 or len(self.faces) == 0:
            return Hits(np.full(count, np.inf), np.full(count, -1, dtype=np.int64))
        limits = np.broadcast_to(np.asarray(max_distance_m, dtype=np.float32), (count,))
        found = self._embree.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            directions.astype(np.float32),
            dists=np.ascontiguousarray(np.minimum(limits, np.float32(1e30))),
            output=1,
        )
        face = found["primID"].astype(np.int64)
        distance = np.full(count, np.inf)
        hit = face >= 0
        index = face[hit]
        normal = self.normals[index]
        cosine = np.einsum("ij,ij->i", normal, directions[hit])
        height = np.einsum("ij,ij->i", normal, self.corners[index, 0] - origins[hit])
        flat = np.abs(cosine) < _MIN_COSINE
        plane = height / np.where(flat, 1.0, cosine)
        distance[hit] = np.where(flat, found["tfar"][hit].astype(np.float64), np.maximum(plane, 0.0))
        return Hits(distance, face)

    def occluded(self, origins: ArrayLike, directions: ArrayLike, max_distance_m: ArrayLike) -> NDArray:
        """Mask (R,) of rays along unit ``directions`` (R, 3) that hit anything within ``max_distance_m``."""
        directions = np.ascontiguousarray(directions, dtype=np.float32).reshape(-1, 3)
        count = len(directions)
        if count == 0 or len(self.faces) == 0:
            return np.zeros(count, dtype=bool)
        origins = np.ascontiguousarray(np.broadcast_to(np.asarray(origins), directions.shape), np.float32)
        limits = np.broadcast_to(np.asarray(max_distance_m, dtype=np.float64), (count,))
        limits = np.ascontiguousarray(np.minimum(limits, 1e30), dtype=np.float32)
        return self._embree.run(origins, directions, dists=limits, query="OCCLUDED") != -1

    def is_back_hit(self, hits: Hits, directions: Floats) -> NDArray:
        """Mask (R,) of rays along ``directions`` (R, 3) whose first hit is on the back of a triangle."""
        cosine = np.einsum("ij,ij->i", self.normals[np.maximum(hits.face, 0)], directions)
        return hits.hit_mask & (cosine > 0)


@dataclass(frozen=True)
class AssetGeometry:
    """All parts of an asset as one triangle soup in the asset's frame.

    ``part_of_face`` (M,) is the index of each triangle's part in ``asset.parts``. ``opaque_part`` is the mask
    of parts that block light because their opacity is absent, textured or at least 0.5.
    """

    asset: GeometryAsset
    vertices: Floats
    faces: NDArray[np.int32]
    part_of_face: NDArray[np.int32]
    opaque_part: NDArray[np.bool_]

    @cached_property
    def minimum_m(self) -> Floats:
        """Lower corner (3,) of the bounding box of all vertices that a triangle uses."""
        return self.vertices[self.faces.ravel()].min(axis=0)

    @cached_property
    def maximum_m(self) -> Floats:
        """Upper corner (3,) of the bounding box of all vertices that a triangle uses."""
        return self.vertices[self.faces.ravel()].max(axis=0)

    @cached_property
    def center_of_mass_m(self) -> Floats:
        """Area-weighted centroid (3,) of the surface, since open meshes have no volume."""
        corners = self.vertices[self.faces]
        area = np.linalg.norm(area_vectors(corners), axis=1)
        return (corners.mean(axis=1) * area[:, None]).sum(axis=0) / area.sum()

    @cached_property
    def opaque_faces(self) -> Ints:
        """Indices (K,) of the triangles that block light."""
        return np.flatnonzero(self.opaque_part[self.part_of_face])

    @cached_property
    def rays(self) -> RayScene:
        """All triangles for ray queries, opaque or not, in the asset's frame."""
        return RayScene(self.vertices, self.faces)


def load_geometry(package: Package) -> AssetGeometry:
    """Read all meshes of an object or environment. Raises :class:`InputError` for invalid meshes."""
    asset = package.asset
    if not isinstance(asset, GeometryAsset):
        raise TypeError(f"{asset.id} is a {asset.kind}; expected an object or environment")
    meshes: dict[str, Mesh] = {}
    vertices, faces, parts, start = [], [], [], 0
    for index, part in enumerate(asset.parts):
        if part.mesh not in meshes:
            meshes[part.mesh] = _sound_mesh(package, part.mesh)
        mesh = meshes[part.mesh]
        matrix = np.asarray(part.asset_from_part, dtype=np.float64)
        moved = world_points(matrix, mesh.positions.astype(np.float64))
        turned = mesh.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else mesh.faces
        vertices.append(moved)
        faces.append(turned + start)
        parts.append(np.full(len(turned), index, dtype=np.int32))
        start += len(moved)
    opaque = np.array([_is_opaque(asset, part.material) for part in asset.parts])
    return AssetGeometry(
        asset, np.concatenate(vertices), np.concatenate(faces).astype(np.int32), np.concatenate(parts), opaque
    )


def _sound_mesh(package: Package, name: str) -> Mesh:
    where = f"{package.path}/{name}"
    mesh = decode_ply(package.read_bytes(name), where)
    is_finite = bool(np.isfinite(mesh.positions).all())
    bounded = bool((mesh.faces >= 0).all() and (mesh.faces < len(mesh.positions)).all())
    if len(mesh.faces) == 0 or not is_finite or not bounded or not (mesh.areas() > 0).any():
        got, expected = str(inspect_mesh(mesh)), "a mesh with finite triangles"
        raise input_error(where, got=got, expected=expected, remedy="re-export the asset")
    return mesh


def _is_opaque(asset: GeometryAsset, material: str) -> bool:
    opacity = asset.materials[material].opacity
    return opacity is None or isinstance(opacity, Texture) or opacity >= 0.5


class PackageCache(Generic[T]):
    """Least-recently-used cache of the results of ``make``, keyed by the package's hash.

    The sum of the results' ``weight`` is at most ``limit``, unless a single result exceeds it.
    """

    def __init__(
        self,
        make: Callable[[Package], T],
        limit: float = math.inf,
        weight: Callable[[T], int] = lambda _: 1,
    ):
        self._make, self._limit, self._weight = make, limit, weight
        self._entries: OrderedDict[str, T] = OrderedDict()

    def __call__(self, package: Package) -> T:
        key = package.sha256
        if key not in self._entries:
            self._entries[key] = self._make(package)
            while len(self._entries) > 1 and sum(map(self._weight, self._entries.values())) > self._limit:
                self._entries.popitem(last=False)
        self._entries.move_to_end(key)
        return self._entries[key]


class CollisionModel:
    """A triangle soup that FCL tests exactly for intersections at any rigid pose."""

    def __init__(self, vertices: Floats, faces: NDArray):
        import fcl

        used, compact = np.unique(np.asarray(faces).ravel(), return_inverse=True)
        points = np.asarray(vertices, dtype=np.float64)[used]
        triangles = compact.reshape(-1, 3).astype(np.int64)
        self._model = fcl.BVHModel()
        self._model.beginModel(len(points), len(triangles))
        self._model.addSubModel(points, triangles)
        self._model.endModel()
        self._fcl = fcl

    def at(self, rotation: Floats | None = None, translation: Floats | None = None) -> Any:
        """Return an FCL collision object of this model at a rotation (3, 3) and translation (3,)."""
        rotation = np.eye(3) if rotation is None else rotation
        translation = np.zeros(3) if translation is None else translation
        return self._fcl.CollisionObject(self._model, self._fcl.Transform(rotation, translation))


def intersects(one: Any, other: Any) -> bool:
    """Return whether the surfaces of two FCL collision objects intersect."""
    import fcl

    return fcl.collide(one, other, fcl.CollisionRequest(), fcl.CollisionResult()) > 0


def distance_m(one: Any, other: Any) -> float:
    """Return the minimum distance between the surfaces of two FCL collision objects; 0 if they intersect."""
    import fcl

    if intersects(one, other):
        return 0.0
    return float(fcl.distance(one, other, fcl.DistanceRequest(), fcl.DistanceResult()))


def direction_of(azimuth_rad: float, elevation_rad: float) -> Floats:
    """Return the unit vector (3,) with an azimuth from +X towards +Y and an elevation above the horizon."""
    flat = math.cos(elevation_rad)
    return np.array([flat * math.cos(azimuth_rad), flat * math.sin(azimuth_rad), math.sin(elevation_rad)])


def world_points(world_from_asset: ArrayLike, points: Floats) -> Floats:
    """Transform points (N, 3) by an affine matrix (4, 4)."""
    matrix = np.asarray(world_from_asset, dtype=np.float64)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


class WorldScene:
    """All opaque triangles of an environment and of placed objects, in world coordinates.

    ``item_of_face`` (M,) is 0 for the environment and k ≥ 1 for the k-th object. ``instance_of_face`` (M,) is
    the index of a part of the environment, or ``num_environment_parts`` plus the index of an object.
    """

    def __init__(self, environment: AssetGeometry, objects: list[tuple[AssetGeometry, NDArray]]):
        placed: list[tuple[AssetGeometry, NDArray]] = [(environment, np.eye(4)), *objects]
        vertices, faces, items, parts, start = [], [], [], [], 0
        for item, (geometry, matrix) in enumerate(placed):
            opaque = geometry.opaque_faces
            vertices.append(world_points(matrix, geometry.vertices))
            faces.append(geometry.faces[opaque] + start)
            items.append(np.full(len(opaque), item, dtype=np.int32))
            parts.append(geometry.part_of_face[opaque])
            start += len(geometry.vertices)
        self.geometries = [geometry for geometry, _ in placed]
        self.rays = RayScene(np.concatenate(vertices), np.concatenate(faces))
        self.item_of_face = np.concatenate(items)
        self.part_of_face = np.concatenate(parts)
        self.num_environment_parts = len(environment.asset.parts)
        self.num_instances = self.num_environment_parts + len(objects)
        self.instance_of_face = np.where(
            self.item_of_face == 0, self.part_of_face, self.num_environment_parts + self.item_of_face - 1
        )

    def rows_of_faces(self, tables: list[Floats]) -> Floats:
        """Return each triangle's row, (M, ...), of ``tables``: one table per item with one row per part."""
        starts = np.cumsum([0] + [len(table) for table in tables[:-1]])
        return np.concatenate(tables)[starts[self.item_of_face] + self.part_of_face]

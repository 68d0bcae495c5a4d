# SPDX-License-Identifier: MIT
"""Objects and rooms prepared for placement: footprints, undersides, poses and collisions."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.assembly.geometry import (
    AssetGeometry,
    CollisionModel,
    Floats,
    Ints,
    RayScene,
    intersects,
    world_points,
)
from datagen.formats.asset import EnvironmentAsset, ObjectAsset, SupportSurface
from datagen.foundation.axes import affine, rotation

_MAX_UNDERSIDE_POINTS = 600
_MANY_POINTS = 2000


def convex_hull_2d(points: Floats) -> Floats:
    """Corners (K, 2) of the convex hull of points (N, 2), counter-clockwise; K < 3 if it is degenerate."""
    unique = np.unique(np.round(points, 9), axis=0)
    if len(unique) < 3:
        return unique
    if len(unique) > _MANY_POINTS:  # above this number the loop below would take seconds
        from scipy.spatial import ConvexHull, QhullError

        with contextlib.suppress(QhullError):  # for points on a line
            unique = np.unique(unique[ConvexHull(unique).vertices], axis=0)
    chains = []
    # plain Python numbers are faster here, in one of the hottest loops of planning
    for run in (unique.tolist(), unique[::-1].tolist()):
        chain: list[list[float]] = []
        for x, y in run:
            while len(chain) > 1:
                (x0, y0), (x1, y1) = chain[-2:]
                if (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) > 0:
                    break
                chain.pop()
            chain.append([x, y])
        chains += chain[:-1]
    return np.array(chains)


def margin_inside(hull: Floats, point: Floats) -> float:
    """Signed distance of a point (2,) to the nearest edge of a hull (K, 2), < 0 outside; -inf if K < 3."""
    if len(hull) < 3:
        return -math.inf
    edges = np.roll(hull, -1, axis=0) - hull
    lengths = np.maximum(np.linalg.norm(edges, axis=1), 1e-300)
    to_point = point - hull
    return float(((edges[:, 0] * to_point[:, 1] - edges[:, 1] * to_point[:, 0]) / lengths).min())


@dataclass(frozen=True)
class Thing:
    """An object asset prepared for placement, with geometry at scale 1 in the asset's frame."""

    asset: ObjectAsset
    geometry: AssetGeometry

    @cached_property
    def footprint(self) -> Floats:
        """Corners (K, 2) of the convex hull of the mesh projected onto the ground."""
        used = self.geometry.vertices[np.unique(self.geometry.faces)]
        return convex_hull_2d(used[:, :2])

    @cached_property
    def underside(self) -> Floats:
        """Points (P, 3) that may touch the ground: low vertices and points on low, down-facing triangles."""
        geometry = self.geometry
        low = geometry.minimum_m[2]
        band = low + max(0.003, 0.03 * float(geometry.maximum_m[2] - low))
        used = geometry.vertices[np.unique(geometry.faces)]
        rays = geometry.rays
        flat = (rays.corners[:, :, 2] <= band).all(axis=1) & (rays.normals[:, 2] < -0.3)
        points = np.concatenate([used[used[:, 2] <= band], _lattice(rays.corners[flat])])
        points = np.unique(np.round(points, 7), axis=0)
        if len(points) <= _MAX_UNDERSIDE_POINTS:
            return points
        lowest = points[points[:, 2] <= low + 5e-4]
        rim = convex_hull_2d(lowest[:, :2] if len(lowest) >= 3 else points[:, :2])
        on_rim = (np.abs(points[:, None, :2] - rim[None]) < 1e-6).all(axis=2).any(axis=1)
        stride = np.zeros(len(points), dtype=bool)
        stride[:: -(-len(points) // _MAX_UNDERSIDE_POINTS)] = True
        return points[on_rim | stride]

    def can_stand(self, contact_tolerance_m: float) -> bool:
        """Return whether the object is stable on level ground: its centre of mass is above its contact hull.

        Contacts are points up to ``contact_tolerance_m`` above the lowest point, at the smallest scale.
        """
        points = self.underside
        low = float(self.geometry.minimum_m[2])
        contact = points[points[:, 2] <= low + contact_tolerance_m / self.asset.scale_range[0]]
        return margin_inside(convex_hull_2d(contact[:, :2]), self.geometry.center_of_mass_m[:2]) > 0

    @cached_property
    def _models(self) -> dict[float, CollisionModel]:
        return {}

    def collision_at(self, scale: float) -> CollisionModel:
        """Return the collision model of the scaled mesh; FCL's poses are rigid, without scale."""
        if scale not in self._models:
            self._models.clear()  # earlier scales seldom recur
            self._models[scale] = CollisionModel(self.geometry.vertices * scale, self.geometry.faces)
        return self._models[scale]


def _lattice(corners: Floats) -> Floats:
    """Return points (7 M, 3) on triangles (M, 3, 3): centroids, edge midpoints, a point near each corner."""
    if len(corners) == 0:
        return np.zeros((0, 3))
    weights = np.array(
        [[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4], [0, 1, 1], [1, 0, 1], [1, 1, 0]], np.float64
    )
    weights /= weights.sum(axis=1, keepdims=True)
    return np.einsum("kc,mcx->mkx", weights, corners).reshape(-1, 3)


def pose(scale: float, yaw_rad: float, position_m: Floats) -> NDArray[np.float64]:
    """Return ``world_from_asset`` (4, 4) of a uniformly scaled, upright object."""
    return affine(scale * rotation("z", yaw_rad), position_m)


@dataclass(frozen=True)
class PlacedThing:
    """A placed object; ``bounds_m`` (2, 3) are the corners of its bounding box in world space."""

    thing: Thing
    support: SupportSurface
    scale: float
    yaw_rad: float
    position_m: Floats
    bounds_m: Floats

    @property
    def world_from_asset(self) -> NDArray[np.float64]:
        """Transform (4, 4) composed of scale, yaw and position."""
        return pose(self.scale, self.yaw_rad, self.position_m)

    @cached_property
    def body(self) -> Any:
        """The FCL collision object at the object's pose."""
        return self.thing.collision_at(self.scale).at(rotation("z", self.yaw_rad), self.position_m)

    @cached_property
    def rays(self) -> RayScene:
        """The object's triangles in world space, for ray queries."""
        geometry = self.thing.geometry
        return RayScene(world_points(self.world_from_asset, geometry.vertices), geometry.faces)


class Room:
    """An environment prepared for the placement of objects."""

    def __init__(self, geometry: AssetGeometry):
        assert isinstance(geometry.asset, EnvironmentAsset)
        self.asset: EnvironmentAsset = geometry.asset
        self.geometry = geometry
        self.rays = geometry.rays
        corners = self.rays.corners
        self._face_bounds = corners.min(axis=1), corners.max(axis=1)
        self._near_surface: dict[SupportSurface, Ints] = {}

    @cached_property
    def has_consistent_winding(self) -> bool:
        """Result of :func:`has_consistent_winding` for points above the support surfaces."""
        return has_consistent_winding(self.rays, above_supports(self.asset))

    def triangles_in(self, bounds_m: Floats, surface: SupportSurface) -> Ints:
        """Return indices of triangles near or above ``surface`` whose boxes intersect ``bounds_m`` (2, 3)."""
        low, high = self._face_bounds
        if surface not in self._near_surface:  # not keyed by name: names may recur
            u, v, o = (np.array(x) for x in (surface.edge_u_m, surface.edge_v_m, surface.origin_m))
            rim = np.array([o, o + u, o + v, o + u + v])
            bottom, top = rim.min(axis=0) - 0.1, rim.max(axis=0) + 0.1
            top[2] += surface.clearance_m
            self._near_surface[surface] = np.flatnonzero(((low <= top) & (high >= bottom)).all(axis=1))
        near = self._near_surface[surface]
        return near[((low[near] <= bounds_m[1]) & (high[near] >= bounds_m[0])).all(axis=1)]

    def cuts(self, body: Any, bounds_m: Floats, surface: SupportSurface) -> bool:
        """Return whether an FCL collision object with bounds (2, 3) intersects the room above a surface."""
        near = self.triangles_in(bounds_m, surface)
        if len(near) == 0:
            return False
        return intersects(CollisionModel(self.geometry.vertices, self.geometry.faces[near]).at(), body)


def above_supports(asset: EnvironmentAsset) -> list[Floats]:
    """Return a point (3,) up to 0.3 m above the middle of each of an environment's support surfaces."""
    points = []
    for surface in asset.support_surfaces:
        middle = np.array(surface.origin_m) + 0.5 * (np.array(surface.edge_u_m) + np.array(surface.edge_v_m))
        points.append(middle + np.array([0.0, 0.0, min(0.5 * surface.clearance_m, 0.3)]))
    return points


def has_consistent_winding(rays: RayScene, starts: Sequence[Floats]) -> bool:
    """Return whether over 90 % of the hits of rays in all directions from ``starts`` are on front faces.

    Without consistent winding, as in many downloaded scenes, hits on back faces do not indicate solids.
    """
    if not starts:
        return False
    directions = np.tile(fibonacci_sphere(64), (len(starts), 1))
    hits = rays.cast(np.repeat(starts, 64, axis=0), directions)
    return bool(rays.is_back_hit(hits, directions).sum() < 0.1 * hits.hit_mask.sum())


@cache
def fibonacci_sphere(count: int) -> Floats:
    """Return unit directions (count, 3) evenly distributed over the sphere; memoised, hence read-only."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = math.pi * (1 + math.sqrt(5)) * k
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    directions.flags.writeable = False
    return directions

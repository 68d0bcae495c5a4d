# SPDX-License-Identifier: MIT
"""Places objects at rest on surfaces of a room, without collisions between the meshes.

A candidate is an object, a surface, a scale, a yaw and a position. Rays are cast down from the object's
underside; the object is placed on the highest hit, even if the declared rectangle is slightly inaccurate. It
must be stable (centre of mass above the hull of its contacts), must not intersect the room or another object
(triangle against triangle, FCL) and must not be inside a solid part of either.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from datagen.assembly.geometry import Floats, RayScene, distance_m, world_points
from datagen.assembly.things import PlacedThing, Room, Thing, convex_hull_2d, margin_inside, pose
from datagen.formats.asset import EnvironmentAsset, ObjectAsset, SupportSurface
from datagen.formats.recipe import ObjectRecipe
from datagen.foundation.axes import rotation
from datagen.foundation.errors import InputError, Problem, input_error
from datagen.foundation.random import Draws

CONTACT_TOLERANCE_M = 2e-3  # points this close to the ground count as contacts
# objects are raised by this for collision tests, which report coplanar contact as a collision
MAX_PENETRATION_M = 5e-4
SURFACE_TOLERANCE_M = 0.02  # largest distance between a declared support and the mesh (a rug, for instance)
# an object whose centre of mass is nearer to the rim of the contact hull could topple
MIN_CONTACT_MARGIN_M = 2e-3
_MIN_UP = 0.98  # poses with a contact on ground tilted by more than 11 degrees are rejected
_WALL_HEIGHT_M = 0.9  # floor-standing objects above this height are often placed with their back to a wall
_WALL_PROBABILITY = 0.65
_ATTEMPTS_PER_SCALE = 12  # attempts share a scale, since a new one needs a collision tree (up to 0.5 s)
_AXES = np.concatenate([np.eye(3), -np.eye(3)])


class Shortfall(InputError):
    """Raised for too few objects or views; :func:`datagen.assembly.plan.assemble` then tries again."""


def surfaces_for(asset: ObjectAsset, room: EnvironmentAsset) -> list[SupportSurface]:
    """Return the room's support surfaces that suit the object and are large enough at its smallest scale."""
    low = np.array(asset.minimum_m) * asset.scale_range[0]
    high = np.array(asset.maximum_m) * asset.scale_range[0]
    size = np.sort((high - low)[:2])
    fitting = []
    for surface in room.support_surfaces:
        edges = sorted(float(np.linalg.norm(e)) for e in (surface.edge_u_m, surface.edge_v_m))
        # an object that fits diagonally must not be rejected
        fits = size[0] <= edges[0] + 1e-9 and size[1] <= math.hypot(*edges)
        if surface.kind in asset.supports and high[2] - low[2] <= surface.clearance_m and fits:
            fitting.append(surface)
    return fitting


class Placer:
    """Places objects in a room one after the other, and counts rejections."""

    def __init__(self, room: Room, recipe: ObjectRecipe, rejections: Counter[str]):
        self.room = room
        self.recipe = recipe
        self.rejections = rejections
        self.placed: list[PlacedThing] = []

    def place(self, thing: Thing, draws: Draws) -> PlacedThing | None:
        """Place an object at the first valid candidate of ``max_attempts``; return None if there is none."""
        surfaces = surfaces_for(thing.asset, self.room.asset)
        if not surfaces:
            self.rejections["placement.no_surface"] += 1
            return None
        weights = [math.sqrt(np.linalg.norm(np.cross(s.edge_u_m, s.edge_v_m))) for s in surfaces]
        scale = 1.0
        for attempt in range(self.recipe.max_attempts):
            if attempt % _ATTEMPTS_PER_SCALE == 0:
                low, high = thing.asset.scale_range
                scale = min(max(round(draws.uniform(low, high), 6), low), high)
            surface = draws.weighted(surfaces, weights)
            outcome = self._try(thing, surface, scale, draws)
            if isinstance(outcome, PlacedThing):
                self.placed.append(outcome)
                return outcome
            self.rejections[f"placement.{outcome}"] += 1
        self.rejections["placement.gave_up"] += 1
        return None

    def _try(self, thing: Thing, surface: SupportSurface, scale: float, draws: Draws) -> PlacedThing | str:
        height = float(thing.geometry.maximum_m[2] - thing.geometry.minimum_m[2]) * scale
        if height > surface.clearance_m:
            return "too_tall"
        drawn = self._draw_pose(thing, surface, scale, draws)
        if drawn is None:
            return "too_large"
        yaw, xy = drawn
        position = np.array([xy[0], xy[1], surface.origin_m[2] - scale * float(thing.geometry.minimum_m[2])])
        rest = self._drop(thing, scale, yaw, position)
        if isinstance(rest, str):
            return rest
        position[2] += rest
        position = np.round(position, 7)
        return self._checked(thing, surface, scale, yaw, position)

    def _draw_pose(
        self, thing: Thing, surface: SupportSurface, scale: float, draws: Draws
    ) -> tuple[float, Floats] | None:
        """Draw a yaw and position (2,) with the footprint inside the surface; None if it does not fit."""
        height = float(thing.geometry.maximum_m[2]) * scale
        likes_wall = surface.kind == "floor" and height > _WALL_HEIGHT_M
        at_wall = draws.chance(_WALL_PROBABILITY) and likes_wall
        side, gap, jitter = draws.integer(0, 3), draws.uniform(0.01, 0.08), draws.uniform(-0.03, 0.03)
        yaw, s, t = draws.uniform(*thing.asset.yaw_range_rad), draws.unit(), draws.unit()
        edge_u, edge_v = surface.edge_u_m, surface.edge_v_m
        length_u, length_v = float(np.linalg.norm(edge_u)), float(np.linalg.norm(edge_v))
        u, v = np.array(edge_u[:2]) / length_u, np.array(edge_v[:2]) / length_v
        if at_wall:
            outward = (u, -u, v, -v)[side]
            turned = math.atan2(outward[1], outward[0]) - 0.5 * math.pi + jitter  # its back (+Y) to the wall
            turned = math.remainder(turned, 2 * math.pi)
            low, high = thing.asset.yaw_range_rad
            inside = [turned + k * 2 * math.pi for k in (-1, 0, 1) if low <= turned + k * 2 * math.pi <= high]
            at_wall, yaw = bool(inside), inside[0] if inside else yaw
        yaw = float(np.round(yaw, 7))
        hull = thing.footprint * scale @ rotation("z", yaw)[:2, :2].T
        along_u, along_v = hull @ u, hull @ v
        room_u = length_u - (along_u.max() - along_u.min())
        room_v = length_v - (along_v.max() - along_v.min())
        if room_u < 0 or room_v < 0:
            return None
        du, dv = s * room_u, t * room_v
        if at_wall:
            du = (max(room_u - gap, 0.0), min(gap, room_u), du, du)[side]
            dv = (dv, dv, max(room_v - gap, 0.0), min(gap, room_v))[side]
        corner = np.array(surface.origin_m[:2])
        return yaw, corner + u * (du - along_u.min()) + v * (dv - along_v.min())

    def _drop(self, thing: Thing, scale: float, yaw: float, position: Floats) -> float | str:
        """Return the vertical shift [m] that puts the object at rest, or the reason for rejection."""
        points = world_points(pose(scale, yaw, position), thing.underside)
        start = points + np.array([0.0, 0.0, SURFACE_TOLERANCE_M])
        down = np.broadcast_to([0.0, 0.0, -1.0], points.shape)
        hits = self.room.rays.cast(start, down, 4 * SURFACE_TOLERANCE_M + 0.1)
        if not hits.hit_mask.any():
            return "no_support"
        offset = SURFACE_TOLERANCE_M - hits.distance_m  # height of the ground relative to the point
        rest = float(offset.max())
        if rest < -SURFACE_TOLERANCE_M or rest > 0.999 * SURFACE_TOLERANCE_M:
            return "off_surface"
        contact = offset >= rest - CONTACT_TOLERANCE_M
        normals = self.room.rays.normals[hits.face[contact]]
        if (np.abs(normals[:, 2]) < _MIN_UP).any():
            return "sloped"
        hull = convex_hull_2d(points[contact][:, :2])
        center = world_points(pose(scale, yaw, position), thing.geometry.center_of_mass_m[None])[0, :2]
        if margin_inside(hull, center) < MIN_CONTACT_MARGIN_M:
            return "unstable"
        return rest

    def _checked(
        self, thing: Thing, surface: SupportSurface, scale: float, yaw: float, position: Floats
    ) -> PlacedThing | str:
        """Return the object placed at a pose or, if it collides there, the reason for rejection."""
        vertices = world_points(pose(scale, yaw, position), thing.geometry.vertices)
        used = vertices[np.unique(thing.geometry.faces)]
        bounds = np.stack([used.min(axis=0), used.max(axis=0)])
        placed = PlacedThing(thing, surface, scale, yaw, position, bounds)
        above = position + np.array([0.0, 0.0, MAX_PENETRATION_M])
        lifted = thing.collision_at(scale).at(rotation("z", yaw), above)
        if self.room.cuts(lifted, bounds, surface):
            return "hits_environment"
        for other in self.placed:
            fault = self._fault_between(placed, other)
            if fault:
                return fault
        if self.room.has_consistent_winding and _is_inside_solid(used, self.room.rays):
            return "inside_solid"
        return placed

    def _fault_between(self, one: PlacedThing, other: PlacedThing) -> str:
        gap = self.recipe.min_gap_m
        (low, high), (other_low, other_high) = one.bounds_m, other.bounds_m
        if (low > other_high + gap).any() or (other_low > high + gap).any():
            return ""
        between = distance_m(one.body, other.body)
        if between <= 0:
            return "hits_object"
        if between < gap:
            return "too_close_to_object"
        if is_enclosed(one, other) or is_enclosed(other, one):
            return "inside_object"
        return ""


def is_enclosed(inner: PlacedThing, outer: PlacedThing) -> bool:
    """Return whether ``inner``'s box is in ``outer``'s and all 6 axis rays from its centre hit ``outer``."""
    if (inner.bounds_m[0] < outer.bounds_m[0]).any() or (inner.bounds_m[1] > outer.bounds_m[1]).any():
        return False
    center = inner.bounds_m.mean(axis=0)
    return bool(outer.rays.cast(np.repeat(center[None], 6, axis=0), _AXES).hit_mask.all())


def _is_inside_solid(points: Floats, rays: RayScene) -> bool:
    """Return whether, for most of 16 sampled points, at least 4 of 6 axis-aligned rays hit back faces."""
    chosen = points[:: max(1, len(points) // 16)][:16]
    origins = np.repeat(chosen, 6, axis=0)
    directions = np.tile(_AXES, (len(chosen), 1))
    hits = rays.cast(origins, directions)
    backs = rays.is_back_hit(hits, directions).reshape(-1, 6).sum(axis=1)
    return bool((backs >= 4).sum() > 0.5 * len(chosen))


def place_things(
    room: Room,
    things: list[Thing],
    recipe: ObjectRecipe,
    key: tuple[int | str, ...],
    rejections: Counter[str],
    weight_of_library: Mapping[str, tuple[str, float]] | None = None,
) -> list[PlacedThing]:
    """Draw objects by weight of library and category, and place them in order of decreasing footprint.

    ``weight_of_library`` maps an object's id to its library and the library's weight. ``key`` seeds the
    draws. Raises :class:`Shortfall` if fewer than ``recipe.count[0]`` objects can be placed, and
    :class:`InputError` if that number is positive but no object can stand on any surface."""
    draws = Draws(*key, "objects")
    target = draws.integer(*recipe.count)
    if target == 0:
        return []
    fitting = [t for t in things if surfaces_for(t.asset, room.asset) and t.can_stand(CONTACT_TOLERANCE_M)]
    cannot_stand = sum(not t.can_stand(CONTACT_TOLERANCE_M) for t in things)
    rejections["placement.cannot_stand"] += cannot_stand
    libraries = _by_library(fitting, recipe, weight_of_library or {})
    if not libraries:
        if recipe.count[0] == 0:
            return []
        kinds = sorted({s.kind for s in room.asset.support_surfaces})
        wanted = sorted({kind for t in things for kind in t.asset.supports})
        raise input_error(
            f"environment {room.asset.id}",
            "support_surfaces",
            f"kinds {', '.join(kinds) or 'none'}; the objects stand on {', '.join(wanted) or 'nothing'}",
            "a surface on which an object of positive weight can stand",
            "add support surfaces or other objects, or set objects.count to [0, 0]",
        )
    placer = Placer(room, recipe, rejections)
    chosen = [_draw_thing(libraries, draws) for _ in range(target)]
    order = sorted(range(target), key=lambda k: (-_bulk(chosen[k].asset), k))
    for k in order:
        placer.place(chosen[k], Draws(*key, "place", k))
    extra = 0
    while len(placer.placed) < target and extra < target:  # replace objects that could not be placed
        other = _draw_thing(libraries, draws)
        placer.place(other, Draws(*key, "replace", extra))
        extra += 1
    if len(placer.placed) < recipe.count[0]:
        counts = ", ".join(f"{k} {v}" for k, v in sorted(rejections.items()) if k.startswith("placement."))
        problem = Problem(
            f"environment {room.asset.id}",
            "objects",
            f"{len(placer.placed)} placed ({counts})",
            f"at least {recipe.count[0]} (objects.count)",
            "lower objects.count, raise objects.max_attempts, or add support surfaces or smaller objects",
        )
        raise Shortfall(problem)
    return placer.placed


@dataclass(frozen=True)
class _LibraryObjects:
    """The objects of one library by category, with the weights of the library and of each category."""

    weight: float
    by_category: dict[str, list[Thing]]
    category_weights: list[float]


def _by_library(
    things: list[Thing], recipe: ObjectRecipe, weight_of_library: Mapping[str, tuple[str, float]]
) -> list[_LibraryObjects]:
    """Group objects by library, sorted by name; omit libraries in which all weights are 0."""
    groups: dict[tuple[str, float], dict[str, list[Thing]]] = {}
    for thing in sorted(things, key=lambda t: (t.asset.category, t.asset.id)):
        of_library = groups.setdefault(weight_of_library.get(thing.asset.id, ("", 1.0)), {})
        of_library.setdefault(thing.asset.category, []).append(thing)
    libraries = []
    for (_, weight), by_category in sorted(groups.items(), key=lambda entry: entry[0]):
        weights = [recipe.category_weights.get(category, 1.0) for category in by_category]
        if weight > 0 and any(weights):
            libraries.append(_LibraryObjects(weight, by_category, weights))
    return libraries


def _draw_thing(libraries: list[_LibraryObjects], draws: Draws) -> Thing:
    """Draw a library (unless there is only one), then one of its categories, then an object."""
    chosen = libraries[0] if len(libraries) == 1 else draws.weighted(libraries, [o.weight for o in libraries])
    return draws.choice(chosen.by_category[draws.weighted(list(chosen.by_category), chosen.category_weights)])


def _bulk(asset: ObjectAsset) -> float:
    size = np.array(asset.maximum_m) - np.array(asset.minimum_m)
    return float(size[0] * size[1])

# SPDX-License-Identifier: MIT
"""Chooses lights, their positions and colours; ``light_levels`` sets their intensities.

Lights form groups with a common intensity factor: the assets' own lights form one group, daylight
another, and each added area or point light one more.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.assembly.daylight import draw_sun_direction, environment_image
from datagen.assembly.geometry import Floats, RayScene, WorldScene
from datagen.assembly.light_probe import Rectangle, is_from_outside
from datagen.assembly.materials import MeanMaterial
from datagen.assembly.panoramas import DARK, OUTSIDE_SHARE, draw_daytime, draw_panorama, turned_image
from datagen.assembly.things import fibonacci_sphere
from datagen.formats.asset import Daytime, EnvironmentAsset, GeometryAsset, LightSlot
from datagen.formats.base import quantized
from datagen.formats.configuration import PlacedAsset
from datagen.formats.lights import AreaLight, Light, PointLight, SkyLight, moved_light
from datagen.formats.recipe import LightRecipe
from datagen.foundation.color import color_of_temperature
from datagen.foundation.random import Draws
from datagen.library import Library

SHARE_RANGE = (0.25, 1.0)  # range of a group's share of the irradiance before the shares are normalised
_DIRECT_SUN_PROBABILITY = 0.6
_PANEL_DROP_M = 0.03  # a ceiling panel hangs this far below the ceiling
_PANEL_SIDE_M = (0.3, 1.0)
_MIN_LIGHT_CLEARANCE_M = 0.05
_MAX_BACKS = 0.85  # share of back-face hits above which a point is in a solid; lampshades stay below it
_PANEL_TRIES = 60


@dataclass(frozen=True)
class PlannedGroup:
    """Lights and emissive slots with a common intensity factor.

    ``slots`` are pairs of asset index (0: the room) and slot. ``share`` is the range of the group's share of
    the irradiance, before the groups' shares are normalised.
    """

    name: str
    lights: tuple[Light, ...] = ()
    slots: tuple[tuple[int, str], ...] = ()
    share: tuple[float, float] = SHARE_RANGE


@dataclass(frozen=True)
class RoomToLight:
    """A scene to light; ``placed``, ``assets`` and ``assigned`` have one entry per asset, the room first.

    ``assigned`` are mean materials by slot, ``eyes`` are possible camera positions (P, 3).
    ``has_solid_backs`` is true if hits on back faces indicate the inside of a solid.
    """

    environment: EnvironmentAsset
    scene: WorldScene
    placed: tuple[PlacedAsset, ...]
    assets: tuple[GeometryAsset, ...]
    assigned: tuple[dict[str, MeanMaterial], ...]
    eyes: Floats
    has_solid_backs: bool


def plan_lights(
    room: RoomToLight,
    recipe: LightRecipe,
    library: Library,
    key: tuple[int | str, ...],
    rejections: Counter[str],
) -> list[PlannedGroup]:
    """Draw light groups at nominal intensity; ``key`` seeds draws, ``rejections`` counts lights left out."""
    draws = Draws(*key, "lights")
    wants = {
        "native": draws.chance(recipe.native_probability),
        "area": draws.chance(recipe.area_probability),
        "point": draws.chance(recipe.point_probability),
        "daylight": draws.chance(recipe.daylight_probability),
    }
    daytime = draw_daytime(room.assets, recipe, Draws(*key, "daytime"))
    if daytime is not None:
        wants["daylight"] = True
        wants["native"] |= daytime in DARK
    makers: dict[str, Any] = {
        "native": lambda: _native(room),
        "area": lambda: _area(room, recipe, Draws(*key, "area"), rejections),
        "point": lambda: _point(room, recipe, Draws(*key, "point"), rejections),
        "daylight": lambda: (
            _daylight(room, recipe, library, Draws(*key, "daylight"), rejections)
            if daytime is None
            else _panorama(daytime, library, Draws(*key, "panorama"))
        ),
    }
    groups: list[PlannedGroup] = []
    for kind in wants:
        if wants[kind]:
            groups += _without_overlap(makers[kind](), groups, rejections)
        if kind == "native" and daytime in DARK and not groups:
            wants["area"] = True
    for kind in ("native", "daylight", "area", "point"):  # at least one group, if the recipe allows any
        if not groups and not wants[kind] and getattr(recipe, f"{kind}_probability") > 0:
            groups += makers[kind]()
    if not groups:
        groups = plan_panels(room, recipe, 1, Draws(*key, "panel"), rejections)
    if sum(any(is_from_outside(light) for light in g.lights) for g in groups) > 1:
        groups = [g for g in groups if g.name != "daylight"]  # the sky of an asset replaces drawn daylight
    return groups


def _without_overlap(
    fresh: list[PlannedGroup], groups: list[PlannedGroup], rejections: Counter[str]
) -> list[PlannedGroup]:
    """Drop the groups of ``fresh`` whose area lights overlap one in ``groups``, and count them."""
    kept = []
    for group in fresh:
        others = [light for other in groups for light in other.lights if isinstance(light, AreaLight)]
        if any(isinstance(a, AreaLight) and _overlap(a, b) for a in group.lights for b in others):
            rejections["light.occupied"] += 1
        else:
            kept.append(group)
    return kept


def _overlap(one: AreaLight, other: AreaLight) -> bool:
    """Return whether two area lights are coplanar within 2 cm and overlap."""
    side, own = Rectangle.of(other), Rectangle.of(one)
    middle = own.middle - side.origin
    if abs(float(middle @ side.normal)) > 0.02:
        return False
    for edge in (side.u, side.v):
        length = float(np.linalg.norm(edge))
        reach = (abs(float(0.5 * own.u @ edge)) + abs(float(0.5 * own.v @ edge))) / length
        if not -reach < float(middle @ edge) / length < length + reach:
            return False
    return True


def _native(room: RoomToLight) -> list[PlannedGroup]:
    lights: list[Light] = []
    slots: list[tuple[int, str]] = []
    for item, (asset, placed) in enumerate(zip(room.assets, room.placed, strict=True)):
        for light in asset.lights:
            moved = moved_light(light, placed.world_from_asset, placed.asset)
            lights.append(moved.model_copy(update={"name": f"{placed.name}.{light.name}"}))
        slots += [
            (item, slot) for slot in sorted(asset.materials) if any(asset.materials[slot].emission or ())
        ]
    return [PlannedGroup("native", tuple(lights), tuple(slots))] if lights or slots else []


def _lamp_color(recipe: LightRecipe, draws: Draws) -> tuple[float, float, float]:
    red, green, blue = color_of_temperature(draws.log_uniform(*recipe.color_temperature_k))
    return (quantized(red, 6), quantized(green, 6), quantized(blue, 6))


def _area(
    room: RoomToLight, recipe: LightRecipe, draws: Draws, rejections: Counter[str]
) -> list[PlannedGroup]:
    count = max(1, draws.integer(*recipe.count_area))
    slots = draws.shuffled([s for s in room.environment.light_slots if s.kind == "area"])
    groups: list[PlannedGroup] = []
    for slot in slots:
        if len(groups) == count:
            break
        light = _light_in_slot(slot, _lamp_color(recipe, draws), draws)
        if is_blocked(light, room.scene.rays):
            rejections["light.blocked"] += 1
        else:
            groups.append(PlannedGroup(f"area-{slot.name}", (light,)))
    if not slots:
        groups = plan_panels(room, recipe, count, draws, rejections)
    return groups


def _light_in_slot(slot: LightSlot, color: tuple[float, float, float], draws: Draws) -> AreaLight:
    """Draw an area light 2 mm in front of a slot, with 50 to 100 % of its length and width."""
    u, v = np.array(slot.edge_u_m), np.array(slot.edge_v_m)
    share_u, share_v = draws.uniform(0.5, 1.0), draws.uniform(0.5, 1.0)
    normal = np.cross(u, v)
    origin = np.array(slot.origin_m) + 2e-3 * normal / np.linalg.norm(normal)
    origin = origin + draws.unit() * (1 - share_u) * u + draws.unit() * (1 - share_v) * v
    return AreaLight(
        name=f"area-{slot.name}",
        origin_m=_vector(origin),
        edge_u_m=_vector(share_u * u),
        edge_v_m=_vector(share_v * v),
        radiance=color,
    )


def _vector(value: Floats) -> tuple[float, float, float]:
    x, y, z = np.round(value, 6).tolist()
    return (x, y, z)


def is_blocked(light: AreaLight, rays: RayScene) -> bool:
    """Return whether geometry intersects an area light or lies within 15 cm in front of over 25 % of it."""
    side = Rectangle.of(light)
    u, v, normal = side.u, side.v, side.normal
    steps = (np.arange(4) + 0.5) / 4
    s, t = (a.ravel() for a in np.meshgrid(steps, steps))
    lifted = side.origin + 1e-3 * normal
    in_front = lifted + s[:, None] * u + t[:, None] * v
    near = rays.occluded(in_front, np.repeat(normal[None], 16, axis=0), 3 * _MIN_LIGHT_CLEARANCE_M)
    if near.mean() > 0.25:
        return True
    starts = np.concatenate([lifted + steps[:, None] * v, lifted + steps[:, None] * u])
    spans = np.concatenate([np.repeat(u[None], 4, axis=0), np.repeat(v[None], 4, axis=0)])
    lengths = np.linalg.norm(spans, axis=1)
    return bool(rays.occluded(starts, spans / lengths[:, None], lengths).any())


def plan_panels(
    room: RoomToLight, recipe: LightRecipe, count: int, draws: Draws, rejections: Counter[str]
) -> list[PlannedGroup]:
    """Draw up to ``count`` groups of one area light each, below the ceiling and above a camera position."""
    groups: list[PlannedGroup] = []
    for _ in range(_PANEL_TRIES if len(room.eyes) else 0):
        if len(groups) == count:
            break
        eye = room.eyes[draws.integer(0, len(room.eyes) - 1)]
        width, depth = draws.uniform(*_PANEL_SIDE_M), draws.uniform(*_PANEL_SIDE_M)
        up = np.array([0.0, 0.0, 1.0])
        above = float(room.scene.rays.cast(eye, up[None]).distance_m[0])
        if not 0.2 < above < 20.0:
            rejections["light.no_ceiling"] += 1
            continue
        middle = eye + (above - _PANEL_DROP_M) * up
        corner = middle - [0.5 * width, -0.5 * depth, 0.0]
        light = AreaLight(
            name=f"panel-{len(groups)}",
            origin_m=_vector(corner),
            edge_u_m=(quantized(width, 5), 0.0, 0.0),
            edge_v_m=(0.0, -quantized(depth, 5), 0.0),
            radiance=_lamp_color(recipe, draws),
        )
        if is_blocked(light, room.scene.rays) or any(_near(light, g.lights[0]) for g in groups):
            rejections["light.blocked"] += 1
            continue
        groups.append(PlannedGroup(light.name, (light,)))
    return groups


def _near(one: AreaLight, other: Light) -> bool:
    assert isinstance(other, AreaLight)
    apart = Rectangle.of(one).middle - Rectangle.of(other).middle
    return float(np.linalg.norm(apart)) < 1.2 * _PANEL_SIDE_M[1]


def _point(
    room: RoomToLight, recipe: LightRecipe, draws: Draws, rejections: Counter[str]
) -> list[PlannedGroup]:
    count = max(1, draws.integer(*recipe.count_point))
    groups: list[PlannedGroup] = []
    for slot in draws.shuffled([s for s in room.environment.light_slots if s.kind == "point"]):
        if len(groups) == count:
            break
        color = _lamp_color(recipe, draws)
        fault = _point_fault(np.array(slot.origin_m), room)
        if fault:
            rejections[f"light.{fault}"] += 1
            continue
        light = PointLight(name=f"point-{slot.name}", position_m=slot.origin_m, intensity=color)
        groups.append(PlannedGroup(light.name, (light,)))
    return groups


def _point_fault(position: Floats, room: RoomToLight) -> str:
    """Return the fault of a point light at ``position`` (3,): ``inside_solid``, ``blocked`` or ''."""
    directions = fibonacci_sphere(48)
    hits = room.scene.rays.cast(position, directions)
    if room.has_solid_backs and room.scene.rays.is_back_hit(hits, directions).mean() > _MAX_BACKS:
        return "inside_solid"
    return "blocked" if float(hits.distance_m.min()) < _MIN_LIGHT_CLEARANCE_M else ""


def _panorama(daytime: Daytime, library: Library, draws: Draws) -> list[PlannedGroup]:
    light = draw_panorama(daytime, library, draws)
    return [PlannedGroup("daylight", (light,), share=OUTSIDE_SHARE[daytime])]


def _daylight(
    room: RoomToLight, recipe: LightRecipe, library: Library, draws: Draws, rejections: Counter[str]
) -> list[PlannedGroup]:
    """Draw a group with a sky and sun, or with an environment image; return [] if there are no openings."""
    openings = room.environment.openings
    images = sorted(recipe.environment_images)
    wants_image, pick, turn = draws.chance(0.5), draws.unit(), draws.uniform(-math.pi, math.pi)
    enters, turbidity = draws.chance(_DIRECT_SUN_PROBABILITY), draws.uniform(2.0, 6.0)
    ground, sun_scale = draws.uniform(0.1, 0.5), draws.log_uniform(0.1, 1.0)
    if not openings:
        rejections["light.no_opening"] += 1
        return []
    if images and wants_image:
        asset = images[int(pick * len(images))]
        return [PlannedGroup("daylight", (turned_image(asset, environment_image(library, asset), turn),))]
    direction, reaches = draw_sun_direction(room.scene.rays, openings, room.eyes, enters, draws)
    if enters and not reaches:
        rejections["light.sun_kept_out"] += 1
    sky = SkyLight(
        name="daylight",
        sun_direction=_vector(direction),
        turbidity=quantized(turbidity, 4),
        ground_albedo=quantized(ground, 4),
        sun_scale=quantized(sun_scale, 4),
    )
    return [PlannedGroup("daylight", (sky,))]

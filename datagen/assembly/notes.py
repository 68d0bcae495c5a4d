# SPDX-License-Identifier: MIT
"""Notes on valid but unusual content of recipes and libraries, reported before work starts."""

from __future__ import annotations

import math

import numpy as np

from datagen.assembly.generated import example_rooms
from datagen.assembly.geometry import load_geometry
from datagen.assembly.light_probe import is_from_outside
from datagen.assembly.placement import CONTACT_TOLERANCE_M, surfaces_for
from datagen.assembly.splits import packages_in_use, pools_of_split, splits_in_use
from datagen.assembly.things import Thing
from datagen.formats.asset import EnvironmentAsset, ObjectAsset
from datagen.formats.category_sizes import size_fault
from datagen.formats.recipe import Recipe
from datagen.foundation.bundled import is_bundled
from datagen.library import Library


def notes_before(recipe: Recipe, library: Library) -> list[str]:
    """List notes on unplaceable objects, implausible sizes and rooms without a sky, one sentence per note."""
    never = (f"{name} is never placed: {why}" for name, why in unplaceable(recipe, library).items())
    return [*never, *implausible_sizes(recipe, library), *rooms_without_sky(recipe, library)]


def implausible_sizes(recipe: Recipe, library: Library) -> list[str]:
    """Return a sentence per available object whose size is implausible for its category, sorted by id."""
    found = []
    for package in packages_in_use(recipe, library, "objects"):
        if fault := size_fault(package.as_kind(ObjectAsset)):
            found.append(f"{package.id} {fault}")
    return found


def unplaceable(recipe: Recipe, library: Library) -> dict[str, str]:
    """Map the id of each object that is unstable or fits in none of the recipe's rooms to reason and remedy.

    It suffices that an object fits in a room of one of the splits that may contain it.
    """
    if recipe.objects.count[1] == 0:
        return {}
    reasons: dict[str, str] = {}
    placeable: set[str] = set()
    for split in splits_in_use(recipe):
        pools = pools_of_split(recipe, library, split)
        rooms = [p.asset for p in pools.environments if isinstance(p.asset, EnvironmentAsset)]
        more = example_rooms(recipe)
        for package in pools.objects:
            asset = package.as_kind(ObjectAsset)
            if asset.id in placeable:
                continue
            why = _why_no_surface(asset, rooms)
            while why and (room := next(more, None)) is not None:  # generated only if no earlier room fits
                rooms.append(room)
                why = _why_no_surface(asset, rooms)
            if not why and not Thing(asset, load_geometry(package)).can_stand(CONTACT_TOLERANCE_M):
                why = "it would topple on level ground; give it feet, or turn it upright"
            if why:
                reasons[asset.id] = why
            else:
                placeable.add(asset.id)
    return {name: reasons[name] for name in sorted(reasons.keys() - placeable)}


def _why_no_surface(asset: ObjectAsset, rooms: list[EnvironmentAsset]) -> str:
    """Return why no room has a surface for the object, and the remedy; '' if a room has one."""
    if any(surfaces_for(asset, room) for room in rooms):
        return ""
    if not asset.supports:
        return "supports is empty, as for hanging or built-in objects; list the surfaces that it can stand on"
    surfaces = [s for room in rooms for s in room.support_surfaces if s.kind in asset.supports]
    kinds = ", ".join(asset.supports)
    if not surfaces:
        return f"no room has a support of kind {kinds}; extend its supports, or mark such surfaces"
    size = (np.array(asset.maximum_m) - np.array(asset.minimum_m)) * asset.scale_range[0]
    tallest = max(s.clearance_m for s in surfaces)
    if size[2] > tallest:
        return f"it is {size[2]:.2f} m tall, at most {tallest:.2f} m are free; check its unit or scale"
    largest = max(
        (sorted(float(np.linalg.norm(e)) for e in (s.edge_u_m, s.edge_v_m)) for s in surfaces), key=math.prod
    )
    return (
        f"its footprint is {size[0]:.2f} x {size[1]:.2f} m, the largest surface {largest[1]:.2f} x "
        f"{largest[0]:.2f} m; check its unit or scale"
    )


def rooms_without_sky(recipe: Recipe, library: Library) -> list[str]:
    """Return a sentence for each room without a sky, bundled ones excepted, on how daylight enters it.

    Returns [] if the recipe uses no library rooms, or neither panoramas nor daylight.
    """
    lights = recipe.lights
    if not recipe.environments.needs_library or (
        lights.panoramas is None and not lights.daylight_probability
    ):
        return []
    found = []
    for package in packages_in_use(recipe, library, "environments"):
        room = package.as_kind(EnvironmentAsset)
        if is_bundled(package.path) or any(map(is_from_outside, room.lights)):
            continue
        if not room.openings:
            how = "and no openings, so no daylight reaches it; mark its windows, or give its scene a world"
        elif lights.panoramas is not None:
            how = "so a panorama lights it through its openings (lights.panoramas)"
        else:
            how = (
                f"so daylight enters through its openings in {lights.daylight_probability:.0%} of its "
                "configurations (lights.daylight_probability; 0 leaves it out)"
            )
        found.append(f"{room.id} has no sky of its own, {how}")
    return found

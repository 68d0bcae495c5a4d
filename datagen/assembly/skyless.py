# SPDX-License-Identifier: MIT
"""Finds users' rooms without a sky, to report them and the substitute for daylight before work starts."""

from __future__ import annotations

from datagen.assembly.light_probe import is_from_outside
from datagen.assembly.splits import pools_of_split, splits_in_use
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.recipe import Recipe
from datagen.foundation.bundled import is_bundled
from datagen.library import Library


def rooms_without_sky(recipe: Recipe, library: Library) -> list[str]:
    """A sentence for each user's room without a sky: how daylight is added, or why that is impossible.

    Empty if the recipe has no daylight.
    """
    lights = recipe.lights
    if not recipe.environments.needs_library or (
        lights.panoramas is None and not lights.daylight_probability
    ):
        return []
    found: dict[str, str] = {}
    for split in splits_in_use(recipe):
        for package in pools_of_split(recipe, library, split).environments:
            room = package.asset
            assert isinstance(room, EnvironmentAsset)
            if is_bundled(package.path) or any(map(is_from_outside, room.lights)):
                continue
            if not room.openings:
                how = (
                    "and no openings, so no daylight reaches it; mark its windows, or give its scene a world"
                )
            elif lights.panoramas is not None:
                how = "so a panorama lies outside its openings (lights.panoramas)"
            else:
                how = (
                    f"so daylight comes through its openings in {lights.daylight_probability:.0%} of its "
                    "configurations (lights.daylight_probability; 0 leaves it out)"
                )
            found[room.id] = f"{room.id} has no sky of its own, {how}"
    return [found[name] for name in sorted(found)]

# SPDX-License-Identifier: MIT
"""Finds rooms of users' libraries without a sky and reports how they get daylight."""

from __future__ import annotations

from datagen.assembly.light_probe import is_from_outside
from datagen.assembly.splits import packages_in_use
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.recipe import Recipe
from datagen.foundation.bundled import is_bundled
from datagen.library import Library


def rooms_without_sky(recipe: Recipe, library: Library) -> list[str]:
    """Describe in one sentence per skyless room how it gets daylight; empty if the recipe has no daylight."""
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

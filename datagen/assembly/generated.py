# SPDX-License-Identifier: MIT
"""Generates the rooms of configurations (``environments.parametric`` of the recipe).

A room is a pure function of the recipe, the configuration's index and the attempt at planning it. It is an
environment package in memory, which planning writes to the dataset's folder ``rooms/`` for later stages.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

from datagen.assembly.looks import KEPT
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.configuration import Configuration
from datagen.formats.package import Package
from datagen.formats.recipe import ParametricRecipe, Recipe
from datagen.foundation.random import Draws
from datagen.parametric.kinds import KINDS
from datagen.parametric.packing import room_package

_KEPT_IN_MEMORY = 4


@dataclass(frozen=True)
class GeneratedRoom:
    """An environment package and the bytes ``data`` of its zip file."""

    data: bytes
    package: Package

    @cached_property
    def bare_slots(self) -> frozenset[tuple[str, str]]:
        """Pairs (asset id, slot) of the slots with a placeholder material, which must be replaced."""
        asset = self.package.as_kind(EnvironmentAsset)
        return frozenset(
            (asset.id, slot)
            for slot, material in asset.materials.items()
            if material.replaceable_by and material.surface not in KEPT
        )


def generated_room(recipe: Recipe, index: int, attempt: int = 0) -> GeneratedRoom | None:
    """Generate the room for an attempt at planning configuration ``index``; None for a library room."""
    wanted = recipe.environments.parametric
    draws = Draws(recipe.seed, index, "parametric")
    if wanted is None or not draws.chance(wanted.share):
        return None
    kind = draws.choice(_kinds(wanted))
    seed = f"{recipe.seed}/{index}" if attempt == 0 else f"{recipe.seed}/{index}/{attempt}"
    return _generated(kind, seed, recipe.lights.panoramas is None)


def room_of(recipe: Recipe, configuration: Configuration, num_tries: int) -> GeneratedRoom | None:
    """Generate the room of a planned configuration again; return None if it uses a library room.

    Raises :class:`ValueError` if none of the first ``num_tries`` attempts has the room's asset id.
    """
    for attempt in range(num_tries):
        room = generated_room(recipe, configuration.index, attempt)
        if room is None or room.package.id == configuration.environment.asset:
            return room
    raise ValueError(f"{configuration.id} is not a configuration of recipe {recipe.name}")


def example_rooms(recipe: Recipe) -> Iterator[EnvironmentAsset]:
    """Yield one room of each kind that the recipe can generate."""
    wanted = recipe.environments.parametric
    for kind in _kinds(wanted) if wanted is not None else ():
        yield _generated(kind, "example", False).package.as_kind(EnvironmentAsset)


def _kinds(wanted: ParametricRecipe) -> list[str]:
    return sorted(set(wanted.kinds)) or sorted(KINDS)


@lru_cache(maxsize=_KEPT_IN_MEMORY)
def _generated(kind: str, seed: str, has_scenery: bool) -> GeneratedRoom:
    return GeneratedRoom(*room_package(kind, seed, has_scenery))

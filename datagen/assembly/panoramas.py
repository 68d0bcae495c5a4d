# SPDX-License-Identifier: MIT
"""Draws the time of day outside a room and the panorama that lights it."""

from __future__ import annotations

import math

import numpy as np

from datagen.assembly.light_probe import is_from_outside
from datagen.assembly.things import pose
from datagen.formats.asset import Daytime, EnvironmentAsset, GeometryAsset, PanoramaAsset
from datagen.formats.lights import EnvironmentLight
from datagen.formats.recipe import LightRecipe
from datagen.foundation.random import Draws
from datagen.library import Library

OUTSIDE_SHARE: dict[Daytime, tuple[float, float]] = {
    "day": (0.4, 1.5),
    "overcast": (0.3, 1.0),
    "dusk": (0.02, 0.15),
    "night": (5e-4, 4e-3),
}
"""Range of a panorama's share of the irradiance, before normalisation; nights have only street lights."""
DARK: tuple[Daytime, ...] = ("dusk", "night")
"""Times of day at which lamps are always on."""


def draw_daytime(assets: tuple[GeometryAsset, ...], recipe: LightRecipe, draws: Draws) -> Daytime | None:
    """Draw the time of day outside the room ``assets[0]``.

    Returns None if the recipe has no panoramas, the room has no openings, or an asset contains a sky.
    """
    room = assets[0]
    assert isinstance(room, EnvironmentAsset)
    has_sky = any(is_from_outside(light) for asset in assets for light in asset.lights)
    if recipe.panoramas is None or not room.openings or has_sky:
        return None
    weights = recipe.panoramas.wanted()
    return draws.weighted(list(weights), list(weights.values()))


def panoramas_of(library: Library, daytime: Daytime) -> list[PanoramaAsset]:
    """Return the library's panoramas of a time of day, sorted by id."""
    assets = (package.asset for package in library.select("panorama"))
    return [asset for asset in assets if isinstance(asset, PanoramaAsset) and asset.daytime == daytime]


def draw_panorama(daytime: Daytime, library: Library, draws: Draws) -> EnvironmentLight:
    """Draw a panorama of a time of day; return it as a light with a random rotation about the vertical."""
    chosen = draws.choice(panoramas_of(library, daytime))
    return turned_image(chosen.id, chosen.image, draws.uniform(-math.pi, math.pi))


def turned_image(asset: str, image: str, turn_rad: float) -> EnvironmentLight:
    """Return an environment light with an image of the package ``asset``, rotated about the vertical."""
    rows = tuple(tuple(round(x, 9) for x in row) for row in pose(1.0, turn_rad, np.zeros(3)).tolist())
    return EnvironmentLight(
        name="daylight",
        image=image,
        asset=asset,
        world_from_environment=rows,  # type: ignore[arg-type]
    )

# SPDX-License-Identifier: MIT
"""Radiance of skies and environment images as functions of direction, and random sun directions."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from datagen.assembly.geometry import Floats, RayScene, direction_of
from datagen.assembly.light_probe import EnvironmentMap
from datagen.formats.asset import Opening
from datagen.formats.lights import DirectionalLight, EnvironmentLight, SkyLight
from datagen.foundation.errors import input_error
from datagen.foundation.images import read_radiance
from datagen.foundation.random import Draws
from datagen.library import Library
from mitsuba_plugins.variant import select_variant

SUN_ELEVATION_RAD = (math.radians(6.0), math.radians(65.0))
_TABLE_ROWS, _TABLE_COLUMNS = 32, 64
SUN_HALF_ANGLE_RAD = math.radians(0.5 * 0.5358)  # half the default sun aperture of Mitsuba's sunsky
_SUN_SAMPLES = 128
_SUN_TRIES = 24


def directions_of_table(rows: int = _TABLE_ROWS, columns: int = _TABLE_COLUMNS) -> Floats:
    """Unit directions (rows, columns, 3) of equirectangular pixels, with +Y at the centre and +Z on top."""
    polar = (np.arange(rows) + 0.5) / rows * math.pi
    azimuth = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * math.pi
    sine = np.sin(polar)[:, None]
    up = np.broadcast_to(np.cos(polar)[:, None], (rows, columns))
    return np.stack([sine * np.sin(azimuth), sine * np.cos(azimuth), up], axis=-1)


def lookup(table: Floats) -> EnvironmentMap:
    """Return a function that looks up directions (R, 3) in an equirectangular table (rows, columns, 3)."""
    rows, columns = table.shape[:2]

    def radiance(directions: Floats) -> Floats:
        u = 0.5 + np.arctan2(directions[:, 0], directions[:, 1]) / (2 * math.pi)
        v = np.arccos(np.clip(directions[:, 2], -1, 1)) / math.pi
        column = np.minimum((u * columns).astype(np.int64), columns - 1)
        row = np.minimum((v * rows).astype(np.int64), rows - 1)
        return table[row, column]

    return radiance


def environment_radiance(light: EnvironmentLight, library: Library) -> EnvironmentMap:
    """Radiance of an environment by world direction; images are averaged over cells of 5.6 degrees."""
    if light.image is None:
        constant = light.scale * np.array(light.radiance)
        return lambda directions: np.broadcast_to(constant, directions.shape)
    assert light.asset is not None
    table = light.scale * _image_table(library, light.asset, light.image)
    environment_from_world = np.array(light.world_from_environment)[:3, :3].T
    local = lookup(table)
    return lambda directions: local(directions @ environment_from_world.T)


def _image_table(library: Library, asset: str, image: str) -> Floats:
    pixels = read_radiance(library.package(asset).local_file(image)).astype(np.float64)
    rows, columns = min(_TABLE_ROWS, pixels.shape[0]), min(_TABLE_COLUMNS, pixels.shape[1])
    by_row = np.add.reduceat(pixels, np.arange(rows) * pixels.shape[0] // rows, axis=0)
    by_cell = np.add.reduceat(by_row, np.arange(columns) * pixels.shape[1] // columns, axis=1)
    heights = np.diff(np.append(np.arange(rows) * pixels.shape[0] // rows, pixels.shape[0]))
    widths = np.diff(np.append(np.arange(columns) * pixels.shape[1] // columns, pixels.shape[1]))
    return by_cell / (heights[:, None, None] * widths[None, :, None])


def sky_radiance(light: SkyLight) -> EnvironmentMap:
    """Radiance of a sky, without the sun's disc, as a function of world direction."""
    table = _sky_table(light.sun_direction, light.turbidity, light.ground_albedo)
    return lookup(light.sky_scale * table)


def sun_of(light: SkyLight) -> DirectionalLight:
    """A directional light with the direction and irradiance of a sky's sun."""
    irradiance = light.sun_scale * _sun_irradiance(light.sun_direction, light.turbidity, light.ground_albedo)
    direction = -np.array(light.sun_direction) / np.linalg.norm(light.sun_direction)
    return DirectionalLight(
        name=light.name,
        direction=(float(direction[0]), float(direction[1]), float(direction[2])),
        irradiance=(float(irradiance[0]), float(irradiance[1]), float(irradiance[2])),
    )


@lru_cache(maxsize=64)
def _sky_table(sun: tuple[float, float, float], turbidity: float, albedo: float) -> Floats:
    directions = directions_of_table()
    values = sunsky(sun, turbidity, albedo, 1.0, 0.0, directions.reshape(-1, 3))
    return values.reshape(directions.shape)


@lru_cache(maxsize=64)
def _sun_irradiance(sun: tuple[float, float, float], turbidity: float, albedo: float) -> Floats:
    axis = np.array(sun) / np.linalg.norm(sun)
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    index = np.arange(_SUN_SAMPLES) + 0.5
    cap = 1 - math.cos(SUN_HALF_ANGLE_RAD)
    cosine = 1 - cap * index / _SUN_SAMPLES
    sine, angle = np.sqrt(1 - cosine**2), math.pi * (3 - math.sqrt(5)) * index
    rim = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
    directions = cosine[:, None] * axis + sine[:, None] * rim
    return sunsky(sun, turbidity, albedo, 0.0, 1.0, directions).mean(axis=0) * 2 * math.pi * cap


def sunsky(
    sun: tuple[float, float, float],
    turbidity: float,
    albedo: float,
    sky: float,
    disc: float,
    directions: Floats,
) -> Floats:
    """Radiance (R, 3) of Mitsuba's ``sunsky`` in unit ``directions`` (R, 3).

    ``sun`` points towards the sun; ``sky`` and ``disc`` scale the radiance of the sky and of the sun's disc.
    """
    select_variant()
    import drjit as dr
    import mitsuba as mi

    emitter = mi.load_dict(
        {
            "type": "sunsky",
            "sun_direction": [float(x) for x in sun],
            "turbidity": turbidity,
            "albedo": albedo,
            "sky_scale": sky,
            "sun_scale": disc,
        }
    )
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    interaction.wi = mi.Vector3f(*(-directions.T).astype(np.float32))
    radiance = np.array(emitter.eval(interaction), dtype=np.float64).T
    return np.maximum(np.round(radiance, 6), 0.0)


def environment_image(library: Library, asset_id: str) -> str:
    """File name of an asset's environment image. Raises :class:`InputError` if it has none."""
    asset = library.package(asset_id).asset
    for light in getattr(asset, "lights", ()):
        if (
            isinstance(light, EnvironmentLight)
            and light.image is not None
            and light.asset in (None, asset_id)
        ):
            return light.image
    raise input_error(
        library.package(asset_id).path,
        "lights",
        "no environment light with an image",
        "one, since the recipe lists this asset in lights.environment_images",
        "list an asset whose lights include an environment image",
    )


def draw_sun_direction(
    rays: RayScene, openings: tuple[Opening, ...], targets: Floats, enters: bool, draws: Draws
) -> tuple[Floats, bool]:
    """Draw a unit vector (3,) towards the sun; also return whether it lights one of ``targets`` (P, 3).

    If ``enters`` is true, directions from targets through openings are tried until one is unobstructed and
    has an elevation in :data:`SUN_ELEVATION_RAD`. If none is found or ``enters`` is false, the direction is
    random and the second value False.
    """
    if enters and openings and len(targets):
        areas = [float(np.linalg.norm(np.cross(o.edge_u_m, o.edge_v_m))) for o in openings]
        for _ in range(_SUN_TRIES):
            opening = draws.weighted(openings, areas)
            target = targets[draws.integer(0, len(targets) - 1)]
            s, t = draws.uniform(0.1, 0.9), draws.uniform(0.1, 0.9)
            through = (
                np.array(opening.origin_m) + s * np.array(opening.edge_u_m) + t * np.array(opening.edge_v_m)
            )
            direction = through - target
            direction /= max(float(np.linalg.norm(direction)), 1e-9)
            elevation = math.asin(min(1.0, max(-1.0, float(direction[2]))))
            if not SUN_ELEVATION_RAD[0] <= elevation <= SUN_ELEVATION_RAD[1]:
                continue
            if not rays.occluded(target[None], direction[None], np.inf)[0]:
                return np.round(direction, 6), True
    azimuth, elevation = draws.uniform(-math.pi, math.pi), draws.uniform(*SUN_ELEVATION_RAD)
    return np.round(direction_of(azimuth, elevation), 6), False

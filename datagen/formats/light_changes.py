# SPDX-License-Identifier: MIT
"""Transformation and scaling of lights of every kind."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from datagen.formats.base import quantized
from datagen.formats.lights import EnvironmentLight, Light, SkyLight
from datagen.foundation.axes import affine


def moved_light(light: Light, world_from_asset: ArrayLike, asset_id: str) -> Light:
    """Transform an asset's light to world space by a (4, 4) matrix; radiometric values are unchanged.

    The image of an environment light without ``asset`` is attributed to the package ``asset_id``.
    """
    matrix = np.array(world_from_asset, dtype=np.float64)
    linear = matrix[:3, :3]
    scale = float(np.cbrt(abs(np.linalg.det(linear))))

    def point(p: Any) -> tuple[float, ...]:
        return tuple((linear @ np.array(p) + matrix[:3, 3]).tolist())

    def vector(v: Any, unit: bool = False) -> tuple[float, ...]:
        moved = linear @ np.array(v)
        return tuple((moved / np.linalg.norm(moved) if unit else moved).tolist())

    def rotated(rows: Any) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple(row) for row in (affine(linear / scale) @ np.array(rows)).tolist())

    moves: dict[str, Callable[[Any], Any]] = {
        **dict.fromkeys(("position_m", "origin_m"), point),
        **dict.fromkeys(("edge_u_m", "edge_v_m"), vector),
        **dict.fromkeys(("direction", "sun_direction"), partial(vector, unit=True)),
        "radius_m": lambda radius_m: radius_m * scale,
        "world_from_environment": rotated,
    }
    changes = {name: move(getattr(light, name)) for name, move in moves.items() if hasattr(light, name)}
    return located_light(light.model_copy(update=changes), asset_id)


def located_light(light: Light, asset_id: str) -> Light:
    """Return the light, with its image, if any, attributed to the package ``asset_id``."""
    if isinstance(light, EnvironmentLight) and light.image is not None and light.asset is None:
        return light.model_copy(update={"asset": asset_id})
    return light


def scaled(light: Light, gain: float, tint: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Light:
    """Multiply a light's power by ``gain`` and, except for skies and environments, by ``tint`` (RGB)."""

    def times(color: tuple[float, float, float]) -> tuple[float, float, float]:
        red, green, blue = (quantized(gain * t * c, 6) for t, c in zip(tint, color, strict=True))
        return (red, green, blue)

    if isinstance(light, SkyLight | EnvironmentLight):
        names = ("sky_scale", "sun_scale") if isinstance(light, SkyLight) else ("scale",)
        return light.model_copy(update={name: quantized(gain * getattr(light, name), 6) for name in names})
    (name,) = type(light).model_fields.keys() & {"intensity", "irradiance", "radiance"}
    return light.model_copy(update={name: times(getattr(light, name))})

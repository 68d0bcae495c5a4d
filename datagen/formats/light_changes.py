# SPDX-License-Identifier: MIT
"""Transformation and scaling of lights of every kind."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from datagen.formats.base import quantized
from datagen.formats.lights import (
    AreaLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
    SkyLight,
    SphereLight,
    SpotLight,
)


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

    if isinstance(light, PointLight):
        return light.model_copy(update={"position_m": point(light.position_m)})
    if isinstance(light, SpotLight):
        changes = {"position_m": point(light.position_m), "direction": vector(light.direction, True)}
        return light.model_copy(update=changes)
    if isinstance(light, SphereLight):
        sphere = {"position_m": point(light.position_m), "radius_m": light.radius_m * scale}
        return light.model_copy(update=sphere)
    if isinstance(light, DirectionalLight):
        return light.model_copy(update={"direction": vector(light.direction, True)})
    if isinstance(light, AreaLight):
        edges = {"edge_u_m": vector(light.edge_u_m), "edge_v_m": vector(light.edge_v_m)}
        return light.model_copy(update={"origin_m": point(light.origin_m), **edges})
    if isinstance(light, SkyLight):
        return light.model_copy(update={"sun_direction": vector(light.sun_direction, True)})
    rotation = np.eye(4)
    rotation[:3, :3] = linear / scale
    world = rotation @ np.array(light.world_from_environment)
    rows = tuple(tuple(row) for row in world.tolist())
    changes_env: dict[str, Any] = {"world_from_environment": rows}
    if light.image is not None and light.asset is None:
        changes_env["asset"] = asset_id
    return light.model_copy(update=changes_env)


def scaled(light: Light, gain: float, tint: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Light:
    """Multiply a light's power by ``gain`` and, except for skies and environments, by ``tint`` (RGB)."""

    def times(color: tuple[float, float, float]) -> tuple[float, float, float]:
        red, green, blue = (quantized(gain * t * c, 6) for t, c in zip(tint, color, strict=True))
        return (red, green, blue)

    if isinstance(light, PointLight | SpotLight):
        return light.model_copy(update={"intensity": times(light.intensity)})
    if isinstance(light, DirectionalLight):
        return light.model_copy(update={"irradiance": times(light.irradiance)})
    if isinstance(light, SkyLight):
        fields = ("sky_scale", "sun_scale")
        return light.model_copy(update={name: quantized(gain * getattr(light, name), 6) for name in fields})
    if isinstance(light, EnvironmentLight):
        return light.model_copy(update={"scale": quantized(gain * light.scale, 6)})
    return light.model_copy(update={"radiance": times(light.radiance)})

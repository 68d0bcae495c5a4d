# SPDX-License-Identifier: MIT
"""Lights in the files of assets and configurations, in radiometric units and linear Rec.709.

Positions are in metres, in the asset's frame or, in a configuration, in the world. A ``direction`` is the
unit vector along which light travels, away from the emitter.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from datagen.formats.base import (
    IDENTITY4,
    Matrix4,
    NonNegative,
    Positive,
    Radiometric3,
    RelativePath,
    Slug,
    StrictModel,
    Vector3,
    quantized,
)
from datagen.foundation.axes import affine


class PointLight(StrictModel):
    """Isotropic point light; ``intensity`` is in W/sr."""

    type: Literal["point"] = "point"
    name: str
    position_m: Vector3
    intensity: Radiometric3


class SpotLight(StrictModel):
    """Spotlight; ``intensity`` is in W/sr.

    It is constant inside ``beam_width_rad`` and falls to 0 at ``cutoff_rad``, both measured from the axis.
    """

    type: Literal["spot"] = "spot"
    name: str
    position_m: Vector3
    direction: Vector3
    intensity: Radiometric3
    cutoff_rad: Annotated[float, Field(gt=0, lt=1.5707963267948966)]
    beam_width_rad: NonNegative


class DirectionalLight(StrictModel):
    """Sunlight of ``irradiance`` in W/m^2 on a plane perpendicular to ``direction``.

    ``angular_diameter_rad``: diameter of the sun's disk; 0 produces sharp shadows.
    """

    type: Literal["directional"] = "directional"
    name: str
    direction: Vector3
    irradiance: Radiometric3
    angular_diameter_rad: Annotated[float, Field(ge=0, le=1.0)] = 0.0


class AreaLight(StrictModel):
    """Flat one-sided emitter of constant ``radiance`` in W/(m^2 sr).

    The rectangle spans ``origin_m + s edge_u_m + t edge_v_m``, s and t in [0, 1], and emits along
    edge_u x edge_v; ``shape: disk`` is the inscribed ellipse. Visible to the camera only if ``is_visible``.
    """

    type: Literal["area"] = "area"
    name: str
    origin_m: Vector3
    edge_u_m: Vector3
    edge_v_m: Vector3
    radiance: Radiometric3
    shape: Literal["rectangle", "disk"] = "rectangle"
    is_visible: bool = True


class SphereLight(StrictModel):
    """Sphere that emits constant ``radiance`` in W/(m^2 sr)."""

    type: Literal["sphere"] = "sphere"
    name: str
    position_m: Vector3
    radius_m: Positive
    radiance: Radiometric3


class EnvironmentLight(StrictModel):
    """Light from infinity: constant ``radiance`` or, if given, an equirectangular image, times ``scale``.

    ``image``: linear Rec.709 EXR, relative to the asset package ``asset`` (None: the package that contains
    this light). Its centre column faces +Y of the environment frame and its top row +Z;
    ``world_from_environment`` rotates it.
    """

    type: Literal["environment"] = "environment"
    name: str
    radiance: Radiometric3 = (1.0, 1.0, 1.0)
    image: RelativePath | None = None
    asset: Slug | None = None
    scale: NonNegative = 1.0
    world_from_environment: Matrix4 = IDENTITY4


class SkyLight(StrictModel):
    """Daylight computed by Mitsuba's ``sunsky``, without an image file.

    ``sun_direction`` points towards the sun. The scales multiply the model's physical radiances.
    """

    type: Literal["sky"] = "sky"
    name: str
    sun_direction: Vector3
    turbidity: Annotated[float, Field(ge=1, le=10)] = 3.0
    ground_albedo: Annotated[float, Field(ge=0, le=1)] = 0.3
    sky_scale: NonNegative = 1.0
    sun_scale: NonNegative = 1.0


Light = Annotated[
    PointLight | SpotLight | DirectionalLight | AreaLight | SphereLight | EnvironmentLight | SkyLight,
    Field(discriminator="type"),
]


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
    """Return the light; an image without a package is attributed to the package ``asset_id``."""
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

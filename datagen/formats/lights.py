# SPDX-License-Identifier: MIT
"""Lights as data, in assets and in configurations. Radiometric units, linear Rec.709.

Positions are metres in the frame of the containing file (asset or world); directions are unit vectors along
which light travels, away from the emitter.
"""

from __future__ import annotations

from typing import Annotated, Literal

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
)


class PointLight(StrictModel):
    """Isotropic point light; ``intensity`` is in W/sr."""

    type: Literal["point"] = "point"
    name: str
    position_m: Vector3
    intensity: Radiometric3


class SpotLight(StrictModel):
    """Spotlight; ``intensity`` is in W/sr, constant inside ``beam_width_rad`` and 0 outside ``cutoff_rad``.

    Both angles are measured from the axis.
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

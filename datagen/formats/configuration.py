# SPDX-License-Identifier: MIT
"""Configurations: one room with objects, materials, lights and cameras, ready to render, as readable JSON.

A configuration names every asset by id and content hash and contains all decisions: the renderer makes no
random choice of content. A configuration is a pure function of (recipe, index, library).
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from datagen.formats.asset import EnvironmentAsset, PinholeFields, lens_of
from datagen.formats.base import (
    IDENTITY4,
    ClipRange,
    Matrix4,
    NonNegative,
    Positive,
    Radiometric3,
    Slug,
    StrictModel,
    Unit,
    check_unique,
)
from datagen.formats.lights import Light, located_light
from datagen.formats.package import Package
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import input_error

Split = Literal["train", "validation", "test"]


class ColorAdjustment(StrictModel):
    """Variation of a material: D and S change in linear HSV, ``roughness_offset`` is added to R.

    ``hue_shift`` is in turns (1 = 360 degrees); ``saturation_scale`` and ``value_scale`` are factors. S
    changes only where it is coloured (metals); its HSV value is never scaled. Results are clamped to [0, 1].
    """

    hue_shift: Annotated[float, Field(ge=-1, le=1)] = 0.0
    saturation_scale: Annotated[float, Field(ge=0, le=4)] = 1.0
    value_scale: Annotated[float, Field(ge=0, le=4)] = 1.0
    roughness_offset: Annotated[float, Field(ge=-1, le=1)] = 0.0


class MaterialAssignment(StrictModel):
    """The material assigned to a slot of a placed asset.

    ``asset`` is the id of a material package, or None for the asset's own material. ``uv_scale`` multiplies
    the part's UVs; None: computed from the part's ``uv_per_m`` and the material's ``tile_size_m``.
    """

    asset: Slug | None = None
    uv_scale: Positive | None = None
    adjustment: ColorAdjustment = ColorAdjustment()


class PlacedAsset(StrictModel):
    """An environment or object in the world; ``name`` is unique in the configuration.

    ``world_from_asset`` contains scale, yaw and position. ``materials`` maps slots to assignments; all other
    slots keep the asset's material. ``emission`` replaces the radiance of emissive slots; (0, 0, 0) switches
    a slot off. ``support``: name of the support surface on which an object stands.
    """

    name: str
    asset: Slug
    world_from_asset: Matrix4 = IDENTITY4
    materials: dict[str, MaterialAssignment] = {}
    emission: dict[str, Radiometric3] = {}
    support: str | None = None


class ViewCamera(PinholeFields):
    """A camera in world space (conventions: ``datagen.foundation.cameras``)."""

    name: Slug
    world_from_camera: Matrix4
    clip_m: ClipRange = None

    def camera(self) -> Camera:
        pose = np.array(self.world_from_camera, dtype=np.float64)
        return Camera(**lens_of(self), world_from_camera=pose, clip_m=self.clip_m)

    @classmethod
    def from_camera(cls, name: str, camera: Camera) -> ViewCamera:
        rows = tuple(tuple(float(x) for x in row) for row in camera.world_from_camera)
        return cls(
            name=name,
            **lens_of(camera),
            world_from_camera=rows,  # type: ignore[arg-type]
            clip_m=camera.clip_m,
        )


METAL_SPECULAR, GLOSSY_ROUGHNESS = 0.3, 0.3
"""S (largest channel) above which a surface pixel counts as metal, and R below which it counts as glossy."""
MIN_METAL_SHARE, MIN_GLOSS_SHARE = 0.06, 0.15
"""Minimum shares of metal and of glossy surface pixels in a dataset for training."""


class ViewCoverage(StrictModel):
    """Summary of the views' content, from rays at low resolution.

    ``median_observations``: median, over the surface points hit, of the number of views that show the point;
    ``thin_share``: share of the points visible in two views or fewer. ``room_share``: share of the views that
    show two walls, or a wall and the ceiling. ``metal_share`` and ``gloss_share``: shares of the surface
    pixels on metal and on glossy materials, by the materials' mean S and R.
    """

    median_observations: NonNegative
    thin_share: Unit
    room_share: Unit
    metal_share: Unit
    gloss_share: Unit


class Configuration(StrictModel):
    """Complete input of rendering. ``lights`` lists all lights except emissive parts.

    ``assets`` maps every used asset id (environment, objects, materials, images of lights) to the SHA-256 of
    its package; rendering refuses a library whose packages differ. ``rejections`` counts rejected candidate
    placements and cameras by stage and reason (``camera.too_close``). ``coverage`` summarises the content of
    the views; None if the configuration was not planned from a recipe. ``seed`` seeds the renderer's sampler.
    """

    format: Literal["scene-materials/configuration"] = "scene-materials/configuration"
    version: Literal[1] = 1
    id: Slug
    index: Annotated[int, Field(ge=0)]
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    split: Split = "train"
    environment: PlacedAsset
    objects: tuple[PlacedAsset, ...] = ()
    lights: tuple[Light, ...] = ()
    cameras: Annotated[tuple[ViewCamera, ...], Field(min_length=1)]
    assets: dict[Slug, str]
    rejections: dict[str, int] = {}
    coverage: ViewCoverage | None = None

    @model_validator(mode="after")
    def _names_are_unique(self) -> Configuration:
        check_unique("placed assets", (self.environment, *self.objects))
        check_unique("the cameras", self.cameras)
        return self


def configuration_of(package: Package, seed: int = 0) -> Configuration:
    """Return a configuration of a single environment with its own materials, lights and cameras.

    Cameras are named ``view_000``, ``view_001``... Raises :class:`InputError` for an asset without cameras.
    """
    asset = package.asset
    if not isinstance(asset, EnvironmentAsset) or not asset.cameras:
        expected = "an environment with at least one camera"
        raise input_error(package.path, "kind", asset.kind, expected, "add a camera and export again")
    return Configuration(
        id=asset.id,
        index=0,
        seed=seed,
        environment=PlacedAsset(name="environment", asset=asset.id),
        lights=tuple(located_light(light, asset.id) for light in asset.lights),
        cameras=tuple(
            ViewCamera.from_camera(f"view_{index:03d}", camera.camera())
            for index, camera in enumerate(asset.cameras)
        ),
        assets={asset.id: package.sha256},
    )

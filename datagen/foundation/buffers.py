# SPDX-License-Identifier: MIT
"""The registry of buffers, the per-pixel quantities of a view, by name.

Renderer, shards, loader, validator and viewer use this table. Arrays are (H, W, C) with C channels, row 0 at
the top of the image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

PixelType = Literal["half", "float", "uint"]
Stage = Literal["radiance", "ground_truth", "statistics"]


class MaterialMaps(NamedTuple):
    """Names of the buffers and material channels of D, S and R, in this order everywhere."""

    diffuse_albedo: str
    specular_albedo: str
    roughness: str


MATERIAL_MAPS = MaterialMaps("diffuse_albedo", "specular_albedo", "roughness")


_RGB = ("R", "G", "B")
_HALF_MAX = 65504.0
_RADIANCE = "W/(m^2 sr), scene-linear"


@dataclass(frozen=True)
class Buffer:
    """Definition of a buffer; ``minimum`` and ``maximum`` bound its valid values, inclusively.

    ``channels``: suffixes of its EXR channels. Pixels without the quantity (background, emitters) contain 0.
    ``stage``: origin of the values: path tracing, ground truth at the first hit, or statistics over views.
    ``is_optional``: the buffer may be missing from a view.
    """

    name: str
    description: str
    channels: tuple[str, ...] = _RGB
    unit: str = "1"
    maximum: float = 1.0
    minimum: float = 0.0
    pixel_type: PixelType = "half"
    stage: Stage = "ground_truth"
    is_optional: bool = False

    @property
    def num_channels(self) -> int:
        return len(self.channels)

    @property
    def dtype(self) -> np.dtype[Any]:
        """NumPy dtype of the stored array."""
        return np.dtype({"half": np.float16, "float": np.float32, "uint": np.uint32}[self.pixel_type])

    @property
    def exr_channels(self) -> tuple[str, ...]:
        """Full EXR channel names, in the order of the array's last axis."""
        if self.name == "beauty":
            return self.channels
        return tuple(f"{self.name}.{channel}" for channel in self.channels)


def _color(name: str, stage: Stage, description: str, is_optional: bool = False) -> Buffer:
    return Buffer(name, description, _RGB, _RADIANCE, _HALF_MAX, stage=stage, is_optional=is_optional)


def _id(name: str, of: str) -> Buffer:
    description = f"{of} through the pixel's centre; 0 = none; names are in the view's JSON"
    return Buffer(name, description, ("I",), "id", 2**32 - 1, pixel_type="uint")


_ALL = (
    _color("beauty", "radiance", "rendered image, denoised if the recipe enables it"),
    _color("beauty_noisy", "radiance", "the same image before the denoiser (only with keep_noisy)", True),
    Buffer(MATERIAL_MAPS.diffuse_albedo, "diffuse albedo D at the first hit"),
    Buffer(MATERIAL_MAPS.specular_albedo, "specular albedo S (F0) at the first hit"),
    Buffer(
        MATERIAL_MAPS.roughness,
        "perceptual roughness R at the first hit; alpha = R^2",
        ("Y",),
        "1 (perceptual)",
    ),
    Buffer(
        "normal_world",
        "shading normal in world space, facing the camera",
        ("X", "Y", "Z"),
        "1 (unit vector)",
        minimum=-1.0,
    ),
    Buffer(
        "depth_z_m",
        "depth along the optical axis through the pixel's centre; 0 where nothing was hit",
        ("Z",),
        "m",
        1e6,
        pixel_type="float",
    ),
    Buffer(
        "surface_mask",
        "share of the pixel covered by reflecting surface; emitters and background do not count",
        ("Y",),
    ),
    _id("instance_id", "object instance"),
    _id("material_id", "material"),
    _color("color_min", "statistics", "per-channel minimum of the point's colours in the chosen views"),
    _color("color_median", "statistics", "per-channel median of the point's colours in the chosen views"),
    _color("color_max", "statistics", "per-channel maximum of the point's colours in the chosen views"),
    Buffer(
        "observation_count",
        "number of views whose colours entered the statistics; 0 on the background",
        ("N",),
        "views",
        2048,
        stage="statistics",
    ),
    Buffer(
        "reflectance",
        "pi times color_median over the irradiance that the views record; 0 where too little light arrives",
        maximum=_HALF_MAX,
        stage="statistics",
        is_optional=True,
    ),
    Buffer(
        "known_share",
        "share of the cosine-weighted hemisphere whose radiance the views record",
        ("Y",),
        stage="statistics",
        is_optional=True,
    ),
    _color("mirror_sharp", "statistics", "radiance that a surface of S = 1 and R = 0.2 would reflect", True),
    _color("mirror_broad", "statistics", "radiance that a surface of S = 1 and R = 0.5 would reflect", True),
)

BUFFERS: dict[str, Buffer] = {buffer.name: buffer for buffer in _ALL}


def _names(*stages: Stage, is_optional: bool = False) -> tuple[str, ...]:
    return tuple(b.name for b in _ALL if b.stage in stages and b.is_optional == is_optional)


GROUND_TRUTH_BUFFERS = _names("ground_truth")
RENDERED_BUFFERS = _names("radiance", "ground_truth")
STATISTICS_BUFFERS = _names("statistics")
VIEW_BUFFERS = RENDERED_BUFFERS + STATISTICS_BUFFERS
"""Buffers of a complete view; ``beauty_noisy`` and :data:`LIGHT_BUFFERS` are optional."""
LIGHT_BUFFERS = _names("statistics", is_optional=True)
"""Buffers of the light recorded by a configuration's views, enabled by the recipe's ``statistics.light``."""
MIRROR_ROUGHNESS = {"mirror_sharp": 0.2, "mirror_broad": 0.5}
"""Roughness R of the hypothetical surface (S = 1) whose reflected radiance each buffer contains."""
MIN_COVERAGE = 0.5
"""Minimum ``surface_mask`` of a surface pixel; below it, emitters or background dominate the colour."""


def get_buffer(name: str) -> Buffer:
    """Return the buffer ``name``. Raises a ``KeyError`` that lists the known names if there is none."""
    try:
        return BUFFERS[name]
    except KeyError:
        raise KeyError(f"unknown buffer {name!r}; known: {', '.join(BUFFERS)}") from None


def split_channels(values: NDArray[Any], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Split ``values`` (..., C) into array views by buffer; C is the sum of the buffers' channel counts."""
    ends = np.cumsum([get_buffer(name).num_channels for name in names])
    assert values.shape[-1] == ends[-1], (values.shape, names)
    return dict(zip(names, np.split(values, ends[:-1], axis=-1), strict=True))


def surface_pixels(view: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Return the mask (H, W) of a view's surface pixels, from its buffers (H, W, C) by name.

    Surface pixels have ``depth_z_m`` > 0 and ``surface_mask`` >= :data:`MIN_COVERAGE`, if these are present.
    """
    shape = next(iter(view.values())).shape[:2]
    mask = np.ones(shape, dtype=bool)
    if "depth_z_m" in view:
        mask &= view["depth_z_m"][..., 0] > 0
    if "surface_mask" in view:
        mask &= view["surface_mask"][..., 0] >= MIN_COVERAGE
    return mask

# SPDX-License-Identifier: MIT
"""The registry of buffers: every per-pixel quantity of a view, looked up by name, never by index.

Renderer, shards, loader, validator and viewer all use this one table. Arrays are (H, W, C) with C the number
of channels, row 0 at the top of the image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

PixelType = Literal["half", "float", "uint"]
ColorSpace = Literal["linear_rec709", "data"]
Stage = Literal["radiance", "ground_truth", "statistics"]


class MaterialMaps(NamedTuple):
    """Names of the buffers and material channels of D, S and R, in this order everywhere."""

    diffuse_albedo: str
    specular_albedo: str
    roughness: str


MATERIAL_MAPS = MaterialMaps("diffuse_albedo", "specular_albedo", "roughness")


@dataclass(frozen=True)
class Buffer:
    """One buffer: its name, EXR channel suffixes, storage type, unit, closed valid range and fill value.

    ``invalid`` fills pixels in which the quantity does not exist (background, emitters). ``stage`` is its
    origin: path tracing, the ground truth of the first hit, or statistics over views. ``is_optional``: views
    may lack it.
    """

    name: str
    channels: tuple[str, ...]
    pixel_type: PixelType
    unit: str
    minimum: float
    maximum: float
    color_space: ColorSpace
    invalid: float
    description: str
    stage: Stage = "ground_truth"
    is_optional: bool = False

    @property
    def num_channels(self) -> int:
        return len(self.channels)

    @property
    def dtype(self) -> np.dtype[Any]:
        """NumPy dtype as stored."""
        return np.dtype({"half": np.float16, "float": np.float32, "uint": np.uint32}[self.pixel_type])

    @property
    def exr_channels(self) -> tuple[str, ...]:
        """Full EXR channel names, in the order of the array's last axis."""
        if self.name == "beauty":
            return self.channels
        return tuple(f"{self.name}.{channel}" for channel in self.channels)


_RGB = ("R", "G", "B")
_HALF_MAX = 65504.0
_RADIANCE = "W/(m^2 sr), scene-linear"


def _color(name: str, stage: Stage, description: str, is_optional: bool = False) -> Buffer:
    return Buffer(
        name, _RGB, "half", _RADIANCE, 0.0, _HALF_MAX, "linear_rec709", 0.0, description, stage, is_optional
    )


def _albedo(name: str, description: str) -> Buffer:
    return Buffer(name, _RGB, "half", "1", 0.0, 1.0, "linear_rec709", 0.0, description)


def _id(name: str, of: str) -> Buffer:
    description = f"{of} through the pixel's centre; 0 = none; names are in the view's JSON"
    return Buffer(name, ("I",), "uint", "id", 0, 2**32 - 1, "data", 0, description)


_ALL = (
    _color("beauty", "radiance", "rendered image, denoised if the recipe enables it"),
    _color("beauty_noisy", "radiance", "the same image before the denoiser (only with keep_noisy)", True),
    _albedo(MATERIAL_MAPS.diffuse_albedo, "diffuse albedo D at the first hit"),
    _albedo(MATERIAL_MAPS.specular_albedo, "specular albedo S (F0) at the first hit"),
    Buffer(
        MATERIAL_MAPS.roughness,
        ("Y",),
        "half",
        "1 (perceptual)",
        0.0,
        1.0,
        "data",
        0.0,
        "perceptual roughness R at the first hit; alpha = R^2",
    ),
    Buffer(
        "normal_world",
        ("X", "Y", "Z"),
        "half",
        "1 (unit vector)",
        -1.0,
        1.0,
        "data",
        0.0,
        "shading normal in world space, facing the camera",
    ),
    Buffer(
        "depth_z_m",
        ("Z",),
        "float",
        "m",
        0.0,
        1e6,
        "data",
        0.0,
        "depth along the optical axis through the pixel's centre; 0 where nothing was hit",
    ),
    Buffer(
        "surface_mask",
        ("Y",),
        "half",
        "1",
        0.0,
        1.0,
        "data",
        0.0,
        "share of the pixel covered by reflecting surface; emitters and background do not count",
    ),
    _id("instance_id", "object instance"),
    _id("material_id", "material"),
    _color("color_min", "statistics", "per-channel minimum of the colours seen by the chosen views"),
    _color("color_median", "statistics", "per-channel median of the colours seen by the chosen views"),
    _color("color_max", "statistics", "per-channel maximum of the colours seen by the chosen views"),
    Buffer(
        "observation_count",
        ("N",),
        "half",
        "views",
        0,
        2048,
        "data",
        0,
        "number of views whose colours entered the statistics; 0 on the background",
        "statistics",
    ),
    Buffer(
        "reflectance",
        _RGB,
        "half",
        "1",
        0.0,
        _HALF_MAX,
        "linear_rec709",
        0.0,
        "pi times color_median over the irradiance that the views record; 0 where too little light arrives",
        "statistics",
        True,
    ),
    Buffer(
        "known_share",
        ("Y",),
        "half",
        "1",
        0.0,
        1.0,
        "data",
        0.0,
        "share of the cosine-weighted hemisphere whose radiance the views record",
        "statistics",
        True,
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
"""Buffers of the light that a configuration's views record, enabled by ``statistics.light`` of the recipe."""
MIRROR_ROUGHNESS = {"mirror_sharp": 0.2, "mirror_broad": 0.5}
"""R of the hypothetical surface whose reflected radiance a buffer stores."""
MIN_COVERAGE = 0.5
"""Minimum ``surface_mask`` of a surface pixel; below it, most of the colour is not the surface's."""


def get_buffer(name: str) -> Buffer:
    """The buffer registered as ``name``. Raises ``KeyError`` with the known names."""
    try:
        return BUFFERS[name]
    except KeyError:
        raise KeyError(f"unknown buffer {name!r}; known: {', '.join(BUFFERS)}") from None


def split_channels(values: NDArray[Any], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Views into ``values`` (..., C) by buffer; C is the sum of the buffers' numbers of channels."""
    ends = np.cumsum([get_buffer(name).num_channels for name in names])
    assert values.shape[-1] == ends[-1], (values.shape, names)
    return dict(zip(names, np.split(values, ends[:-1], axis=-1), strict=True))


def surface_pixels(view: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Mask (H, W): True where ``depth_z_m`` and ``surface_mask``, if present, indicate a surface."""
    shape = next(iter(view.values())).shape[:2]
    mask = np.ones(shape, dtype=bool)
    if "depth_z_m" in view:
        mask &= view["depth_z_m"][..., 0] > 0
    if "surface_mask" in view:
        mask &= view["surface_mask"][..., 0] >= MIN_COVERAGE
    return mask

# SPDX-License-Identifier: MIT
"""The registry of buffers: every per-pixel quantity a view can hold, looked up by name, never by index.

Renderer, shards, loader, validator and viewer all read this one table. Arrays are (H, W, C) with C the number
of channels, row 0 at the top of the image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

PixelType = Literal["half", "float", "uint"]
ColorSpace = Literal["linear_rec709", "data"]


@dataclass(frozen=True)
class Buffer:
    """One buffer: its name, EXR channel suffixes, storage type, unit, closed valid range and fill value.

    ``invalid`` is what a pixel holds where the quantity does not exist (background, emitters).
    ``layer`` is the EXR layer; "" stores plain R, G, B, the default image of any viewer.
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
    is_ground_truth: bool = False

    @property
    def num_channels(self) -> int:
        return len(self.channels)

    @property
    def dtype(self) -> np.dtype:
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


def _radiance(name: str, description: str) -> Buffer:
    return Buffer(name, _RGB, "half", _RADIANCE, 0.0, _HALF_MAX, "linear_rec709", 0.0, description)


_ALL = (
    _radiance("beauty", "rendered image, denoised where the recipe asks for it"),
    _radiance("beauty_noisy", "the same image before the denoiser (kept only if asked for)"),
    Buffer(
        "diffuse_albedo",
        _RGB,
        "half",
        "1",
        0.0,
        1.0,
        "linear_rec709",
        0.0,
        "diffuse albedo D at the first hit",
        True,
    ),
    Buffer(
        "specular_albedo",
        _RGB,
        "half",
        "1",
        0.0,
        1.0,
        "linear_rec709",
        0.0,
        "specular albedo S (F0) at the first hit",
        True,
    ),
    Buffer(
        "roughness",
        ("Y",),
        "half",
        "1 (perceptual)",
        0.0,
        1.0,
        "data",
        0.0,
        "perceptual roughness R at the first hit; alpha = R^2",
        True,
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
        True,
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
        True,
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
        True,
    ),
    Buffer(
        "instance_id",
        ("I",),
        "uint",
        "id",
        0,
        2**32 - 1,
        "data",
        0,
        "object instance through the pixel's centre; 0 = none; names are in the view's JSON",
        True,
    ),
    Buffer(
        "material_id",
        ("I",),
        "uint",
        "id",
        0,
        2**32 - 1,
        "data",
        0,
        "material through the pixel's centre; 0 = none; names are in the view's JSON",
        True,
    ),
    _radiance("color_min", "per-channel minimum of the colours seen by the chosen views"),
    _radiance("color_median", "per-channel median of the colours seen by the chosen views"),
    _radiance("color_max", "per-channel maximum of the colours seen by the chosen views"),
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
    ),
)

BUFFERS: dict[str, Buffer] = {buffer.name: buffer for buffer in _ALL}
RENDERED_BUFFERS = tuple(b.name for b in _ALL[:10] if b.name != "beauty_noisy")
STATISTICS_BUFFERS = ("color_min", "color_median", "color_max", "observation_count")
VIEW_BUFFERS = RENDERED_BUFFERS + STATISTICS_BUFFERS
"""What a complete view holds; ``beauty_noisy`` is optional."""
MIN_COVERAGE = 0.5
"""Least ``surface_mask`` of a pixel that counts as surface; below, its colour is mostly something else's."""


def get_buffer(name: str) -> Buffer:
    """The registered buffer of that name; ``KeyError`` names the known ones."""
    try:
        return BUFFERS[name]
    except KeyError:
        raise KeyError(f"unknown buffer {name!r}; known: {', '.join(BUFFERS)}") from None


def surface_pixels(view: Mapping[str, NDArray]) -> NDArray[np.bool_]:
    """Mask (H, W) of the pixels that are counted."""
    shape = next(iter(view.values())).shape[:2]
    mask = np.ones(shape, dtype=bool)
    if "depth_z_m" in view:
        mask &= view["depth_z_m"][..., 0] > 0
    if "surface_mask" in view:
        mask &= view["surface_mask"][..., 0] >= MIN_COVERAGE
    return mask

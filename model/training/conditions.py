# SPDX-License-Identifier: MIT
"""Random viewing and lighting conditions of the rendering loss, drawn from seeded generators.

Maps are (B, C, H, W). Positions and normals are in camera space (metres; x right, y down, z forward; the
camera at the origin), so a pixel's original view direction is -position/|position|. Every draw is made per
image of the batch on the CPU, so the conditions of a seed are the same on every device.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from model.shading import SphericalGaussians, dot, normalize, sg_integral

VIEW_DISC_RADIUS2 = 0.9
"""Squared radius of the disc from which view directions are drawn, up to 71.6 degrees off the original."""
LIGHT_DISTANCE_LOG_MEAN, LIGHT_DISTANCE_LOG_STD = 0.5, 0.75
NUM_SG_LIGHTS = 5
SG_SHARPNESS_RANGE = (2.0, 200.0)


@dataclass(frozen=True)
class Geometry:
    """Geometry of crops in camera space: ``position`` in metres and unit ``normal`` (B, 3, H, W), ``mask``
    (B, 1, H, W) bool. Where ``mask`` is False there is no surface and the normal is zero.
    """

    position: Tensor
    normal: Tensor
    mask: Tensor


@dataclass(frozen=True)
class PointCondition:
    """A viewing direction per pixel, ``view_dir`` (B, 3, H, W), and a point light per image, at
    ``light_position`` (B, 3, 1, 1) in metres, of ``intensity`` (B, 1, 1, 1) in W/sr.
    """

    view_dir: Tensor
    light_position: Tensor
    intensity: Tensor


@dataclass(frozen=True)
class AreaCondition:
    """A viewing direction per pixel, ``view_dir`` (B, 3, H, W), and distant area lights per image."""

    view_dir: Tensor
    lights: SphericalGaussians


class SampleDraws:
    """Random numbers of a batch, with a separate stream for each image.

    An image's conditions thus depend only on the run's seed and the image's sample id: two processes with
    half a batch each draw the same numbers as one process with the whole batch.
    """

    def __init__(self, generators: Sequence[torch.Generator]):
        self._generators = list(generators)

    @classmethod
    def for_samples(cls, seed: int, sample_ids: Iterable[int]) -> SampleDraws:
        """Create the streams of the images with ids ``sample_ids`` in a run with ``seed``."""
        return cls([generator_for(seed, _CONDITION_PURPOSE, int(i)) for i in sample_ids])

    def uniform(self, *shape: int) -> Tensor:
        """Uniform numbers (B, *shape) in [0, 1), float32 on the CPU."""
        return torch.stack([torch.rand(shape, generator=g) for g in self._generators])

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers (B, *shape), float32 on the CPU."""
        return torch.stack([torch.randn(shape, generator=g) for g in self._generators])


_CONDITION_PURPOSE = 0xC0


def generator_for(*key: int) -> torch.Generator:
    """CPU generator seeded by a hash of ``key``, e.g. (seed, purpose, step, rank)."""
    state = 0x9E3779B97F4A7C15
    for part in key:  # splitmix64 of the running state: neighbouring keys have unrelated seeds
        state = (state ^ (part & 0xFFFFFFFFFFFFFFFF)) & 0xFFFFFFFFFFFFFFFF
        state = (state + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
        state ^= state >> 31
    generator = torch.Generator(device="cpu")
    generator.manual_seed(state >> 1)
    return generator


def scene_scale(geometry: Geometry) -> Tensor:
    """Unit of light distances (B, 1, 1, 1) in metres; 1.0 for a crop without a surface.

    Deschaintre et al. define light distances for a patch on [-1, 1]^2, whose root-mean-square distance from
    its centre is sqrt(2/3); the unit scales this to the root-mean-square distance of the crop's points.
    """
    mask = geometry.mask.to(geometry.position.dtype)
    count = mask.sum(dim=(2, 3), keepdim=True)
    mean = (geometry.position * mask).sum(dim=(2, 3), keepdim=True) / count.clamp_min(1.0)
    offset = (geometry.position - mean) * mask
    spread2 = dot(offset, offset).sum(dim=(2, 3), keepdim=True) / count.clamp_min(1.0)
    return torch.where(spread2 > 1e-12, torch.sqrt(1.5 * spread2.clamp_min(1e-12)), torch.ones_like(spread2))


def sample_views(geometry: Geometry, draws: SampleDraws) -> Tensor:
    """Draw a viewing direction per pixel (B, 3, H, W), cosine-weighted about the original directions.

    One point of a disc is drawn per image and applied in each pixel's frame, spanned by the original
    direction and the camera's x axis, so the directions vary smoothly over the image, as from one camera.
    """
    original = normalize(-geometry.position)
    uv = draws.uniform(2).to(original)
    radius2 = VIEW_DISC_RADIUS2 * uv[:, 0].reshape(-1, 1, 1, 1)
    phi = 2.0 * math.pi * uv[:, 1].reshape(-1, 1, 1, 1)
    radius = torch.sqrt(radius2)
    x_axis = torch.zeros_like(original)
    x_axis[:, 0] = 1.0
    tangent = normalize(x_axis - dot(x_axis, original) * original)
    bitangent = torch.linalg.cross(original, tangent, dim=1)
    view = tangent * (radius * torch.cos(phi)) + bitangent * (radius * torch.sin(phi))
    return normalize(view + original * torch.sqrt(1.0 - radius2))


def _anchor_pixels(geometry: Geometry, draws: SampleDraws) -> Tensor:
    """Flat index (B,) of a random pixel with a surface in each image; the last pixel if there is none."""
    weights = geometry.mask.flatten(1).to("cpu", torch.float32)
    u = draws.uniform(1)
    cumulative = weights.cumsum(dim=1)
    target = u * cumulative[:, -1:]
    index = torch.searchsorted(cumulative, target, right=True).clamp_max(weights.shape[1] - 1)
    return index[:, 0].to(geometry.position.device)


def _pick(image: Tensor, index: Tensor) -> Tensor:
    """Values (B, C, 1, 1) of ``image`` (B, C, H, W) at flat pixel indices (B,)."""
    flat = image.flatten(2)
    picked = flat.gather(2, index.reshape(-1, 1, 1).expand(-1, flat.shape[1], 1))
    return picked.unsqueeze(-1)


def sample_point_condition(geometry: Geometry, draws: SampleDraws) -> PointCondition:
    """Draw viewing directions, and a point light in the mirror direction at a random pixel, the anchor.

    The light's distance from the anchor is exp(N(0.5, 0.75)) times :func:`scene_scale`. Its intensity is
    such that a white Lambertian surface at the anchor, facing the light, has radiance 1 at any distance.
    """
    view_dir = sample_views(geometry, draws)
    anchor = _anchor_pixels(geometry, draws)
    point, normal, view = (_pick(m, anchor) for m in (geometry.position, geometry.normal, view_dir))
    cos_o = dot(normal, view)
    mirror = normalize(2.0 * cos_o * normal - view)
    # a view below the anchor's horizon would put the light behind the surface: use the normal instead
    direction = torch.where(cos_o > 0, mirror, normal)
    spread = draws.normal(1)[:, 0].to(point)
    log_distance = LIGHT_DISTANCE_LOG_MEAN + LIGHT_DISTANCE_LOG_STD * spread
    distance = torch.exp(log_distance).reshape(-1, 1, 1, 1) * scene_scale(geometry)
    return PointCondition(view_dir, point + distance * direction, math.pi * distance * distance)


def sample_area_condition(geometry: Geometry, draws: SampleDraws) -> AreaCondition:
    """Draw viewing directions, and 5 spherical Gaussians with axes uniform over the hemisphere z <= 0.

    Visible surfaces face the camera, so all lights are behind it. Sharpness is log-uniform between 2
    and 200, and colours are uniform; the sum of the lobes' integrals, averaged over channels, is pi.
    """
    view_dir = sample_views(geometry, draws)
    dtype, device = view_dir.dtype, view_dir.device
    u = draws.uniform(NUM_SG_LIGHTS, 6).double()
    cos_theta = u[..., 0]
    sin_theta = torch.sqrt((1.0 - cos_theta**2).clamp_min(0.0))
    phi = 2.0 * math.pi * u[..., 1]
    axis = torch.stack([sin_theta * torch.cos(phi), sin_theta * torch.sin(phi), -cos_theta], dim=-1)
    low, high = SG_SHARPNESS_RANGE
    sharpness = low * (high / low) ** u[..., 2]
    color = u[..., 3:6]
    energy = color / color.mean(dim=(1, 2), keepdim=True).clamp_min(1e-3) * (math.pi / NUM_SG_LIGHTS)
    amplitude = energy / sg_integral(sharpness).unsqueeze(-1)
    lights = SphericalGaussians(*(t.to(device=device, dtype=dtype) for t in (axis, sharpness, amplitude)))
    return AreaCondition(view_dir, lights)

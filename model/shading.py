# SPDX-License-Identifier: MIT
"""The material model in torch, and the lights used for rendering in training.

Notation: every map is a tensor (B, C, ...) with the channel or vector component on axis 1, for example (N, 3)
or (B, 3, H, W); arguments broadcast. D is ``diffuse_albedo``, S ``specular_albedo``, R ``roughness``
(perceptual), ``alpha`` = R^2, n the normal, o the direction to the viewer, i the direction to the light, h
their half vector. All directions point away from the surface and have unit length; the reflectance for a zero
vector (background) is 0. All vectors are in the same frame, which is arbitrary.

The BRDF follows Walter et al. 2007, with Beckmann's distribution, the exact separable Smith term and
Schlick's Fresnel term. Everything is differentiable, with finite gradients even at grazing angles and for
zero vectors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

ALPHA_MIN = 1e-3
"""Minimum of alpha: narrower lobes exceed the precision of float32 in the rendering loss."""

_SQRT_PI = math.sqrt(math.pi)
_TINY_SIN2 = 1e-12  # keeps the gradient of a square root finite for coincident directions
_TINY_COS2 = 1e-12  # keeps tan^2 finite at grazing half vectors, where the lobe is 0 in any case


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar product over axis 1, which is kept with length 1."""
    return (a * b).sum(dim=1, keepdim=True)


def normalize(vector: Tensor) -> Tensor:
    """Normalise vectors along axis 1; a zero vector stays zero and has a finite gradient."""
    return vector * torch.rsqrt(dot(vector, vector).clamp_min(1e-20))  # avoids 0/0 at a zero vector


def _cross(a: Tensor, b: Tensor) -> Tensor:
    a, b = torch.broadcast_tensors(a, b)
    return torch.linalg.cross(a, b, dim=1)


def alpha_from_roughness(roughness: Tensor) -> Tensor:
    """Beckmann slope width: R^2 clamped to [:data:`ALPHA_MIN`, 1]. All conversions use this function."""
    return (roughness * roughness).clamp(ALPHA_MIN, 1.0)


def beckmann_log_pdf(tan2_theta: Tensor, alpha: Tensor) -> Tensor:
    """Logarithm of Beckmann's distribution, exp(-tan^2/alpha^2) / (pi alpha^2 cos^4), at the angle theta."""
    return (
        -tan2_theta / (alpha * alpha)
        - math.log(math.pi)
        - 2.0 * torch.log(alpha)
        + 2.0 * torch.log1p(tan2_theta)
    )


def smith_g1_over_cos(cos_theta: Tensor, sin2_theta: Tensor, alpha: Tensor) -> Tensor:
    """Exact Smith G1 for Beckmann, divided by cos(theta) > 0; finite up to 90 degrees.

    G1 = 2 / (1 + erf(a) + exp(-a^2)/(a sqrt(pi))), a = cos/(alpha sin). The division by cos cancels the pole
    of 1/a, so that G1/cos tends to 2 sqrt(pi) / (alpha sin) at the horizon instead of 0/0.
    """
    sin_theta = torch.sqrt(sin2_theta.clamp_min(_TINY_SIN2))
    a = cos_theta / (alpha * sin_theta)
    shadowed = alpha * sin_theta * torch.exp(-a * a) / _SQRT_PI
    return 2.0 / (cos_theta * (1.0 + torch.erf(a)) + shadowed)


def schlick(specular_albedo: Tensor, cos_theta: Tensor) -> Tensor:
    """Schlick's Fresnel term F = S + (1 - S)(1 - cos)^5; ``cos_theta`` is clamped to [0, 1]."""
    m = (1.0 - cos_theta).clamp(0.0, 1.0)
    return specular_albedo + (1.0 - specular_albedo) * (m * m) ** 2 * m


def brdf_cos(
    diffuse_albedo: Tensor,
    specular_albedo: Tensor,
    roughness: Tensor,
    normal: Tensor,
    view_dir: Tensor,
    light_dir: Tensor,
) -> Tensor:
    """The BRDF times cos(theta_i), in 1/sr: (1-S) D/pi cos_i + F D_b G / (4 cos_o).

    D_b is Beckmann's distribution, G Smith's and F Schlick's term. Albedos and vectors are (B, 3, ...),
    ``roughness`` is (B, 1, ...). The result is 0 if the viewer or the light is at or below the horizon. tan^2
    of the half vector's angle is computed from n x h, since 1 - cos^2 would cancel.
    """
    cos_o, cos_i = dot(normal, view_dir), dot(normal, light_dir)
    is_lit = (cos_o > 0) & (cos_i > 0)
    cos_o = torch.where(is_lit, cos_o, torch.ones_like(cos_o))  # masked before divisions
    cos_i = torch.where(is_lit, cos_i, torch.ones_like(cos_i))
    tangent_o, tangent_i = _cross(normal, view_dir), _cross(normal, light_dir)
    tangent_h = tangent_o + tangent_i
    cos_h = cos_o + cos_i  # the half vector before normalisation: i + o
    tan2_h = dot(tangent_h, tangent_h) / (cos_h * cos_h).clamp_min(_TINY_COS2)
    alpha = alpha_from_roughness(roughness)
    half2 = dot(view_dir + light_dir, view_dir + light_dir)
    cos_d = 0.5 * torch.sqrt(half2.clamp_min(_TINY_SIN2))  # i.h = |i + o| / 2
    lobe = torch.exp(beckmann_log_pdf(tan2_h, alpha))
    lobe = lobe * smith_g1_over_cos(cos_o, dot(tangent_o, tangent_o), alpha)
    lobe = lobe * smith_g1_over_cos(cos_i, dot(tangent_i, tangent_i), alpha)
    specular = schlick(specular_albedo, cos_d) * (lobe * (0.25 * cos_i))
    diffuse = (1.0 - specular_albedo) * diffuse_albedo * (cos_i / math.pi)
    return torch.where(is_lit, diffuse + specular, torch.zeros_like(diffuse))


def shade_point_light(
    diffuse_albedo: Tensor,
    specular_albedo: Tensor,
    roughness: Tensor,
    normal: Tensor,
    view_dir: Tensor,
    position: Tensor,
    light_position: Tensor,
    intensity: Tensor,
) -> Tensor:
    """Reflected radiance (B, 3, ...) under an isotropic point light.

    ``position`` (B, 3, ...) and ``light_position`` are in metres, ``intensity`` in W/sr. Both light arguments
    broadcast against ``position``, e.g. (B, 3, 1, 1). Light falls off with the squared distance.
    """
    to_light = light_position - position
    distance2 = dot(to_light, to_light).clamp_min(1e-8)  # a light inside the surface would divide by 0
    light_dir = to_light * torch.rsqrt(distance2)
    reflected = brdf_cos(diffuse_albedo, specular_albedo, roughness, normal, view_dir, light_dir)
    return reflected * (intensity / distance2)


@dataclass(frozen=True)
class SphericalGaussians:
    """K lobes of radiance ``amplitude`` exp(``sharpness`` (``axis`` . w - 1)) over directions w.

    ``axis`` (B, K, 3) of unit length, ``sharpness`` (B, K), ``amplitude`` (B, K, 3) in W/(m^2 sr).
    """

    axis: Tensor
    sharpness: Tensor
    amplitude: Tensor


def sg_integral(sharpness: Tensor) -> Tensor:
    """Integral of a unit-amplitude spherical Gaussian: 2 pi (1 - exp(-2 l)) / l for sharpness l."""
    return -2.0 * math.pi * torch.expm1(-2.0 * sharpness) / sharpness


def sg_inner_product(sharpness1: Tensor, sharpness2: Tensor, axis_gap2: Tensor) -> Tensor:
    """Integral over the sphere of the product of two unit-amplitude spherical Gaussians.

    For sharpness l1, l2 and axes p1, p2, with ``axis_gap2`` = |p1 - p2|^2 in [0, 4] and u = |l1 p1 + l2 p2|:
    2 pi exp(-l1 l2 |p1-p2|^2 / (u + l1 + l2)) (-expm1(-2u)) / u, without cancellation or overflow.
    """
    total = sharpness1 + sharpness2
    product = sharpness1 * sharpness2 * axis_gap2
    # (l1 + l2)^2 - l1 l2 |p1-p2|^2; the floor keeps the square root differentiable for opposite equal lobes
    u = torch.sqrt((total * total - product).clamp_min(1e-8))
    return 2.0 * math.pi * torch.exp(-product / (u + total)) * (-torch.expm1(-2.0 * u)) / u


def sg_hemisphere_integral(sharpness: Tensor, cos_beta: Tensor) -> Tensor:
    """Integral of a unit-amplitude spherical Gaussian over a hemisphere; beta: angle between axis and pole.

    As in Meder and Bruederlin 2018, the integrals over the hemispheres around the axis and opposite to it are
    blended by a fitted sigmoid; expm1 avoids overflow.
    """
    lam = sharpness
    t = torch.sqrt(lam) * ((1.6988 * lam + 10.8438) * lam) / ((lam + 6.2201) * lam + 10.2415)
    x = t * cos_beta.clamp(-1.0, 1.0)
    blend = torch.expm1(-(t + x)) / torch.expm1(-t) * torch.sigmoid(x)
    upper = -2.0 * math.pi * torch.expm1(-lam) / lam
    return upper * (torch.exp(-lam) * (1.0 - blend) + blend)


_COSINE_SHARPNESS, _COSINE_AMPLITUDE, _COSINE_OFFSET = 0.0315, 32.7080, 31.7003


def sg_irradiance(sharpness: Tensor, cos_beta: Tensor) -> Tensor:
    """Irradiance due to a unit-amplitude spherical Gaussian whose axis is at the angle beta to the normal.

    As in Meder and Bruederlin 2018, the cosine is approximated by a spherical Gaussian minus a constant, so
    the irradiance is the difference of two hemisphere integrals. Cancellation loses 5 bits of precision.
    """
    gap2 = 2.0 - 2.0 * cos_beta
    total = sharpness + _COSINE_SHARPNESS
    product = sharpness * _COSINE_SHARPNESS * gap2
    u = torch.sqrt((total * total - product).clamp_min(1e-8))
    product_cos = (sharpness * cos_beta + _COSINE_SHARPNESS) / u
    with_cosine = torch.exp(-product / (u + total)) * sg_hemisphere_integral(u, product_cos)
    return (
        _COSINE_AMPLITUDE * with_cosine - _COSINE_OFFSET * sg_hemisphere_integral(sharpness, cos_beta)
    ).clamp_min(0.0)


def shade_spherical_gaussians(
    diffuse_albedo: Tensor,
    specular_albedo: Tensor,
    roughness: Tensor,
    normal: Tensor,
    view_dir: Tensor,
    lights: SphericalGaussians,
) -> Tensor:
    """Reflected radiance (B, 3, ...) under distant area lights, after Wang et al. 2009.

    Beckmann's distribution is approximated by a spherical Gaussian over light directions; the other factors
    are evaluated at its axis. The error relative to the exact lobe is 1 % at alpha 0.1 and 50 % at alpha 1.
    Maps and directions are (B, C, H, W) or (B, C).
    """
    alpha = alpha_from_roughness(roughness)
    cos_o = dot(normal, view_dir)
    is_lit = cos_o > 0
    cos_o = torch.where(is_lit, cos_o, torch.ones_like(cos_o))
    tangent_o = _cross(normal, view_dir)
    visible = smith_g1_over_cos(cos_o, dot(tangent_o, tangent_o), alpha) ** 2 * (0.25 * cos_o)
    lobe_axis = 2.0 * cos_o * normal - view_dir
    lobe_sharpness = 0.5 / (alpha * alpha * cos_o.clamp_min(0.1))
    # 1/(pi alpha^2) reaches 3e5; multiplied first by the inner product, which decreases equally fast
    lobe_amplitude = 1.0 / (math.pi * alpha * alpha)
    trailing = (1,) * (normal.dim() - 2)
    specular = torch.zeros_like(diffuse_albedo)
    irradiance = torch.zeros_like(diffuse_albedo)
    for k in range(lights.sharpness.shape[1]):
        axis = lights.axis[:, k].reshape(-1, 3, *trailing)
        sharpness = lights.sharpness[:, k].reshape(-1, 1, *trailing)
        amplitude = lights.amplitude[:, k].reshape(-1, 3, *trailing)
        gap = lobe_axis - axis
        specular = specular + amplitude * (
            lobe_amplitude * sg_inner_product(lobe_sharpness, sharpness, dot(gap, gap))
        )
        irradiance = irradiance + amplitude * sg_irradiance(sharpness, dot(normal, axis))
    reflected = (1.0 - specular_albedo) * diffuse_albedo * irradiance / math.pi
    reflected = reflected + schlick(specular_albedo, cos_o) * visible * specular
    return torch.where(is_lit, reflected, torch.zeros_like(reflected))

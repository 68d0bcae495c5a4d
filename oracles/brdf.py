# SPDX-License-Identifier: MIT
"""The material model in float64 NumPy, written directly from its equations.

Symbols: ``wi`` and ``wo`` are the unit directions (..., 3) to viewer and light, in a local frame whose z is
the normal; ``alpha`` the slope width; D, S (..., 3) and R (...) the material's channels. Callers round
directions to float32 first, so that rounding the input does not count as an error of the implementation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import erf

MIN_ALPHA = 1e-3
MIN_LOBE_PROBABILITY = 0.1

Array = np.ndarray
Value = np.ndarray | np.floating | float
"""A channel of materials, broadcast against the directions."""


def alpha_from_roughness(roughness: Value) -> Array:
    """alpha = R^2, clamped to [1e-3, 1]; NaN counts as R = 1."""
    r = np.asarray(roughness, np.float64)
    r = np.clip(np.where(np.isnan(r), 1.0, r), 0.0, 1.0)
    return np.clip(r**2, MIN_ALPHA, 1.0)


def effective_albedo(albedo: Value) -> Array:
    """The albedo clamped to [0, 1]; NaN counts as 0."""
    a = np.asarray(albedo, np.float64)
    return np.clip(np.where(np.isnan(a), 0.0, a), 0.0, 1.0)


def theta(w: Array) -> Array:
    """Angle in radians of directions (..., 3) from the normal, accurate near 0 and pi/2."""
    return np.arctan2(np.hypot(w[..., 0], w[..., 1]), w[..., 2])


def beckmann_d(h: Array, alpha: Value) -> Array:
    """Beckmann's distribution [1/sr] (Walter et al. 2007, eq. 25), for ``h`` of any length."""
    t = theta(h)
    inside = t < np.pi / 2
    t = np.where(inside, t, 0.0)
    d = np.exp(-((np.tan(t) / alpha) ** 2)) / (np.pi * alpha**2 * np.cos(t) ** 4)
    return np.where(inside, d, 0.0)


def smith_g1(w: Array, alpha: Value) -> Array:
    """Smith's G1, 2 / (1 + erf a + exp(-a^2) / (a sqrt pi)), a = 1 / (alpha tan theta); 0 if z <= 0."""
    tan = np.hypot(w[..., 0], w[..., 1]) / np.where(w[..., 2] > 0, w[..., 2], 1.0)
    with np.errstate(divide="ignore", over="ignore", under="ignore"):
        a = 1.0 / (alpha * tan)
        g = 2.0 / (1.0 + erf(a) + np.exp(-(a**2)) / (a * np.sqrt(np.pi)))
    return np.where(w[..., 2] > 0, g, 0.0)


def schlick(specular_albedo: Value, one_minus_cos: Value) -> Any:
    """Schlick's Fresnel term as a function of 1 - cos, which avoids cancellation."""
    return specular_albedo + (1.0 - specular_albedo) * one_minus_cos**5


def one_minus_cos_half(wi: Array, wo: Array) -> Array:
    """1 - wi.h as 2 sin^2(angle / 4), with the angle between the directions by Kahan's formula."""
    angle = 2.0 * np.arctan2(np.linalg.norm(wi - wo, axis=-1), np.linalg.norm(wi + wo, axis=-1))
    return 2.0 * np.sin(angle / 4.0) ** 2


def specular_lobe(wi: Array, wo: Array, alpha: Value) -> Array:
    """Density [1/sr] of ``wo`` if h is drawn from the visible normals: D(h) G1(wi) / (4 cos_i)."""
    cos_i = np.where(wi[..., 2] > 0, wi[..., 2], 1.0)
    value = beckmann_d(wi + wo, alpha) * smith_g1(wi, alpha) / (4.0 * cos_i)
    return np.where((wi[..., 2] > 0) & (wo[..., 2] > 0), value, 0.0)


def eval_cos(wi: Array, wo: Array, diffuse: Value, specular: Value, roughness: Value) -> Array:
    """BRDF times cosine, f(wi, wo) cos_o, (..., 3); 0 for directions below the surface (docs/bsdf.md)."""
    diffuse, specular = effective_albedo(diffuse), effective_albedo(specular)
    alpha = alpha_from_roughness(roughness)
    lobe = specular_lobe(wi, wo, alpha) * smith_g1(wo, alpha)
    f = schlick(specular, one_minus_cos_half(wi, wo)[..., None]) * lobe[..., None]
    up = ((wi[..., 2] > 0) & (wo[..., 2] > 0))[..., None]
    return np.where(up, f + (1.0 - specular) * diffuse / np.pi * wo[..., 2:], 0.0)


def specular_probability(wi: Array, diffuse: Value, specular: Value) -> Array:
    """Probability (...) that the BSDF's sampling chooses the specular lobe."""
    diffuse, specular = effective_albedo(diffuse), effective_albedo(specular)
    s = np.mean(schlick(specular, 1.0 - wi[..., 2:]), -1)
    d = np.mean((1.0 - specular) * diffuse, -1)
    return np.maximum(s / np.where(s + d > 0, s + d, 1.0), MIN_LOBE_PROBABILITY)


def pdf(wi: Array, wo: Array, diffuse: Value, specular: Value, roughness: Value) -> Array:
    """Density [1/sr] of ``wo`` under the BSDF's sampling."""
    p = specular_probability(wi, diffuse, specular)
    up = (wi[..., 2] > 0) & (wo[..., 2] > 0)
    lobe = specular_lobe(wi, wo, alpha_from_roughness(roughness))
    return np.where(up, p * lobe + (1.0 - p) * wo[..., 2] / np.pi, 0.0)


def direction(angle_rad: Array, azimuth_rad: Array) -> Array:
    """Unit vectors (..., 3) at ``angle_rad`` from the normal and ``azimuth_rad`` around it."""
    s = np.sin(angle_rad)
    x, y, z = np.broadcast_arrays(s * np.cos(azimuth_rad), s * np.sin(azimuth_rad), np.cos(angle_rad))
    return np.stack([x, y, z], -1)


def slopes_grid(alpha: float, num: int = 400, reach: float = 6.0) -> tuple[Array, Array]:
    """Normals (num^2, 3) and quadrature weights [sr] of a midpoint grid of slopes up to ``reach`` alpha."""
    edges = np.linspace(-reach * alpha, reach * alpha, num + 1)
    mid = 0.5 * (edges[1:] + edges[:-1])
    x, y = (a.ravel() for a in np.meshgrid(mid, mid))
    length = np.sqrt(1.0 + x**2 + y**2)
    normal = np.stack([-x, -y, np.ones_like(x)], -1) / length[:, None]
    # d(omega) = cos^3 d(slopes)
    return normal, (edges[1] - edges[0]) ** 2 / length**3


def specular_albedo_towards(wi: Array, specular: float, roughness: float) -> float:
    """Directional albedo of the specular lobe for ``wi`` (3,), by quadrature over microfacet normals."""
    alpha = float(alpha_from_roughness(np.float64(roughness)))
    h, weight = slopes_grid(alpha)
    cos_h = h @ wi
    wo = 2.0 * cos_h[:, None] * h - wi
    g1_i = smith_g1(wi[None], alpha)[0]
    value = beckmann_d(h, alpha) * g1_i * np.maximum(cos_h, 0.0) / wi[2]
    value *= schlick(specular, 1.0 - np.maximum(cos_h, 0.0)) * smith_g1(wo, alpha)
    return float(np.sum(np.where((cos_h > 0) & (wo[:, 2] > 0), value, 0.0) * weight))


def directional_albedo(wi: Array, diffuse: float, specular: float, roughness: float) -> float:
    """Directional albedo of both lobes for ``wi`` (3,); exceeds 1 at grazing angles (docs/bsdf.md)."""
    return (1.0 - specular) * diffuse + specular_albedo_towards(wi, specular, roughness)

# SPDX-License-Identifier: MIT
"""Fresnel reflectances and lobe widths for converting other renderers' materials to D, S and R.

F0 is the reflectance at normal incidence, in air. ``ALPHA_BECKMANN_PER_GGX`` is the ratio of alphas at which
the total variation distance between a Beckmann and a GGX lobe is least: with x = tan^2(theta_h) / alpha^2 of
the GGX lobe and s the squared ratio, the cosine-weighted densities are exp(-x / s) / s and 1 / (1 + x)^2. The
minimum is 0.180, at s = 1.3123 (0.204 at s = 1); the medians are equal at a ratio of 1.2011.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mitsuba_plugins.variant import select_variant

ALPHA_BECKMANN_PER_GGX = 1.1456
AIR_IOR = 1.000277
DIFFUSE_SHEEN = 0.0047
"""Hemispherical albedo of the specular lobe at S = 0 and R = 1, by Monte Carlo with an error of 2e-5."""

NAMED_IOR = {
    "vacuum": 1.0, "air": AIR_IOR, "water": 1.3330, "acetone": 1.36, "ethanol": 1.361, "bk7": 1.5046,
    "polypropylene": 1.49, "acrylic glass": 1.49, "fused quartz": 1.458, "pyrex": 1.470, "amber": 1.55,
    "sodium chloride": 1.544, "pet": 1.575, "diamond": 2.419, "water ice": 1.31,
}  # fmt: skip
"""Indices of refraction of Mitsuba's named dielectrics, by lower-case name."""


def dielectric_f0(ior: float) -> float:
    """Return F0 of a dielectric of relative index of refraction ``ior``: ((ior - 1) / (ior + 1))^2."""
    return ((ior - 1.0) / (ior + 1.0)) ** 2


def conductor_fresnel(cos_i: NDArray, eta: NDArray, k: NDArray) -> NDArray[np.float64]:
    """Return a conductor's unpolarised reflectance (N, C) in air at cosines of incidence ``cos_i`` (N,).

    ``eta`` and ``k`` (C,): real and imaginary part of the index of refraction per channel.
    """
    cosine = np.asarray(cos_i, dtype=np.float64)[:, None]
    index = np.asarray(eta, dtype=np.float64) + 1j * np.asarray(k, dtype=np.float64)
    inner = np.sqrt(1 - (1 - cosine**2) / index**2)
    across = (cosine - index * inner) / (cosine + index * inner)
    parallel = (index * cosine - inner) / (index * cosine + inner)
    return 0.5 * (np.abs(across) ** 2 + np.abs(parallel) ** 2)


def conductor_mean(eta: NDArray, k: NDArray) -> NDArray[np.float64]:
    """Return a conductor's reflectance (C,) under diffuse light: 2 * integral of F(c) c over cosines c."""
    cosine = (np.arange(2000) + 0.5) / 2000
    return 2 * (conductor_fresnel(cosine, eta, k) * cosine[:, None]).mean(axis=0)


def schlick_s_of_mean(mean: NDArray) -> NDArray[np.float64]:
    """Return S in [0, 1] whose Schlick reflectance under diffuse light, S + (1 - S) / 21, equals ``mean``.

    Schlick's reflectance, unlike that of a dimmed metal, rises to 1 at grazing angles; an equal mean
    preserves the brightness of a room, whereas an equal F0 would not.
    """
    return np.clip((np.asarray(mean, dtype=np.float64) - 1 / 21) * 21 / 20, 0.0, 1.0)


def dielectric_fresnel(cos_i: NDArray, ior: float) -> NDArray[np.float64]:
    """Return the unpolarised reflectance (N,) of a smooth interface at cosines of incidence ``cos_i`` (N,).

    ``ior``: index of refraction of the transmitting side over that of the incident side.
    """
    cos_i = np.asarray(cos_i, dtype=np.float64)
    sin2_t = (1 - cos_i**2) / ior**2
    cos_t = np.sqrt(np.maximum(0.0, 1 - sin2_t))
    # the bounds prevent 0 / 0 at grazing angles with ior 1
    parallel = (ior * cos_i - cos_t) / np.maximum(ior * cos_i + cos_t, 1e-30)
    across = (cos_i - ior * cos_t) / np.maximum(cos_i + ior * cos_t, 1e-30)
    return np.where(sin2_t >= 1, 1.0, 0.5 * (parallel**2 + across**2))


def diffuse_fresnel(ior: float) -> float:
    """Return a dielectric's reflectance under diffuse light: 2 * integral of F(c) c over cosines c."""
    cosine = (np.arange(20000) + 0.5) / 20000
    return float(2 * (dielectric_fresnel(cosine, ior) * cosine).mean())


def perceptual_roughness(alpha: float | NDArray, distribution: str) -> NDArray[np.float64]:
    """Return R = sqrt(alpha) in [0, 1]; a ``ggx`` lobe is first replaced by the nearest Beckmann lobe."""
    factor = ALPHA_BECKMANN_PER_GGX if distribution == "ggx" else 1.0
    return np.sqrt(np.clip(np.asarray(alpha, dtype=np.float64) * factor, 0.0, 1.0))


def plastic_diffuse_albedo(reflectance: NDArray, ior: float, nonlinear: bool) -> NDArray[np.float64]:
    """Return the hemispherical albedo of the diffuse component of Mitsuba's ``plastic`` BSDF.

    It is (1 - f_out) (1 - f_in) d / (1 - f_in d) if ``nonlinear``, else (1 - f_out) d, where d is
    ``reflectance``, and f_out and f_in are the interface's reflectances for diffuse light from outside and
    inside.
    """
    reflectance = np.asarray(reflectance, dtype=np.float64)
    entering = 1 - diffuse_fresnel(ior)
    inner = diffuse_fresnel(1 / ior)
    if not nonlinear:
        return entering * reflectance
    return entering * (1 - inner) * reflectance / (1 - inner * reflectance)


def conductor_preset_mean(material: str) -> tuple[float, float, float]:
    """Return :func:`conductor_mean` (RGB) of one of Mitsuba's conductors, such as ``Au``; 1 for ``none``.

    Raises ``ValueError`` for other names.
    """
    if material.lower() == "none":
        return (1.0, 1.0, 1.0)
    select_variant()
    import drjit as dr
    import mitsuba as mi

    try:
        bsdf = mi.load_dict({"type": "conductor", "material": material})
    except RuntimeError as error:
        raise ValueError(str(error).splitlines()[0]) from None
    cosine = (np.arange(512) + 0.5) / 512
    si = dr.zeros(mi.SurfaceInteraction3f, len(cosine))
    si.wi = mi.Vector3f(np.sqrt(1 - cosine**2), 0.0, cosine)
    _, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(0.5, 0.5), True)
    mean = 2 * (np.array(weight) * cosine).mean(axis=1)
    red, green, blue = (min(max(float(x), 0.0), 1.0) for x in mean[:3])
    if not all(map(math.isfinite, (red, green, blue))):
        raise ValueError(f"conductor {material!r} has no finite reflectance")
    return (red, green, blue)

# SPDX-License-Identifier: MIT
"""The Beckmann microfacet distribution as free functions on Dr.Jit arrays, stable in float32.

Symbols: ``alpha`` is the slope width (perceptual roughness squared, clamped to [:data:`MIN_ALPHA`, 1]), ``w``
a unit direction in the local frame (z is the normal), ``h`` the half vector *of any positive length*, ``cos``
and ``sin`` the cosine and sine of the angle between ``w`` and the normal, ``tan2`` the squared tangent of the
angle between ``h`` and the normal. Sources: Walter et al. 2007 (D, G1), Heitz 2014 and Heitz & d'Eon 2014
(visible normals).

Three measures keep float32 accurate down to alpha = 1e-3 (docs/bsdf.md lists the errors, in eps):

* tan^2 is computed from the tangential part of ``h``. ``wi.x + wo.x`` cancels exactly near the mirror
  direction, whereas 1 - cos^2 has no correct digit there (26 % error in D at alpha = 1e-3).
* The half vector is never normalised: cos(theta_h) and wi.h follow from tan2 and from |wi + wo|.
* G1 is always computed from :func:`smith_g1_over_cos`, G1 / cos, which has no 0/0 at the horizon.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

MIN_ALPHA = 1e-3
"""Minimum slope width: narrower lobes exceed the precision of float32."""
MAX_TAN2 = 1e3
"""Upper bound of tan^2; beyond it, the density is below exp(-985) for all alpha <= 1: zero in float32."""
MAX_EXPONENT = 100.0
"""Cap of the exponent, which keeps 0 * inf out of the derivatives; exp(-100) is negligible in float32."""
MAX_COTANGENT = 10.0
"""Upper bound of cotangents, which avoids a division by zero at the normal; 1 + erf(a) is 2 for a > 4."""
NEWTON_STEPS = 3
"""Newton steps for sampling slopes, with an error of 3e-6 in the variate; four would reach float32 precision.
"""
# Dr.Jit arrays have no useful common static type: their class depends on the variant chosen at run time.
Array = Any


def alpha_from_roughness(roughness: Array) -> Array:
    """Slope width alpha = clamp(R^2, 1e-3, 1) of a perceptual roughness R.

    Negative values count as 0, values above 1 as 1, and NaN as 1, which causes no fireflies. The derivative
    is 2R on (sqrt(1e-3), 1] and 0 outside.
    """
    bounded = effective_roughness(roughness)
    return dr.maximum(dr.square(bounded), MIN_ALPHA)


def effective_roughness(roughness: Array) -> Array:
    """Roughness as used in rendering: clamped to [0, 1], NaN becomes 1."""
    # NaN compares false and becomes 1. The comparisons include the ends, so that a parameter at an end keeps
    # its derivative and an optimiser can leave it again.
    below_one = dr.select(roughness <= 1.0, roughness, 1.0)
    return dr.select(below_one >= 0.0, below_one, 0.0)


def effective_albedo(albedo: Array) -> Array:
    """Albedo as used in rendering: clamped to [0, 1] per channel, NaN becomes 0."""
    non_negative = dr.select(albedo >= 0.0, albedo, 0.0)  # NaN compares false and becomes 0
    return dr.select(non_negative <= 1.0, non_negative, 1.0)


def beckmann_d(h: Array, alpha: Array) -> Array:
    """Density of microfacet normals D(h) [1/sr], for ``h`` of any positive length; 0 where h.z <= 0.

    D = exp(-tan^2/alpha^2) / (pi alpha^2 cos^4) with cos^-2 = 1 + tan^2 (Walter et al. 2007, eq. 25).
    """
    tangential2 = dr.square(h.x) + dr.square(h.y)
    normal2 = dr.square(h.z)
    # Compared before the division, so that an h in the tangent plane or of zero length is divided by 1.
    valid = (h.z > 0.0) & (tangential2 < MAX_TAN2 * normal2)
    inverse_z = 1.0 / dr.select(valid, h.z, 1.0)
    tan2 = dr.select(valid, dr.square(h.x * inverse_z) + dr.square(h.y * inverse_z), 0.0)
    alpha2 = dr.square(alpha)
    exponent = tan2 / alpha2
    valid &= exponent < MAX_EXPONENT
    # Not computed by logarithms: tan2 < 1e3 bounds every factor (docs/decisions/0002), and adding
    # ln(alpha^2) = -13.8 would lose three bits.
    density = dr.exp(-dr.minimum(exponent, MAX_EXPONENT)) * dr.square(1.0 + tan2) / (dr.pi * alpha2)
    return dr.select(valid, density, 0.0)


def smith_g1_over_cos(w: Array, alpha: Array) -> Array:
    """Smith's masking divided by its cosine, G1(w) / cos(theta), exact form; finite down to the horizon.

    With a = cos / (alpha sin): G1 = 2 / (1 + erf a + exp(-a^2) / (a sqrt(pi))), and division by cos turns the
    last term into alpha sin exp(-a^2) / sqrt(pi). At the horizon the result tends to 2 sqrt(pi) / alpha; it
    is 0 where w.z <= 0.
    """
    valid = w.z > 0.0
    cos = dr.select(valid, w.z, 1.0)
    sin2 = dr.square(w.x) + dr.square(w.y)
    # The bound avoids sqrt's infinite derivative at 0, where the sine has no effect: alpha sin < cos / 10.
    alpha_sin = alpha * dr.sqrt(dr.maximum(sin2, 1e-30))
    a = cos / dr.maximum(alpha_sin, cos / MAX_COTANGENT)
    denominator = cos * (1.0 + dr.erf(a)) + alpha_sin * dr.exp(-dr.square(a)) * (1.0 / math.sqrt(math.pi))
    return dr.select(valid, 2.0 / denominator, 0.0)


def smith_g1(w: Array, alpha: Array) -> Array:
    """Smith's masking function G1(w) in [0, 1], exact form (Walter et al. 2007, eq. 23 without the fit)."""
    return dr.minimum(w.z * smith_g1_over_cos(w, alpha), 1.0)


def visible_normal_pdf(w: Array, h: Array, alpha: Array) -> Array:
    """Density of visible normals D_w(h) = D(h) G1(w) (w.h)+ / cos(theta_w) [1/sr] for a *unit* ``h``."""
    return beckmann_d(h, alpha) * smith_g1_over_cos(w, alpha) * dr.maximum(dr.dot(w, h), 0.0)


def sample_visible_normal(w: Array, alpha: Array, sample: Array) -> Array:
    """Sample a unit half vector with density :func:`visible_normal_pdf` by ``sample`` in [0, 1]^2; w.z > 0.

    The surface is stretched to alpha = 1, slopes are drawn there, and the result is stretched back.
    """
    stretched = dr.normalize(mi.Vector3f(alpha * w.x, alpha * w.y, w.z))
    radial = dr.sqrt(dr.square(stretched.x) + dr.square(stretched.y))
    has_azimuth = radial > 0.0
    inverse = 1.0 / dr.select(has_azimuth, radial, 1.0)
    cos_phi = dr.select(has_azimuth, stretched.x * inverse, 1.0)
    sin_phi = dr.select(has_azimuth, stretched.y * inverse, 0.0)
    slope_x, slope_y = sample_visible_slopes(stretched.z, radial, sample)
    rotated_x = cos_phi * slope_x - sin_phi * slope_y
    rotated_y = sin_phi * slope_x + cos_phi * slope_y
    return dr.normalize(mi.Vector3f(-alpha * rotated_x, -alpha * rotated_y, 1.0))


def sample_visible_slopes(
    cos: Array, sin: Array, sample: Array, num_steps: int = NEWTON_STEPS
) -> tuple[Array, Array]:
    """Sample a visible slope (x, y) at alpha = 1, for a direction of azimuth 0 with this cosine and sine.

    Inverts the distribution function C(s) = 1 + erf(s) + tan exp(-s^2) / sqrt(pi) of Heitz & d'Eon 2014 by
    ``num_steps`` Newton steps in x = erf(s), starting at the inverse for grazing incidence.
    """
    edge = 1.0 - 6e-8  # the last float32 below 1: erfinv stays finite
    u = dr.clip(sample.x, 6e-8, edge)
    # Everything is divided by max(1, tan), so that neither end of the range of angles overflows.
    cot = cos / dr.maximum(sin, cos / MAX_COTANGENT)
    largest_slope = dr.erf(cot)
    scale_erf = dr.minimum(cot, 1.0)
    scale_exp = dr.minimum(sin / dr.maximum(cos, 1e-30), 1.0)
    inverse_sqrt_pi = 1.0 / math.sqrt(math.pi)
    total = u * (scale_erf * (1.0 + largest_slope) + scale_exp * inverse_sqrt_pi * dr.exp(-dr.square(cot)))
    x = largest_slope - (largest_slope + 1.0) * dr.erf(dr.sqrt(-dr.log(u)))
    for _ in range(num_steps):
        x = dr.clip(x, -edge, dr.minimum(largest_slope, edge))
        slope = dr.erfinv(x)
        value = scale_erf * (1.0 + x) + scale_exp * inverse_sqrt_pi * dr.exp(-dr.square(slope)) - total
        derivative = scale_erf - slope * scale_exp
        # The derivative vanishes at the largest slope, where the initial value is exact.
        steep = derivative > 1e-6
        x -= dr.select(steep, value / dr.select(steep, derivative, 1.0), 0.0)
    x = dr.clip(x, -edge, dr.minimum(largest_slope, edge))
    return dr.erfinv(x), dr.erfinv(dr.clip(2.0 * sample.y - 1.0, -edge, edge))

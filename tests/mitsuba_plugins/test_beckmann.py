# SPDX-License-Identifier: MIT
"""The Beckmann functions against the float64 oracle and their defining identities."""

from __future__ import annotations

import numpy as np
import pytest

from oracles import brdf as oracle
from oracles.bsdf_probe import ANGLES_RAD, EPS, ROUGHNESS, array, dr, mi, unit_float32, vector

from mitsuba_plugins import beckmann  # isort: skip  (after the variant is chosen)

# Maximum relative error in eps = 2^-23. That of D grows with the exponent x = tan^2 / alpha^2, since exp(-x)
# multiplies the relative rounding error of x by x. docs/bsdf.md repeats this table.
MAX_ERROR_EPS = {"D / (1 + x)": 4.0, "G1 / cos": 3.0}
ALPHAS = np.unique(oracle.alpha_from_roughness(ROUGHNESS).astype(np.float32))


def _slopes(rng: np.random.Generator, alpha: np.ndarray, num: int) -> np.ndarray:
    """Random unit half vectors: 70 % with slopes of up to a few alpha, the others uniform on the sphere."""
    slopes = rng.normal(size=(num, 2)) * alpha[:, None] * rng.choice([0.0, 0.1, 0.7, 2.0], num)[:, None]
    h = np.stack([-slopes[:, 0], -slopes[:, 1], np.ones(num)], -1)
    everywhere = oracle.direction(np.arccos(rng.uniform(-1, 1, num)), rng.uniform(0, 2 * np.pi, num))
    return unit_float32(np.where(rng.uniform(size=num)[:, None] < 0.7, h, everywhere))


def test_density_agrees_with_the_oracle() -> None:
    rng = np.random.default_rng(11)
    num = 50_000
    alpha = rng.choice(ALPHAS, num)
    h = _slopes(rng, alpha, num)
    got = array(beckmann.beckmann_d(vector(h), mi.Float(alpha)))
    expected = oracle.beckmann_d(h, alpha.astype(np.float64))
    exponent = np.where(h[:, 2] > 0, np.tan(oracle.theta(h)) ** 2 / alpha.astype(np.float64) ** 2, np.inf)
    in_range = exponent < 80.0
    error = np.abs(got - expected)[in_range] / expected[in_range] / EPS / (1.0 + exponent[in_range])
    assert in_range.sum() > num / 2
    assert error.max() < MAX_ERROR_EPS["D / (1 + x)"]
    assert np.all(got[~in_range] <= 1e-25 / ALPHAS.min() ** 2)
    assert np.all(np.isfinite(got)) and np.all(got >= 0.0)


def test_half_vectors_of_any_length_have_the_same_density() -> None:
    rng = np.random.default_rng(12)
    h = _slopes(rng, np.full(2000, 0.3), 2000)
    alpha = mi.Float(0.3)
    short, long = (array(beckmann.beckmann_d(vector(h * scale), alpha)) for scale in (2.0**-10, 2.0**10))
    np.testing.assert_array_equal(short, long)


def test_masking_agrees_with_the_oracle_down_to_the_horizon() -> None:
    rng = np.random.default_rng(13)
    num = 50_000
    w = unit_float32(oracle.direction(rng.choice(ANGLES_RAD, num), rng.uniform(0, 2 * np.pi, num)))
    alpha = rng.choice(ALPHAS, num)
    up = w[:, 2] > 0
    got = array(beckmann.smith_g1_over_cos(vector(w), mi.Float(alpha)))
    expected = oracle.smith_g1(w[up], alpha[up].astype(np.float64)) / w[up, 2]
    assert (np.abs(got[up] - expected) / expected / EPS).max() < MAX_ERROR_EPS["G1 / cos"]
    g1 = array(beckmann.smith_g1(vector(w), mi.Float(alpha)))
    assert g1.min() >= 0.0 and g1.max() <= 1.0
    below = array(beckmann.smith_g1(vector(w * [1, 1, -1]), mi.Float(alpha)))
    assert np.all(below[w[:, 2] >= 0] == 0.0)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_projected_density_integrates_to_one(alpha: np.float32) -> None:
    """The integral of D cos over the hemisphere is 1: microfacets cover the surface exactly once."""
    h, weight = oracle.slopes_grid(float(alpha), num=300, reach=6.0)
    density = array(beckmann.beckmann_d(vector(h), mi.Float(alpha))).astype(np.float64)
    assert np.sum(density * h[:, 2] * weight) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("alpha", [0.001, 0.09, 0.5, 1.0])
@pytest.mark.parametrize("angle_deg", [0.0, 40.0, 80.0, 89.0])
def test_visible_normals_integrate_to_one(alpha: float, angle_deg: float) -> None:
    """The projected area of the visible microfacets equals that of the surface (Heitz 2014)."""
    w = oracle.direction(np.array([np.radians(angle_deg)]), np.array([0.4]))
    h, weight = oracle.slopes_grid(alpha, num=1000, reach=6.0)
    w_all = np.repeat(w, len(h), 0)
    density = array(beckmann.visible_normal_pdf(vector(w_all), vector(h), mi.Float(alpha))).astype(np.float64)
    # The integrand has a kink where normals become invisible, which limits quadrature to second order.
    assert np.sum(density * weight) == pytest.approx(1.0, abs=3e-4)


def test_alpha_is_clamped_for_every_input() -> None:
    roughness = np.array([0.0, 0.01, np.sqrt(1e-3), 0.3, 1.0, -0.5, 1.7, np.nan, np.inf, -np.inf], np.float32)
    alpha = array(beckmann.alpha_from_roughness(mi.Float(roughness)))
    np.testing.assert_allclose(alpha, [1e-3, 1e-3, 1e-3, 0.09, 1, 1e-3, 1, 1, 1, 1e-3], rtol=2 * EPS)
    np.testing.assert_allclose(alpha, oracle.alpha_from_roughness(roughness), rtol=2 * EPS)
    albedo = array(beckmann.effective_albedo(mi.Float([np.nan, -1.0, 0.25, 2.0, np.inf])))
    np.testing.assert_array_equal(albedo, [0.0, 0.0, 0.25, 1.0, 1.0])


def test_sampled_normals_are_finite_unit_and_visible_everywhere() -> None:
    rng = np.random.default_rng(14)
    num = 200_000
    w = unit_float32(oracle.direction(rng.choice(ANGLES_RAD, num), rng.uniform(0, 2 * np.pi, num)))
    w[:, 2] = np.abs(w[:, 2])
    u = rng.uniform(size=(num, 2)).astype(np.float32)
    u[:4000] = rng.choice(np.float32([0.0, 1.0, 6e-8, 1 - 6e-8, 0.5]), (4000, 2))
    alpha = rng.choice(ALPHAS, num)
    sample = mi.Point2f(mi.Float(u[:, 0].copy()), mi.Float(u[:, 1].copy()))
    h = array(beckmann.sample_visible_normal(vector(w), mi.Float(alpha), sample)).astype(np.float64)
    assert np.all(np.isfinite(h))
    np.testing.assert_allclose(np.linalg.norm(h, axis=1), 1.0, atol=4 * EPS)
    assert h[:, 2].min() > 0.0
    # The half vector is on the viewer's side, up to rounding.
    assert np.sum(w * h, 1).min() > -4 * EPS


@pytest.mark.parametrize("angle_rad", [0.0, 0.8, 1.4, np.pi / 2 - 1e-4, np.pi / 2 - 1e-6])
def test_sampled_slopes_follow_the_distribution_function(angle_rad: float) -> None:
    """Heitz & d'Eon's distribution function, in float64, maps the sampled slope back to its variate."""
    from scipy.special import erf

    u = ((np.arange(4000) + 0.5) / 4000).astype(np.float32)
    cos, sin = np.float32(np.cos(angle_rad)), np.float32(np.sin(angle_rad))
    slope, _ = beckmann.sample_visible_slopes(
        mi.Float(cos), mi.Float(sin), mi.Point2f(mi.Float(u), mi.Float(0.5))
    )
    s = array(slope).astype(np.float64)
    tan = float(sin) / float(cos)

    def distribution(x: np.ndarray) -> np.ndarray:
        return (1.0 + erf(x) + tan * np.exp(-(x**2)) / np.sqrt(np.pi)) / max(1.0, tan)

    total = distribution(np.float64(min(1.0 / max(tan, 1e-12), 10.0)))
    np.testing.assert_allclose(distribution(s) / total, u, atol=4e-6)


def test_derivatives_are_finite_at_the_singularities() -> None:
    """Zero vectors, the tangent plane, the normal and the smallest alpha cause no 0/0 in the derivatives."""
    unit = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1e-4, 0, 1], [1, 0, 1e-6], [1, 0, 1e-12], [0, 0, -1]])
    any_length = np.concatenate([unit, [[1e-12, 0, 1e-12], [0, 0, 1e-12], [1e-8, 0, 1e-6]]])
    functions = (beckmann.beckmann_d, beckmann.smith_g1, beckmann.smith_g1_over_cos)
    for alpha_value in (1e-3, 0.3, 1.0):
        for function in functions:
            h = any_length if function is beckmann.beckmann_d else unit
            direction, alpha = vector(h), mi.Float(np.full(len(h), alpha_value, np.float32))
            dr.enable_grad(direction, alpha)
            value = function(direction, alpha)
            dr.backward(value)
            assert np.all(np.isfinite(array(value)))
            assert np.all(np.isfinite(array(dr.grad(alpha)))), (function.__name__, alpha_value)
            assert np.all(np.isfinite(array(dr.grad(direction)))), (function.__name__, alpha_value)

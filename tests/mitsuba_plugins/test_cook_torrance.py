# SPDX-License-Identifier: MIT
"""The BSDF ``cook_torrance``: oracle, identities, white furnace, gradients, both sides, and bad input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from oracles import brdf as oracle
from oracles.bsdf_probe import (
    ANGLES_RAD,
    EPS,
    ROUGHNESS,
    array,
    dr,
    interaction,
    material,
    mi,
    unit_float32,
    vector,
)

# Maximum relative error in eps, divided by 1 + x with x = tan^2(theta_h) / alpha^2, the exponent of D. The
# value is less accurate than the density because Schlick's fifth power multiplies the error of 1 - cos by 5.
MAX_ERROR_EPS = {"value": 16.0, "pdf": 8.0, "weight": 16.0}
MAX_EXPONENT = 80.0
MAX_WEIGHT = 10.0
CTX = mi.BSDFContext()


def _directions(rng: np.random.Generator, roughness: np.ndarray, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Return wi and wo (num, 3), rounded to float32; two thirds of wo are in the specular lobe."""
    wi = oracle.direction(rng.choice(ANGLES_RAD, num), rng.uniform(0, 2 * np.pi, num))
    alpha = oracle.alpha_from_roughness(roughness)[:, None]
    slope = rng.normal(size=(num, 2)) * alpha * rng.choice([0.1, 0.7, 1.4], num)[:, None]
    h = np.stack([-slope[:, 0], -slope[:, 1], np.ones(num)], -1)
    h /= np.linalg.norm(h, axis=1)[:, None]
    mirrored = 2 * np.sum(wi * h, 1)[:, None] * h - wi
    anywhere = oracle.direction(rng.choice(ANGLES_RAD, num), rng.uniform(0, 2 * np.pi, num))
    return unit_float32(wi), unit_float32(np.where(rng.uniform(size=num)[:, None] < 0.67, mirrored, anywhere))


def _channels(rng: np.random.Generator, num: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    diffuse = rng.choice(np.float32([0.0, 0.04, 0.5, 0.8, 1.0]), (num, 3))
    specular = rng.choice(np.float32([0.0, 0.04, 0.5, 1.0]), (num, 3))
    return diffuse, specular, rng.choice(ROUGHNESS, num).astype(np.float32)


def _uniforms(rng: np.random.Generator, num: int) -> tuple[Any, Any]:
    u = rng.uniform(size=(3, num)).astype(np.float32)
    return mi.Float(u[0]), mi.Point2f(mi.Float(u[1]), mi.Float(u[2]))


def _relative_error(got: np.ndarray, expected: np.ndarray) -> np.ndarray:
    return np.where(expected > 1e-30, np.abs(got - expected) / np.maximum(expected, 1e-30), 0.0) / EPS


def test_value_and_density_agree_with_the_oracle() -> None:
    rng = np.random.default_rng(21)
    num = 120_000
    diffuse, specular, roughness = _channels(rng, num)
    wi, wo = _directions(rng, roughness, num)
    bsdf = material(diffuse, specular, roughness, num)
    value, pdf = (array(v) for v in bsdf.eval_pdf(CTX, interaction(wi), vector(wo)))
    channels = (c.astype(np.float64) for c in (diffuse, specular, roughness))
    d, s, r = channels
    alpha = oracle.alpha_from_roughness(r)
    exponent = (np.tan(oracle.theta(wi + wo)) / alpha) ** 2
    up = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    checked = up & (exponent < MAX_EXPONENT)
    assert checked.sum() > num / 3
    scale = 1.0 + exponent[checked]
    value_error = _relative_error(value, oracle.eval_cos(wi, wo, d, s, r)).max(1)[checked] / scale
    pdf_error = _relative_error(pdf, oracle.pdf(wi, wo, d, s, r))[checked] / scale
    assert value_error.max() < MAX_ERROR_EPS["value"]
    assert pdf_error.max() < MAX_ERROR_EPS["pdf"]
    assert np.all(np.isfinite(value)) and value.min() >= 0.0
    assert np.all(value[~up] == 0.0) and np.all(pdf[~up] == 0.0)


def test_oracle_against_a_second_derivation() -> None:
    """The oracle equals the formula in terms of cosines, at angles where cosines are accurate."""
    rng = np.random.default_rng(22)
    num = 4000
    wi, wo = (oracle.direction(rng.uniform(0.1, 1.2, num), rng.uniform(0, 2 * np.pi, num)) for _ in range(2))
    d, s, r = 0.6, 0.2, 0.7
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=1)[:, None]
    alpha2 = r**4
    cos2 = h[:, 2] ** 2
    density = np.exp((cos2 - 1) / (alpha2 * cos2)) / (np.pi * alpha2 * cos2**2)
    lambdas = []
    for w in (wi, wo):
        from scipy.special import erfc

        a = w[:, 2] / np.sqrt(1 - w[:, 2] ** 2) / r**2
        lambdas.append(0.5 * (np.exp(-(a**2)) / (a * np.sqrt(np.pi)) - erfc(a)))
    masking = 1 / ((1 + lambdas[0]) * (1 + lambdas[1]))
    fresnel = s + (1 - s) * (1 - np.sum(wi * h, 1)) ** 5
    expected = fresnel * density * masking / (4 * wi[:, 2]) + (1 - s) * d / np.pi * wo[:, 2]
    one = np.ones((num, 1))
    got = oracle.eval_cos(wi, wo, d * one, s * one, np.full(num, r))[:, 0]
    np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_sample_is_eval_over_pdf_and_bounded() -> None:
    rng = np.random.default_rng(23)
    num = 300_000
    diffuse, specular, roughness = _channels(rng, num)
    wi, _ = _directions(rng, roughness, num)
    si = interaction(wi)
    bsdf = material(diffuse, specular, roughness, num)
    bs, weight = bsdf.sample(CTX, si, *_uniforms(rng, num))
    value, pdf = (array(v) for v in bsdf.eval_pdf(CTX, si, bs.wo))
    weight, wo, sampled_pdf = array(weight), array(bs.wo), array(bs.pdf)
    assert np.all(np.isfinite(weight)) and weight.min() >= 0.0
    assert weight.max() <= MAX_WEIGHT
    valid = sampled_pdf > 0
    np.testing.assert_array_equal(sampled_pdf[valid], pdf[valid])
    np.testing.assert_allclose(weight[valid], value[valid] / pdf[valid][:, None], rtol=4 * EPS)
    assert np.all(weight[~valid] == 0.0)
    np.testing.assert_allclose(np.linalg.norm(wo[valid], axis=1), 1.0, atol=4 * EPS)


def test_joint_call_equals_the_separate_ones() -> None:
    rng = np.random.default_rng(24)
    num = 2000
    diffuse, specular, roughness = _channels(rng, num)
    wi, wo = _directions(rng, roughness, num)
    bsdf, si, uniforms = material(diffuse, specular, roughness, num), interaction(wi), _uniforms(rng, num)
    value, pdf, bs, weight = bsdf.eval_pdf_sample(CTX, si, vector(wo), *uniforms)
    other_bs, other_weight = bsdf.sample(CTX, si, *uniforms)
    np.testing.assert_array_equal(array(value), array(bsdf.eval(CTX, si, vector(wo))))
    np.testing.assert_array_equal(array(pdf), array(bsdf.pdf(CTX, si, vector(wo))))
    np.testing.assert_array_equal(array(bs.wo), array(other_bs.wo))
    np.testing.assert_array_equal(array(weight), array(other_weight))


def test_specular_part_is_reciprocal() -> None:
    rng = np.random.default_rng(25)
    num = 50_000
    _, specular, roughness = _channels(rng, num)
    wi, wo = _directions(rng, roughness, num)
    up = (wi[:, 2] > 1e-4) & (wo[:, 2] > 1e-4)
    bsdf = material(0.0, specular, roughness, num)
    there = array(bsdf.eval(CTX, interaction(wi), vector(wo))).astype(np.float64)[up] / wo[up, 2:]
    back = array(bsdf.eval(CTX, interaction(wo), vector(wi))).astype(np.float64)[up] / wi[up, 2:]
    np.testing.assert_allclose(there, back, rtol=16 * EPS, atol=1e-30)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("angle_deg", [0.0, 50.0, 85.0])
def test_density_integrates_to_at_most_one(roughness: float, angle_deg: float) -> None:
    """The density integrates to 1 minus the share of samples rejected because they are below the surface."""
    num_theta, num_phi = 800, 800
    cos = (np.arange(num_theta) + 0.5) / num_theta
    phi = 2 * np.pi * (np.arange(num_phi) + 0.5) / num_phi
    c, p = (a.ravel() for a in np.meshgrid(cos, phi))
    s = np.sqrt(1 - c**2)
    wo = np.stack([s * np.cos(p), s * np.sin(p), c], -1)
    wi = np.repeat(oracle.direction(np.array([np.radians(angle_deg)]), np.array([0.3])), len(wo), 0)
    bsdf = mi.load_dict({"type": "cook_torrance", "diffuse_albedo": 0.5, "roughness": roughness})
    pdf = array(bsdf.pdf(CTX, interaction(wi), vector(wo))).astype(np.float64)
    integral = pdf.mean() * 2 * np.pi
    rng = np.random.default_rng(26)
    num = 200_000
    bs, _ = bsdf.sample(CTX, interaction(np.repeat(wi[:1], num, 0)), *_uniforms(rng, num))
    share_valid = np.mean(array(bs.pdf) > 0)
    assert integral == pytest.approx(share_valid, abs=4 * np.sqrt(0.25 / num) + 1e-3)
    assert integral <= 1.0 + 1e-3


@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 75.0, 85.0])
def test_white_furnace_against_quadrature(angle_deg: float) -> None:
    """The mean sample weight equals the directional albedo (Z-test per roughness); 5 % more is detected."""
    num = 100_000
    rng = np.random.default_rng(27)
    wi = oracle.direction(np.array([np.radians(angle_deg)]), np.array([1.1]))
    combinations = [(0.8, 0.04), (0.0, 1.0), (0.5, 0.5)]
    num_tests = 4 * len(ROUGHNESS) * len(combinations)
    threshold = _two_sided_z(0.01, num_tests)
    for diffuse, specular in combinations:
        for roughness in ROUGHNESS:
            bsdf = material(diffuse, specular, roughness)
            si = interaction(np.repeat(wi, num, 0))
            weight = array(bsdf.sample(CTX, si, *_uniforms(rng, num))[1])[:, 0].astype(np.float64)
            standard_error = max(weight.std() / np.sqrt(num), 1e-6)
            expected = oracle.directional_albedo(wi[0], diffuse, specular, float(roughness))
            z = (weight.mean() - expected) / standard_error
            assert abs(z) < threshold, (diffuse, specular, roughness, weight.mean(), expected)
            twin = (1.05 * weight.mean() - expected) / (1.05 * standard_error)
            assert abs(twin) > threshold, (diffuse, specular, roughness)


def _two_sided_z(significance: float, num_tests: int) -> float:
    from scipy.stats import norm

    return float(norm.isf(0.5 * (1.0 - (1.0 - significance) ** (1.0 / num_tests))))


# ---- gradients ----


def _gradients(
    wi: np.ndarray, wo: np.ndarray, channels: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Dr.Jit's derivatives of eval, summed over RGB, by D (N, 3), S (N, 3) and R (N,)."""
    num = len(wi)
    bsdf = material(*channels, num)
    parameters = mi.traverse(bsdf)
    names = ("diffuse_albedo.data", "specular_albedo.data", "roughness.data")
    for name in names:
        dr.enable_grad(parameters[name])
    parameters.update()
    dr.backward(dr.sum(bsdf.eval(CTX, interaction(wi), vector(wo))))
    d, s, r = (np.array(dr.grad(parameters[n])) for n in names)
    return d.reshape(-1, 3)[:num], s.reshape(-1, 3)[:num], r.reshape(-1)[:num]


def test_gradients_agree_with_finite_differences_of_the_oracle() -> None:
    rng = np.random.default_rng(28)
    num = 40_000
    d = rng.uniform(0.05, 0.95, (num, 3)).astype(np.float32)
    s = rng.uniform(0.02, 0.95, (num, 3)).astype(np.float32)
    # Away from sqrt(1e-3), where the clamp of alpha has a kink.
    r = rng.choice(np.float32([0.04, 0.1, 0.3, 0.6, 0.95]), num)
    wi, wo = _directions(rng, r, num)
    exponent = (np.tan(oracle.theta(wi + wo)) / oracle.alpha_from_roughness(r)) ** 2
    checked = (wi[:, 2] > 0) & (wo[:, 2] > 0) & (exponent < 40)
    grad_d, grad_s, grad_r = _gradients(wi, wo, (d, s, r))
    d64, s64, r64 = (a.astype(np.float64) for a in (d, s, r))

    def value(dd: Any = 0.0, ds: Any = 0.0, dr_: Any = 0.0) -> np.ndarray:
        return oracle.eval_cos(wi, wo, d64 + dd, s64 + ds, r64 + dr_)

    # The value is linear in D and S: a long step has no truncation error, only float64 rounding.
    step = 0.02
    rounding = 4 * np.finfo(np.float64).eps * value() / step
    for got, plus, minus in (
        (grad_d, value(dd=step), value(dd=-step)),
        (grad_s, value(ds=step), value(ds=-step)),
    ):
        expected = (plus - minus) / (2 * step)
        # The terms of the derivative by S, F' spec - D cos / pi, may cancel: the error is relative to at
        # least 1 % of the value.
        scale = np.maximum(np.abs(expected), 1e-2 * value())
        assert np.max((np.abs(got - expected) - rounding)[checked] / scale[checked]) < 1e-3
    h = 1e-5 * r64
    expected_r = ((value(dr_=h) - value(dr_=-h)) / (2 * h[:, None])).sum(1)
    # The derivative by R crosses zero inside the lobe: the error is relative to at least value / R.
    scale = np.maximum(np.abs(expected_r), value().sum(1) / r64)[checked]
    assert np.max(np.abs(grad_r - expected_r)[checked] / np.maximum(scale, 1e-20)) < 1e-3
    assert checked.sum() > num / 3


def test_gradients_are_finite_everywhere() -> None:
    rng = np.random.default_rng(29)
    num = 100_000
    channels = _channels(rng, num)
    channels[2][: num // 10] = np.nan
    wi, wo = _directions(rng, channels[2], num)
    wo[::7, 2] *= -1.0
    for gradient in _gradients(np.nan_to_num(wi), np.nan_to_num(wo), channels):
        assert np.all(np.isfinite(gradient))


def test_parameters_at_the_ends_of_their_range_keep_their_gradient() -> None:
    """At albedos of 0 or 1 and a roughness of 1, gradients are the one-sided derivatives into the range."""
    num = 4
    wi = np.repeat(unit_float32(oracle.direction(np.array([0.7]), np.array([0.0]))), num, 0)
    wo = wi * [-1, 1, 1]
    d = np.repeat(np.float64([[0.0], [1.0], [0.0], [1.0]]), 3, 1)
    s = np.repeat(np.float64([[0.0], [0.0], [1.0], [1.0]]), 3, 1)
    r = np.ones(num)
    inward_d, inward_s = np.where(d > 0.5, -0.1, 0.1), np.where(s > 0.5, -0.1, 0.1)
    base = oracle.eval_cos(wi, wo, d, s, r)
    grad_d, grad_s, grad_r = _gradients(wi, wo, (d, s, r))
    expected_d = (oracle.eval_cos(wi, wo, d + inward_d, s, r) - base) / inward_d
    expected_s = (oracle.eval_cos(wi, wo, d, s + inward_s, r) - base) / inward_s
    expected_r = (base - oracle.eval_cos(wi, wo, d, s, r - 1e-6)).sum(1) / 1e-6
    np.testing.assert_allclose(grad_d, expected_d, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(grad_s, expected_s, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(grad_r, expected_r, rtol=1e-4, atol=1e-7)


def test_roughness_has_no_gradient_where_alpha_is_clamped() -> None:
    wi = np.repeat(oracle.direction(np.array([0.5]), np.array([0.0])), 4, 0)
    wo = wi * [-1, -1, 1]
    r = np.array([0.0, 0.02, -0.3, 1.5], np.float32)
    _, _, gradient = _gradients(wi, wo, (np.full((4, 3), 0.5), np.full((4, 3), 0.04), r))
    np.testing.assert_array_equal(gradient, 0.0)


# ---- sides, components, attributes, bad input ----


def test_two_sides_mirror_and_equal_mitsubas_wrapper() -> None:
    rng = np.random.default_rng(30)
    num = 5000
    wi, wo = _directions(rng, np.full(num, 0.4), num)
    wi[::2, 2] *= -1
    wo[::3, 2] *= -1
    si, uniforms = interaction(wi), _uniforms(rng, num)
    channels = {"diffuse_albedo": 0.3, "specular_albedo": 0.2, "roughness": 0.4}
    native = mi.load_dict({"type": "cook_torrance", **channels})
    one_sided = mi.load_dict({"type": "cook_torrance", "two_sided": False, **channels})
    wrapped = mi.load_dict(
        {"type": "twosided", "nested": {"type": "cook_torrance", "two_sided": False, **channels}}
    )
    value = array(native.eval(CTX, si, vector(wo)))
    np.testing.assert_array_equal(value, array(wrapped.eval(CTX, si, vector(wo))))
    np.testing.assert_array_equal(
        array(native.pdf(CTX, si, vector(wo))), array(wrapped.pdf(CTX, si, vector(wo)))
    )
    np.testing.assert_array_equal(
        array(native.sample(CTX, si, *uniforms)[0].wo), array(wrapped.sample(CTX, si, *uniforms)[0].wo)
    )
    same_side = wi[:, 2] * wo[:, 2] > 0
    assert np.all(value[~same_side] == 0) and np.all(value[same_side][:, 0] > 0)
    front_only = array(one_sided.eval(CTX, si, vector(wo)))
    assert np.all(front_only[wi[:, 2] <= 0] == 0)
    np.testing.assert_array_equal(front_only[wi[:, 2] > 0], value[wi[:, 2] > 0])


@pytest.mark.parametrize("two_sided", [True, False])
def test_flags_match_the_reflecting_sides(two_sided: bool) -> None:
    bsdf = mi.load_dict({"type": "cook_torrance", "two_sided": two_sided})
    for index, lobe in enumerate((mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection)):
        sides = mi.BSDFFlags.FrontSide | (mi.BSDFFlags.BackSide if two_sided else 0)
        assert bsdf.flags(index) == lobe | sides
    assert mi.has_flag(bsdf.flags(), mi.BSDFFlags.BackSide) == two_sided


def test_all_lanes_are_active_by_default() -> None:
    """Calls without a mask equal calls with an all-true mask; inactive lanes return zero."""
    wi, wo = (unit_float32(oracle.direction(np.array([a]), np.array([b]))) for a, b in ((0.5, 0.0), (0.3, 2)))
    bsdf, si = material(0.5, 0.3, 0.4), interaction(wi)
    lanes = [mi.Float(0.9), mi.Point2f(0.3, 0.4)]
    calls: list[tuple[Any, tuple[Any, ...]]] = [
        (bsdf.eval, (CTX, si, vector(wo))),
        (bsdf.pdf, (CTX, si, vector(wo))),
        (bsdf.eval_pdf, (CTX, si, vector(wo))),
        (lambda *words: bsdf.sample(*words)[1], (CTX, si, *lanes)),
        (lambda *words: bsdf.eval_pdf_sample(*words)[0], (CTX, si, vector(wo), *lanes)),
        (bsdf.surface_parameters, (si,)),
        (bsdf.eval_diffuse_reflectance, (si,)),
        (bsdf.eval_attribute, ("specular_albedo", si)),
        (bsdf.eval_attribute_1, ("specular_albedo", si)),
        (bsdf.eval_attribute_3, ("specular_albedo", si)),
    ]
    for method, words in calls:
        usual, given, none = (
            [array(part) for part in (found if isinstance(found, tuple) else (found,))]
            for found in (method(*words), method(*words, True), method(*words, False))
        )
        for a, b, c in zip(usual, given, none, strict=True):
            np.testing.assert_array_equal(a, b)
            assert (a > 0).all() and (c == 0).all(), method
    assert bsdf.has_attribute("roughness") and not bsdf.has_attribute("sheen")


def test_components_add_up() -> None:
    rng = np.random.default_rng(31)
    wi, wo = _directions(rng, np.full(3000, 0.5), 3000)
    bsdf = mi.load_dict({"type": "cook_torrance", "diffuse_albedo": 0.3, "specular_albedo": 0.2})
    si = interaction(wi)
    parts = []
    for index, flag in enumerate((mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection)):
        ctx = mi.BSDFContext()
        ctx.type_mask = +flag
        value = bsdf.eval(ctx, si, vector(wo))
        bs, weight = bsdf.sample(ctx, si, *_uniforms(rng, 3000))
        assert np.all(array(bs.sampled_type)[array(bs.pdf) > 0] == +flag)
        assert np.all(array(bs.sampled_component)[array(bs.pdf) > 0] == index)
        assert array(weight).max() <= MAX_WEIGHT
        parts.append(array(value))
    np.testing.assert_allclose(sum(parts), array(bsdf.eval(CTX, si, vector(wo))), rtol=4 * EPS, atol=1e-12)


def test_each_lobe_has_its_separate_density() -> None:
    """The diffuse lobe has the density cos / pi, the specular lobe that of a purely specular surface."""
    rng = np.random.default_rng(33)
    wi, wo = _directions(rng, np.full(500, 0.5), 500)
    wo[:, 2] = np.maximum(wo[:, 2], 0.01)
    si, alone = (
        interaction(wi),
        {flag: mi.BSDFContext() for flag in ("DiffuseReflection", "GlossyReflection")},
    )
    for flag, ctx in alone.items():
        ctx.type_mask = +getattr(mi.BSDFFlags, flag)
    both = mi.load_dict({"type": "cook_torrance", "diffuse_albedo": 0.3, "specular_albedo": 0.2})
    mirror = mi.load_dict({"type": "cook_torrance", "diffuse_albedo": 0.0, "specular_albedo": 0.2})
    density = array(both.pdf(alone["DiffuseReflection"], si, vector(wo)))
    np.testing.assert_allclose(density, wo[:, 2] / np.pi, rtol=4 * EPS)
    density = array(both.pdf(alone["GlossyReflection"], si, vector(wo)))
    np.testing.assert_allclose(density, array(mirror.pdf(CTX, si, vector(wo))), rtol=4 * EPS)
    assert density.max() > 0.1


def test_attributes_return_the_channels() -> None:
    rgb = {"type": "rgb", "value": [0.1, 0.5, 0.9]}
    bsdf = mi.load_dict(
        {"type": "cook_torrance", "diffuse_albedo": rgb, "specular_albedo": 0.3, "roughness": 0.2}
    )
    pointer, si = mi.BSDFPtr(bsdf), interaction(np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(
        array(pointer.eval_attribute_3("diffuse_albedo", si))[0], [0.1, 0.5, 0.9], rtol=EPS
    )
    np.testing.assert_allclose(array(pointer.eval_attribute_3("specular_albedo", si))[0], 0.3, rtol=EPS)
    assert array(pointer.eval_attribute_1("roughness", si))[0] == np.float32(0.2)
    luminance = 0.1 * 0.212671 + 0.5 * 0.715160 + 0.9 * 0.072169
    (got,) = array(bsdf.eval_attribute_1("diffuse_albedo", si))
    assert got == pytest.approx(luminance, rel=1e-4)
    assert bool(pointer.has_attribute("roughness")[0]) and not bool(pointer.has_attribute("metallic")[0])
    reflectance = array(bsdf.eval_diffuse_reflectance(si))[0]
    np.testing.assert_allclose(reflectance, np.array([0.1, 0.5, 0.9]) * 0.7, rtol=2 * EPS)
    assert array(pointer.eval_attribute_1("metallic", si))[0] == 0.0  # unknown, as in Mitsuba's BSDFs


def test_parameters_can_be_changed_and_differentiated() -> None:
    bsdf = mi.load_dict({"type": "cook_torrance", "roughness": 0.5})
    parameters = mi.traverse(bsdf)
    assert set(parameters.keys()) == {"diffuse_albedo.value", "specular_albedo.value", "roughness.value"}
    parameters["diffuse_albedo.value"] = 0.25
    parameters.update()
    si = interaction(np.array([[0.0, 0.0, 1.0]]))
    assert array(bsdf.eval_attribute_1("diffuse_albedo", si))[0] == pytest.approx(0.25)


def test_out_of_range_values_set_later_are_clamped() -> None:
    rng = np.random.default_rng(32)
    num = 20_000
    wild = np.float32([np.nan, -1.0, 2.0, np.inf, -np.inf, 0.5])
    d, s, r = rng.choice(wild, (num, 3)), rng.choice(wild, (num, 3)), rng.choice(wild, num)
    wi, wo = _directions(rng, np.full(num, 0.5), num)
    si = interaction(wi)
    bsdf = material(d, s, r, num)
    value, pdf = (array(v) for v in bsdf.eval_pdf(CTX, si, vector(wo)))
    weight = array(bsdf.sample(CTX, si, *_uniforms(rng, num))[1])
    for got in (value, pdf, weight):
        assert np.all(np.isfinite(got)) and got.min() >= 0.0
    np.testing.assert_allclose(value, oracle.eval_cos(wi, wo, d, s, r), rtol=1e-4, atol=1e-9)


def test_bad_textures_are_refused_with_their_file(tmp_path: Path) -> None:
    from datagen.foundation.errors import InputError
    from mitsuba_plugins import load_dict

    texels = np.full((4, 4, 3), 0.5, np.float32)
    texels[3, 0, 1] = np.inf
    mi.Bitmap(texels).write(str(tmp_path / "oak_color.exr"))
    texture = {"type": "bitmap", "filename": str(tmp_path / "oak_color.exr"), "raw": True}
    scene = {"type": "scene", "oak": {"type": "cook_torrance", "diffuse_albedo": texture, "roughness": 2.0}}
    with pytest.raises(InputError) as error:
        load_dict(scene)
    first, second = (str(problem) for problem in error.value.problems)  # all in one error
    assert first.startswith(
        "oak: diffuse_albedo.data = 1 of 48 values NaN or Inf in oak_color.exr (first at (3, 0"
    )
    assert second.startswith("oak: roughness = 2; expected values in [0, 1]")


def _bitmap(values: np.ndarray) -> dict[str, Any]:
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(values.astype(np.float32)),
        "raw": True,
        "format": "variant",
    }


@pytest.mark.parametrize(
    ("channel", "value", "message"),
    [
        ("roughness", 1.4, r"roughness = 1\.4; expected values in \[0, 1\]"),
        ("roughness", -0.1, r"roughness = -0\.1; expected values in \[0, 1\]"),
        ("roughness", float("nan"), "1 of 1 values NaN or Inf"),
        (
            "specular_albedo",
            "nan texture",
            r"specular_albedo\.data = 3 of 48 values NaN or Inf \(first at \(1, 2",
        ),
        (
            "diffuse_albedo",
            "bright texture",
            r"diffuse_albedo\.data = 0 \.\.\. 3; expected values in \[0, 1\]",
        ),
    ],
)
def test_bad_parameters_are_refused_by_name(channel: str, value: Any, message: str) -> None:
    from datagen.foundation.errors import InputError
    from mitsuba_plugins import load_dict

    if isinstance(value, str):
        texels = np.zeros((4, 4, 3), np.float32)
        texels[1, 2] = np.nan if value == "nan texture" else 3.0
        value = _bitmap(texels)
    with pytest.raises(InputError, match=message) as error:
        load_dict({"type": "scene", "chair_seat": {"type": "cook_torrance", channel: value}})
    assert error.value.problems[0].where == "chair_seat"

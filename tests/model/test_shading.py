# SPDX-License-Identifier: MIT
"""The torch BRDF and the spherical Gaussians: against brute force, at the extremes, and their gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from model import shading
from model.training import conditions
from oracles import brdf
from oracles import spherical_gaussians as oracle


def _directions(count: int, seed: int, min_cos: float = 0.02) -> np.ndarray:
    """Unit vectors (count, 3) of the upper hemisphere with a cosine of at least ``min_cos``."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(min_cos, 1.0, count)
    phi = rng.uniform(0, 2 * np.pi, count)
    s = np.sqrt(1 - z * z)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)


def _random_surface(count: int, dtype: torch.dtype, seed: int = 0) -> list[torch.Tensor]:
    """Random D, S, R, normals, view and light directions of ``count`` points; R is from 0 to 1."""
    rng = np.random.default_rng(seed)
    frame = np.linalg.qr(rng.standard_normal((count, 3, 3)))[0]
    world = [np.einsum("nij,nj->ni", frame, _directions(count, seed + k)) for k in (1, 2)]
    arrays = [
        rng.uniform(0, 1, (count, 3)),
        rng.uniform(0, 1, (count, 3)),
        np.linspace(0, 1, count)[:, None],
        frame[:, :, 2],
        *world,
    ]
    return [torch.as_tensor(a, dtype=dtype) for a in arrays]


def test_lobe_integrates_to_one_over_projected_area():
    """The integral of D_b cos over the hemisphere is 1 at every alpha; a lobe 5 % too strong is detected."""
    for alpha in (1e-3, 0.01, 0.1, 0.5, 1.0):
        a = torch.tensor(alpha, dtype=torch.float64)
        # d(omega) cos = pi d(sin^2) = pi cos^4 d(tan^2): substitute tan^2 = alpha^2 x
        x = (torch.arange(200_000, dtype=torch.float64) + 0.5) * (60.0 / 200_000)
        tan2 = alpha**2 * x
        integrand = torch.exp(shading.beckmann_log_pdf(tan2, a)) * math.pi / (1 + tan2) ** 2 * alpha**2
        total = float(integrand.sum() * (60.0 / 200_000))
        assert total == pytest.approx(1.0, abs=1e-6)
        assert abs(total * 1.05 - 1.0) > 1e-6


def test_smith_matches_the_textbook_form_and_stays_finite_at_the_horizon():
    cos = torch.linspace(0.05, 0.999, 50, dtype=torch.float64)
    for alpha in (1e-3, 0.05, 0.3, 1.0):
        al = torch.tensor(alpha, dtype=torch.float64)
        a = cos / (alpha * torch.sqrt(1 - cos**2))
        textbook = 2 / (1 + torch.erf(a) + torch.exp(-a * a) / (a * math.sqrt(math.pi)))
        ours = shading.smith_g1_over_cos(cos, 1 - cos**2, al) * cos
        torch.testing.assert_close(ours, textbook, rtol=1e-12, atol=0)
    at_horizon = shading.smith_g1_over_cos(torch.tensor(1e-30), torch.tensor(1.0), torch.tensor(0.25))
    assert float(at_horizon) == pytest.approx(2 * math.sqrt(math.pi) / 0.25, rel=1e-6)


def test_brdf_is_reciprocal_except_for_the_cosine():
    d, s, r, n, o, i = _random_surface(500, torch.float64)
    forward = shading.brdf_cos(d, s, r, n, o, i) / shading.dot(n, i)
    backward = shading.brdf_cos(d, s, r, n, i, o) / shading.dot(n, o)
    torch.testing.assert_close(forward, backward, rtol=1e-10, atol=1e-300)


def _angle_grid(dtype: torch.dtype) -> list[torch.Tensor]:
    """D, S, R, normals, view and light directions on a grid of roughness and angles, in the local frame."""
    angles = np.radians([0.0, 1.0, 10.0, 30.0, 60.0, 80.0, 89.0])
    grids = np.meshgrid([0.0, 0.05, 0.1, 0.3, 0.6, 1.0], angles, angles, [0.0, 2.0, np.pi], indexing="ij")
    roughness, theta_o, theta_i, phi = (g.ravel() for g in grids)
    rng = np.random.default_rng(0)
    albedo = rng.uniform(0, 1, (2, len(phi), 3))
    arrays = [albedo[0], albedo[1], roughness[:, None], np.tile([0.0, 0.0, 1.0], (len(phi), 1))]
    arrays += [brdf.direction(theta_o, 0 * phi), brdf.direction(theta_i, phi)]
    return [torch.as_tensor(a, dtype=dtype) for a in arrays]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_brdf_against_the_oracle(dtype, tolerance):
    """Error relative to the oracle for the same rounded directions; a roughness 5 % off is detected."""
    d, s, r, n, o, i = _angle_grid(dtype)
    wi, wo, diffuse, specular, rough = (t.double().numpy() for t in (o, i, d, s, r[:, 0]))
    expected = brdf.eval_cos(wi, wo, diffuse, specular, rough)
    got = shading.brdf_cos(d, s, r, n, o, i).double().numpy()
    scale = np.maximum(np.abs(expected), 1e-5)
    assert (np.abs(got - expected) / scale).max() < tolerance
    wrong = shading.brdf_cos(d, s, 1.05 * r, n, o, i).double().numpy()
    assert (np.abs(wrong - expected) / scale).max() > 100 * tolerance


def test_brdf_agrees_with_the_renderer():
    """The Dr.Jit plugin and the torch BRDF on the same grid, to 1e-4 relative."""
    from oracles import bsdf_probe as probe

    d, s, r, n, o, i = _angle_grid(torch.float32)
    plugin = probe.material(d.numpy(), s.numpy(), r[:, 0].numpy(), len(r))
    context = probe.mi.BSDFContext()
    rendered = plugin.eval(context, probe.interaction(o.numpy()), probe.vector(i.numpy()))
    ours = shading.brdf_cos(d, s, r, n, o, i)
    expected = torch.from_numpy(np.ascontiguousarray(probe.array(rendered)))
    assert expected.max() > 10
    assert ((ours - expected).abs() / expected.clamp_min(1e-5)).max() < 1e-4


def test_float32_is_close_to_float64():
    """The median error is below 1e-6 and the 99th percentile below 1e-4, on the same rounded inputs."""
    single = _random_surface(4000, torch.float32)
    double = [t.double() for t in single]
    approx = shading.brdf_cos(*single).double()
    exact = shading.brdf_cos(*double)
    error = ((approx - exact).abs() / exact.clamp_min(1e-6)).flatten()
    assert error.median() < 1e-6
    assert error.quantile(0.99) < 1e-4


def test_rotating_the_frame_changes_nothing():
    d, s, r, n, o, i = _random_surface(200, torch.float64)
    rotation = torch.linalg.qr(
        torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    )[0]
    turned = [v @ rotation.T for v in (n, o, i)]
    torch.testing.assert_close(shading.brdf_cos(d, s, r, *turned), shading.brdf_cos(d, s, r, n, o, i))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_and_gradients_are_finite_at_every_extreme(dtype):
    """Grazing angles, coincident and opposite directions, zero vectors, alpha at its floor, light from
    below."""
    up = [0.0, 0.0, 1.0]
    cases = [up, [0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]
    for exponent in range(-12, 0):
        e = 10.0**exponent
        cases += [
            [math.sqrt(1 - e * e), 0.0, e],
            [-math.sqrt(1 - e * e), 0.0, e],
            [e, 0.0, math.sqrt(1 - e * e)],
        ]
    vectors = torch.tensor(cases, dtype=dtype)
    k = len(cases)
    grid = torch.cartesian_prod(torch.arange(k), torch.arange(k))
    for normal in (up, [0.0, 0.0, 0.0]):
        for roughness in (0.0, 1e-4, math.sqrt(shading.ALPHA_MIN), 0.2, 1.0):
            o, i = (vectors[grid[:, j]].clone().requires_grad_() for j in (0, 1))
            n = torch.tensor([normal], dtype=dtype).repeat(len(grid), 1).requires_grad_()
            maps = [
                torch.full((len(grid), c), v, dtype=dtype, requires_grad=True)
                for c, v in ((3, 0.5), (3, 0.04))
            ]
            r = torch.full((len(grid), 1), roughness, dtype=dtype, requires_grad=True)
            value = shading.brdf_cos(*maps, r, n, o, i)
            assert torch.isfinite(value).all() and (value >= 0).all()
            if normal == up:
                below = (vectors[grid[:, 0], 2] <= 0) | (vectors[grid[:, 1], 2] <= 0)
                assert (value[below] == 0).all()
            lights = shading.SphericalGaussians(
                i.unsqueeze(1),
                torch.full((len(grid), 1), 200.0, dtype=dtype),
                torch.ones(len(grid), 1, 3, dtype=dtype),
            )
            area = shading.shade_spherical_gaussians(*maps, r, n, o, lights)
            assert torch.isfinite(area).all() and (area >= 0).all()
            for output in (value, area):
                gradients = torch.autograd.grad(
                    output.sum(), [*maps, r, n, o, i], allow_unused=True, retain_graph=True
                )
                for gradient in gradients:
                    assert gradient is None or torch.isfinite(gradient).all()


def test_gradcheck_of_the_brdf():
    d, s, r, n, o, i = _random_surface(6, torch.float64, seed=4)
    r = 0.2 + 0.7 * r
    inputs = [t.detach().requires_grad_() for t in (d, s, r, n, o, i)]
    assert torch.autograd.gradcheck(shading.brdf_cos, inputs, eps=1e-6, atol=1e-5, rtol=1e-4)


def test_gradcheck_of_both_lights():
    d, s, r, n, o, i = _random_surface(4, torch.float64, seed=5)
    r = 0.3 + 0.6 * r
    maps = [t.detach().requires_grad_() for t in (d, s, r)]
    lights = shading.SphericalGaussians(
        i.unsqueeze(1),
        torch.full((4, 1), 20.0, dtype=torch.float64),
        torch.ones(4, 1, 3, dtype=torch.float64),
    )
    position = torch.zeros(4, 3, dtype=torch.float64)
    intensity = torch.ones(4, 1, dtype=torch.float64)

    def both(*m: torch.Tensor) -> torch.Tensor:
        return shading.shade_spherical_gaussians(*m, n, o, lights) + shading.shade_point_light(
            *m, n, o, position, 2 * i, intensity
        )

    assert torch.autograd.gradcheck(both, maps, eps=1e-6, atol=1e-5, rtol=1e-4)


def test_point_light_falls_off_with_the_squared_distance():
    d, s, r, n, o, i = _random_surface(20, torch.float64)
    zero, one = torch.zeros(20, 3, dtype=torch.float64), torch.ones(20, 1, dtype=torch.float64)
    near = shading.shade_point_light(d, s, r, n, o, zero, i, one)
    far = shading.shade_point_light(d, s, r, n, o, zero, 3 * i, one)
    torch.testing.assert_close(near, 9 * far)
    torch.testing.assert_close(near, shading.brdf_cos(d, s, r, n, o, i))


def test_inner_product_against_quadrature():
    rng = np.random.default_rng(1)
    for sharp1, sharp2 in ((0.5, 2.0), (10.0, 10.0), (200.0, 3.0), (1000.0, 200.0)):
        p1, p2 = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        expected = oracle.inner_product(p1, sharp1, p2, sharp2)
        gap2 = torch.tensor(((p1 - p2) ** 2).sum())
        got = shading.sg_inner_product(torch.tensor(sharp1).double(), torch.tensor(sharp2).double(), gap2)
        assert float(got) == pytest.approx(expected, rel=1e-6, abs=1e-300)
        assert float(got) * 1.05 != pytest.approx(expected, rel=1e-6, abs=1e-300)


def test_inner_product_is_stable_in_float32():
    """A lobe of alpha = 1e-3 (sharpness 5e6) against one of 200: naive exponents overflow there."""
    gap2 = torch.tensor([0.0, 1e-6, 1e-3, 0.1, 4.0])
    args = torch.tensor(5e6), torch.tensor(200.0)
    single = shading.sg_inner_product(*args, gap2)
    double = shading.sg_inner_product(*(a.double() for a in args), gap2.double())
    assert torch.isfinite(single).all()
    torch.testing.assert_close(single.double(), double, rtol=2e-5, atol=1e-30)


@pytest.mark.parametrize("sharpness", [0.5, 2.0, 10.0, 50.0, 200.0])
def test_irradiance_against_quadrature(sharpness):
    """The error is below 1.2 % of the lobe's maximum irradiance; an error of 5 % is detected."""
    peak = oracle.irradiance(sharpness, 1.0)
    for cos_beta in (-1.0, -0.5, -0.1, 0.0, 0.3, 0.7, 1.0):
        got = float(shading.sg_irradiance(torch.tensor(sharpness), torch.tensor(cos_beta)))
        assert abs(got - oracle.irradiance(sharpness, cos_beta)) < 0.012 * peak
    wrong = 1.05 * float(shading.sg_irradiance(torch.tensor(sharpness), torch.tensor(1.0)))
    assert abs(wrong - peak) > 0.012 * peak


@pytest.mark.parametrize(("alpha", "expected"), [(0.1, 0.010), (0.2, 0.038), (0.3, 0.083)])
def test_the_gaussian_lobe_departs_from_beckmann_as_documented(alpha, expected):
    """Cosine-weighted relative L1 distance between the Beckmann lobe and its Gaussian."""
    theta = torch.linspace(0, math.pi / 2 - 1e-4, 40_000, dtype=torch.float64)
    a = torch.tensor(alpha, dtype=torch.float64)
    exact = torch.exp(shading.beckmann_log_pdf(torch.tan(theta) ** 2, a))
    gaussian = torch.exp(2 / a**2 * (torch.cos(theta) - 1)) / (math.pi * a**2)
    weight = torch.cos(theta) * torch.sin(theta)
    error = float(((exact - gaussian).abs() * weight).sum() / (exact * weight).sum())
    assert error == pytest.approx(expected, rel=0.1)


def test_area_light_approaches_a_point_light_of_the_same_irradiance():
    """A sharp lobe on a diffuse surface reflects D/pi times its irradiance."""
    d = torch.full((1, 3), 0.6, dtype=torch.float64)
    s = torch.zeros(1, 3, dtype=torch.float64)
    n = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    axis = torch.tensor([[[0.6, 0.0, 0.8]]], dtype=torch.float64)
    sharpness = torch.full((1, 1), 3000.0, dtype=torch.float64)
    amplitude = (1.0 / shading.sg_integral(sharpness)).unsqueeze(-1).expand(1, 1, 3)
    lights = shading.SphericalGaussians(axis, sharpness, amplitude)
    radiance = shading.shade_spherical_gaussians(
        d, s, torch.full((1, 1), 0.5, dtype=torch.float64), n, n, lights
    )
    schlick_rest = radiance - 0.6 * 0.8 / math.pi
    assert float(schlick_rest.abs().max()) < 0.012 * 0.6 / math.pi + 2e-3


# --- conditions -------------------------------------------------------------------------------------------


def _geometry(batch: int = 3, size: int = 24) -> conditions.Geometry:
    """A tilted plane 2 m in front of the camera; half of the last image is empty."""
    y, x = torch.meshgrid(torch.linspace(-0.6, 0.6, size), torch.linspace(-0.6, 0.6, size), indexing="ij")
    normal = torch.nn.functional.normalize(torch.tensor([0.2, -0.3, -1.0]), dim=0)
    z = 2.0 / (1.0 - 0.2 * x + 0.3 * y)
    position = torch.stack([x * z, y * z, z]).repeat(batch, 1, 1, 1)
    mask = torch.ones(batch, 1, size, size, dtype=torch.bool)
    mask[-1, :, : size // 2] = False
    return conditions.Geometry(position * mask, normal.reshape(1, 3, 1, 1) * mask, mask)


def _draws(batch: int, seed: int = 0) -> conditions.SampleDraws:
    return conditions.SampleDraws.for_samples(seed, range(batch))


def test_conditions_of_an_image_do_not_depend_on_the_batch():
    geometry = _geometry()
    whole = conditions.sample_area_condition(geometry, _draws(3))
    part = conditions.Geometry(*(t[1:2] for t in (geometry.position, geometry.normal, geometry.mask)))
    alone = conditions.sample_area_condition(part, conditions.SampleDraws.for_samples(0, [1]))
    assert torch.equal(alone.lights.axis, whole.lights.axis[1:2])
    assert torch.equal(alone.view_dir, whole.view_dir[1:2])


def test_conditions_are_reproducible_and_distinct():
    geometry = _geometry()
    first = conditions.sample_point_condition(geometry, _draws(3, 0))
    again = conditions.sample_point_condition(geometry, _draws(3, 0))
    other = conditions.sample_point_condition(geometry, _draws(3, 1))
    assert torch.equal(first.light_position, again.light_position)
    assert not torch.equal(first.light_position, other.light_position)
    assert not torch.allclose(first.light_position[0], first.light_position[1])


def test_views_are_on_the_disc_and_cosine_weighted():
    """E[cos] under a disc of r^2 <= 0.9 is (1 - 0.1^1.5)/0.9/1.5; a bias of 5 % is detected."""
    geometry = _geometry(batch=4000, size=2)
    view = conditions.sample_views(geometry, _draws(4000))
    original = shading.normalize(-geometry.position)
    cosine = shading.dot(view, original)[:-1].flatten(1)[:, 0].double()
    assert cosine.min() >= math.sqrt(0.1) - 1e-3
    expected = (1 - 0.1**1.5) / (0.9 * 1.5)
    error = cosine.std() / math.sqrt(len(cosine))
    assert abs(cosine.mean() - expected) < 4 * error
    assert abs(cosine.mean() * 1.05 - expected) > 4 * error


def test_point_light_is_in_the_mirror_direction_of_one_pixel():
    geometry = _geometry()
    condition = conditions.sample_point_condition(geometry, _draws(3))
    light_dir = shading.normalize(condition.light_position - geometry.position)
    half = shading.normalize(light_dir + condition.view_dir)
    best = (shading.dot(half, geometry.normal) * geometry.mask).flatten(1).max(dim=1).values
    assert (best > 0.99999).all()  # the highlight is exactly centred at some pixel
    aligned = (shading.dot(half, geometry.normal) > 0.9999) & geometry.mask
    assert aligned.float().mean() < 0.5  # and not everywhere, so the lobe's shape is visible


def test_area_lights_have_unit_mean_energy_and_the_documented_range():
    condition = conditions.sample_area_condition(_geometry(), _draws(3))
    lights = condition.lights
    assert ((lights.sharpness >= 2.0) & (lights.sharpness <= 200.0)).all()
    assert (lights.axis[..., 2] <= 0).all()
    energy = (lights.amplitude * shading.sg_integral(lights.sharpness).unsqueeze(-1)).sum(dim=1).mean(dim=1)
    torch.testing.assert_close(energy, torch.full_like(energy, math.pi), rtol=1e-4, atol=0)


def test_an_empty_crop_is_shaded_black_without_nan():
    geometry = conditions.Geometry(
        torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 8), torch.zeros(1, 1, 8, 8, dtype=torch.bool)
    )
    point = conditions.sample_point_condition(geometry, _draws(1))
    area = conditions.sample_area_condition(geometry, _draws(1))
    d, s, r = torch.rand(1, 3, 8, 8), torch.rand(1, 3, 8, 8), torch.rand(1, 1, 8, 8)
    lit = shading.shade_point_light(
        d, s, r, geometry.normal, point.view_dir, geometry.position, point.light_position, point.intensity
    )
    assert (lit == 0).all()
    assert (
        shading.shade_spherical_gaussians(d, s, r, geometry.normal, area.view_dir, area.lights) == 0
    ).all()

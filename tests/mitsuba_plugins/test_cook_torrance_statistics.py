# SPDX-License-Identifier: MIT
"""Sampling against density (chi-square) and renders against Mitsuba's BSDFs (Z-test).

Significance is corrected for the number of tests (Sidak), and an injected 5 % error must be detected.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from oracles import brdf as oracle
from oracles.bsdf_probe import dr, mi, vector

from mitsuba.chi2 import ChiSquareTest, SphericalDomain  # isort: skip  (needs the variant)

SIGNIFICANCE = 0.01
ANGLES_DEG = (0.0, 30.0, 60.0, 80.0, 88.0)
# At these, the lobe is narrower than the cells of a spherical grid, so the histogram is over slopes.
NARROW_ROUGHNESS = (0.0, 0.05, 0.15, 0.3)
WIDE_ROUGHNESS = (0.5, 0.7, 1.0)
NUM_SAMPLES = 200_000
NUM_CHI2_TESTS = len(ANGLES_DEG) * (len(NARROW_ROUGHNESS) + len(WIDE_ROUGHNESS))


class SlopeDomain:
    """Directions parametrised by the half vector's slopes s: (1 - exp(-|s|^2 / alpha^2), azimuth / 2 pi).

    For half vectors of density D cos both are uniform, so cells are filled about equally at any alpha.
    """

    def __init__(self, wi: np.ndarray, alpha: float):
        self.wi = mi.Vector3f(*(float(c) for c in wi))
        self.alpha = alpha

    def bounds(self) -> Any:
        return mi.ScalarBoundingBox2f([0.0, 0.0], [1.0, 1.0])

    def aspect(self) -> float:
        return 1.0

    def map_forward(self, p: Any) -> Any:
        radius = self.alpha * dr.sqrt(-dr.log(dr.maximum(1.0 - p.x, 1e-7)))
        sin, cos = dr.sincos(2.0 * dr.pi * p.y)
        h = dr.normalize(mi.Vector3f(-radius * cos, -radius * sin, 1.0))
        return 2.0 * dr.dot(self.wi, h) * h - self.wi

    def map_backward(self, wo: Any) -> Any:
        h = self.wi + wo
        x, y = -h.x / h.z, -h.y / h.z
        turn = dr.atan2(y, x) / (2.0 * dr.pi)
        turn = dr.select(turn < 0.0, turn + 1.0, turn)
        return mi.Point2f(1.0 - dr.exp(-(dr.square(x) + dr.square(y)) / self.alpha**2), turn)

    def density_factor(self, wo: Any) -> Any:
        """d(solid angle of wo) / d(u, v): 4 (wi.h) for reflection, cos^3 for slopes, pi alpha^2 exp(r^2)."""
        h = dr.normalize(self.wi + wo)
        r2 = (dr.square(h.x) + dr.square(h.y)) / dr.square(h.z) / self.alpha**2
        return 4.0 * dr.maximum(dr.dot(self.wi, h), 0.0) * h.z**3 * dr.pi * self.alpha**2 * dr.exp(r2)


def _bsdf(roughness: float) -> Any:
    return mi.load_dict(
        {"type": "cook_torrance", "diffuse_albedo": 0.4, "specular_albedo": 0.3, "roughness": roughness}
    )


def _chi2_test(
    angle_deg: float, roughness: float, pdf_roughness: float, specular_only: bool = False
) -> ChiSquareTest:
    """Chi-square test of samples of one roughness against the density of another."""
    is_narrow = roughness in NARROW_ROUGHNESS
    wi = oracle.direction(np.array(np.radians(angle_deg)), np.array(0.7))
    sampled, described = _bsdf(roughness), _bsdf(pdf_roughness)
    ctx = mi.BSDFContext()
    if (
        is_narrow or specular_only
    ):  # only the specular lobe, because the diffuse one would fall into the last column of cells
        ctx.type_mask = +mi.BSDFFlags.GlossyReflection
    domain = SlopeDomain(wi, float(oracle.alpha_from_roughness(np.float64(roughness)))) if is_narrow else None

    def interaction() -> Any:
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = vector(wi[None])
        dr.make_opaque(si.wi)
        return si

    def sample(u: Any) -> Any:
        bs, _ = sampled.sample(ctx, interaction(), u[0], mi.Point2f(u[1], u[2]))
        is_valid = bs.pdf > 0.0
        return dr.select(is_valid, bs.wo, mi.Vector3f(0.0, 0.0, 1.0)), dr.select(is_valid, 1.0, 0.0)

    def density(wo: Any) -> Any:
        pdf = described.pdf(ctx, interaction(), wo)
        return pdf * domain.density_factor(wo) if domain else pdf

    return ChiSquareTest(
        domain=domain or SphericalDomain(),
        sample_func=sample,
        pdf_func=density,
        sample_dim=3,
        sample_count=NUM_SAMPLES,
        res=31 if is_narrow else 61,
        ires=12,
        seed=5,
    )


@pytest.mark.parametrize("roughness", NARROW_ROUGHNESS + WIDE_ROUGHNESS)
@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_samples_follow_their_density(angle_deg: float, roughness: float) -> None:
    test = _chi2_test(angle_deg, roughness, roughness)
    assert test.run(SIGNIFICANCE, NUM_CHI2_TESTS, quiet=True), test.messages


@pytest.mark.parametrize("roughness", NARROW_ROUGHNESS[1:] + WIDE_ROUGHNESS)
@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_a_wrong_density_is_detected(angle_deg: float, roughness: float) -> None:
    """Injected fault: the density's alpha is 5 % too small, without the diffuse lobe, which would hide it."""
    test = _chi2_test(angle_deg, roughness, roughness * np.sqrt(0.95), specular_only=True)
    assert not test.run(SIGNIFICANCE, NUM_CHI2_TESTS, quiet=True)


# ---- renders in the limits where Mitsuba has an equal model ----

SIZE = 20
NUM_RENDERS = 24
SPP = 96
# Limit -> (channels, Mitsuba's BSDF).
LIMITS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    # At S = 1, the Fresnel term is 1 and there is no diffuse part, as for ideal mirror microfacets.
    "mirror, alpha 0.04": (
        {"diffuse_albedo": 0.7, "specular_albedo": 1.0, "roughness": 0.2},
        {"type": "roughconductor", "material": "none", "alpha": 0.04, "distribution": "beckmann"},
    ),
    "mirror, alpha 0.36": (
        {"diffuse_albedo": 0.7, "specular_albedo": 1.0, "roughness": 0.6},
        {"type": "roughconductor", "material": "none", "alpha": 0.36, "distribution": "beckmann"},
    ),
}


def _scene(bsdf: dict[str, Any]) -> Any:
    transform = mi.ScalarTransform4f
    sky = np.ones((16, 32, 3), np.float32)
    sky[2:6, 4:9] = 8.0  # a small emitter that resolves the lobe's shape
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": transform().look_at([0, -4, 1], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
                "sampler": {"type": "independent"},
            },
            "sky": {
                "type": "envmap",
                "bitmap": mi.Bitmap(sky),
                "to_world": transform().rotate([1, 0, 0], 90),
            },
            "object": {"type": "sphere", "bsdf": {"type": "twosided", "nested": bsdf}},
        }
    )


def _renders(bsdf: dict[str, Any], first_seed: int) -> np.ndarray:
    """Return the green channel of independent renders of one view, (NUM_RENDERS, pixels)."""
    scene = _scene(bsdf)
    images = [np.array(mi.render(scene, spp=SPP, seed=first_seed + i)) for i in range(NUM_RENDERS)]
    return np.stack(images)[..., 1].reshape(NUM_RENDERS, -1).astype(np.float64)


def _largest_z(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Return the largest |t| of all pixels and its threshold: two-sample t-tests, with Sidak's correction."""
    from scipy.stats import t

    variance = (a.var(0, ddof=1) + b.var(0, ddof=1)) / NUM_RENDERS
    z = np.abs(a.mean(0) - b.mean(0)) / np.sqrt(np.maximum(variance, 1e-12))
    num_tests = a.shape[1] * (len(LIMITS) + 1)
    level = 1.0 - (1.0 - SIGNIFICANCE) ** (1.0 / num_tests)
    return float(z.max()), float(t.isf(level / 2, 2 * NUM_RENDERS - 2))


@pytest.mark.parametrize("limit", LIMITS)
def test_renders_like_roughconductor(limit: str) -> None:
    channels, builtin = LIMITS[limit]
    ours = _renders({"type": "cook_torrance", **channels}, 1000)
    z, threshold = _largest_z(ours, _renders(builtin, 2000))
    assert z < threshold
    twin = _renders({**builtin, "specular_reflectance": 0.95}, 3000)
    z, threshold = _largest_z(ours, twin)
    assert z > threshold


def test_diffuse_term_renders_like_diffuse() -> None:
    """At S = 0 the diffuse component equals Mitsuba's ``diffuse``, although it is sampled differently."""
    import mitsuba_plugins.cook_torrance as module

    class DiffuseOnly(module.CookTorrance):
        """The diffuse component of ``cook_torrance``."""

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return super().eval_pdf(_diffuse_context(), si, wo, active)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            return super().sample(_diffuse_context(), si, sample1, sample2, active)

        def eval_pdf_sample(self, ctx: Any, si: Any, wo: Any, s1: Any, s2: Any, active: Any = True) -> Any:
            return super().eval_pdf_sample(_diffuse_context(), si, wo, s1, s2, active)

    mi.register_bsdf("cook_torrance_diffuse_only", DiffuseOnly)
    ours = _renders(
        {"type": "cook_torrance_diffuse_only", "diffuse_albedo": 0.6, "specular_albedo": 0.0}, 1000
    )
    z, threshold = _largest_z(ours, _renders({"type": "diffuse", "reflectance": 0.6}, 2000))
    assert z < threshold
    z, threshold = _largest_z(ours, _renders({"type": "diffuse", "reflectance": 0.63}, 3000))
    assert z > threshold


def _diffuse_context() -> Any:
    ctx = mi.BSDFContext()
    ctx.type_mask = +mi.BSDFFlags.DiffuseReflection
    return ctx


@pytest.mark.parametrize("radiance", [1e-6, 1e6])
def test_renders_scale_with_radiance(radiance: float) -> None:
    """Scaling the light by 1e-6 or 1e6 scales the image by the same factor, given the same samples."""
    own = {"type": "cook_torrance", "diffuse_albedo": 0.5, "specular_albedo": 0.3, "roughness": 0.2}

    def render(level: float) -> np.ndarray:
        scene = _scene(own)
        parameters = mi.traverse(scene)
        parameters["sky.data"] = parameters["sky.data"] * level
        parameters.update()
        return np.array(mi.render(scene, spp=16, seed=1))

    np.testing.assert_allclose(render(radiance) / radiance, render(1.0), rtol=1e-4, atol=1e-6)

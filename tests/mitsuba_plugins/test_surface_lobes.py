# SPDX-License-Identifier: MIT
"""``SurfaceLobes``, evaluated without an indirect call, equal Mitsuba's BSDF in the same wrappers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from oracles.bsdf_probe import array, dr, mi

from mitsuba_plugins.surface_material import (  # isort: skip
    SurfaceChannels,
    SurfaceLobes,
    build_evaluator,
)

NUM = 4096
COATED = {
    "type": "cook_torrance",
    "diffuse_albedo": {"type": "rgb", "value": [0.6, 0.3, 0.1]},
    "specular_albedo": {"type": "rgb", "value": [0.2, 0.1, 0.04]},
    "roughness": 0.4,
}
TILTED = {
    "type": "normalmap",
    "normalmap": {"type": "rgb", "value": [0.7, 0.6, 0.9]},
    "nested": COATED,
}


def directions(generator: np.random.Generator) -> Any:
    """Return NUM unit directions, uniform on the sphere."""
    values = generator.normal(size=(3, NUM))
    return mi.Vector3f(*(mi.Float(v) for v in (values / np.linalg.norm(values, axis=0)).astype(np.float32)))


@pytest.fixture(scope="module")
def hits() -> Any:
    """Return NUM surface interactions with incident directions on both sides."""
    si = dr.zeros(mi.SurfaceInteraction3f, NUM)
    si.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    si.wi = directions(np.random.default_rng(1))
    return si


def lobes_of(description: dict[str, Any], si: Any) -> tuple[Any, SurfaceLobes]:
    """Return Mitsuba's BSDF of a material and the project's lobes at ``si``."""
    bsdf = mi.load_dict(description)
    evaluator, _ = build_evaluator(bsdf)
    channels = SurfaceChannels(*evaluator(si, mi.Bool(True)))
    return bsdf, SurfaceLobes(channels, si, mi.Bool(True), description is TILTED)


@pytest.mark.parametrize("description", [COATED, TILTED], ids=["plain", "normal map"])
def test_value_and_density_are_those_of_the_bsdf(hits: Any, description: dict[str, Any]) -> None:
    bsdf, lobes = lobes_of(description, hits)
    wo = directions(np.random.default_rng(2))
    expected_value, expected_pdf = bsdf.eval_pdf(mi.BSDFContext(), hits, wo)
    value, pdf = lobes.eval_pdf(wo)
    assert 0.2 < np.count_nonzero(array(pdf)) / NUM < 0.6
    np.testing.assert_allclose(array(value), array(expected_value), rtol=2e-4, atol=1e-6)
    np.testing.assert_allclose(array(pdf), array(expected_pdf), rtol=2e-4, atol=1e-6)


@pytest.mark.parametrize("description", [COATED, TILTED], ids=["plain", "normal map"])
def test_samples_have_the_stated_density_and_weight(hits: Any, description: dict[str, Any]) -> None:
    _, lobes = lobes_of(description, hits)
    generator = np.random.default_rng(3)
    choice, x, y = (mi.Float(generator.uniform(size=NUM).astype(np.float32)) for _ in range(3))
    wo, pdf, weight = lobes.sample(choice, mi.Point2f(x, y))
    value, density = lobes.eval_pdf(wo)
    is_sampled = array(pdf) > 0
    assert is_sampled.mean() > 0.8
    np.testing.assert_allclose(array(density)[is_sampled], array(pdf)[is_sampled], rtol=1e-3)
    np.testing.assert_allclose(
        (array(weight) * array(pdf)[:, None])[is_sampled], array(value)[is_sampled], rtol=2e-3, atol=1e-5
    )

# SPDX-License-Identifier: MIT
"""Baked shading Ld (diffuse), Ls0, Ls1 (specular) against float64 integrals, and the solve for materials."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import mesh_scene
from datagen.light.background import NEAR, Background
from datagen.light.bake import Baker
from datagen.light.cells import surfel_cells
from datagen.light.emitters import Emitters
from datagen.light.radiance_field import RadianceField
from datagen.light.surfels import CellGrid, Observations, Surfels, weighted_medians
from model.reconstruction.light.solve import (
    EXACT_RESIDUAL,
    MATTE_ALLOWANCE,
    NETWORK_VARIANCE,
    REFERENCE_OBSERVATIONS,
    REGION_SHARE,
    ROUGHNESS_LEVELS,
    SPECULAR_LEVELS,
    Costs,
    PriorWeights,
    SolvedSegments,
    decide,
    segment_costs,
    shared_roughness,
)

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
RADIANCE = np.array([3.0, 2.0, 1.0])
ABOVE = 0.25
"""Height (m) of a panel of 0.6 x 0.6 m, centred above the origin, that emits downwards."""


def background(radiance: NDArray) -> Background:
    """Background of uniform radiance."""
    every = np.ones(NEAR.num_bins, dtype=bool)
    low, high = np.full(3, -5.0), np.full(3, 5.0)
    return Background(low, high, np.tile(radiance, (NEAR.num_bins, 1)).astype(np.float32), every, every)


def dark_surfel() -> Surfels:
    """A surfel that no ray hits."""
    surfel = np.array([0, -1, -1, -1, -1, -1], np.int32)
    grid = CellGrid(np.full(3, -5.0), 10.0, np.array([1, 1, 1]), surfel)
    row, one = np.zeros((1, 3), np.float32), np.zeros(1, np.int32)
    seen = Observations(np.array([0, 1]), one, row, np.ones(1, np.float32), row)
    return Surfels(grid, row, row, one, row, np.zeros(1, bool), seen, row, (), ())


def panel() -> tuple[Mesh, Emitters]:
    corners = np.array([[-0.3, -0.3, ABOVE], [-0.3, 0.3, ABOVE], [0.3, 0.3, ABOVE], [0.3, -0.3, ABOVE]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    mesh = Mesh(corners.astype(np.float32), faces, None, None)
    emitters = Emitters(
        np.zeros(2, np.int32),
        RADIANCE[None].astype(np.float32),
        np.ones(2, np.float32),
        np.arange(2, dtype=np.int32),
        corners[faces].astype(np.float32),
        np.full(2, 0.18 * RADIANCE @ LUMINANCE_WEIGHTS, np.float32),
    )
    return mesh, emitters


@lru_cache(maxsize=2)
def baker(*, has_sky: bool) -> Baker:
    mesh, emitters = panel()
    sky = background(0.5 * RADIANCE if has_sky else np.zeros(3))
    return Baker(RadianceField(mesh_scene(mesh), surfel_cells(dark_surfel()), emitters, sky), 1e-2)


def hemisphere(num: int = 1200) -> tuple[NDArray, NDArray]:
    """Grid of directions (K, 3), uniform in cosine and azimuth, and their solid angles (K,)."""
    z = (np.arange(num) + 0.5) / num
    azimuth = (np.arange(num) + 0.5) / num * 2 * np.pi
    z, azimuth = (part.ravel() for part in np.meshgrid(z, azimuth, indexing="ij"))
    radius = np.sqrt(1 - z**2)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    return directions, np.full(len(directions), 2 * np.pi / len(directions))


def incoming(point: NDArray, direction: NDArray, *, has_sky: bool) -> NDArray[np.float64]:
    """Incident radiance in units of RADIANCE: 1 from the panel, else 0.5 with ``has_sky``, else 0."""
    t = (ABOVE - point[2]) / np.maximum(direction[:, 2], 1e-12)
    place = point[None, :2] + t[:, None] * direction[:, :2]
    hits = (np.abs(place) < 0.3).all(axis=1)
    return np.where(hits, 1.0, 0.5 if has_sky else 0.0)


POINTS = np.array([[0.0, 0.0, 0.0], [0.25, -0.1, 0.0], [0.6, 0.4, 0.0]])


@pytest.mark.parametrize("has_sky", [False, True])
def test_diffuse_shading(has_sky: bool) -> None:
    """Ld is within 1 % of the integral of L cos / pi."""
    normal = np.tile([0.0, 0.0, 1.0], (len(POINTS), 1))
    found = baker(has_sky=has_sky).irradiance(POINTS, normal, 4096)
    directions, solid = hemisphere()
    for point, value in zip(POINTS, found.diffuse, strict=True):
        true = (incoming(point, directions, has_sky=has_sky) * directions[:, 2] * solid).sum() / np.pi
        np.testing.assert_allclose(value, true * RADIANCE, rtol=0.01)
    assert found.known == pytest.approx(1.0)


def lobes(wi: NDArray, wo: NDArray, alpha: float) -> tuple[NDArray, NDArray]:
    """The specular BRDF times cos_o in float64, in two parts: D G / (4 cos_i) times 1 - f, and times f, with
    f = (1 - h.i)^5, for directions ``wi`` (3,) or (N, 3) and ``wo`` (N, 3)."""
    from scipy.special import erf

    half = wi + wo
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    tan2 = (half[:, 0] ** 2 + half[:, 1] ** 2) / half[:, 2] ** 2
    density = np.exp(-tan2 / alpha**2) / (np.pi * alpha**2 * half[:, 2] ** 4)

    def masking(w: NDArray) -> NDArray:
        sine = np.sqrt(np.maximum(1 - w[..., 2] ** 2, 1e-30))
        a = w[..., 2] / (alpha * sine)
        return 2 / (1 + erf(a) + np.exp(-(a**2)) / (a * np.sqrt(np.pi)))

    value = density * masking(wi) * masking(wo) / (4 * wi[..., 2])
    f = (1 - (half * wi).sum(axis=1)) ** 5
    return value * (1 - f), value * f


@pytest.mark.parametrize("roughness", [0.25, 0.55, 1.0])
@pytest.mark.parametrize("has_sky", [False, True])
def test_specular_shading(roughness: float, has_sky: bool) -> None:
    """Ls0 and Ls1 are within 2 % plus 0.003 of the integrals of the BRDF's two parts."""
    view = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.9, 0.1, np.sqrt(1 - 0.82)]])
    normal = np.tile([0.0, 0.0, 1.0], (len(POINTS), 1))
    found = baker(has_sky=has_sky).specular(POINTS, normal, view, np.full(len(POINTS), roughness), 8192)
    directions, solid = hemisphere()
    for k, point in enumerate(POINTS):
        light = incoming(point, directions, has_sky=has_sky) * solid
        first, second = lobes(view[k], directions, roughness**2)
        np.testing.assert_allclose(found.ls0[k], (first * light).sum() * RADIANCE, rtol=0.02, atol=0.003)
        np.testing.assert_allclose(found.ls1[k], (second * light).sum() * RADIANCE, rtol=0.02, atol=0.003)


@pytest.mark.parametrize(("albedo", "roughness"), [(0.8, 0.25), (0.3, 0.7)])
def test_rays_continue_at_metals(albedo: float, roughness: float) -> None:
    """A point above a metal floor under a uniform sky receives the floor's reflection of the sky within 1 %,
    instead of the floor's photographed radiance."""
    corners = np.array([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]], np.float32)
    floor = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), None, None)
    one = dark_surfel()
    grid = replace(one.grid, surfel=np.array([-1, -1, -1, -1, -1, 0], np.int32))
    surfels = replace(one, grid=grid, radiance=np.full((1, 3), 7.0, np.float32))
    none = np.zeros(0, np.float32)
    dark = Emitters(
        np.full(2, -1, np.int32),
        none.reshape(0, 3),
        np.ones(2, np.float32),
        np.zeros(0, np.int32),
        none.reshape(0, 3, 3),
        none,
    )
    field = RadianceField(mesh_scene(floor), surfel_cells(surfels), dark, background(RADIANCE))
    point, down = np.array([[0.0, 0.0, 0.2]]), np.array([[0.0, 0.0, -1.0]])
    seen = Baker(field, 1e-2).irradiance(point, down, 4096)
    np.testing.assert_allclose(seen.diffuse, 7.0, rtol=0.01)
    s, r, is_metal = np.full((1, 3), albedo), np.full(1, roughness), np.ones(1, dtype=bool)
    found = Baker(field.with_metals(surfels, s, r, is_metal), 1e-2).irradiance(point, down, 4096)
    directions, solid = hemisphere(400)
    cosines = (np.arange(40) + 0.5) / 40
    reflected = []
    for cosine in cosines:
        view = np.array([np.sqrt(1 - cosine**2), 0, cosine])
        first, second = lobes(view, directions, roughness**2)
        reflected.append(((albedo * first + second) * solid).sum())
    true = (np.array(reflected) * cosines).sum() / cosines.sum()
    np.testing.assert_allclose(found.diffuse[0], true * RADIANCE, rtol=0.01)
    assert found.photographed == pytest.approx(1.0)


@pytest.mark.parametrize("roughness", [0.3, 0.6])
def test_metal_reflects_a_lamp_without_noise(roughness: float) -> None:
    """A small lamp's reflection in a metal floor is within 2 %, and its standard deviation with 64 rays below
    30 %; without sampling the lamp from the floor, it would be over 100 %."""
    lamp = np.array([[0.45, -0.05, 1], [0.45, 0.05, 1], [0.55, 0.05, 1], [0.55, -0.05, 1]], np.float32)
    corners = np.array([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    mesh = Mesh(np.concatenate([corners, lamp]), faces, None, None)
    one = dark_surfel()
    surfels = replace(one, grid=replace(one.grid, surfel=np.array([-1, -1, -1, -1, -1, 0], np.int32)))
    emitters = Emitters(
        np.array([-1, -1, 0, 0], np.int32),
        np.full((1, 3), 500.0, np.float32),
        np.ones(4, np.float32),
        np.array([2, 3], np.int32),
        mesh.positions[faces[2:]],
        np.full(2, 2.5, np.float32),  # area times luminance
    )
    field = RadianceField(mesh_scene(mesh), surfel_cells(surfels), emitters, background(np.zeros(3)))
    albedo = 0.7
    s, r, is_metal = np.full((1, 3), albedo), np.full(1, roughness), np.ones(1, dtype=bool)
    baker = Baker(field.with_metals(surfels, s, r, is_metal), 1e-2)
    point, down = np.array([[0.0, 0.0, 0.2]]), np.array([[0.0, 0.0, -1.0]])
    found = baker.irradiance(point, down, 16_384).diffuse[0]
    noisy = baker.irradiance(np.repeat(point, 200, axis=0), np.repeat(down, 200, axis=0), 64).diffuse[:, 0]
    x, y = np.meshgrid((np.arange(600) + 0.5) / 300 - 1, (np.arange(400) + 0.5) / 200 - 1)
    floor = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    view, light = point - floor, np.array([0.5, 0.0, 1.0]) - floor
    to_view, to_light = (np.linalg.norm(v, axis=1)[:, None] for v in (view, light))
    view, light = view / to_view, light / to_light
    solid = 0.01 * light[:, 2] / to_light[:, 0] ** 2
    first, second = lobes(view, light, roughness**2)
    radiance = 500 * solid * (albedo * first + second)
    area = (2 / 600) * (2 / 400)
    true = (radiance * view[:, 2] ** 2 / to_view[:, 0] ** 2).sum() * area / np.pi
    np.testing.assert_allclose(found, true, rtol=0.02)
    assert noisy.std() < 0.3 * noisy.mean()


def observations(num: int, metal: bool, seed: int) -> tuple[NDArray, ...]:
    """Arguments of ``segment_costs`` for 8 randomly lit views of metal or a dielectric (S 0.06) of R 0.4."""
    random = np.random.default_rng(seed)
    levels = len(ROUGHNESS_LEVELS)
    ls0 = random.gamma(0.6, 1.0, (num, 8, levels, 3)).astype(np.float32)
    ls1 = (0.1 * random.gamma(0.6, 1.0, (num, 8, levels, 3))).astype(np.float32)
    diffuse = random.uniform(0.5, 1.5, (num, 3)).astype(np.float32)
    albedo = np.zeros((num, 3)) if metal else random.uniform(0.1, 0.7, (num, 3))
    s = np.array([0.9, 0.7, 0.4]) if metal else np.full(3, 0.06)
    at = int(np.flatnonzero(np.isclose(ROUGHNESS_LEVELS, 0.4))[0])
    radiance = ((1 - s) * albedo * diffuse)[:, None] + s * ls0[:, :, at] + ls1[:, :, at]
    return radiance.astype(np.float32), np.ones((num, 8), np.float32), diffuse, ls0, ls1


@pytest.mark.parametrize("metal", [False, True])
def test_known_materials_are_found(metal: bool) -> None:
    start = np.array([0, 30, 60], np.int64)
    costs = segment_costs(start, *observations(60, metal, 5), 0.4)
    found = decide(
        costs,
        np.full((2, 3), 0.04),
        np.full(2, 0.6),
        np.ones(2),
        np.full(2, 8),
        np.arange(2),
        np.full(2, 30),
        np.full(2, 0.5),
        PriorWeights(),
    )
    assert (found.is_metal == metal).all()
    np.testing.assert_allclose(
        found.specular_albedo, [[0.9, 0.7, 0.4] if metal else [0.06] * 3] * 2, atol=0.01
    )
    np.testing.assert_allclose(found.roughness, 0.4, atol=0.02)
    assert found.residual.max() < 1e-4


def test_white_paint_in_slightly_stronger_light_is_matte() -> None:
    """A diffuse albedo of 0.98 in 10 % more light than estimated does not appear to have a specular part."""
    _, weight, diffuse, ls0, ls1 = observations(60, False, 5)
    radiance = np.broadcast_to((0.98 * 1.1 * diffuse)[:, None], (60, 8, 3)).astype(np.float32)
    costs = segment_costs(np.array([0, 60], np.int64), radiance, weight, diffuse, ls0, 0 * ls1, 0.4)
    assert costs.dielectric[0, :, 0].max() < 1e-4
    assert costs.dielectric[0, :, 1:].min() > 1e-3


def test_textured_metal_costs_no_more_than_plain_metal() -> None:
    """One segment with metal tiles of S 0.8 and 0.17 has no cost as metal of the right roughness."""
    _, weight, diffuse, ls0, ls1 = observations(60, True, 5)
    s = np.where(np.arange(60) % 2, 0.8, 0.17)[:, None, None]
    radiance = (s * ls0[:, :, 2] + ls1[:, :, 2]).astype(np.float32)
    costs = segment_costs(np.array([0, 60], np.int64), radiance, weight, diffuse, ls0, ls1, 0.4)
    assert costs.metal[0, 2] < 1e-4
    assert min(costs.metal[0, 1], costs.metal[0, 3], costs.dielectric[0].min()) > 0.01


@pytest.mark.parametrize(("albedo", "becomes_metal"), [(0.15, True), (0.05, False)])
def test_metal_spreads_to_dark_segments_of_its_region(albedo: float, becomes_metal: bool) -> None:
    levels = len(ROUGHNESS_LEVELS)
    dielectric = np.full((3, levels, len(SPECULAR_LEVELS)), 0.1, np.float32)
    colors = np.repeat([0.8, albedo, 0.15], 3 * levels).reshape(3, levels, 3).astype(np.float32)
    costs = Costs(dielectric, np.full((3, levels), 0.01, np.float32), colors)
    prior = np.full((3, 3), 0.04), np.full(3, 0.6)
    region, size = np.array([0, 0, 1]), np.full(3, 100)
    found = decide(costs, *prior, np.ones(3), np.full(3, 8), region, size, np.full(3, 0.5), PriorWeights())
    assert found.is_metal.tolist() == [True, becomes_metal, False]  # the last is in no region with metal


@pytest.mark.parametrize(
    ("advantage", "evidence", "becomes_metal"), [(0.03, 1.0, True), (0.0, 1.0, False), (0.03, 0.3, False)]
)
def test_segments_of_a_region_share_their_evidence_of_metal(
    advantage: float, evidence: float, becomes_metal: bool
) -> None:
    """On a fifth of a region metal halves the residual; the other four fifths alone would be undecided."""
    levels = len(ROUGHNESS_LEVELS)
    dielectric = np.full((2, levels, len(SPECULAR_LEVELS)), 0.1, np.float32)
    metal = np.repeat(0.1 - np.float32([0.05, advantage]), levels).reshape(2, levels)
    costs = Costs(dielectric, metal, np.full((2, levels, 3), 0.8, np.float32))
    prior = np.full((2, 3), 0.04), np.full(2, 0.6)
    region, size = np.zeros(2, np.int64), np.array([20, 80])
    weights = PriorWeights(metal=0.04 * evidence)
    dim = np.full(2, 0.5)
    found = decide(costs, *prior, np.full(2, evidence), np.full(2, 8), region, size, dim, weights)
    assert found.is_metal.tolist() == [True, becomes_metal]


def decided(
    dielectric: NDArray,
    metal: float = 0.5,
    evidence: float = 1.0,
    views: int = 4,
    observations: float = REFERENCE_OBSERVATIONS,
    brightness: float = 0.5,
) -> SolvedSegments:
    """Decision for one segment with costs ``dielectric`` (levels, speculars) and ``metal`` (S 0.9), where a
    network predicts S 0.04 and R 0.6."""
    num_levels = len(ROUGHNESS_LEVELS)
    costs = Costs(
        dielectric[None].astype(np.float32),
        np.full((1, num_levels), metal, np.float32),
        np.full((1, num_levels, 3), 0.9, np.float32),
    )
    group, size = np.zeros(1, np.int64), np.array([observations / views])
    prior = np.full((1, 3), 0.04), np.full(1, 0.6)
    of_segment = (np.full(1, value) for value in (evidence, views))
    return decide(costs, *prior, *of_segment, group, size, np.full(1, brightness), PriorWeights())


@pytest.mark.parametrize(("surfels", "is_metal"), [(5, False), (6, True)])
def test_fragments_are_no_metal(surfels: int, is_metal: bool) -> None:
    dielectric = np.full((len(ROUGHNESS_LEVELS), len(SPECULAR_LEVELS)), 0.1)
    assert decided(dielectric, 0.001, observations=4 * surfels).is_metal.tolist() == [is_metal]


@pytest.mark.parametrize(
    ("residual", "brightness", "is_metal"), [(0.1, 1.0, True), (0.1, 1.2, False), (0.005, 1.2, True)]
)
def test_patches_of_sun_are_no_metal(residual: float, brightness: float, is_metal: bool) -> None:
    """Segments brighter than white are not metal, except in exact captures, whose metals reflect lamps."""
    dielectric = np.full((len(ROUGHNESS_LEVELS), len(SPECULAR_LEVELS)), residual)
    found = decided(dielectric, 0.001, brightness=brightness)
    assert found.is_metal.tolist() == [is_metal]


@pytest.mark.parametrize(
    ("changes", "becomes_metal"),
    [
        ({}, True),
        ({"dielectric": 0.05, "metal": 0.03}, False),  # the dielectric explains the observations
        ({"metal": 0.09}, False),
        ({"level": 2}, False),  # too rough for a mirror
        ({"views": 1}, False),
        ({"size": 20}, False),
        ({"evidence": 1.0, "level": 2}, True),
    ],
)
def test_mirrors_need_no_evidence_but_their_images(changes: dict[str, float], becomes_metal: bool) -> None:
    """100 surfels in two views, with costs of 0.1 as dielectric and 0.06 as metal of one roughness level."""
    case = {"dielectric": 0.1, "metal": 0.06, "level": 0, "views": 2, "size": 100, "evidence": 0.02}
    case |= changes
    num_levels = len(ROUGHNESS_LEVELS)
    metal = np.full((1, num_levels), 0.5, np.float32)
    metal[0, int(case["level"])] = case["metal"]
    dielectric = np.full((1, num_levels, len(SPECULAR_LEVELS)), case["dielectric"], np.float32)
    costs = Costs(dielectric, metal, np.full((1, num_levels, 3), 0.9, np.float32))
    found = decide(
        costs,
        np.full((1, 3), 0.04),
        np.full(1, 0.6),
        np.full(1, case["evidence"]),
        np.full(1, case["views"]),
        np.zeros(1, np.int64),
        np.full(1, int(case["size"])),
        np.full(1, 0.5),
        PriorWeights(),
    )
    assert found.is_metal.tolist() == [becomes_metal]


def costs_of_levels(noise: float, matte: float, best: tuple[int, int] = (2, 3)) -> NDArray:
    """Costs (levels, speculars): ``noise`` for the best hypothesis, ``noise + matte`` for S = 0, and twice
    the noise for all others."""
    costs = np.full((len(ROUGHNESS_LEVELS), len(SPECULAR_LEVELS)), 2 * noise)
    costs[:, 0] = noise + matte
    costs[best] = noise
    return costs


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_gloss_is_decided_by_evidence(noise: float) -> None:
    """A segment is glossy if S lowers the cost by two fifths of the noise, matte if S raises it by as much;
    in between, the two are averaged, and R has less confidence. S of matte segments is 0 in an exact
    capture, and three quarters of the network's (0.04) in an inexact one.
    """
    of_matte = 0.0 if noise < EXACT_RESIDUAL[0] else 0.03
    either = decided(costs_of_levels(noise, MATTE_ALLOWANCE * noise))
    glossy = decided(costs_of_levels(noise, 0.4 * noise))
    np.testing.assert_allclose(either.specular_albedo, 0.03 + 0.5 * of_matte, atol=1e-3)
    np.testing.assert_allclose(either.roughness, 0.7, atol=1e-3)
    of_network = 2 * NETWORK_VARIANCE  # of four views
    np.testing.assert_allclose(either.confidence[0, 2], of_network / (of_network + 0.3**2), atol=0.01)
    np.testing.assert_allclose(glossy.specular_albedo, 0.06, atol=0.005)
    np.testing.assert_allclose(glossy.roughness, 0.4, atol=0.02)
    matte = decided(costs_of_levels(noise, -0.4 * noise))
    np.testing.assert_allclose(matte.specular_albedo, of_matte, atol=1e-3)
    np.testing.assert_allclose(matte.roughness, 1.0, atol=1e-3)


def test_observations_decide_between_hypotheses() -> None:
    """In an exact capture, equal costs are clearer evidence with more observations; not in an inexact one,
    whose residuals are correlated.
    """
    exact, inexact = costs_of_levels(0.005, 0.0001), costs_of_levels(0.02, 0.0004)
    few, some, many = (decided(exact, observations=num).roughness[0] for num in (30, 3000, 300_000))
    np.testing.assert_allclose(many, 0.4, atol=0.01)
    assert many + 0.1 < some < few - 0.05
    few, many = (decided(inexact, observations=num).roughness[0] for num in (30, 300_000))
    assert few == many > 0.6


def test_equally_likely_hypotheses_are_averaged() -> None:
    """R of two hypotheses of equal cost is averaged rather than decided by rounding."""
    costs = costs_of_levels(0.01, 0.01, (1, 2))
    costs[4, 2] = 0.01
    found = decided(costs, evidence=0.999)
    assert 0.35 < found.roughness[0] < 0.72
    np.testing.assert_allclose(found.specular_albedo, 0.04, atol=0.003)


def test_segments_share_the_roughness_of_their_region() -> None:
    """R of a dielectric is blended with the mean of its region's dielectrics, weighted by observations and
    confidence; the mean's share is :data:`REGION_SHARE` at full confidence and 1 at none."""
    noise, num = 0.005, 4
    dielectric = np.stack([costs_of_levels(noise, 0.05)] * num).astype(np.float32)
    dielectric[1] = costs_of_levels(noise, -0.004)
    metal = np.full((num, len(ROUGHNESS_LEVELS)), 0.5, np.float32)
    dielectric[3], metal[3, 0] = 0.1, 1e-3
    group, size = np.array([0, 0, 1, 0]), np.array([3000, 1000, 1000, 9000])
    found = decide(
        Costs(dielectric, metal, np.full((*metal.shape, 3), 0.9, np.float32)),
        np.full((num, 3), 0.04),
        np.full(num, 0.6),
        np.full(num, 0.99),
        np.full(num, 10.0),
        group,
        size,
        np.full(num, 0.5),
        PriorWeights(),
    )
    assert found.is_metal.tolist() == [False, False, False, True]
    roughness = np.array([0.4, 1.0, 0.4, found.roughness[3]], np.float32)
    for sure, share in ((1.0, REGION_SHARE), (0.5, 1 - 0.5 * (1 - REGION_SHARE)), (0.0, 1.0)):
        confidence = np.ones((num, 3), np.float32)
        confidence[1, 2] = sure
        given = replace(found, roughness=roughness, confidence=confidence)
        shared, of_shared = shared_roughness(given, group, size)
        mean = (3 * 0.4 + sure * 1.0) / (3 + sure)
        expected = [0.4 + REGION_SHARE * (mean - 0.4), 1.0 + share * (mean - 1.0), 0.4, roughness[3]]
        np.testing.assert_allclose(shared, expected, atol=1e-6)
        least = max(sure, share * (3 + sure) / 4)
        np.testing.assert_allclose(of_shared, [1, least, 1, 1], atol=1e-6)
    unknown = replace(found, roughness=roughness, confidence=np.zeros((num, 3), np.float32))
    shared, of_shared = shared_roughness(unknown, group, size)
    assert (shared == roughness).all() and (of_shared == 0).all()


def test_unexplained_segments_have_no_confidence() -> None:
    """Confidence is 0.5 at a residual of 0.045 and 0 from 0.06 on; for metals at twice these residuals."""
    for residual, expected in ((0.03, 1.0), (0.045, 0.5), (0.06, 0.0)):
        found = decided(costs_of_levels(residual, 0.05))
        np.testing.assert_allclose(found.confidence[:, :2], expected, atol=1e-3)
    for residual, expected in ((0.06, 1.0), (0.09, 0.5), (0.12, 0.0)):
        metal = decided(costs_of_levels(0.4, 0.0), metal=residual)
        assert metal.is_metal.all()
        np.testing.assert_allclose(metal.confidence, expected, atol=1e-3)


@pytest.mark.parametrize("residual", [0.02, 0.005])
def test_roughness_between_likely_hypotheses_has_less_confidence(residual: float) -> None:
    """Confidence of R is the inverse-variance weight of the mean over hypotheses against the network's R."""
    clear = decided(costs_of_levels(residual, residual))
    assert clear.confidence[0, 2] > 0.95
    costs = costs_of_levels(residual, residual, (1, 2))
    costs[-1, 2] = residual
    variance = (ROUGHNESS_LEVELS[-1] - ROUGHNESS_LEVELS[1]) ** 2 / 4
    for views in (1, 4, 40):
        unclear = decided(costs, evidence=0.999, views=views)
        of_network = NETWORK_VARIANCE * np.sqrt(views)
        expected = of_network / (of_network + variance)
        np.testing.assert_allclose(unclear.confidence[0, 2], expected, rtol=0.05)
        np.testing.assert_allclose(unclear.confidence[0, :2], 1.0)


def test_cost_equals_that_of_a_dense_solve() -> None:
    """Costs of all dielectric hypotheses equal those of float64 NumPy."""
    radiance, weight, diffuse, ls0, ls1 = observations(12, False, 9)
    weight = np.random.default_rng(2).uniform(0.2, 2.0, weight.shape).astype(np.float32)
    costs = segment_costs(np.array([0, 12], np.int64), radiance, weight, diffuse, ls0, ls1, 0.4)
    for level in range(len(ROUGHNESS_LEVELS)):
        for k, s in enumerate(SPECULAR_LEVELS.astype(np.float64)):
            spec = s * ls0[:, :, level].astype(np.float64) + ls1[:, :, level]
            rest = ((radiance - spec) * weight[..., None]).sum(axis=1) / weight.sum(axis=1)[:, None]
            albedo = np.clip(rest / ((1 - s) * diffuse), 0, 1.1)
            model = ((1 - s) * albedo * diffuse)[:, None] + spec
            encode = lambda x: np.log1p(50 * np.maximum(x, 0) * 0.4) / np.log(51)  # noqa: E731
            residual = np.minimum(np.abs(encode(model) - encode(radiance)), 0.2)
            true = (residual * weight[..., None]).sum() / (3 * weight.sum())
            assert costs.dielectric[0, level, k] == pytest.approx(true, rel=2e-3, abs=1e-5)


def test_weighted_medians() -> None:
    random = np.random.default_rng(0)
    values = random.random((40, 3)).astype(np.float32)
    start = np.array([0, 1, 4, 40], np.int64)
    found = weighted_medians(start, values, np.ones(40, np.float32))
    for row, (first, last) in enumerate(pairwise(start)):
        np.testing.assert_allclose(found[row], np.median(values[first:last], axis=0), rtol=1e-6)
    heavy = np.ones(40, np.float32)
    heavy[7] = 100
    np.testing.assert_array_equal(weighted_medians(start, values, heavy)[2], values[7])

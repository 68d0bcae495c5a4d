# SPDX-License-Identifier: MIT
"""Albedo gains, fitted to points of known radiance, irradiance and predicted reflectance."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from model.reconstruction import albedo_level
from model.reconstruction.albedo_level import (
    IMPOSSIBLE,
    MIN_POINTS,
    AlbedoLevel,
)

NUM = 1200
WANTED = np.array([[1.5, 1.2, 0.8], [0.7, 0.9, 1.1], [1.3, 1.3, 1.3]])
"""True RGB gains of the regions 0, 2 and 3; region 1 has no points."""
REGIONS = np.array([0, 2, 3])
ARRIVING = np.random.default_rng(5).uniform(0.5, 2.0, (NUM, 3))
"""RGB irradiance of the points."""


def leaving(reflected: float = 0.4) -> NDArray[np.float64]:
    """Outgoing radiance (NUM, 3) of points with the reflectance ``reflected`` times the true gains."""
    return reflected * WANTED[np.arange(NUM) % 3] * ARRIVING / np.pi


def points_of(
    radiance: NDArray[np.float64], arriving: NDArray[np.float64], reflected: float = 0.4
) -> albedo_level.Points:
    """Points that alternate between the three regions, with outgoing ``radiance`` and irradiance
    ``arriving`` (N, 3)."""
    which = np.arange(len(radiance)) % 3
    return albedo_level.Points(radiance, arriving, np.full_like(radiance, reflected), REGIONS[which])


def fit(
    num: int = NUM, coverage: Any = 1.0, noise: float = 0.0, reflected: float = 0.4, **changes: Any
) -> AlbedoLevel:
    """Fit gains to points with log-normal ``noise`` and the photographed share ``coverage`` of light."""
    which = np.arange(num) % 3
    arriving = np.resize(ARRIVING, (num, 3))
    factor = np.exp(noise * np.random.default_rng(4).normal(size=(num, 1)))
    rho = reflected * WANTED[which] * factor
    known = np.broadcast_to(np.asarray(coverage, dtype=float), num)
    fields = {
        "radiance": rho * arriving / np.pi,
        "irradiance": arriving,
        "reflected": np.full((num, 3), reflected),
        "region": REGIONS[which],
    }
    points = albedo_level.Points(**{**fields, **changes})
    return albedo_level.fit_level(points, known, 4, 0.01)


def test_gains_are_per_region_and_the_rooms_elsewhere() -> None:
    level = fit()
    np.testing.assert_allclose(level.gains[REGIONS], WANTED, rtol=0.02)
    np.testing.assert_allclose(level.gains[1], level.report.gain, rtol=1e-6)
    report = level.report
    assert report.is_applied and (report.points_used, report.regions_used) == (NUM, 3)
    assert (report.coverage, report.used_share, report.clipped_share) == (1.0, 1.0, 0.01)
    assert report.spread < 1e-3 and report.impossible_share == 0.0
    # a third of the points are at each of ln 0.9, ln 1.2 and ln 1.3: the quartiles are the outer ones
    assert report.region_spread == pytest.approx(0.5 * np.log(1.3 / 0.9), rel=0.03)


def test_points_with_little_photographed_light_count_less() -> None:
    """A point's weight is 1 if at least 0.8 of its incident light is photographed, 0.5 at 0.6, 0 at 0.4."""
    random = np.random.default_rng(0)
    coverage = random.choice([0.3, 0.6, 0.8, 1.0], NUM)
    level = fit(coverage=coverage)
    weight = np.select([coverage == 0.3, coverage == 0.6], [0.0, 0.5], 1.0)
    assert level.report.used_share == pytest.approx(weight.mean(), abs=1e-9)
    assert level.report.points_used == (weight > 0).sum()
    assert level.report.coverage == pytest.approx(coverage.mean())
    np.testing.assert_allclose(level.gains[REGIONS], WANTED, rtol=0.02)


@pytest.mark.parametrize("num_dark", [60, 660])
def test_dark_points_are_not_used(num_dark: int) -> None:
    """Dark points are ignored even if most are dark."""
    left = leaving()
    left[:num_dark] = 0.0
    level = fit(radiance=left)
    assert level.report.points_used == NUM - num_dark
    np.testing.assert_allclose(level.gains[REGIONS], WANTED, rtol=0.02)


def test_points_without_incident_light_are_not_used() -> None:
    """Without photographed incident light the reflectance would be unbounded."""
    arriving = ARRIVING.copy()
    arriving[:60] = 0.0
    level = albedo_level.fit_level(points_of(leaving(), arriving), np.ones(NUM), 4, 0.0)
    assert level.report.points_used == NUM - 60 and level.report.impossible_share == 0.0
    np.testing.assert_allclose(level.gains[REGIONS], WANTED, rtol=0.02)


def test_a_surface_may_reflect_all_incident_light() -> None:
    """A reflectance of exactly 1 is possible."""
    left = np.random.default_rng(7).uniform(0.1, 0.5, (NUM, 3))
    for factor, share in ((1.0, 0.0), (0.999, 1.0)):
        level = albedo_level.fit_level(points_of(left, left * np.pi * factor), np.ones(NUM), 4, 0.0)
        assert level.report.impossible_share == share


def test_spread_is_half_the_interquartile_range() -> None:
    """For a normal distribution the spread is 0.6745 standard deviations."""
    level = fit(num=30_000, noise=0.3)
    assert level.report.is_applied and level.report.spread == pytest.approx(0.6745 * 0.3, rel=0.04)
    np.testing.assert_allclose(level.gains[REGIONS], WANTED, rtol=0.03)


def fit_excess(noise: float, share: float) -> AlbedoLevel:
    """Fit gains to noisy points, a ``share`` of which reflects more than its incident light."""
    left = leaving() * np.exp(noise * np.random.default_rng(4).normal(size=(NUM, 1)))
    left[: int(share * NUM)] = 1.2 * ARRIVING[: int(share * NUM)] / np.pi
    level = fit(radiance=left)
    assert level.report.impossible_share == pytest.approx(share, abs=0.03)
    return level


def test_increases_fade_where_reflectance_exceeds_one() -> None:
    """Unphotographed light and unknown metal only raise the measured reflectance: decreases apply in full."""
    level = fit_excess(0.1, 0.15)
    low, high = IMPOSSIBLE
    trust = (high - level.report.impossible_share) / (high - low)
    assert level.report.trust == pytest.approx(trust) and 0.2 < trust < 0.8
    full = fit_excess(0.1, 0.08)
    assert full.report.trust == 1 and full.report.reason == ""
    expected = np.where(WANTED > 1, WANTED**trust, WANTED)
    np.testing.assert_allclose(level.gains[REGIONS], expected, rtol=0.1)
    np.testing.assert_allclose(full.gains[REGIONS], WANTED, rtol=0.1)
    none = fit_excess(0.1, 0.21)
    assert none.report.is_applied and none.report.trust == 0 and "no photograph shows" in none.report.reason
    np.testing.assert_allclose(none.gains[REGIONS], np.minimum(WANTED, 1), rtol=0.15)
    assert none.gains.max() == 1


@pytest.mark.parametrize(("num", "is_applied"), [(MIN_POINTS, True), (MIN_POINTS - 1, False)])
def test_few_points_change_nothing(num: int, is_applied: bool) -> None:
    level = fit(num=num)
    assert level.report.is_applied == is_applied and level.gains.shape == (4, 3)


@pytest.mark.parametrize(("coverage", "is_applied"), [(0.53, True), (0.51, False)])
def test_little_weight_changes_nothing(coverage: float, is_applied: bool) -> None:
    """A photographed share of 0.52 has 0.3 of the full weight."""
    assert fit(coverage=coverage).report.is_applied == is_applied


def test_predictions_near_zero_are_clamped_to_a_fiftieth() -> None:
    """A ratio to a prediction near zero would give an unbounded reflectance."""
    black = fit(reflected=0.02)
    np.testing.assert_allclose(black.gains[REGIONS], WANTED, rtol=0.02)
    same = fit(reflected=0.005)
    np.testing.assert_allclose(same.gains[REGIONS], WANTED / 4, rtol=0.02)


def test_the_gain_of_a_small_region_is_shrunk_to_the_rooms() -> None:
    """One point at 4 times the room's albedo scale changes its region's gain less than 200 points do."""
    gains = []
    for count in (1, 200):
        region = np.zeros(NUM, np.int64)
        region[:count] = 3
        factor = np.where(region == 3, 4.0, 1.0)[:, None]
        factor = factor * np.exp(0.1 * np.random.default_rng(1).normal(size=(NUM, 1)))
        level = fit(radiance=0.2 * factor * ARRIVING / np.pi, region=region, reflected=0.2)
        gains.append(level.gains[3, 1])
        np.testing.assert_allclose(level.gains[0], 1.0, rtol=0.05)
    assert 1.1 < gains[0] < 0.9 * gains[1] < 4.0 and gains[1] == pytest.approx(4.0, rel=0.05)


def test_outliers_do_not_move_a_regions_gain() -> None:
    """A third of the points receive three times the known light."""
    random = np.random.default_rng(6)
    lit = np.where(random.random((NUM, 1)) < 1 / 3, 3.0, 1.0)
    spread = np.exp(0.05 * random.normal(size=(NUM, 1)))
    level = fit(radiance=0.25 * lit * spread * ARRIVING / np.pi, reflected=0.25)
    np.testing.assert_allclose(level.gains[REGIONS], 1.0, rtol=0.06)


def test_weighted_quantiles_follow_the_cumulative_weights() -> None:
    values, weight = np.array([3.0, 1.0, 2.0, 4.0]), np.array([1.0, 5.0, 1.0, 3.0])
    found = albedo_level.weighted_quantiles(values, weight, (0.2, 0.55, 0.65, 0.95))
    assert found.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert albedo_level.interquartile_range(values, weight) == 3.0

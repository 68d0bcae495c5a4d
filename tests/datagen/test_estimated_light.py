# SPDX-License-Identifier: MIT
"""Gains that scale the estimates of unphotographed light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.light.background import FAR, NEAR, Background, Layout
from datagen.light.estimated_light import (
    MAX_LOG_GAIN,
    NUM_GROUPS,
    NUM_OUTSIDE,
    background_groups,
    solve_gains,
    with_gains,
)

GAINS = np.array([0.4, 1.5, 3.0, 1.0])
IS_OUTSIDE = np.array([True, True, False, False])


def walls(seed: int = 0) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return log radiance (N,), known irradiance (N,), estimated irradiance by four groups of light (N, 4)
    and region (N,) of surfels on 48 textured walls, along which each group's light varies independently."""
    random = np.random.default_rng(seed)
    region = np.repeat(np.arange(48), 400)
    along = np.tile(np.linspace(0, 1, 400), 48)
    phase = random.uniform(0, 2 * np.pi, (48, 5))[region]
    light = 1 + 0.9 * np.sin(4 * along[:, None] + phase)
    rest, parts = light[:, 0], light[:, 1:]
    albedo = random.uniform(0.1, 0.8, 48)[region] * np.exp(0.2 * random.normal(size=len(region)))
    return np.log(albedo * (rest + parts @ GAINS)), rest, parts, region


def test_gains_follow_from_walls_of_unknown_albedo() -> None:
    np.testing.assert_allclose(solve_gains(*walls(), IS_OUTSIDE), GAINS, rtol=0.15)


def test_gains_do_not_depend_on_the_numbers_of_regions() -> None:
    log_radiance, rest, parts, region = walls()
    numbers = np.random.default_rng(1).permutation(1000)[:48]
    other = solve_gains(log_radiance, rest, parts, numbers[region], IS_OUTSIDE)
    np.testing.assert_allclose(other, solve_gains(*walls(), IS_OUTSIDE), rtol=1e-9)


def test_small_objects_of_another_colour_change_little() -> None:
    """Pictures four times darker than the walls, on a tenth of each wall, change gains by at most 35 %."""
    log_radiance, rest, parts, region = walls()
    is_picture = np.arange(len(region)) % 400 < 40
    darker = log_radiance - np.log(4) * is_picture
    np.testing.assert_allclose(solve_gains(darker, rest, parts, region, IS_OUTSIDE), GAINS, rtol=0.35)


def test_uniform_light_keeps_its_estimate() -> None:
    """Uniform light and regions of a single surfel leave gains undetermined, so these stay near 1."""
    log_radiance, rest, parts, region = walls()
    even = np.ones_like(rest)
    found = solve_gains(np.log(0.5 * even), even, parts * 0 + 0.5, region, IS_OUTSIDE)
    np.testing.assert_allclose(found, 1.0, atol=1e-6)
    alone = solve_gains(log_radiance[::400], rest[::400], parts[::400], region[::400], IS_OUTSIDE)
    np.testing.assert_allclose(alone, 1.0, atol=0.75)


def test_gains_are_bounded() -> None:
    log_radiance, rest, parts, region = walls()
    bright = log_radiance + np.log1p(1e4 * parts[:, 0] / rest)
    assert solve_gains(bright, rest, parts, region, IS_OUTSIDE).max() <= np.exp(MAX_LOG_GAIN) * (1 + 1e-12)


@pytest.mark.parametrize("layout", [NEAR, FAR])
def test_background_groups_are_blocks_of_positions_and_directions(layout: Layout) -> None:
    groups = background_groups(layout)
    assert groups.min() == 0
    assert groups.max() < NUM_OUTSIDE < NUM_GROUPS
    assert (groups.max() == NUM_OUTSIDE - 1) == (layout is NEAR)
    sizes = np.bincount(groups)
    assert (sizes == sizes[0]).all()
    low, high = np.zeros(3), np.ones(3)
    east = np.array([[1.0, 0.1, 0.02], [1.0, 0.1, 0.15], [-1.0, 0.1, 0.02], [1.0, 0.1, -0.15]])
    near, up, back, down = groups[layout.bins_of(np.full((4, 3), 0.5), east, low, high)]
    assert near == up
    assert len({near, back, down}) == 3
    ahead, aside = groups[
        layout.bins_of(np.array([[0.5, 0.1, 0.5], [0.5, 0.9, 0.5]]), east[:1].repeat(2, 0), low, high)
    ]
    assert (ahead == aside) == (layout is FAR)


@pytest.mark.parametrize("layout", [NEAR, FAR])
def test_only_estimates_of_the_background_are_scaled(layout: Layout) -> None:
    is_known = np.arange(layout.num_bins) % 3 > 0
    radiance = np.ones((layout.num_bins, 3), np.float32)
    is_photographed = np.arange(layout.num_bins) % 3 == 2
    background = Background(np.zeros(3), np.ones(3), radiance, is_known, is_photographed, layout)
    gains = np.linspace(1, 2, NUM_GROUPS)
    scaled = with_gains(background, gains)
    kept = ~is_known | background.is_photographed
    np.testing.assert_array_equal(scaled.radiance[kept], 1)
    of_bin = gains[background_groups(layout)]
    np.testing.assert_allclose(scaled.radiance[~kept, 1], of_bin[~kept], rtol=1e-6)
    assert replace(scaled, radiance=background.radiance) == replace(background)

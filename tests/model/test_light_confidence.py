# SPDX-License-Identifier: MIT
"""Confidence of surfels: evidence, uncertain light, impossible brightness, and bumpy normals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.light.surfels import CellGrid, Observations, Surfels
from model.reconstruction.light.confidence import (
    BLOCK_CELLS,
    D_EVIDENCE,
    DOUBT,
    S_EVIDENCE,
    ImpossibleShares,
    impossible_shares,
    light_certainty,
    normal_spread,
    surfel_confidence,
    trust_in_normals,
)

OBSERVATIONS = 20


def test_confidence_grows_with_the_evidence() -> None:
    share = np.array([0.0, D_EVIDENCE[0], np.mean(D_EVIDENCE), D_EVIDENCE[1], 1.0])
    found = surfel_confidence(share, np.zeros(5, bool))
    np.testing.assert_allclose(found[:, 0], [0, 0, 0.5, 1, 1], atol=1e-6)
    assert (found[:, 1] == found[:, 2]).all() and (found[:, 1] >= found[:, 0]).all()
    share = np.array([S_EVIDENCE[0], np.mean(S_EVIDENCE), S_EVIDENCE[1]])
    np.testing.assert_allclose(surfel_confidence(share, np.zeros(3, bool))[:, 1], [0, 0.5, 1], atol=1e-6)


def test_mirrors_need_no_photographed_hemisphere() -> None:
    found = surfel_confidence(np.zeros(2), np.array([False, True]))
    np.testing.assert_allclose(found, [[0, 0, 0], [1, 1, 1]], atol=1e-6)


def test_uncertain_light_counts_in_the_whole_region() -> None:
    """A small uncertain source gives half of a region's light, though only two of 100 surfels hit it."""
    doubt, region = np.zeros(200), np.repeat([0, 1], 100)
    doubt[[3, 30]] = 50 * np.mean(DOUBT)
    doubt[150] = DOUBT[1]
    found = light_certainty(doubt, np.ones((200, 3)), region)
    np.testing.assert_allclose(np.delete(found[:100], [3, 30]), 0.5, atol=1e-6)
    assert found[3] == found[30] == 0
    np.testing.assert_allclose(np.delete(found[100:], 50), 1, atol=1e-6)
    assert found[150] == 0


def wall(radiance: NDArray) -> Surfels:
    """A row of surfels along x, one per cell, all facing up, each with :data:`OBSERVATIONS` observations."""
    num = len(radiance)
    grid = CellGrid(np.zeros(3), 0.1, np.array([num, 1, 1]), np.full(6 * num, -1, np.int32))
    position = np.stack([0.1 * np.arange(num) + 0.05, np.zeros(num), np.zeros(num)], axis=1)
    normal = np.tile([0.0, 0.0, 1.0], (num, 1))
    none = np.zeros(num, np.int32)
    start = OBSERVATIONS * np.arange(num + 1)
    of_views = np.repeat(radiance, OBSERVATIONS, axis=0)
    view, weight = np.zeros(len(of_views), np.int32), np.ones(len(of_views), np.float32)
    seen = Observations(start, view, of_views, weight, np.repeat(normal, OBSERVATIONS, axis=0))
    unmixed = np.zeros(num, bool)
    return Surfels(grid, position, normal, none, radiance, unmixed, seen, np.zeros((1, 3)), (), ())


def shares_of(
    radiance: NDArray, is_metal: NDArray[np.bool_] | None = None, region: NDArray | None = None
) -> ImpossibleShares:
    """Shares of impossibly bright surfels on a wall where a white surface has a radiance of 1."""
    num = len(radiance)
    is_metal = np.zeros(num, dtype=bool) if is_metal is None else is_metal
    region = np.zeros(num, np.int32) if region is None else region
    return impossible_shares(wall(radiance), np.ones((num, 3)), is_metal, region)


def test_confidence_falls_where_surfaces_reflect_more_than_arrives() -> None:
    """An unphotographed lamp lights one end of a wall, where confidence falls smoothly."""
    num = 10 * BLOCK_CELLS
    radiance = np.full((num, 3), 0.5)
    radiance[: 2 * BLOCK_CELLS] = 1.5
    trust = shares_of(radiance).trust()
    assert trust[:BLOCK_CELLS].max() == 0.0
    assert trust[5 * BLOCK_CELLS :].min() > 0.95
    assert (np.diff(trust) >= 0).all() and np.diff(trust).max() < 0.15
    np.testing.assert_array_equal(shares_of(radiance, is_metal=radiance[:, 0] > 1).trust(), 1.0)


def test_surfels_with_mixed_radiance_do_not_lower_confidence() -> None:
    radiance = np.full((10 * BLOCK_CELLS, 3), 0.5)
    radiance[: 2 * BLOCK_CELLS] = 1.5
    mixed = replace(wall(radiance), is_mixed=radiance[:, 0] > 1)
    num = len(radiance)
    shares = impossible_shares(mixed, np.ones((num, 3)), np.zeros(num, bool), np.zeros(num, np.int32))
    np.testing.assert_array_equal(shares.trust(), 1.0)


def test_few_bright_surfels_do_not_lower_confidence() -> None:
    """Three bright blocks of cells out of thirty, such as window frames, do not affect the others; six do."""
    num = 30 * BLOCK_CELLS
    for blocks, trusted in ((3, 1.0), (6, 0.0)):
        radiance = np.full((num, 3), 0.5)
        radiance[: blocks * BLOCK_CELLS] = 1.5
        assert shares_of(radiance).trust()[0] == pytest.approx(trusted)


def test_confidence_is_low_everywhere_in_an_unlit_room() -> None:
    """If four tenths of the surface reflect more light than they receive, lamps are unphotographed and no
    block is trusted."""
    num = 10 * BLOCK_CELLS
    for blocks, trusted in ((2, 1.0), (3, 0.5), (4, 0.0)):
        radiance = np.full((num, 3), 0.5)
        radiance[: blocks * BLOCK_CELLS] = 1.5
        region = (np.arange(num) >= blocks * BLOCK_CELLS).astype(np.int32)
        assert shares_of(radiance, region=region).trust()[-1] == pytest.approx(trusted, abs=0.01)


@pytest.mark.parametrize(("share", "trusted"), [(0.0, 1.0), (0.09, 1.0), (0.2, 0.5)])
def test_confidence_follows_the_share_around(share: float, trusted: float) -> None:
    """Up to a tenth of bright surfels counts as noise, as does a radiance up to a tenth above white."""
    num = 4 * BLOCK_CELLS
    radiance = np.full((num, 3), 0.5)
    radiance[np.arange(num) % 25 < round(25 * share)] = 1.5
    np.testing.assert_allclose(shares_of(radiance).trust(), trusted, atol=0.1)
    np.testing.assert_array_equal(shares_of(0.7 * radiance).trust(), 1.0)


def test_a_bright_surface_does_not_affect_the_wall_around_it() -> None:
    """Every fourth surfel is a window frame: only the frame's light has no confidence."""
    num = 40 * BLOCK_CELLS
    is_frame = (np.arange(num) % 4 == 0) & (np.arange(num) < 8 * BLOCK_CELLS)
    radiance = np.where(is_frame[:, None], 1.5, 0.5) * np.ones(3)
    evidence = shares_of(radiance, region=is_frame.astype(np.int32)).evidence()
    assert evidence[is_frame].max() == 0.0 and evidence[~is_frame].min() == 1.0
    assert shares_of(radiance).evidence().min() == 1.0  # one surface of which a fourth is bright


def test_few_observations_count_less_than_the_room() -> None:
    """A region of one bright surfel is judged mainly by the room's share of bright surfels."""
    num = 20 * BLOCK_CELLS
    radiance = np.full((num, 3), 0.5)
    radiance[0] = 1.5
    region = (np.arange(num) >= 1).astype(np.int32)
    assert shares_of(radiance, region=region).evidence()[0] > 0.5


def test_only_bumpy_surfaces_have_a_spread_of_normals() -> None:
    """An edge between planes has no spread; normals with errors of 0.2 rad have a spread of 0.2 to 0.3."""
    flat = wall(np.ones((100, 3)))
    np.testing.assert_allclose(normal_spread(flat), 0, atol=1e-6)
    edge = replace(flat, normal=np.where(np.arange(100)[:, None] < 50, [0.0, 0, 1], [0.0, 1, 0]))
    np.testing.assert_allclose(normal_spread(edge), 0, atol=1e-6)
    azimuth = np.random.default_rng(4).uniform(0, 2 * np.pi, 100)
    tilted = np.stack([0.2 * np.cos(azimuth), 0.2 * np.sin(azimuth), np.full(100, 0.98)], axis=1)
    bumpy = replace(flat, normal=tilted / np.linalg.norm(tilted, axis=1, keepdims=True))
    spread = normal_spread(bumpy)
    assert 0.2 < np.median(spread) < 0.3
    assert trust_in_normals(spread).mean() < 0.7


def test_bumps_count_where_the_whole_mesh_is_bumpy() -> None:
    spread = np.array([0.05, 0.05, 0.175, 0.3, 2.0])
    np.testing.assert_allclose(trust_in_normals(spread), [1, 1, 0.75, 0.5, 0.5])
    vases = np.concatenate([np.full(90, 0.001), np.full(10, 0.3)])
    np.testing.assert_array_equal(trust_in_normals(vases), 1)
    half = np.concatenate([np.full(51, 0.03), np.full(49, 0.3)])
    np.testing.assert_allclose(trust_in_normals(half)[51:], 0.75)

# SPDX-License-Identifier: MIT
"""Correction of the shading where the incident light is not photographed."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.light.surfels import CellGrid, Observations, Surfels
from model.reconstruction.light.shading_correction import (
    ESTIMATE_WEIGHT,
    MIN_SPREAD_NETWORK,
    NETWORK_WEIGHT,
    shading_correction,
)

SIDE, CELL_M = 60, 0.025


@pytest.fixture(scope="module")
def wall() -> Surfels:
    """A wall of 60 x 60 surfels without observations."""
    y, z = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    position = (np.stack([np.zeros_like(y), y, z], axis=-1).reshape(-1, 3) + 0.5) * CELL_M
    num = len(position)
    none = np.zeros(0, np.float32)
    rows = none.reshape(0, 3)
    observations = Observations(np.zeros(num + 1, np.int64), none.astype(np.int32), rows, none, rows)
    grid = CellGrid(np.zeros(3), CELL_M, np.array([1, SIDE, SIDE]), np.zeros(0, np.int32))
    normal = np.broadcast_to(np.float32([1, 0, 0]), (num, 3))
    white = np.ones((num, 3), np.float32)
    face, unmixed = np.zeros(num, np.int32), np.zeros(num, bool)
    return Surfels(
        grid, position.astype(np.float32), normal, face, white, unmixed, observations, none, (), ()
    )


def _checks(high: float, low: float) -> np.ndarray:
    """Albedo (N, 3) of a checkerboard with fields of 4 x 4 surfels."""
    y, z = np.divmod(np.arange(SIDE * SIDE), SIDE)
    return np.where(((y // 4 + z // 4) % 2 == 0)[:, None], high, low) * np.array([1.0, 0.9, 0.7])


def _fading() -> np.ndarray:
    """Fade (N,): 0 on a third of the wall, then rising to 1."""
    y = np.arange(SIDE * SIDE) // SIDE
    return np.clip((y - 20) / 40, 0, 1)


def test_albedo_is_kept_where_light_is_misestimated(wall: Surfels) -> None:
    true = _checks(0.8, 0.6)
    away = _fading()
    albedo = true * np.exp(-np.log(4.0) * away)[:, None]
    blue = np.full_like(true, 0.2) * [1, 1, 2]  # the network is wrong everywhere
    region = np.zeros(len(true), np.int32)
    confidence = (away == 0).astype(np.float32)
    found = shading_correction(wall, region, albedo, blue, confidence, confidence, np.ones(len(true), bool))
    error = np.abs(np.log(albedo / true) + found)
    assert np.abs(np.log(albedo / true)).mean() > 0.4
    assert error.mean() < 0.08 and error.max() < 0.25
    step = np.abs(np.diff(found.reshape(SIDE, SIDE, 3), axis=1)).max()
    assert step < 0.02  # the checkerboard is not smoothed


def test_unlit_albedo_has_the_networks_level_and_the_photographs_pattern(
    wall: Surfels,
) -> None:
    true = _checks(0.8, 0.4)
    network = np.broadcast_to(np.exp(np.log(true).mean(axis=0)) * 1.1, true.shape)
    none = np.zeros(len(true), np.float32)
    found = shading_correction(
        wall, none.astype(np.int32), 0.5 * true, network, none, none, np.ones(len(true), bool)
    )
    corrected = 0.5 * true * np.exp(found)
    np.testing.assert_allclose(corrected, 1.1 * true, rtol=0.05)


def test_partly_photographed_light_counts_against_the_network(wall: Surfels) -> None:
    """The network's D is a fifth too low; no surfel is confident, with 5 % or 65 % of light photographed."""
    true = _checks(0.6, 0.5)
    none, on_wall = np.zeros(len(true), np.float32), np.ones(len(true), bool)
    region = none.astype(np.int32)
    without, partly = (
        shading_correction(wall, region, true, 0.8 * true, none, np.full(len(true), share), on_wall)
        for share in (0.05, 0.65)
    )
    np.testing.assert_allclose(without, np.log(0.8), atol=1e-3)
    of_network = NETWORK_WEIGHT / MIN_SPREAD_NETWORK**2
    expected = np.log(0.8) * of_network / (of_network + ESTIMATE_WEIGHT)
    np.testing.assert_allclose(partly, expected, atol=1e-3)


def test_known_light_is_kept_and_a_deviating_network_counts_little(wall: Surfels) -> None:
    """The network's D is a third of the true one in known light, so it counts little in unknown light."""
    true = _checks(0.6, 0.5)
    known = (np.arange(len(true)) % SIDE < SIDE // 2).astype(np.float32)
    network = true / 3 * np.where(np.arange(len(true)) % 2, 2.0, 0.5)[:, None]
    region = np.where(known > 0, 0, 1).astype(np.int32)  # no confident surfel in the other region
    found = shading_correction(wall, region, true, network, known, known, np.ones(len(true), bool))
    assert np.abs(found[known > 0]).max() < 0.05
    assert np.abs(found).max() < 0.25


def test_metal_is_excluded_from_the_correction(wall: Surfels) -> None:
    true = _checks(0.6, 0.5)
    is_diffuse = np.arange(len(true)) % SIDE >= SIDE // 2
    albedo = np.where(is_diffuse[:, None], true, 0.0)
    ones = np.ones(len(true), np.float32)
    found = shading_correction(wall, np.zeros(len(true), np.int32), albedo, true, ones, ones, is_diffuse)
    assert np.abs(found).max() < 1e-3

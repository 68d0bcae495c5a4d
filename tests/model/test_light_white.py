# SPDX-License-Identifier: MIT
"""The albedo of a room's white paint."""

from __future__ import annotations

import numpy as np
import pytest

from model.reconstruction.light.view_maps import HALF_SUPPORT, TYPICAL_WHITE, white_paint


def surfels(*parts: tuple[int, tuple[float, float, float], float]) -> tuple[np.ndarray, np.ndarray]:
    """Albedos (N, 3), scattered by 0.01, and confidences (N,) of parts (number, albedo, confidence)."""
    random = np.random.default_rng(3)
    albedo = np.concatenate([np.tile(color, (num, 1)) for num, color, _ in parts])
    albedo += random.normal(0, 0.01, (len(albedo), 1))
    return albedo, np.concatenate([np.full(num, confidence) for num, _, confidence in parts])


GREY = (0.5, 0.5, 0.5)
YELLOW = (0.93, 0.9, 0.6)
WALL = (0.79, 0.8, 0.78)
TOO_BRIGHT = (0.95, 0.95, 0.95)


def test_mode_of_confident_white_surfels() -> None:
    albedo, confidence = surfels(
        (40_000, GREY, 1.0), (20_000, YELLOW, 1.0), (20_000, WALL, 0.8), (3_000, TOO_BRIGHT, 0.9)
    )
    white = white_paint(albedo, confidence)
    assert white.albedo == pytest.approx(0.79, abs=0.01)
    assert white.known == pytest.approx(1.0, abs=0.03)


def test_surfels_in_uncertain_light_do_not_count() -> None:
    albedo, confidence = surfels((500, WALL, 1.0), (100_000, TOO_BRIGHT, 0.001))
    assert white_paint(albedo, confidence).albedo == pytest.approx(0.812, abs=0.01)


@pytest.mark.parametrize("num", [0, 300, 30_000])
def test_few_surfels_count_less_than_typical_paint(num: int) -> None:
    white = white_paint(*surfels((100, GREY, 1.0), (num, WALL, 1.0)))
    assert white.known == pytest.approx(num / (num + HALF_SUPPORT), rel=0.05)
    assert white.albedo == pytest.approx(TYPICAL_WHITE + white.known * (0.79 - TYPICAL_WHITE), abs=0.01)

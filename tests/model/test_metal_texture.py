# SPDX-License-Identifier: MIT
"""The specular albedo of individual surfels of a metal segment."""

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.light.bake import SpecularShading
from datagen.light.surfels import CellGrid, Observations, Surfels
from model.reconstruction.light.view_maps import textured_specular_albedo

NUM, VIEWS = 200, 30
SEGMENT_S = 0.5
TILES = np.where(np.arange(NUM) % 2, 0.8, 0.17)[:, None] * np.array([1.0, 0.9, 0.7])


def found(roughness: float, wrong: float = 0.0) -> NDArray[np.float32]:
    """S (NUM, 3) found from noisy shading of :data:`TILES`, the last being paint. In the share ``wrong`` of
    the observations, unphotographed light makes the lobe 9 times as bright as assumed."""
    random = np.random.default_rng(3)
    start = np.arange(NUM + 1) * VIEWS
    owner = np.repeat(np.arange(NUM), VIEWS)
    ls0, ls1 = random.gamma(2.0, 1.0, (2, NUM * VIEWS, 3)).astype(np.float32)
    is_wrong = random.random(NUM * VIEWS) < wrong
    radiance = (TILES[owner] * ls0 + 0.1 * ls1) * np.where(is_wrong, 9, 1)[:, None]
    noise = random.uniform(0.7, 1.3, (NUM * VIEWS, 1))
    rows, ones = np.zeros((NUM, 3), np.float32), np.ones(NUM * VIEWS, np.float32)
    seen = Observations(
        start, np.zeros(NUM * VIEWS, np.int32), radiance.astype(np.float32), ones, np.zeros_like(radiance)
    )
    grid = CellGrid(np.zeros(3), 1.0, np.ones(3, int), np.zeros(6, np.int32))
    face, is_mixed = np.zeros(NUM, np.int32), np.zeros(NUM, bool)
    surfels = Surfels(grid, rows, rows, face, rows, is_mixed, seen, rows[:1], (), ())
    shading = SpecularShading(ls0 * noise, 0.1 * ls1, ones, 1.0 - is_wrong)
    segment, rough = np.full((NUM, 3), SEGMENT_S, np.float32), np.full(NUM, roughness, np.float32)
    return textured_specular_albedo(surfels, segment, rough, np.arange(NUM) < NUM - 1, shading)


def test_blurred_reflections_tell_tiles_apart() -> None:
    error = found(0.35)[:-1] - TILES[:-1]
    assert np.sqrt((error**2).mean()) < 0.06


def test_light_in_no_photograph_has_little_weight() -> None:
    error = found(0.35, wrong=0.45)[:-1] - TILES[:-1]
    assert np.sqrt((error**2).mean()) < 0.1


def test_sharp_reflections_and_paint_keep_the_albedo_of_their_segment() -> None:
    np.testing.assert_array_equal(found(0.2), np.float32(SEGMENT_S))
    np.testing.assert_array_equal(found(0.35)[-1], np.float32(SEGMENT_S))


@pytest.mark.parametrize("roughness", [0.21, 0.25, 0.29])
def test_texture_fades_in_with_roughness(roughness: float) -> None:
    share = (roughness - 0.2) / 0.1
    expected = share * found(0.35) + (1 - share) * SEGMENT_S
    np.testing.assert_allclose(found(roughness), expected, atol=1e-5)

# SPDX-License-Identifier: MIT
"""Typical reflectance of smooth regions, which is assumed for unphotographed surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.light.bake import Irradiance
from datagen.light.unseen_surfaces import PRIOR_SURFELS, RATIO_EVIDENCE, Regions, typical_reflectance

NUM = 90
TRUE = np.array([0.2, 0.6, 0.8])
"""Reflectance of the regions 0, 1 and 2; region 3 has no surfels."""
REGION = np.repeat([0, 1, 2], [40, 49, 1]).astype(np.int32)
SHADING = np.random.default_rng(1).uniform(0.5, 2.0, (NUM, 3)).astype(np.float32)


@dataclass(frozen=True)
class Surfels:
    """The fields of surfels that ``typical_reflectance`` uses."""

    position_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    radiance: NDArray[np.float64]
    face: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.radiance)


@dataclass(frozen=True)
class Baker:
    """Stub by which half of the irradiance is known; ``photographed`` (N,) is the photographed share."""

    photographed: NDArray[np.float32]

    def irradiance(self, position_m: NDArray, normal: NDArray, num_rays: int) -> Irradiance:
        half = np.full(NUM, 0.5, np.float32)
        return Irradiance(0.5 * SHADING, half, self.photographed)


def typical(
    photographed: NDArray | float = 1.0,
    radiance: NDArray | None = None,
    objects: Sequence[int] = (0, 1, 2, 3),
) -> NDArray[np.float64]:
    nowhere = np.zeros((NUM, 3))
    radiance = TRUE[REGION, None] * SHADING if radiance is None else radiance
    surfels: Any = Surfels(nowhere, nowhere, radiance, np.arange(NUM))  # one triangle per surfel
    baker: Any = Baker(np.broadcast_to(np.float32(photographed), (NUM,)))
    return typical_reflectance(baker, surfels, Regions(REGION, np.array(objects, np.int32)), 48)


def test_regions_have_the_median_of_their_surfels() -> None:
    """A region's median is shrunk towards its object's, and that towards the room's, most for few surfels."""
    found, room = typical(), np.log(0.6)
    for which, count in enumerate(np.bincount(REGION)):
        prior = (PRIOR_SURFELS / (count + PRIOR_SURFELS)) ** 2
        expected = np.exp((1 - prior) * np.log(TRUE[which]) + prior * room)
        np.testing.assert_allclose(found[which], expected, rtol=1e-6)
    np.testing.assert_allclose(found[3], 0.6, rtol=1e-6)
    assert found[0, 0] == pytest.approx(0.2, rel=0.02)


def test_regions_without_surfels_have_the_reflectance_of_their_object() -> None:
    """Region 3 belongs to the object of region 0, or to that of regions 0 and 1, where 1 has more surfels."""
    assert typical(objects=(0, 1, 2, 0))[3, 0] == pytest.approx(0.2, rel=0.12)
    np.testing.assert_allclose(typical(objects=(0, 0, 1, 0))[3], 0.6, rtol=1e-6)


def test_surfels_in_photographed_light_prevail() -> None:
    """Surfels whose incident light is hardly photographed, here with reflectances three times too high, get
    little or no weight. If too little light is photographed everywhere, the reflectance 0.4 is assumed."""
    is_wrong = np.arange(NUM) % 5 < 3
    wrong = TRUE[REGION, None] * SHADING * np.where(is_wrong, 3.0, 1.0)[:, None]
    low, high = RATIO_EVIDENCE
    for share in (low, low + 0.2 * (high - low)):
        assert typical(np.where(is_wrong, share, 1.0), wrong)[0, 1] == pytest.approx(0.2, rel=0.3)
    assert typical(1.0, wrong)[0, 1] > 0.5
    np.testing.assert_array_equal(typical(low), np.full((4, 3), 0.4))


def test_reflectance_is_between_0_05_and_0_9() -> None:
    found = typical(radiance=SHADING * np.where(REGION == 0, 1e-3, 50.0)[:, None])
    assert found.min() > 0.049 and found.max() < 0.901

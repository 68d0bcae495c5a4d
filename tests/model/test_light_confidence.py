# SPDX-License-Identifier: MIT
"""How much the light is trusted, and what takes its place where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from model.reconstruction.light.confidence import (
    D_EVIDENCE,
    IMPOSSIBLE,
    impossible_share,
    surfel_confidence,
    trust_of,
)


def test_confidence_grows_with_what_photographs_show() -> None:
    found = surfel_confidence(np.array([0.0, D_EVIDENCE[0], np.mean(D_EVIDENCE), D_EVIDENCE[1], 1.0]))
    np.testing.assert_allclose(found[:, 0], [0, 0, 0.5, 1, 1], atol=1e-6)
    assert (found[:, 1] == found[:, 2]).all() and (found[:, 1] >= found[:, 0]).all()


def test_rooms_that_reflect_more_than_arrives_are_not_trusted() -> None:
    """A lamp that no photograph shows lights a quarter of the surfels."""
    radiance, diffuse = np.full((8, 3), 0.5), np.ones((8, 3))
    radiance[:2] = 1.5
    assert impossible_share(radiance, diffuse, np.ones(8)) == pytest.approx(0.25)
    assert impossible_share(radiance, diffuse, np.array([0.0, 0.0, 1, 1, 1, 1, 1, 1])) == 0.0
    assert trust_of(0.0) == trust_of(IMPOSSIBLE[0]) == 1.0
    assert trust_of(IMPOSSIBLE[1]) == trust_of(0.6) == 0.0
    assert 0.4 < trust_of(np.mean(IMPOSSIBLE)) < 0.6

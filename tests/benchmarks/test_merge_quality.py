# SPDX-License-Identifier: MIT
"""Discontinuities of merged D at the borders of the views' footprints."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.bench_merge_quality import steps
from model.reconstruction.atlas.atlas import Atlas, empty_atlas

SIDE = 8


def halves(left: float, right: float) -> Atlas:
    """An atlas with a merged D of ``left`` where one view sees the surface and ``right`` where two do."""
    atlas = empty_atlas(SIDE)
    atlas.count[:, : SIDE // 2], atlas.count[:, SIDE // 2 :] = 1, 2
    atlas.maps["diffuse_albedo"][:, : SIDE // 2] = left
    atlas.maps["diffuse_albedo"][:, SIDE // 2 :] = right
    return atlas


def test_a_step_where_a_footprint_ends_counts_as_border() -> None:
    found = steps(halves(0.25, 0.5), halves(0.25, 0.25))
    assert found["border"] == (pytest.approx(0.25 * SIDE), SIDE)
    assert found["inside"] == (0.0, SIDE * (SIDE - 2) + SIDE * (SIDE - 1))


def test_a_step_inside_a_footprint_counts_as_inside() -> None:
    merged = halves(0.25, 0.25)
    merged.maps["diffuse_albedo"][3:] = 0.5
    found = steps(merged, halves(0.25, 0.25))
    assert found["border"][0] == 0.0
    assert found["inside"][0] == pytest.approx(0.25 * SIDE)


def test_true_edges_and_unseen_texels_are_excluded() -> None:
    truth = halves(0.25, 0.5)
    assert steps(halves(0.25, 0.5), truth)["border"] == (0.0, 0)
    merged = halves(0.25, 0.5)
    merged.count[:] = np.where(np.arange(SIDE) < SIDE // 2, 1, 0)
    assert steps(merged, halves(0.25, 0.25))["border"] == (0.0, 0)

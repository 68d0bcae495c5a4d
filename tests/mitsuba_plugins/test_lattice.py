# SPDX-License-Identifier: MIT
"""Lattices of positions in a pixel: distinct in each coordinate, and as far apart as a search finds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from oracles.bsdf_probe import array, mi

from mitsuba_plugins.lattice import generator, lattice_point  # isort: skip


def points_of(num_points: int, shift: tuple[int, int] = (0, 0)) -> NDArray[np.float64]:
    """Points (N, 2) of a shifted lattice."""
    index = mi.UInt32(np.arange(num_points, dtype=np.uint32))
    steps = zip(shift, generator(num_points), strict=True)
    return np.stack([array(lattice_point(index, mi.UInt32(s), step)) for s, step in steps], axis=-1)


def minimum_distance(points: NDArray[np.float64]) -> float:
    """Minimum distance of a point from the first one on the torus."""
    apart = np.abs(points[1:] - points[0])
    return float(np.hypot(*np.minimum(apart, 1.0 - apart).T).min())


@pytest.mark.parametrize("num_points", [2, 3, 5, 16, 48, 64, 89])
def test_points_are_as_far_apart_as_any_lattice_permits(num_points: int) -> None:
    index = np.arange(num_points)
    every = [
        np.stack([index / num_points, index * g / num_points % 1.0], axis=-1)
        for g in range(1, num_points)
        if math.gcd(g, num_points) == 1
    ]
    found = minimum_distance(points_of(num_points))
    assert found == pytest.approx(max(map(minimum_distance, every)), abs=1e-6)


@pytest.mark.parametrize("num_points", [1, 7, 48, 4096])
def test_each_coordinate_is_stratified(num_points: int) -> None:
    points = points_of(num_points, (0x9E3779B9, 0x12345678))
    assert points.min() >= 0.0 and points.max() < 1.0
    for axis in (0, 1):
        gaps = np.diff(np.sort(points[:, axis]))
        np.testing.assert_allclose(gaps, 1.0 / num_points, atol=1e-6)

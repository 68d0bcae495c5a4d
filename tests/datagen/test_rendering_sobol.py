# SPDX-License-Identifier: MIT
"""Sobol samples of paths: stratified in every pair of dimensions, uniform, independent between pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def points(key: Any, count: int, *, first: int = 0, pairs: int = 3) -> NDArray[np.float64]:
    """Return the first pairs of dimensions (pairs, count, 2) of a pixel, starting at its sample ``first``."""
    import drjit as dr
    import mitsuba as mi

    from datagen.rendering.transport.sobol import OwenSobol

    sampler = OwenSobol(dr.arange(mi.UInt32, count) + first, mi.UInt32(key) + dr.zeros(mi.UInt32, count))
    return np.stack([np.array(sampler.next_2d()).T for _ in range(pairs)]).astype(np.float64)


@pytest.mark.parametrize("first", [0, 64, 4096])
def test_every_block_of_64_fills_all_elementary_intervals(first: int) -> None:
    for pair in points(77, 64, first=first):
        for columns_log2 in range(7):
            columns, rows = 2**columns_log2, 2 ** (6 - columns_log2)
            cells = np.floor(pair[:, 0] * columns) * rows + np.floor(pair[:, 1] * rows)
            assert len(np.unique(cells)) == 64


def test_single_numbers_are_stratified(mitsuba_variant: str) -> None:
    import drjit as dr
    import mitsuba as mi

    from datagen.rendering.transport.sobol import OwenSobol

    sampler = OwenSobol(dr.arange(mi.UInt32, 256), dr.full(mi.UInt32, 3, 256))
    for _ in range(4):
        assert len(np.unique(np.floor(np.array(sampler.next_1d()) * 256))) == 256


def test_pixels_and_dimensions_are_independent() -> None:
    import drjit as dr
    import mitsuba as mi

    from datagen.rendering.transport.sobol import OwenSobol

    count = 1 << 18
    pixel: Any = dr.arange(mi.UInt32, count)
    launch: Any = mi.UInt32(5)
    keys = mi.sample_tea_32(pixel, launch)[0]
    sampler = OwenSobol(dr.zeros(mi.UInt32, count), keys)  # the first sample of many pixels
    drawn = np.concatenate([np.array(sampler.next_2d()) for _ in range(6)] + [[np.array(sampler.next_1d())]])
    assert ((drawn >= 0.0) & (drawn < 1.0)).all()
    noise = 1.0 / np.sqrt(count)
    assert np.abs(drawn.mean(axis=1) - 0.5).max() < 5 * noise * np.sqrt(1 / 12)
    off_diagonal = np.corrcoef(drawn) - np.eye(len(drawn))
    assert np.abs(off_diagonal).max() < 5 * noise
    beside = [np.corrcoef(row[:-1], row[1:])[0, 1] for row in drawn]
    assert np.abs(beside).max() < 5 * noise
    for row in drawn:  # chi-square test of uniformity with 64 bins
        expected = count / 64
        statistic = ((np.histogram(row, 64, (0, 1))[0] - expected) ** 2 / expected).sum()
        assert statistic < 63 + 5 * np.sqrt(2 * 63)


def test_estimates_converge_faster_than_with_independent_samples() -> None:
    """For a smooth function and 256 samples, the RMS error is below 5 % of that of independent samples."""

    def error(samples: list[NDArray[np.float64]]) -> float:
        values = [np.exp(-3 * s[:, 0]) * np.sin(np.pi * s[:, 1]) for s in samples]
        exact = (1 - np.exp(-3)) / 3 * 2 / np.pi
        return float(np.sqrt(np.mean([(v.mean() - exact) ** 2 for v in values])))

    generator = np.random.default_rng(1)
    ours = error([points(1000 + k, 256, pairs=2)[1] for k in range(64)])
    assert ours < 0.05 * error([generator.random((256, 2)) for _ in range(64)])

# SPDX-License-Identifier: MIT
"""Light removed by the firefly clamp is restored where its amount is certain, otherwise counted as error."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.rendering.clamped_light import missing_error, restored_share
from datagen.rendering.error import EPSILON

SIZE = (64, 96)


def fireflies(count: int, share: float, seed: int = 0) -> NDArray[np.float64]:
    """Return light (H, W) removed at ``count`` random pixels, equal amounts with the mean ``share``."""
    removed = np.zeros(SIZE[0] * SIZE[1])
    removed[np.random.default_rng(seed).choice(removed.size, count, replace=False)] = (
        share * removed.size / count
    )
    return removed.reshape(SIZE)


def test_frequent_fireflies_are_restored() -> None:
    level = np.ones(SIZE)
    level[:, 48:] = 0.01  # light is restored in proportion to the pixel's luminance
    restored = level * restored_share(level, 0.05 * level)
    assert restored.sum() == pytest.approx(0.05 * level.sum(), rel=0.03)
    assert restored[:, 90].max() < 0.001
    scattered = restored_share(np.ones(SIZE), fireflies(600, 0.05))
    assert scattered.mean() == pytest.approx(0.05, rel=0.1)
    assert scattered.std() < 0.01


def test_dense_fireflies_stay_in_place() -> None:
    removed = np.zeros(SIZE)
    removed[20:30, 40:50] = np.random.default_rng(1).uniform(0.0, 2.0, (10, 10))
    restored = restored_share(np.ones(SIZE), removed)
    assert restored.sum() == pytest.approx(removed.sum(), rel=0.1)
    assert restored[18:32, 38:52].sum() > 0.6 * removed.sum()


def test_rare_fireflies_are_not_restored() -> None:
    """A few fireflies, however bright, do not determine how much light is missing."""
    assert not restored_share(np.ones(SIZE), fireflies(1, 1.0)).any()
    assert restored_share(np.ones(SIZE), fireflies(4, 0.1)).mean() < 0.01
    assert not restored_share(np.ones(SIZE), np.zeros(SIZE)).any()
    assert not restored_share(np.zeros(SIZE), fireflies(600, 0.05)).any()  # no light to multiply


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_restored_share_does_not_depend_on_brightness(unit: float) -> None:
    level, removed = np.ones(SIZE), fireflies(300, 0.1)
    assert restored_share(unit * level, unit * removed) == pytest.approx(restored_share(level, removed))


def test_only_missing_light_is_an_error() -> None:
    level, uniform = np.ones(SIZE), np.full(SIZE, 0.1)
    assert missing_error(level, (uniform, uniform), 1.0) < 1e-6  # restored
    rare = np.zeros(SIZE)
    rare[30, 40] = 100.0
    assert missing_error(level, (rare, rare), 1.0) > 0.003 / (1.0 + EPSILON)
    assert missing_error(level, (rare, np.zeros(SIZE)), 1.0) == 0.0

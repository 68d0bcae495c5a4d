# SPDX-License-Identifier: MIT
"""Sorts many short lists at once, one per lane of vector instructions, by Batcher's odd-even merge sort,
whose sequence of comparisons does not depend on the values.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.multiview.compiled import compiled
from datagen.multiview.statistics import sorting_network

LANES = 64
_HALF, _QUARTER = np.float32(0.5), np.float32(0.25)
STEP = 4
"""Lists are sorted by the network for their length rounded up to a multiple of this number."""


def networks(most: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Build Batcher's sorting networks for lists of 0, STEP, 2 STEP, ... values, to at least ``most``.

    Returns the comparisons (C, 2) of all networks as pairs of rows, and offsets (K + 1,) of the K networks.
    """
    powers = [1 << bits for bits in range((most + STEP).bit_length() + 1)]
    full = {power: sorting_network(power) for power in powers}
    tables = []
    for size in range(0, most + STEP, STEP):
        pairs = full[1 << max(size - 1, 0).bit_length()]
        tables.append(pairs[pairs[:, 1] < size])  # without comparisons beyond the list's end
    starts = np.cumsum([0, *map(len, tables)], dtype=np.int64)
    return np.concatenate(tables).astype(np.int32), starts


@compiled
def sort_lanes(values: Any, network: Any) -> None:
    """Sort each column of ``values`` (R, LANES) in ascending order by the comparisons ``network`` (C, 2)."""
    for index in range(len(network)):
        a, b = values[network[index, 0]], values[network[index, 1]]
        for lane in range(LANES):
            low, high = a[lane], b[lane]
            a[lane] = low if low < high else high
            b[lane] = high if low < high else low


@compiled
def sort_weighted_lanes(values: Any, weights: Any, network: Any) -> None:
    """Sort as :func:`sort_lanes` does, and permute ``weights`` (R, LANES) with the values."""
    for index in range(len(network)):
        i, k = network[index, 0], network[index, 1]
        a, b, light, heavy = values[i], values[k], weights[i], weights[k]
        for lane in range(LANES):
            low, high, c, d = a[lane], b[lane], light[lane], heavy[lane]
            is_sorted = low < high
            a[lane] = low if is_sorted else high
            b[lane] = high if is_sorted else low
            light[lane] = c if is_sorted else d
            heavy[lane] = d if is_sorted else c


@compiled
def middle_mean(values: Any, weights: Any, lane: Any, num: Any) -> Any:
    """Compute the weighted interquartile mean of the first ``num`` sorted values of a lane.

    A value is weighted by the part of its weight between a quarter and three quarters of the cumulative
    weight. Outliers are ignored, as by the median, but the result is continuous in the weights.
    """
    total = np.float32(0)
    for k in range(num):
        total += weights[k, lane]
    low, high = _QUARTER * total, (_HALF + _QUARTER) * total
    before, mean, parts = np.float32(0), np.float32(0), np.float32(0)
    for k in range(num):
        after = before + weights[k, lane]
        part = min(after, high) - max(before, low)
        if part > 0:
            mean += part * values[k, lane]
            parts += part
        before = after
    return mean / parts

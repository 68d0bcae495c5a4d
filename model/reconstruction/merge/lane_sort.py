# SPDX-License-Identifier: MIT
"""Sorts many short lists at once in machine code: one list per lane of vector instructions, by Batcher's
odd-even merge sort, whose comparisons do not depend on the values.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from datagen.multiview.compiled import compiled

LANES = 64
_HALF = np.float32(0.5)
STEP = 4
"""Lists are sorted by the network for the next multiple of this."""


@compiled
def networks(most: int) -> tuple[Any, Any]:
    """Batcher's networks for lists of up to ``most`` values rounded up to ``STEP``.

    Comparisons (C, 2), and the index of the first comparison for k * STEP values, k = 0, 1, ... .
    """
    num_sizes = (most + STEP - 1) // STEP + 1
    starts = np.zeros(num_sizes + 1, np.int64)
    pairs = [(np.int32(0), np.int32(0))]
    for size in range(num_sizes):
        num, p = size * STEP, 1
        while p < num:
            k = p
            while k >= 1:
                for j in range(k % p, num - k, 2 * k):
                    for i in range(j, min(j + k, num - k)):
                        if i // (2 * p) == (i + k) // (2 * p):
                            pairs.append((np.int32(i), np.int32(i + k)))
                k //= 2
            p *= 2
        starts[size + 1] = len(pairs) - 1
    table = np.empty((len(pairs) - 1, 2), np.int32)
    for index in range(len(table)):
        table[index, 0], table[index, 1] = pairs[index + 1]
    return table, starts


@compiled
def sort_lanes(values: Any, network: Any) -> None:
    """Sort each lane of (R, LANES) ``values`` in ascending order."""
    for index in range(len(network)):
        a, b = values[network[index, 0]], values[network[index, 1]]
        for lane in range(LANES):
            low, high = a[lane], b[lane]
            a[lane] = low if low < high else high
            b[lane] = high if low < high else low


@compiled
def sort_weighted_lanes(values: Any, weights: Any, network: Any) -> None:
    """As :func:`sort_lanes`; ``weights`` are permuted alike."""
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
def weighted_median(values: Any, weights: Any, lane: Any, num: Any) -> Any:
    """Weighted median of a lane's sorted values: the first at which the cumulative weight exceeds half of the
    total; if it is exactly half at a value, the mean of that value and the next.
    """
    total = np.float32(0)
    for k in range(num):
        total += weights[k, lane]
    before = np.float32(0)
    for k in range(num - 1):
        before += weights[k, lane]
        if _HALF * total < before:
            return values[k, lane]
        if _HALF * total == before:
            return _HALF * (values[k, lane] + values[k + 1, lane])
    return values[num - 1, lane]

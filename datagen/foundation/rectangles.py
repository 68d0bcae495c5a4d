# SPDX-License-Identifier: MIT
"""Search for the largest rectangles in a mask."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray


def rectangles(mask: NDArray[np.bool_], count: int, min_side: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield up to ``count`` disjoint all-True rectangles ``mask[x0:x1, y0:y1]``, the largest first."""
    mask = mask.copy()
    for _ in range(count):
        x0, x1, y0, y1 = largest_rectangle(mask, min_side)
        if x1 <= x0:
            return
        yield x0, x1, y0, y1
        mask[x0:x1, y0:y1] = False


def largest_rectangle(mask: NDArray[np.bool_], min_side: int = 1) -> tuple[int, int, int, int]:
    """Return (x0, x1, y0, y1) of the largest all-True rectangle ``mask[x0:x1, y0:y1]``; zeros if none.

    Sides are at least ``min_side``. Each row is searched as a histogram of the runs of True that end in it.
    """
    best, result = 0, (0, 0, 0, 0)
    heights = np.zeros(mask.shape[1] + 1, dtype=np.int64)  # the last stays 0, which ends every open rectangle
    for row in range(mask.shape[0]):
        heights[:-1] = np.where(mask[row], heights[:-1] + 1, 0)
        if heights.max() * mask.shape[1] <= best:
            continue
        stack: list[tuple[int, int]] = []  # (start, height), heights increasing
        for column, height in enumerate(heights.tolist()):
            start = column
            while stack and stack[-1][1] > height:
                start, tall = stack.pop()
                if tall >= min_side and column - start >= min_side and tall * (column - start) > best:
                    best = tall * (column - start)
                    result = (row + 1 - tall, row + 1, start, column)
            if height and (not stack or stack[-1][1] < height):
                stack.append((start, height))
    return result

# SPDX-License-Identifier: MIT
"""Covers masks with a small number of rectangles."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

COVERED, MAX_RECTANGLES = 0.98, 12
"""Share of a mask that rectangles must cover, and maximum number of rectangles."""


def cover(mask: NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    """Find disjoint rectangles (row, column, rows, columns) that cover the share :data:`COVERED` of a mask
    (H, W), at most :data:`MAX_RECTANGLES`, in decreasing order of size.
    """
    rest = mask.copy()
    found: list[tuple[int, int, int, int]] = []
    while rest.sum() > (1 - COVERED) * mask.sum() and len(found) < MAX_RECTANGLES:
        row, column, rows, columns = largest_rectangle(rest)
        rest[row : row + rows, column : column + columns] = False
        found.append((row, column, rows, columns))
    return found


def largest_rectangle(mask: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """Find the largest rectangle (row, column, rows, columns) within which a mask (H, W) is True."""
    best, size = (0, 0, 0, 0), 0
    heights = np.zeros(mask.shape[1] + 1, np.int64)  # a final 0 closes all open rectangles
    for row, line in enumerate(mask):
        heights[:-1] = np.where(line, heights[:-1] + 1, 0)
        stack: list[int] = []
        for column, height in enumerate(heights):
            start = column
            while stack and heights[stack[-1]] >= height:
                tall = int(heights[stack.pop()])
                start = stack[-1] + 1 if stack else 0
                if tall * (column - start) > size:
                    size = tall * (column - start)
                    best = (row - tall + 1, start, tall, column - start)
            stack.append(column)
    return best


def cut(block: tuple[int, int, int, int], most: int) -> list[tuple[int, int, int, int]]:
    """Cut a rectangle (row, column, rows, columns) into pieces of at most ``most`` rows and columns."""
    row, column, rows, columns = block
    down, along = -(-rows // most), -(-columns // most)
    tops = np.linspace(row, row + rows, down + 1).round().astype(int)
    lefts = np.linspace(column, column + columns, along + 1).round().astype(int)
    return [
        (int(top), int(left), int(bottom - top), int(right - left))
        for top, bottom in pairwise(tops)
        for left, right in pairwise(lefts)
    ]

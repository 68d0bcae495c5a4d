# SPDX-License-Identifier: MIT
"""Covers masks with a small number of rectangles."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.rectangles import largest_rectangle

COVERED, MAX_RECTANGLES = 0.98, 12
"""Share of a mask that rectangles must cover, and maximum number of rectangles."""


def cover(mask: NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    """Find up to :data:`MAX_RECTANGLES` disjoint rectangles (row, column, rows, columns) that cover the share
    :data:`COVERED` of a mask (H, W), in decreasing order of size.
    """
    rest = mask.copy()
    found: list[tuple[int, int, int, int]] = []
    while rest.sum() > (1 - COVERED) * mask.sum() and len(found) < MAX_RECTANGLES:
        top, bottom, left, right = largest_rectangle(rest)
        rest[top:bottom, left:right] = False
        found.append((top, left, bottom - top, right - left))
    return found


def cut(block: tuple[int, int, int, int], max_side: int) -> list[tuple[int, int, int, int]]:
    """Cut a rectangle (row, column, rows, columns) into pieces of at most ``max_side`` rows and columns."""
    row, column, rows, columns = block
    num_rows, num_columns = -(-rows // max_side), -(-columns // max_side)
    tops = np.linspace(row, row + rows, num_rows + 1).round().astype(int)
    lefts = np.linspace(column, column + columns, num_columns + 1).round().astype(int)
    return [
        (int(top), int(left), int(bottom - top), int(right - left))
        for top, bottom in pairwise(tops)
        for left, right in pairwise(lefts)
    ]

# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses the resolution of a baked channel among box-filtered levels of a fine bake. Uses no bpy.

Images are (H, W, C) float32, row 0 at the bottom (v = 0); H and W are powers of two. A mask (H, W) marks the
texels covered by the surface; the others are filled from their neighbours and excluded from errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
_NUM_RINGS = 2
_BLOCK_ROWS = 64


@dataclass(frozen=True)
class Level:
    """A coarser image that replaces a finer one.

    ``error`` is the mean absolute difference over covered texels, in the worst component, between the finer
    image and this one, interpolated linearly.
    """

    image: Image
    error: float


def halve(image: Image, weight: Image, axis: int) -> tuple[Image, Image]:
    """Average pairs of texels along an axis, weighted by coverage (H, W, 1); returns image and coverage."""
    first, second = (slice(None, None, 2), slice(1, None, 2))
    a, b = (image[first], image[second]) if axis == 0 else (image[:, first], image[:, second])
    p, q = (weight[first], weight[second]) if axis == 0 else (weight[:, first], weight[:, second])
    total = p + q
    return (a * p + b * q) / np.maximum(total, 1e-12), total / 2


def _axis_weights(size: int, target: int, repeats: bool) -> tuple[NDArray, NDArray, NDArray]:
    centre = (np.arange(target) + 0.5) * size / target - 0.5
    low = np.floor(centre).astype(int)
    fraction = (centre - low).astype(np.float32)
    if repeats:
        return low % size, (low + 1) % size, fraction
    return np.clip(low, 0, size - 1), np.clip(low + 1, 0, size - 1), fraction


def interpolate(
    image: Image, height: int, width: int, repeats: bool = True, rows: slice = slice(None)
) -> Image:
    """Resample an image bilinearly to ``height`` x ``width`` texels, with wrap-around if ``repeats``.

    Only ``rows`` of the result are computed.
    """
    if image.shape[0] == height:
        result = image[rows]
    else:
        low, high, t = (values[rows] for values in _axis_weights(image.shape[0], height, repeats))
        result = image[low] * (1 - t)[:, None, None] + image[high] * t[:, None, None]
    if image.shape[1] == width:
        return result
    low, high, t = _axis_weights(image.shape[1], width, repeats)
    return result[:, low] * (1 - t)[None, :, None] + result[:, high] * t[None, :, None]


def _shifted(values: NDArray, rows: int, columns: int) -> NDArray:
    """Shift ``values`` (H, W, ...) by whole texels, filling with zeros."""
    result = np.zeros_like(values)
    height, width = values.shape[:2]
    if abs(rows) < height and abs(columns) < width:
        result[max(rows, 0) : height + min(rows, 0), max(columns, 0) : width + min(columns, 0)] = values[
            max(-rows, 0) : height + min(-rows, 0), max(-columns, 0) : width + min(-columns, 0)
        ]
    return result


def dilate(image: Image, mask: Mask) -> tuple[Image, Mask]:
    """Grow the mask by a ring of texels, each the mean of its covered neighbours; returns image and mask."""
    covered = np.where(mask[..., None], image, 0)
    total = np.zeros_like(image)
    count = np.zeros((*mask.shape, 1), np.float32)
    weight = mask.astype(np.float32)[..., None]
    for rows in (-1, 0, 1):
        for columns in (-1, 0, 1):
            if rows or columns:
                total += _shifted(covered, rows, columns)
                count += _shifted(weight, rows, columns)
    is_new = ~mask & (count[..., 0] > 0)
    return np.where(is_new[..., None], total / np.maximum(count, 1), image), mask | is_new


def fill(image: Image, mask: Mask) -> Image:
    """Fill the texels outside the mask: two rings from their neighbours, the rest by push-pull.

    Interpolation at the border of a chart reads the rings; push-pull alone would mix in other charts there.
    """
    if mask.all():
        return image
    if not mask.any():
        return np.zeros_like(image)
    for _ in range(_NUM_RINGS):
        image, mask = dilate(image, mask)
    levels: list[tuple[Image, Image]] = [(image, mask.astype(np.float32)[..., None])]
    while levels[-1][0].shape[0] > 1 or levels[-1][0].shape[1] > 1:
        current, weight = levels[-1]
        for axis in (0, 1):
            if current.shape[axis] > 1:
                current, weight = halve(current, weight, axis)
        levels.append((current, weight))
    filled = levels[-1][0]
    for current, weight in reversed(levels[:-1]):
        coarse = interpolate(filled, current.shape[0], current.shape[1], False)
        filled = np.where(weight > 0, current, coarse)
    return filled.astype(np.float32)


def smallest_level(image: Image, mask: Mask, tolerance: float, counted: Mask | None = None) -> Level:
    """Find the coarsest level whose error is at most ``tolerance``; each axis is halved separately.

    A channel that varies along one axis only is reduced to a single row or column. Returns the filled image
    (error 0) if no level is good enough. ``counted``: mask of the texels over which the error is computed, by
    default ``mask``.
    """
    counted = mask if counted is None else counted
    best = Level(fill(image, mask), 0.0)
    weight = mask.astype(np.float32)[..., None]
    current = image
    axes = [0, 1]
    while axes:
        for axis in list(axes):
            if current.shape[axis] == 1:
                axes.remove(axis)
                continue
            smaller, smaller_weight = halve(current, weight, axis)
            filled = fill(smaller, smaller_weight[..., 0] > 0)
            error = level_error(filled, image, counted, tolerance)
            if error > tolerance:
                axes.remove(axis)
                continue
            current, weight, best = smaller, smaller_weight, Level(filled, error)
    return best


def level_error(level: Image, image: Image, mask: Mask, enough: float = math.inf) -> float:
    """Mean absolute difference of ``image`` and interpolated ``level`` over ``mask``, in the worst component.

    The sum stops once the mean exceeds ``enough``; the result is then a lower bound.
    """
    height, width = image.shape[:2]
    count = np.count_nonzero(mask)
    is_full = count == mask.size
    total = np.zeros(image.shape[2])
    for start in range(0, height, _BLOCK_ROWS):
        rows = slice(start, min(start + _BLOCK_ROWS, height))
        difference = np.abs(interpolate(level, height, width, rows=rows) - image[rows])
        covered = difference.reshape(-1, difference.shape[2]) if is_full else difference[mask[rows]]
        total += covered.sum(axis=0, dtype=np.float64)
        if total.max() > enough * count:
            break
    return float(total.max()) / max(count, 1)

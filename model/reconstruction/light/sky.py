# SPDX-License-Identifier: MIT
"""Converts distant light from outside to an image of the sky."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.light.background import Background

HEIGHT, WIDTH = 64, 128
"""Size of the sky image in pixels."""


def sky_image(background: Background) -> NDArray[np.float32]:
    """Convert the radiance of a ``background`` to an image of a distant sky (HEIGHT, WIDTH, 3).

    A pixel is the mean of its known bins; a pixel without known bins equals the nearest one with some.
    """
    of_direction = directions_of(background.layout.ways(), HEIGHT)
    pixel = np.resize(of_direction, background.layout.size)[background.is_known]
    radiance = background.radiance[background.is_known].astype(np.float64)
    count = np.bincount(pixel, minlength=HEIGHT * WIDTH)
    sums = [np.bincount(pixel, column, HEIGHT * WIDTH) for column in radiance.T]
    image = (np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]).astype(np.float32)
    known = count > 0
    if known.any():
        every = direction_vectors(HEIGHT)
        _, nearest = cKDTree(every[known]).query(every[~known])
        image[~known] = image[known][nearest]
    return image.reshape(HEIGHT, WIDTH, 3)


def directions_of(direction: NDArray, height: int) -> NDArray[np.int64]:
    """Compute the flat pixel index (N,) of directions (N, 3) in an image of 2 ``height`` x ``height`` pixels.

    The top row is +Z, the centre column +Y, and +X is to its right.
    """
    row = np.clip(np.arccos(np.clip(direction[:, 2], -1, 1)) / np.pi * height, 0, height - 1).astype(np.int64)
    turn = 0.5 + np.arctan2(direction[:, 0], direction[:, 1]) / (2 * np.pi)
    column = np.clip(turn * 2 * height, 0, 2 * height - 1).astype(np.int64)
    return row * 2 * height + column


def direction_vectors(height: int) -> NDArray[np.float64]:
    """Compute the unit directions (2 ``height``^2, 3) of the pixel centres of a sky image, row by row."""
    row, column = np.divmod(np.arange(2 * height * height), 2 * height)
    polar, turn = (row + 0.5) / height * np.pi, ((column + 0.5) / (2 * height) - 0.5) * 2 * np.pi
    return np.stack([np.sin(polar) * np.sin(turn), np.sin(polar) * np.cos(turn), np.cos(polar)], axis=1)

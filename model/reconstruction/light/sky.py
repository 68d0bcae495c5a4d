# SPDX-License-Identifier: MIT
"""Light from outside as a sky image, where it is far, and the test for that.

Far light depends on direction alone, near light on where it enters: half of the views predict the background
pixels of the other half by direction and by place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.foundation.color import luminance
from datagen.geometry.views import TracedView
from datagen.light.background import Background
from model.reconstruction.light.openings import LeavingRays, box_squares

HEIGHT, WIDTH = 64, 128
"""Pixels of the image of the sky."""
PLACES_ACROSS = 24
"""Squares along a side of the box, for judging."""
COARSE = 16
"""Rows of the directions for judging; twice as many columns."""
FAR_GAIN = 0.8
"""Part of the error by place that the error by direction must be below: of two that explain as much, near
light is the better, as its place is known."""
_MAX_PIXELS = 6000  # of a view


@dataclass(frozen=True)
class SkyPixels:
    """Background pixels (N,): ``origin``, ``direction`` and ``color`` (N, 3), ``view`` (N,)."""

    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    color: NDArray[np.float32]
    view: NDArray[np.int64]


def sky_pixels(views: Sequence[TracedView]) -> SkyPixels:
    """A subset of the background pixels of each view."""
    parts: list[tuple[NDArray, ...]] = [(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))]
    for number, view in enumerate(views):
        pixel = np.flatnonzero(((view.geometry.face < 0) & view.valid_mask).ravel())
        pixel = pixel[:: max(1, len(pixel) // _MAX_PIXELS)]
        rays = view.camera.ray_directions().reshape(-1, 3)[pixel]
        origin = np.broadcast_to(view.camera.position_m, rays.shape)
        parts.append((origin, rays, view.color.reshape(-1, 3)[pixel], np.full(len(pixel), number)))
    origin, direction, color, index = (np.concatenate(part) for part in zip(*parts, strict=True))
    return SkyPixels(origin, direction, color.astype(np.float32), index.astype(np.int64))


def is_far(pixels: SkyPixels, background: Background) -> bool:
    """Whether direction predicts the pixels of other views better than place."""
    if not len(pixels.view):
        return False
    face, square = box_squares(
        pixels.origin, pixels.direction, background.low, background.high, PLACES_ACROSS
    )
    by_place = (face * PLACES_ACROSS + square[:, 0]) * PLACES_ACROSS + square[:, 1]
    by_direction = directions_of(pixels.direction, COARSE)
    learns = pixels.view % 2 == 0
    encoded = np.log(np.maximum(luminance(pixels.color.astype(np.float64)), 0) + _floor(pixels.color))
    apart = []
    both = np.ones(int((~learns).sum()), dtype=bool)
    for bins in (by_direction, by_place):
        mean, known = _means(bins[learns], encoded[learns], int(bins.max()) + 1)
        both &= known[bins[~learns]]
        apart.append(np.abs(mean[bins[~learns]] - encoded[~learns]))
    if not both.any():
        return False
    of_direction, of_place = (float(error[both].mean()) for error in apart)
    return of_direction < FAR_GAIN * of_place


def sky_image(pixels: SkyPixels, rays: LeavingRays) -> NDArray[np.float32]:
    """Radiance (H, W, 3) by direction: the mean of the pixels in it, else of the rays that leave the room in
    it, else of the nearest known direction."""
    image = np.zeros((HEIGHT * WIDTH, 3))
    known = np.zeros(len(image), dtype=bool)
    for direction, color in (
        (pixels.direction, pixels.color),
        (rays.direction[rays.is_known], rays.radiance[rays.is_known]),
    ):
        bins = directions_of(direction, HEIGHT)
        for channel in range(3):
            mean, seen = _means(bins, color[:, channel].astype(np.float64), len(image))
            image[seen & ~known, channel] = mean[seen & ~known]
        known |= seen
    if known.any() and not known.all():
        every = direction_vectors(HEIGHT)
        _, nearest = cKDTree(every[known]).query(every[~known])
        image[~known] = image[known][nearest]
    return image.reshape(HEIGHT, WIDTH, 3).astype(np.float32)


def directions_of(direction: NDArray, height: int) -> NDArray[np.int64]:
    """Pixel (N,) of an image of ``height`` rows and twice as many columns: the top row looks along +Z, the
    centre column along +Y, +X is to its right."""
    way = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    row = np.clip(np.arccos(np.clip(way[:, 2], -1, 1)) / np.pi * height, 0, height - 1).astype(np.int64)
    turn = 0.5 + np.arctan2(way[:, 0], way[:, 1]) / (2 * np.pi)
    column = np.clip(turn * 2 * height, 0, 2 * height - 1).astype(np.int64)
    return row * 2 * height + column


def direction_vectors(height: int) -> NDArray[np.float64]:
    """Unit directions (2 H^2, 3) of the pixels' centres of such an image."""
    row, column = np.divmod(np.arange(2 * height * height), 2 * height)
    polar, turn = (row + 0.5) / height * np.pi, ((column + 0.5) / (2 * height) - 0.5) * 2 * np.pi
    return np.stack([np.sin(polar) * np.sin(turn), np.sin(polar) * np.cos(turn), np.cos(polar)], axis=1)


def _means(bins: NDArray, values: NDArray, num: int) -> tuple[NDArray, NDArray[np.bool_]]:
    count = np.bincount(bins, minlength=num)
    return np.bincount(bins, values, num) / np.maximum(count, 1), count > 0


def _floor(color: NDArray) -> float:
    return 0.01 * float(luminance(color.astype(np.float64)).mean()) + 1e-12

# SPDX-License-Identifier: MIT
"""Background radiance of rays that leave the mesh, estimated from the pixels that show no surface.

Near light, such as light through a window pane, is binned by direction and by the position at which a ray
leaves the room's bounding box (:data:`NEAR`). Far light, such as the sky, depends only on direction and has
finer bins (:data:`FAR`). To tell them apart, background pixels of half of the views are predicted from the
rest, once by direction and once by position; light counts as near unless direction predicts clearly better.

A bin's radiance is the median of its pixels (in :data:`FAR`, the mean). An empty bin gets the radiance of the
nearest filled one; up to the distance ``photographed_reach`` it counts as photographed, up to :data:`REACH`
as estimated, else as unknown. Distances are in radians; the box's diagonal counts as :data:`PLACE_WEIGHT`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.foundation.color import luminance
from datagen.geometry.views import TracedView
from mitsuba_plugins.arrays import point_argument
from mitsuba_plugins.cells import cell_of

REACH = 2.0
"""Distance up to which an empty bin gets the radiance of the nearest filled one. Light from other bins, which
are unknown, is later assumed to equal the mean of known light."""
MIN_PIXELS = 3
"""Minimum number of pixels in a filled bin."""
PLACE_WEIGHT = 2.25
FAR_GAIN = 0.8
"""Light counts as far if predictions by direction have less than this share of the error by position."""
JUDGED_PLACES = 24
"""Number of squares along each edge of a box face in :func:`is_far`."""
_MIN_GAIN = 1e-3  # additional margin in ln radiance; without it, rounding errors could decide
_MAX_PIXELS = 6000  # per view


@dataclass(frozen=True)
class Layout:
    """Layout of the background's bins.

    Numbers of bins: ``faces`` of the box (1: bins by direction only), ``places`` along each edge of a face,
    ``azimuths``, and ``heights``, equal steps of the direction's z, so that solid angles are equal.
    ``photographed_reach``: maximum distance in radians from an empty bin that counts as photographed to the
    nearest filled one. ``gain_blocks``: numbers of blocks along places, heights and azimuths; estimated light
    has one gain per block (``estimated_light``).
    """

    faces: int
    places: int
    azimuths: int
    heights: int
    photographed_reach: float
    gain_blocks: tuple[int, int, int]

    @property
    def is_far(self) -> bool:
        """True if bins depend only on direction."""
        return self.faces == 1

    @property
    def num_directions(self) -> int:
        """Number of bins at one position."""
        return self.azimuths * self.heights

    @property
    def num_bins(self) -> int:
        """Total number of bins."""
        return self.faces * self.places**2 * self.num_directions

    @property
    def num_gains(self) -> int:
        """Total number of blocks that share a gain."""
        places, heights, azimuths = self.gain_blocks
        return self.faces * places**2 * heights * azimuths

    def bin_directions(self) -> NDArray[np.float64]:
        """Unit directions (D, 3) of the centres of the bins at one position."""
        row, column = np.divmod(np.arange(self.num_directions), self.azimuths)
        z = (row + 0.5) / self.heights * 2 - 1
        azimuth = (column + 0.5 - 0.5 * self.azimuths) * (2 * np.pi / self.azimuths)
        radius = np.sqrt(1 - z**2)
        return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)

    def bins_of(self, origin: NDArray, direction: NDArray, low: NDArray, high: NDArray) -> NDArray[np.int64]:
        """Bin indices (N,) of rays (N, 3) that start inside the box with corners ``low``, ``high`` (3,)."""
        azimuth = np.arctan2(direction[:, 1], direction[:, 0]) * (self.azimuths / (2 * np.pi))
        column = np.clip(azimuth + 0.5 * self.azimuths, 0, self.azimuths - 1).astype(np.int64)
        row = np.clip((direction[:, 2] * 0.5 + 0.5) * self.heights, 0, self.heights - 1).astype(np.int64)
        index = row * self.azimuths + column
        if self.is_far:
            return index
        face, place = box_squares(origin, direction, low, high, self.places)
        square = (face * self.places + place[:, 0]) * self.places + place[:, 1]
        return square * self.num_directions + index


NEAR = Layout(6, 12, 24, 12, photographed_reach=0.45, gain_blocks=(3, 2, 4))
FAR = Layout(1, 1, 128, 64, photographed_reach=0.15, gain_blocks=(1, 4, 8))


@dataclass(frozen=True)
class Background:
    """Radiance of rays that leave the box with corners ``low`` and ``high`` (3,), in metres.

    Per bin of the ``layout``: ``radiance`` (B, 3), ``is_known`` (B,) and ``is_photographed`` (B,); radiance
    is estimated if it is known but not photographed.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    radiance: NDArray[np.float32]
    is_known: NDArray[np.bool_]
    is_photographed: NDArray[np.bool_]
    layout: Layout = NEAR

    def bin_of(self, origin: Any, direction: Any) -> Any:
        """Bin index of Dr.Jit rays that start inside the box."""
        import drjit as dr
        import mitsuba as mi

        azimuths, heights = self.layout.azimuths, self.layout.heights
        azimuth = dr.atan2(direction.y, direction.x) * (azimuths / (2 * np.pi)) + 0.5 * azimuths
        index = cell_of((direction.z * 0.5 + 0.5) * heights, heights) * azimuths + cell_of(azimuth, azimuths)
        if self.layout.is_far:
            return index
        places = self.layout.places
        # opaque, since literals would cause a separate kernel for each room
        low, high = point_argument(self.low), point_argument(self.high)
        places_per_m = point_argument(places / (self.high - self.low))
        distance, axis = mi.Float(dr.inf), mi.UInt32(0)
        for k in range(3):
            d = dr.select(dr.abs(direction[k]) < 1e-9, 1e-9, direction[k])
            t = dr.maximum((dr.select(d > 0, high[k], low[k]) - origin[k]) / d, 0.0)
            axis = dr.select(t < distance, k, axis)
            distance = dr.minimum(t, distance)
        place = [
            cell_of((origin[k] + distance * direction[k] - low[k]) * places_per_m[k], places)
            for k in range(3)
        ]
        u = dr.select(axis == 0, place[1], place[0])
        v = dr.select(axis == 2, place[1], place[2])
        leaving = dr.select(axis == 0, direction.x, dr.select(axis == 1, direction.y, direction.z))
        face = 2 * axis + dr.select(leaving > 0, mi.UInt32(1), 0)
        return ((face * places + u) * places + v) * self.layout.num_directions + index


def box_squares(
    origin: NDArray, direction: NDArray, low: NDArray, high: NDArray, across: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the face (N,) through which rays (N, 3) leave the box, and the square (N, 2) hit on that face.

    The face index is twice the axis, plus 1 for the upper face; the square is (row, column) in a grid of
    ``across`` x ``across`` squares.
    """
    safe = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    leaves = np.maximum((np.where(safe > 0, high, low) - origin) / safe, 0.0)
    axis = leaves.argmin(axis=1)
    rows = np.arange(len(axis))
    place = (origin + leaves[rows, axis][:, None] * direction - low) * (across / (high - low))
    first, second = np.where(axis == 0, 1, 0), np.where(axis == 2, 1, 2)
    square = np.stack([place[rows, first], place[rows, second]], axis=1)
    return 2 * axis + (direction[rows, axis] > 0), np.clip(square, 0, across - 1).astype(np.int64)


@dataclass(frozen=True)
class OutsidePixels:
    """N background pixels: ray ``origin`` and ``direction``, ``color``, (N, 3) each, and ``view`` (N,)."""

    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    color: NDArray[np.float32]
    view: NDArray[np.int64]


def outside_pixels(views: Sequence[TracedView]) -> OutsidePixels:
    """Evenly spaced background pixels, fewer than twice ``_MAX_PIXELS`` per view."""
    parts: list[tuple[NDArray, ...]] = [(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))]
    for number, view in enumerate(views):
        pixel = np.flatnonzero(((view.geometry.face < 0) & view.valid_mask).ravel())
        pixel = pixel[:: max(1, len(pixel) // _MAX_PIXELS)]
        rays = view.camera.ray_directions().reshape(-1, 3)[pixel]
        origin = np.broadcast_to(view.camera.position_m, rays.shape)
        parts.append((origin, rays, view.color.reshape(-1, 3)[pixel], np.full(len(pixel), number)))
    origin, direction, color, index = (np.concatenate(part) for part in zip(*parts, strict=True))
    return OutsidePixels(origin, direction, color.astype(np.float32), index.astype(np.int64))


def is_far(pixels: OutsidePixels, low: NDArray, high: NDArray) -> bool:
    """Return whether the background depends only on direction: whether bins by direction predict the pixels
    of other views clearly better than bins by position on the box with corners ``low`` and ``high`` (3,).
    """
    if not len(pixels.view):
        return False
    face, square = box_squares(pixels.origin, pixels.direction, low, high, JUDGED_PLACES)
    by_place = (face * JUDGED_PLACES + square[:, 0]) * JUDGED_PLACES + square[:, 1]
    by_direction = FAR.bins_of(pixels.origin, pixels.direction, low, high)
    predicts = pixels.view % 2 == 0
    bright = luminance(pixels.color.astype(np.float64))
    encoded = np.log(np.maximum(bright, 0) + 0.01 * float(bright.mean()) + 1e-12)
    errors = []
    both = np.ones(int((~predicts).sum()), dtype=bool)
    for bins in (by_direction, by_place):
        num = int(bins.max()) + 1
        count = np.bincount(bins[predicts], minlength=num)
        mean = np.bincount(bins[predicts], encoded[predicts], num) / np.maximum(count, 1)
        both &= count[bins[~predicts]] > 0
        errors.append(np.abs(mean[bins[~predicts]] - encoded[~predicts]))
    if not both.any():
        return False
    of_direction, of_place = (float(error[both].mean()) for error in errors)
    return of_direction < FAR_GAIN * of_place - _MIN_GAIN


def photographed_background(
    views: Sequence[TracedView],
    low: NDArray,
    high: NDArray,
    layout: Layout | None = None,
    reach: float = REACH,
) -> Background:
    """Estimate the background outside the box with corners ``low`` and ``high`` (3,) from ``views``.

    If ``layout`` is None, :func:`is_far` decides between :data:`NEAR` and :data:`FAR`. Bins are known up to
    the distance ``reach`` from a filled one.
    """
    pixels = outside_pixels(views)
    if layout is None:
        layout = FAR if is_far(pixels, low, high) else NEAR
    radiance = np.zeros((layout.num_bins, 3), np.float32)
    is_known, is_photographed = np.zeros(layout.num_bins, dtype=bool), np.zeros(layout.num_bins, dtype=bool)
    bins = layout.bins_of(pixels.origin, pixels.direction, low, high)
    keys, colors = (_means if layout.is_far else _medians)(bins, pixels.color)
    if not len(keys):
        return Background(low, high, radiance, is_known, is_photographed, layout)
    radiance[keys] = colors
    is_known[keys] = is_photographed[keys] = True
    rest = np.flatnonzero(~is_known)
    distance, nearest = cKDTree(_centres(keys, low, high, layout)).query(
        _centres(rest, low, high, layout), distance_upper_bound=reach, workers=-1
    )
    found = np.isfinite(distance)
    radiance[rest[found]] = colors[nearest[found]]
    is_known[rest[found]] = True
    is_photographed[rest[distance <= layout.photographed_reach]] = True
    return Background(low, high, radiance, is_known, is_photographed, layout)


def _centres(bins: NDArray, low: NDArray, high: NDArray, layout: Layout) -> NDArray[np.float64]:
    """Points (N, 6) whose distances are those of ``bins`` (N,): the position, scaled so that the box's
    diagonal is :data:`PLACE_WEIGHT`, and the unit direction.
    """
    places = layout.places
    face, u, v, direction = np.unravel_index(bins, (layout.faces, places, places, layout.num_directions))
    axis, is_high = face // 2, face % 2
    share = np.zeros((len(bins), 3))
    rows = np.arange(len(bins))
    first, second = np.where(axis == 0, 1, 0), np.where(axis == 2, 1, 2)
    share[rows, first], share[rows, second] = (u + 0.5) / places, (v + 0.5) / places
    share[rows, axis] = is_high
    size = float(np.linalg.norm(high - low))
    position = share * (high - low) * (PLACE_WEIGHT / size)
    return np.concatenate([position, layout.bin_directions()[direction]], axis=1)


def _medians(bins: NDArray, color: NDArray) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Bins (K,) with at least :data:`MIN_PIXELS` pixels, and their per-channel median colours (K, 3)."""
    order = np.argsort(bins, kind="stable")
    keys, first, num = np.unique(bins[order], return_index=True, return_counts=True)
    medians = np.empty((len(keys), 3), np.float32)
    for channel in range(3):
        values = color[order[np.lexsort((color[order, channel], bins[order]))], channel]
        medians[:, channel] = 0.5 * (values[first + (num - 1) // 2] + values[first + num // 2])
    enough = num >= MIN_PIXELS
    return keys[enough], medians[enough]


def _means(bins: NDArray, color: NDArray) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Like :func:`_medians`, but with means, which preserve the irradiance of skies with trees and clouds."""
    keys, of_pixel, num = np.unique(bins, return_inverse=True, return_counts=True)
    sums = [np.bincount(of_pixel, color[:, channel].astype(np.float64)) for channel in range(3)]
    enough = num >= MIN_PIXELS
    return keys[enough], (np.stack(sums, axis=1) / num[:, None]).astype(np.float32)[enough]

# SPDX-License-Identifier: MIT
"""Background radiance: rays that leave the mesh, from the pixels that show no surface.

Windows are near and the sky is far, so the background is binned by direction and by the place where a ray
leaves the room's box. A bin holds the median of its pixels. An empty bin takes the nearest filled one, with a
move by the box's diagonal counted as :data:`PLACE_WEIGHT` radians: within :data:`PHOTOGRAPHED_REACH` as
photographed, within :data:`REACH` as an estimate, else unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.geometry.views import TracedView

PLACES = 12
"""Bins along both sides of a face of the box."""
AZIMUTHS, HEIGHTS = 24, 12
"""Bins of azimuth, and of the direction's z in equal steps: equal solid angles."""
MIN_PIXELS = 3
"""Pixels that a bin needs to count as seen."""
PLACE_WEIGHT = 2.25
REACH, PHOTOGRAPHED_REACH = 1.0, 0.45
_MAX_SAMPLES = 6000  # pixels of a view
_NUM_DIRECTIONS = AZIMUTHS * HEIGHTS
_NUM_PLACES = 6 * PLACES * PLACES


@dataclass(frozen=True)
class Background:
    """``low`` and ``high`` (3,) corners of the box; by bin ``radiance`` (B, 3), ``is_known`` and
    ``is_photographed`` (B,)."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    radiance: NDArray[np.float32]
    is_known: NDArray[np.bool_]
    is_photographed: NDArray[np.bool_]

    def bin_of(self, origin: Any, direction: Any) -> Any:
        """Bin of Dr.Jit rays that start inside the box."""
        import drjit as dr
        import mitsuba as mi

        distance, axis = mi.Float(dr.inf), mi.UInt32(0)
        for k in range(3):
            d = dr.select(dr.abs(direction[k]) < 1e-9, 1e-9, direction[k])
            t = dr.maximum((dr.select(d > 0, float(self.high[k]), float(self.low[k])) - origin[k]) / d, 0.0)
            axis = dr.select(t < distance, k, axis)
            distance = dr.minimum(t, distance)
        place = [
            dr.clip(
                mi.UInt32(
                    dr.clip(
                        (origin[k] + distance * direction[k] - float(self.low[k])) * float(s),
                        0.0,
                        PLACES - 1.0,
                    )
                ),
                0,
                PLACES - 1,
            )
            for k, s in enumerate(PLACES / (self.high - self.low))
        ]
        u = dr.select(axis == 0, place[1], place[0])
        v = dr.select(axis == 2, place[1], place[2])
        leaving = dr.select(axis == 0, direction.x, dr.select(axis == 1, direction.y, direction.z))
        face = 2 * axis + dr.select(leaving > 0, mi.UInt32(1), 0)
        azimuth = dr.atan2(direction.y, direction.x) * (AZIMUTHS / (2 * np.pi)) + 0.5 * AZIMUTHS
        column = mi.UInt32(dr.clip(azimuth, 0.0, AZIMUTHS - 1.0))
        row = mi.UInt32(dr.clip((direction.z * 0.5 + 0.5) * HEIGHTS, 0.0, HEIGHTS - 1.0))
        return ((face * PLACES + u) * PLACES + v) * _NUM_DIRECTIONS + row * AZIMUTHS + column


def bins_of(origin: NDArray, direction: NDArray, low: NDArray, high: NDArray) -> NDArray[np.int64]:
    """Bins (N,) of rays (N, 3), in NumPy."""
    safe = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    leaves = np.maximum((np.where(safe > 0, high, low) - origin) / safe, 0.0)
    axis = leaves.argmin(axis=1)
    rows = np.arange(len(axis))
    place = origin + leaves[rows, axis][:, None] * direction
    place = np.clip((place - low) * (PLACES / (high - low)), 0, PLACES - 1).astype(np.int64)
    u = np.where(axis == 0, place[:, 1], place[:, 0])
    v = np.where(axis == 2, place[:, 1], place[:, 2])
    face = 2 * axis + (direction[rows, axis] > 0)
    azimuth = np.arctan2(direction[:, 1], direction[:, 0]) * (AZIMUTHS / (2 * np.pi)) + 0.5 * AZIMUTHS
    column = np.clip(azimuth, 0, AZIMUTHS - 1).astype(np.int64)
    row = np.clip((direction[:, 2] * 0.5 + 0.5) * HEIGHTS, 0, HEIGHTS - 1).astype(np.int64)
    return ((face * PLACES + u) * PLACES + v) * _NUM_DIRECTIONS + row * AZIMUTHS + column


def _centres(bins: NDArray, low: NDArray, high: NDArray) -> NDArray[np.float64]:
    """Bin centres as rays (N, 6): place in units of :data:`PLACE_WEIGHT` diagonals, and direction."""
    face, direction = np.divmod(bins, PLACES * PLACES * _NUM_DIRECTIONS)
    u, direction = np.divmod(direction, PLACES * _NUM_DIRECTIONS)
    v, direction = np.divmod(direction, _NUM_DIRECTIONS)
    row, column = np.divmod(direction, AZIMUTHS)
    axis, is_high = face // 2, face % 2
    share = np.zeros((len(bins), 3))
    rows = np.arange(len(bins))
    first, second = np.where(axis == 0, 1, 0), np.where(axis == 2, 1, 2)
    share[rows, first], share[rows, second] = (u + 0.5) / PLACES, (v + 0.5) / PLACES
    share[rows, axis] = is_high
    size = float(np.linalg.norm(high - low))
    z = (row + 0.5) / HEIGHTS * 2 - 1
    azimuth = (column + 0.5 - 0.5 * AZIMUTHS) * (2 * np.pi / AZIMUTHS)
    radius = np.sqrt(1 - z**2)
    way = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    return np.concatenate([share * (high - low) * (PLACE_WEIGHT / size), way], axis=1)


def photographed_background(views: Sequence[TracedView], low: NDArray, high: NDArray) -> Background:
    """Background of ``views`` beyond the box from ``low`` to ``high`` (3,)."""
    origins, directions, colors = [], [], []
    for view in views:
        pixel = np.flatnonzero(((view.geometry.face < 0) & view.valid_mask).ravel())
        pixel = pixel[:: max(1, len(pixel) // _MAX_SAMPLES)]
        directions.append(view.camera.ray_directions().reshape(-1, 3)[pixel])
        origins.append(np.broadcast_to(view.camera.position_m, (len(pixel), 3)))
        colors.append(view.color.reshape(-1, 3)[pixel])
    origin, direction, color = (np.concatenate(parts) for parts in (origins, directions, colors))
    num_bins = _NUM_PLACES * _NUM_DIRECTIONS
    radiance = np.zeros((num_bins, 3), np.float32)
    is_known, is_photographed = np.zeros(num_bins, dtype=bool), np.zeros(num_bins, dtype=bool)
    if not len(origin):
        return Background(low, high, radiance, is_known, is_photographed)
    keys, medians = _medians(bins_of(origin, direction, low, high), color)
    if not len(keys):
        return Background(low, high, radiance, is_known, is_photographed)
    seen = np.zeros(num_bins, dtype=bool)
    radiance[keys], seen[keys] = medians, True
    rest = np.flatnonzero(~seen)
    distance, nearest = cKDTree(_centres(keys, low, high)).query(
        _centres(rest, low, high), distance_upper_bound=REACH, workers=-1
    )
    found = np.isfinite(distance)
    radiance[rest[found]] = medians[nearest[found]]
    is_known[keys] = is_photographed[keys] = True
    is_known[rest[found]] = True
    is_photographed[rest[distance <= PHOTOGRAPHED_REACH]] = True
    return Background(low, high, radiance, is_known, is_photographed)


def _medians(bins: NDArray, color: NDArray) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Bins of at least :data:`MIN_PIXELS` colours, and the medians (K, 3) of their colours."""
    order = np.argsort(bins, kind="stable")
    keys, first, num = np.unique(bins[order], return_index=True, return_counts=True)
    medians = np.empty((len(keys), 3), np.float32)
    for channel in range(3):
        values = color[order[np.lexsort((color[order, channel], bins[order]))], channel]
        medians[:, channel] = 0.5 * (values[first + (num - 1) // 2] + values[first + num // 2])
    enough = num >= MIN_PIXELS
    return keys[enough], medians[enough]

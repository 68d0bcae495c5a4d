# SPDX-License-Identifier: MIT
"""Finds the box around a room on whose faces the sky guide (:mod:`.sky_guide`) represents openings.

A window corresponds to a compact group of cells only if the face lies in the window's plane. Camera paths
through windows also hit points outside, so the box around all visited points may extend far beyond the room.
Faces are therefore moved inwards while this raises the mean logarithm of the guide's density over the rays
observed to escape, which minimises the divergence of the guide from their distribution (as in Vorba et al.,
On-line Learning of Parametric Mixture Models for Light Transport Simulation, 2014).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.transport.sky_observation import SkyObservations
from mitsuba_plugins.arrays import point_argument, vectors_from_rows
from mitsuba_plugins.cells import cell_of

Array = Any

CELLS = 32
"""Number of cells along each side of a face; cells measure 0.16 m in a room of 5 m."""
PERCENTILE = 2.0
"""Percentage of the visited points left out beyond each face of the largest box."""
MARGIN = 0.025
"""Margin beyond each face, which keeps walls inside, as a fraction of the longest side of a core box. That
box excludes MARGIN_PERCENTILE % of the points beyond each face and so hardly depends on surfaces outdoors."""
MARGIN_PERCENTILE = 10.0
INNER_PERCENTILES = (4, 6, 8, 10, 12.5, 15, 17.5, 20, 25, 30, 35, 40)
"""Positions to which a face may be moved, as percentages of the visited points left out beyond it."""
MIN_GAIN = 0.1
"""Minimum increase of the mean logarithm of the density for moving a face."""
NUM_RAYS = 4096
"""Maximum number of escaping rays whose density is compared."""
NUM_POINTS = 32768
"""Maximum number of points for percentiles."""
REGIONS = 24
"""Number of regions along the longest side of the box in which the share of escaping rays is estimated."""
OUTER_DENSITY = 0.01
"""Density [1/sr] assumed for rays outside the box, an eighth of a uniform one; it penalises boxes that
exclude a part of the room to fit the rest better."""
UNIFORM_SHARE = 0.1
"""Weight of a uniform distribution over all cells in the density, which keeps unobserved cells above 0."""


def room_box(observations: SkyObservations) -> NDArray[np.float64] | None:
    """Lower and upper corner (2, 3) of the room's box; None if nearly all visited points are equal."""
    points = observations.points_m[:: max(1, len(observations.points_m) // NUM_POINTS)]
    outer = np.array([PERCENTILE, *INNER_PERCENTILES])
    planes = np.stack([np.percentile(points, share, axis=0) for share in (outer, 100.0 - outer)])
    core = np.percentile(points, [MARGIN_PERCENTILE, 100.0 - MARGIN_PERCENTILE], axis=0)
    margin = MARGIN * np.ptp(core, axis=0).max()
    if not margin > 0.0:
        return None
    planes += np.array([-margin, margin])[:, None, None]
    box_m = planes[:, 0]
    step = max(1, len(observations.origins_m) // NUM_RAYS)
    rays = observations.origins_m[::step], observations.directions[::step]
    weights = _weights(observations, box_m)[::step]
    best = _log_density(box_m, *rays, weights)
    while np.isfinite(best):
        moved = []
        for end, axis in np.ndindex(2, 3):
            for plane in planes[end, 1:, axis]:
                box = box_m.copy()
                box[end, axis] = plane
                is_inwards = plane > box_m[0, axis] if end == 0 else plane < box_m[1, axis]
                if is_inwards and (box[1] > box[0]).all():
                    moved.append((_log_density(box, *rays, weights), box))
        density, box = max(moved, key=lambda pair: pair[0], default=(best, box_m))
        if density < best + MIN_GAIN:
            break
        best, box_m = density, box
    return box_m


def _weights(observations: SkyObservations, box_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (E,) of escaping rays: radiance x (1 - e) / e, with the share e of nearby rays that escape.

    (1 - e) / e is the relative variance of finding the sky by chance. Points outside, from which most rays
    escape, need no guide.
    """
    side = (box_m[1] - box_m[0]).max() / REGIONS

    def region(points: NDArray[np.float64]) -> NDArray[np.int64]:
        place = np.clip(((points - box_m[0]) / side).astype(np.int64) + 1, 0, REGIONS + 1)
        return np.ravel_multi_index(tuple(place.T), (REGIONS + 2,) * 3)

    size = (REGIONS + 2) ** 3
    origins = region(observations.origins_m)
    num_points = np.bincount(region(observations.points_m), minlength=size)
    num_escapes = np.bincount(origins, minlength=size)
    share = (num_escapes / np.maximum(num_points, num_escapes + 1e-9))[origins]
    return observations.clamped_radiance() * (1.0 - share) / share


def _log_density(
    box_m: NDArray[np.float64],
    origins_m: NDArray[np.float64],
    directions: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> float:
    """Weighted mean logarithm of the density [1/sr] of each ray in a guide fitted to all other rays."""
    is_inside = ((origins_m >= box_m[0]) & (origins_m <= box_m[1])).all(axis=1)
    inner = np.where(is_inside, weights, 0.0)
    if not inner.any():
        return -np.inf
    cell, distance, cosine = exits(box_m, origins_m, directions)
    num_cells = 6 * CELLS**2
    found = np.bincount(cell, inner, num_cells)[cell] - inner  # without the ray itself
    share = (1.0 - UNIFORM_SHARE) * np.maximum(found, 0.0) / inner.sum() + UNIFORM_SHARE / num_cells
    density = share / cell_areas(box_m)[cell] * distance**2 / np.maximum(cosine, 1e-9)
    # the bound prevents log 0 for rays that start on a face
    density = np.where(is_inside, np.maximum(density, 1e-30), OUTER_DENSITY)
    return float(weights @ np.log(density) / weights.sum())


def cell_areas(box_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Areas [m^2] (6 CELLS^2,) of the cells of a box (2, 3)."""
    side = box_m[1] - box_m[0]
    return np.repeat(side.prod() / side / CELLS**2, 2 * CELLS**2)


def exits(
    box_m: NDArray[np.float64], origins_m: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[Any], ...]:
    """Cell, distance [m] and cosine, each (N,), at which rays leave a box (2, 3)."""
    low, high = map(point_argument, box_m)
    rays = mi.Point3f(vectors_from_rows(origins_m)), vectors_from_rows(directions)
    cell, distance, along = (np.array(part) for part in exit_cell(low, high, *rays))
    return cell.astype(np.int64), distance.astype(np.float64), np.abs(along.astype(np.float64))


def exit_cell(low: Array, high: Array, point: Array, direction: Array) -> tuple[Any, Any, Any]:
    """Return cell and distance at which rays exit a box, and the direction's component normal to the face.

    The cell index is always valid, even for NaN input of lanes without a vertex.
    """
    far = [
        dr.select(d == 0.0, dr.inf, (dr.select(d > 0.0, upper, lower) - p) / d)
        for p, d, lower, upper in zip(point, direction, low, high, strict=True)
    ]
    t = dr.minimum(far[0], dr.minimum(far[1], far[2]))
    is_x, is_y = far[0] == t, far[1] == t
    along = dr.select(is_x, direction.x, dr.select(is_y, direction.y, direction.z))
    axis = dr.select(is_x, mi.UInt32(0), dr.select(is_y, mi.UInt32(1), mi.UInt32(2)))
    share = (point + t * direction - low) / (high - low)
    column, row = dr.select(is_x, share.y, share.x), dr.select(is_x | is_y, share.z, share.y)
    cell = 2 * axis + dr.select(along > 0.0, mi.UInt32(1), mi.UInt32(0))
    for position in (column, row):
        cell = cell * CELLS + cell_of(position * CELLS, CELLS)
    return cell, t, along

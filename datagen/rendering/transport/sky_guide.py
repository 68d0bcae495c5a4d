# SPDX-License-Identifier: MIT
"""The sky guide samples environment light through the openings of a room.

At most points of a room, an environment is visible through a window in only a few per cent of the directions.
Emitter sampling chooses directions by their radiance, and nearly all of its shadow rays hit walls. Manually
placed portals are the classic remedy (Bitterli, Novak and Jarosz, Portal-Masked Environment Map Sampling,
2015). Here, the openings are estimated from the points at which camera paths leave the box around the room,
weighted by the radiance outside (:mod:`.sky_observation`).

From a point x inside a box, every direction leaves through exactly one point of the faces. Faces are divided
into cells; cell c is chosen with the estimated probability P_c, and a point q in it uniformly. The density

    p(w) = P_c / A_c * |q - x|^2 / |cos|

of direction w, with the cell's area A_c and the cosine at the face, is then known for openings of any shape.
The guide is thus a further technique of multiple importance sampling; a poor estimate adds no bias.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.transport.sky_observation import SkyObservations
from mitsuba_plugins.cells import cell_of

Array = Any

CELLS = 32
"""Number of cells along each side of a face; cells measure 0.16 m in a room of 5 m."""
TABLE = 1 << 16
"""Number of entries of the table from which a cell is drawn; probabilities are multiples of its inverse."""
BOX_PERCENTILE = 2.0
"""Percentage of the visited points left out beyond each face of the box, such as surfaces outside."""
BOX_MARGIN = 0.02
"""Margin of the box on each side, as a fraction of its longest side, which keeps walls inside the box."""
NEIGHBOUR_SHARE = 0.05
"""Fraction of a cell's weight added to each of its eight neighbours, since rays miss parts of openings."""
MIN_ESCAPES = 256
"""Minimum number of rays that leave the room for fitting a guide."""
MAX_SHARE = 0.5
"""Maximum share of the shadow rays sampled by the guide instead of emitter sampling."""
MIN_SHARE = 0.1
"""Minimum share of the sky in the direct light for fitting a guide."""


class SkyGuide:
    """A distribution of directions towards openings, for points inside a box.

    ``share`` is the fraction of shadow rays sampled from it while :mod:`.light_sampler` has no estimates.
    """

    def __init__(
        self,
        scene: Any,
        box_m: NDArray[np.float64],
        probabilities: NDArray[np.float64],
        share: float,
        brightest: float,
    ):
        """``box_m`` (2, 3) are the lower and upper corner, ``probabilities`` (6 CELLS^2,) those of cells by
        face, column and row; ``brightest`` is the maximum luminance of the sky without its sun.
        """
        from datagen.rendering.plugins import outside_distance  # needs a selected variant

        self.environment = scene.environment()
        self.box_m, self.share = box_m, share
        side = box_m[1] - box_m[0]
        areas = np.array([side[(axis + 1) % 3] * side[(axis + 2) % 3] for axis in (0, 0, 1, 1, 2, 2)])
        cumulative = np.cumsum(probabilities) / probabilities.sum()
        table = np.searchsorted(cumulative, (np.arange(TABLE) + 0.5) / TABLE)
        drawn = np.bincount(table, minlength=probabilities.size) / TABLE  # the table's exact probabilities
        self.low, self.high = _corners(box_m)
        self.brightest = mi.Float(brightest)
        self.distance = mi.Float(outside_distance(scene))  # from which the environment's light arrives
        self.table = mi.UInt32(table.astype(np.uint32))
        self.density = mi.Float((drawn / np.repeat(areas / CELLS**2, CELLS**2)).astype(np.float32))
        dr.make_opaque(self.low, self.high, self.brightest, self.distance)

    def arrays(self) -> list[Any]:
        """Arrays that a recorded kernel reads."""
        return [self.low, self.high, self.brightest, self.distance, self.table, self.density]

    def contains(self, point: Array) -> Array:
        """Mask of points inside the box."""
        return dr.all((point >= self.low) & (point <= self.high))

    def pdf(self, point: Array, direction: Array) -> Array:
        """Density [1/sr] of :meth:`sample` at ``direction``; ``point`` must be inside the box."""
        cell, t, along = exit_cell(self.low, self.high, point, direction)
        return dr.gather(mi.Float, self.density, cell) * dr.square(t) / dr.maximum(dr.abs(along), 1e-9)

    def sample(self, point: Array, choice: Array, sample: Array) -> Array:
        """Sample a direction from ``point`` in the box by ``choice`` in [0, 1) and ``sample`` in [0, 1)^2."""
        cell = dr.gather(mi.UInt32, self.table, cell_of(choice * TABLE, TABLE))
        face, rest = cell // (CELLS * CELLS), cell % (CELLS * CELLS)
        column = (mi.Float(rest // CELLS) + sample.x) / CELLS
        row = (mi.Float(rest % CELLS) + sample.y) / CELLS
        axis, end = face // 2, mi.Float(face % 2)
        share: Any = mi.Vector3f(
            dr.select(axis == 0, end, column),
            dr.select(axis == 1, end, dr.select(axis == 0, column, row)),
            dr.select(axis == 2, end, row),
        )
        side: Any = self.high - self.low
        return dr.normalize(self.low + share * side - point)


def _corners(box_m: NDArray[np.float64]) -> tuple[Any, Any]:
    low, high = (mi.Point3f(*(float(c) for c in corner)) for corner in box_m)
    return low, high


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


def fit_sky_guide(scene: Any, observations: SkyObservations) -> SkyGuide | None:
    """Fit a guide; None if too few rays leave the scene or the sky's share of the light is too small."""
    from scipy import ndimage

    share = observations.sky_share()
    if len(observations.origins_m) < MIN_ESCAPES or share < MIN_SHARE:
        return None
    low, high = np.percentile(observations.points_m, [BOX_PERCENTILE, 100.0 - BOX_PERCENTILE], axis=0)
    margin = BOX_MARGIN * (high - low).max()
    if not margin > 0.0:
        return None
    box_m = np.stack([low - margin, high + margin])
    weights = observations.clamped_radiance()
    is_inside = ((observations.origins_m >= box_m[0]) & (observations.origins_m <= box_m[1])).all(axis=1)
    if not weights[is_inside].any():
        return None
    low_corner, high_corner = _corners(box_m)
    origins: Any = mi.Point3f(observations.origins_m[is_inside].T.astype(np.float32))
    directions: Any = mi.Vector3f(observations.directions[is_inside].T.astype(np.float32))
    cells = np.array(exit_cell(low_corner, high_corner, origins, directions)[0])
    found = np.bincount(cells, weights[is_inside], 6 * CELLS**2).reshape(6, CELLS, CELLS)
    around = np.full((1, 3, 3), NEIGHBOUR_SHARE)
    around[0, 1, 1] = 1.0
    probabilities = ndimage.convolve(found, around, mode="constant").ravel()
    return SkyGuide(scene, box_m, probabilities, min(MAX_SHARE, share), float(weights.max()))

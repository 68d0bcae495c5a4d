# SPDX-License-Identifier: MIT
"""The sky guide samples environment light through the openings of a room.

At most points of a room, an environment is visible through a window in only a few per cent of the directions.
Emitter sampling chooses directions by their radiance, and nearly all of its shadow rays hit walls. Manually
placed portals are the classic remedy (Bitterli, Novak and Jarosz, Portal-Masked Environment Map Sampling,
2015). Here, the openings are estimated from the points at which camera paths leave the box around the room,
weighted by the radiance outside (:mod:`.sky_observation`).

From a point x inside a box (:mod:`.room_box`), every direction leaves through exactly one point of the faces.
Faces are divided into cells; cell c is chosen with the estimated probability P_c, and a point q in it
uniformly. The density

    p(w) = P_c / A_c * |q - x|^2 / |cos|

of direction w, with the cell's area A_c and the cosine at the face, is then known for openings of any shape.
The guide is thus a further technique of multiple importance sampling; a poor estimate adds no bias.

From most points, only some of a room's windows are visible. Cells are therefore divided into groups, the
*openings*, each with its own density, among which the light sampler chooses.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.transport.room_box import CELLS, cell_areas, exit_cell, exits, room_box
from datagen.rendering.transport.sky_observation import SkyObservations
from mitsuba_plugins.arrays import point_argument, rows_from_vectors
from mitsuba_plugins.cells import cell_of

Array = Any

OPENINGS = 8
"""Maximum number of openings, which are groups of cells."""
SMALLEST_MOMENT = 1e-9
"""Smallest moment of :func:`_openings`, in squares of the longest side, that is not rounding error."""
TABLE = 1 << 13
"""Number of table entries from which an opening's cell is drawn; probabilities are multiples of 1 / TABLE."""
NEIGHBOUR_SHARE = 0.05
"""Fraction of a cell's weight added to each of its eight neighbours, since rays miss parts of openings."""
MIN_ESCAPES = 256
"""Minimum number of escaping rays to which a guide is fitted."""
MAX_SHARE = 0.5
"""Maximum share of the shadow rays sampled by the guide instead of emitter sampling."""
MIN_SHARE = 0.1
"""Minimum share of the sky in the direct light for fitting a guide."""


class SkyGuide:
    """Distributions of directions towards each of the openings, for points inside a box.

    ``shares`` (openings,) are the fractions of shadow rays towards each opening until :mod:`.light_sampler`
    has estimates.
    """

    def __init__(
        self,
        scene: Any,
        box_m: NDArray[np.float64],
        probabilities: NDArray[np.float64],
        share: float,
        brightest: float,
    ):
        """``box_m`` (2, 3) are the lower and upper corner of the box, ``probabilities`` (6 CELLS^2,) those of
        its cells by face, column and row; ``share`` is the fraction of shadow rays towards all openings
        together, ``brightest`` the maximum luminance of the sky without its sun.
        """
        from datagen.rendering.plugins import outside_distance  # needs a selected variant

        self.environment = scene.environment()
        self.box_m = box_m
        probabilities = probabilities / probabilities.sum()
        openings = _openings(probabilities, box_m[1] - box_m[0])
        self.shares = share * np.bincount(openings, probabilities)
        table = np.concatenate([_table(probabilities * (openings == k)) for k in range(len(self.shares))])
        drawn = np.bincount(table, minlength=probabilities.size) / TABLE  # the tables' exact probabilities
        self.low, self.high = map(point_argument, box_m)
        self.brightest = dr.opaque(mi.Float, brightest)
        # distance from which the environment's light arrives
        self.distance = dr.opaque(mi.Float, outside_distance(scene))
        self.table = mi.UInt32(table.astype(np.uint32))
        self.opening_of_cell = mi.UInt32(openings.astype(np.uint32))
        self.density = mi.Float((drawn / cell_areas(box_m)).astype(np.float32))

    def arrays(self) -> list[Any]:
        """Arrays that a recorded kernel reads."""
        return [
            self.low,
            self.high,
            self.brightest,
            self.distance,
            self.table,
            self.opening_of_cell,
            self.density,
        ]

    def contains(self, point: Array) -> Array:
        """Mask of points inside the box."""
        return dr.all((point >= self.low) & (point <= self.high))

    def pdf(self, point: Array, direction: Array) -> tuple[Any, Any]:
        """Return the opening of a ``direction``, and the density [1/sr] with which :meth:`sample` draws it.

        ``point`` must be inside the box.
        """
        cell, t, along = exit_cell(self.low, self.high, point, direction)
        density = dr.gather(mi.Float, self.density, cell) * dr.square(t) / dr.maximum(dr.abs(along), 1e-9)
        return dr.gather(mi.UInt32, self.opening_of_cell, cell), density

    def sample(self, point: Array, opening: Array, choice: Array, sample: Array) -> Array:
        """Sample a direction from ``point`` in the box to ``opening``.

        ``choice`` in [0, 1) selects the cell, ``sample`` in [0, 1)^2 the position in it.
        """
        cell = dr.gather(mi.UInt32, self.table, opening * TABLE + cell_of(choice * TABLE, TABLE))
        side: Any = self.high - self.low
        return dr.normalize(self.low + _position(cell, sample) * side - point)


def _position(cell: Array, sample: Array) -> Any:
    """Position, in [0, 1]^3 of the box, of the point ``sample`` in [0, 1)^2 of a cell."""
    face, rest = cell // (CELLS * CELLS), cell % (CELLS * CELLS)
    column = (mi.Float(rest // CELLS) + sample.x) / CELLS
    row = (mi.Float(rest % CELLS) + sample.y) / CELLS
    axis, end = face // 2, mi.Float(face % 2)
    x = dr.select(axis == 0, end, column)
    y = dr.select(axis == 1, end, dr.select(axis == 0, column, row))
    return mi.Vector3f(x, y, dr.select(axis == 2, end, row))


def _openings(probabilities: NDArray[np.float64], side_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """Group the cells of a box with sides ``side_m`` (3,) into openings; return their indices (6 CELLS^2,).

    ``probabilities`` (6 CELLS^2,) have the sum 1. The opening with the largest moment (probability x variance
    of position along an axis) is repeatedly split at its mean, until there are OPENINGS or all are one cell.
    """
    places = _position(dr.arange(mi.UInt32, probabilities.size), mi.Point2f(0.0))
    positions = rows_from_vectors(places) * side_m / side_m.max()
    weights = probabilities[:, None]
    openings = np.zeros(probabilities.size, np.int64)
    for number in range(1, OPENINGS):
        is_member = openings == np.arange(number)[:, None]
        means = (is_member @ (weights * positions)) / (is_member @ weights)
        moments = is_member @ (weights * (positions - means[openings]) ** 2)
        opening, along = np.unravel_index(np.argmax(moments), moments.shape)
        if moments[opening, along] < SMALLEST_MOMENT:
            break
        openings[is_member[opening] & (positions[:, along] > means[opening, along])] = number
    return openings


def _table(weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """TABLE indices in [0, N), each repeated in proportion to its ``weights`` (N,), up to rounding."""
    cumulative = np.cumsum(weights) / weights.sum()
    return np.searchsorted(cumulative, (np.arange(TABLE) + 0.5) / TABLE)


def fit_sky_guide(scene: Any, observations: SkyObservations) -> SkyGuide | None:
    """Fit a guide; None if too few rays leave the scene or the sky's share of the light is too small."""
    from scipy import ndimage

    share = observations.sky_share()
    if len(observations.origins_m) < MIN_ESCAPES or share < MIN_SHARE:
        return None
    box_m = room_box(observations)
    if box_m is None:
        return None
    weights = observations.clamped_radiance()
    is_inside = ((observations.origins_m >= box_m[0]) & (observations.origins_m <= box_m[1])).all(axis=1)
    if not weights[is_inside].any():
        return None
    cells, *_ = exits(box_m, observations.origins_m, observations.directions)
    found = np.bincount(cells[is_inside], weights[is_inside], 6 * CELLS**2).reshape(6, CELLS, CELLS)
    around = np.full((1, 3, 3), NEIGHBOUR_SHARE)
    around[0, 1, 1] = 1.0
    probabilities = ndimage.convolve(found, around, mode="constant").ravel()
    return SkyGuide(scene, box_m, probabilities, min(MAX_SHARE, share), float(weights.max()))

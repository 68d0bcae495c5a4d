# SPDX-License-Identifier: MIT
"""Confidence of D, S and R recovered from light, which weights them against the network's predictions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.light.cells import cell_keys
from datagen.light.estimated_light import MAX_REFLECTED
from datagen.light.surfels import CellGrid, Surfels, cell_of
from datagen.multiview.compiled import compiled

IMPOSSIBLE = (0.1, 0.3)
"""Range of the local share of surfels that reflect more than their incident light, a sign of unphotographed
sources, over which the confidence of D, S and R decreases to 0."""
IMPOSSIBLE_ROOM = (0.12, 0.2)
"""Range of the room's share of surfels that reflect more than their incident light, over which the effect of
local shares (:data:`IMPOSSIBLE`) increases from none to full."""
DARK_ROOM = (0.2, 0.4)
"""Range of the room's share of surfels that reflect more than their incident light, over which all confidence
decreases to 0, since most light sources are not photographed."""
IMPOSSIBLE_SURFACE = (0.4, 0.8)
"""Like :data:`IMPOSSIBLE`, for the confidence of D in any room."""
MIN_OBSERVATIONS = 50.0
"""Number of observations at which a share has the same weight as the share to which it is shrunk."""
BLOCK_CELLS = 25
"""Edge length in cells of the blocks over which shares are computed: a twelfth of the room's diagonal."""
DOUBT = (0.15, 0.6)
"""Range of the uncertain share of a surfel's diffuse shading, over which confidence decreases to 0."""
HIDDEN_LIGHT = (0.25, 0.4)
"""Range of the share of a smooth region's light that comes from unphotographed sources at unknown places,
over which the confidence of D, S and R decreases from 1 to 0."""
INFERRED_LIGHT = (0.4, 1.0)
"""Like :data:`HIDDEN_LIGHT`, for unphotographed lamps that the geometry declares."""
METAL_TRUST = 0.85
"""Lower bound on the factor by which unphotographed light reduces the confidence of metals: it is high, since
photographs record the light that metals reflect, and below 1, since dielectrics may be mistaken for metal."""
BUMPY, BUMPY_ROOM, BUMPY_TRUST = (0.05, 0.3), (0.01, 0.05), 0.5
"""Ranges of the spread of normals around a surfel and of its median over the room, in radians, over which the
factor of the confidence of R decreases from 1 to :data:`BUMPY_TRUST`. A mesh with errors is bumpy everywhere
and reflects in wrong directions; an exact mesh is curved only at some objects."""
_BUMPY_NEIGHBOURS, _SAME_SURFACE = 12, 0.7  # number of neighbours, and minimum cosine to their normals
_NEAR_BLOCKS = 8
D_EVIDENCE, S_EVIDENCE = (0.65, 1.0), (0.0, 0.2)
"""Ranges of the photographed share of a surfel's hemisphere over which the confidence of D, and that of S and
R, increases from 0 to 1."""
_STEPS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], np.int64)
_NEAREST_FIRST = np.ascontiguousarray(_STEPS[np.argsort((_STEPS**2).sum(axis=1), kind="stable")])


def surfel_confidence(photographed: NDArray, is_mirror: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Compute the confidence (N, 3) of D, S and R from the ``photographed`` share (N,) of each hemisphere.

    The relative error of D equals that of the irradiance, so D needs a larger share than S and R, whose
    priors already weigh more where evidence is weak: even below a share of 0.3, the squared error of R from
    light is 0.03 to 0.9 times the network's in the development rooms. Mirrors (``is_mirror`` (N,)) need no
    photographed hemisphere, since the reflected images alone determine their material.
    """
    photographed = np.where(is_mirror, 1.0, photographed)
    of_d = _ramp(photographed, D_EVIDENCE)
    of_s = _ramp(photographed, S_EVIDENCE)
    return np.stack([of_d, of_s, of_s], axis=1).astype(np.float32)


@dataclass(frozen=True)
class ImpossibleShares:
    """Shares of surfels that reflect more than their incident light.

    ``around`` (N,): share near each surfel within its smooth region; ``of_room``: share in the whole room.
    """

    around: NDArray[np.float64]
    of_room: float

    def trust(self) -> NDArray[np.float32]:
        """Compute the factor (N,), in [0, 1], of the confidence of D, S and R.

        It is 1 if ``of_room`` is below :data:`IMPOSSIBLE_ROOM`: some surfels are too bright in any room.
        """
        trust = 1 - _ramp(self.of_room, IMPOSSIBLE_ROOM) * _ramp(self.around, IMPOSSIBLE)
        return (trust * (1 - _ramp(self.of_room, DARK_ROOM))).astype(np.float32)

    def evidence(self) -> NDArray[np.float32]:
        """Compute the additional factor (N,), in [0, 1], of the confidence of D.

        It is lower where most of a surface reflects more than its incident light; there, the shading is
        corrected by other surfaces and the network's maps (``shading_correction``).
        """
        return (1 - _ramp(self.around, IMPOSSIBLE_SURFACE)).astype(np.float32)


def impossible_shares(
    surfels: Surfels, diffuse: NDArray, is_metal: NDArray[np.bool_], region: NDArray
) -> ImpossibleShares:
    """Compute the shares of surfels that reflect more than their incident light.

    Their radiance is above :data:`MAX_REFLECTED` times their shading ``diffuse`` (N, 3). Surfels are weighted
    by their number of views; metals and mixed surfels are ignored. Local shares are computed per smooth
    ``region`` (N,) in blocks of :data:`BLOCK_CELLS` cells, and interpolated between blocks. With few views,
    a block's share is shrunk to its region's, and a region's to the room's.
    """
    excess = (surfels.radiance - MAX_REFLECTED * diffuse) @ LUMINANCE_WEIGHTS > 0
    weight = (np.diff(surfels.observations.start) * ~(is_metal | surfels.is_mixed)).astype(np.float64)
    grid = surfels.grid
    side_m = BLOCK_CELLS * grid.cell_m
    blocks = CellGrid(grid.low, side_m, -(-grid.shape // BLOCK_CELLS), grid.surfel)
    keys = cell_keys(blocks, surfels.position_m, surfels.normal)
    of_region = np.unique(region, return_inverse=True)[1]
    block = np.unique(np.stack([keys, of_region]), axis=1, return_inverse=True)[1].ravel()
    of_room = float(weight @ excess) / max(float(weight.sum()), 1e-12)
    whole = _shrunk_share(np.bincount(of_region, weight * excess), np.bincount(of_region, weight), of_room)
    num = np.bincount(block)
    total, excessive = np.bincount(block, weight), np.bincount(block, weight * excess)
    apart_m = 100 * side_m * of_region  # keeps nearest neighbours within one region
    place = np.column_stack([surfels.position_m, surfels.normal * side_m, apart_m]).astype(np.float64)
    centre = np.stack([np.bincount(block, column) / num for column in place.T], axis=1)
    distance, index = cKDTree(centre).query(place, k=np.arange(min(_NEAR_BLOCKS, len(num))) + 1, workers=-1)
    near = np.exp(-0.5 * np.square(distance / (0.7 * side_m)))
    around = _shrunk_share(
        (near * excessive[index]).sum(axis=1), (near * total[index]).sum(axis=1), whole[of_region]
    )
    return ImpossibleShares(around, of_room)


def _shrunk_share(part: NDArray, total: NDArray, otherwise: float | NDArray) -> NDArray[np.float64]:
    """Compute ``part`` / ``total`` (K,), shrunk to ``otherwise`` with the weight :data:`MIN_OBSERVATIONS`."""
    return (part + MIN_OBSERVATIONS * otherwise) / (total + MIN_OBSERVATIONS)


def trust_in_hidden(hidden: NDArray, inferred: NDArray) -> NDArray[np.float32]:
    """Compute the factor (N,) of all confidences from the shares (N,) of light from unphotographed sources:
    ``hidden`` at unknown places, ``inferred`` from lamps that the geometry declares.
    """
    unknown = np.maximum(_ramp(hidden, HIDDEN_LIGHT), _ramp(inferred, INFERRED_LIGHT))
    return (1 - unknown).astype(np.float32)


def normal_spread(surfels: Surfels) -> NDArray[np.float64]:
    """Compute the root mean square angle (N,), in radians, between the normals of each surfel and of its
    neighbours on the same surface.
    """
    nearest = np.arange(min(_BUMPY_NEIGHBOURS + 1, len(surfels))) + 1
    _, index = cKDTree(surfels.position_m).query(surfels.position_m, k=nearest, workers=-1)
    normal = surfels.normal.astype(np.float64)
    cosine = np.einsum("nc,nkc->nk", normal, normal[index])
    is_near = cosine > _SAME_SURFACE
    angle2 = np.square(np.arccos(np.clip(cosine, -1, 1)))
    return np.sqrt((angle2 * is_near).sum(axis=1) / np.maximum(is_near.sum(axis=1), 1))


def trust_in_normals(spread: NDArray) -> NDArray[np.float32]:
    """Compute the factor (N,) of the confidence of R from the :func:`normal_spread` (N,) of surfels."""
    of_room = _ramp(float(np.median(spread)), BUMPY_ROOM)
    return (1 - (1 - BUMPY_TRUST) * of_room * _ramp(spread, BUMPY)).astype(np.float32)


def light_certainty(doubt: NDArray, diffuse: NDArray, region: NDArray) -> NDArray[np.float64]:
    """Compute the trust (N,) in the light of surfels from the uncertain luminance ``doubt`` (N,) of their
    diffuse shading ``diffuse`` (N, 3).

    It is at most the trust in their whole smooth ``region`` (N,): small sources make the shares noisy.
    """
    shading = np.maximum(diffuse @ LUMINANCE_WEIGHTS, 1e-12)
    part = np.bincount(region, doubt) / np.maximum(np.bincount(region, shading), 1e-12)
    return 1.0 - _ramp(np.maximum(doubt / shading, part[region]), DOUBT)


def _ramp(value: NDArray | float, ends: tuple[float, float]) -> NDArray:
    """Compute the smoothstep of ``value`` from 0 at the first of ``ends`` to 1 at the second."""
    t = np.clip((value - ends[0]) / (ends[1] - ends[0]), 0, 1)
    return t * t * (3 - 2 * t)


@dataclass(frozen=True)
class SurfelConfidence:
    """Confidence of N surfels by grid cell and side of the cell, the signed axis nearest to the normal.

    ``low`` (3,), ``cell_m`` and ``shape`` (3,): lower corner, cell size and number of cells of the grid;
    ``cell`` (N,): key of each surfel's cell and side, ascending; ``confidence`` (N, 3): of D, S and R, x 255.
    """

    low: NDArray[np.float64]
    cell_m: float
    shape: NDArray[np.int64]
    cell: NDArray[np.int64]
    confidence: NDArray[np.uint8]

    @classmethod
    def of(cls, surfels: Surfels, confidence: NDArray) -> SurfelConfidence:
        """Store the ``confidence`` (N, 3), in [0, 1], of ``surfels``."""
        grid = surfels.grid
        stored = np.round(255 * np.clip(confidence, 0, 1)).astype(np.uint8)
        return cls(grid.low, grid.cell_m, grid.shape, np.flatnonzero(grid.surfel >= 0), stored)

    def at(self, points: NDArray, normals: NDArray) -> NDArray[np.uint8]:
        """Look up the confidence (..., 3), 0 to 255, at surface ``points`` with ``normals``, (..., 3) each.

        Without a surfel in the point's cell, it is that of the nearest adjacent cell that has one, else 0.
        """
        flat = points.reshape(-1, 3).astype(np.float64)
        side = np.ascontiguousarray(normals.reshape(-1, 3), np.float32)
        found = _look_up(
            flat, side, self.low, self.cell_m, self.shape, self.cell, self.confidence, _NEAREST_FIRST
        )
        return found.reshape(points.shape)


@compiled
def _look_up(points, normals, low, cell_m, shape, cells, confidence, steps):
    found = np.zeros((len(points), 3), np.uint8)
    place = np.zeros(3)
    for index in range(len(points)):
        for step in range(len(steps)):
            for axis in range(3):
                place[axis] = points[index, axis] + steps[step, axis] * cell_m
            cell = cell_of(place, normals[index], low, cell_m, shape)
            if cell < 0:
                continue
            row = np.searchsorted(cells, cell)
            if row < len(cells) and cells[row] == cell:
                found[index] = confidence[row]
                break
    return found

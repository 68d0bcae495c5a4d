# SPDX-License-Identifier: MIT
"""Confidence of D, S and R from light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.light.estimated_light import MAX_REFLECTED
from datagen.light.radiance_field import cell_keys
from datagen.light.surfels import CellGrid, Surfels

IMPOSSIBLE = (0.1, 0.3)
"""Share of the surfels around that reflect more than arrives, up to which the light counts fully, and from
which it does not count."""
IMPOSSIBLE_ROOM = (0.12, 0.2)
"""The same of a whole room: up to the first, its light is trusted everywhere."""
DARK_ROOM = (0.2, 0.4)
"""The same of a whole room whose lamps no photograph shows: from the second on, its light counts nowhere."""
IMPOSSIBLE_SURFACE = (0.4, 0.8)
"""The same of a surface in any room, up to which its light is evidence of D, and from which it is none."""
MIN_OBSERVATIONS = 50.0
"""Observations from which a share is that of its surfels rather than of the larger surface around."""
BLOCK_CELLS = 25
"""Side of the blocks whose shares count, in cells: a twelfth of the room's diagonal."""
DOUBT = (0.15, 0.6)
"""Part of a surfel's light that is not sure up to which it counts fully, and from which it does not count."""
HIDDEN_LIGHT = (0.3, 0.5)
"""Share of the light of a surfel's smooth region from lamps that no photograph shows, whose place is not
known: up to the first it counts fully, and from the second on, it does not count."""
_NEAR_BLOCKS = 8
D_EVIDENCE, S_EVIDENCE = (0.65, 1.0), (0.2, 0.5)
"""Share of a surfel's hemisphere that photographs show: below the first number the light counts nothing,
above the second it counts fully."""


def surfel_confidence(photographed: NDArray) -> NDArray[np.float32]:
    """Confidence (N, 3) of D, S and R of surfels from the photographed share of their hemisphere: D scales
    with the irradiance, while S and R already have a prior that grows where evidence is weak."""
    of_d = _ramp(photographed, D_EVIDENCE)
    of_s = _ramp(photographed, S_EVIDENCE)
    return np.stack([of_d, of_s, of_s], axis=1).astype(np.float32)


@dataclass(frozen=True)
class ImpossibleShares:
    """Share of the surfels that reflect more than arrives, because of unphotographed lamps and windows:
    ``around`` each surfel (N,), on its smooth region, and ``of_room``."""

    around: NDArray[np.float64]
    of_room: float

    def trust(self) -> NDArray[np.float32]:
        """Factor (N,) of all confidences; a low factor blends in the network's maps. Some surfels are too
        bright in any room: :data:`IMPOSSIBLE_ROOM`."""
        trust = 1 - _ramp(self.of_room, IMPOSSIBLE_ROOM) * _ramp(self.around, IMPOSSIBLE)
        return (trust * (1 - _ramp(self.of_room, DARK_ROOM))).astype(np.float32)

    def evidence(self) -> NDArray[np.float32]:
        """Factor (N,) of the confidence of D in any room: where most of a surface reflects more than arrives,
        its shading is corrected by surface elsewhere and by the network's maps."""
        return (1 - _ramp(self.around, IMPOSSIBLE_SURFACE)).astype(np.float32)


def impossible_shares(
    surfels: Surfels, diffuse: NDArray, is_metal: NDArray[np.bool_], region: NDArray
) -> ImpossibleShares:
    """Where surfels of the smooth regions ``region`` (N,) reflect more than arrives: their radiance exceeds
    :data:`MAX_REFLECTED` times ``diffuse`` (N, 3).

    Shares, weighted by views, are those of a region in blocks of :data:`BLOCK_CELLS`, interpolated between
    blocks; blocks of few surfels shrink to the whole region, small regions to the room. Metals are ignored.
    """
    excess = (surfels.radiance - MAX_REFLECTED * diffuse) @ LUMINANCE_WEIGHTS > 0
    weight = (np.diff(surfels.observations.start) * ~is_metal).astype(np.float64)
    grid = surfels.grid
    side_m = BLOCK_CELLS * grid.cell_m
    blocks = CellGrid(grid.low, side_m, -(-grid.shape // BLOCK_CELLS), grid.surfel)
    keys = cell_keys(blocks, surfels.position_m, surfels.normal)
    of_region = np.unique(region, return_inverse=True)[1]
    block = np.unique(np.stack([keys, of_region]), axis=1, return_inverse=True)[1].ravel()
    of_room = float(weight @ excess) / max(float(weight.sum()), 1e-12)
    whole = _shrunk_share(np.bincount(of_region, weight * excess), np.bincount(of_region, weight), of_room)
    num = np.bincount(block)
    total, shining = np.bincount(block, weight), np.bincount(block, weight * excess)
    apart_m = 100 * side_m * of_region  # blocks of other regions are never near
    place = np.column_stack([surfels.position_m, surfels.normal * side_m, apart_m]).astype(np.float64)
    centre = np.stack([np.bincount(block, column) / num for column in place.T], axis=1)
    distance, index = cKDTree(centre).query(place, k=np.arange(min(_NEAR_BLOCKS, len(num))) + 1, workers=-1)
    near = np.exp(-0.5 * np.square(distance / (0.7 * side_m)))
    around = _shrunk_share(
        (near * shining[index]).sum(axis=1), (near * total[index]).sum(axis=1), whole[of_region]
    )
    return ImpossibleShares(around, of_room)


def _shrunk_share(part: NDArray, total: NDArray, otherwise: float | NDArray) -> NDArray[np.float64]:
    """``part`` of ``total``, shrunk to ``otherwise`` with the weight of :data:`MIN_OBSERVATIONS`."""
    return (part + MIN_OBSERVATIONS * otherwise) / (total + MIN_OBSERVATIONS)


def trust_in_hidden(hidden: NDArray) -> NDArray[np.float32]:
    """Factor (N,) of all confidences by the share ``hidden`` (N,) of light from unphotographed lamps; a low
    factor blends in the network's maps."""
    return (1 - _ramp(hidden, HIDDEN_LIGHT)).astype(np.float32)


def sureness(doubt: NDArray, diffuse: NDArray) -> NDArray[np.float64]:
    """Factor (N,) of the confidence of surfels whose shading ``diffuse`` (N, 3) has the uncertain luminance
    ``doubt`` (N,)."""
    part = doubt / np.maximum(diffuse @ LUMINANCE_WEIGHTS, 1e-12)
    return 1.0 - _ramp(part, DOUBT)


def _ramp(value: NDArray | float, ends: tuple[float, float]) -> NDArray:
    """0 below the first of ``ends``, 1 above the second, smooth between."""
    t = np.clip((value - ends[0]) / (ends[1] - ends[0]), 0, 1)
    return t * t * (3 - 2 * t)

# SPDX-License-Identifier: MIT
"""How much the light is trusted: the confidence of D, S and R."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.light.radiance_field import cell_keys
from datagen.light.surfels import CellGrid, Surfels

NOISE = 1.1
"""Radiance over Ld that a white surface reaches by noise."""
IMPOSSIBLE = (0.1, 0.3)
"""Share of the surfels around that reflect more than arrives, up to which the light counts fully, and from
which it does not count."""
IMPOSSIBLE_ROOM = (0.12, 0.2)
"""The same of a whole room: up to the first, its light is trusted everywhere."""
DARK_ROOM = (0.2, 0.4)
"""The same of a whole room whose lamps no photograph shows: from the second on, its light counts nowhere."""
BLOCK_CELLS = 25
"""Side of the blocks whose shares count, in cells: a twelfth of the room's diagonal."""
DOUBT = (0.15, 0.6)
"""Part of a surfel's light that is not sure up to which it counts fully, and from which it does not count."""
_NEAR_BLOCKS = 8
D_EVIDENCE, S_EVIDENCE = (0.65, 1.0), (0.2, 0.5)
"""Share of a surfel's hemisphere that photographs show: below the first number the light counts nothing,
above the second it counts fully."""


def surfel_confidence(photographed: NDArray) -> NDArray[np.float32]:
    """Confidence (N, 3) of D, S and R of surfels from the share of their hemisphere that photographs show:
    D scales with the irradiance, while S and R hold a prior already that grows where evidence lacks."""
    of_d = _ramp(photographed, D_EVIDENCE)
    of_s = _ramp(photographed, S_EVIDENCE)
    return np.stack([of_d, of_s, of_s], axis=1).astype(np.float32)


def light_trust(surfels: Surfels, diffuse: NDArray, is_metal: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Factor (N,) of all confidences: less where surfels around reflect more than arrives, as they do in the
    light of lamps and windows that no photograph shows.

    A surfel does where its radiance is above :data:`NOISE` times ``diffuse`` (N, 3). Shares, by views, are
    those of blocks of :data:`BLOCK_CELLS` by side of the surface, interpolated between blocks; metals do not
    count. Blocks count as far as the share of the whole room is above :data:`IMPOSSIBLE_ROOM`: some surfels
    are too bright in any room.
    """
    excess = (surfels.radiance - NOISE * diffuse) @ LUMINANCE_WEIGHTS > 0
    weight = np.diff(surfels.observations.start) * ~is_metal
    grid = surfels.grid
    side_m = BLOCK_CELLS * grid.cell_m
    blocks = CellGrid(grid.low, side_m, -(-grid.shape // BLOCK_CELLS), grid.surfel)
    keys = cell_keys(blocks, surfels.position_m, surfels.normal)
    block = np.unique(keys, return_inverse=True)[1]
    num = np.bincount(block)
    total, shining = np.bincount(block, weight), np.bincount(block, weight * excess)
    place = np.concatenate([surfels.position_m, surfels.normal * side_m], axis=1).astype(np.float64)
    centre = np.stack([np.bincount(block, column) / num for column in place.T], axis=1)
    distance, index = cKDTree(centre).query(place, k=np.arange(min(_NEAR_BLOCKS, len(num))) + 1, workers=-1)
    near = np.exp(-0.5 * np.square(distance / (0.7 * side_m)))
    share = (near * shining[index]).sum(axis=1) / np.maximum((near * total[index]).sum(axis=1), 1e-12)
    of_room = shining.sum() / max(float(total.sum()), 1e-12)
    trust = 1 - _ramp(of_room, IMPOSSIBLE_ROOM) * _ramp(share, IMPOSSIBLE)
    return (trust * (1 - _ramp(of_room, DARK_ROOM))).astype(np.float32)


def sureness(doubt: NDArray, diffuse: NDArray) -> NDArray[np.float64]:
    """Factor (N,) of the confidence of surfels of whose shading ``diffuse`` (N, 3) the luminance ``doubt``
    (N,) is not sure."""
    part = doubt / np.maximum(diffuse @ LUMINANCE_WEIGHTS, 1e-12)
    return 1.0 - _ramp(part, DOUBT)


def _ramp(value: NDArray, ends: tuple[float, float]) -> NDArray:
    """0 below the first of ``ends``, 1 above the second, smooth between."""
    t = np.clip((value - ends[0]) / (ends[1] - ends[0]), 0, 1)
    return t * t * (3 - 2 * t)

# SPDX-License-Identifier: MIT
"""Finds the diffuse albedo of a room's white paint, the upper bound of D in uncertain light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.reconstruction.light.solve import MAX_ALBEDO

TYPICAL_WHITE = 0.85
"""Albedo of white paint where none is known; in the development rooms it is 0.78 to 1."""
MIN_WHITE, MAX_CHROMA = 0.7, 0.12
"""Minimum mean albedo of white paint over channels, and maximum difference between its channels."""
HALF_SUPPORT = 300.0
"""Number of confident surfels of one white at which it has the same weight as :data:`TYPICAL_WHITE`."""
_STEP, _BANDWIDTH, _REACH = 0.005, 0.015, 0.04  # of the histogram, its smoothing, and the support of its mode


class White(NamedTuple):
    """Diffuse ``albedo`` of white paint, and the weight ``known`` in [0, 1] of the surfels that show it."""

    albedo: float = TYPICAL_WHITE
    known: float = 0.0


def white_paint(albedo: NDArray, confidence: NDArray) -> White:
    """Compute the most frequent ``albedo`` (N, 3) of bright grey surfels, weighted by ``confidence`` (N,) and
    shrunk to :data:`TYPICAL_WHITE`.
    """
    mean = np.minimum(albedo.mean(axis=1), MAX_ALBEDO)
    is_white = (mean >= MIN_WHITE) & (np.ptp(albedo, axis=1) <= MAX_CHROMA)
    edges = np.arange(MIN_WHITE, MAX_ALBEDO + 1.5 * _STEP, _STEP)
    centres = 0.5 * (edges[1:] + edges[:-1])
    num = np.histogram(mean[is_white], edges, weights=confidence[is_white])[0]
    distance = np.abs(centres[:, None] - centres)
    mode = int((np.exp(-0.5 * (distance / _BANDWIDTH) ** 2) @ num).argmax())
    support = float(num[distance[mode] < _REACH].sum())
    known = support / (support + HALF_SUPPORT)
    return White(known * float(centres[mode]) + (1 - known) * TYPICAL_WHITE, known)

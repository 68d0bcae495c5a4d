# SPDX-License-Identifier: MIT
"""Computes a texture of the specular albedo of metals that blur their reflections, surfel by surfel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.light.bake import SpecularShading
from datagen.light.surfels import Surfels, grouped_medians
from model.reconstruction.light.points import UNSEEN_WEIGHT

SHARP, BLURRED = 0.2, 0.3
"""Range of roughness over which S of a metal surfel changes from that of its segment to that of its own
observations; the grid's cells do not resolve sharp reflections."""
SEGMENT_VIEWS = 2.0
"""Weight of the segment's S, as a number of observations of the surfel."""


def textured_specular_albedo(
    surfels: Surfels,
    specular_albedo: NDArray[np.float32],
    roughness: NDArray[np.float32],
    is_metal: NDArray[np.bool_],
    shading: SpecularShading,
) -> NDArray[np.float32]:
    """Compute S (N, 3) of the surfels: of rough metals mainly the median of (radiance - ls1) / ls0 over
    observations, of all others that of the segment.

    ``specular_albedo`` (N, 3), ``roughness`` (N,) and ``is_metal`` (N,) are those of the surfels' segments;
    ``shading`` is that of all M observations, divided by the known share of its light.
    """
    observations = surfels.observations
    owner = surfels.surfel_of_observation()
    rows = np.flatnonzero(is_metal[owner])
    num = np.bincount(owner[rows], minlength=len(surfels))
    ratio = (observations.radiance[rows] - shading.ls1[rows]) / np.maximum(shading.ls0[rows], 1e-9)
    weight = observations.weight[rows] * (UNSEEN_WEIGHT + shading.photographed[rows])
    medians = grouped_medians(ratio, weight, owner[rows], len(surfels))
    blurred = np.clip((roughness - SHARP) / (BLURRED - SHARP), 0, 1)
    share = (blurred * num / (num + SEGMENT_VIEWS))[:, None]
    textured = share * np.clip(medians, 0, 1) + (1 - share) * specular_albedo
    return np.where(is_metal[:, None], textured, specular_albedo).astype(np.float32)

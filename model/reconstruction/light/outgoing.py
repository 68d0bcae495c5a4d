# SPDX-License-Identifier: MIT
"""Mean outgoing radiance of surfels, by which they illuminate each other.

Cameras at eye height see floors and table tops at grazing angles, where they reflect windows and lamps;
ceilings and walls see them at other angles. For dielectrics, the photographed radiance is therefore replaced
by its diffuse part plus the mean of the specular part over the hemisphere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.light.bake import cosine_rays
from datagen.light.lighting import Lit
from datagen.light.surfels import weighted_medians

NUM_DIRECTIONS, RAYS = 6, 8
"""Number of cosine-distributed outgoing directions of a surfel, and number of rays for each."""
SPECULAR_RAYS = 3
"""Rays per observation for its specular part; the median over observations has less noise than each."""
MIN_DIFFUSE = 0.1
"""Minimum diffuse part, relative to the photographed radiance."""
ROUGH = (0.5, 0.8)
"""Range of R over which increases of the photographed radiance are reduced to 0, since rough dielectrics can
hardly be distinguished from matte surfaces, whose S is 0."""
_SEED = 41


def outgoing_radiance(
    lit: Lit,
    specular: NDArray[np.float32],
    specular_albedo: NDArray[np.float32],
    roughness: NDArray[np.float32],
    is_metal: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute the mean outgoing radiance (N, 3) of N surfels, and its diffuse part (N, 3).

    Both are the photographed radiance for metals and mixed surfels. ``specular`` (M, 3): specular part of
    each observation; of the surfels: ``specular_albedo`` (N, 3), ``roughness`` (N,), ``is_metal`` (N,).
    """
    surfels, observations = lit.surfels, lit.surfels.observations
    diffuse = weighted_medians(observations.start, observations.radiance - specular, observations.weight)
    diffuse = np.maximum(diffuse, MIN_DIFFUSE * surfels.radiance)
    surfel = np.repeat(np.arange(len(surfels)), NUM_DIRECTIONS)
    position, normal = surfels.position_m[surfel], surfels.normal[surfel]
    ray = cosine_rays(surfels.position_m, surfels.normal, NUM_DIRECTIONS, lit.baker.start_m, _SEED)
    view = np.asarray(ray.d.numpy()).reshape(3, -1).T
    shading = lit.baker.specular(position, normal, view, roughness[surfel], RAYS, _SEED).extrapolated()
    leaving = specular_albedo[surfel] * shading.ls0 + shading.ls1
    change = diffuse + leaving.reshape(-1, NUM_DIRECTIONS, 3).mean(axis=1) - surfels.radiance
    low, high = ROUGH
    change = np.where(change > 0, change * np.clip((high - roughness) / (high - low), 0, 1)[:, None], change)
    outgoing = surfels.radiance + change
    is_kept = (is_metal | surfels.is_mixed)[:, None]
    return np.where(is_kept, surfels.radiance, outgoing), np.where(is_kept, surfels.radiance, diffuse)

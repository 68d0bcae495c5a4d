# SPDX-License-Identifier: MIT
"""Estimates the radiance of unphotographed surfaces, which illuminate the photographed ones.

An unphotographed surface is assumed to have the typical reflectance of its smooth region or object: the back
of a door gets the reflectance of the front. Its light is gathered in rounds of one bounce each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import smooth_regions
from datagen.light.bake import Baker
from datagen.light.cells import surface_cells
from datagen.light.radiance_field import RadianceField
from datagen.light.surfels import Surfels, grouped_medians

MAX_ESTIMATED_SURFELS, ESTIMATE_RAYS_PER_SURFEL = 40_000, 16
"""Approximate maximum number of surfels, and number of rays per surfel, that search for unphotographed
surfaces."""
MAX_RATIO_SURFELS, RATIO_EVIDENCE, PRIOR_SURFELS = 16_000, (0.5, 0.9), 4.0
"""Approximate maximum number of surfels from which typical reflectances are computed; range of the
photographed share of a surfel's light over which its weight increases from 0 to 1; and total weight at which
the median of a region (or object) counts as much as its prior, the median of the object (or room)."""
ESTIMATE_ROUNDS = 5
"""Number of rounds, each of which adds one bounce between unphotographed surfaces. The first assumes unknown
light to be as bright as known light; from the fifth on, the mean radiance changes by less than 2 %."""
EARLY_RAYS = 1 / 3
"""Share of ``num_rays`` in each round but the last; the next round's rays average out the noise."""
_REFLECTANCE_RANGE = (0.05, 0.9)
_MIN_KNOWN = 0.2  # lower bound on the known share of light, by which light is divided


@dataclass(frozen=True)
class Regions:
    """Smooth regions of a mesh: the region ``of_face`` (M,) of each triangle, and ``object_of_region`` (R,),
    the connected part of the mesh to which each region belongs.
    """

    of_face: NDArray[np.int32]
    object_of_region: NDArray[np.int32]

    @classmethod
    def of_mesh(cls, mesh: Mesh, region_of_face: NDArray[np.int32]) -> Regions:
        """Find the objects of the regions ``region_of_face`` (M,) of ``mesh``."""
        objects = np.zeros(int(region_of_face.max(initial=-1)) + 1, np.int32)
        objects[region_of_face] = smooth_regions(mesh, np.pi)
        return cls(region_of_face, objects)


@dataclass(frozen=True)
class UnseenSurfaces:
    """K unphotographed surface points: ``position_m``, ``normal`` and estimated ``radiance``, (K, 3) each."""

    position_m: NDArray[np.float32]
    normal: NDArray[np.float32]
    radiance: NDArray[np.float32]

    def added_to(self, field: RadianceField, surfels: Surfels) -> RadianceField:
        """Return a field that adds these surfaces to ``field``."""
        if not len(self.radiance):
            return field
        return field.extended(self.position_m, self.normal, surfels, self.radiance)


def unseen_surfaces(baker: Baker, surfels: Surfels, regions: Regions, num_rays: int) -> UnseenSurfaces:
    """Estimate the radiance of surfaces that are unknown in the field of ``baker`` but visible from surfels,
    as the typical reflectance of their smooth region times their incident light (``num_rays`` rays per point
    in the last round).
    """
    position, facing, face = _unknown_surface(baker, surfels)
    unseen = UnseenSurfaces(position, facing, np.zeros((len(position), 3), np.float32))
    if not len(position):
        return unseen
    reflectance = typical_reflectance(baker, surfels, regions, num_rays)[regions.of_face[face]]
    for number in range(ESTIMATE_ROUNDS):
        lit = Baker(unseen.added_to(baker.field, surfels), baker.size_m) if number else baker
        share = 1 if number == ESTIMATE_ROUNDS - 1 else EARLY_RAYS
        light = lit.irradiance(position, facing, math.ceil(share * num_rays))
        arriving = light.diffuse / np.maximum(light.known, _MIN_KNOWN)[:, None]
        unseen = replace(unseen, radiance=(reflectance * arriving).astype(np.float32))
    return unseen


def _unknown_surface(baker: Baker, surfels: Surfels) -> tuple[NDArray, NDArray, NDArray[np.int64]]:
    """Find the cells of unknown radiance that the surfels' rays hit; return a position and normal, (K, 3)
    each, and a triangle (K,) in every cell.
    """
    step = max(1, len(surfels) // MAX_ESTIMATED_SURFELS)
    origin, normal = surfels.position_m[::step], surfels.normal[::step]
    ray = baker.cosine_rays(origin, normal, ESTIMATE_RAYS_PER_SURFEL, seed=0)
    position, facing, face = baker.field.unknown_hits(ray)
    keys, first = np.unique(surface_cells(surfels.grid, position, facing), return_index=True)
    chosen = first[keys >= 0]
    return position[chosen], facing[chosen], face[chosen]


def typical_reflectance(
    baker: Baker, surfels: Surfels, regions: Regions, num_rays: int
) -> NDArray[np.float64]:
    """Compute the typical reflectance pi L / E (R, 3) of R smooth regions.

    It is the median over surfels, weighted by the photographed share of their light and shrunk towards the
    object's median, which is itself shrunk towards the room's; 0.4 if too little light is photographed.
    """
    step = max(1, len(surfels) // MAX_RATIO_SURFELS)
    lit = baker.irradiance(surfels.position_m[::step], surfels.normal[::step], num_rays)
    low, high = RATIO_EVIDENCE
    weight = np.clip((lit.photographed - low) / (high - low), 0, 1) * (lit.diffuse.min(axis=1) > 0)
    used = weight > 0
    object_of_region = regions.object_of_region
    if not used.any():
        return np.full((len(object_of_region), 3), 0.4)
    weight = weight[used]
    ratio = surfels.radiance[::step][used] * lit.known[used, None] / lit.diffuse[used]
    log_ratio = np.log(np.clip(ratio, *_REFLECTANCE_RANGE))

    def shrunk(group: NDArray, prior: NDArray) -> NDArray[np.float64]:
        """Median (K, 3) of each of K groups, shrunk towards ``prior`` (K, 3)."""
        total = np.bincount(group, weight, len(prior))
        own = (total / (total + PRIOR_SURFELS))[:, None]
        return own * grouped_medians(log_ratio, weight, group, len(prior)) + (1 - own) * prior

    of_room = grouped_medians(log_ratio, weight, np.zeros(len(weight), np.int64), 1)
    num_objects = int(object_of_region.max()) + 1
    of_sample = regions.of_face[surfels.face[::step][used]]
    of_object = shrunk(object_of_region[of_sample], np.repeat(of_room, num_objects, axis=0))
    return np.exp(shrunk(of_sample, of_object[object_of_region]))

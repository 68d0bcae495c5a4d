# SPDX-License-Identifier: MIT
"""Finds the sun of a photographed room from its patches of sunlight.

Photographs rarely show the sun, so its light is missing in the radiance field. Sunlit surfels have a larger
ratio of radiance to incident light than the rest of their smooth region, and rays towards the sun leave the
mesh from exactly these surfels. The sun is the direction whose visibility correlates best with the logarithm
of this ratio. Its irradiance follows from the median, over sunlit surfels, of their radiance divided by the
reflectance of the nearest surfels in shadow, less other light.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.foundation.color import luminance
from datagen.light.surfels import weighted_medians
from mitsuba_plugins.arrays import vectors_from_rows

Floats = NDArray[np.float64]

ANGULAR_DIAMETER_RAD = 0.0093
"""Angular diameter of the sun's disk."""
MIN_SURFELS, MIN_SUNLIT = 60, 20
"""Minimum number of surfels in a smooth region that is used in the search, and minimum numbers of sunlit and
of shadowed surfels in one that is used for the sun's irradiance."""
COARSE_SURFELS, NUM_DIRECTIONS = 10_000, 3000
"""Approximate number of surfels of the coarse search, and number of its directions above the horizon."""
REFINEMENTS, REFINED_DIRECTIONS = 6, 24
"""Number of refinements, each with half the radius of the one before, and of directions in each."""
MIN_COSINE = 0.1
"""Minimum cosine between the sun and the normal of a sunlit surfel."""
MAX_LOG_RATIO = 1.5
"""Bound to which |ln (reflectance / the region's median)| is clipped; lamps and highlights exceed it."""
MIN_CORRELATION, MIN_BRIGHT, MIN_ABOVE_WHITE = 0.3, 0.6, 0.3
"""Minimum correlation between the sun's visibility and ln reflectance, and minimum shares of sunlit surfels
that are above the midpoint of the means of sunlit and other surfels, and brighter than white in shadow."""
LOCAL_SURFELS, NEAREST_SHARE = 16, 0.5
"""Number of nearest shadowed surfels whose median reflectance is assumed for a sunlit one, and share of a
region's sunlit surfels that is used for the sun's irradiance, namely those nearest to shadow."""
MIN_REFLECTANCE = 0.02
"""Minimum reflectance of a region that is used for the sun's irradiance."""
DISK_SAMPLES = 16
"""Number of directions to the sun's disk from which its visible share is computed."""
_BATCH = 1_000_000  # rays


@dataclass(frozen=True)
class Sun:
    """The sun: ``direction`` (3,), a unit vector to it, and ``radiance`` (3,), the diffuse shading E / pi of
    a surface that faces it, in the photographs' unit.
    """

    direction: Floats
    radiance: Floats

    @property
    def irradiance(self) -> Floats:
        """Irradiance (3,) of a surface that faces the sun."""
        return np.pi * self.radiance


@dataclass(frozen=True)
class ShadowRays:
    """Rays from surfaces in a Mitsuba ``scene``; they start ``start_m`` above the surface."""

    scene: Any
    start_m: float

    def sunlight(self, sun: Sun, position_m: NDArray, normal: NDArray) -> NDArray[np.float32]:
        """Compute the diffuse shading (N, 3) by ``sun`` at positions with normals, (N, 3) each."""
        cosine = np.maximum(normal @ sun.direction, 0) * self.disk_share(sun.direction, position_m, normal)
        return (cosine[:, None] * sun.radiance).astype(np.float32)

    def disk_share(self, direction: Floats, position_m: NDArray, normal: NDArray) -> Floats:
        """Compute the visible share (N,) of the sun's disk in ``direction`` (3,)."""
        directions = around(direction, ANGULAR_DIAMETER_RAD / 2, DISK_SAMPLES)
        return self.escape(directions, position_m, normal).mean(axis=0)

    def escape(self, directions: Floats, position_m: NDArray, normal: NDArray) -> NDArray[np.bool_]:
        """Compute the mask (D, N) of rays from N points in ``directions`` (D, 3) that leave the scene and
        whose cosine to the normal exceeds :data:`MIN_COSINE`.
        """
        import mitsuba as mi

        escapes = normal @ directions.T > MIN_COSINE
        origin = (position_m + self.start_m * normal).astype(np.float32)
        surface, toward = np.nonzero(escapes)
        for start in range(0, len(surface), _BATCH):
            at, to = surface[start : start + _BATCH], toward[start : start + _BATCH]
            ray = mi.Ray3f(mi.Point3f(vectors_from_rows(origin[at])), vectors_from_rows(directions[to]))
            escapes[at, to] = ~np.asarray(self.scene.ray_test(ray).numpy(), dtype=bool)
        return escapes.T


@dataclass(frozen=True)
class LitSurfaces:
    """N surfels: ``position_m``, ``normal``, ``radiance`` and ``diffuse``, the shading without the sun,
    (N, 3) each; smooth ``region`` (N,); ``is_clipped`` (N,): whether the radiance is a lower bound.
    """

    position_m: NDArray
    normal: NDArray
    radiance: NDArray
    diffuse: NDArray
    region: NDArray
    is_clipped: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.region)

    def chosen(self, which: NDArray) -> LitSurfaces:
        """Select surfels; ``which`` is a mask (N,) or indices."""
        return LitSurfaces(*(getattr(self, field.name)[which] for field in fields(self)))


def find_sun(surfaces: LitSurfaces, rays: ShadowRays) -> Sun | None:
    """Find the sun; None if bright surfels fit no direction, or if its irradiance is unknown."""
    count = np.bincount(surfaces.region)
    surfaces = surfaces.chosen(count[surfaces.region] >= MIN_SURFELS)
    if not len(surfaces):
        return None
    value = _log_ratio(surfaces)
    step = max(1, len(surfaces) // COARSE_SURFELS)
    directions = upper_directions(NUM_DIRECTIONS)
    best = _best(directions, surfaces.chosen(np.arange(0, len(surfaces), step)), value[::step], rays)
    radius = np.sqrt(2 * np.pi / NUM_DIRECTIONS)
    for _ in range(REFINEMENTS):
        best = _best(np.stack([best, *around(best, radius, REFINED_DIRECTIONS)]), surfaces, value, rays)
        radius /= 2
    seen = rays.escape(best[None], surfaces.position_m, surfaces.normal)
    if _correlations(seen, value, surfaces.region)[0] < MIN_CORRELATION:
        return None
    is_sunlit, is_above_white = seen[0], luminance(surfaces.radiance) > luminance(surfaces.diffuse)
    is_bright = value > 0.5 * (value[is_sunlit].mean() + value[~is_sunlit].mean())
    if is_bright[is_sunlit].mean() < MIN_BRIGHT or is_above_white[is_sunlit].mean() < MIN_ABOVE_WHITE:
        return None
    radiance = _facing_radiance(surfaces, rays, best)
    return None if radiance is None else Sun(best, radiance)


def _best(directions: Floats, surfaces: LitSurfaces, value: Floats, rays: ShadowRays) -> Floats:
    """Return the direction (3,) whose visibility correlates best with ``value`` (N,)."""
    num = max(1, _BATCH // len(surfaces))
    found = []
    for start in range(0, len(directions), num):
        seen = rays.escape(directions[start : start + num], surfaces.position_m, surfaces.normal)
        found.append(_correlations(seen, value, surfaces.region))
    return np.asarray(directions[np.concatenate(found).argmax()])


def _log_ratio(surfaces: LitSurfaces) -> Floats:
    """Compute ln (reflectance / median of the smooth region) (N,), clipped at :data:`MAX_LOG_RATIO`."""
    reflected, arriving = luminance(surfaces.radiance), luminance(surfaces.diffuse)
    ratio = np.log(np.maximum(reflected, 1e-9) / np.maximum(arriving, 1e-9))
    order = np.lexsort((ratio, surfaces.region))
    region, start, count = np.unique(surfaces.region[order], return_index=True, return_counts=True)
    median = ratio[order][start + count // 2]
    return np.clip(ratio - median[np.searchsorted(region, surfaces.region)], -MAX_LOG_RATIO, MAX_LOG_RATIO)


def _correlations(seen: NDArray[np.bool_], value: Floats, region: NDArray) -> Floats:
    """Compute the correlation (D,) within regions between ``value`` (N,) and the mask ``seen`` (D, N) of the
    surfels from which a direction is visible; 0 if no region has both surfels in sun and in shadow.
    """
    of_region = np.unique(region, return_inverse=True)[1]
    count = np.bincount(of_region).astype(np.float64)
    deviation = value - (np.bincount(of_region, value) / count)[of_region]
    total = np.stack([np.bincount(of_region, row, len(count)) for row in seen])
    variance = (total * (1 - total / count)).sum(axis=1)
    norm = np.sqrt(np.maximum(variance * float(deviation @ deviation), 1e-12))
    return np.where(variance > 0, seen @ deviation / norm, 0.0)


def _facing_radiance(surfaces: LitSurfaces, rays: ShadowRays, direction: Floats) -> Floats | None:
    """Compute the diffuse shading (3,) of a surface that faces the sun; None if no region has enough surfels.

    It is the weighted median over regions of each region's median over sunlit surfels near shadow. Clipped
    surfels count as infinitely bright; without them, the median would be too low.
    """
    seen = rays.disk_share(direction, surfaces.position_m, surfaces.normal)
    found, weight = [], []
    for region in np.unique(surfaces.region[seen == 1]):
        own = surfaces.region == region
        sunlit, shadow = own & (seen == 1), own & (seen == 0)
        if min(sunlit.sum(), shadow.sum()) < MIN_SUNLIT:
            continue
        tree = cKDTree(surfaces.position_m[shadow])
        distance, index = tree.query(surfaces.position_m[sunlit], LOCAL_SURFELS, workers=-1)
        ratio = surfaces.radiance[shadow] / np.maximum(surfaces.diffuse[shadow], 1e-9)
        typical = np.maximum(np.median(ratio[index], axis=1), 1e-9)
        excess = surfaces.radiance[sunlit] / typical - surfaces.diffuse[sunlit]
        excess /= (surfaces.normal[sunlit] @ direction)[:, None]
        excess[surfaces.is_clipped[sunlit]] = np.inf
        near = np.argsort(distance[:, 0], kind="stable")[: max(MIN_SUNLIT, int(NEAREST_SHARE * len(excess)))]
        excess, typical = excess[near], typical[near]
        if np.median(typical, axis=0).min() < MIN_REFLECTANCE:
            continue
        found.append(np.median(excess, axis=0))
        weight.append(len(excess) ** 0.5)
    values, weights = np.reshape(found, (-1, 3)), np.array(weight)
    is_known = np.isfinite(values).all(axis=1)
    if not is_known.any():
        return None
    start = np.array([0, is_known.sum()])
    radiance = weighted_medians(start, values[is_known], weights[is_known])[0].astype(np.float64)
    return radiance if radiance.min() > 0 else None


def upper_directions(num: int) -> Floats:
    """Compute ``num`` evenly distributed unit directions (num, 3) above the horizon (Fibonacci lattice)."""
    index = np.arange(num) + 0.5
    z, turn = index / num, np.pi * (1 + np.sqrt(5)) * index
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def around(direction: Floats, radius: float, num: int) -> Floats:
    """Compute ``num`` unit directions (num, 3) evenly distributed within ``radius`` of ``direction``."""
    axis = np.eye(3)[np.abs(direction).argmin()]
    x = np.cross(direction, axis)
    x /= np.linalg.norm(x)
    index = np.arange(num) + 0.5
    offset, turn = radius * np.sqrt(index / num), np.pi * (1 + np.sqrt(5)) * index
    found = direction + (offset * np.cos(turn))[:, None] * x
    found += (offset * np.sin(turn))[:, None] * np.cross(direction, x)
    return found / np.linalg.norm(found, axis=1, keepdims=True)

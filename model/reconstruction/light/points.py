# SPDX-License-Identifier: MIT
"""Divides surfels into segments that share specular albedo and roughness, chooses surfels of each segment,
computes the specular shading of their observations, and solves the segments for S and R.

A segment is a part of a smooth region of the mesh with similar reflectance and predictions. These features
are binned, and a bin with few surfels is merged with the nearest bin of its region.

The solved materials determine the mean outgoing radiance of surfels, with which these illuminate each other.
Cameras at eye height record floors and table tops at grazing angles, where they reflect windows and lamps;
floors and table tops illuminate ceilings and walls at other angles. For dielectrics, the photographed
radiance is therefore replaced by its diffuse part plus the mean of the specular part over the hemisphere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.light.lighting import Lit
from datagen.light.surfels import Surfels, weighted_medians
from mitsuba_plugins.arrays import rows_from_vectors
from model.reconstruction.light.options import LightOptions
from model.reconstruction.light.solve import (
    ROUGHNESS_LEVELS,
    PriorWeights,
    SolvedSegments,
    decide,
    segment_costs,
)

LUMINANCE_STEP, CHROMA_STEP = 0.5, 0.35
"""Bin widths of the mean ln reflectance over channels, and of ln red and ln blue minus ln green."""
SPECULAR_STEP, ROUGHNESS_STEP = 0.3, 0.35
"""Bin widths of the square root of the predicted specular albedo, and of the predicted roughness."""
MIN_SURFELS = 24
"""Number of surfels below which a bin is merged with another."""
_MIN_REFLECTANCE, _MAX_REFLECTANCE = 0.01, 2.0
EVIDENCE_POWER = 3
"""Weights of priors are divided by a segment's evidence to this power."""
HALF_EVIDENCE_VIEWS = 1.0
"""Number of views at which a surfel has half of the full evidence; in few views, other materials may resemble
metal."""
MIN_VIEWS, MIN_LIGHT = 3, 0.6
"""Minimum number of views and known share of light of surfels that are preferred when points are chosen."""
_MIN_WEIGHT = 0.1  # preferred minimum weight of an observation
_QUOTA_STEP = 8
UNSEEN_WEIGHT = 0.05
"""Weight added to the photographed share of an observation's specular lobe, which may be 0."""
NUM_DIRECTIONS, RAYS = 6, 8
"""Number of cosine-distributed outgoing directions of a surfel, and number of rays for each."""
SPECULAR_RAYS = 3
"""Rays per observation for its specular part; the median over several observations reduces the noise."""
MIN_DIFFUSE = 0.1
"""Minimum diffuse part, relative to the photographed radiance."""
ROUGH = (0.5, 0.8)
"""Range of R over which increases of outgoing over photographed radiance fade to 0, since rough dielectrics
can hardly be distinguished from matte surfaces, whose S is 0."""
_SEED = 41


def segment_surfels(
    region: NDArray, reflectance: NDArray, specular_albedo: NDArray, roughness: NDArray
) -> NDArray[np.int32]:
    """Divide surfels into segments; return each surfel's segment (N,), numbered from 0 without gaps.

    Per surfel: smooth ``region`` (N,), ``reflectance`` pi radiance / irradiance (N, 3), and predicted
    ``specular_albedo`` (N, 3) and ``roughness`` (N,).
    """
    feature = _features(reflectance, specular_albedo, roughness)
    bins = np.round(feature).astype(np.int64)
    bins -= bins.min(axis=0, initial=0)
    key = region.astype(np.int64)
    for axis in range(bins.shape[1]):
        key = key * (int(bins[:, axis].max(initial=0)) + 1) + bins[:, axis]
    keys, segment = np.unique(key, return_inverse=True)
    num = np.bincount(segment, minlength=len(keys))
    centre = np.stack([np.bincount(segment, column, len(keys)) / num for column in feature.T], axis=1)
    region_of = np.zeros(len(keys), region.dtype)
    region_of[segment] = region
    target = np.arange(len(keys))
    order = np.argsort(region_of, kind="stable")
    starts = np.flatnonzero(np.diff(region_of[order])) + 1
    for rows in np.split(order, starts):
        large = rows[num[rows] >= MIN_SURFELS]
        if not len(large):
            large = rows[[num[rows].argmax()]]
        small = np.setdiff1d(rows, large)
        if len(small):
            distance = ((centre[small, None] - centre[None, large]) ** 2).sum(axis=2)
            target[small] = large[distance.argmin(axis=1)]
    return np.unique(target[segment], return_inverse=True)[1].astype(np.int32)


def _features(reflectance: NDArray, specular_albedo: NDArray, roughness: NDArray) -> NDArray[np.float64]:
    """Compute the features (N, 5) of surfels in units of bin width."""
    rho = np.log(np.clip(reflectance.astype(np.float64), _MIN_REFLECTANCE, _MAX_REFLECTANCE))
    green = rho[:, 1]
    return np.stack(
        [
            rho.mean(axis=1) / LUMINANCE_STEP,
            (rho[:, 0] - green) / CHROMA_STEP,
            (rho[:, 2] - green) / CHROMA_STEP,
            np.sqrt(np.clip(specular_albedo.mean(axis=1), 0, 1)) / SPECULAR_STEP,
            roughness / ROUGHNESS_STEP,
        ],
        axis=1,
    )


@dataclass(frozen=True)
class Segmentation:
    """Segmentation of N surfels: index of each surfel's ``segment`` (N,) and smooth ``region`` (N,), and the
    network's D, S and R as ``prior`` (N, 7).
    """

    segment: NDArray[np.int32]
    region: NDArray[np.int32]
    prior: NDArray[np.float32]

    def region_of_segment(self) -> NDArray[np.int64]:
        """Return the smooth region (G,) of each of G segments."""
        region = np.zeros(int(self.segment.max()) + 1, np.int64)
        region[self.segment] = self.region
        return region


@dataclass(frozen=True)
class Points:
    """P surfels to be solved, in order of their segments, with up to O observations each.

    ``surfel`` (P,): indices of the surfels; ``row`` (P, O): indices of the observations; ``weight`` (P, O), 0
    for missing observations; ``start`` (G + 1,): first point of each of G segments, followed by P.
    """

    surfel: NDArray[np.int64]
    row: NDArray[np.int64]
    weight: NDArray[np.float32]
    start: NDArray[np.int64]


def choose_points(surfels: Surfels, segment: NDArray, known: NDArray, options: LightOptions) -> Points:
    """Choose up to ``max_points`` surfels: equally many of each segment (index ``segment`` (N,)), or all of a
    small one; at least :data:`_QUOTA_STEP` of each, even if their sum exceeds ``max_points``.

    ``known`` (N,) is the known share of the surfels' light. Each surfel has at most ``num_observations``,
    chosen at equal steps of rank from the darkest to the brightest.
    """
    num_segments = int(segment.max()) + 1
    size = np.bincount(segment, minlength=num_segments)
    quota = _QUOTA_STEP
    while quota < size.max() and np.minimum(size, quota + _QUOTA_STEP).sum() < options.max_points:
        quota += _QUOTA_STEP
    count = np.diff(surfels.observations.start)
    random = np.random.default_rng(0).random(len(surfels))
    rank = np.lexsort((random - 2.0 * (count >= MIN_VIEWS) - 1.0 * (known > MIN_LIGHT), segment))
    first = np.cumsum(size) - size
    place = np.arange(len(rank)) - first[segment[rank]]
    chosen = rank[place < quota]
    luminance = surfels.observations.radiance.mean(axis=1)
    cosine_weight = _observation_weights(surfels)
    row, weight = _choose_observations(
        surfels.observations.start, luminance, cosine_weight, chosen, options.num_observations
    )
    start = np.concatenate([[0], np.cumsum(np.minimum(size, quota))]).astype(np.int64)
    return Points(chosen, row, weight, start)


def _observation_weights(surfels: Surfels) -> NDArray[np.float32]:
    """Compute each observation's weight (M,): its pixels' weight, at most 4, times the viewing cosine."""
    observations = surfels.observations
    surfel = surfels.surfel_of_observation()
    direction = surfels.directions(surfel, observations.view)
    cosine = (direction * surfels.normal[surfel]).sum(axis=1)
    return (np.minimum(observations.weight, 4.0) * np.clip(cosine, 0.02, 1.0)).astype(np.float32)


def _choose_observations(
    start: NDArray, luminance: NDArray, weight: NDArray, chosen: NDArray, num: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    row = np.zeros((len(chosen), num), np.int64)
    found = np.zeros((len(chosen), num), np.float32)
    for k, surfel in enumerate(chosen):
        rows = np.arange(start[surfel], start[surfel + 1])
        good = rows[weight[rows] > _MIN_WEIGHT]
        rows = good if len(good) >= 2 else rows
        order = rows[np.argsort(luminance[rows], kind="stable")]
        picked = (
            order if len(order) <= num else order[np.round(np.linspace(0, len(order) - 1, num)).astype(int)]
        )
        row[k, : len(picked)], found[k, : len(picked)] = picked, weight[picked]
    return row, found


@dataclass(frozen=True)
class PointShading:
    """Terms of the points' specular radiance S ``ls0`` + ``ls1``, (P, O, roughness levels, 3) each.

    The ``weight`` (P, O) of an observation is lower where its lobe includes unphotographed radiance.
    """

    ls0: NDArray[np.float32]
    ls1: NDArray[np.float32]
    weight: NDArray[np.float32]


def shade_points(lit: Lit, points: Points, options: LightOptions) -> PointShading:
    """Compute the specular shading of the points' observations at every roughness level."""
    surfels, observations = lit.surfels, lit.surfels.observations
    num_points, num = points.row.shape
    num_levels = len(ROUGHNESS_LEVELS)
    used = points.weight > 0
    surfel = np.repeat(points.surfel, num).reshape(num_points, num)[used]
    row = points.row[used]
    view = surfels.directions(surfel, observations.view[row])
    ls0 = np.zeros((num_points, num, num_levels, 3), np.float32)
    ls1 = np.zeros_like(ls0)
    photographed = np.zeros((num_points, num, num_levels), np.float32)
    for level, roughness in enumerate(ROUGHNESS_LEVELS):
        shading = lit.baker.specular(
            surfels.position_m[surfel],
            observations.normal[row],
            view,
            np.full(len(surfel), roughness),
            options.solve_rays,
            seed=level + 1,
        ).extrapolated()
        ls0[used, level], ls1[used, level] = shading.ls0, shading.ls1
        photographed[used, level] = shading.photographed
    weight = points.weight * (UNSEEN_WEIGHT + photographed.mean(axis=2))
    return PointShading(ls0, ls1, weight.astype(np.float32))


def solve_points(
    lit: Lit,
    points: Points,
    shading: PointShading,
    segmentation: Segmentation,
    exposure: float,
    options: LightOptions,
) -> SolvedSegments:
    """Solve S and R of the segments from the ``shading`` of their points at the capture's ``exposure``."""
    prior = segmentation.prior[points.surfel]
    num_segments = len(points.start) - 1
    segment = np.repeat(np.arange(num_segments), np.diff(points.start))
    total = np.bincount(segment, minlength=num_segments)
    mean = np.stack([np.bincount(segment, c, num_segments) / total for c in prior.T], axis=1)
    num_views = np.diff(lit.surfels.observations.start)[points.surfel]
    point_evidence = lit.irradiance.photographed[points.surfel] * (
        num_views / (num_views + HALF_EVIDENCE_VIEWS)
    )
    evidence = np.bincount(segment, point_evidence, num_segments) / total
    costs = segment_costs(
        points.start,
        lit.surfels.observations.radiance[points.row],
        shading.weight,
        lit.diffuse[points.surfel],
        shading.ls0,
        shading.ls1,
        exposure,
    )
    weights = options.prior if options.has_prior else PriorWeights(0.0, (0.0, 0.0), options.prior.metal)
    region = segmentation.region_of_segment()
    size = np.bincount(segmentation.segment, minlength=num_segments)
    views = np.bincount(segment, num_views, num_segments) / total
    white = lit.diffuse @ LUMINANCE_WEIGHTS
    ratio = lit.surfels.radiance @ LUMINANCE_WEIGHTS / np.maximum(white, 1e-12)
    brightness = _medians(ratio[points.surfel], points.start)
    evidence **= EVIDENCE_POWER
    return decide(costs, mean[:, 3:6], mean[:, 6], evidence, views, region, size, brightness, weights)


def _medians(values: NDArray, start: NDArray) -> NDArray[np.float64]:
    """Compute the upper median (G,) of each group ``start[g]`` to ``start[g + 1]`` - 1 of ``values`` (N,)."""
    group = np.repeat(np.arange(len(start) - 1), np.diff(start))
    ordered = values[np.lexsort((values, group))]
    return np.asarray(ordered[start[:-1] + np.diff(start) // 2], np.float64)


def outgoing_radiance(
    lit: Lit,
    specular: NDArray[np.float32],
    specular_albedo: NDArray[np.float32],
    roughness: NDArray[np.float32],
    is_metal: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute the mean outgoing radiance (N, 3) of N surfels, and its diffuse part (N, 3).

    Both are the photographed radiance for metals and mixed surfels. ``specular`` (M, 3): specular part of
    each observation; per surfel: ``specular_albedo`` (N, 3), ``roughness`` (N,), ``is_metal`` (N,).
    """
    surfels, observations = lit.surfels, lit.surfels.observations
    diffuse = weighted_medians(observations.start, observations.radiance - specular, observations.weight)
    diffuse = np.maximum(diffuse, MIN_DIFFUSE * surfels.radiance)
    surfel = np.repeat(np.arange(len(surfels)), NUM_DIRECTIONS)
    position, normal = surfels.position_m[surfel], surfels.normal[surfel]
    ray = lit.baker.cosine_rays(surfels.position_m, surfels.normal, NUM_DIRECTIONS, _SEED)
    view = rows_from_vectors(ray.d)
    shading = lit.baker.specular(position, normal, view, roughness[surfel], RAYS, _SEED).extrapolated()
    leaving = specular_albedo[surfel] * shading.ls0 + shading.ls1
    change = diffuse + leaving.reshape(-1, NUM_DIRECTIONS, 3).mean(axis=1) - surfels.radiance
    low, high = ROUGH
    change = np.where(change > 0, change * np.clip((high - roughness) / (high - low), 0, 1)[:, None], change)
    outgoing = surfels.radiance + change
    is_kept = (is_metal | surfels.is_mixed)[:, None]
    return np.where(is_kept, surfels.radiance, outgoing), np.where(is_kept, surfels.radiance, diffuse)

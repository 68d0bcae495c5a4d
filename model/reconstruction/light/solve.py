# SPDX-License-Identifier: MIT
"""Solves specular albedo and roughness of segments from the variation of radiance over views (docs/light.md).

For each roughness of :data:`ROUGHNESS_LEVELS` and specular albedo of :data:`SPECULAR_LEVELS`, the diffuse
albedo of a point follows from its radiance L, diffuse shading Ld and specular radiance S Ls0 + Ls1
(:mod:`datagen.light.bake`) in each observation, that is, in each view of the point,

    D = mean of (L - S Ls0 - Ls1) / ((1 - S) Ld), clipped to [0, MAX_FITTED_ALBEDO],

and the cost is the mean of |g(model) - g(L)|, each at most :data:`MAX_RESIDUAL`, with g(x) = ln(1 + 50 x) /
ln 51 at the capture's exposure, plus priors from the network's S and R. Alternative hypotheses are matte (S =
0, R = 1) and metal: D = 0 and a coloured S per point, mean(L - Ls1) / mean(Ls0), so that textured metal costs
no more than a textured dielectric.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, softmax

from datagen.multiview.compiled import compiled

ROUGHNESS_LEVELS = np.array([0.12, 0.25, 0.4, 0.55, 0.75, 1.0], np.float32)
SPECULAR_LEVELS = np.array([0.0, 0.02, 0.04, 0.06, 0.08], np.float32)
"""Specular albedos: 0 for matte surfaces, and those of dielectrics from water (0.02) to sapphire (0.08)."""
MAX_ALBEDO = 0.95
MAX_FITTED_ALBEDO = 1.1
"""Maximum D of a hypothesis. It exceeds 1 so that errors of the shading of white paint are not attributed to
a specular part."""
MAX_RESIDUAL = 0.2
"""Upper bound on the residual of an observation, since outliers result from wrong visibility or light."""
MIN_METAL = 0.2
"""Minimum specular albedo, averaged over channels, of a segment or region that is evidently metal."""
MIN_DARK_METAL = 0.1
"""Like :data:`MIN_METAL`, for other segments of a region of metal, such as dark tiles of a metal floor."""

MIN_EVIDENCE = 0.05
DIELECTRIC_RESIDUAL, METAL_RESIDUAL = (0.03, 0.06), (0.06, 0.12)
"""Ranges of a segment's residual over which confidence decreases from 1 to 0, since no hypothesis explains
the observations. Apparent dielectrics of high residual are mostly metals in inexact light or geometry; true
metals fit worse than true dielectrics, since they reflect the errors of light and geometry."""
NETWORK_VARIANCE = 0.1
"""Assumed variance of the network's R. The confidence of R compares the variance of R over hypotheses with
this value times the square root of the number of views. The variance over hypotheses omits errors of light
and geometry, which all hypotheses share and which are correlated among the views of a surfel."""
REGION_SHARE = 0.7
"""Weight of the mean R of a smooth region's dielectric segments in the shared R of a segment of full
confidence (:func:`shared_roughness`). Segments of a region differ in colour, but rarely in R."""
MIN_NOISE = 0.001
GLOSSY_TEMPERATURE = 0.04
"""Difference of costs, relative to the residual, that reduces the likelihood of S and R by a factor e in a
segment of :data:`REFERENCE_OBSERVATIONS`."""
MATTE_TEMPERATURE, MATTE_ALLOWANCE = (0.06, 0.018), 0.01
"""Like :data:`GLOSSY_TEMPERATURE`, but for matte (S = 0, R = 1) against the best glossy hypothesis, in an
inexact and an exact capture (:data:`EXACT_RESIDUAL`); and excess cost of matte, relative to the residual, at
which it is as likely as glossy, since glossy hypotheses fit noise slightly better."""
MATTE_ALBEDO, MATTE_DIELECTRIC = (0.02, 0.06), 0.75
"""Bounds on the network's S of matte segments in an inexact capture, where S = 0 and a rough dielectric look
alike; and the probability of the dielectric."""
REFERENCE_OBSERVATIONS, COOLING, MAX_TEMPERATURE_FACTOR = 3000.0, 0.75, 10.0
"""In an exact capture, temperatures are multiplied by (observations of the segment / REFERENCE_OBSERVATIONS)
to the power of -COOLING (-1 for independent errors), at most by MAX_TEMPERATURE_FACTOR."""
EXACT_RESIDUAL = (0.008, 0.012)
"""Median residuals up to which a capture counts as exact and from which as inexact. Errors of cameras, mesh
and photographs are common to many observations and blur reflections, which then resemble matte surfaces."""
METAL_SHARE = 0.25
"""Share of metal among a smooth region's surfels from which its other segments may become metal."""
MIN_LOG_RATIO, MAX_LOG_RATIO = 0.35, 2.0
"""Minimum, for a region of metal, of the mean ln (residual as dielectric / residual as metal) of its segments
times the square root of their mean evidence; and bound on each logarithm, so that few do not dominate."""
MAX_BRIGHTNESS = 1.1
"""Maximum typical radiance, relative to white in the same light, of a segment that is evidence of metal in an
inexact capture. Metal that reflects a lamp may be brighter."""
MIRROR_ROUGHNESS, MIRROR_RESIDUAL, MIRROR_FIT = 0.25, 0.06, 0.8
"""Maximum roughness of a mirror, its minimum residual as dielectric, and maximum ratio of its residual as
metal to that. Reflections that move with the view are evidence enough, without a photographed hemisphere."""
MIRROR_VIEWS, MIRROR_SURFELS = 1.2, 48
"""Minimum mean number of views of a mirror's surfels, and minimum number of surfels."""
MATTE_METAL = 0.7
"""Roughness above which metal looks so much like matte paint that the network's S is no evidence of metal."""
MIN_METAL_SURFELS = 6
"""Minimum number of surfels of a smooth region of metal. The mixed pixels of smaller regions, such as the
fragments of a bumpy mesh, resemble metal."""
METAL_TOLERANCE = 0.005
"""Maximum excess cost of metal over a dielectric at which a segment of a metal region becomes metal."""


@dataclass(frozen=True)
class PriorWeights:
    """Weights of the priors, which are divided by a segment's evidence.

    ``specular_albedo`` and ``roughness``: weights of the squared differences of sqrt(S) and of R from the
    network's, ``roughness`` for an inexact and an exact capture (:data:`EXACT_RESIDUAL`); ``metal``: margin
    by which the cost of metal must be below that of a dielectric.
    """

    specular_albedo: float = 0.02
    roughness: tuple[float, float] = (0.0005, 0.0001)
    metal: float = 0.015


@dataclass(frozen=True)
class Costs:
    """Costs of hypotheses for G segments by roughness level and specular albedo: ``dielectric`` (G, levels,
    speculars), ``metal`` (G, levels) and ``metal_albedo`` (G, levels, 3), the S of the metal hypotheses.
    """

    dielectric: NDArray[np.float32]
    metal: NDArray[np.float32]
    metal_albedo: NDArray[np.float32]


@dataclass(frozen=True)
class SolvedSegments:
    """Materials of G segments.

    ``specular_albedo`` (G, 3); ``roughness`` (G,); ``is_metal`` (G,); ``residual`` (G,): cost without priors;
    ``confidence`` (G, 3) of D, S and R in [0, 1], which decreases with the residual and, for R of
    dielectrics, with R's variance over hypotheses.
    """

    specular_albedo: NDArray[np.float32]
    roughness: NDArray[np.float32]
    is_metal: NDArray[np.bool_]
    residual: NDArray[np.float32]
    confidence: NDArray[np.float32]

    @property
    def is_mirror(self) -> NDArray[np.bool_]:
        """Mask (G,) of metals so smooth that the reflected images alone determine their material."""
        return self.is_metal & (self.roughness <= MIRROR_ROUGHNESS)


def segment_costs(
    start: NDArray[np.int64],
    radiance: NDArray[np.float32],
    weight: NDArray[np.float32],
    diffuse: NDArray[np.float32],
    ls0: NDArray[np.float32],
    ls1: NDArray[np.float32],
    exposure: float,
) -> Costs:
    """Compute the costs of G segments; segment g consists of the points ``start[g]`` to ``start[g + 1]`` - 1.

    For P points with O observations each: ``radiance`` (P, O, 3); ``weight`` (P, O), 0 for missing
    observations; diffuse shading ``diffuse`` (P, 3); specular shading ``ls0`` and ``ls1`` (P, O, levels, 3).
    """
    observed = (start, radiance, weight, diffuse, ls0, ls1, np.float32(exposure))
    return Costs(*_costs(*observed, ROUGHNESS_LEVELS, SPECULAR_LEVELS))


def decide(
    costs: Costs,
    specular_albedo: NDArray,
    roughness: NDArray,
    evidence: NDArray,
    views: NDArray,
    region: NDArray,
    size: NDArray,
    brightness: NDArray,
    weights: PriorWeights,
) -> SolvedSegments:
    """Compute the expected material of each of G segments.

    ``specular_albedo`` (G, 3) and ``roughness`` (G,) are the network's; ``evidence`` (G,) in [0, 1], at least
    :data:`MIN_EVIDENCE`, divides the weights of priors; ``views`` (G,): mean number of views of a surfel;
    ``region`` (G,): smooth region; ``size`` (G,): number of surfels; ``brightness`` (G,): typical radiance
    relative to white in the same light. A dielectric is the mean of the matte hypothesis (R = 1; S = 0 or, in
    an inexact capture, as in :data:`MATTE_ALBEDO`) and the glossy ones, weighted by likelihood.

    A segment is metal if its cost as metal is lower by a margin (:class:`PriorWeights`), or by any amount for
    mirrors. A segment whose cost is at most :data:`METAL_TOLERANCE` higher as metal becomes metal too if
    :data:`METAL_SHARE` of its region is metal or the region as a whole fits better as metal
    (:data:`MIN_LOG_RATIO`). Regions of fewer than :data:`MIN_METAL_SURFELS` surfels are not metal. In inexact
    captures, segments above :data:`MAX_BRIGHTNESS` are no evidence of metal, since sunlit patches, which clip
    and whose light is underestimated, resemble metal.
    """
    inverse_evidence = 1.0 / np.maximum(evidence, MIN_EVIDENCE)
    root = np.sqrt(np.maximum(specular_albedo.mean(axis=1), 0))
    prior_s = (
        weights.specular_albedo
        * inverse_evidence[:, None]
        * (np.sqrt(SPECULAR_LEVELS)[None] - root[:, None]) ** 2
    )
    matte_cost = costs.dielectric[:, -1, 0].astype(np.float64)
    glossy_cost = costs.dielectric[:, :, 1:].reshape(len(root), -1).min(axis=1)
    residual = np.minimum(matte_cost, glossy_cost)
    observations = np.maximum(size * views, 1)
    exactness = _exactness(residual, observations)
    roughness_weight = _blended(weights.roughness, exactness) * inverse_evidence
    prior_r = roughness_weight[:, None] * (ROUGHNESS_LEVELS[None] - roughness[:, None]) ** 2
    rows = np.arange(len(root))
    glossy = costs.dielectric[:, :, 1:].astype(np.float64) + prior_s[:, None, 1:] + prior_r[:, :, None]
    noise = np.maximum(residual, MIN_NOISE)
    cooling = (observations / REFERENCE_OBSERVATIONS) ** -(COOLING * exactness)
    temperature = noise * np.minimum(cooling, MAX_TEMPERATURE_FACTOR)
    found_s, found_r, mean_r2 = _expected(glossy / (GLOSSY_TEMPERATURE * temperature)[:, None, None])
    matte_temperature = _blended(MATTE_TEMPERATURE, exactness) * temperature
    matte = expit((glossy_cost - matte_cost + MATTE_ALLOWANCE * noise) / matte_temperature)
    matte_s = (1 - exactness) * MATTE_DIELECTRIC * np.clip(root**2, *MATTE_ALBEDO)
    found_s, found_r = matte * matte_s + (1 - matte) * found_s, matte + (1 - matte) * found_r
    variance = matte + (1 - matte) * mean_r2 - found_r**2
    best = np.minimum(glossy.reshape(len(root), -1).min(axis=1), matte_cost + prior_s[:, 0] + prior_r[:, -1])
    metal = costs.metal + prior_r
    mean_albedo = costs.metal_albedo.mean(axis=2)
    metal = np.where(mean_albedo < MIN_DARK_METAL, np.inf, metal)
    metal_level = metal.argmin(axis=1)
    nonmetal_prior = 1 - np.minimum(root**2 / MIN_METAL, 1)  # the network rarely predicts metal, but reliably
    nonmetal_prior[ROUGHNESS_LEVELS[metal_level] > MATTE_METAL] = 1
    required = weights.metal * inverse_evidence * nonmetal_prior
    albedo, advantage = mean_albedo[rows, metal_level], best - metal[rows, metal_level]
    metal_residual = costs.metal[rows, metal_level]
    is_mirror = (ROUGHNESS_LEVELS[metal_level] <= MIRROR_ROUGHNESS) & (
        metal_residual <= MIRROR_FIT * residual
    )
    is_mirror &= (residual >= MIRROR_RESIDUAL) & (views >= MIRROR_VIEWS) & (size >= MIRROR_SURFELS)
    required = np.where(is_mirror, 0, required)
    is_possible = (brightness <= MAX_BRIGHTNESS) | (exactness > 0.5)
    is_possible &= np.bincount(region, size)[region] >= MIN_METAL_SURFELS
    is_metal = (advantage > required) & (albedo >= MIN_METAL) & is_possible
    ratio = np.log(noise / np.maximum(metal_residual, MIN_NOISE))
    is_in_metal = _is_in_metal_region(region, size * is_possible, is_metal, ratio, evidence, albedo)
    is_metal |= is_in_metal & (advantage > -METAL_TOLERANCE)
    found_s = np.where(is_metal[:, None], costs.metal_albedo[rows, metal_level], found_s[:, None])
    found_r = np.where(is_metal, _refined(metal, metal_level), found_r)
    residual = np.where(is_metal, metal_residual, residual)
    low, high = np.where(is_metal[:, None], METAL_RESIDUAL, DIELECTRIC_RESIDUAL).T
    confidence = np.repeat(np.clip((high - residual) / (high - low), 0, 1)[:, None], 3, axis=1)
    network_variance = NETWORK_VARIANCE * np.sqrt(views)
    confidence[:, 2] *= np.where(is_metal, 1.0, network_variance / (network_variance + variance))
    return SolvedSegments(
        found_s.astype(np.float32),
        found_r.astype(np.float32),
        is_metal,
        residual.astype(np.float32),
        confidence.astype(np.float32),
    )


def shared_roughness(
    solved: SolvedSegments, region: NDArray, weight: NDArray
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Blend the R (G,) of dielectrics with its mean over the smooth region ``region`` (G,), weighted by
    ``weight`` (G,) times confidence; return it and its confidence (G,).

    The share of the mean increases from :data:`REGION_SHARE` to 1 as a segment's confidence decreases to 0,
    and confidence is at least that of the region times this share. The result is for maps; specular radiance
    is computed with each segment's own R, which explains its observations.
    """
    confidence = solved.confidence[:, 2]
    weight = weight * ~solved.is_metal
    total = np.bincount(region, weight * confidence)
    mean = np.bincount(region, weight * confidence * solved.roughness) / np.maximum(total, 1e-12)
    of_region = total / np.maximum(np.bincount(region, weight), 1e-12)
    share = np.where(solved.is_metal | (total <= 0)[region], 0.0, 1 - (1 - REGION_SHARE) * confidence)
    shared = solved.roughness + share * (mean[region] - solved.roughness)
    return shared.astype(np.float32), np.maximum(confidence, share * of_region[region]).astype(np.float32)


def _is_in_metal_region(
    region: NDArray, size: NDArray, is_metal: NDArray, ratio: NDArray, evidence: NDArray, albedo: NDArray
) -> NDArray[np.bool_]:
    """Compute the mask (G,) of segments whose region is metal as a whole, by its share of metal or by
    its mean ``ratio``, ln (residual as dielectric / residual as metal).

    ``size`` (G,): number of surfels, 0 for ignored segments; ``albedo`` (G,): mean S of the metal
    hypotheses; the other arguments (G,) are as in :func:`decide`.
    """
    share, mean_ratio, mean_evidence, mean_albedo = (
        np.bincount(region, size * values) / np.maximum(np.bincount(region, size), 1)
        for values in (is_metal, np.clip(ratio, -MAX_LOG_RATIO, MAX_LOG_RATIO), evidence, albedo)
    )
    is_evident = mean_ratio * np.sqrt(mean_evidence) > MIN_LOG_RATIO
    return ((share >= METAL_SHARE) | (is_evident & (mean_albedo >= MIN_METAL)))[region]


def _exactness(residual: NDArray, observations: NDArray) -> float:
    """Compute the exactness of a capture, from 0 to 1 over :data:`EXACT_RESIDUAL`, from the segments'
    ``residual`` and numbers of ``observations``, (G,) each.
    """
    order = np.argsort(residual)
    count = np.cumsum(observations[order])
    median = residual[order[np.searchsorted(count, 0.5 * count[-1])]]
    return float(np.interp(median, EXACT_RESIDUAL, (1, 0)))


def _blended(ends: tuple[float, float], exactness: float) -> float:
    """Interpolate between values for an inexact and an exact capture."""
    return ends[0] + exactness * (ends[1] - ends[0])


def _expected(cost: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Compute the means (G,) of S, R and R^2 over glossy hypotheses of ``cost`` (G, levels, nonzero
    speculars), weighted by likelihood.

    Means have a lower squared error than the most likely hypothesis.
    """
    weight = softmax(-cost.reshape(len(cost), -1), axis=1).reshape(cost.shape)
    of_level = weight.sum(axis=2)
    return (
        weight.sum(axis=1) @ SPECULAR_LEVELS[1:],
        of_level @ ROUGHNESS_LEVELS,
        of_level @ ROUGHNESS_LEVELS**2,
    )


def _refined(cost: NDArray, best: NDArray) -> NDArray[np.float32]:
    """Compute the roughness (G,) at the minimum of the parabola through the costs of the ``best`` level (G,)
    and its neighbours; ``cost`` is (G, levels).
    """
    rows, last = np.arange(len(best)), len(ROUGHNESS_LEVELS) - 1
    inner = (best > 0) & (best < last)
    middle = np.clip(best, 1, last - 1)
    x = [ROUGHNESS_LEVELS[middle + k].astype(np.float64) for k in (-1, 0, 1)]
    y = [cost[rows, middle + k].astype(np.float64) for k in (-1, 0, 1)]
    usable = inner & np.isfinite(y[0]) & np.isfinite(y[1]) & np.isfinite(y[2])
    y = [np.where(usable, value, 0.0) for value in y]
    low, high = (y[1] - y[0]) / (x[1] - x[0]), (y[2] - y[1]) / (x[2] - x[1])
    curvature = (high - low) / (x[2] - x[0])
    vertex = 0.5 * (x[0] + x[1] - low / np.where(curvature > 0, curvature, 1.0))
    refined = np.clip(vertex, x[0], x[2])
    return np.where(usable & (curvature > 0), refined, ROUGHNESS_LEVELS[best]).astype(np.float32)


@compiled
def _encoded(value, exposure):
    return np.log(np.float32(1) + np.float32(50) * max(value, np.float32(0)) * exposure) * np.float32(0.25433)


@compiled
def _cost(first, last, radiance, target, weight, diffuse, ls0, ls1, level, specular, is_metal, exposure):
    """Compute the mean clamped residual of a segment's points at one roughness level, for a dielectric of
    albedo ``specular`` or a metal with the best albedo of each point and channel.
    """
    total, sum_weight = np.float32(0), np.float32(0)
    num = radiance.shape[1]
    for point in range(first, last):
        for channel in range(3):
            s, base = specular, np.float32(0)
            above, below = np.float32(0), np.float32(0)
            for o in range(num):
                w = weight[point, o]
                rest = radiance[point, o, channel] - ls1[point, o, level, channel]
                if is_metal:
                    above += w * rest
                    below += w * ls0[point, o, level, channel]
                else:
                    above += w * (rest - s * ls0[point, o, level, channel])
                    below += w * (1 - s) * diffuse[point, channel]
            if below > 0 and is_metal:
                s = min(max(above / below, np.float32(0)), np.float32(1))
            elif below > 0:
                albedo = min(max(above / below, np.float32(0)), np.float32(MAX_FITTED_ALBEDO))
                base = (1 - s) * albedo * diffuse[point, channel]
            for o in range(num):
                w = weight[point, o]
                if w > 0:
                    spec = s * ls0[point, o, level, channel] + ls1[point, o, level, channel]
                    r = abs(_encoded(base + spec, exposure) - target[point, o, channel])
                    total += w * min(r, np.float32(MAX_RESIDUAL))
                    sum_weight += w
    return total / max(sum_weight, np.float32(1e-12))


@compiled
def _metal_albedo(first, last, radiance, weight, ls0, ls1, level, out):
    """Set ``out`` (3,) to the median of (radiance - ls1) / ls0 over a segment's observations, in [0, 1]."""
    num = radiance.shape[1]
    ratio = np.empty((last - first) * num, np.float32)
    for channel in range(3):
        found = 0
        for point in range(first, last):
            for o in range(num):
                if weight[point, o] > 0 and ls0[point, o, level, channel] > 1e-6:
                    ratio[found] = (radiance[point, o, channel] - ls1[point, o, level, channel]) / ls0[
                        point, o, level, channel
                    ]
                    found += 1
        out[channel] = min(max(np.median(ratio[:found]), 0), 1) if found else 0


@compiled
def _costs(start, radiance, weight, diffuse, ls0, ls1, exposure, levels, speculars):
    num = len(start) - 1
    dielectric = np.zeros((num, len(levels), len(speculars)), np.float32)
    metal, colour = np.zeros((num, len(levels)), np.float32), np.zeros((num, len(levels), 3), np.float32)
    target = np.empty_like(radiance)
    for p in range(radiance.shape[0]):
        for o in range(radiance.shape[1]):
            for c in range(3):
                target[p, o, c] = _encoded(radiance[p, o, c], exposure)
    for g in range(num):
        first, last = start[g], start[g + 1]
        for level in range(len(levels)):
            for k, s in enumerate(speculars):
                dielectric[g, level, k] = _cost(
                    first, last, radiance, target, weight, diffuse, ls0, ls1, level, s, False, exposure
                )
            _metal_albedo(first, last, radiance, weight, ls0, ls1, level, colour[g, level])
            metal[g, level] = _cost(
                first, last, radiance, target, weight, diffuse, ls0, ls1, level, np.float32(0), True, exposure
            )
    return dielectric, metal, colour

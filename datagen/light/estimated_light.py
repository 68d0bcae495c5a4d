# SPDX-License-Identifier: MIT
"""Fit of the gains of estimated light to the surfaces that it illuminates.

Rays that leave the room in unphotographed directions, or that hit unphotographed surfaces, have estimated
radiance. Estimates of similar position and direction form K groups with one unknown gain each. The irradiance
of surfel i is E_i + sum_k g_k F_ik, with E_i its known part and F_ik the estimate of group k. The albedo in a
smooth region r is nearly constant. With residuals e_i = ln L_i - ln(E_i + sum_k g_k F_ik), ln g minimises

    sum_i huber(e_i - mean of e in r(i)) / SURFELS_PER_SAMPLE + PRIOR |ln g - mean|^2 + MEAN_PRIOR K mean^2

by Gauss-Newton steps, with one mean of ln g for groups outside the room and one for groups inside. Texture
acts as noise: it is uncorrelated with the light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import luminance
from datagen.light.background import FAR, NEAR, Background, Layout
from datagen.light.bake import Baker
from datagen.light.cells import side_of
from datagen.light.surfels import NUM_SIDES, Surfels

MAX_SURFELS, RAYS = 16_000, 96
"""Approximate maximum number of surfels used in the fit, and number of rays per surfel."""
ROOM_PARTS = 5
"""Number of parts of the room along its longest axis; surfaces with the same part and side share a gain."""
MIN_SHARE, MAX_GROUPS = 0.002, 96
"""Minimum mean share of the surfels' irradiance that a group with a fitted gain contributes, and maximum
number of such groups."""
SURFELS_PER_SAMPLE = 10.0
"""Number of neighbouring surfels that count as one sample, since their errors are correlated."""
PRIOR, MEAN_PRIOR, REGION_PRIOR = 1.0, 0.05, 0.5
"""Strengths, in samples, of the priors that a gain equals the mean of its kind (outside or inside), that this
mean is 1, and that a region's albedo equals the room's."""
MAX_LOG_GAIN = 2.5
HIDDEN_GAIN = 4.0
"""Gain above which an estimate is attributed to an unphotographed lamp."""
MAX_REFLECTED = 1.1
"""Maximum ratio of radiance to Ld of a white surface, including noise."""
_HUBER = 0.25  # threshold, in ln L
_STEPS, _REWEIGHTINGS, _MAX_STEP = 8, 5, 1.0
_MIN_REST = 0.02  # minimum known share of the irradiance: separately sampled parts may exceed the whole
NUM_OUTSIDE = max(layout.num_gains for layout in (NEAR, FAR))
NUM_GROUPS = NUM_OUTSIDE + (ROOM_PARTS + 2) ** 3 * NUM_SIDES


@dataclass(frozen=True)
class EstimateGains:
    """Gains of estimated light.

    ``of_group`` (:data:`NUM_GROUPS`,): gain of each group, 1 if undetermined. ``hidden`` (N,): share of the
    surfels' irradiance from groups with gains above :data:`HIDDEN_GAIN`, averaged by region; at least the
    share of the room's surfels that reflect more than their incident light before gains are applied.
    """

    of_group: NDArray[np.float64]
    hidden: NDArray[np.float64]


def background_groups(layout: Layout) -> NDArray[np.int64]:
    """Index (B,), less than :data:`NUM_OUTSIDE`, of the gain group of each bin of ``layout``."""
    shape = layout.faces, layout.places, layout.places, layout.heights, layout.azimuths
    places, heights, azimuths = layout.gain_blocks
    blocks = layout.faces, places, places, heights, azimuths
    bins = np.unravel_index(np.arange(layout.num_bins), shape)
    return np.ravel_multi_index(
        [axis // (num // of) for axis, num, of in zip(bins, shape, blocks, strict=True)], blocks
    )


def surface_groups(position_m: NDArray, normal: NDArray, surfels: Surfels) -> NDArray[np.int64]:
    """Gain groups (N,), at least :data:`NUM_OUTSIDE`, of surface positions (N, 3) with normals (N, 3)."""
    grid = surfels.grid
    side_m = grid.cell_m * float(grid.shape.max()) / ROOM_PARTS
    part = np.floor((position_m - grid.low) / side_m).astype(np.int64)
    x, y, z = (np.clip(part, -1, ROOM_PARTS) + 1).T  # the outermost parts extend beyond the grid
    across = ROOM_PARTS + 2
    return NUM_OUTSIDE + ((x * across + y) * across + z) * NUM_SIDES + side_of(normal)


def fitted_gains(baker: Baker, surfels: Surfels, region: NDArray, sunlight: NDArray) -> EstimateGains:
    """Fit the gains of the groups that contribute most; other gains are 1.

    ``region`` (N,) is the index of each surfel's smooth region, and ``sunlight`` (N, 3) the diffuse shading
    by the sun, which is not part of the field of ``baker``.
    """
    step = max(1, len(surfels) // MAX_SURFELS)
    position, normal = surfels.position_m[::step], surfels.normal[::step]
    whole = luminance(baker.irradiance(position, normal, RAYS).diffuse.astype(np.float64))
    whole += luminance(sunlight[::step].astype(np.float64))
    estimated = baker.field.estimated(baker.cosine_rays(position, normal, RAYS, seed=3))
    group = np.where(
        estimated.background_bin >= 0,
        background_groups(baker.field.background.layout)[estimated.background_bin],
        surface_groups(estimated.position_m, estimated.normal, surfels),
    )
    surfel = estimated.ray // RAYS
    part = luminance(estimated.radiance.astype(np.float64)) / RAYS
    share = np.bincount(group, part / np.maximum(whole[surfel], 1e-12), NUM_GROUPS) / len(position)
    fitted = np.argsort(-share, kind="stable")[:MAX_GROUPS]
    fitted = fitted[share[fitted] > MIN_SHARE]
    found = EstimateGains(np.ones(NUM_GROUPS), np.zeros(len(surfels)))
    radiance = luminance(surfels.radiance[::step].astype(np.float64))
    is_lit = (whole > 0) & (radiance > 0)
    if not len(fitted) or not is_lit.any():
        return found
    column = np.full(NUM_GROUPS, -1)
    column[fitted] = np.arange(len(fitted))
    chosen = column[group] >= 0
    shape = (len(position), len(fitted))
    cell = surfel[chosen] * shape[1] + column[group[chosen]]
    parts = np.bincount(cell, part[chosen], shape[0] * shape[1]).reshape(shape)[is_lit]
    rest = np.maximum(whole[is_lit] - parts.sum(axis=1), _MIN_REST * whole[is_lit])
    lit_region = region[::step][is_lit]
    gains = solve_gains(np.log(radiance[is_lit]), rest, parts, lit_region, fitted < NUM_OUTSIDE)
    found.of_group[fitted] = gains
    scaled = parts * gains
    hidden = scaled[:, gains > HIDDEN_GAIN].sum(axis=1) / (rest + scaled.sum(axis=1))
    too_bright = float((radiance > MAX_REFLECTED * whole)[is_lit].mean())
    num_regions = int(region.max()) + 1
    count, total = np.bincount(lit_region, None, num_regions), np.bincount(lit_region, hidden, num_regions)
    of_region = np.where(count > 0, total / np.maximum(count, 1), hidden.mean())
    return replace(found, hidden=np.maximum(of_region[region], too_bright))


def solve_gains(
    log_radiance: NDArray, rest: NDArray, parts: NDArray, region: NDArray, is_outside: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Gains (K,) of the estimated ``parts`` (N, K) of the irradiance, whose known part is ``rest`` (N,).

    ``log_radiance`` (N,): ln L of each surfel; ``region`` (N,): index of its smooth region; ``is_outside``
    (K,): mask of the groups outside the room.
    """
    num_groups = parts.shape[1]
    region = np.unique(region, return_inverse=True)[1]
    is_alike = is_outside[:, None] == is_outside[None, :]
    mean_of_kind = is_alike / is_alike.sum(axis=1, keepdims=True)
    prior = PRIOR * (np.eye(num_groups) - mean_of_kind) + MEAN_PRIOR * mean_of_kind
    log_gain = np.zeros(num_groups)
    for _ in range(_STEPS):
        scaled = parts * np.exp(log_gain)
        irradiance = rest + scaled.sum(axis=1)
        residual = log_radiance - np.log(irradiance)
        rows = np.concatenate([residual[:, None], -scaled / irradiance[:, None]], axis=1)
        weight = _robust_weights(residual, region)
        rows -= _region_means(rows, region, weight)
        error, slope = rows[:, 0], rows[:, 1:] * weight[:, None]
        change = np.linalg.solve(slope.T @ rows[:, 1:] + prior, -slope.T @ error - prior @ log_gain)
        log_gain = np.clip(log_gain + np.clip(change, -_MAX_STEP, _MAX_STEP), -MAX_LOG_GAIN, MAX_LOG_GAIN)
    return np.exp(log_gain)


def _robust_weights(residual: NDArray, region: NDArray) -> NDArray[np.float64]:
    """Huber weights (N,), in samples, of residuals (N,) relative to the mean of their region."""
    weight = np.ones(len(residual))
    for _ in range(_REWEIGHTINGS):
        mean = np.bincount(region, weight * residual) / np.bincount(region, weight)
        weight = 1 / np.maximum(1, np.abs(residual - mean[region]) / _HUBER)
    return weight / SURFELS_PER_SAMPLE


def _region_means(rows: NDArray, region: NDArray, weight: NDArray) -> NDArray[np.float64]:
    """Weighted means (N, J) of ``rows`` (N, J) over each row's region, shrunk towards the overall mean."""
    total = np.bincount(region, weight)
    means = np.stack([np.bincount(region, weight * column) / total for column in rows.T], axis=1)
    own = (total / (total + REGION_PRIOR))[:, None]
    return (own * means + (1 - own) * (weight @ rows / weight.sum()))[region]


def with_gains(background: Background, gains: NDArray) -> Background:
    """Multiply the estimated, not the photographed, radiance of ``background`` by its groups' ``gains``."""
    is_estimated = background.is_known & ~background.is_photographed
    factor = np.where(is_estimated, gains[background_groups(background.layout)], 1.0)[:, None]
    return replace(background, radiance=(background.radiance * factor).astype(np.float32))

# SPDX-License-Identifier: MIT
"""Estimates the albedo scale from interreflection in a photographed room.

Networks confuse a grey wall in a bright room with a white one in a dim room. Photographs of a whole room
record the radiance L that leaves its surfaces, so rays from a point x determine its irradiance E(x) and
reflectance (inverse global illumination, Yu et al. 1999):

    rho(x) = pi L(x) / E(x),   about D + S on a rough surface,

independent of the exposure. Where unphotographed light arrives (lamps behind the camera, sun through a
window), rho is too large; D is therefore corrected per smooth region of the mesh, by the mode of ln(rho / (D
+ S)) over the region's points, shrunk to the room's mode for regions with few points. Variation of D within a
region remains as predicted. Measurements: docs/measurements.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.foundation.progress import Advance, no_advance
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from datagen.multiview.visibility import vectors_from_rows
from model.reconstruction.level.radiance_cache import Floats, RadianceCache

NUM_POINTS, NUM_RAYS = 4096, 400
"""Number of points, almost evenly distributed over photographed surfaces, and of rays per point (a square
number)."""
FULL_COVERAGE, NO_COVERAGE = 0.9, 0.6
"""Range of the cosine-weighted known share of a point's hemisphere over which its weight decreases from 1 to
0."""
LITTLE_DOUBT, NO_DOUBT = 0.15, 0.6
"""Range of the uncertain share of a point's light over which its weight decreases from 1 to 0."""
MIN_POINTS, MIN_USED = 200, 0.3
"""Minimum number of points, and minimum of their mean weight, for a correction."""
EXCESS, MAX_SPREAD, MAX_IMPOSSIBLE = (0.035, 0.045), 0.6, 0.2
"""Range of ``spread`` x ``impossible_share`` (:class:`LevelReport`) over which increases of D fade to none,
and maxima of both for any. Unphotographed light and metal taken for a dark dielectric both make reflectance
vary within regions and exceed 1; as both only add to it, decreases of D are always applied."""
_MIN_REFLECTED = 0.02  # minimum D + S for a meaningful ratio
_MIN_RADIANCE = 1e-6  # relative to the median
_POINT_SCALE, _REGION_SCALE, _FREEDOM = 0.2, 0.3, 2.0  # Student's t distributions of ln rho
_ROUNDS = 40
_CHUNK = 512


@dataclass(frozen=True)
class LevelReport:
    """Result and statistics of the estimation of the albedo scale.

    ``gain``: the room's gain of D by channel; ``coverage``: mean known share of the points' hemispheres;
    ``used_share``: mean weight of the points, in [0, 1]; ``spread``: half the interquartile range of ln(rho /
    (D + S)) of points about their region's mode, in green; ``region_spread``: half the interquartile range of
    the regions' ln gains, weighted by points; ``impossible_share``: weighted share of points that reflect
    more than their incident light; ``trust``: the power in [0, 1] of gains above 1 that is applied;
    ``clipped_share``: share of clipped pixels in the photographs; ``reason``: why D is not corrected, or not
    increased, or empty.
    """

    is_applied: bool
    reason: str
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    coverage: float = 0.0
    used_share: float = 0.0
    spread: float = 0.0
    region_spread: float = 0.0
    impossible_share: float = 0.0
    trust: float = 0.0
    points_used: int = 0
    regions_used: int = 0
    clipped_share: float = 0.0


@dataclass(frozen=True)
class AlbedoLevel:
    """RGB ``gains`` (K, 3) of D for the K smooth regions of the mesh, and the report of their estimation."""

    gains: Floats
    report: LevelReport

    def corrected(self, diffuse_albedo: NDArray, region: NDArray) -> NDArray[np.float16]:
        """Multiply D (H, W, 3) by the gains of the pixels' ``region`` (H, W), and clip it to [0, 1]; pixels
        off the mesh (region -1) are unchanged.
        """
        found = diffuse_albedo.astype(np.float16)
        on_mesh = region >= 0
        gained = self.gains[region[on_mesh]] * diffuse_albedo[on_mesh]
        found[on_mesh] = np.clip(gained, 0, 1)
        return found


def find_level(
    views: Sequence[TracedView],
    maps: Sequence[dict[str, NDArray]],
    traced: TracedGeometry,
    region_of_face: NDArray[np.int32],
    clipped_share: float = 0.0,
    doubt_at: Callable[[NDArray, NDArray], NDArray] | None = None,
    progress: Advance = no_advance,
) -> AlbedoLevel:
    """Estimate the albedo scale of the views' ``maps``; gains are 1 if the evidence is insufficient.

    ``region_of_face`` (M,) is each triangle's smooth region; ``doubt_at`` returns the uncertain luminance
    (N,) of diffuse shading at positions and normals (N, 3).
    """
    num_regions = int(region_of_face.max(initial=-1)) + 1
    try:
        cache = RadianceCache(views)
    except ValueError as error:
        return _unchanged(num_regions, str(error), clipped_share=clipped_share)
    points = _draw_points(cache, views, maps, region_of_face)
    irradiance, coverage = _irradiance(cache, traced, points.position_m, points.normal, progress)
    sure = np.ones(len(coverage))
    if doubt_at is not None:
        arriving = irradiance @ LUMINANCE_WEIGHTS / np.maximum(coverage, 1e-3)
        unsure = np.pi * doubt_at(points.position_m, points.normal) / np.maximum(arriving, 1e-300)
        sure = np.clip((NO_DOUBT - unsure) / (NO_DOUBT - LITTLE_DOUBT), 0, 1)
    return fit_level(points, irradiance, coverage, num_regions, clipped_share, sure)


def fit_level(
    points: Points,
    irradiance: Floats,
    coverage: Floats,
    num_regions: int,
    clipped_share: float,
    sure: Floats | float = 1.0,
) -> AlbedoLevel:
    """Fit gains to the ``irradiance`` (N, 3) of points from known directions, which cover the cosine-weighted
    share ``coverage`` (N,) of the hemisphere. ``sure`` (N,) in [0, 1] is a further weight of the points.
    """
    # unknown directions are assumed to have the mean radiance of known ones
    arriving = irradiance / np.maximum(coverage, 1e-3)[:, None]
    weight = np.clip((coverage - NO_COVERAGE) / (FULL_COVERAGE - NO_COVERAGE), 0, 1) * sure
    leaving = points.radiance @ LUMINANCE_WEIGHTS
    weight[(arriving @ LUMINANCE_WEIGHTS <= 0) | (leaving <= _MIN_RADIANCE * np.median(leaving))] = 0
    used = weight > 0
    found: dict[str, Any] = {
        "coverage": float(coverage.mean()) if len(coverage) else 0.0,
        "used_share": float(weight.mean()) if len(weight) else 0.0,
        "points_used": int(used.sum()),
        "clipped_share": clipped_share,
    }
    if used.sum() < MIN_POINTS or found["used_share"] < MIN_USED:
        return _unchanged(num_regions, "the photographs show too little of the light on surfaces", **found)
    regions, region = np.unique(points.region[used], return_inverse=True)
    rho = np.pi * points.radiance / np.maximum(arriving, 1e-300)
    excess = (points.radiance * np.pi - arriving) @ LUMINANCE_WEIGHTS > 0
    found["impossible_share"] = float(weight[excess].sum() / weight.sum())
    wanted = np.log(np.maximum(rho[used], 1e-6)) - np.log(np.maximum(points.reflected[used], _MIN_REFLECTED))
    gains, rest = np.ones((num_regions, 3)), np.zeros_like(wanted)
    rooms = np.zeros(3)
    for channel in range(3):
        rooms[channel], own = _modes(wanted[:, channel], weight[used], region, len(regions))
        gains[:, channel] = np.exp(rooms[channel])
        gains[regions, channel] = np.exp(own)
        rest[:, channel] = wanted[:, channel] - own[region]
    green = 1  # green dominates luminance
    found |= {
        "spread": 0.5 * interquartile_range(rest[:, green], weight[used]),
        "region_spread": 0.5 * interquartile_range(np.log(gains[regions, green])[region], weight[used]),
        "regions_used": len(regions),
    }
    gain = (float(np.exp(rooms[0])), float(np.exp(rooms[1])), float(np.exp(rooms[2])))
    excess_spread = found["spread"] * found["impossible_share"]
    trust = float(np.clip((EXCESS[1] - excess_spread) / (EXCESS[1] - EXCESS[0]), 0, 1))
    reason = ""
    if found["spread"] > MAX_SPREAD:
        trust, reason = 0.0, "reflectance varies too much within surfaces"
    elif found["impossible_share"] > MAX_IMPOSSIBLE or trust == 0:
        trust, reason = 0.0, "light that no photograph shows falls on too much of the room"
    gains = np.where(gains > 1, gains**trust, gains)
    return AlbedoLevel(gains, LevelReport(bool((gains != 1).any()), reason, gain=gain, trust=trust, **found))


def clipped_share(views: Sequence[TracedView]) -> float:
    """Compute the share of the pixels of all photographs in which a channel is clipped."""
    masks = [view.clipped_mask for view in views if view.clipped_mask is not None]
    return sum(int(mask.any(axis=2).sum()) for mask in masks) / max(
        sum(view.valid_mask.size for view in views), 1
    )


def _unchanged(num_regions: int, reason: str, **found: Any) -> AlbedoLevel:
    return AlbedoLevel(np.ones((num_regions, 3)), LevelReport(False, reason, **found))


@dataclass(frozen=True)
class Points:
    """N points on surfaces: position, normal, radiance and predicted D + S (N, 3), and smooth region (N,)."""

    position_m: Floats
    normal: Floats
    radiance: Floats
    reflected: Floats
    region: NDArray[np.int64]


def _draw_points(
    cache: RadianceCache,
    views: Sequence[TracedView],
    maps: Sequence[dict[str, NDArray]],
    region_of_face: NDArray[np.int32],
) -> Points:
    """Draw at most one pixel per cube, so that points are distributed by area, not by number of views."""
    pixels, random = cache.pixels, np.random.default_rng(0)
    is_surface = np.zeros(len(pixels.view), dtype=bool)
    for index, view in enumerate(views):
        of_view = pixels.view == index
        is_surface[of_view] = view.geometry.surface_mask.ravel()[pixels.pixel[of_view]] > 0
    order = random.permutation(np.flatnonzero(is_surface))
    order = order[np.unique(pixels.cube[order], return_index=True)[1]]
    chosen = np.sort(random.permutation(order)[:NUM_POINTS])
    reflected, region = np.zeros((len(chosen), 3)), np.zeros(len(chosen), np.int64)
    for index, (view, view_maps) in enumerate(zip(views, maps, strict=True)):
        here = np.flatnonzero(pixels.view[chosen] == index)
        at = pixels.pixel[chosen[here]]
        for name in ("diffuse_albedo", "specular_albedo"):
            reflected[here] += view_maps[name].reshape(-1, 3)[at]
        region[here] = region_of_face[view.geometry.face.ravel()[at]]
    position, normal = pixels.position_m[chosen], pixels.normal[chosen]
    return Points(position, normal, cache.at(position, normal)[0], reflected, region)


def _irradiance(
    cache: RadianceCache,
    traced: TracedGeometry,
    position_m: Floats,
    normal: Floats,
    progress: Advance,
) -> tuple[Floats, Floats]:
    """Compute the irradiance (N, 3) of points from directions of known radiance, and the cosine-weighted
    share (N,) of these directions in the hemisphere.
    """
    random = np.random.default_rng(1)
    irradiance, coverage = np.zeros_like(position_m), np.zeros(len(position_m))
    for first in range(0, len(position_m), _CHUNK):
        part = slice(first, first + _CHUNK)
        direction = cosine_rays(normal[part], random)
        start = np.repeat(position_m[part] + normal[part] * (2e-4 * cache.size_m), NUM_RAYS, axis=0)
        distance, facing = _first_hits(traced, start, direction)
        hit = np.isfinite(distance)
        radiance, is_known = np.zeros_like(direction), np.zeros(len(direction), dtype=bool)
        place = start[hit] + direction[hit] * distance[hit, None]
        radiance[hit], is_known[hit] = cache.at(place, facing[hit])
        radiance[~hit], is_known[~hit] = cache.beyond(start[~hit], direction[~hit])
        irradiance[part] = np.pi * radiance.reshape(-1, NUM_RAYS, 3).mean(axis=1)
        coverage[part] = is_known.reshape(-1, NUM_RAYS).mean(axis=1)
        progress(min(part.stop, len(position_m)), len(position_m))
    return irradiance, coverage


def cosine_rays(normal: Floats, random: np.random.Generator) -> Floats:
    """Sample stratified, cosine-distributed directions (N * NUM_RAYS, 3) about ``normal`` (N, 3)."""
    side = int(np.sqrt(NUM_RAYS))
    cell = np.arange(NUM_RAYS)
    u = (cell // side + random.random((len(normal), NUM_RAYS))) / side
    v = (cell % side + random.random((len(normal), NUM_RAYS))) / side
    radius, angle = np.sqrt(u), 2 * np.pi * v
    helper = np.where(np.abs(normal[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(normal, helper)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    bitangent = np.cross(normal, tangent)
    rays = (
        (radius * np.cos(angle))[..., None] * tangent[:, None]
        + (radius * np.sin(angle))[..., None] * bitangent[:, None]
        + np.sqrt(1 - u)[..., None] * normal[:, None]
    )
    return rays.reshape(-1, 3)


def _first_hits(traced: TracedGeometry, start: Floats, direction: Floats) -> tuple[Floats, Floats]:
    """Return the distance (N,) to each first hit, Inf for misses, and its normal (N, 3) facing the ray."""
    import drjit as dr
    import mitsuba as mi

    ray = mi.Ray3f(mi.Point3f(vectors_from_rows(start)), vectors_from_rows(direction))
    si = traced.scene.ray_intersect(ray)
    is_valid, normal = si.is_valid(), si.n
    dr.eval(si.t, is_valid, normal)
    hit = np.asarray(is_valid.numpy(), dtype=bool)
    facing = np.asarray(normal.numpy(), dtype=np.float64).reshape(3, -1).T
    facing = np.where((facing * direction).sum(axis=1, keepdims=True) > 0, -facing, facing)
    return np.where(hit, np.asarray(si.t.numpy(), dtype=np.float64), np.inf), facing


def _modes(
    values: Floats, weight: Floats, region: NDArray[np.int64], num_regions: int
) -> tuple[float, Floats]:
    """Compute the mode of the room and the modes (num_regions,) of its regions for ``values`` (N,) of points.

    They maximise the likelihood under Student's t of points about their region and of regions about the room.
    """
    num = np.bincount(region, weight, num_regions)
    room = float(weighted_quantiles(values, weight, (0.4,))[0])  # unphotographed light only increases values
    offset = np.zeros(num_regions)
    for _ in range(_ROUNDS):
        of_point = weight * _precision((values - room - offset[region]), _POINT_SCALE)
        of_region = _precision(offset, _REGION_SCALE)
        summed = np.bincount(region, of_point * (values - room), num_regions)
        offset = summed / (np.bincount(region, of_point, num_regions) + of_region)
        shift = float((num * of_region * offset).sum() / (num * of_region).sum())
        room, offset = room + shift, offset - shift
    return room, room + offset


def _precision(residual: Floats, scale: float) -> Floats:
    """Compute the weight of each residual in reweighted least squares for Student's t."""
    return (_FREEDOM + 1) / (_FREEDOM + (residual / scale) ** 2) / scale**2


def weighted_quantiles(values: Floats, weight: Floats, levels: tuple[float, ...]) -> Floats:
    """Compute weighted quantiles (L,) of ``values`` (N,) at ``levels`` in [0, 1]."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return values[order][np.searchsorted(total, np.array(levels) * total[-1])]


def interquartile_range(values: Floats, weight: Floats) -> float:
    """Compute the weighted interquartile range of ``values`` (N,)."""
    low, high = weighted_quantiles(values, weight, (0.25, 0.75))
    return float(high - low)

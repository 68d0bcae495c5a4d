# SPDX-License-Identifier: MIT
"""Estimates the albedo scale from interreflection in a photographed room.

Networks confuse a grey wall in a bright room with a white one in a dim room. Photographs of a whole room
record the radiance L that leaves its surfaces and lamps (:mod:`datagen.light.radiance_field`), so rays from a
point x determine its irradiance E(x) and reflectance (inverse global illumination, Yu et al. 1999):

    rho(x) = pi L(x) / E(x),   about D + S on a rough surface,

independent of the exposure. Where unphotographed light arrives (lamps behind the camera, sun through a
window), rho is too large. D is therefore scaled per smooth region of the mesh by the exponential of the mode,
rather than the mean, of ln(rho / (D + S)) over its points; with few points, the mode is shrunk to the room's.
Variation of D within a region remains as predicted. Measurements: docs/measurements.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.geometry.traced import TracedGeometry, smooth_regions
from datagen.geometry.views import TracedCapture, TracedView
from datagen.light.background import Background, photographed_background
from datagen.light.bake import Baker, Irradiance
from datagen.light.cells import surfel_cells
from datagen.light.emitters import photographed_emitters
from datagen.light.radiance_field import RadianceField
from datagen.light.surfels import CELLS_ACROSS, Surfels, build_surfels, surfel_means
from model.reconstruction.radiometry.completed import clipped_share
from model.reconstruction.stages import DoubtAt, Estimate, Run

Floats = NDArray[np.float64]

NUM_POINTS, NUM_RAYS = 4096, 400
"""Number of points, almost evenly distributed over photographed surfaces, and of rays per point."""
FULL_COVERAGE, NO_COVERAGE = 0.8, 0.4
"""Range of the cosine-weighted photographed share of a point's hemisphere over which its weight decreases
from 1 to 0."""
FULL_WEIGHT_DOUBT, NO_WEIGHT_DOUBT = 0.15, 0.6
"""Range of the uncertain share of a point's irradiance over which its weight decreases from 1 to 0."""
MIN_POINTS, MIN_USED = 200, 0.3
"""Minimum number of points, and minimum of their mean weight, for a correction."""
IMPOSSIBLE, MAX_SPREAD = (0.12, 0.18), 0.6
"""Range of ``impossible_share`` (:class:`LevelReport`) over which increases of D fade to none, and maximum
``spread`` for any increase. Unphotographed light and metal mistaken for a dark dielectric only raise rho, so
decreases of D are always applied."""
_MIN_REFLECTED = 0.02  # minimum D + S for a meaningful ratio
_MIN_RADIANCE = 1e-6  # relative to the median
_POINT_SCALE, _REGION_SCALE, _FREEDOM = 0.2, 0.3, 2.0  # scales and degrees of freedom of Student's t
_ROUNDS = 40


@dataclass(frozen=True)
class LevelReport:
    """Result and statistics of the estimation of the albedo scale.

    ``gain``: the room's gain of D by channel; ``coverage``: mean photographed share of the points'
    hemispheres; ``used_share``: mean weight of the points, in [0, 1]; ``spread``: half the interquartile
    range of ln(rho / (D + S)) of points about their region's mode, in green; ``region_spread``: half the
    interquartile range of the regions' ln gains in green, weighted by points; ``impossible_share``: weighted
    share of points that reflect more than their incident light; ``trust``: power in [0, 1] to which gains
    above 1 are raised; ``clipped_share``: share of clipped pixels in the photographs; ``reason``: why D is
    not corrected or not increased, else empty.
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
    emits: NDArray[np.bool_],
    region_of_face: NDArray[np.int32],
    doubt_at: DoubtAt | None = None,
) -> AlbedoLevel:
    """Estimate the albedo scale of the views' ``maps``; gains are 1 if the evidence is insufficient.

    ``emits`` (M,): mask of triangles known to emit; ``region_of_face`` (M,): smooth region of each triangle;
    ``doubt_at``: see :data:`~model.reconstruction.stages.DoubtAt`.
    """
    num_regions, clipped = int(region_of_face.max(initial=-1)) + 1, clipped_share(views)
    try:
        surfels = build_surfels(views)
    except ValueError as error:
        return _unchanged(num_regions, str(error), clipped_share=clipped)
    grid = surfels.grid
    emitters = photographed_emitters(views, traced, emits, region_of_face)
    background = photographed_background(views, grid.low, grid.high)
    chosen = np.sort(np.random.default_rng(0).permutation(len(surfels))[:NUM_POINTS])
    position, normal = surfels.position_m[chosen], surfels.normal[chosen]

    def irradiance_from(surfels: Surfels, background: Background) -> Irradiance:
        field = RadianceField(traced.scene, surfel_cells(surfels), emitters, background)
        return Baker(field, CELLS_ACROSS * grid.cell_m).irradiance(position, normal, NUM_RAYS)

    lit = irradiance_from(surfels, background)
    no_surfels = replace(surfels, radiance=np.zeros_like(surfels.radiance))
    no_background = replace(background, radiance=np.zeros_like(background.radiance))
    by_lamps = irradiance_from(no_surfels, no_background).diffuse
    # Unknown directions get the mean radiance of known ones, excluding lamps, whose radiance is all known.
    shading = by_lamps + (lit.diffuse - by_lamps) / np.maximum(lit.known, 1e-3)[:, None]
    reflected = surfel_means(surfels, [m["diffuse_albedo"] + m["specular_albedo"] for m in maps])[chosen]
    points = Points(
        surfels.radiance[chosen].astype(np.float64),
        np.pi * shading.astype(np.float64),
        reflected.astype(np.float64),
        region_of_face[surfels.face[chosen]].astype(np.int64),
    )
    certainty = np.ones(len(chosen))
    if doubt_at is not None:
        arriving = np.maximum(points.irradiance @ LUMINANCE_WEIGHTS, 1e-300)
        doubt = np.pi * doubt_at(position, normal) / arriving
        certainty = np.clip((NO_WEIGHT_DOUBT - doubt) / (NO_WEIGHT_DOUBT - FULL_WEIGHT_DOUBT), 0, 1)
    return fit_level(points, lit.photographed.astype(np.float64), num_regions, clipped, certainty)


def fit_level(
    points: Points,
    coverage: Floats,
    num_regions: int,
    clipped_share: float,
    certainty: Floats | float = 1.0,
) -> AlbedoLevel:
    """Fit gains to N points, weighted by the cosine-weighted photographed share ``coverage`` (N,) of their
    hemispheres and by the ``certainty`` (N,) of their irradiance, in [0, 1].
    """
    arriving = points.irradiance
    weight = np.clip((coverage - NO_COVERAGE) / (FULL_COVERAGE - NO_COVERAGE), 0, 1) * certainty
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
    of_room = np.zeros(3)
    for channel in range(3):
        of_room[channel], own = _modes(wanted[:, channel], weight[used], region, len(regions))
        gains[:, channel] = np.exp(of_room[channel])
        gains[regions, channel] = np.exp(own)
        rest[:, channel] = wanted[:, channel] - own[region]
    green = 1  # green dominates luminance
    found |= {
        "spread": 0.5 * interquartile_range(rest[:, green], weight[used]),
        "region_spread": 0.5 * interquartile_range(np.log(gains[regions, green])[region], weight[used]),
        "regions_used": len(regions),
    }
    gain = (float(np.exp(of_room[0])), float(np.exp(of_room[1])), float(np.exp(of_room[2])))
    low, high = IMPOSSIBLE
    trust = float(np.clip((high - found["impossible_share"]) / (high - low), 0, 1))
    reason = ""
    if found["spread"] > MAX_SPREAD:
        trust, reason = 0.0, "reflectance varies too much within surfaces"
    elif trust == 0:
        reason = "light that no photograph shows falls on too much of the room"
    gains = np.where(gains > 1, gains**trust, gains)
    return AlbedoLevel(gains, LevelReport(bool((gains != 1).any()), reason, gain=gain, trust=trust, **found))


def _unchanged(num_regions: int, reason: str, **found: Any) -> AlbedoLevel:
    return AlbedoLevel(np.ones((num_regions, 3)), LevelReport(False, reason, **found))


@dataclass(frozen=True)
class Points:
    """N points on surfaces: radiance, irradiance and predicted D + S, (N, 3) each, and smooth region (N,)."""

    radiance: Floats
    irradiance: Floats
    reflected: Floats
    region: NDArray[np.int64]


def _modes(
    values: Floats, weight: Floats, region: NDArray[np.int64], num_regions: int
) -> tuple[float, Floats]:
    """Compute the modes of ``values`` (N,) over the room and over each of its regions (num_regions,).

    They maximise the Student's t likelihood of points about their region and of regions about the room.
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


def leveled(traced: TracedCapture, estimate: Estimate, run: Run) -> Estimate:
    """Correct the albedo scale of the maps unless evidence is weak; maps on disk remain as predicted."""
    with run.stage("level"):
        views, geometry = traced.views, traced.geometry
        is_lamp, region_of_face = traced.capture.geometry.emitter_mask(), smooth_regions(geometry.mesh)
        level = find_level(views, estimate.maps, geometry, is_lamp, region_of_face, estimate.doubt_at)
        run.report.albedo_level = asdict(level.report)
        if level.report.reason:
            change = "increased" if level.report.is_applied else "corrected"
            run.report.notes.append(f"the albedo scale is not {change}: {level.report.reason}")
        if not level.report.is_applied:
            return estimate
        corrected = []
        for view_maps, view in zip(estimate.maps, traced.views, strict=True):
            face = view.geometry.face
            region = np.where(face >= 0, region_of_face[np.maximum(face, 0)], -1)
            albedo = level.corrected(view_maps["diffuse_albedo"], region)
            corrected.append({**view_maps, "diffuse_albedo": albedo})
        return replace(estimate, maps=corrected)

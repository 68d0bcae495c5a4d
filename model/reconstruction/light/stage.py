# SPDX-License-Identifier: MIT
"""The stage between prediction and merge that recovers material maps of the views from their recorded light.

Surfels and their radiance field are gathered (``lighting``) and divided into segments, whose S and R are
solved (``points``, ``solve``). A second round computes the light with less noise, reflections at metals and
the mean outgoing radiance of dielectrics, and solves again if there is metal. Then the specular part of every
observation is computed, shading is corrected where light is not photographed (``shading_correction``), and
maps (``view_maps``) are computed and blended with the network's by ``confidence``. See docs/light.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.peak_memory import num_threads
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from datagen.light.edge_pixels import unmixed
from datagen.light.emitters import Emitters
from datagen.light.lighting import Lit, clipped_surfels, light_surfels, relight, smoothed
from datagen.light.surfels import Surfels, camera_row, surfel_means, weighted_medians
from model.reconstruction.light.confidence import (
    METAL_TRUST,
    impossible_shares,
    light_certainty,
    normal_spread,
    surfel_confidence,
    trust_in_hidden,
    trust_in_normals,
)
from model.reconstruction.light.options import LightOptions, LightReport
from model.reconstruction.light.points import (
    SPECULAR_RAYS,
    Segmentation,
    choose_points,
    outgoing_radiance,
    segment_surfels,
    shade_points,
    solve_points,
)
from model.reconstruction.light.shading_correction import network_scale, shading_correction
from model.reconstruction.light.solve import MAX_ALBEDO, SolvedSegments, shared_roughness
from model.reconstruction.light.unseen_lamps import UnseenLamps, unseen_lamps
from model.reconstruction.light.view_maps import (
    SolvedSurfels,
    White,
    packed_maps,
    textured_specular_albedo,
    view_materials,
    white_paint,
    without_sunlit_edges,
)

_SEED = 99  # for the specular parts; differs from the solver's seeds


@dataclass(frozen=True)
class LightMaterials:
    """Results of the light stage.

    ``maps``: D, S, R and ``confidence`` (H, W, 3) of each view by name; ``lit``: the surfels and their light;
    ``solved``, ``albedo`` (N, 3) and ``segment`` (N,): materials, diffuse albedo and segments of the surfels.
    """

    maps: list[dict[str, NDArray]]
    report: LightReport
    lit: Lit
    solved: SolvedSurfels
    albedo: NDArray[np.float32]
    segment: NDArray[np.int32]


def materials_from_light(
    views: Sequence[TracedView],
    maps: Sequence[dict[str, NDArray]],
    traced: TracedGeometry,
    emits: NDArray[np.bool_],
    region_of_face: NDArray[np.int32],
    exposure: float,
    options: LightOptions | None = None,
    doubt_at: Callable[[NDArray, NDArray], NDArray] | None = None,
    report: LightReport | None = None,
) -> LightMaterials:
    """Recover the materials of ``views`` from their recorded light, independently of the order of the views.

    ``maps`` are the network's; ``emits`` (M,) is the mask of triangles known to emit; ``region_of_face`` (M,)
    is the smooth region of each triangle; ``exposure`` is the factor that scales bright surfaces to 0.9;
    ``doubt_at`` returns the uncertain luminance (N,) of the diffuse shading at positions and normals (N, 3).
    Raises :class:`InputError` if the views show no extended surface.
    """
    options, report = options or LightOptions(), report or LightReport()
    order = sorted(range(len(views)), key=lambda index: camera_row(views[index]).tobytes())
    ordered, predicted = [views[index] for index in order], [maps[index] for index in order]
    lamps: UnseenLamps | None = None
    if options.unmixes_edges:
        with report.step("edges"):
            ordered = unmixed(ordered, traced, emits, region_of_face)

    def completed(dark: Lit) -> Emitters:
        nonlocal lamps
        predicted_albedo = surfel_means(dark.surfels, [m["diffuse_albedo"] for m in predicted])
        lamps = unseen_lamps(dark, traced.mesh, region_of_face[dark.surfels.face], predicted_albedo)
        return lamps.emitters

    lit = light_surfels(ordered, traced, emits, region_of_face, options, report.step, completed)
    surfels = lit.surfels
    report.num_surfels, report.num_observations = len(surfels), len(surfels.observations.view)
    report.photographed_share = float(lit.irradiance.photographed.mean())
    region = region_of_face[surfels.face]
    with report.step("segments"):
        prior = surfel_means(surfels, [packed_maps(view_maps) for view_maps in predicted])
        reflectance = surfels.radiance / np.maximum(lit.diffuse, 1e-12)
        segment = segment_surfels(region, reflectance, prior[:, 3:6], prior[:, 6])
        segmentation = Segmentation(segment, region, prior)
        points = choose_points(surfels, segment, lit.irradiance.known, options)
    with report.step("solve"):
        shading = shade_points(lit, points, options)
        segments = solve_points(lit, points, shading, segmentation, exposure, options)
    if options.num_rounds > 1:
        with report.step("second round"):
            surfel_materials = (
                segments.specular_albedo[segment],
                segments.roughness[segment],
                segments.is_metal[segment],
            )
            _, specular = _specular_parts(lit, segments, segment, SPECULAR_RAYS)
            radiance = outgoing_radiance(lit, specular, *surfel_materials)
            lit = relight(lit, *surfel_materials, *radiance, options)
            if segments.is_metal.any():
                shading = shade_points(lit, points, options)
                segments = solve_points(lit, points, shading, segmentation, exposure, options)
    report.num_segments, report.num_metal = len(segments.roughness), int(segments.is_metal.sum())
    with report.step("specular"):
        specular_albedo, specular = _specular_parts(lit, segments, segment, options.specular_rays)
    with report.step("correction"):
        certainty = np.ones(len(surfels))
        if doubt_at is not None:
            noisy = doubt_at(surfels.position_m, surfels.normal)[:, None]
            doubt = smoothed(surfels, noisy, options.smoothing_neighbours)
            certainty = light_certainty(doubt[:, 0], lit.diffuse, region)
        inferred = lamps.share(lit, region) if lamps is not None else np.zeros(len(surfels))
        solved, albedo = _solved_surfels(
            lit, segments, segmentation, specular_albedo, specular, certainty, inferred, options
        )
    with report.step("maps"):
        with ThreadPoolExecutor(num_threads()) as pool:
            made = list(
                pool.map(partial(view_materials, surfels, solved), range(len(views)), ordered, predicted)
            )
        if lit.sun is not None:
            made = without_sunlit_edges(made, lit, region, clipped_surfels(ordered, surfels))
        found: list[dict[str, NDArray]] = [{} for _ in views]
        for index, view_maps in zip(order, made, strict=True):
            found[index] = dict(view_maps)
        report.confidence = tuple(float(v) for v in solved.confidence.mean(axis=0))
    return LightMaterials(found, report, lit, solved, albedo, segment)


def _specular_parts(
    lit: Lit, segments: SolvedSegments, segment: NDArray, num_rays: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute S (N, 3) of surfels, and the specular part (M, 3) of observations, ``num_rays`` rays each."""
    surfels = lit.surfels
    owner = surfels.surfel_of_observation()
    roughness = segments.roughness[segment]
    shading = lit.baker.specular(
        surfels.position_m[owner],
        surfels.observations.normal,
        surfels.directions(owner, surfels.observations.view),
        roughness[owner],
        num_rays,
        _SEED,
    ).extrapolated()
    s = segments.specular_albedo[segment]
    s = textured_specular_albedo(surfels, s, roughness, segments.is_metal[segment], shading)
    return s, (s[owner] * shading.ls0 + shading.ls1).astype(np.float32)


def _solved_surfels(
    lit: Lit,
    segments: SolvedSegments,
    segmentation: Segmentation,
    s: NDArray[np.float32],
    specular: NDArray[np.float32],
    certainty: NDArray,
    inferred: NDArray,
    options: LightOptions,
) -> tuple[SolvedSurfels, NDArray[np.float32]]:
    """Compute the surfels' shading and materials for the views' maps, and their diffuse albedo (N, 3)."""
    surfels, segment = lit.surfels, segmentation.segment
    weight = np.bincount(segment, np.diff(surfels.observations.start))
    shared, r_confidence = shared_roughness(segments, segmentation.region_of_segment(), weight)
    r = shared[segment]
    is_metal = segments.is_metal[segment]
    albedo = surfel_albedo(surfels, lit.diffuse, specular, s, is_metal)
    if not options.has_prior:
        ones = np.ones_like(albedo)
        return SolvedSurfels(lit.diffuse, specular, s, r, is_metal, ones, ones[:, 0], ones, White()), albedo
    confidence = surfel_confidence(lit.irradiance.photographed, segments.is_mirror[segment])
    is_lit = lit.diffuse.max(axis=1) > 0  # elsewhere, light does not determine the albedo
    impossible = impossible_shares(surfels, lit.diffuse, is_metal, segmentation.region)
    of_segment = np.column_stack([segments.confidence[:, :2], r_confidence])[segment]
    trust = impossible.trust() * trust_in_hidden(lit.hidden, inferred) * is_lit
    trust = certainty * np.maximum(trust, METAL_TRUST * is_metal)
    confidence *= trust[:, None] * of_segment
    replaced = trust * of_segment[:, 0]
    confidence[:, 0] *= impossible.evidence()
    confidence[:, 2] *= trust_in_normals(normal_spread(surfels))
    diffuse, prior_scale = lit.diffuse, np.ones_like(albedo)
    if options.is_corrected:
        predicted, is_diffuse = segmentation.prior[:, :3], is_lit & ~is_metal
        scale = network_scale(albedo, predicted, confidence[:, 0] * is_diffuse)
        # scales only where the light is trusted but no hypothesis explains the observations
        unexplained = np.clip((trust - replaced) / np.maximum(1 - replaced, 1e-6), 0, 1)[:, None]
        prior_scale = 1 + unexplained * (scale - 1)
        correction = shading_correction(
            surfels,
            segmentation.region,
            albedo,
            predicted,
            confidence[:, 0],
            lit.irradiance.photographed * trust,
            is_diffuse,
        )
        albedo = np.minimum(albedo * np.exp(correction), MAX_ALBEDO)
        diffuse = lit.diffuse * np.exp(-correction)
    white = white_paint(albedo, confidence[:, 0])
    return SolvedSurfels(diffuse, specular, s, r, is_metal, confidence, replaced, prior_scale, white), albedo


def surfel_albedo(
    surfels: Surfels, diffuse: NDArray, specular: NDArray, specular_albedo: NDArray, is_metal: NDArray
) -> NDArray[np.float32]:
    """Compute D (N, 3) of surfels, 0 for metals: the weighted median over observations of (radiance -
    ``specular``) / ((1 - S) ``diffuse``); ``specular`` is (M, 3), ``specular_albedo`` and ``diffuse`` (N, 3).
    """
    observations = surfels.observations
    owner = surfels.surfel_of_observation()
    rest = (observations.radiance - specular) / np.maximum(
        (1 - specular_albedo[owner]) * diffuse[owner], 1e-12
    )
    albedo = np.clip(
        weighted_medians(observations.start, rest.astype(np.float32), observations.weight), 0, MAX_ALBEDO
    )
    return np.where(is_metal[:, None], 0.0, albedo).astype(np.float32)

# SPDX-License-Identifier: MIT
"""The stage between prediction and merge: maps of the views out of the light that their photographs record.

Surfels and where rays end (``lighting``) → segments → S and R of segments (``points``, ``solve``) → specular
part of every observation → D of every pixel (``view_maps``), mixed with the network's maps by ``confidence``.
docs/light.md explains them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.reconstruction.geometry.traced import TracedGeometry
from model.reconstruction.geometry.views import TracedView
from model.reconstruction.light.confidence import (
    impossible_share,
    propagated_gain,
    surfel_confidence,
    trust_of,
)
from model.reconstruction.light.lighting import MIN_KNOWN, Lit, light_surfels
from model.reconstruction.light.options import LightOptions, LightReport
from model.reconstruction.light.points import Segmentation, choose_points, shade_points, solve_points
from model.reconstruction.light.segments import segment_surfels
from model.reconstruction.light.solve import MAX_ALBEDO, SolvedSegments
from model.reconstruction.light.surfels import Surfels, camera_row, surfel_means, weighted_medians
from model.reconstruction.light.view_maps import SolvedSurfels, view_materials

_SEED = 99  # of the specular part of all observations: other samples than the solve's


@dataclass(frozen=True)
class LightMaterials:
    """``maps`` of the views with their ``confidence`` (H, W, 3) of D, S and R; the surfels, their light and
    what was found for them: ``solved``, ``albedo`` (N, 3), ``segment`` (N,)."""

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
) -> LightMaterials:
    """Materials of ``views`` in the light that they record; ``maps`` are the network's, ``emits`` (M,) the
    triangles that are known to emit, ``exposure`` brings the bright surfaces to 0.9.

    The result does not depend on the order of the views. Raises ValueError where the views see no extended
    surface.
    """
    options, report = options or LightOptions(), LightReport()
    order = sorted(range(len(views)), key=lambda index: camera_row(views[index]).tobytes())
    ordered, predicted = [views[index] for index in order], [maps[index] for index in order]
    lit = light_surfels(ordered, traced, emits, region_of_face, options, report)
    surfels = lit.surfels
    region = region_of_face[surfels.face]
    with report.step("segments"):
        prior = surfel_means(surfels, [_packed(view_maps) for view_maps in predicted])
        reflectance = surfels.radiance / np.maximum(lit.diffuse, 1e-12)
        segment = segment_surfels(region, reflectance, prior[:, 3:6], prior[:, 6])
        segmentation = Segmentation(segment, region, prior)
        points = choose_points(surfels, segment, lit.irradiance.known, options)
    with report.step("solve"):
        shading = shade_points(lit, points, options)
        segments = solve_points(lit, points, shading, segmentation, exposure, options)
        report.num_segments, report.num_metal = len(segments.roughness), int(segments.is_metal.sum())
    with report.step("specular"):
        solved, albedo = _solved_surfels(lit, segments, segmentation, options)
    with report.step("maps"):
        found: list[dict[str, NDArray]] = [{} for _ in views]
        for place, (index, view, view_maps) in enumerate(zip(order, ordered, predicted, strict=True)):
            found[index] = dict(view_materials(surfels, solved, place, view, camera_row(view), view_maps))
        report.confidence = tuple(float(v) for v in solved.confidence.mean(axis=0))
    return LightMaterials(found, report, lit, solved, albedo, segment)


def _packed(view_maps: dict[str, NDArray]) -> NDArray:
    return np.concatenate(
        [view_maps[name] for name in ("diffuse_albedo", "specular_albedo", "roughness")], axis=2
    )


def _solved_surfels(
    lit: Lit, segments: SolvedSegments, segmentation: Segmentation, options: LightOptions
) -> tuple[SolvedSurfels, NDArray[np.float32]]:
    """What the maps of the views are made of, and the surfels' own diffuse albedo (N, 3)."""
    surfels, segment = lit.surfels, segmentation.segment
    s, r, is_metal = (
        segments.specular_albedo[segment],
        segments.roughness[segment],
        segments.is_metal[segment],
    )
    owner = surfels.surfel_of_observation()
    toward = surfels.directions(owner, surfels.observations.view)
    shading = lit.baker.specular(
        surfels.position_m[owner],
        surfels.normal[owner],
        toward,
        r[owner],
        options.specular_rays,
        _SEED,
    )
    known = np.maximum(shading.known, MIN_KNOWN)[:, None]
    specular = ((s[owner] * shading.ls0 + shading.ls1) / known).astype(np.float32)
    albedo = surfel_albedo(surfels, lit.diffuse, specular, s, is_metal)
    confidence, gain = np.ones_like(albedo), np.ones_like(albedo)
    if options.has_prior:
        confidence = surfel_confidence(lit.irradiance.photographed)
        share = impossible_share(surfels.radiance, lit.diffuse, confidence[:, 0])
        confidence *= trust_of(share)
        confidence[lit.diffuse.max(axis=1) <= 0] = 0  # nothing is known where nothing arrives
        if not options.is_leveled:
            predicted = segmentation.prior[:, :3]
            gain = propagated_gain(albedo, predicted, confidence[:, 0], segment, segmentation.region)
            gain **= trust_of(share)
    return SolvedSurfels(lit.diffuse, specular, s, r, is_metal, confidence, gain), albedo


def surfel_albedo(
    surfels: Surfels, diffuse: NDArray, specular: NDArray, specular_albedo: NDArray, is_metal: NDArray
) -> NDArray[np.float32]:
    """Median over observations of (L - specular part) / ((1 - S) Ld), (N, 3)."""
    observations = surfels.observations
    owner = surfels.surfel_of_observation()
    rest = (observations.radiance - specular) / np.maximum(
        (1 - specular_albedo[owner]) * diffuse[owner], 1e-12
    )
    albedo = np.clip(
        weighted_medians(observations.start, rest.astype(np.float32), observations.weight), 0, MAX_ALBEDO
    )
    return np.where(is_metal[:, None], 0.0, albedo).astype(np.float32)

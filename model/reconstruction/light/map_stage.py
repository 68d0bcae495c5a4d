# SPDX-License-Identifier: MIT
"""The stage of ``materials infer`` that recovers materials from light."""

from __future__ import annotations

from dataclasses import asdict, replace

from datagen.geometry.traced import smooth_regions
from datagen.geometry.views import TracedCapture
from model.reconstruction.light.found import found_lights, radiance_samples
from model.reconstruction.light.options import LightOptions, LightReport
from model.reconstruction.light.pictures import view_pictures
from model.reconstruction.light.stage import materials_from_light
from model.reconstruction.light.surfel_confidence import SurfelConfidence
from model.reconstruction.stages import Estimate, Found, Run


def lit(traced: TracedCapture, estimate: Estimate, run: Run, options: LightOptions | None = None) -> Estimate:
    """Estimate D, S and R from light, blended with the given maps where evidence is weak, and recover the
    lights; files on disk keep the prediction.
    """
    options = options or LightOptions(has_prior=run.options.materials == "both")
    report = LightReport()
    with run.stage("light") as report.advance:
        materials = materials_from_light(
            traced.views,
            estimate.maps,
            traced.geometry,
            traced.capture.geometry.emitter_mask(),
            smooth_regions(traced.geometry.mesh),
            run.report.exposure,
            options,
            estimate.doubt_at,
            report,
        )
        with report.step("lights"):
            lights = found_lights(materials.lit, traced.geometry, traced.capture.geometry)
    holes = lights.described_holes()
    run.report.light = {**asdict(report), "lights": lights.described(), "holes": holes}
    if holes:
        area_m2 = sum(hole["area_m2"] for hole in holes)
        run.report.notes.append(
            f"{len(holes)} openings of the mesh ({area_m2:.2f} m2) are no brighter than white paint there: "
            "they count as holes, not as windows"
        )
    found = Found(
        lights,
        radiance_samples(traced.views),
        SurfelConfidence.of(materials.lit.surfels, materials.solved.confidence).at,
        tuple(view_pictures(traced.views, materials.maps, run.report.exposure)),
    )
    return replace(estimate, maps=materials.maps, found=found)

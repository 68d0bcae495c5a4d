# SPDX-License-Identifier: MIT
"""The pipeline stage of ``materials infer`` for materials from light."""

from __future__ import annotations

from dataclasses import asdict

from datagen.geometry.traced import smooth_regions
from datagen.geometry.views import TracedCapture
from model.reconstruction.light.found import found_lights, radiance_samples
from model.reconstruction.light.options import LightReport
from model.reconstruction.light.pictures import view_pictures
from model.reconstruction.light.stage import LightOptions, materials_from_light
from model.reconstruction.light.surfel_confidence import SurfelConfidence
from model.reconstruction.stages import Maps, Run


def lit(traced: TracedCapture, maps: list[Maps], run: Run, options: LightOptions | None = None) -> list[Maps]:
    """Maps of D, S and R from light, blended with ``maps`` where the evidence is weak; stored maps are
    unchanged.
    """
    options = options or LightOptions(has_prior=run.options.materials == "both")
    report = LightReport()
    with run.stage("light") as report.advance:
        found = materials_from_light(
            traced.views,
            maps,
            traced.geometry,
            traced.capture.geometry.emitter_mask(),
            smooth_regions(traced.geometry.mesh),
            run.report.exposure,
            options,
            run.found.doubt_at,
            report,
        )
        with report.step("lights"):
            lights = found_lights(found.lit, traced.geometry, traced.capture.geometry)
    run.report.light = {**asdict(report), "lights": lights.described()}
    run.found.lights, run.found.samples = lights, radiance_samples(traced.views)
    run.found.confidence_at = SurfelConfidence.of(found.lit.surfels, found.solved.confidence).at
    run.found.pictures = view_pictures(traced.views, found.maps, run.report.exposure)
    return found.maps

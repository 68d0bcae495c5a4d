# SPDX-License-Identifier: MIT
"""The stage of ``materials infer`` that recovers materials from light, and its pictures for the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from datagen.foundation.color import cividis, srgb_from_linear
from datagen.foundation.images import quantized_bytes
from datagen.geometry.traced import smooth_regions
from datagen.geometry.views import TracedCapture, TracedView
from model.reconstruction.light.confidence import SurfelConfidence
from model.reconstruction.light.found import found_lights, radiance_samples
from model.reconstruction.light.options import LightOptions, LightReport
from model.reconstruction.light.stage import materials_from_light
from model.reconstruction.stages import Estimate, Found, Maps, Run, ViewPicture

NUM_VIEWS, WIDTH_PX = 6, 320
NO_SURFACE = 128
"""Grey value of pixels without a surface."""


def lit(traced: TracedCapture, estimate: Estimate, run: Run, options: LightOptions | None = None) -> Estimate:
    """Estimate D, S and R from light, blended with the maps of ``estimate`` where evidence is weak, and
    recover the lights; maps on disk remain as predicted.
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


def view_pictures(views: Sequence[TracedView], maps: Sequence[Maps], exposure: float) -> list[ViewPicture]:
    """Make pictures of up to :data:`NUM_VIEWS` evenly spaced views, at most :data:`WIDTH_PX` wide."""
    chosen = np.unique(np.linspace(0, len(views) - 1, NUM_VIEWS).round().astype(int))
    pictures = []
    for index in chosen:
        view, view_maps = views[index], maps[index]
        step = max(1, -(-view.camera.width_px // WIDTH_PX))
        thin = (slice(None, None, step), slice(None, None, step))
        scale = np.array(cividis(), np.uint8)
        confidence = scale[quantized_bytes(view_maps["confidence"][thin][..., 0].astype(np.float32))]
        confidence[view.geometry.surface_mask[thin][..., 0] == 0] = NO_SURFACE
        pictures.append(
            ViewPicture(
                view.name,
                quantized_bytes(srgb_from_linear(view.color[thin] * exposure)),
                quantized_bytes(srgb_from_linear(view_maps["diffuse_albedo"][thin].astype(np.float32))),
                confidence,
            )
        )
    return pictures

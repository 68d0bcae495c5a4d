# SPDX-License-Identifier: MIT
"""The stage that corrects the scale of predicted diffuse albedo before the merge."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from datagen.geometry.traced import smooth_regions
from datagen.geometry.views import TracedCapture
from model.reconstruction.level.albedo_level import clipped_share, find_level
from model.reconstruction.stages import Estimate, Run


def leveled(traced: TracedCapture, estimate: Estimate, run: Run) -> Estimate:
    """Correct the albedo scale of the maps, unless evidence is weak; files on disk keep the prediction."""
    with run.stage("level"):
        views, geometry = traced.views, traced.geometry
        is_lamp, region_of_face = traced.capture.geometry.emitter_mask(), smooth_regions(geometry.mesh)
        clipped = clipped_share(views)
        level = find_level(
            views, estimate.maps, geometry, is_lamp, region_of_face, clipped, estimate.doubt_at
        )
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

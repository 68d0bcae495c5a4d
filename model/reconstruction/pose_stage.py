# SPDX-License-Identifier: MIT
"""The stage of ``materials infer --mend-poses``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.geometry.views import TracedCapture
from model.reconstruction.pose_mending import mended_poses
from model.reconstruction.stages import Run


def mended(traced: TracedCapture, run: Run) -> TracedCapture:
    """The capture with corrected poses, if these explain the views better than the given poses."""
    with run.stage("poses"):
        found = mended_poses(traced.views)
        low, high = found.residual
        run.report.poses = {
            "moved_mm": [round(float(value), 2) for value in found.moved_mm],
            "turned_deg": [round(float(value), 3) for value in found.turned_deg],
            "residual": [round(low, 5), round(high, 5)],
        }
        if not found.is_moved:
            run.report.notes.append("poses stay: none found that make the views agree better")
            return traced
        middle = float(np.median(found.moved_mm)), float(np.median(found.turned_deg))
        run.report.notes.append(
            f"poses mended by {middle[0]:.1f} mm and {middle[1]:.2f} degrees (medians); views differ by "
            f"{100 * high:.1f} % where they did by {100 * low:.1f} %"
        )
        views = tuple(
            replace(view, camera=camera, geometry=traced.geometry.trace_view(camera, view.valid_mask))
            for view, camera in zip(traced.views, found.cameras, strict=True)
        )
        return replace(traced, views=views)

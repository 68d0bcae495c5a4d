# SPDX-License-Identifier: MIT
"""The stage of ``materials infer --mend-poses`` that corrects camera poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.geometry.views import TracedCapture
from model.reconstruction.poses.mending import mended_poses
from model.reconstruction.stages import Run


def mended(traced: TracedCapture, run: Run) -> TracedCapture:
    """Correct the capture's poses and trace it again; it is unchanged if agreement would not improve."""
    with run.stage("poses"):
        found = mended_poses(traced.views)
        before, after = found.residual
        run.report.poses = {
            "moved_mm": [round(float(value), 2) for value in found.moved_mm],
            "turned_deg": [round(float(value), 3) for value in found.turned_deg],
            "residual": [round(before, 5), round(after, 5)],
        }
        if not found.is_moved:
            run.report.notes.append("poses are unchanged: no correction makes the views agree better")
            return traced
        moved_mm, turned_deg = np.median(found.moved_mm), np.median(found.turned_deg)
        run.report.notes.append(
            f"poses are corrected by {moved_mm:.1f} mm and {turned_deg:.2f} degrees (medians), which reduces "
            f"the difference between views from {100 * before:.1f} % to {100 * after:.1f} %"
        )
        views = tuple(
            replace(view, camera=camera, geometry=traced.geometry.trace_view(camera, view.valid_mask))
            for view, camera in zip(traced.views, found.cameras, strict=True)
        )
        return replace(traced, views=views)

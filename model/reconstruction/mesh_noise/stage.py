# SPDX-License-Identifier: MIT
"""The stage of ``materials infer`` that removes the noise of the capture's mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.formats.capture import Capture, CaptureGeometry
from model.reconstruction.mesh_noise.smoothing import noise_deg, smoothed
from model.reconstruction.stages import Run

MIN_NOISE_DEG = 2.0
"""Minimum noise for a correction; modelled meshes have 0, photogrammetry several degrees."""


def denoised(capture: Capture, run: Run) -> Capture:
    """Remove the noise of the mesh, and report it; a mesh without noise is unchanged. Lamps are unchanged."""
    with run.stage("mesh") as advance:
        geometry = capture.geometry
        before = noise_deg(geometry.mesh)
        run.report.mesh = {"noise_deg": round(before, 2)}
        if before < MIN_NOISE_DEG:
            return capture
        mesh = smoothed(geometry.mesh, geometry.emitter_mask(), advance)
        moved_mm = 1000 * np.linalg.norm(mesh.positions - geometry.mesh.positions, axis=1)
        moved = {f"moved_mm_{p}": round(float(np.percentile(moved_mm, p)), 1) for p in (50, 95)}
        after = noise_deg(mesh)
        run.report.mesh |= {"left_deg": round(after, 2), **moved}
        run.report.notes.append(
            f"the mesh is smoothed: triangles deviate by {after:.1f} instead of {before:.1f} degrees, and "
            f"vertices move by {moved['moved_mm_50']:.1f} mm (median); --no-smooth-mesh keeps it"
        )
        return replace(capture, geometry=CaptureGeometry(mesh, geometry.parts))

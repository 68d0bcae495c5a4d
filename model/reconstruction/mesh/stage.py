# SPDX-License-Identifier: MIT
"""The stage of ``materials infer`` that mends the noise and the holes of a reconstructed mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.formats.capture import Capture, CaptureGeometry
from model.reconstruction.mesh.holes import filled
from model.reconstruction.mesh.smoothing import noise_deg, smoothed
from model.reconstruction.stages import Run

MIN_NOISE_DEG = 2.0
"""Minimum noise of a mesh that is mended; modelled meshes have 0, photogrammetry several degrees."""


def mended_mesh(capture: Capture, run: Run) -> Capture:
    """Fill holes of the mesh, remove its noise, and report both; a mesh without noise is unchanged.

    Lamps are unchanged. Filled holes are a further part of the mesh, which then has no UVs.
    """
    with run.stage("mesh") as advance:
        before = noise_deg(capture.geometry.mesh)
        run.report.mesh = {"noise_deg": round(before, 2)}
        if before < MIN_NOISE_DEG:
            return capture
        capture, num_filled = filled(capture)
        geometry = capture.geometry
        mesh = smoothed(geometry.mesh, geometry.emitter_mask(), advance)
        moved_mm = 1000 * np.linalg.norm(mesh.positions - geometry.mesh.positions, axis=1)
        median_mm, high_mm = (round(float(np.percentile(moved_mm, p)), 1) for p in (50, 95))
        after = noise_deg(mesh)
        run.report.mesh |= {
            "left_deg": round(after, 2),
            "moved_mm_50": median_mm,
            "moved_mm_95": high_mm,
            "holes_filled": num_filled,
        }
        run.report.num_triangles = len(mesh.faces)
        run.report.notes.append(
            f"the mesh is mended: triangles deviate by {after:.1f} instead of {before:.1f} degrees, vertices "
            f"move by {median_mm:.1f} mm (median), {num_filled} holes are filled; --no-mend-mesh keeps it"
        )
        return replace(capture, geometry=CaptureGeometry(mesh, geometry.parts))

# SPDX-License-Identifier: MIT
"""Checks whether the mesh of a capture fits its photographs.

In each view, it checks the share, side and distance of the visible mesh, black or clipped photographs, and
the shift between the edges of mesh and photograph (``check.edges``). Over all views, it checks whether a
common offset and scale of the mesh explain the shifts (``check.judgement``) and, if edges do not match at
all, whether another up axis or unit fits better. Every warning names its views and a remedy.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import canonical_json, write_bytes_atomically
from datagen.formats.capture import Capture, CaptureGeometry
from datagen.foundation.axes import affine
from datagen.foundation.errors import input_error
from datagen.foundation.peak_memory import num_threads
from datagen.foundation.progress import Advance, Progress, no_advance
from datagen.geometry.traced import TracedGeometry, seen_sides
from datagen.geometry.views import TracedCapture
from mitsuba_plugins.variant import select_variant
from model.reconstruction.captures.frames import AXES, z_up_from
from model.reconstruction.check.edges import match_edges, mesh_edges
from model.reconstruction.check.judgement import judge
from model.reconstruction.check.pictures import write_contact_sheets
from model.reconstruction.check.views import CheckReport, Look, view_warnings

__all__ = ["CheckReport", "Look", "check_capture", "check_looks", "check_traced", "view_warnings"]
_MAX_TRIED_VIEWS = 4
_UNITS = (0.001, 0.01, 0.0254, 0.3048, 100.0, 1000.0)
_MIN_FIT = 4.0  # minimum of (median score without a shift) x coverage for a mesh that fits
_BETTER = 1.5  # minimum ratio of the score in another frame to the score in the given one


def check_capture(capture: Capture, out: Path | None = None, progress: Progress | None = None) -> CheckReport:
    """Read, trace and check a capture; write ``check.json`` and contact sheets to ``out`` if given.

    Raises :class:`InputError` if no view shows the mesh.
    """
    tell = progress or (lambda stage, done, total: None)
    select_variant()
    traced = TracedGeometry(capture.geometry)
    looks = []
    for number, view in enumerate(capture.views, start=1):
        image = view.read()
        pixels = image.color, traced.trace_view(view.camera, image.valid_mask), image.valid_mask
        looks.append(Look(view.camera, *pixels, view.name, image.clipped_mask, image.limit))
        tell("check", number, len(capture.views))
    return check_looks(capture, looks, out)


def check_traced(traced: TracedCapture, out: Path, progress: Advance) -> CheckReport:
    """Check a capture that is already read and traced, as :func:`check_capture` does."""
    return check_looks(traced.capture, [Look(**vars(view)) for view in traced.views], out, progress)


def check_looks(
    capture: Capture, looks: Sequence[Look], out: Path | None, progress: Advance = no_advance
) -> CheckReport:
    """Check views, read and traced with the selected Mitsuba variant, as :func:`check_capture` does."""
    if not any((look.geometry.face >= 0).any() for look in looks):
        raise _nothing_seen(capture, looks)
    sides = seen_sides([look.geometry for look in looks], len(capture.geometry.mesh.faces))
    report = CheckReport(capture.name, [], notes=list(capture.notes))
    with ThreadPoolExecutor(num_threads()) as pool:
        for checked in pool.map(lambda look: look.checked(sides), looks):
            report.views.append(checked)
            progress(len(report.views), len(looks))
    judge(report, looks)
    if report.fit * float(np.median([view.coverage for view in report.views])) < _MIN_FIT:
        _try_other_frames(report, capture, looks)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        edges = [look.edges for look in looks]
        write_contact_sheets(out, report, [look.color for look in looks], edges)
        write_bytes_atomically(out / "check.json", canonical_json(report.table()))
    return report


def _try_other_frames(report: CheckReport, capture: Capture, looks: Sequence[Look]) -> None:
    """Add a warning that the mesh does not fit, and the up axis or unit, if any, that fits some views."""
    step = max(1, len(looks) // _MAX_TRIED_VIEWS)
    chosen = looks[::step][:_MAX_TRIED_VIEWS]
    in_file = z_up_from(capture.mesh_up).T
    now = _fit_of(capture, np.eye(3), chosen)
    best, name = max(_BETTER * now, _MIN_FIT), ""
    trials: list[tuple[str, NDArray[np.float64]]] = [
        (f"--mesh-up {axis}", z_up_from(axis) @ in_file) for axis in AXES if axis != capture.mesh_up
    ]
    trials += [(f"a unit of the mesh {unit:g} times as long", unit * np.eye(3)) for unit in _UNITS]
    for remedy, linear in trials:
        fit = _fit_of(capture, linear, chosen)
        if fit > best:
            best, name = fit, remedy
    finding = "the mesh's edges do not match the photographs'"
    if name:
        report.better = name
        report.warnings.append(f"{finding} (score {now:.1f}); with {name} they do (score {best:.1f})")
    elif report.fit < _MIN_FIT:
        report.warnings.append(
            f"{finding} (score {report.fit:.1f} instead of at least {_MIN_FIT:.0f}), and no other up axis or "
            "unit is better; look at the contact sheets and compare the frames of cameras and mesh"
        )


def _fit_of(capture: Capture, linear: NDArray[np.float64], looks: Sequence[Look]) -> float:
    """Compute the fit of the mesh transformed by ``linear`` (3, 3): the median over views of
    ``EdgeMatch.at_zero`` times the share of pixels that show the mesh.
    """
    mesh = replace(capture.geometry.mesh.transformed(affine(linear)), normals=None)
    traced = TracedGeometry(CaptureGeometry(mesh, capture.geometry.parts))
    scores = []
    for look in looks:
        geometry = traced.trace_view(look.camera, look.valid_mask)
        found = match_edges(mesh_edges(geometry, look.camera), look.field, look.radius_px)
        coverage = float((geometry.face >= 0).mean())
        scores.append(0.0 if found is None else found.at_zero * coverage)
    return float(np.median(scores))


def _nothing_seen(capture: Capture, looks: Sequence[Look]) -> Exception:
    mesh = capture.geometry.mesh
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    centers = np.array([look.camera.position_m for look in looks])
    got = (
        f"no view sees the mesh: it spans {_box(low, high)}, the cameras "
        f"{_box(centers.min(axis=0), centers.max(axis=0))}"
    )
    remedy = "check that mesh and cameras share their frame, axes (--mesh-up) and unit (--unit)"
    return input_error(capture.name, "geometry", got, "cameras that face the mesh", remedy)


def _box(low: NDArray, high: NDArray) -> str:
    return " x ".join(f"{a:.3g}...{b:.3g}" for a, b in zip(low, high, strict=True)) + " m"

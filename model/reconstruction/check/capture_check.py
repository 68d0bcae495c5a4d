# SPDX-License-Identifier: MIT
"""Checks whether the mesh of a capture fits its photographs.

In each view, it checks the visible mesh (coverage, back faces, distance), the photograph (black, clipped) and
the shift between the edges of both (``check.edges``). Over all views, it checks whether a
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
from model.reconstruction.check.views import CheckReport, EdgeView, view_warnings

__all__ = ["CheckReport", "EdgeView", "check_capture", "check_traced", "check_views", "view_warnings"]
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
    edge_views = []
    for number, view in enumerate(capture.views, start=1):
        image = view.read()
        pixels = image.color, traced.trace_view(view.camera, image.valid_mask), image.valid_mask
        edge_views.append(EdgeView(view.camera, *pixels, view.name, image.clipped_mask, image.limit))
        tell("check", number, len(capture.views))
    return check_views(capture, edge_views, out)


def check_traced(traced: TracedCapture, out: Path, progress: Advance) -> CheckReport:
    """Check a capture that is already read and traced, as :func:`check_capture` does."""
    return check_views(traced.capture, [EdgeView(**vars(view)) for view in traced.views], out, progress)


def check_views(
    capture: Capture, edge_views: Sequence[EdgeView], out: Path | None, progress: Advance = no_advance
) -> CheckReport:
    """Check the views of a capture as :func:`check_capture` does; a Mitsuba variant must be selected."""
    if not any((edge_view.geometry.face >= 0).any() for edge_view in edge_views):
        raise _nothing_seen(capture, edge_views)
    sides = seen_sides([edge_view.geometry for edge_view in edge_views], len(capture.geometry.mesh.faces))
    report = CheckReport(capture.name, [], notes=list(capture.notes))
    with ThreadPoolExecutor(num_threads()) as pool:
        for checked in pool.map(lambda edge_view: edge_view.checked(sides), edge_views):
            report.views.append(checked)
            progress(len(report.views), len(edge_views))
    judge(report, edge_views)
    if report.fit * float(np.median([view.coverage for view in report.views])) < _MIN_FIT:
        _try_other_frames(report, capture, edge_views)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        edges = [edge_view.edges for edge_view in edge_views]
        write_contact_sheets(out, report, [edge_view.color for edge_view in edge_views], edges)
        write_bytes_atomically(out / "check.json", canonical_json(report.table()))
    return report


def _try_other_frames(report: CheckReport, capture: Capture, edge_views: Sequence[EdgeView]) -> None:
    """Try other up axes and units of the mesh on some views; warn of the bad fit, and name the best frame."""
    step = max(1, len(edge_views) // _MAX_TRIED_VIEWS)
    chosen = edge_views[::step][:_MAX_TRIED_VIEWS]
    in_file = z_up_from(capture.mesh_up).T
    now = _fit_of(capture, np.eye(3), chosen)
    best, name = max(_BETTER * now, _MIN_FIT), ""
    trials: list[tuple[str, NDArray[np.float64]]] = [
        (f"--mesh-up {axis}", z_up_from(axis) @ in_file) for axis in AXES if axis != capture.mesh_up
    ]
    trials += [(f"a mesh unit {unit:g} times as long", unit * np.eye(3)) for unit in _UNITS]
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


def _fit_of(capture: Capture, linear: NDArray[np.float64], edge_views: Sequence[EdgeView]) -> float:
    """Compute the fit of the mesh transformed by ``linear`` (3, 3): the median over views of
    ``EdgeMatch.at_zero`` times the share of pixels that show the mesh.
    """
    mesh = replace(capture.geometry.mesh.transformed(affine(linear)), normals=None)
    traced = TracedGeometry(CaptureGeometry(mesh, capture.geometry.parts))
    scores = []
    for edge_view in edge_views:
        geometry = traced.trace_view(edge_view.camera, edge_view.valid_mask)
        found = match_edges(mesh_edges(geometry, edge_view.camera), edge_view.field, edge_view.radius_px)
        coverage = float((geometry.face >= 0).mean())
        scores.append(0.0 if found is None else found.at_zero * coverage)
    return float(np.median(scores))


def _nothing_seen(capture: Capture, edge_views: Sequence[EdgeView]) -> Exception:
    mesh = capture.geometry.mesh
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    centers = np.array([edge_view.camera.position_m for edge_view in edge_views])
    got = (
        f"no view sees the mesh: it spans {_box(low, high)}, the cameras "
        f"{_box(centers.min(axis=0), centers.max(axis=0))}"
    )
    remedy = "check that mesh and cameras share their frame, axes (--mesh-up) and unit (--unit)"
    return input_error(capture.name, "geometry", got, "cameras that face the mesh", remedy)


def _box(low: NDArray, high: NDArray) -> str:
    return " x ".join(f"{a:.3g}...{b:.3g}" for a, b in zip(low, high, strict=True)) + " m"

# SPDX-License-Identifier: MIT
"""Derives warnings from the results of the check: errors common to all views, and errors of single views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.reconstruction.check.registration import Registration, SeenShift, common_mistake
from model.reconstruction.check.views import SEARCH_RAD, SURE, CheckReport, Look, ViewCheck

_LOST = 0.6  # score relative to SURE below which a view does not match if others do
_SURE_GAIN = 1.2  # minimum gain by roll or zoom in standard deviations; it is lower in correct views
_MIN_ROLL_RAD, _MIN_ZOOM = np.radians(0.5), 0.015
_MAX_LISTED = 6  # views in a warning
_MIN_VIEWS, _MAX_SPREAD = 4, 0.3  # minimum number and maximum relative spread of common magnifications


def judge(report: CheckReport, looks: Sequence[Look]) -> None:
    """Set ``fit``, ``offset_m`` and ``scale`` of ``report``, and add warnings about mesh and views."""
    with_edges = [view.edges for view in report.views if view.edges is not None]
    report.fit = float(np.median([edges.at_zero for edges in with_edges])) if with_edges else 0.0
    if not with_edges:
        report.warnings.append(
            "no view shows enough edges of the mesh to compare them with the photographs; look at the sheets"
        )
        return
    zoom = _common_zoom(report)
    if zoom is not None:
        size, factor = ("small", zoom) if zoom > 1 else ("large", 1 / zoom)
        report.warnings.append(
            f"the mesh looks {factor:.3f} times too {size} in most views; the focal length, or the mesh's "
            "scale in the cameras' frame, is off by this factor; correct it and check again"
        )
        return  # a wrong scale shifts the edges in all views, so shifts do not indicate other errors
    pairs = [(view, look) for view, look in zip(report.views, looks, strict=True) if view.is_judged]
    mistake = common_mistake(
        [
            SeenShift(look.camera, view.depth_m, view.edges.peak_px, view.edges.blur_px2)
            for view, look in pairs
            if view.edges is not None
        ]
    )
    report.offset_m = None if mistake is None else mistake.offset_m
    report.scale = 1.0 if mistake is None else mistake.scale
    names = ", ".join(view.name for view, _ in pairs[:_MAX_LISTED])
    if len(pairs) > _MAX_LISTED:
        names += f" and {len(pairs) - _MAX_LISTED} more views"
    if report.offset_m is not None:
        offset = ", ".join(f"{100 * v:+.1f}" for v in report.offset_m)
        report.warnings.append(
            f"the mesh seems to be moved by ({offset}) cm along x, y, z in {names}; "
            "register it to the cameras again"
        )
    if report.scale != 1:
        report.warnings.append(
            f"the mesh seems to be {report.scale:.3f} times too large for the cameras' frame in {names}; "
            f"scale it by {1 / report.scale:.4f} about the cameras' mean position"
        )
    left_px = {view.name: view.edges.peak_px for view, _ in pairs if view.edges is not None}
    if mistake is not None:
        left_px = dict(zip(left_px, mistake.left_px, strict=True))
    _judge_zooms(report, looks, mistake)
    is_fitting = len(pairs) >= 0.5 * len(with_edges)
    for view, look in zip(report.views, looks, strict=True):
        if view.edges is not None and not view.warnings:
            _judge_shift(view, look, left_px.get(view.name), is_fitting)


def _common_zoom(report: CheckReport) -> float | None:
    """Find the magnification of the mesh's image that is common to most views; None if there is none."""
    warps = [view.warp for view in report.views if view.warp is not None and view.warp.at_peak >= SURE]
    zooms = np.array([warp.zoom - 1 for warp in warps if warp.zoom_gain >= _SURE_GAIN])
    if len(zooms) < max(_MIN_VIEWS, 0.5 * len(warps)):
        return None
    middle = float(np.median(zooms))
    is_common = float(np.median(np.abs(zooms - middle))) < _MAX_SPREAD * abs(middle)
    return 1 + middle if abs(middle) >= _MIN_ZOOM and is_common else None


def _judge_zooms(report: CheckReport, looks: Sequence[Look], mistake: Registration | None) -> None:
    """Add warnings to views whose cameras are rolled, or too far forward or backward."""
    zoomed = []
    for view, look in zip(report.views, looks, strict=True):
        warp = view.warp
        if warp is None or view.warnings or warp.at_peak < SURE:
            continue
        moved = 0.0
        if mistake is not None:
            moved = float(mistake.moved_m(look.camera.position_m) @ look.camera.forward) / view.zoom_depth_m
        is_rolled = warp.roll_gain >= _SURE_GAIN and abs(warp.roll_rad) >= _MIN_ROLL_RAD
        excess = abs(warp.zoom - 1 - moved)
        is_zoomed = warp.zoom_gain >= _SURE_GAIN and excess >= max(_MIN_ZOOM, 0.5 * abs(warp.zoom - 1))
        if is_rolled and (warp.roll_gain >= warp.zoom_gain or not is_zoomed):
            way = "clockwise" if warp.roll_rad > 0 else "anticlockwise"
            view.warnings.append(
                f"{view.name}: its edges are turned by {np.degrees(abs(warp.roll_rad)):.1f} degrees {way} "
                "against the mesh's; the camera is rolled; correct its pose or leave it out"
            )
        elif is_zoomed:
            zoomed.append((view, warp.zoom))
    for view, zoom in zoomed:
        size, way = ("small", "backward") if zoom > 1 else ("large", "forward")
        share = abs(zoom - 1)
        view.warnings.append(
            f"{view.name}: the mesh looks {100 * share:.0f} % too {size} in it; the camera is about "
            f"{100 * share * view.zoom_depth_m:.0f} cm too far {way}, or its focal length is off; correct it "
            "or leave the view out"
        )


def _judge_shift(view: ViewCheck, look: Look, left_px: tuple[float, float] | None, is_fitting: bool) -> None:
    """Add a warning to a view whose edges are shifted too far or do not match.

    ``left_px``: the shift (dx, dy) that the common error does not explain, None if the shift is ambiguous.
    """
    assert view.edges is not None
    is_lost = left_px is None
    if left_px is not None and view.edges.surely_px(left_px) > look.tolerance_px():
        shift = float(np.hypot(*left_px))
        degrees = np.degrees(np.arctan(shift / look.camera.fx_px))
        is_lost = bool(np.radians(degrees) > SEARCH_RAD)
        if not is_lost:
            view.warnings.append(
                f"{view.name}: its edges are {shift:.0f} pixels from the mesh's ({degrees:.1f} degrees); "
                "correct its pose or leave it out"
            )
    if is_lost and is_fitting and view.edges.at_zero < _LOST * SURE:
        view.warnings.append(
            f"{view.name}: its edges do not match the mesh's; it shows another scene or its pose is wrong; "
            "correct its pose or leave it out"
        )

# SPDX-License-Identifier: MIT
"""Derives warnings from the results of the check: errors common to all views, and errors of single views.

A common error is a displacement and a scale of the mesh that explain the shifts in all views. If mesh points
p are displaced to p + d + e (p - m), with m the cameras' mean position, a camera at c observes the
displacement d + e (c - m); the remainder e (p - c) scales the room about the camera, which does not change
its image. The edges in a view are therefore shifted by f (d + e (c - m))_xy / z, in the camera's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera
from model.reconstruction.check.edges import EdgeMatch
from model.reconstruction.check.views import SEARCH_RAD, SURE, CheckReport, EdgeView, ViewCheck

# minimum reported offset and error of scale, and their minimum in standard deviations
_OFFSET_M, _SCALE, _SIGMAS = 0.008, 0.004, 3.0
_MIN_VIEWS_FOR_SCALE = 8
_FLOOR_PX2 = 0.25  # added to a peak's covariance, since shifts are known to half a pixel at best
_OUTLIER = 1.5  # standard deviations of the residual above which a view has less weight
_EXPLAINED = 0.75  # maximum ratio of the median residual to the median shift
_LOST = 0.6  # score relative to SURE below which a view does not match if others do
_SURE_GAIN = 1.2  # minimum gain by roll or zoom in standard deviations; it is lower in correct views
_MIN_ROLL_RAD, _MIN_ZOOM = np.radians(0.5), 0.015
_MAX_LISTED = 6  # maximum number of views named in a warning
_MIN_VIEWS = 4  # minimum number of views for a common error
_MAX_SPREAD = 0.3  # maximum relative spread of common magnifications


@dataclass(frozen=True)
class Registration:
    """A significant error of the mesh common to all views.

    ``offset_m``: offset of the mesh relative to the cameras, None if insignificant; ``scale``: scale of the
    mesh relative to the cameras, 1 if insignificant; ``left_px``: residual shift (dx, dy) of each view;
    ``center_m`` (3,): mean position of the cameras.
    """

    offset_m: tuple[float, float, float] | None
    scale: float
    left_px: list[tuple[float, float]]
    center_m: NDArray[np.float64]

    def moved_m(self, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute the apparent displacement (3,) of the mesh in metres for a camera at ``position_m``."""
        offset = np.zeros(3) if self.offset_m is None else np.array(self.offset_m)
        return offset + (self.scale - 1) * (position_m - self.center_m)


def common_error(views: Sequence[tuple[Camera, float, EdgeMatch]]) -> Registration | None:
    """Estimate the offset and scale of the mesh that best explain all shifts; None if insignificant.

    ``views``: camera, mean edge depth in metres, and match of the edges of each view. Iteratively reweighted
    least squares (IRLS) bound the effect of outliers; the scale is estimated from eight views or more.
    """
    if len(views) < _MIN_VIEWS:
        return None
    centers = np.array([camera.position_m for camera, _, _ in views])
    middle = centers.mean(axis=0)
    rows, whiten = [], []
    for camera, depth_m, edges in views:
        across = camera.world_from_camera[:3, :3].T[:2]
        factor = np.array([[camera.fx_px], [camera.fy_px]]) / max(depth_m, 1e-3)
        by_scale = (across @ (camera.position_m - middle))[:, None]
        rows.append(-factor * np.hstack([across, by_scale]))
        xx, xy, yy = edges.blur_px2
        values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]) + _FLOOR_PX2 * np.eye(2))
        whiten.append(vectors @ np.diag(values**-0.5) @ vectors.T)
    a, b = np.array(rows), np.array([edges.peak_px for _, _, edges in views])
    white = np.array(whiten)
    if len(views) >= _MIN_VIEWS_FOR_SCALE:
        found, covariance = _robust(white @ a, (white @ b[..., None])[..., 0])
        if abs(found[3]) >= max(_SCALE, _SIGMAS * float(np.sqrt(covariance[3, 3]))):
            if not _is_moved(found[:3], covariance[:3, :3]):
                found[:3] = 0
            return _registration(found, a, b, white, middle)
    a = a[..., :3]  # an insignificant scale would make the offset less certain
    found, covariance = _robust(white @ a, (white @ b[..., None])[..., 0])
    return _registration(found, a, b, white, middle) if _is_moved(found, covariance) else None


def _is_moved(offset_m: NDArray[np.float64], covariance: NDArray[np.float64]) -> bool:
    size = float(np.linalg.norm(offset_m))
    along = offset_m / max(size, 1e-12)
    return size >= _OFFSET_M and size >= _SIGMAS * float(np.sqrt(along @ covariance @ along))


def _robust(
    a: NDArray[np.float64], b: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Solve a x = b for ``a`` (V, 2, N) and ``b`` (V, 2) by IRLS; return x (N,) and its covariance (N, N)."""
    weight = np.ones(len(a))
    found = np.zeros(a.shape[2])
    for _ in range(20):
        w = np.sqrt(weight)[:, None]
        system = (a * w[..., None]).reshape(-1, a.shape[2])
        found = np.linalg.lstsq(system, (b * w).ravel(), rcond=1e-3)[0]
        left = np.linalg.norm(b - a @ found, axis=1)
        weight = 1 / np.maximum(left / _OUTLIER, 1) ** 2
    degrees = max(2 * weight.sum() - a.shape[2], 1)
    sigma2 = max(float((weight * left**2).sum() / degrees), 0.1)
    return found, sigma2 * np.linalg.pinv(np.einsum("v,vki,vkj->ij", weight, a, a))


def _registration(
    found: NDArray[np.float64],
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    white: NDArray[np.float64],
    middle: NDArray[np.float64],
) -> Registration | None:
    rest = b - a @ found
    before, left = (np.linalg.norm((white @ x[..., None])[..., 0], axis=1) for x in (b, rest))
    if float(np.median(left)) >= _EXPLAINED * float(np.median(before)):
        return None
    offset = None if not found[:3].any() else (float(found[0]), float(found[1]), float(found[2]))
    scale = 1.0 + (float(found[3]) if len(found) > 3 else 0.0)
    return Registration(offset, scale, [(float(x), float(y)) for x, y in rest], middle)


def judge(report: CheckReport, edge_views: Sequence[EdgeView]) -> None:
    """Set ``fit``, ``offset_m`` and ``scale`` of ``report``, and add warnings about mesh and views."""
    with_edges = [view.edges for view in report.views if view.edges is not None]
    report.fit = float(np.median([edges.at_zero for edges in with_edges])) if with_edges else 0.0
    if not with_edges:
        report.warnings.append(
            "no view shows enough edges of the mesh to compare them with the photographs; "
            "look at the contact sheets"
        )
        return
    zoom = _common_zoom(report)
    if zoom is not None:
        size, factor = ("small", zoom) if zoom > 1 else ("large", 1 / zoom)
        report.warnings.append(
            f"the mesh looks too {size} by a factor of {factor:.3f} in most views; the focal length, or the "
            "mesh's scale in the cameras' frame, is off by this factor; correct it and check again"
        )
        return  # a wrong scale shifts the edges in all views, so shifts do not indicate other errors
    pairs = [
        (view, edge_view) for view, edge_view in zip(report.views, edge_views, strict=True) if view.is_judged
    ]
    registration = common_error(
        [(edge_view.camera, view.depth_m, view.edges) for view, edge_view in pairs if view.edges is not None]
    )
    report.offset_m = None if registration is None else registration.offset_m
    report.scale = 1.0 if registration is None else registration.scale
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
            f"the mesh seems to be scaled by {report.scale:.3f} relative to the cameras in {names}; "
            f"scale it by {1 / report.scale:.4f} about the cameras' mean position"
        )
    left_px = {view.name: view.edges.peak_px for view, _ in pairs if view.edges is not None}
    if registration is not None:
        left_px = dict(zip(left_px, registration.left_px, strict=True))
    _judge_zooms(report, edge_views, registration)
    is_fitting = len(pairs) >= 0.5 * len(with_edges)
    for view, edge_view in zip(report.views, edge_views, strict=True):
        if view.edges is not None and not view.warnings:
            _judge_shift(view, edge_view, left_px.get(view.name), is_fitting)


def _common_zoom(report: CheckReport) -> float | None:
    """Find the magnification of the mesh's image that is common to most views; None if there is none."""
    warps = [view.warp for view in report.views if view.warp is not None and view.warp.at_peak >= SURE]
    zooms = np.array([warp.zoom - 1 for warp in warps if warp.zoom_gain >= _SURE_GAIN])
    if len(zooms) < max(_MIN_VIEWS, 0.5 * len(warps)):
        return None
    middle = float(np.median(zooms))
    is_common = float(np.median(np.abs(zooms - middle))) < _MAX_SPREAD * abs(middle)
    return 1 + middle if abs(middle) >= _MIN_ZOOM and is_common else None


def _judge_zooms(
    report: CheckReport, edge_views: Sequence[EdgeView], registration: Registration | None
) -> None:
    """Add warnings to views whose cameras are rolled, or too far forward or backward."""
    zoomed = []
    for view, edge_view in zip(report.views, edge_views, strict=True):
        warp = view.warp
        if warp is None or view.warnings or warp.at_peak < SURE:
            continue
        moved = 0.0
        if registration is not None:
            moved = (
                float(registration.moved_m(edge_view.camera.position_m) @ edge_view.camera.forward)
                / view.zoom_depth_m
            )
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


def _judge_shift(
    view: ViewCheck, edge_view: EdgeView, left_px: tuple[float, float] | None, is_fitting: bool
) -> None:
    """Add a warning to a view whose edges are shifted too far or do not match.

    ``left_px``: shift (dx, dy) that the common error does not explain, None if ambiguous.
    """
    assert view.edges is not None
    is_lost = left_px is None
    if left_px is not None and view.edges.surely_px(left_px) > edge_view.tolerance_px():
        shift = float(np.hypot(*left_px))
        degrees = np.degrees(np.arctan(shift / edge_view.camera.fx_px))
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

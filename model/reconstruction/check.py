# SPDX-License-Identifier: MIT
"""Looks at a capture before minutes are spent on it: does the mesh project onto the photographs?

By view: what share shows the mesh, from which side and how near; whether the photograph is black or clipped;
whether the mesh's edges lie on the photograph's, and how far they are off (``check_edges``). Over all views:
whether their shifts are explained by one offset and scale of the mesh (``check_registration``), and, where
edges do not fit at all, whether another up axis or unit of the mesh fits better. Every warning names its
views and a remedy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.cameras import Camera
from datagen.color import luminance
from datagen.errors import input_error
from datagen.formats.base import canonical_json, write_bytes_atomically
from datagen.formats.capture import Capture, CaptureGeometry, ColorImage
from mitsuba_plugins.variant import select_variant
from model.reconstruction.captures.frames import AXES, z_up_from
from model.reconstruction.check_edges import (
    EdgeMatch,
    WarpMatch,
    match_edges,
    match_warp,
    mesh_edges,
    photograph_field,
)
from model.reconstruction.check_registration import Registration, SeenShift, common_mistake
from model.reconstruction.geometry import TracedGeometry, ViewGeometry, seen_sides

MIN_COVERAGE = 0.05  # of a view's pixels; below, the view hardly shows the room that the mesh is of
CLIPPED_LEVEL, MAX_CLIPPED = 0.99, 0.5
_NEAR_M, _MAX_NEAR = 0.05, 0.5  # half a view nearer than this: the camera is in or at a wall
SEARCH_RAD = np.radians(3.5)  # how far off a camera is looked for
_MIN_RADIUS_PX = 24  # enough other shifts to tell a peak from accidents
TOLERANCE_RAD, _TOLERANCE_PX = np.radians(0.35), 1.5
SURE = 5.0  # standard deviations: a peak of this height is no accident
_LOST = 0.6  # of SURE: a view that fits worse, among views that fit, is of another place
_SURE_GAIN = 1.2  # standard deviations: on right views roll and zoom gain less
_LEAST_ROLL_RAD, _LEAST_ZOOM = np.radians(0.5), 0.015
_MAX_TRIED_VIEWS = 4
_UNITS = (0.001, 0.01, 0.0254, 0.3048, 100.0, 1000.0)
_MIN_FIT = 4.0  # median score at zero, times coverage, of a capture whose mesh fits
_BETTER = 1.5  # times the score that another frame must have

Progress = Callable[[str, int, int], None]


@dataclass
class ViewCheck:
    """What was found about a view. Shares are of its pixels; ``off_deg`` is the shift as an angle of the
    camera, None where the edges say nothing."""

    name: str
    coverage: float
    back_share: float
    nearest_m: float
    edges: EdgeMatch | None = None
    warp: WarpMatch | None = None
    off_deg: float | None = None
    depth_m: float = 0.0
    warnings: list[str] = field(default_factory=list)

    @property
    def is_judged(self) -> bool:
        """Whether the edges say where they belong."""
        return self.edges is not None and self.edges.at_peak >= SURE


@dataclass
class CheckReport:
    """Findings by view and for the capture. ``offset_m``: how far the mesh seems to be moved, None where
    unknown or nothing to speak of; ``scale``: how large it seems to be against the cameras' frame; ``fit``:
    median over the views of the edges' score as it stands, in standard deviations."""

    name: str
    views: list[ViewCheck]
    fit: float = 0.0
    offset_m: tuple[float, float, float] | None = None
    scale: float = 1.0
    better: str = ""
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def all_warnings(self) -> list[str]:
        """Those of the capture, then those of the views."""
        return [*self.warnings, *(warning for view in self.views for warning in view.warnings)]

    def table(self) -> dict[str, Any]:
        """As it is written to ``check.json``."""
        return {"format": "scene-materials/check", **asdict(self)}


def check_capture(capture: Capture, out: Path | None = None, progress: Progress | None = None) -> CheckReport:
    """Read, trace and check a capture; with ``out`` write ``check.json`` and contact sheets there.

    Raises :class:`InputError` where no view sees the mesh.
    """
    tell = progress or (lambda stage, done, total: None)
    select_variant()
    traced = TracedGeometry(capture.geometry)
    looks = []
    for number, view in enumerate(capture.views, start=1):
        image = view.read()
        geometry = traced.trace_view(view.camera, image.valid_mask)
        looks.append(Look(view.name, view.camera, image, geometry))
        tell("check", number, len(capture.views))
    return check_looks(capture, looks, out)


def check_looks(capture: Capture, looks: Sequence[Look], out: Path | None = None) -> CheckReport:
    """The same for views that have been read and traced. The Mitsuba variant must have been selected."""
    if not any((look.geometry.face >= 0).any() for look in looks):
        raise _nothing_seen(capture, looks)
    sides = seen_sides([look.geometry for look in looks], len(capture.geometry.mesh.faces))
    report = CheckReport(capture.name, [look.checked(sides) for look in looks], notes=list(capture.notes))
    _judge(report, looks)
    if report.fit * float(np.median([view.coverage for view in report.views])) < _MIN_FIT:
        _try_other_frames(report, capture, looks)
    if out is not None:
        from model.reconstruction.check_pictures import write_contact_sheets

        out.mkdir(parents=True, exist_ok=True)
        edges = [look.edges for look in looks]
        write_contact_sheets(out, report, [look.image.color for look in looks], edges)
        write_bytes_atomically(out / "check.json", canonical_json(report.table()))
    return report


def view_warnings(name: str, color: NDArray[np.float32], geometry: ViewGeometry) -> list[str]:
    """What makes a view of little use by itself, each with a remedy."""
    found = []
    coverage = float((geometry.face >= 0).mean())
    if coverage == 0:
        found.append(f"{name}: sees nothing of the mesh; correct its pose or leave it out")
    elif coverage < MIN_COVERAGE:
        found.append(
            f"{name}: only {coverage:.1%} of its pixels show the mesh; leave it out if it is of another place"
        )
    brightness = luminance(color)
    if not brightness.any():
        found.append(f"{name}: is black; leave it out")
    elif float((brightness >= CLIPPED_LEVEL).mean()) > MAX_CLIPPED and float(brightness.max()) <= 1.0:
        found.append(f"{name}: over half of it is at the sensor's limit; expose less or leave it out")
    return found


@dataclass
class Look:
    """A view as read and traced, and the edges of both."""

    name: str
    camera: Camera
    image: ColorImage
    geometry: ViewGeometry

    def __post_init__(self) -> None:
        self.edges = mesh_edges(self.geometry, self.camera)
        self.field = photograph_field(self.image.color, self.image.valid_mask)

    @property
    def radius_px(self) -> int:
        """The largest shift to look for."""
        wanted = max(self.camera.fx_px * float(np.tan(SEARCH_RAD)), _MIN_RADIUS_PX)
        return int(max(6, min(wanted, min(self.camera.width_px, self.camera.height_px) / 4)))

    def checked(self, sides: NDArray[np.float32]) -> ViewCheck:
        hit = self.geometry.face >= 0
        depth = self.geometry.depth_z_m[..., 0]
        is_back = self.geometry.is_front[hit] != (sides[self.geometry.face[hit]] > 0)
        found = ViewCheck(
            self.name,
            coverage=float(hit.mean()),
            back_share=float(is_back.mean()) if hit.any() else 0.0,
            nearest_m=float(depth[hit].min()) if hit.any() else 0.0,
            warnings=view_warnings(self.name, self.image.color, self.geometry),
        )
        if hit.any() and float((depth[hit] < _NEAR_M).mean()) > _MAX_NEAR:
            found.warnings.append(
                f"{self.name}: most of what it sees is nearer than {100 * _NEAR_M:.0f} cm; "
                "the camera is inside a wall or a thing, or the unit is wrong (--unit)"
            )
        elif found.back_share > 0.5:
            found.warnings.append(
                f"{self.name}: sees mostly the back of the mesh; the camera is inside a wall or outside the "
                "room; correct its pose or leave it out"
            )
        if not found.warnings:
            found.edges = match_edges(self.edges, self.field, self.radius_px)
            found.warp = match_warp(self.edges, self.field, self.camera, self.radius_px)
            at = self.edges & hit
            found.depth_m = float(1 / np.mean(1 / depth[at])) if at.any() else 0.0
        if found.edges is not None:
            is_off = found.edges.surely_px(found.edges.peak_px) > 0
            shift = float(np.hypot(*found.edges.peak_px)) if is_off else 0.0
            found.off_deg = float(np.degrees(np.arctan(shift / self.camera.fx_px)))
        return found

    def tolerance_px(self) -> float:
        return max(_TOLERANCE_PX, self.camera.fx_px * float(np.tan(TOLERANCE_RAD)))


def _judge(report: CheckReport, looks: Sequence[Look]) -> None:
    """Find one offset and scale of the mesh, and the views that are off or do not match."""
    with_edges = [view.edges for view in report.views if view.edges is not None]
    report.fit = float(np.median([edges.at_zero for edges in with_edges])) if with_edges else 0.0
    if not with_edges:
        report.warnings.append(
            "no view shows enough edges of the mesh to compare them with the photographs; look at the "
            "pictures"
        )
        return
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
    names = _listed([view.name for view, _ in pairs])
    if report.offset_m is not None:
        said = ", ".join(f"{100 * v:+.1f}" for v in report.offset_m)
        report.warnings.append(
            f"the mesh seems to be moved by ({said}) cm along x, y, z, as seen in {names}; "
            "register it to the cameras again"
        )
    if report.scale != 1:
        report.warnings.append(
            f"the mesh seems to be {report.scale:.3f} times as large as in the cameras' frame, as seen in "
            f"{names}; scale it by {1 / report.scale:.4f} about the cameras' middle"
        )
    left_px = {view.name: view.edges.peak_px for view, _ in pairs if view.edges is not None}
    if mistake is not None:
        left_px = dict(zip(left_px, mistake.left_px, strict=True))
    _judge_zooms(report, looks, mistake)
    is_fitting = len(pairs) >= 0.5 * len(with_edges)
    for view, look in zip(report.views, looks, strict=True):
        if view.edges is not None and not view.warnings:
            _judge_shift(view, look, left_px.get(view.name), is_fitting)


def _judge_zooms(report: CheckReport, looks: Sequence[Look], mistake: Registration | None) -> None:
    """Find views that are rolled or stand too far forward, and a focal length that is off in all of them."""
    zoomed = []
    for view, look in zip(report.views, looks, strict=True):
        warp = view.warp
        if warp is None or view.warnings or warp.at_peak < SURE:
            continue
        moved = 0.0
        if mistake is not None:
            moved = float(mistake.moved_m(look.camera.position_m) @ look.camera.forward) / view.depth_m
        is_rolled = warp.roll_gain >= _SURE_GAIN and abs(warp.roll_rad) >= _LEAST_ROLL_RAD
        excess = abs(warp.zoom - 1 - moved)
        is_zoomed = warp.zoom_gain >= _SURE_GAIN and excess >= max(_LEAST_ZOOM, 0.5 * abs(warp.zoom - 1))
        if is_rolled and (warp.roll_gain >= warp.zoom_gain or not is_zoomed):
            way = "clockwise" if warp.roll_rad > 0 else "anticlockwise"
            view.warnings.append(
                f"{view.name}: its edges are turned by {np.degrees(abs(warp.roll_rad)):.1f} degrees {way} "
                "against the mesh's; the camera is rolled; correct its pose or leave it out"
            )
        elif is_zoomed:
            zoomed.append((view, warp.zoom))
    judged = sum(view.is_judged for view in report.views)
    zooms = [zoom for _, zoom in zoomed]
    if zooms and len(zooms) >= 0.5 * judged and (min(zooms) > 1 or max(zooms) < 1):
        report.warnings.append(
            f"the mesh looks {np.median(zooms):.3f} times too {'small' if zooms[0] > 1 else 'large'} in most "
            f"views ({_listed([view.name for view, _ in zoomed])}); the focal length is off by as much"
        )
        return
    for view, zoom in zoomed:
        size, way = ("small", "backward") if zoom > 1 else ("large", "forward")
        share = abs(zoom - 1)
        view.warnings.append(
            f"{view.name}: the mesh looks {100 * share:.0f} % too {size} in it; the camera stands some "
            f"{100 * share * view.depth_m:.0f} cm too far {way}, or its focal length is off; correct it or "
            "leave the view out"
        )


def _judge_shift(view: ViewCheck, look: Look, left_px: tuple[float, float] | None, is_fitting: bool) -> None:
    """Warn of a view whose edges are off by more than can be, or nowhere near; ``left_px``: what is left of
    its shift, None where its edges do not say where they belong."""
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
            f"{view.name}: its edges are nowhere near the mesh's; it shows another place or its pose is "
            "wrong; correct its pose or leave it out"
        )


def _listed(names: Sequence[str], limit: int = 6) -> str:
    shown = ", ".join(names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more views"


def _try_other_frames(report: CheckReport, capture: Capture, looks: Sequence[Look]) -> None:
    """Whether the mesh fits better with another axis up or another unit, on a few views."""
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
    fitting = "the mesh's edges do not lie on the photographs'"
    if name:
        report.better = name
        report.warnings.append(f"{fitting} (score {now:.1f}); with {name} they do (score {best:.1f})")
    elif report.fit < _MIN_FIT:
        report.warnings.append(
            f"{fitting} (score {report.fit:.1f}, {_MIN_FIT:.0f} would do), and no other up axis or unit does "
            "better; look at the pictures and compare the frames of cameras and mesh"
        )


def _fit_of(capture: Capture, linear: NDArray[np.float64], looks: Sequence[Look]) -> float:
    """Median of score at zero times coverage with the mesh under another transform."""
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    mesh = replace(capture.geometry.mesh.transformed(matrix), normals=None)
    traced = TracedGeometry(CaptureGeometry(mesh, capture.geometry.parts))
    scores = []
    for look in looks:
        geometry = traced.trace_view(look.camera, look.image.valid_mask)
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
    return input_error(capture.name, "geometry", got, "cameras that look at the mesh", remedy)


def _box(low: NDArray, high: NDArray) -> str:
    return " x ".join(f"{a:.3g}...{b:.3g}" for a, b in zip(low, high, strict=True)) + " m"

# SPDX-License-Identifier: MIT
"""Looks at a capture before minutes are spent on it: does the mesh project onto the photographs?

By view: what share shows the mesh, from which side and how near; whether the photograph is black or clipped;
whether the mesh's edges lie on the photograph's, and how far they are off (``check_edges``). Over all views:
whether their shifts are explained by one offset of the mesh, and, where edges do not fit at all, whether
another up axis or unit of the mesh fits better. Every warning names its views and a remedy.
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
from model.reconstruction.check_edges import EdgeMatch, match_edges, mesh_edges, photograph_field
from model.reconstruction.geometry import TracedGeometry, ViewGeometry, seen_sides

MIN_COVERAGE = 0.05  # of a view's pixels; below, the view hardly shows the room that the mesh is of
CLIPPED_LEVEL, MAX_CLIPPED = 0.99, 0.5
_NEAR_M, _MAX_NEAR = 0.05, 0.5  # half a view nearer than this: the camera is in or at a wall
SEARCH_RAD = np.radians(3.5)  # how far off a camera is looked for
_MIN_RADIUS_PX = 24  # enough other shifts to tell a peak from accidents
TOLERANCE_RAD, _TOLERANCE_PX = np.radians(0.35), 1.5
SURE = 5.0  # standard deviations: a peak of this height is no accident
_LOST = 0.6  # of SURE: a view that fits worse, among views that fit, is of another place
_OFFSET_M, _OFFSET_SIGMAS = 0.008, 3.0
_MIN_VIEWS_FOR_OFFSET = 4
_FLOOR_PX2 = 0.25  # added to the blur of a peak: no shift is known better than half a pixel
_OUTLIER = 1.5  # of a peak's blur: views that are further off count less
_EXPLAINED = 0.75  # what the offset must leave at most of the median shift
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
    unknown; ``fit``: median over the views of the edges' score as it stands, in standard deviations."""

    name: str
    views: list[ViewCheck]
    fit: float = 0.0
    offset_m: tuple[float, float, float] | None = None
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
    """Find one offset of the mesh, and the views that are off or do not match."""
    with_edges = [view.edges for view in report.views if view.edges is not None]
    report.fit = float(np.median([edges.at_zero for edges in with_edges])) if with_edges else 0.0
    if not with_edges:
        report.warnings.append(
            "no view shows enough edges of the mesh to compare them with the photographs; look at the "
            "pictures"
        )
        return
    pairs = [(view, look) for view, look in zip(report.views, looks, strict=True) if view.is_judged]
    offset, explained = _common_offset(pairs)
    report.offset_m = offset
    if offset is not None and explained is not None:
        said = ", ".join(f"{100 * v:+.1f}" for v in offset)
        names = _listed([view.name for view, _ in pairs])
        report.warnings.append(
            f"the mesh seems to be moved by ({said}) cm along x, y, z, as seen in {names}; "
            "register it to the cameras again"
        )
    unexplained = {view.name: view.edges.peak_px for view, _ in pairs if view.edges is not None}
    rest = unexplained if explained is None else explained
    is_fitting = len(pairs) >= 0.5 * len(with_edges)
    for view, look in zip(report.views, looks, strict=True):
        if view.edges is None:
            continue
        is_lost = not view.is_judged
        if view.is_judged and view.edges.surely_px(rest[view.name]) > look.tolerance_px():
            shift = float(np.hypot(*rest[view.name]))
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


def _common_offset(
    pairs: Sequence[tuple[ViewCheck, Look]],
) -> tuple[tuple[float, float, float] | None, dict[str, tuple[float, float]] | None]:
    """The offset of the mesh (metres, world) that explains the views' shifts best, and the shifts that remain
    by name; None where it is nothing to speak of.

    A mesh moved by d shows its edges f d_xy / z from where they belong, d in the camera's axes. Robust least
    squares: a view that is off by itself must not move the mesh.
    """
    if len(pairs) < _MIN_VIEWS_FOR_OFFSET:
        return None, None
    rows, shifts, whiten = [], [], []
    for view, look in pairs:
        assert view.edges is not None
        camera_axes = look.camera.world_from_camera[:3, :3].T
        scale = np.array([[look.camera.fx_px], [look.camera.fy_px]]) / max(view.depth_m, 1e-3)
        rows.append(-scale * camera_axes[:2])
        shifts.append(view.edges.peak_px)
        xx, xy, yy = view.edges.blur_px2
        values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]) + _FLOOR_PX2 * np.eye(2))
        whiten.append(vectors @ np.diag(values**-0.5) @ vectors.T)
    a, b = np.array(rows), np.array(shifts)
    a_white, b_white = np.array(whiten) @ a, (np.array(whiten) @ b[..., None])[..., 0]
    weight = np.ones(len(pairs))
    offset = np.zeros(3)
    for _ in range(20):
        w = np.sqrt(weight)[:, None]
        system = (a_white * w[..., None]).reshape(-1, 3)
        offset = np.linalg.lstsq(system, (b_white * w).ravel(), rcond=1e-3)[0]
        left = np.linalg.norm(b_white - a_white @ offset, axis=1)
        weight = 1 / np.maximum(left / _OUTLIER, 1) ** 2
    before, left = np.linalg.norm(b_white, axis=1), np.linalg.norm(b_white - a_white @ offset, axis=1)
    sigma2 = max(float((weight * left**2).sum() / max(2 * weight.sum() - 3, 1)), 0.1)
    normal = np.einsum("v,vki,vkj->ij", weight, a_white, a_white)
    size = float(np.linalg.norm(offset))
    direction = offset / max(size, 1e-12)
    deviation = float(np.sqrt(sigma2 * direction @ np.linalg.pinv(normal) @ direction))
    is_better = float(np.median(left)) < _EXPLAINED * float(np.median(before))
    if size < _OFFSET_M or size < _OFFSET_SIGMAS * deviation or not is_better:
        return None, None
    rest = b - a @ offset
    moved = {view.name: (float(r[0]), float(r[1])) for (view, _), r in zip(pairs, rest, strict=True)}
    return (float(offset[0]), float(offset[1]), float(offset[2])), moved


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

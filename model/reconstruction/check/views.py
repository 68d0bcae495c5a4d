# SPDX-License-Identifier: MIT
"""Views as input of the check, and its results for a view and for a capture."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import luminance
from datagen.geometry.views import TracedView
from model.reconstruction.captures.photographs import CLIPPED_LEVEL
from model.reconstruction.check.edges import (
    EdgeMatch,
    WarpMatch,
    match_edges,
    match_warp,
    mesh_edges,
    photograph_field,
)

MIN_COVERAGE = 0.05  # minimum share of pixels that show the mesh
MAX_CLIPPED = 0.5
_NEAR_M, _MAX_NEAR = 0.05, 0.5  # a camera is in a wall if over _MAX_NEAR of the visible mesh is nearer
SEARCH_RAD = np.radians(3.5)  # maximum rotation error of a camera in the search
_MIN_RADIUS_PX = 24  # ensures enough other shifts to distinguish a peak from chance
TOLERANCE_RAD, _TOLERANCE_PX = np.radians(0.35), 1.5
SURE = 5.0  # standard deviations above which a peak is significant


@dataclass
class ViewCheck:
    """Results of the check of a view.

    ``coverage``: share of pixels that show the mesh; ``back_share``: share of these that show its back;
    ``nearest_m``: minimum depth; ``edges`` and ``warp``: best shift, and best rotation and magnification,
    None if not compared; ``off_deg``: camera rotation that explains the shift, None without edges;
    ``depth_m``: harmonic mean depth of the edges; ``zoom_depth_m``: see ``EdgeView._zoom_depth_m``.
    """

    name: str
    coverage: float
    back_share: float
    nearest_m: float
    edges: EdgeMatch | None = None
    warp: WarpMatch | None = None
    off_deg: float | None = None
    depth_m: float = 0.0
    zoom_depth_m: float = 0.0
    warnings: list[str] = field(default_factory=list)

    @property
    def is_judged(self) -> bool:
        """True if the edges determine the shift significantly."""
        return self.edges is not None and self.edges.at_peak >= SURE


@dataclass
class CheckReport:
    """Results of the check of a capture.

    ``fit``: median over views of the edge score without a shift, in standard deviations; ``offset_m``:
    apparent displacement of the mesh, None if unknown or negligible; ``scale``: its apparent scale relative
    to the cameras; ``better``: option or unit with which a mesh in the wrong frame fits, or empty.
    """

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
        """Warnings about the capture, then warnings about views."""
        return [*self.warnings, *(warning for view in self.views for warning in view.warnings)]

    def table(self) -> dict[str, Any]:
        """Return the content of ``check.json``."""
        return {"format": "scene-materials/check", **asdict(self)}


def view_warnings(view: TracedView) -> list[str]:
    """Return warnings, with remedies, if a photograph hardly shows the mesh, is black or is mostly clipped.

    If the sensor's limit is unknown, white pixels count as clipped, unless some are brighter than white.
    """
    found, name = [], view.name
    coverage = float((view.geometry.face >= 0).mean())
    if coverage == 0:
        found.append(f"{name}: shows nothing of the mesh; correct its pose or leave it out")
    elif coverage < MIN_COVERAGE:
        found.append(
            f"{name}: only {coverage:.1%} of its pixels show the mesh; leave it out if it shows another scene"
        )
    brightness = luminance(view.color)
    if view.clipped_mask is None:
        is_clipped = (brightness >= CLIPPED_LEVEL) & (brightness.max() <= 1.0)
    else:
        is_clipped = view.clipped_mask.all(axis=2)
    if not brightness.any():
        found.append(f"{name}: is black; leave it out")
    elif float(is_clipped.mean()) > MAX_CLIPPED:
        found.append(f"{name}: over half of it is at the sensor's limit; expose less or leave it out")
    return found


class EdgeView(TracedView):
    """A traced view with its edges, which are computed on first use."""

    @cached_property
    def edges(self) -> NDArray[np.bool_]:
        """Mask (H, W) of the mesh's edges."""
        return mesh_edges(self.geometry, self.camera)

    @cached_property
    def field(self) -> NDArray[np.float32]:
        """The photograph's edges (H, W, 2) as double angles."""
        return photograph_field(self.color, self.valid_mask)

    @property
    def radius_px(self) -> int:
        """Largest shift that is searched, in pixels."""
        wanted = max(self.camera.fx_px * float(np.tan(SEARCH_RAD)), _MIN_RADIUS_PX)
        return int(max(6, min(wanted, min(self.camera.width_px, self.camera.height_px) / 4)))

    def checked(self, sides: NDArray[np.float32]) -> ViewCheck:
        """Check the view; ``sides`` (M,): outer side of each triangle, 1 for its front, -1 for its back."""
        hit = self.geometry.face >= 0
        depth = self.geometry.depth_z_m[..., 0]
        is_back = self.geometry.is_front[hit] != (sides[self.geometry.face[hit]] > 0)
        found = ViewCheck(
            self.name,
            coverage=float(hit.mean()),
            back_share=float(is_back.mean()) if hit.any() else 0.0,
            nearest_m=float(depth[hit].min()) if hit.any() else 0.0,
            warnings=view_warnings(self),
        )
        if hit.any() and float((depth[hit] < _NEAR_M).mean()) > _MAX_NEAR:
            found.warnings.append(
                f"{self.name}: most of the visible mesh is nearer than {100 * _NEAR_M:.0f} cm; "
                "the camera is inside a wall or an object, or the unit is wrong (--unit)"
            )
        elif found.back_share > 0.5:
            found.warnings.append(
                f"{self.name}: shows mostly the back of the mesh; the camera is inside a wall or outside the "
                "room; correct its pose or leave it out"
            )
        if not found.warnings:
            found.edges = match_edges(self.edges, self.field, self.radius_px)
            found.warp = match_warp(self.edges, self.field, self.camera, self.radius_px)
            at = self.edges & hit
            if at.any():
                found.depth_m = float(1 / np.mean(1 / depth[at]))
                found.zoom_depth_m = self._zoom_depth_m(at, depth)
        if found.edges is not None:
            is_off = found.edges.surely_px(found.edges.peak_px) > 0
            shift = float(np.hypot(*found.edges.peak_px)) if is_off else 0.0
            found.off_deg = float(np.degrees(np.arctan(shift / self.camera.fx_px)))
        return found

    def _zoom_depth_m(self, at: NDArray[np.bool_], depth: NDArray[np.floating]) -> float:
        """Compute the depth z0 for which a forward camera motion t magnifies the masked edges by 1 + t / z0.

        An edge at distance r from the optical axis and depth z moves outwards by r t / z; one factor is
        fitted to all edges by least squares.
        """
        centers = self.camera.pixel_centers()[at] - [self.camera.cx_px, self.camera.cy_px]
        squared = (centers**2).sum(axis=-1)
        return float(squared.sum() / (squared / depth[at]).sum())

    def tolerance_px(self) -> float:
        """Compute the shift of edges, in pixels, up to which a view counts as correct."""
        return max(_TOLERANCE_PX, self.camera.fx_px * float(np.tan(TOLERANCE_RAD)))

# SPDX-License-Identifier: MIT
"""Checks that depth and cameras of different views agree, by projecting points of one view into others.

A point p of view a, with normal n, is projected into view b, where the pixel's depth gives a point q. Either
q is on p's surface, or q is in front (p is occluded in b, which is allowed), or q is behind, so b shows
something beyond a surface visible in a. For points on one surface the residual is the distance of q from p's
tangent plane, |n . (q - p)| / z: on flat surfaces it is zero wherever p falls within b's pixel, so it
measures errors of depth and pose, not the size of pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera
from datagen.inspection.findings import Fault

POINTS_PER_VIEW = 3000
MAX_PARTNERS = 8
MIN_POINTS = 150
MATCH_DISTANCE = 0.05  # maximum relative depth difference between q and p on one surface
MIN_COSINE = 0.2  # at grazing angles a pixel spans too much depth to compare
# the limits allow for pixels at silhouettes, whose share falls with the resolution
_THROUGH_FLOOR, _THROUGH_PIXELS = 0.04, 8.0
_RESIDUAL_FLOOR, _RESIDUAL_PIXELS = 5e-4, 0.75  # normal maps tilt the plane within a pixel


@dataclass(frozen=True)
class Geometry:
    """Geometry of a view: ``depth_z_m`` and ``is_surface`` (H, W), ``normal`` (H, W, 3) in world space."""

    name: str
    camera: Camera
    depth_z_m: NDArray
    normal: NDArray
    is_surface: NDArray

    @classmethod
    def from_buffers(cls, name: str, camera: Camera, view: dict[str, NDArray]) -> Geometry:
        """Create a view's geometry from its buffers by name; pixels with NaN or Inf are not surface."""
        depth = view["depth_z_m"][..., 0]
        normal = view["normal_world"]
        is_surface = (view["surface_mask"][..., 0] >= 0.5) & (depth > 0)
        is_surface &= np.isfinite(depth) & np.isfinite(normal).all(axis=-1)
        return cls(name, camera, np.nan_to_num(depth), normal, is_surface)


@dataclass(frozen=True)
class Agreement:
    """Agreement of a view's depth with the points of another view; NaN for too few comparable points.

    ``seen_through`` is the share of unoccluded points at which the view's surface is farther away or missing;
    ``median_residual`` is the median distance of the view's surface from the tangent planes at the points,
    relative to depth.
    """

    seen_through: float
    median_residual: float


def sample_points(view: Geometry, seed: int) -> tuple[NDArray, NDArray]:
    """World points and unit normals, (N, 3) each, of up to :data:`POINTS_PER_VIEW` random surface pixels."""
    rng = np.random.default_rng([seed, 0x7265])
    rows, columns = np.nonzero(view.is_surface)
    if len(rows) > POINTS_PER_VIEW:
        chosen = rng.choice(len(rows), POINTS_PER_VIEW, replace=False)
        rows, columns = rows[chosen], columns[chosen]
    pixels = np.stack([columns, rows], axis=-1) + 0.5
    points = view.camera.unproject(pixels, view.depth_z_m[rows, columns])
    normals = view.normal[rows, columns].astype(np.float64)
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    return points, normals / np.where(lengths > 0, lengths, 1)


def compare(points: NDArray, normals: NDArray, other: Geometry) -> Agreement:
    """Project world points (N, 3) with unit normals (N, 3) into view ``other``, and compare the depths."""
    camera = other.camera
    offset = points - camera.position_m
    distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-9)
    pixels, z = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & (pixels >= 0).all(-1) & (pixels < [camera.width_px, camera.height_px]).all(-1)
    inside &= -np.einsum("nc,nc->n", normals, offset) / distance > MIN_COSINE
    points, normals, z, pixels = points[inside], normals[inside], z[inside], pixels[inside]
    columns, rows = pixels.astype(np.int64).T
    seen = other.depth_z_m[rows, columns].astype(np.float64)
    is_blocked = (seen > 0) & (seen < z * (1 - MATCH_DISTANCE))
    is_through = (seen <= 0) | (seen > z * (1 + MATCH_DISTANCE))
    is_match = ~is_blocked & ~is_through
    num_points = int((~is_blocked).sum())
    if num_points < MIN_POINTS:
        return Agreement(np.nan, np.nan)
    through = float(is_through.sum() / num_points)
    if is_match.sum() < MIN_POINTS // 3:
        return Agreement(through, np.nan)
    centres = np.stack([columns, rows], axis=-1) + 0.5
    found = camera.unproject(centres[is_match], seen[is_match])
    gap = np.abs(np.einsum("nc,nc->n", normals[is_match], found - points[is_match])) / z[is_match]
    return Agreement(through, float(np.median(gap)))


def partners_of(index: int, count: int) -> list[int]:
    """Indices of up to :data:`MAX_PARTNERS` evenly spaced views among ``count``, other than ``index``."""
    others = [i for i in range(count) if i != index]
    if len(others) <= MAX_PARTNERS:
        return others
    return [
        others[(index + round(k * len(others) / MAX_PARTNERS)) % len(others)] for k in range(MAX_PARTNERS)
    ]


def check_reprojection(views: Sequence[Geometry], where: str) -> tuple[list[Fault], int]:
    """Return the faults of views that disagree with others, and the number of views that could be compared.

    Views are dropped one by one, the furthest beyond its limits first, until all others are within theirs.
    """
    samples = [sample_points(view, index) for index, view in enumerate(views)]
    pairs = [
        (a, b, compare(*samples[a], views[b])) for a in range(len(views)) for b in partners_of(a, len(views))
    ]
    pairs = [pair for pair in pairs if not np.isnan(pair[2].seen_through)]
    num_compared = len({index for a, b, _ in pairs for index in (a, b)})
    faults = []
    while pairs:
        excess = {index: _excess(pairs, index, views[index]) for a, b, _ in pairs for index in (a, b)}
        worst = max(excess, key=lambda index: excess[index][0])
        ratio, got, expected = excess[worst]
        if ratio <= 1:
            break
        faults.append(Fault("reprojection", f"{where}/{views[worst].name}", got, expected))
        pairs = [pair for pair in pairs if worst not in pair[:2]]
    return faults, num_compared


def _excess(
    pairs: Sequence[tuple[int, int, Agreement]], index: int, view: Geometry
) -> tuple[float, str, str]:
    """The larger ratio of a view's two median deviations to its limit, and the texts of that fault."""
    mine = [agreement for a, b, agreement in pairs if index in (a, b)]
    through = float(np.median([agreement.seen_through for agreement in mine]))
    gaps = [a.median_residual for a in mine if not np.isnan(a.median_residual)]
    gap = float(np.median(gaps)) if gaps else 0.0
    limit = _RESIDUAL_FLOOR + _RESIDUAL_PIXELS / min(view.camera.fx_px, view.camera.fy_px)
    most_through = _THROUGH_FLOOR + _THROUGH_PIXELS / view.camera.width_px
    by_through = (
        through / most_through,
        f"{through:.0%} of its points, or of other views' points in it, have no surface at their depth",
        f"at most {most_through:.0%}",
    )
    by_gap = (
        gap / limit,
        f"surfaces differ by {gap:.2%} of their depth from those of other views",
        f"at most {limit:.2%}",
    )
    return max(by_through, by_gap)

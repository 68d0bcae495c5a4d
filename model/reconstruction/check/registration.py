# SPDX-License-Identifier: MIT
"""Estimates whether a displacement and scale of the mesh explain the shifts in all views.

If mesh points p are displaced to p + d + e (p - m), with m the cameras' mean position, a camera at c observes
the displacement d + e (c - m); the remainder e (p - c) scales the room about the camera, which does not
change its image. The edges in a view are therefore shifted by f (d + e (c - m))_xy / z, in the camera's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera

# minimum reported offset and error of scale, and their minimum in standard deviations
_OFFSET_M, _SCALE, _SIGMAS = 0.008, 0.004, 3.0
_MIN_VIEWS, _MIN_VIEWS_FOR_SCALE = 4, 8
_FLOOR_PX2 = 0.25  # added to a peak's covariance, since shifts are known to half a pixel at best
_OUTLIER = 1.5  # standard deviations of the residual above which a view has less weight
_EXPLAINED = 0.75  # maximum remaining share of the median shift


@dataclass(frozen=True)
class SeenShift:
    """A view's camera, mean edge depth, and ``peak_px`` and ``blur_px2`` of its ``EdgeMatch``."""

    camera: Camera
    depth_m: float
    shift_px: tuple[float, float]
    blur_px2: tuple[float, float, float]


@dataclass(frozen=True)
class Registration:
    """A significant error of the mesh common to all views.

    ``offset_m``: offset of the mesh relative to the cameras, None if insignificant; ``scale``: scale of the
    mesh relative to the cameras, 1 if insignificant; ``left_px``: remaining shift (dx, dy) of each view;
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


def common_mistake(views: Sequence[SeenShift]) -> Registration | None:
    """Estimate the offset and scale of the mesh that best explain all shifts; None if insignificant.

    Least squares are robust to single wrong views. Scale is estimated from eight views or more.
    """
    if len(views) < _MIN_VIEWS:
        return None
    centers = np.array([view.camera.position_m for view in views])
    middle = centers.mean(axis=0)
    rows, whiten = [], []
    for view in views:
        camera = view.camera
        across = camera.world_from_camera[:3, :3].T[:2]
        factor = np.array([[camera.fx_px], [camera.fy_px]]) / max(view.depth_m, 1e-3)
        by_scale = (across @ (camera.position_m - middle))[:, None]
        rows.append(-factor * np.hstack([across, by_scale]))
        xx, xy, yy = view.blur_px2
        values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]) + _FLOOR_PX2 * np.eye(2))
        whiten.append(vectors @ np.diag(values**-0.5) @ vectors.T)
    a, b = np.array(rows), np.array([view.shift_px for view in views])
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
    """Solve ``a`` (V, 2, N) x = ``b`` (V, 2) robustly; return the solution (N,) and its covariance (N, N)."""
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

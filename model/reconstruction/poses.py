# SPDX-License-Identifier: MIT
"""Corrects small errors of camera poses by photometric alignment with other views.

Points on the mesh in a view, away from depth edges and where the image varies, are projected into the views
with the largest overlap. The view's pose is fitted so that its log luminance at the points equals the median
over these views, by Gauss-Newton steps with Cauchy weights and a normal prior (:data:`SPREAD_M`,
:data:`SPREAD_DEG`). All poses are updated at once, in several rounds. The common translation of the cameras
is undetermined: their mean position is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.foundation.axes import affine
from datagen.foundation.cameras import Camera
from datagen.foundation.color import luminance
from datagen.geometry.views import TracedCapture, TracedView
from model.reconstruction.stages import Run

ROUNDS = 6
MAX_POINTS, MAX_OTHERS, MIN_OTHERS, MIN_POINTS = 4000, 8, 2, 100
"""Maximum number of points per view, maximum and minimum number of other views with which they are compared,
and minimum number of points for the correction of a view."""
SPREAD_M, SPREAD_DEG = 0.01, 0.3
"""Prior standard deviations of a pose per axis: translation in metres and rotation in degrees."""
EDGE = 0.03
"""Range of depth within three pixels, relative to the depth, above which a pixel is at a depth edge."""
SAME_DEPTH = 0.02
"""Maximum relative difference of depth at which two views show the same point."""
MIN_GAIN = 0.1
"""Minimum relative reduction of the residual for corrections; without it, correct poses move by half a
pixel."""
_STEP = 0.8  # damping of Gauss-Newton steps, since all views move at once
_CORRELATED = 25.0  # number of neighbouring points with correlated errors


@dataclass(frozen=True)
class MendedPoses:
    """Cameras with corrected poses.

    ``cameras``: in the order of the views, unchanged if the residual decreases by less than :data:`MIN_GAIN`;
    ``moved_mm`` and ``turned_deg`` (V,): lengths of the corrections in mm and degrees; ``residual``: median
    of |ln luminance - median over the other views| before and after the correction.
    """

    cameras: tuple[Camera, ...]
    moved_mm: NDArray[np.float64]
    turned_deg: NDArray[np.float64]
    residual: tuple[float, float]

    @property
    def is_moved(self) -> bool:
        """True if any pose was corrected."""
        return bool(self.moved_mm.any())


@dataclass(frozen=True)
class _ViewImage:
    """Log luminance (H, W) of a view, its derivatives by x and y per pixel, depth in metres (H, W), and
    the points (N, 3) on its surfaces that are compared with other views.
    """

    image: NDArray[np.float32]
    gradient: tuple[NDArray[np.float32], NDArray[np.float32]]
    depth: NDArray[np.float32]
    points: NDArray[np.float64]


def mended_poses(views: Sequence[TracedView]) -> MendedPoses:
    """Correct the camera poses of ``views``, whose colours must have one exposure."""
    view_images = [_view_image(view, number) for number, view in enumerate(views)]
    initial = [view.camera.camera_from_world for view in views]
    poses = [pose.copy() for pose in initial]
    lenses = [view.camera for view in views]
    before = after = 0.0
    for number in range(ROUNDS + 1):
        steps = [_step(view_images, lenses, poses, initial, index) for index in range(len(views))]
        residuals = [residual for _, residual in steps if residual is not None]
        after = float(np.median(residuals)) if residuals else 0.0
        before = before if number else after
        if number < ROUNDS:
            poses = [_transform(step) @ pose for (step, _), pose in zip(steps, poses, strict=True)]
    if after >= (1 - MIN_GAIN) * before:
        nothing = np.zeros(len(views))
        return MendedPoses(tuple(lenses), nothing, nothing, (before, after))
    drift = np.mean([_center(new) - _center(old) for new, old in zip(poses, initial, strict=True)], axis=0)
    cameras, moved, turned = [], [], []
    for lens, pose, old in zip(lenses, poses, initial, strict=True):
        world = np.linalg.inv(pose)
        world[:3, 3] -= drift
        cameras.append(replace(lens, world_from_camera=world))
        moved.append(1000 * float(np.linalg.norm(world[:3, 3] - _center(old))))
        turned.append(np.degrees(Rotation.from_matrix(pose[:3, :3] @ old[:3, :3].T).magnitude()))
    return MendedPoses(tuple(cameras), np.array(moved), np.array(turned), (before, after))


def _center(camera_from_world: NDArray) -> NDArray[np.float64]:
    return np.asarray(-camera_from_world[:3, :3].T @ camera_from_world[:3, 3])


def _transform(step: NDArray) -> NDArray[np.float64]:
    """Make the rigid transform (4, 4) of ``step`` (6,), a rotation vector (radians) and a translation (m)."""
    return affine(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])


def _view_image(view: TracedView, number: int) -> _ViewImage:
    import cv2

    shown = luminance(view.color.astype(np.float64))
    floor = 0.05 * float(np.median(shown[shown > 0])) if (shown > 0).any() else 1.0
    image = cv2.GaussianBlur(np.log(shown + floor).astype(np.float32), (0, 0), 1.0)
    gradient = (
        cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=0.125),
        cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=0.125),
    )
    depth = view.geometry.depth_z_m[..., 0]
    around = np.ones((7, 7), np.uint8)
    is_edge = cv2.dilate(depth, around) - cv2.erode(depth, around) > EDGE * depth
    usable = (depth > 0) & ~is_edge & view.valid_mask & (view.geometry.surface_mask[..., 0] > 0)
    if view.clipped_mask is not None:
        usable &= ~view.clipped_mask.any(axis=2)
    rows, columns = np.nonzero(usable)
    strength = np.hypot(*gradient)[rows, columns]
    random = np.random.default_rng(number).random(len(rows))
    chosen = np.argsort(-(random ** (1 / np.maximum(strength, 1e-6))), kind="stable")[:MAX_POINTS]
    rows, columns = rows[chosen], columns[chosen]
    points = view.camera.unproject(np.stack([columns, rows], axis=1) + 0.5, depth[rows, columns])
    return _ViewImage(image, gradient, depth, points)


def _projected(lens: Camera, pose: NDArray, points: NDArray) -> tuple[NDArray[np.float64], ...]:
    """Project points (N, 3) to camera space (N, 3) and to pixels x and y (N,), with centres at integers."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    z = np.maximum(local[:, 2], 1e-6)
    x = lens.fx_px * local[:, 0] / z + lens.cx_px - 0.5
    return local, x, lens.fy_px * local[:, 1] / z + lens.cy_px - 0.5


def _sampled(image: NDArray, x: NDArray, y: NDArray) -> NDArray[np.float64]:
    """Interpolate an image (H, W) bilinearly at pixels ``x`` and ``y`` (N,), to values (N,)."""
    left = np.clip(np.floor(x).astype(np.int64), 0, image.shape[1] - 2)
    top = np.clip(np.floor(y).astype(np.int64), 0, image.shape[0] - 2)
    u, v = np.clip(x - left, 0, 1), np.clip(y - top, 0, 1)
    upper = image[top, left] * (1 - u) + image[top, left + 1] * u
    return np.asarray(upper * (1 - v) + (image[top + 1, left] * (1 - u) + image[top + 1, left + 1] * u) * v)


def _is_inside(lens: Camera, local: NDArray, x: NDArray, y: NDArray) -> NDArray[np.bool_]:
    within = (x >= 1) & (y >= 1) & (x <= lens.width_px - 2) & (y <= lens.height_px - 2)
    return np.asarray(within & (local[:, 2] > 0))


def _expected(
    view_images: Sequence[_ViewImage], lenses: Sequence[Camera], poses: Sequence[NDArray], index: int
) -> NDArray[np.float64]:
    """Compute the median log luminance (N,) of a view's points in the other views; NaN where fewer than
    ``MIN_OTHERS`` views show a point.
    """
    points, found = view_images[index].points, []
    for other, (view_image, lens, pose) in enumerate(zip(view_images, lenses, poses, strict=True)):
        if other == index:
            continue
        local, x, y = _projected(lens, pose, points)
        seen = _is_inside(lens, local, x, y)
        depth = view_image.depth[np.clip(np.round(y), 0, lens.height_px - 1).astype(np.int64),
                           np.clip(np.round(x), 0, lens.width_px - 1).astype(np.int64)]  # fmt: skip
        seen &= np.abs(local[:, 2] - depth) < SAME_DEPTH * depth
        if seen.sum() >= MIN_POINTS:
            found.append(np.where(seen, _sampled(view_image.image, x, y), np.nan))
    found.sort(key=lambda values: -int(np.isfinite(values).sum()))
    if len(found) < MIN_OTHERS:
        return np.full(len(points), np.nan)
    stack = np.stack(found[:MAX_OTHERS])
    enough = np.isfinite(stack).sum(axis=0) >= MIN_OTHERS
    expected = np.full(len(points), np.nan)
    expected[enough] = np.nanmedian(stack[:, enough], axis=0)
    return expected


def _step(
    view_images: Sequence[_ViewImage],
    lenses: Sequence[Camera],
    poses: Sequence[NDArray],
    initial: Sequence[NDArray],
    index: int,
) -> tuple[NDArray[np.float64], float | None]:
    """Compute the Gauss-Newton step (6,) of a view's pose, a rotation vector and a translation, and the
    median absolute residual; 0 and None with fewer than ``MIN_POINTS`` points.
    """
    view_image, lens = view_images[index], lenses[index]
    local, x, y = _projected(lens, poses[index], view_image.points)
    rest = _sampled(view_image.image, x, y) - _expected(view_images, lenses, poses, index)
    used = np.isfinite(rest) & _is_inside(lens, local, x, y)
    if used.sum() < MIN_POINTS:
        return np.zeros(6), None
    local, x, y, rest = local[used], x[used], y[used], rest[used]
    rest -= np.median(rest)  # removes the remaining difference in exposure
    spread = max(1.4826 * float(np.median(np.abs(rest))), 1e-3)
    weight = 1 / (1 + (rest / (2 * spread)) ** 2) / spread**2 / _CORRELATED
    gx, gy = _sampled(view_image.gradient[0], x, y), _sampled(view_image.gradient[1], x, y)
    px, py, pz = local.T
    by_x, by_y = gx * lens.fx_px / pz, gy * lens.fy_px / pz
    by_z = -(by_x * px + by_y * py) / pz
    jacobian = np.stack(
        [by_z * py - by_y * pz, by_x * pz - by_z * px, by_y * px - by_x * py, by_x, by_y, by_z], axis=1
    )
    prior = np.array([np.radians(SPREAD_DEG)] * 3 + [SPREAD_M] * 3) ** -2.0
    correction = poses[index] @ np.linalg.inv(initial[index])
    moved = np.concatenate([Rotation.from_matrix(correction[:3, :3]).as_rotvec(), correction[:3, 3]])
    hessian = jacobian.T @ (weight[:, None] * jacobian) + np.diag(prior)
    step = np.linalg.solve(hessian, -jacobian.T @ (weight * rest) - prior * moved)
    return _STEP * step, float(np.median(np.abs(rest)))


def mended(traced: TracedCapture, run: Run) -> TracedCapture:
    """Correct the capture's poses and trace it again if the views then agree clearly better."""
    with run.stage("poses"):
        found = mended_poses(traced.views)
        before, after = found.residual
        run.report.poses = {
            "moved_mm": [round(float(value), 2) for value in found.moved_mm],
            "turned_deg": [round(float(value), 3) for value in found.turned_deg],
            "residual": [round(before, 5), round(after, 5)],
        }
        if not found.is_moved:
            run.report.notes.append("poses are unchanged: no correction makes the views agree better")
            return traced
        moved_mm, turned_deg = np.median(found.moved_mm), np.median(found.turned_deg)
        run.report.notes.append(
            f"poses are corrected by {moved_mm:.1f} mm and {turned_deg:.2f} degrees (medians), which reduces "
            f"the difference between views from {100 * before:.1f} % to {100 * after:.1f} %"
        )
        views = tuple(
            replace(view, camera=camera, geometry=traced.geometry.trace_view(camera, view.valid_mask))
            for view, camera in zip(traced.views, found.cameras, strict=True)
        )
        return replace(traced, views=views)

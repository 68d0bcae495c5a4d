# SPDX-License-Identifier: MIT
"""Correction of small pose errors by the photographs of other views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.foundation.cameras import Camera
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from model.reconstruction.poses import mended_poses
from oracles.textured_room import geometry_of, room_mesh
from tests.model.photographed_room import photographed_room

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
SHIFT_M, TURN_DEG = 0.006, 0.25


def off(camera: Camera, seed: int) -> Camera:
    """The camera with a random error of position and rotation."""
    random = np.random.default_rng(seed)
    pose = camera.world_from_camera.copy()
    pose[:3, 3] += random.normal(0, SHIFT_M, 3)
    axis = random.normal(size=3)
    axis *= np.radians(TURN_DEG) / np.linalg.norm(axis)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(axis).as_matrix()
    return replace(camera, world_from_camera=pose)


def traced(cameras: list[Camera]) -> list[TracedView]:
    """The photographs, traced from the given cameras."""
    geometry = TracedGeometry(geometry_of(room_mesh()))
    views = []
    for camera, view in zip(cameras, photographed_room().views, strict=True):
        image = view.read()
        views.append(
            TracedView(camera, image.color, geometry.trace_view(camera), image.valid_mask, view.name)
        )
    return views


def pixels_off(cameras: list[Camera], views: list[TracedView]) -> NDArray[np.float64]:
    """Median distance (px) between projections of each view's points by the given and the true camera."""
    found = []
    for camera, true, view in zip(cameras, (v.camera for v in photographed_room().views), views, strict=True):
        depth = view.geometry.depth_z_m[::9, ::9, 0]
        ways = view.camera.ray_directions()[::9, ::9]
        z = depth / (ways @ view.camera.forward)
        points = (view.camera.position_m + ways * z[..., None])[depth > 0]
        shown = []
        for lens in (camera, true):
            matrix = lens.camera_from_world
            x, y, z = (points @ matrix[:3, :3].T + matrix[:3, 3]).T
            shown.append(np.stack([lens.fx_px * x / z, lens.fy_px * y / z], axis=1))
        found.append(np.median(np.linalg.norm(shown[0] - shown[1], axis=1)))
    return np.array(found)


def test_errors_of_millimetres_and_tenths_of_degrees_are_corrected() -> None:
    cameras = [off(view.camera, number) for number, view in enumerate(photographed_room().views)]
    views = traced(cameras)
    found = mended_poses(views)
    before, after = pixels_off(cameras, views), pixels_off(list(found.cameras), views)
    assert np.median(after) < 0.5 * np.median(before)
    assert found.residual[1] < found.residual[0]
    assert 1 < np.median(found.moved_mm) < 30 and 0.05 < np.median(found.turned_deg) < 0.6


def test_correct_poses_are_kept() -> None:
    views = traced([view.camera for view in photographed_room().views])
    found = mended_poses(views)
    assert (found.moved_mm == 0).all() and found.residual[1] > 0.9 * found.residual[0]


def test_views_without_surfaces_do_not_hide_errors_of_others() -> None:
    """Views of nothing, more than half of all, have no residual."""
    cameras = [off(view.camera, number) for number, view in enumerate(photographed_room().views)]
    views = traced(cameras)
    outside = replace(cameras[0], world_from_camera=cameras[0].world_from_camera.copy())
    outside.world_from_camera[:3, 3] += 100.0
    nothing = replace(traced([outside] * len(views))[0], name="nothing")
    found = mended_poses([*views, *[nothing] * (len(views) + 1)])
    assert found.residual[1] < found.residual[0] and np.median(found.moved_mm[: len(views)]) > 1

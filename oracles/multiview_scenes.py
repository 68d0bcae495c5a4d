# SPDX-License-Identifier: MIT
"""A small scene of axis-aligned boxes with exact depth, normals and occlusion, for the multi-view tests.

The boxes are a floor, a wall and two more, in front of an empty background. One of the cameras is behind the
wall, one faces away from all surfaces, and one is just above the floor. Colours are white noise, so a colour
fetched from a wrong position is detected.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera, look_at
from datagen.multiview.statistics import StatisticsView

BOXES = np.array(  # (box, low/high corner, xyz)
    [
        [[-3.0, -3.0, -0.2], [3.0, 3.0, 0.0]],  # floor
        [[-3.0, 2.0, 0.0], [1.5, 2.2, 2.0]],  # wall
        [[-1.1, -0.3, 0.0], [-0.2, 0.6, 1.1]],
        [[0.4, 0.1, 0.0], [1.3, 0.9, 0.5]],
    ]
)
POSES = (  # position, target
    ((0.3, -4.1, 2.2), (0.0, 0.3, 0.4)),
    ((-2.7, -3.2, 1.7), (0.1, 0.4, 0.5)),
    ((2.9, -2.6, 1.4), (-0.2, 0.5, 0.6)),
    ((3.1, 1.1, 2.6), (-0.3, 0.2, 0.1)),
    ((-0.4, 4.7, 1.23), (0.2, 1.0, 0.9)),  # behind the wall
    ((0.2, -4.4, 1.0), (0.3, -9.0, 1.2)),  # looks away
    ((-3.9, -1.7, 0.12), (0.6, 0.3, 0.15)),  # grazes the floor
    ((0.5, -0.6, 3.4), (0.1, 0.7, 0.0)),
    ((-1.9, -2.2, 0.9), (-0.6, 0.1, 0.5)),  # near
)


def hit_boxes(origins: NDArray, directions: NDArray) -> tuple[NDArray, NDArray]:
    """Ray parameters (N,), Inf without a hit, and outward normals (N, 3) at the first hits of rays (N, 3)."""
    nearest = np.full(len(origins), np.inf)
    normals = np.zeros((len(origins), 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        for low, high in BOXES:
            a, b = (low - origins) / directions, (high - origins) / directions
            enter, leave = np.minimum(a, b), np.maximum(a, b)
            axis = enter.argmax(axis=1)
            t = enter.max(axis=1)
            hit = (t <= leave.min(axis=1)) & (t > 0) & (t < nearest)
            nearest[hit] = t[hit]
            rows = np.nonzero(hit)[0]
            normals[rows] = 0
            normals[rows, axis[hit]] = -np.sign(directions[rows, axis[hit]])
    return nearest, normals


def seen_boxes(camera: Camera) -> tuple[NDArray, NDArray]:
    """Depth along the optical axis (H, W, 1), 0 without a hit, and normals (H, W, 3) at the pixel centres."""
    directions, shape = camera.ray_directions().reshape(-1, 3), (camera.height_px, camera.width_px)
    t, normals = hit_boxes(np.broadcast_to(camera.position_m, directions.shape), directions)
    depth = np.where(np.isfinite(t), t * (directions @ camera.forward), 0)
    return depth.reshape(*shape, 1), normals.reshape(*shape, 3)


def is_occluded(centres: NDArray, points: NDArray) -> NDArray:
    """Mask (N,) of the ``points`` (N, 3) that are occluded from camera ``centres`` (N, 3)."""
    t, _ = hit_boxes(centres, points - centres)
    return t < 1 - 1e-3


def make_views(
    sizes: tuple[tuple[int, int], ...] = ((33, 22),),
    num_views: int = len(POSES),
    is_noise: bool = True,
) -> list[StatisticsView]:
    """Views of the scene at the first ``num_views`` poses, cycling through ``sizes`` (width, height).

    Colours are white noise if ``is_noise``, else normals. 3 % of the pixels count as emitters.
    """
    rng = np.random.default_rng(5)
    views = []
    for index, (position, target) in enumerate(POSES[:num_views]):
        width, height = sizes[index % len(sizes)]
        intrinsics = 0.9 * width, 0.93 * width, 0.5 * width + 0.3, 0.5 * height - 0.2
        camera = Camera(width, height, *intrinsics, look_at(position, target))
        depth, normals = seen_boxes(camera)
        mask = (depth > 0).astype(np.float32)
        emitters = rng.random(mask.shape) < 0.03
        mask[emitters] *= 0.3
        color = rng.random((height, width, 3)) if is_noise else 0.5 + 0.5 * normals
        color, depth, normals = (array.astype(np.float32) for array in (color, depth, normals))
        views.append(StatisticsView(camera, color, depth, normals, mask, f"view_{index:02d}"))
    return views


def mitsuba_scene():
    """The boxes as a Mitsuba scene; the variant must have been selected."""
    import mitsuba as mi

    scene: dict[str, Any] = {"type": "scene"}
    for index, (low, high) in enumerate(BOXES):
        transform = mi.ScalarTransform4f().translate(((low + high) / 2).tolist()) @ (
            mi.ScalarTransform4f().scale(((high - low) / 2).tolist())
        )
        scene[f"box_{index}"] = {"type": "cube", "to_world": transform}
    return mi.load_dict(scene)

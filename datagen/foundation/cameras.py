# SPDX-License-Identifier: MIT
"""Pinhole cameras and their conventions.

World: metres, right-handed, Z up. Camera: x right, y down, z forward. Pixel (column u, row v) has its centre
at (u + 0.5, v + 0.5); intrinsics are in pixels. Transforms are named target_from_source.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.foundation.axes import affine


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion. ``world_from_camera`` is a rigid (4, 4) float64 matrix.

    ``clip_m``: nearest and farthest visible depth along the optical axis; None: no limits.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    world_from_camera: NDArray[np.float64]
    clip_m: tuple[float, float] | None = None

    @property
    def position_m(self) -> NDArray[np.float64]:
        """Centre of projection (3,) in world space, in metres."""
        return self.world_from_camera[:3, 3]

    @property
    def forward(self) -> NDArray[np.float64]:
        """Unit vector (3,) of the optical axis in world space."""
        return self.world_from_camera[:3, 2]

    @property
    def camera_from_world(self) -> NDArray[np.float64]:
        """Inverse of ``world_from_camera``, (4, 4)."""
        inverse = self.world_from_camera[:3, :3].T
        return affine(inverse, -inverse @ self.position_m)

    @property
    def fov_x_rad(self) -> float:
        """Horizontal field of view in radians, for a centred principal point."""
        return float(2 * np.arctan(0.5 * self.width_px / self.fx_px))

    def scaled(self, width_px: int, height_px: int) -> Camera:
        """Return the camera at another resolution, with the intrinsics scaled per axis."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        fx, fy, cx, cy = self.fx_px * sx, self.fy_px * sy, self.cx_px * sx, self.cy_px * sy
        return Camera(width_px, height_px, fx, fy, cx, cy, self.world_from_camera, self.clip_m)

    def project(self, points_world: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Project world points (..., 3) to pixel coordinates (..., 2) and depths (...).

        Depths are along the optical axis, in metres. Coordinates are NaN where the depth is not positive.
        """
        points = np.asarray(points_world, dtype=np.float64)
        local = points @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        z = local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = self.fx_px * local[..., 0] / z + self.cx_px
            v = self.fy_px * local[..., 1] / z + self.cy_px
        pixels = np.stack([u, v], axis=-1)
        pixels[z <= 0] = np.nan
        return pixels, z

    def unproject(self, pixels: ArrayLike, depth_z_m: ArrayLike) -> NDArray[np.float64]:
        """Return the world points (..., 3) at pixel coordinates (..., 2) and depths (...) in metres."""
        pixels = np.asarray(pixels, dtype=np.float64)
        z = np.asarray(depth_z_m, dtype=np.float64)
        x = (pixels[..., 0] - self.cx_px) / self.fx_px * z
        y = (pixels[..., 1] - self.cy_px) / self.fy_px * z
        local = np.stack([x, y, z], axis=-1)
        points: NDArray[np.float64] = local @ self.world_from_camera[:3, :3].T + self.world_from_camera[:3, 3]
        return points

    def pixel_centers(self) -> NDArray[np.float64]:
        """Return the coordinates (u, v) of every pixel's centre, (H, W, 2)."""
        u, v = np.meshgrid(np.arange(self.width_px) + 0.5, np.arange(self.height_px) + 0.5)
        return np.stack([u, v], axis=-1)

    def ray_directions(self) -> NDArray[np.float64]:
        """Return unit vectors (H, W, 3) in world space from the camera through every pixel's centre."""
        ends = self.unproject(self.pixel_centers(), np.ones((self.height_px, self.width_px)))
        directions = ends - self.position_m
        unit: NDArray[np.float64] = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        return unit


def look_at(
    position_m: ArrayLike, target_m: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)
) -> NDArray[np.float64]:
    """Return ``world_from_camera`` (4, 4) of a camera at ``position_m`` that looks at ``target_m``.

    If it looks along ``up``, another axis defines the roll. Raises ``ValueError`` if the points coincide.
    """
    position, target = np.asarray(position_m, dtype=np.float64), np.asarray(target_m, dtype=np.float64)
    forward = target - position
    length = np.linalg.norm(forward)
    if not length > 0:
        raise ValueError(f"camera position and target coincide at {position.tolist()}")
    forward /= length
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-8:
        right = np.cross(forward, [0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    return affine(np.stack([right, down, forward], axis=1), position)

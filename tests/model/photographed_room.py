# SPDX-License-Identifier: MIT
"""Photographs of the textured room, computed by brute force from its true mesh and poses.

A test may then replace mesh, poses or photographs to inject a fault.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.formats.capture import Capture, CaptureView, ColorImage
from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.mesh import Mesh
from oracles.textured_room import geometry_of, materials_at, room_cameras, room_mesh, uv_of_pixels

SIZE = (320, 220)


@dataclass(frozen=True)
class Photograph:
    """Pixels of a photograph, and the maps of the visible surface."""

    color: NDArray[np.float32]
    maps: dict[str, NDArray]

    def read(self, camera: Camera) -> ColorImage:
        return ColorImage(self.color, np.ones(self.color.shape[:2], bool))

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        return {name: self.maps[name] for name in names}


def photograph(mesh: Mesh, camera: Camera, seed: int = 0) -> Photograph:
    """Photograph of the diffuse albedo times a random brightness per quad, with noise of 0.01."""
    uv, depth = uv_of_pixels(mesh, camera)
    maps = materials_at(np.nan_to_num(uv))
    cell = np.floor(np.nan_to_num(uv) * [4, 3]).astype(int)
    quad = cell[..., 1] * 4 + cell[..., 0]
    level = np.random.default_rng(7).permutation(np.linspace(0.25, 0.9, 12))[quad]
    noise = np.random.default_rng(seed).normal(0, 0.01, (*depth.shape, 3))
    color = np.clip((maps["diffuse_albedo"] * level[..., None]) * (depth > 0)[..., None] + noise, 0, 0.98)
    return Photograph(color.astype(np.float32), maps)


@lru_cache(maxsize=4)
def photographed_room(num: int = 10, size: tuple[int, int] = SIZE) -> Capture:
    """The capture of the unchanged room, cached."""
    mesh = room_mesh()
    cameras = room_cameras(num, size)
    views = [
        CaptureView(f"view_{k:02d}", camera, photograph(mesh, camera, k)) for k, camera in enumerate(cameras)
    ]
    return Capture("room", tuple(views), geometry_of(mesh))


def with_mesh(capture: Capture, mesh: Mesh) -> Capture:
    """The capture with another mesh and the same photographs."""
    return replace(capture, geometry=geometry_of(mesh))


def with_view(capture: Capture, index: int, **changes: object) -> Capture:
    """The capture with changed fields of one view."""
    views = list(capture.views)
    views[index] = replace(views[index], **changes)  # type: ignore[arg-type]
    return replace(capture, views=tuple(views))


def with_color(capture: Capture, index: int, color: NDArray) -> Capture:
    """The capture with another photograph in one view."""
    source = capture.views[index].source
    assert isinstance(source, Photograph)
    return with_view(capture, index, source=replace(source, color=color.astype(np.float32)))


def turned(capture: Capture, index: int, degrees: float, axis: tuple[float, float, float]) -> Capture:
    """The capture with one camera rotated about an axis in camera space, its photograph unchanged."""
    camera = capture.views[index].camera
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix()
    return with_view(capture, index, camera=replace(camera, world_from_camera=pose))

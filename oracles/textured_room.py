# SPDX-License-Identifier: MIT
"""A room with a block in it and known, smooth materials: the oracle of the reconstruction tests.

It has twelve quads, each in a cell of a 4 x 3 grid of the atlas: the room's six sides, which face inwards,
and the block's, which face outwards (its bottom is never visible). Materials are smooth functions of the UVs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import Capture, CaptureGeometry, CaptureView, ColorImage, GeometryPart
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.meshes.mesh import Mesh

ROOM = ((0.0, 0.0, 0.0), (4.0, 3.0, 2.5))
BLOCK = ((1.4, 1.1, 0.0), (2.3, 1.8, 0.8))
MARGIN = 0.06  # empty border of a quad's cell in the atlas, as a share of the cell's side
_AXES = (0, 0, 1, 1, 2, 2)


def _quad(low: NDArray, high: NDArray, side: int, is_inward: bool) -> NDArray:
    """Corners (4, 3) of a box's side 0 to 5 (-x, +x, -y ... +z), counter-clockwise from in- or outside."""
    axis, at = _AXES[side], (low, high)[side % 2]
    a, b = (axis + 1) % 3, (axis + 2) % 3
    corners = np.empty((4, 3))
    corners[:, axis] = at[axis]
    corners[:, a] = [low[a], high[a], high[a], low[a]]
    corners[:, b] = [low[b], low[b], high[b], high[b]]
    is_outward = side % 2 == 1  # a x b points along +axis
    return corners if is_outward != is_inward else corners[::-1]


def room_mesh() -> Mesh:
    """The room's mesh: 48 vertices, 24 triangles, non-overlapping UVs and flat normals."""
    quads = [
        _quad(np.array(low), np.array(high), side, is_inward)
        for (low, high), is_inward in ((ROOM, True), (BLOCK, False))
        for side in range(6)
    ]
    positions, uvs, normals, faces = [], [], [], []
    for index, quad in enumerate(quads):
        cell = np.array([index % 4 / 4, index // 4 / 3])
        unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (1 - 2 * MARGIN) + MARGIN
        normal = np.cross(quad[1] - quad[0], quad[2] - quad[0])
        first = 4 * index
        positions.append(quad)
        uvs.append(cell + unit * [1 / 4, 1 / 3])
        normals.append(np.tile(normal / np.linalg.norm(normal), (4, 1)))
        faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    stacked = [np.concatenate(part).astype(np.float32) for part in (positions, normals, uvs)]
    return Mesh(stacked[0], np.array(faces, np.int32), stacked[1], stacked[2])


def materials_at(uv: NDArray) -> dict[str, NDArray[np.float32]]:
    """Maps (..., 3 or 1) in [0.05, 0.8] at UVs (..., 2): waves of one period per cell and axis."""
    u, v = uv[..., 0] * 4 * 2 * np.pi, uv[..., 1] * 3 * 2 * np.pi
    diffuse = np.stack([0.5 + 0.3 * np.sin(u), 0.5 + 0.3 * np.cos(v), 0.4 + 0.2 * np.sin(u + v)], axis=-1)
    specular = np.stack([0.1 + 0.05 * np.cos(u), 0.1 + 0.05 * np.sin(v), 0.2 + 0.1 * np.cos(u - v)], axis=-1)
    roughness = (0.5 + 0.25 * np.sin(v - u))[..., None]
    maps = {"diffuse_albedo": diffuse, "specular_albedo": specular, "roughness": roughness}
    return {name: values.astype(np.float32) for name, values in maps.items()}


def room_cameras(num: int = 10, size: tuple[int, int] = (96, 72), seed: int = 4) -> list[Camera]:
    """``num`` cameras near the walls, directed across the room, with two alternating image sizes."""
    rng = np.random.default_rng(seed)
    cameras = []
    for index in range(num):
        angle = 2 * np.pi * index / num
        eye = [2.0 + 1.7 * np.cos(angle), 1.5 + 1.25 * np.sin(angle), rng.uniform(1.2, 2.2)]
        target = np.array([2.0, 1.5, 0.6]) + rng.uniform(-0.9, 0.9, 3) * [1, 1, 1.5]
        width, height = size if index % 2 == 0 else (size[0] + 8, size[1] - 6)
        intrinsics = 0.62 * width, 0.63 * width, 0.49 * width, 0.52 * height
        cameras.append(Camera(width, height, *intrinsics, look_at(eye, target)))
    return cameras


class MapSource:
    """Image source of a view with ground-truth ``maps``; the diffuse albedo serves as its photograph."""

    def __init__(self, maps: dict[str, NDArray]):
        self.maps = maps

    def read(self, camera: Camera) -> ColorImage:
        color = np.ascontiguousarray(self.maps["diffuse_albedo"], np.float32)
        return ColorImage(color, np.ones(color.shape[:2], bool))

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        return {name: self.maps[name] for name in names}


def geometry_of(mesh: Mesh) -> CaptureGeometry:
    """Geometry of the mesh with a single part and no lamps."""
    return CaptureGeometry(mesh, (GeometryPart("room", 0, len(mesh.faces)),))


def view_maps(mesh: Mesh, camera: Camera) -> dict[str, NDArray]:
    """Exact maps (H, W, C) of a view by float64 ray casting, independent of the tracer under test."""
    uv, _ = uv_of_pixels(mesh, camera)
    return materials_at(np.nan_to_num(uv))


def uv_of_pixels(mesh: Mesh, camera: Camera) -> tuple[NDArray, NDArray]:
    """UVs (H, W, 2), NaN without a hit, and depth [m] (H, W), 0 without a hit, at the pixel centres."""
    assert mesh.uv is not None
    directions = camera.ray_directions().reshape(-1, 3)
    nearest, uv = np.full(len(directions), np.inf), np.full((len(directions), 2), np.nan)
    for face in mesh.faces:
        a, b, c = mesh.positions[face].astype(np.float64)
        e1, e2, rhs = b - a, c - a, camera.position_m - a
        # a + s e1 + t e2 = position + r direction, by Cramer's rule for every direction
        normal = np.cross(e1, e2)
        with np.errstate(divide="ignore", invalid="ignore"):
            r = -(rhs @ normal) / (directions @ normal)
            offset = rhs + r[:, None] * directions
            s = np.cross(offset, e2) @ normal / (normal @ normal)
            t = np.cross(e1, offset) @ normal / (normal @ normal)
            hit = (r > 1e-9) & (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9) & (r < nearest)
        nearest[hit] = r[hit]
        ua, ub, uc = mesh.uv[face].astype(np.float64)
        uv[hit] = ua + s[hit, None] * (ub - ua) + t[hit, None] * (uc - ua)
    shape = (camera.height_px, camera.width_px)
    depth = np.where(np.isfinite(nearest), nearest * (directions @ camera.forward), 0)
    return uv.reshape(*shape, 2), depth.reshape(shape)


def room_capture(
    num: int = 10, size: tuple[int, int] = (96, 72), *, has_equal_views: bool = False
) -> Capture:
    """Capture of the room with ground-truth maps; ``has_equal_views``: equal sizes and square pixels."""
    mesh = room_mesh()
    cameras = room_cameras(num, size)
    if has_equal_views:
        focal = 0.62 * size[0]
        cameras = [
            Camera(*size, focal, focal, size[0] / 2, size[1] / 2, c.world_from_camera) for c in cameras
        ]
    views = [
        CaptureView(f"view_{k:02d}", camera, MapSource(view_maps(mesh, camera)))
        for k, camera in enumerate(cameras)
    ]
    return Capture("room", tuple(views), geometry_of(mesh))

# SPDX-License-Identifier: MIT
"""Writes a folder per room with ``transforms.json``, for nerfstudio, instant-ngp and Gaussian splatting.

Cameras look along -z with y up (OpenGL); the world has Z up and is in metres. All images of a room share one
exposure, since a radiance field would reproduce exposure changes. Depth is along the optical axis, stored as
16-bit PNG in units of ``depth_unit_scale_factor`` metres; ``points.ply`` contains coloured surface points
that initialise Gaussians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.exports.rooms import Export, Room
from datagen.foundation.images import encode_png, shown_bytes

_OPENGL_FROM_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])
_POINTS = 200_000


def export_nerfstudio(export: Export, room: Room) -> None:
    """Write ``transforms.json``, images, depth and points of a room to the folder ``<configuration>``."""
    name = room.configuration.id
    farthest = max(float(view.read("depth_z_m")["depth_z_m"].max()) for view in room.views)
    unit_m = max(1e-3, farthest / 65535)
    generator = np.random.default_rng(room.configuration.seed)
    frames, points, colors = [], [], []
    for view in room.views:
        camera, record = view.camera, view.record
        buffers = view.read("beauty", "depth_z_m", "surface_mask")
        depth = buffers["depth_z_m"][..., 0]
        shown = shown_bytes(buffers["beauty"], room.exposure)
        stored = np.clip(depth / unit_m + 0.5, 0, 65535).astype(np.uint16)
        export.write(f"{name}/images/{record.name}.png", encode_png(shown))
        export.write(f"{name}/depth/{record.name}.png", encode_png(stored))
        frames.append(
            {
                "file_path": f"images/{record.name}.png",
                "depth_file_path": f"depth/{record.name}.png",
                "w": camera.width_px,
                "h": camera.height_px,
                "fl_x": camera.fx_px,
                "fl_y": camera.fy_px,
                "cx": camera.cx_px,
                "cy": camera.cy_px,
                "transform_matrix": (camera.world_from_camera @ _OPENGL_FROM_CAMERA).tolist(),
            }
        )
        rows, columns = np.nonzero((depth > 0) & (buffers["surface_mask"][..., 0] > 0.5))
        count = min(len(rows), _POINTS // len(room.views))
        chosen = generator.choice(len(rows), count, replace=False)
        rows, columns = rows[chosen], columns[chosen]
        points.append(camera.unproject(np.stack([columns, rows], -1) + 0.5, depth[rows, columns]))
        colors.append(shown[rows, columns])
    export.write(f"{name}/points.ply", _point_cloud(np.concatenate(points), np.concatenate(colors)))
    head = {"camera_model": "PINHOLE", "depth_unit_scale_factor": unit_m, "ply_file_path": "points.ply"}
    export.write_json(f"{name}/transforms.json", {**head, "frames": frames})


def _point_cloud(points: NDArray, colors: NDArray[np.uint8]) -> bytes:
    fields = "".join(f"property float {axis}\n" for axis in "xyz")
    fields += "".join(f"property uchar {channel}\n" for channel in ("red", "green", "blue"))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{fields}end_header\n"
    table = np.empty(len(points), np.dtype([("position", "<f4", 3), ("color", "u1", 3)]))
    table["position"], table["color"] = points, colors
    return head.encode() + table.tobytes()

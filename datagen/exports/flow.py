# SPDX-License-Identifier: MIT
"""Writes exact optical flow between views, from depth and cameras: Middlebury ``.flo`` files and masks.

flow(p) = project_b(unproject_a(p, depth_a(p))) - p, in pixels, for every pixel p of view a whose surface
point is in front of camera b; elsewhere 1e10, the format's value for unknown flow. The mask is True where the
point is visible in b: the surface that b shows at this position is of the same instance and near the point,
and its tangent plane passes through the point.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from datagen.exports.rooms import Export, Room
from datagen.foundation.cameras import Camera
from datagen.foundation.images import encode_png

UNKNOWN = 1e10
_COARSE = 8  # pixel step of the coarse flow that selects pairs of views
# relative to distance; normals in half floats have errors of 1e-3, and pixels subtend 1e-3 to 3e-3 rad
_PLANE_TOLERANCE = 4e-3
_NAMES = ("depth_z_m", "normal_world", "instance_id")


def flow_between(
    camera_a: Camera,
    buffers_a: dict[str, NDArray],
    camera_b: Camera,
    buffers_b: dict[str, NDArray],
    step: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the flow (h, w, 2) in pixels from view a to b, and the mask (h, w) of points visible in b.

    Only every ``step``-th row and column of view a is used. Buffers are stored arrays (H, W, C) by name.
    """
    depth = buffers_a["depth_z_m"][::step, ::step, 0].astype(np.float64)
    pixels = camera_a.pixel_centers()[::step, ::step]
    points = camera_a.unproject(pixels, depth)
    ends, depth_b = camera_b.project(points)
    known = (depth > 0) & (depth_b > 1e-6)
    flow = np.where(known[..., None], ends - pixels, UNKNOWN)
    column, row = (np.floor(np.where(known, ends[..., k], -1.0)).astype(np.int64) for k in (0, 1))
    inside = known & (column >= 0) & (row >= 0) & (column < camera_b.width_px) & (row < camera_b.height_px)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    seen_depth = buffers_b["depth_z_m"][row, column, 0].astype(np.float64)
    seen = camera_b.unproject(np.stack([column, row], axis=-1) + 0.5, seen_depth)
    normal = buffers_b["normal_world"][row, column].astype(np.float64)
    distance = np.linalg.norm(points - camera_b.position_m, axis=-1)
    is_in_plane = np.abs(((points - seen) * normal).sum(-1)) < _PLANE_TOLERANCE * distance
    same = buffers_b["instance_id"][row, column, 0] == buffers_a["instance_id"][::step, ::step, 0]
    near = np.linalg.norm(points - seen, axis=-1) < 0.05 * distance  # not another surface in the same plane
    is_seen = inside & (seen_depth > 0) & is_in_plane & same & near
    return flow.astype(np.float32), is_seen


def encode_flo(flow: NDArray[np.float32]) -> bytes:
    """Encode flow (H, W, 2) in Middlebury's format: ``PIEH``, width, height, then (u, v) row by row."""
    height, width = flow.shape[:2]
    return b"PIEH" + struct.pack("<ii", width, height) + flow.astype("<f4").tobytes()


def export_flow(export: Export, room: Room) -> None:
    """Write images, and the flow from each view to the ``neighbours`` views that show most of its points.

    Views that show less than ``min_overlap`` of the points are left out. ``pairs.json`` lists the files.
    """
    name, views = room.configuration.id, room.views
    read = [view.read(*_NAMES) for view in views]
    cameras = [view.camera for view in views]
    pairs = []
    for a, view in enumerate(views):
        shares = []
        for b in range(len(views)):
            if a != b:
                _, is_seen = flow_between(cameras[a], read[a], cameras[b], read[b], _COARSE)
                shares.append((-float(is_seen.mean()), b))
        export.write_picture(
            f"{name}/images/{view.record.name}.png", view.read("beauty")["beauty"], room.exposure
        )
        for share, b in sorted(shares)[: export.neighbours]:
            if -share < export.min_overlap:
                continue
            flow, is_seen = flow_between(cameras[a], read[a], cameras[b], read[b])
            stem = f"{view.record.name}_to_{views[b].record.name}"
            export.write(f"{name}/flow/{stem}.flo", encode_flo(flow))
            export.write(f"{name}/visible/{stem}.png", encode_png(np.where(is_seen, 255, 0).astype(np.uint8)))
            pairs.append(
                {
                    "from": view.record.name,
                    "to": views[b].record.name,
                    "flow": f"flow/{stem}.flo",
                    "visible": f"visible/{stem}.png",
                    "visible_share": round(float(is_seen.mean()), 4),
                }
            )
    export.write_json(f"{name}/pairs.json", {"configuration": name, "pairs": pairs})

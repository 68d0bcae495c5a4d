# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs Blender's Smart UV Project in a separate process, for pieces of a mesh on which xatlas fails.

``python -m model.reconstruction.unwrap.blender_process IN.npz OUT.npz`` has the files of ``xatlas_process``.
It needs the Python module bpy; the exit code is 3 if it is not installed.
"""

from __future__ import annotations

import sys

import numpy as np

PACK_RESOLUTION, PADDING = 1024, 2
_ANGLE_RAD = 1.15  # Blender's own default, 66 degrees


def main(source: str, target: str) -> None:
    """Unwrap the mesh in the file ``source`` and write the result to the file ``target``."""
    try:
        import bpy
    except ImportError:
        raise SystemExit(3) from None
    with np.load(source) as data:
        positions, faces = data["positions"].astype(np.float64), data["faces"]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh = bpy.data.meshes.new("piece")
    mesh.from_pydata(positions.tolist(), [], faces.tolist())
    if len(mesh.polygons) != len(faces):
        raise SystemExit("Blender did not accept every triangle")
    layer = mesh.uv_layers.new(name="UVMap")
    piece = bpy.data.objects.new("piece", mesh)
    bpy.context.scene.collection.objects.link(piece)
    bpy.context.view_layer.objects.active = piece
    piece.select_set(True)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.uv.smart_project(
        angle_limit=_ANGLE_RAD,
        margin_method="FRACTION",
        island_margin=PADDING / PACK_RESOLUTION,
        area_weight=0.0,
        correct_aspect=False,
        scale_to_bounds=False,
    )
    bpy.ops.object.mode_set(mode="OBJECT")
    layer = mesh.uv_layers[0]
    flat = np.empty(len(layer.data) * 2, np.float32)
    layer.data.foreach_get("uv", flat)
    loops = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", loops)
    if not np.array_equal(loops.reshape(-1, 3), faces):
        raise SystemExit("Blender changed the order of the triangles")
    corners = flat.reshape(-1, 3, 2).astype(np.float64)
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    uv_areas = 0.5 * np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])
    p = positions[faces]
    areas = 0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    is_placed = uv_areas > 1e-12
    if not is_placed.any():
        raise SystemExit("Blender's UVs have no area")
    metres = float(np.sqrt(areas[is_placed].sum() / uv_areas[is_placed].sum()))
    corners = (corners - corners[is_placed].min(axis=(0, 1))) * metres
    size = corners[is_placed].max(axis=(0, 1)) + metres * PADDING / PACK_RESOLUTION
    np.savez(target, corners=corners, size_m=size, is_placed=is_placed)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])

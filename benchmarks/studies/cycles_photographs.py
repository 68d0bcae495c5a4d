# SPDX-License-Identifier: GPL-3.0-or-later
"""The bpy part of colmap_end_to_end.py: renders a room's views with Cycles, and simplifies its mesh.

    python -m benchmarks.studies.cycles_photographs render BLEND OUT --samples 32 --f-stop 4 --focus 2.5
    python -m benchmarks.studies.cycles_photographs retopology BLEND OUT.ply --triangles 20000

``render`` writes one linear EXR (half) per camera of the .blend of ``cycles_baseline build``, with the depth
of field of a full-frame camera; existing files are kept. ``retopology`` joins the contents of the room, welds
vertices and collapses edges; the result has no UVs.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from benchmarks.studies.cycles_baseline import Sampling, look_through, set_up

OUTSIDE = "room/outside"  # lawn and hedge, which no user would model
_WELD_M = 2e-4


def render(arguments: argparse.Namespace) -> None:
    """Render the view of each camera whose file does not exist."""
    import bpy

    bpy.ops.wm.open_mainfile(filepath=str(arguments.blend.resolve()), use_scripts=False)
    scene = bpy.context.scene
    set_up(scene, Sampling(samples=arguments.samples))
    image = scene.render.image_settings
    image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGB", "16"
    lens = scene.camera.data
    lens.dof.use_dof = arguments.f_stop > 0
    lens.dof.focus_distance = arguments.focus
    lens.dof.aperture_fstop = max(arguments.f_stop, 0.1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for camera in json.loads(bpy.data.texts["cameras"].as_string()):
        path = (arguments.out / f"{camera['name']}.exr").resolve()
        if path.is_file():
            continue
        look_through(scene, camera, 1.0)
        partial = path.with_name(f"partial-{path.name}")
        scene.render.filepath = str(partial)
        bpy.ops.render.render(write_still=True)
        partial.replace(path)


def retopology(arguments: argparse.Namespace) -> None:
    """Write one mesh of about ``--triangles`` triangles, as PLY in the world's frame."""
    import bpy  # isort: split
    import bmesh

    bpy.ops.wm.open_mainfile(filepath=str(arguments.blend.resolve()), use_scripts=False)
    scene = bpy.context.scene
    joined = bmesh.new()
    for thing in list(scene.objects):
        if thing.type == "MESH" and not thing.name.startswith(OUTSIDE):
            first = len(joined.verts)
            joined.from_mesh(thing.data)
            joined.verts.ensure_lookup_table()
            bmesh.ops.transform(joined, matrix=thing.matrix_world, verts=joined.verts[first:])
    bmesh.ops.remove_doubles(joined, verts=joined.verts, dist=_WELD_M)
    bmesh.ops.triangulate(joined, faces=joined.faces)
    mesh = bpy.data.meshes.new("retopology")
    num = len(joined.faces)
    joined.to_mesh(mesh)
    whole: Any = bpy.data.objects.new("retopology", mesh)
    scene.collection.objects.link(whole)
    modifier = whole.modifiers.new("decimate", "DECIMATE")
    modifier.ratio = min(1.0, arguments.triangles / num)
    modifier.use_collapse_triangulate = True
    for thing in list(scene.objects):
        thing.select_set(thing is whole)
    bpy.context.view_layer.objects.active = whole
    bpy.ops.wm.ply_export(
        filepath=str(arguments.out.resolve()),
        export_selected_objects=True,
        apply_modifiers=True,
        export_triangulated_mesh=True,
        export_uv=False,
        export_normals=False,
        export_attributes=False,
        forward_axis="Y",
        up_axis="Z",
    )
    print(f"{num} triangles, welded; collapsed with ratio {modifier.ratio:.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    command = verbs.add_parser("render")
    command.add_argument("blend", type=Path)
    command.add_argument("out", type=Path)
    command.add_argument("--samples", type=int, default=32)
    command.add_argument("--f-stop", type=float, default=4.0, help="0: everything is sharp")
    command.add_argument("--focus", type=float, default=2.5, help="metres")
    command = verbs.add_parser("retopology")
    command.add_argument("blend", type=Path)
    command.add_argument("out", type=Path)
    command.add_argument("--triangles", type=int, default=20000)
    arguments = parser.parse_args()
    if arguments.verb == "render":
        render(arguments)
    else:
        retopology(arguments)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: GPL-3.0-or-later
"""Exports a room whose three walls share a graph on object coordinates, and two stools of the same oak.

``python -m tests.blender_addon.one_material OUT`` writes ``first/``, and ``again/`` after an import.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

ROOM = "plastered_room"


def _graph(bpy: Any, name: str, main_class: str, replaceable_by: str, coordinates: str) -> Any:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material["sm_class"], material["sm_replaceable_by"] = main_class, replaceable_by
    tree = material.node_tree
    noise, ramp = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = (0.4, 0.35, 0.3, 1)
    ramp.color_ramp.elements[1].color = (0.7, 0.65, 0.6, 1)
    tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs[coordinates], noise.inputs["Vector"])
    tree.links.new(noise.outputs[0], ramp.inputs[0])
    tree.links.new(ramp.outputs[0], tree.nodes["Principled BSDF"].inputs["Base Color"])
    return material


def _box(bpy: Any, collection: Any, name: str, low: Any, high: Any, material: Any) -> None:
    mesh = bpy.data.meshes.new(name)
    corners = [(x, y, z) for z in (low[2], high[2]) for y in (low[1], high[1]) for x in (low[0], high[0])]
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    mesh.from_pydata(corners, [], faces)
    mesh.materials.append(material)
    collection.objects.link(bpy.data.objects.new(name, mesh))


def _export(bpy: Any, folder: Path) -> None:
    from blender_addon.export import export
    from blender_addon.settings import ExportSettings

    bpy.context.view_layer.update()
    export(folder, ExportSettings(max_texture_px=64, license="CC0-1.0"))


def main(out: Path) -> None:
    """Build, export, import and export again."""
    import bpy

    from blender_addon.import_package import import_package

    bpy.ops.wm.read_factory_settings(use_empty=True)
    room = bpy.data.collections.new(ROOM)
    room["sm_role"], room["sm_id"] = "environment", ROOM
    bpy.context.scene.collection.children.link(room)
    plaster = _graph(bpy, "plaster", "plaster", "plaster, painted", "Object")
    oak = _graph(bpy, "oak", "wood", "wood", "Generated")
    for number, (low, high) in enumerate(
        (((0, 4, 0), (5, 4.1, 3)), ((-0.1, 0, 0), (0, 4, 3)), ((5, 0, 0), (5.1, 4, 3)))
    ):
        _box(bpy, room, f"wall {number}", low, high, plaster)
    for number, x in enumerate((1, 3)):
        _box(bpy, room, f"stool {number}", (x, 1, 0), (x + 0.4, 1.4, 0.45), oak)
    paint = bpy.data.materials.new("paint")
    paint.use_nodes = True
    paint["sm_class"], paint["sm_replaceable_by"] = "painted", "painted"
    paint["sm_surface"] = "furniture"
    lacquer = bpy.data.materials.new("lacquer")
    lacquer.use_nodes = True
    lacquer["sm_role"], lacquer["sm_class"], lacquer["sm_surfaces"] = "material", "painted", "legs, frame"
    _box(bpy, room, "shelf", (0, 2, 1), (0.3, 3, 1.05), paint)
    _export(bpy, out / "first")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    import_package(out / "first" / ROOM)
    import_package(out / "first" / "lacquer")
    _export(bpy, out / "again")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

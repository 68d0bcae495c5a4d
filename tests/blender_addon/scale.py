# SPDX-License-Identifier: GPL-3.0-or-later
"""Times the export of large scenes; prints JSON: ``python -m tests.blender_addon.scale OUT [NAME...]``."""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np


def _grid(bpy: Any, name: str, side: int, materials: list[Any]) -> Any:
    """Create a bumpy square of side^2 quads, divided into one block of faces per material."""
    ticks = np.linspace(0, 1, side + 1, dtype=np.float32)
    x, y = np.meshgrid(ticks, ticks)
    z = 0.02 * np.sin(40 * x) * np.cos(30 * y)
    mesh = bpy.data.meshes.new(name)
    i, j = np.meshgrid(np.arange(side), np.arange(side))
    first = (i + j * (side + 1)).ravel()
    quads = np.stack([first, first + 1, first + side + 2, first + side + 1], axis=1).astype(np.int32)
    mesh.vertices.add(x.size)
    mesh.vertices.foreach_set("co", np.stack([x, y, z], axis=-1).ravel())
    mesh.loops.add(quads.size)
    mesh.loops.foreach_set("vertex_index", quads.ravel())
    mesh.polygons.add(len(quads))
    mesh.polygons.foreach_set("loop_start", np.arange(0, quads.size, 4, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(len(quads), bool))
    layer = mesh.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.stack([x.ravel(), y.ravel()], axis=1)[quads.ravel()].ravel())
    for material in materials:
        mesh.materials.append(material)
    blocks = np.arange(len(quads)) * max(len(materials), 1) // len(quads)
    mesh.polygons.foreach_set("material_index", blocks.astype(np.int32))
    mesh.update(calc_edges=True)
    return mesh


def _material(bpy: Any, index: int) -> Any:
    material = bpy.data.materials.new(f"material {index}")
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (0.2 + 0.003 * index, 0.5, 0.3, 1)
    if index % 2:
        noise, coordinates = (
            material.node_tree.nodes.new(f"ShaderNode{n}") for n in ("TexNoise", "TexCoord")
        )
        noise.inputs["Scale"].default_value = 3 + index % 7
        material.node_tree.links.new(coordinates.outputs["UV"], noise.inputs["Vector"])
        material.node_tree.links.new(noise.outputs["Color"], shader.inputs["Base Color"])
    return material


def _export(bpy: Any, out: Path, measured: dict[str, float], name: str, **values: Any) -> None:
    from blender_addon.export import export
    from blender_addon.settings import ExportSettings

    settings = ExportSettings(kind="environment", license="CC0-1.0", **values)
    start, cpu = time.perf_counter(), time.process_time()
    export(out, settings)
    measured[f"{name}_s"] = time.perf_counter() - start
    measured[f"{name}_cpu_s"] = time.process_time() - cpu


def million_triangles(bpy: Any) -> dict[str, Any]:
    """Add a mesh of a million triangles with a constant material, which needs no baking."""
    mesh = _grid(bpy, "million", 708, [_material(bpy, 0)])
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("million", mesh))
    return {}


def room(bpy: Any) -> dict[str, Any]:
    """Add 2,000 instances of 40 meshes (4M triangles) with 200 materials, half of which are procedural."""
    materials = [_material(bpy, index) for index in range(200)]
    meshes = [_grid(bpy, f"mesh {i}", 224, materials[5 * i : 5 * i + 5]) for i in range(40)]
    for index in range(2000):
        thing = bpy.data.objects.new(f"thing {index}", meshes[index % 40])
        thing.location = (index % 50, index // 50, 0)
        bpy.context.scene.collection.objects.link(thing)
    return {"max_texture_px": 512}


def three_channels_1024_px(bpy: Any) -> dict[str, Any]:
    """Add a square whose material has three procedural channels, each of which needs 1024 px."""
    material = _material(bpy, 1)
    noise = next(n for n in material.node_tree.nodes if n.type == "TEX_NOISE")
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = 200, 8
    shader = material.node_tree.nodes["Principled BSDF"]
    for name in ("Roughness", "Metallic"):
        material.node_tree.links.new(noise.outputs[0], shader.inputs[name])
    thing = bpy.data.objects.new("sample", _grid(bpy, "sample", 4, [material]))
    bpy.context.scene.collection.objects.link(thing)
    return {"max_texture_px": 1024}


SCENES = {build.__name__: build for build in (million_triangles, room, three_channels_1024_px)}


def main(out: Path, names: Sequence[str]) -> None:
    """Export the named scenes to ``OUT/<name>``; print wall and processor seconds."""
    import bpy

    measured: dict[str, float] = {}
    for name in names:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        values = SCENES[name](bpy)
        bpy.context.view_layer.update()
        _export(bpy, out / name, measured, name, **values)
    measured["peak_memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print("\n" + json.dumps(measured))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:] or list(SCENES))

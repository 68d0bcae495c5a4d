# SPDX-License-Identifier: GPL-3.0-or-later
"""Assembles the Poly Haven living room from its layout, renders it with Cycles and exports it.

``python -m tests.blender_addon.living_room ASSETS OUT [--width W] [--samples N]`` writes the .blend file, the
package ``OUT/packages/living_room`` and ``OUT/cycles.npy`` (two images of N samples, 2 x H x W x 3, linear),
and prints the remarks of the export as JSON. ASSETS is the folder with the layout and ``assets/``.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml

LAYOUT = "furnished_living_room.dmd.yaml"
# Mesh file of each model in the layout.
MESHES = {
    "living_room": "living_room", "cabinet": "painted_wooden_cabinet_1k",
    "bookshelves": "wooden_bookshelf_worn_1k", "tall_cabinet": "painted_wooden_cabinet_02_1k",
    "sofa": "sofa_03_1k", "stool": "painted_wooden_stool_1k", "curtain_open": "curtain_open",
}  # fmt: skip
BOUNCES = 6
MITSUBA_DEPTH = BOUNCES + 2  # Mitsuba counts segments from the camera to the light


class _Layout(yaml.SafeLoader):
    """YAML loader that reads ``!Rpy`` rotations as dictionaries."""


_Layout.add_constructor("!Rpy", lambda loader, node: loader.construct_mapping(node, deep=True))


def placements(layout: Path) -> list[tuple[str, np.ndarray]]:
    """Mesh file and ``world_from_model`` (4, 4) of each model; rotations are about the fixed axes x, y, z."""
    meshes, poses = {}, []
    for directive in yaml.load(layout.read_text(), _Layout)["directives"]:
        if "add_model" in directive:
            model = directive["add_model"]
            meshes[model["name"]] = MESHES[Path(model["file"]).stem]
            continue
        weld = directive["add_weld"]
        offset = weld.get("X_PC", {})
        roll, pitch, yaw = np.radians(offset.get("rotation", {}).get("deg", (0, 0, 0)))
        pose = np.eye(4)
        pose[:3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
        pose[:3, 3] = offset.get("translation", (0, 0, 0))
        poses.append((meshes[weld["child"].split("::")[0]], pose))
    return poses


def _about(axis: int, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return matrix


def assemble(bpy: Any, assets: Path) -> None:
    """Build the furnished room in an empty file, with four lamps under its ceiling and a camera."""
    from mathutils import Matrix

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    for mesh, pose in placements(assets / LAYOUT):
        before = set(bpy.data.objects)
        bpy.ops.import_scene.gltf(filepath=str(assets / "assets" / f"{mesh}.gltf"))
        for thing in set(bpy.data.objects) - before:
            if thing.parent is None:
                thing.matrix_world = Matrix(pose.tolist()) @ thing.matrix_world
    _drop_missing_images(bpy)
    for index, (x, y) in enumerate(((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))):
        data = bpy.data.lights.new(f"lamp_{index}", "AREA")
        data.shape, data.size, data.energy, data.color = "DISK", 0.3, 70, (1, 0.85, 0.7)
        lamp = bpy.data.objects.new(f"lamp_{index}", data)
        lamp.location = (x, y, 3.1)
        scene.collection.objects.link(lamp)
    data = bpy.data.cameras.new("camera")
    data.lens, data.clip_start = 15, 0.01
    camera = bpy.data.objects.new("camera", data)
    camera.location = (-2.8, 0.0, 1.6)
    direction = np.array([1.0, -0.1, 0.95]) - np.array(camera.location)
    camera.rotation_euler = (
        math.pi / 2 + math.atan2(direction[2], math.hypot(*direction[:2])), 0,
        math.atan2(direction[1], direction[0]) - math.pi / 2,
    )  # fmt: skip
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene["sm_id"], scene["sm_title"], scene["sm_license"] = "living_room", "Living room", "CC0-1.0"


def _drop_missing_images(bpy: Any) -> None:
    """Remove the door's missing normal map, which the exporter would refuse and Cycles renders magenta."""
    for material in bpy.data.materials:
        for node in list(material.node_tree.nodes):
            if node.type == "TEX_IMAGE" and not node.image.has_data and not node.image.size[0]:
                material.node_tree.nodes.remove(node)


def prepare_cycles(scene: Any, width: int, samples: int) -> None:
    """Set up path tracing with Mitsuba's number of bounces, without clamp, Filter Glossy or denoiser."""
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = width, width * 5 // 8
    cycles = scene.cycles
    cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = samples, False, False
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = BOUNCES
    cycles.sample_clamp_indirect, cycles.blur_glossy, cycles.light_sampling_threshold = 0, 0, 0


def main(assets: Path, out: Path, width: int, samples: int) -> None:
    """Assemble, save, export and render."""
    import bpy

    from blender_addon.cycles import render_linear
    from blender_addon.export import export
    from blender_addon.settings import ExportSettings

    out.mkdir(parents=True, exist_ok=True)
    assemble(bpy, assets)
    prepare_cycles(bpy.context.scene, width, samples)
    bpy.context.view_layer.update()
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "living_room.blend"))
    result = export(out / "packages", ExportSettings(kind="environment", bake_normals=True))
    images = []
    for seed in range(2):
        bpy.context.scene.cycles.seed = seed
        images.append(render_linear(bpy.context.scene))
    np.save(out / "cycles.npy", np.stack(images))
    print("\n" + json.dumps([str(problem) for problem in result.problems]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("assets", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--samples", type=int, default=64)
    arguments = parser.parse_args()
    main(arguments.assets, arguments.out, arguments.width, arguments.samples)

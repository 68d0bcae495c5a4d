# SPDX-License-Identifier: GPL-3.0-or-later
"""Exports a floor under each light and cameras of every sensor fit, renders with Cycles, prints JSON.

``python -m tests.blender_addon.lights_and_cameras OUT`` writes ``packages/<name>`` and ``cycles/<name>.npy``.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

WIDTH, HEIGHT, SAMPLES = 48, 36, 128
LIGHTS: dict[str, Callable[[Any, Any], None]] = {}


def light(build: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
    LIGHTS[build.__name__] = build
    return build


def _add(bpy: Any, kind: str, height: float = 1.5, **values: Any) -> Any:
    data = bpy.data.lights.new(kind, kind)
    for name, value in values.items():
        setattr(data, name, value)
    thing = bpy.data.objects.new(kind, data)
    thing.location = (0.2, -0.1, height)
    thing.rotation_euler = (0.2, -0.15, 0.3)
    bpy.context.scene.collection.objects.link(thing)
    return thing


@light
def point(bpy: Any, scene: Any) -> None:
    _add(bpy, "POINT", energy=60, color=(1, 0.7, 0.4), shadow_soft_size=0)


@light
def sphere(bpy: Any, scene: Any) -> None:
    _add(bpy, "POINT", energy=60, shadow_soft_size=0.2, exposure=1, use_soft_falloff=False)


@light
def sphere_with_soft_falloff(bpy: Any, scene: Any) -> None:
    _add(bpy, "POINT", energy=60, shadow_soft_size=0.1)


@light
def sphere_not_normalized(bpy: Any, scene: Any) -> None:
    _add(bpy, "POINT", energy=60, shadow_soft_size=0.2, normalize=False, use_soft_falloff=False)


@light
def area_square(bpy: Any, scene: Any) -> None:
    _add(bpy, "AREA", energy=60, shape="SQUARE", size=0.8).scale = (1, 1.5, 1)


@light
def area_rectangle(bpy: Any, scene: Any) -> None:
    _add(bpy, "AREA", energy=60, shape="RECTANGLE", size=0.8, size_y=0.3)


@light
def area_disk(bpy: Any, scene: Any) -> None:
    _add(bpy, "AREA", energy=60, shape="DISK", size=0.9)


@light
def area_ellipse_not_normalized(bpy: Any, scene: Any) -> None:
    _add(bpy, "AREA", energy=20, shape="ELLIPSE", size=0.9, size_y=0.4, normalize=False)


@light
def sun_sharp(bpy: Any, scene: Any) -> None:
    _add(bpy, "SUN", energy=3, angle=0)


@light
def sun_disc(bpy: Any, scene: Any) -> None:
    _add(bpy, "SUN", energy=3, angle=math.radians(10))


@light
def spot_hard(bpy: Any, scene: Any) -> None:
    _add(bpy, "SPOT", energy=200, spot_size=math.radians(50), spot_blend=0, shadow_soft_size=0)


@light
def spot_soft(bpy: Any, scene: Any) -> None:
    _add(bpy, "SPOT", energy=200, spot_size=math.radians(50), spot_blend=0.5, shadow_soft_size=0)


@light
def scaled_units(bpy: Any, scene: Any) -> None:
    scene.unit_settings.scale_length = 0.1
    _add(bpy, "POINT", energy=60, shadow_soft_size=0)


@light
def emissive_mesh(bpy: Any, scene: Any) -> None:
    mesh = bpy.data.meshes.new("panel")
    mesh.from_pydata([(-0.4, -0.4, 0), (-0.4, 0.4, 0), (0.4, 0.4, 0), (0.4, -0.4, 0)], [], [(0, 1, 2, 3)])
    material = bpy.data.materials.new("panel")
    material.use_nodes = True
    shader = material.node_tree.nodes.new("ShaderNodeEmission")
    shader.inputs["Color"].default_value = (1, 0.8, 0.5, 1)
    shader.inputs["Strength"].default_value = 7
    output = material.node_tree.nodes["Material Output"]
    material.node_tree.links.new(shader.outputs[0], output.inputs["Surface"])
    mesh.materials.append(material)
    thing = bpy.data.objects.new("panel", mesh)
    thing.location = (0, 0, 1.5)
    scene.collection.objects.link(thing)


def _world(bpy: Any, scene: Any) -> Any:
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    scene.world = world
    return world.node_tree


@light
def world_constant(bpy: Any, scene: Any) -> None:
    node = _world(bpy, scene).nodes["Background"]
    node.inputs["Color"].default_value = (0.5, 0.7, 1, 1)
    node.inputs["Strength"].default_value = 1.5


@light
def world_graph(bpy: Any, scene: Any) -> None:
    tree = _world(bpy, scene)
    gradient, coordinates = tree.nodes.new("ShaderNodeTexGradient"), tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(coordinates.outputs["Generated"], gradient.inputs[0])
    tree.links.new(gradient.outputs[0], tree.nodes["Background"].inputs[0])


@light
def world_image_turned(bpy: Any, scene: Any) -> None:
    tree = _world(bpy, scene)
    texture, mapping = tree.nodes.new("ShaderNodeTexEnvironment"), tree.nodes.new("ShaderNodeMapping")
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    folder = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
    texture.image = bpy.data.images.load(str(sorted(folder.glob("*.exr"))[0]))
    mapping.inputs["Rotation"].default_value = (0, 0, 1.1)
    tree.links.new(coordinates.outputs["Generated"], mapping.inputs[0])
    tree.links.new(mapping.outputs[0], texture.inputs[0])
    tree.links.new(texture.outputs[0], tree.nodes["Background"].inputs[0])


CAMERAS: dict[str, dict[str, Any]] = {
    "auto_wide": {"lens": 35},
    "auto_tall": {"lens": 35, "size": (30, 50)},
    "horizontal_tall": {"lens": 28, "sensor_fit": "HORIZONTAL", "size": (30, 50)},
    "vertical_wide": {"lens": 40, "sensor_fit": "VERTICAL", "sensor_height": 20},
    "shifted": {"lens": 35, "shift_x": 0.15, "shift_y": -0.1},
    "shifted_tall": {"lens": 35, "shift_x": 0.1, "shift_y": 0.2, "size": (30, 50)},
    "wide_pixels": {"lens": 35, "pixel_aspect_x": 2.0, "shift_x": 0.1, "shift_y": 0.1},
    "tall_pixels": {"lens": 35, "pixel_aspect_y": 1.5, "shift_x": 0.1, "shift_y": 0.1},
    "half_resolution": {"lens": 50, "resolution_percentage": 50, "size": (80, 60)},
    "scaled_parent": {"lens": 35, "scale": (2.0, 2.0, 2.0)},
}
CLIP = "clip_depths"  # name of the package


def clipped(bpy: Any, scene: Any) -> None:
    """Add a black card nearer than Clip Start and a black wall beyond Clip End; the unit is 2 m."""
    scene.unit_settings.scale_length = 2.0
    _world(bpy, scene).nodes["Background"].inputs["Color"].default_value = (0.3, 0.4, 0.6, 1)
    camera = scene.camera
    camera.data.clip_start, camera.data.clip_end = 0.5, 1.6
    material = _matt(bpy, "black", 0)
    for name, depth, size in (("card", 0.45, 0.15), ("wall", 1.8, 9.0)):
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata([(-size, 0, 0), (size, 0, 0), (size, size, 0), (-size, size, 0)], [], [(0, 1, 2, 3)])
        mesh.materials.append(material)
        thing = bpy.data.objects.new(name, mesh)
        thing.parent, thing.location = camera, (0.03, -0.02, -depth)
        scene.collection.objects.link(thing)


def _matt(bpy: Any, name: str, grey: float) -> Any:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = material.node_tree.nodes.new("ShaderNodeBsdfDiffuse")
    shader.inputs["Color"].default_value = (grey, grey, grey, 1)
    output = material.node_tree.nodes["Material Output"]
    material.node_tree.links.new(shader.outputs[0], output.inputs["Surface"])
    return material


def _stage(bpy: Any) -> Any:
    """Return the scene of an empty file with a grey floor that fills the camera's view."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    material = _matt(bpy, "floor", 0.5)
    mesh = bpy.data.meshes.new("floor")
    mesh.from_pydata([(-6, -6, 0), (6, -6, 0), (6, 6, 0), (-6, 6, 0)], [], [(0, 1, 2, 3)])
    mesh.materials.append(material)
    scene.collection.objects.link(bpy.data.objects.new("floor", mesh))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location, camera.rotation_euler = (0.1, -1.2, 0.9), (0.85, 0, 0.1)
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_adaptive_sampling = SAMPLES, False
    scene.cycles.use_denoising, scene.cycles.pixel_filter_type = False, "BOX"
    scene.cycles.filter_width = 1.0
    scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
    scene.view_settings.view_transform = "Raw"
    return scene


def _cycles(bpy: Any, scene: Any, path: Path) -> None:
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.filepath = str(path.with_suffix(".exr"))
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    image.colorspace_settings.name = "Non-Color"
    pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    np.save(path, pixels.reshape(image.size[1], image.size[0], 4)[::-1, :, :3])


def _projected(bpy: Any, scene: Any) -> list[dict[str, Any]]:
    """Return twenty random world points with Blender's pixel coordinates for them, v downwards."""
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    generator = np.random.default_rng(3)
    render, found = scene.render, []
    scale = render.resolution_percentage / 100
    for point in generator.uniform((-1, 0, -0.3), (1, 2, 0.3), (20, 3)):
        u, v, _ = world_to_camera_view(scene, scene.camera, Vector(point))
        pixel = (u * int(render.resolution_x * scale), (1 - v) * int(render.resolution_y * scale))
        found.append({"point": point.tolist(), "pixel": pixel})
    return found


def main(out: Path) -> None:
    import bpy

    from blender_addon.export import export
    from blender_addon.settings import ExportSettings

    (out / "cycles").mkdir(parents=True, exist_ok=True)
    settings = ExportSettings(kind="environment", license="CC0-1.0", max_texture_px=1024)
    for name, build in LIGHTS.items():
        scene = _stage(bpy)
        scene["sm_id"] = name
        build(bpy, scene)
        bpy.context.view_layer.update()
        export(out / "packages", settings)
        _cycles(bpy, scene, out / "cycles" / f"{name}.npy")
    scene = _stage(bpy)
    scene["sm_id"] = CLIP
    clipped(bpy, scene)
    bpy.context.view_layer.update()
    export(out / "packages", settings)
    _cycles(bpy, scene, out / "cycles" / f"{CLIP}.npy")
    projections: dict[str, Any] = {}
    for name, values in CAMERAS.items():
        scene = _stage(bpy)
        scene["sm_id"] = f"camera_{name}"
        camera = scene.camera.data
        scene.render.resolution_x, scene.render.resolution_y = values.get("size", (WIDTH, HEIGHT))
        for key in ("pixel_aspect_x", "pixel_aspect_y", "resolution_percentage"):
            if key in values:
                setattr(scene.render, key, values[key])
        for key in ("lens", "sensor_fit", "sensor_height", "shift_x", "shift_y"):
            if key in values:
                setattr(camera, key, values[key])
        scene.camera.scale = values.get("scale", (1, 1, 1))
        bpy.context.view_layer.update()
        export(out / "packages", settings)
        projections[name] = _projected(bpy, scene)
    print("\n" + json.dumps(projections))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

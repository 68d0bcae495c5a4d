# SPDX-License-Identifier: GPL-3.0-or-later
"""Baseline of bench_cycles.py: Cycles from pip's bpy, set up as in BlenderProc. The module must not share a
process with mitsuba.

    python -m benchmarks.studies.cycles_baseline build EXPORT OUT.blend
    python -m benchmarks.studies.cycles_baseline render BLEND OUT VIEW... --samples 32 --max-depth 8 [--noisy]

``build`` converts an export of cycles_scene.py to a .blend; ``render`` writes one multi-layer EXR per view
(half, zip: beauty, depth, normal, diffuse and glossy colour, object and material index) and ``times.json``
with the times at which the scene was loaded and each view was finished, as seconds since the epoch. Cycles
keeps the scene's data between views and denoises by OIDN with prefiltered albedo and normal; ``--noisy``
omits the denoiser and writes single precision, for references.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

SENSOR_MM = 36.0


def build(export: Path, out: Path) -> None:
    """Write a .blend of the exported room with its lights and sky, and with the cameras in a text block."""
    import bpy

    from blender_addon.import_package import import_package

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    import_package(export)
    setup = json.loads((export / "setup.json").read_text(encoding="utf-8"))
    for light in setup["lights"]:
        _add_light(light)
    if (export / "sky.exr").is_file():
        _add_sky(export / "sky.exr")
    for index, thing in enumerate(scene.objects, start=1):
        thing.pass_index = index
    for index, material in enumerate(bpy.data.materials, start=1):
        material.pass_index = index
    bpy.data.texts.new("cameras").write(json.dumps(setup["cameras"]))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.sensor_width, camera.data.sensor_fit = SENSOR_MM, "HORIZONTAL"
    camera.data.clip_start, camera.data.clip_end = 1e-3, 1e4
    scene.collection.objects.link(camera)
    scene.camera = camera
    out.parent.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(out.resolve()), compress=False)


def _add_light(light: dict[str, Any]) -> None:
    """Add a lamp with the radiance, intensity or irradiance of ``light`` (units: docs/blender.md)."""
    import bpy
    from mathutils import Matrix, Vector

    kinds = {"point": "POINT", "sphere": "POINT", "spot": "SPOT", "directional": "SUN", "area": "AREA"}
    lamp = bpy.data.lights.new(light["name"], kinds[light["type"]])
    thing = bpy.data.objects.new(light["name"], lamp)
    bpy.context.scene.collection.objects.link(thing)
    if light["type"] in ("spot", "directional"):
        towards = Vector(light["direction"]).to_track_quat("-Z", "Y").to_matrix().to_4x4()
        thing.matrix_world = Matrix.Translation(light.get("position_m", (0, 0, 0))) @ towards
    if light["type"] == "area":
        value, factor = light["radiance"], _area_light(lamp, thing, light)
        thing.visible_camera = light["is_visible"]
    elif light["type"] == "directional":
        value, factor = light["irradiance"], 1.0
        lamp.angle = light["angular_diameter_rad"]
    elif light["type"] == "sphere":
        value, factor = light["radiance"], 4 * (math.pi * light["radius_m"]) ** 2
        lamp.shadow_soft_size = light["radius_m"]
        thing.location = light["position_m"]
    else:
        value, factor = light["intensity"], 4 * math.pi
        lamp.shadow_soft_size = 0.0
        thing.location = light["position_m"]
        if light["type"] == "spot":
            lamp.spot_size = 2 * light["cutoff_rad"]
            lamp.spot_blend = 1 - light["beam_width_rad"] / light["cutoff_rad"]
    strongest = max(value) or 1.0
    lamp.energy, lamp.color = strongest * factor, [component / strongest for component in value]


def _area_light(lamp: Any, thing: Any, light: dict[str, Any]) -> float:
    """Set shape, size and pose of an area light; returns its power in W per unit of radiance."""
    origin, u, v = (np.array(light[key]) for key in ("origin_m", "edge_u_m", "edge_v_m"))
    lamp.shape = "RECTANGLE" if light["shape"] == "rectangle" else "ELLIPSE"
    lamp.size, lamp.size_y = float(np.linalg.norm(u)), float(np.linalg.norm(v))
    forward = np.cross(u, v)
    matrix = np.eye(4)
    matrix[:3, 0] = u / np.linalg.norm(u)
    matrix[:3, 2] = -forward / np.linalg.norm(forward)  # lamps emit along -Z
    matrix[:3, 1] = np.cross(matrix[:3, 2], matrix[:3, 0])
    matrix[:3, 3] = origin + 0.5 * (u + v)
    thing.matrix_world = matrix.T.tolist()
    area = float(np.linalg.norm(forward)) * (1.0 if light["shape"] == "rectangle" else math.pi / 4)
    return math.pi * area


def _add_sky(image: Path) -> None:
    import bpy

    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    texture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = bpy.data.images.load(str(image.resolve()))
    texture.image.colorspace_settings.name = "Non-Color"
    background = world.node_tree.nodes["Background"]
    world.node_tree.links.new(texture.outputs["Color"], background.inputs["Color"])
    bpy.context.scene.world = world


@dataclass(frozen=True)
class Sampling:
    """Settings of Cycles: ``samples`` per pixel; ``max_depth`` in path segments; ``noisy``: without denoiser
    and ground-truth passes; ``adaptive``: sampling that stops early where noise is low; ``clamp``: limit of
    indirect light, and ``filter_glossy``: blur of glossy reflections after diffuse bounces, 0 for none.
    """

    samples: int = 32
    max_depth: int = 8
    seed: int = 0
    noisy: bool = False
    adaptive: bool = False
    clamp: float = 10.0
    filter_glossy: float = 1.0


def set_up(scene: Any, sampling: Sampling) -> None:
    """Set up path tracing with persistent data and ground-truth passes; the rest keeps Blender's defaults."""
    scene.render.engine = "CYCLES"
    cycles, render, layer = scene.cycles, scene.render, scene.view_layers[0]
    cycles.device = "CPU"
    cycles.samples, cycles.seed = sampling.samples, sampling.seed
    cycles.use_adaptive_sampling = sampling.adaptive
    cycles.adaptive_threshold = 0.0  # Cycles' default depends on the number of samples
    cycles.sample_clamp_indirect = sampling.clamp
    cycles.blur_glossy = sampling.filter_glossy
    cycles.pixel_filter_type = "BOX"
    # a path of n segments hits n - 1 surfaces; Cycles does not count the first as a bounce
    bounces = max(0, sampling.max_depth - 2)
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = bounces
    cycles.transmission_bounces = cycles.transparent_max_bounces = bounces
    cycles.use_denoising = not sampling.noisy
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
    cycles.denoising_prefilter = "ACCURATE"
    render.use_persistent_data = True
    render.threads_mode = "AUTO"
    render.resolution_percentage = 100
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    render.image_settings.color_depth = "32" if sampling.noisy else "16"
    render.image_settings.exr_codec = "ZIP"
    if not sampling.noisy:
        for name in ("z", "normal", "diffuse_color", "glossy_color", "object_index", "material_index"):
            setattr(layer, f"use_pass_{name}", True)


def look_through(scene: Any, camera: dict[str, Any], scale: float) -> None:
    """Set the scene's camera, and its resolution times ``scale``; ``ValueError`` for non-square pixels."""
    if abs(camera["fx_px"] / camera["fy_px"] - 1) > 1e-6:
        raise ValueError(f"camera {camera['name']}: non-square pixels are not supported")
    width, height = camera["width_px"], camera["height_px"]
    scene.render.resolution_x, scene.render.resolution_y = round(width * scale), round(height * scale)
    lens = scene.camera.data
    lens.lens = camera["fx_px"] * SENSOR_MM / width
    lens.shift_x = (width / 2 - camera["cx_px"]) / width
    lens.shift_y = (camera["cy_px"] - height / 2) / width
    matrix = np.array(camera["world_from_camera"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    scene.camera.matrix_world = matrix.T.tolist()


def render(arguments: argparse.Namespace) -> None:
    """Render views in turn, and write the times to ``times.json``."""
    import bpy

    bpy.ops.wm.open_mainfile(filepath=str(arguments.blend.resolve()), use_scripts=False)
    scene = bpy.context.scene
    set_up(scene, Sampling(**{field.name: getattr(arguments, field.name) for field in fields(Sampling)}))
    cameras = json.loads(bpy.data.texts["cameras"].as_string())
    loaded = time.time()
    arguments.out.mkdir(parents=True, exist_ok=True)
    finished = []
    for view in arguments.views:
        look_through(scene, cameras[view], arguments.scale)
        scene.render.filepath = str((arguments.out / f"view_{view:03}.exr").resolve())
        bpy.ops.render.render(write_still=True)
        finished.append(time.time())
    times = {"loaded": loaded, "finished": finished, "blender": bpy.app.version_string}
    (arguments.out / "times.json").write_text(json.dumps(times), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    build_command = verbs.add_parser("build")
    build_command.add_argument("export", type=Path)
    build_command.add_argument("out", type=Path)
    command = verbs.add_parser("render")
    command.add_argument("blend", type=Path)
    command.add_argument("out", type=Path)
    command.add_argument("views", type=int, nargs="+")
    command.add_argument("--samples", type=int, default=Sampling.samples)
    command.add_argument("--max-depth", type=int, default=Sampling.max_depth)
    command.add_argument("--seed", type=int, default=Sampling.seed)
    command.add_argument("--noisy", action="store_true")
    command.add_argument("--adaptive", action="store_true", help="Cycles' adaptive sampling")
    command.add_argument("--clamp", type=float, default=Sampling.clamp, help="clamp of indirect light")
    command.add_argument(
        "--filter-glossy", type=float, default=Sampling.filter_glossy, help="blur after diffuse bounces"
    )
    command.add_argument("--scale", type=float, default=1.0, help="factor of the resolution")
    arguments = parser.parse_args()
    if arguments.verb == "build":
        build(arguments.export, arguments.out)
    else:
        render(arguments)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks graphs that must be refused, exports normals as textures and writes a fidelity report; prints JSON.

``python -m tests.blender_addon.policies OUT``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.blender_addon import graphs
from tests.blender_addon.graphs import Stage

REFUSED: dict[str, tuple[str, Callable[[Stage], None]]] = {}


def refused(fragment: str) -> Callable[[Callable[[Stage], None]], Callable[[Stage], None]]:
    """Decorator that registers a graph whose refusal must contain ``fragment``."""

    def register(build: Callable[[Stage], None]) -> Callable[[Stage], None]:
        REFUSED[build.__name__] = (fragment, build)
        return build

    return register


@refused("transmission")
def glass(s: Stage) -> None:
    s.surface(s.node("BsdfGlass"))


@refused("transmission")
def principled_glass(s: Stage) -> None:
    s.shader.inputs["Transmission Weight"].default_value = 1


@refused("Hair BSDF")
def hair(s: Stage) -> None:
    s.surface(s.node("BsdfHair"))


@refused("Sheen")
def sheen(s: Stage) -> None:
    s.surface(s.node("BsdfSheen"))


@refused("Toon")
def toon(s: Stage) -> None:
    s.surface(s.node("BsdfToon"))


@refused("volume")
def volume(s: Stage) -> None:
    s.link(s.node("VolumeScatter").outputs[0], s.output.inputs["Volume"])


@refused("thin film")
def thin_film(s: Stage) -> None:
    s.shader.inputs["Thin Film Thickness"].default_value = 400


@refused("no image")
def image_node_without_image(s: Stage) -> None:
    s.link(s.node("TexImage").outputs[0], s.shader.inputs["Base Color"])


@refused("cannot be read")
def image_file_missing(s: Stage) -> None:
    image = s.image(graphs.smooth_image(8), packed=False)
    Path(image.filepath).unlink()
    image.reload()
    s.link(s.texture(image).outputs[0], s.shader.inputs["Base Color"])


@refused("needs a UV map")
def no_uv_map(s: Stage) -> None:
    s.mesh.uv_layers.remove(s.mesh.uv_layers[0])
    s.link(s.uv(), s.shader.inputs["Base Color"])


@refused("needs the UV map 'Missing'")
def wrong_uv_map(s: Stage) -> None:
    s.link(s.node("UVMap", uv_map="Missing").outputs[0], s.shader.inputs["Base Color"])


@refused("change with the view")
def window_coordinates(s: Stage) -> None:
    s.link(s.node("TexCoord").outputs["Window"], s.shader.inputs["Base Color"])


@refused("Open Shading Language")
def script(s: Stage) -> None:
    group = s.node("Script")
    group.mode = "INTERNAL"
    text = s.bpy.data.texts.new("s.osl")
    text.write("shader s(output color c = 0.5) { c = 0.2; }")
    group.script = text
    if not group.outputs:  # without an OSL compiler the node has no outputs: another refused node replaces it
        s.link(s.node("CameraData").outputs["View Z Depth"], s.shader.inputs["Roughness"])
        group.name = "unused"
        s.material["no_osl"] = True
        return
    s.link(group.outputs[0], s.shader.inputs["Base Color"])


@refused("linked to a shader input")
def colour_as_shader(s: Stage) -> None:
    s.link(s.node("TexNoise").outputs[1], s.output.inputs["Surface"])


@refused("no material")
def empty_slot(s: Stage) -> None:
    s.mesh.materials[0] = None


@refused("sm_class = 'wod'")
def misspelt_class(s: Stage) -> None:
    s.material["sm_class"] = "wod"


@refused("sm_transmission = 'opake'")
def misspelt_transmission_without_nodes(s: Stage) -> None:
    s.material.use_nodes = False
    s.material["sm_transmission"] = "opake"


@refused("sm_scale_range = 'large'")
def scale_in_words(s: Stage) -> None:
    s.collection["sm_scale_range"] = "large"


@refused("sm_scale_range = (0.0, 1.0)")
def scale_of_zero(s: Stage) -> None:
    s.collection["sm_scale_range"] = [0.0, 1.0]


@refused("sm_tile_size_m = 'a foot'")
def tile_size_in_words(s: Stage) -> None:
    s.material["sm_role"], s.material["sm_tile_size_m"] = "material", "a foot"


@refused("sm_tile_size_m = 0")
def tile_size_of_zero(s: Stage) -> None:
    s.material["sm_tile_size_m"] = 0


@refused("sm_clearance_m = 'high'")
def clearance_in_words(s: Stage) -> None:
    s.collection["sm_role"] = "environment"
    s.thing["sm_role"], s.thing["sm_clearance_m"] = "support_surface", "high"


@refused("spread")
def area_light_spread(s: Stage) -> None:
    light = s.bpy.data.lights.new(s.name, "AREA")
    light.spread = 1.0
    s.thing.name = "floor"
    s.collection.objects.link(s.bpy.data.objects.new(s.name, light))


def normal_image(size: int = 64) -> np.ndarray:
    """Return a tiling image (size, size, 3) of encoded unit normals, tilted by up to 23 degrees."""
    t = (np.arange(size) + 0.5) / size * 2 * np.pi
    y, x = np.meshgrid(t, t, indexing="ij")
    vector = np.stack([0.3 * np.sin(x), 0.3 * np.cos(y), np.ones_like(x)], axis=-1)
    vector /= np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.round((vector + 1) / 2 * 255) / 255


def _normal_map(s: Stage, strength: float = 1.0) -> None:
    node = s.node("NormalMap", uv_map="UVMap")  # glTF importers set the map here, not in the texture node
    node.inputs["Strength"].default_value = strength
    s.link(s.texture(s.image(normal_image(), "Non-Color")).outputs[0], node.inputs["Color"])
    s.link(node.outputs[0], s.shader.inputs["Normal"])


def _bump(s: Stage) -> None:
    """A bump of height 0.05 sin(2 pi x), whose slope has a closed form."""
    node = s.node("Bump")
    node.inputs["Strength"].default_value, node.inputs["Distance"].default_value = 1, 0.05
    wave = s.math("SINE", s.math("MULTIPLY", s.split(s.uv())[0], 2 * np.pi))
    s.link(wave, node.inputs["Height"])
    s.link(node.outputs[0], s.shader.inputs["Normal"])


def main(out: Path) -> None:
    import bpy

    from blender_addon.bake.execute import BakeSession
    from blender_addon.export import check, export
    from blender_addon.report import compare, stage
    from blender_addon.settings import ExportSettings

    graphs.FOLDER = out / "images"
    graphs.FOLDER.mkdir(parents=True, exist_ok=True)
    found: dict[str, Any] = {"refused": {}}
    for name, (_, build) in REFUSED.items():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        build(Stage(bpy, name))
        bpy.context.view_layer.update()
        problems = check(ExportSettings(license="CC0-1.0"))
        found["refused"][name] = [vars(p) for p in problems if p.severity == "error"]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    _normal_map(Stage(bpy, "normal_map"))
    _normal_map(Stage(bpy, "weak_normal_map"), 0.5)
    _bump(Stage(bpy, "bump"))
    bpy.context.view_layer.update()
    settings = ExportSettings(kind="object", license="CC0-1.0", bake_normals=True, max_texture_px=256)
    export(out / "normals", settings)
    bpy.context.scene.unit_settings.scale_length = 0.01
    for name in ("normal_map", "bump"):  # a tile of 0.01 m is still one unit wide
        bpy.data.materials[name]["sm_role"], bpy.data.materials[name]["sm_tile_size_m"] = "material", 0.01
    export(out / "materials", replace(settings, kind="material"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    stages = [Stage(bpy, name) for name in ("plain", "gradient")]
    stages[1].link(stages[1].uv(), stages[1].shader.inputs["Base Color"])
    scene = bpy.context.scene
    light = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "AREA"))
    camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    light.location, camera.location = (0.5, 0.5, 2), (0.5, -1, 1)
    for thing in (light, camera):
        scene.collection.objects.link(thing)
    for collection in bpy.data.collections:
        del collection["sm_role"]
    bpy.context.view_layer.update()
    result = export(
        out / "report", ExportSettings(license="CC0-1.0", report=True, max_texture_px=64, kind="environment")
    )
    found["report"] = str(result.report)
    slow = out / "slow_python"
    slow.write_text("#!/bin/sh\nexec tail -f /dev/null\n")
    slow.chmod(0o755)
    compare.TIMEOUT_S = 0.1
    found["slow"] = compare.render_with_mitsuba(out, [], str(slow))
    found["left"] = [scene.name for scene in bpy.data.scenes] + [block.name for block in bpy.data.meshes]
    stage.SPHERE_ROWS, stage.SPHERE_COLUMNS = 2, 3
    session = BakeSession().__enter__()  # not closed: removing its objects takes seconds
    cameras = stage.material_stage(session, [bpy.data.materials["plain"]] * 1002, [()] * 1002)
    found["camera names"] = [camera.name for camera in cameras]
    print("\n" + json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

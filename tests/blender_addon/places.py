# SPDX-License-Identifier: GPL-3.0-or-later
"""Exports, imports and re-exports a room and a lamp with every kind of light, marker, camera and tag.

``python -m tests.blender_addon.places OUT`` writes ``first/``, ``again/`` (imported into an empty file) and
``in_centimetres/`` (imported into a file whose unit is a centimetre), and prints JSON: the remarks of these
imports, the errors of invalid packages with the changes to the file, and the width of a material's sample.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from pathlib import Path
from typing import Any

from tests.blender_addon.file_state import differences, snapshot

ENVIRONMENT, LAMP = "small_room", "desk_lamp"
TURNED = (0.3, -0.2, 1.1)


def _linked(bpy: Any, collection: Any, name: str, data: Any, place: Any, turned: Any = (0, 0, 0)) -> Any:
    thing = bpy.data.objects.new(name, data)
    thing.location, thing.rotation_euler = place, turned
    collection.objects.link(thing)
    return thing


def _light(bpy: Any, collection: Any, name: str, kind: str, place: Any, **values: Any) -> Any:
    data = bpy.data.lights.new(name, kind)
    for key, value in values.items():
        setattr(data, key, value)
    return _linked(bpy, collection, name, data, place, TURNED)


def _plane(bpy: Any, collection: Any, name: str, place: Any, size: tuple[float, float], turned: Any) -> Any:
    x, y = size
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], [], [(0, 1, 2, 3)])
    return _linked(bpy, collection, name, mesh, place, turned)


def _tag(block: Any, **tags: Any) -> None:
    for key, value in tags.items():
        block[f"sm_{key}"] = value


def _collection(bpy: Any, name: str, **tags: Any) -> Any:
    collection = bpy.data.collections.new(name)
    bpy.context.scene.collection.children.link(collection)
    _tag(collection, id=name, license="CC0-1.0", author="someone", source="https://example.org/x", **tags)
    return collection


def _material(bpy: Any, name: str, **tags: Any) -> Any:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    _tag(material, **tags)
    return material


def _room(bpy: Any) -> None:
    room = _collection(bpy, ENVIRONMENT, role="environment", title="A small room", usage="evaluation_only")
    floor = _plane(bpy, room, "floor", (0, 0, 0), (3, 2), (0, 0, 0))
    floor.data.materials.append(
        _material(bpy, "boards", **{"class": "wood", "replaceable_by": "wood, stone"})
    )
    _light(bpy, room, "bulb", "POINT", (1, 0.5, 2), energy=40, color=(1, 0.6, 0.3), shadow_soft_size=0)
    globe = {"shadow_soft_size": 0.15, "use_soft_falloff": False, "exposure": 1.0}
    _light(bpy, room, "globe", "POINT", (-1, 0.5, 2), energy=30, **globe)
    _light(bpy, room, "sun", "SUN", (0, 0, 4), energy=3, angle=0.01)
    spot = {"spot_size": math.radians(70), "shadow_soft_size": 0}
    _light(bpy, room, "spot_hard", "SPOT", (0, 1, 2), energy=90, spot_blend=0, **spot)
    _light(bpy, room, "spot_soft", "SPOT", (0, -1, 2), energy=90, spot_blend=0.4, **spot)
    _light(bpy, room, "panel", "AREA", (0.5, 0, 2.4), energy=25, shape="RECTANGLE", size=0.9, size_y=0.3)
    oval = _light(bpy, room, "oval", "AREA", (-0.5, 0, 2.4), energy=25, shape="ELLIPSE", size=0.5, size_y=0.8)
    oval.visible_camera = True
    _tag(_plane(bpy, room, "window", (0, 2, 1.4), (0.6, 0.8), (math.pi / 2, 0.1, 0)), role="opening")
    table = _plane(bpy, room, "table_top", (1, 1, 0.7), (0.8, 0.5), (0, 0, 0.4))
    _tag(table, role="support_surface", kind="table", clearance_m=0.9)
    _tag(_plane(bpy, room, "ceiling_slot", (0, 0, 2.5), (0.3, 0.3), (math.pi, 0, 0.2)), role="light_slot")
    _tag(_linked(bpy, room, "pendant", None, (0.4, 0.1, 2.1)), role="light_slot", kind="point")
    for name, x in (("left", -1.5), ("right", 1.5)):
        region = _linked(bpy, room, f"stand_{name}", None, (x, 0, 1.5), (0, 0, 0.3))
        region.empty_display_size = 0.4
        _tag(region, role="camera_region")
    for name, values in (
        ("front", {"lens": 30, "shift_x": 0.1, "shift_y": -0.05, "clip_start": 0.02, "clip_end": 50}),
        ("side", {"lens": 28, "sensor_fit": "VERTICAL", "sensor_height": 20}),
    ):
        data = bpy.data.cameras.new(name)
        for key, value in values.items():
            setattr(data, key, value)
        _linked(bpy, room, name, data, (0, -1.8, 1.5), (1.4, 0.02, 0.1))
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 90, 60
    bpy.context.scene.render.pixel_aspect_x = 1.2


def _world(bpy: Any) -> None:
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    bpy.context.scene.world = world
    tree = world.node_tree
    texture, mapping = tree.nodes.new("ShaderNodeTexEnvironment"), tree.nodes.new("ShaderNodeMapping")
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    folder = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
    texture.image = bpy.data.images.load(str(sorted(folder.glob("*.exr"))[0]))
    mapping.inputs["Rotation"].default_value = (0, 0, 0.7)
    tree.nodes["Background"].inputs["Strength"].default_value = 0.5
    tree.links.new(coordinates.outputs["Generated"], mapping.inputs[0])
    tree.links.new(mapping.outputs[0], texture.inputs[0])
    tree.links.new(texture.outputs[0], tree.nodes["Background"].inputs[0])


def _lamp(bpy: Any) -> None:
    lamp = _collection(
        bpy, LAMP, role="object", title="A lamp", category="lamp", supports="table, shelf",
        scale_range=(0.8, 1.25), yaw_range_rad=(-0.5, 0.5), keep_origin=True,
    )  # fmt: skip
    foot = _plane(bpy, lamp, "foot", (0.2, 0.1, 0), (0.1, 0.1), (0, 0, 0))
    foot.data.materials.append(_material(bpy, "brass", **{"class": "metal"}))
    _light(bpy, lamp, "lamp_bulb", "POINT", (0.2, 0.1, 0.4), energy=5, shadow_soft_size=0.03)


def _export(bpy: Any, folder: Path) -> None:
    from blender_addon.export import export
    from blender_addon.settings import ExportSettings

    bpy.context.view_layer.update()
    export(folder, ExportSettings(max_texture_px=256))


def _invalid(bpy: Any, out: Path) -> dict[str, tuple[str, list[str]]]:
    """Import an incomplete room, a damaged zip and a text; return errors and changes to the file by name."""
    from blender_addon.import_package import import_package

    shutil.copytree(out / "first" / ENVIRONMENT, out / "incomplete")
    description = out / "incomplete" / "asset.json"
    data = json.loads(description.read_text(encoding="utf-8"))
    del data["camera_regions"][-1]["maximum_m"]
    description.write_text(json.dumps(data), encoding="utf-8")
    shutil.make_archive(str(out / "damaged"), "zip", out / "first" / LAMP)
    content = bytearray((out / "damaged.zip").read_bytes())
    content[len(content) // 2] ^= 0xFF
    (out / "damaged.zip").write_bytes(content)
    (out / "text.zip").write_text("no zip")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("own")
    before, found = snapshot(bpy), {}
    for name in ("incomplete", "damaged.zip", "text.zip"):
        try:
            import_package(out / name)
        except (ValueError, KeyError) as error:
            found[name] = (f"{type(error).__name__}: {error}", differences(before, snapshot(bpy)))
    return found


def _sample_side_m(bpy: Any, out: Path) -> float:
    """Return the width in metres of the square that shows the material "paint", in a scene in centimetres."""
    from blender_addon.import_package import import_package

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.unit_settings.scale_length = 0.01
    (thing,) = import_package(out / "first" / "paint").collection.objects
    return 0.01 * thing.dimensions.x


def main(out: Path) -> None:
    import bpy

    from blender_addon.import_package import import_package

    bpy.ops.wm.read_factory_settings(use_empty=True)
    _room(bpy)
    _world(bpy)
    _lamp(bpy)
    paint = _material(bpy, "paint", role="material", title="Paint", license="CC0-1.0", tile_size_m=0.5)
    paint.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.1, 0.3, 0.2, 1)
    _export(bpy, out / "first")
    remarks: dict[str, list[str]] = {}
    for name, unit_m in (("again", 1.0), ("in_centimetres", 0.01)):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.unit_settings.scale_length = unit_m
        remarks[name] = []
        for folder in sorted((out / "first").iterdir()):
            remarks[name] += import_package(folder).remarks
        _export(bpy, out / name)
    found = {"remarks": remarks, "invalid": _invalid(bpy, out), "sample_m": _sample_side_m(bpy, out)}
    print("\n" + json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

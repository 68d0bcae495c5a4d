# SPDX-License-Identifier: GPL-3.0-or-later
"""Exports a file with every possible outcome, compares its state before and after, and prints JSON.

``python -m tests.blender_addon.untouched FOLDER`` expects ``FOLDER/graphs.blend``.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

from tests.blender_addon.file_state import differences, snapshot

CHOSEN = (
    "object_coordinates", "nested_groups_with_coordinates", "world_position_of_two_instances", "arm_image",
    "object_colour_of_two_instances", "two_slots_of_one_mesh", "images_with_different_mappings",
)  # fmt: skip


def main(folder: Path) -> None:
    import bpy

    from blender_addon import command, write
    from blender_addon.export import check, export, export_steps
    from blender_addon.problems import ExportRefused
    from blender_addon.settings import ExportSettings

    bpy.ops.wm.open_mainfile(filepath=str(folder / "graphs.blend"))
    _furnish(bpy)
    settings = ExportSettings(kind="object", only=CHOSEN, license="CC0-1.0", max_texture_px=64)
    before = snapshot(bpy)
    outcome: dict[str, Any] = {"num_blocks": sum(len(v) for k, v in before.items() if k != "context")}

    def compare(name: str) -> None:
        outcome[name] = differences(before, snapshot(bpy))

    compare("nothing")
    out = folder / "out"
    export(out / "done", settings)
    compare("success")
    export(out / "done", ExportSettings(kind="environment", license="CC0-1.0", max_texture_px=64))
    compare("environment")
    check(settings)
    compare("check")
    report = ExportSettings(
        kind="object", only=CHOSEN[:2], license="CC0-1.0", max_texture_px=64, bake_normals=True,
        report=True, report_python="/bin/false",
    )  # fmt: skip
    export(out / "report", report)
    compare("report")
    try:
        export(out / "refused", ExportSettings(kind="object", only=CHOSEN))
        outcome["refused"] = ["an export without a licence was not refused"]
    except ExportRefused:
        compare("refused")
    num_steps = sum(1 for _ in export_steps(out / "counted", settings))
    outcome["num_steps"] = num_steps
    for stop in range(0, num_steps, 3):
        steps = export_steps(out / f"cancelled_{stop}", settings)
        for _ in range(stop + 1):
            next(steps)
        steps.close()
        compare(f"cancelled after {stop}")
    original, calls = write.png_bytes, []

    def failing(pixels: Any) -> bytes:
        calls.append(1)
        if len(calls) == 4:
            raise OSError(28, "No space left on device")
        return original(pixels)

    import blender_addon.package as package

    package.png_bytes = failing
    try:
        export(out / "full", settings)
        outcome["disk full"] = ["the failure did not reach the caller"]
    except OSError:
        compare("disk full")
    calls.clear()
    words = [*(f"--only={name}" for name in CHOSEN), "--kind=object", "--license=CC0-1.0"]
    arguments = command.build_parser().parse_args([*words, "--max-texture=64", f"--out={out / 'full'}"])
    with contextlib.redirect_stderr(io.StringIO()) as messages:
        outcome["full disk in a command"] = (command.run(arguments), messages.getvalue())
    outcome["partial files"] = [str(p) for p in out.rglob(".*") if "partial" in p.name]
    bpy.context.scene["changed"] = 1
    bpy.data.materials[0].node_tree.nodes[0].location.x += 1
    outcome["twin"] = differences(before, snapshot(bpy))
    print("\n" + json.dumps(outcome))


def _furnish(bpy: Any) -> None:
    """Add state that careless code changes: selection, active object, textured world, camera and curve."""
    scene = bpy.context.scene
    for collection in list(bpy.data.collections):
        if collection.name not in CHOSEN:
            for thing in list(collection.objects):
                bpy.data.objects.remove(thing)
            bpy.data.collections.remove(collection)
    bpy.ops.outliner.orphans_purge(do_recursive=True)
    for thing in list(scene.objects)[:3]:
        thing.select_set(True)
    bpy.context.view_layer.objects.active = scene.objects[1]
    world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    sky = world.node_tree.nodes.new("ShaderNodeTexGradient")
    world.node_tree.links.new(sky.outputs[0], world.node_tree.nodes["Background"].inputs[0])
    scene.world = world
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    curve = bpy.data.curves.new("Wire", "CURVE")
    curve.dimensions, curve.bevel_depth = "3D", 0.05
    spline = curve.splines.new("POLY")
    spline.points.add(3)
    for index, point in enumerate(spline.points):
        point.co = (index, index % 2, 0, 1)
    curve.materials.append(bpy.data.materials[0])
    scene.collection.objects.link(bpy.data.objects.new("Wire", curve))
    bpy.context.view_layer.update()


if __name__ == "__main__":
    main(Path(sys.argv[1]))

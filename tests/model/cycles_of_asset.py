# SPDX-License-Identifier: GPL-3.0-or-later
"""Loads an asset package with the add-on in a separate process and renders its cameras with Cycles.

``python -m tests.model.cycles_of_asset PACKAGE OUT SAMPLES CAMERA...`` writes ``OUT/CAMERA.npy``, linear.
``PACKAGE+FILE.glb`` (or ``.usdz``) imports the surfaces from that file with Blender's importer, and cameras
and lights from the package.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np


def main(source: str, out: Path, samples: int, names: list[str]) -> None:
    import bpy

    from blender_addon.cycles import render_linear
    from blender_addon.import_package import import_package

    package, _, other = source.partition("+")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    remarks = import_package(Path(package)).remarks
    if other:
        for thing in [t for t in scene.objects if t.type == "MESH"]:
            bpy.data.objects.remove(thing)
        if other.endswith(".usdz"):
            bpy.ops.wm.usd_import(filepath=other, import_lights=False)
        else:
            bpy.ops.import_scene.gltf(filepath=other)
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = samples, False, False
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.sample_clamp_indirect, cycles.blur_glossy, cycles.light_sampling_threshold = 0, 0, 0
    # paths of eight segments, like Mitsuba's max_depth = 8
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = 6
    out.mkdir(parents=True, exist_ok=True)
    for name in names:
        scene.camera = bpy.data.objects[name]
        np.save(out / f"{name}.npy", render_linear(scene))
    print("\n" + json.dumps({"remarks": remarks}))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])

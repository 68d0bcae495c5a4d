# SPDX-License-Identifier: GPL-3.0-or-later
"""Prints a GLB's lights as Blender's importer reads them: python -m tests.model.glb_in_blender FILE."""

from __future__ import annotations

import json
import sys


def main() -> None:
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=sys.argv[1])
    emission = {}
    for material in bpy.data.materials:
        (shader,) = (node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
        strength = shader.inputs["Emission Strength"].default_value
        emission[material.name] = [strength * c for c in shader.inputs["Emission Color"].default_value[:3]]
    watts = {light.name: [light.energy * c for c in light.color] for light in bpy.data.lights}
    places = {o.name: list(o.matrix_world.translation) for o in bpy.data.objects if o.type == "LIGHT"}
    print(json.dumps({"emission": emission, "watts": watts, "places": places}))


if __name__ == "__main__":
    main()

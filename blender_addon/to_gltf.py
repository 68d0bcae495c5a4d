# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m blender_addon.to_gltf FILE OUT.glb [FOLDER ...]``: converts a file to glTF with Blender.

Scripts in .blend files are not run. Images outside the file's folder and the FOLDERs are omitted; each
omission is printed on a line that begins with ``to_gltf: ``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy

from .command import leave

_MARK = "to_gltf: "


def read(path: Path) -> None:
    """Replace the scene by the contents of a file. Raises ``RuntimeError`` if Blender cannot read it."""
    suffix = path.suffix.lower()
    if suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False)
        return
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if suffix == ".fbx":
        bpy.ops.import_scene.fbx(filepath=str(path))
    elif suffix in (".usd", ".usda", ".usdc", ".usdz"):
        bpy.ops.wm.usd_import(filepath=str(path))
    elif suffix in (".gltf", ".glb"):
        bpy.ops.import_scene.gltf(filepath=str(path))
    else:
        raise RuntimeError(f"{suffix} is not a format that Blender reads")


def leave_out_images(folders: list[Path]) -> None:
    """Remove images whose files are outside ``folders``, and print the name of each."""
    for image in list(bpy.data.images):
        if image.packed_file is not None or not image.filepath:
            continue
        real = Path(bpy.path.abspath(image.filepath)).resolve()
        if not any(real.is_relative_to(folder) for folder in folders):
            print(f"{_MARK}{image.name}: left out, since {real} is outside the file's folder")
            bpy.data.images.remove(image)


def main(arguments: list[str]) -> int:
    """Convert the file; returns the exit code, 1 if it could not be read."""
    source, out = Path(arguments[0]), Path(arguments[1])
    try:
        read(source)
        leave_out_images([source.parent.resolve(), *(Path(name).resolve() for name in arguments[2:])])
        if not any(thing.type == "MESH" for thing in bpy.context.scene.objects):
            raise RuntimeError("no meshes in the scene")
        bpy.ops.export_scene.gltf(
            filepath=str(out), export_format="GLB", export_apply=True, export_cameras=True,
            export_lights=True, export_animations=False, export_skins=False, export_morph=False,
        )  # fmt: skip
    except RuntimeError as error:
        print(f"{_MARK}{str(error).strip().splitlines()[-1]}")
        return 1
    return 0


if __name__ == "__main__":
    leave(main(sys.argv[1:]))

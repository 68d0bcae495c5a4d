# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds, validates, installs and enables the extension, then uses its operators; prints JSON.

``python -m tests.blender_addon.install FOLDER PACKAGES`` imports the packages and exports them again to
``FOLDER/again``. BLENDER_USER_RESOURCES must be set to an empty folder.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.conftest import REPOSITORY

MODULE = "bl_ext.user_default.scene_materials"
ROUND_TRIP = (
    "principled_constant", "principled_metal", "metallic_gradient", "arm_image", "alpha_of_an_image",
    "emission_of_principled", "mix_of_diffuse_and_glossy", "two_slots_of_one_mesh",
)  # fmt: skip


def build(folder: Path) -> tuple[Path, str]:
    """Build and validate the extension's zip with Blender's tool; return its path and the tool's output."""
    import bpy

    tool = Path(bpy.utils.resource_path("LOCAL")) / "scripts/addons_core/bl_pkg/cli/blender_ext.py"
    output = ""
    source = ["--source-dir", str(REPOSITORY / "blender_addon"), "--output-dir", str(folder)]
    for command in (["build", *source], ["validate", str(folder / "scene_materials-0.1.0.zip")]):
        done = subprocess.run(
            [sys.executable, str(tool), *command], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        output += done.stdout
    return folder / "scene_materials-0.1.0.zip", output


def main(folder: Path, packages: Path) -> None:
    import bpy  # isort: skip  (it provides addon_utils)

    import addon_utils

    archive, output = build(folder)
    outcome: dict[str, Any] = {"tool": output}
    sys.path = [p for p in sys.path if Path(p or ".").resolve() != REPOSITORY]  # import the installed copy
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(
        filepath=str(archive), repo="user_default", enable_on_install=True
    )
    addon_utils.enable(MODULE, default_set=True)
    outcome["file"] = sys.modules[MODULE].__file__
    outcome["has_operators"] = all(
        hasattr(bpy.types, f"SCENE_MATERIALS_OT_{name}") for name in ("check", "export", "tag")
    )
    for name in ROUND_TRIP:
        bpy.ops.scene_materials.import_package(filepath=str(packages / name / "asset.json"))
    chosen = bpy.context.window_manager.scene_materials
    chosen.kind, chosen.max_texture = "object", "1024"
    bpy.ops.scene_materials.check()
    outcome["status"] = chosen.status
    outcome["problems"] = [f"{p.severity} {p.place} {p.message}" for p in chosen.problems]
    outcome["export"] = sorted(bpy.ops.scene_materials.export(directory=str(folder / "again")))
    operators = sys.modules[f"{MODULE}.operators"]
    outcome["is_command_registered"] = operators.cli_command is not None  # needed by `blender --command`
    arguments = ["--kind", "object", "--max-texture", "1024", "--out"]
    outcome["command"] = operators.run_command([*arguments, str(folder / "by_command")])
    outcome["refused_command"] = operators.run_command(
        [*arguments, str(folder / "refused"), "--only", "not there"]
    )
    bpy.context.scene.objects[0].select_set(True)
    bpy.ops.scene_materials.tag(role="camera_region", target="objects")
    outcome["tagged"] = [t.name for t in bpy.context.scene.objects if t.get("sm_role") == "camera_region"]
    addon_utils.disable(MODULE)
    outcome["is_command_unregistered"] = operators.cli_command is None
    outcome["disabled"] = not hasattr(bpy.types.WindowManager, "scene_materials")
    print("\n" + json.dumps(outcome))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

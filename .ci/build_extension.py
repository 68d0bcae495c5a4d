# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the add-on as a Blender extension and validates it with Blender's tool: build_extension.py OUT."""

import subprocess
import sys
from pathlib import Path

import bpy

tool = (
    Path(bpy.utils.resource_path("LOCAL")) / "scripts" / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
)
out = Path(sys.argv[1])
out.mkdir(parents=True, exist_ok=True)
subprocess.run(
    [sys.executable, str(tool), "build", "--source-dir", "blender_addon", "--output-dir", str(out)],
    check=True,
)
for package in sorted(out.glob("*.zip")):
    subprocess.run([sys.executable, str(tool), "validate", str(package)], check=True)

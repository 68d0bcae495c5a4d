# SPDX-License-Identifier: GPL-3.0-or-later
"""Supported versions of Blender: earlier ones register the extension, and are refused by name."""

from __future__ import annotations

import bpy

OLDEST = (4, 5)
"""Earlier ones keep meshes otherwise and give the inputs of the Principled node other names."""


def fault_of_version() -> tuple[str, str] | None:
    """Message that this Blender's version is not supported, with the remedy, or None."""
    if bpy.app.version[:2] >= OLDEST:
        return None
    oldest = ".".join(map(str, OLDEST))
    return (
        f"this is Blender {bpy.app.version_string}; expected {oldest} or later",
        f"open the file in Blender {oldest} LTS, or export it without a window, on Python 3.11: "
        "pip install 'scene-materials[blender]', then python -m blender_addon FILE.blend --out packages",
    )

# SPDX-License-Identifier: GPL-3.0-or-later
"""Supported versions of Blender. Older versions load the extension, but its commands refuse to run."""

from __future__ import annotations

import bpy

OLDEST = (4, 5)
"""Oldest supported version; earlier ones store meshes and name inputs of the Principled node differently."""


def fault_of_version() -> tuple[str, str] | None:
    """Message and remedy if this version of Blender is not supported, else None."""
    if bpy.app.version[:2] >= OLDEST:
        return None
    oldest = ".".join(map(str, OLDEST))
    return (
        f"this is Blender {bpy.app.version_string}; expected {oldest} or later",
        f"open the file in Blender {oldest} LTS, or export it without a window, on Python 3.11: "
        "pip install 'scene-materials[blender]', then python -m blender_addon FILE.blend --out packages",
    )

# SPDX-License-Identifier: GPL-3.0-or-later
"""Refuses drivers that Blender did not evaluate because they need Python and scripts are disabled.

Blender sets the property of such a driver to 0, whatever its saved value.
"""

from __future__ import annotations

import bpy

from .problems import ERROR, ProblemList

_BLOCKS = (
    "objects", "meshes", "curves", "materials", "lights", "cameras", "worlds", "node_groups", "shape_keys",
    "armatures", "scenes",
)  # fmt: skip
_REMEDY = (
    "open the file in Blender, allow its scripts if you trust them, and export it there; or write the driver "
    "without Python, or remove it"
)


def refuse_unevaluated_drivers(problems: ProblemList) -> None:
    """Add an error for each data-block with drivers that were not evaluated."""
    bpy.context.view_layer.update()
    for collection in _BLOCKS:
        for block in getattr(bpy.data, collection):
            paths = [path for owner in (block, getattr(block, "node_tree", None)) for path in _paths(owner)]
            if paths:
                what = ", ".join(sorted(set(paths))[:5])
                message = f"{collection} {block.name!r}: drivers need Python, which is not run: {what}"
                problems.add(ERROR, message, _REMEDY)


def _paths(owner: bpy.types.ID | None) -> list[str]:
    data = getattr(owner, "animation_data", None)
    if data is None:
        return []
    return [
        f"{curve.data_path}[{curve.array_index}]"
        for curve in data.drivers
        if curve.driver.type == "SCRIPTED"
        and not curve.driver.is_simple_expression
        and not curve.driver.is_valid
    ]

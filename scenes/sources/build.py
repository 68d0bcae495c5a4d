# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the assets: in an empty file, a source creates tagged Blender data, which the add-on exports."""

from __future__ import annotations

from pathlib import Path

import bpy

from blender_addon.export import export
from blender_addon.settings import ExportSettings
from scenes.sources import modelling
from scenes.sources.environments import ENVIRONMENTS
from scenes.sources.materials.catalogue import MATERIALS
from scenes.sources.materials.graph import Graph
from scenes.sources.objects import OBJECTS

FOLDERS = {"environment": "environments", "object": "objects", "material": "materials"}
TOLERANCE = 0.7 / 255  # textures are reduced as far as the mean error of each channel stays below this
SLOT_TEXTURE_PX = {"environment": 512, "object": 256}


def sources() -> dict[str, str]:
    """Map the id of every asset to its kind, in the order in which assets are built."""
    kinds = {name: "material" for name in MATERIALS}
    kinds |= {name: "object" for name in OBJECTS}
    kinds |= {name: "environment" for name in ENVIRONMENTS}
    return kinds


def make(name: str) -> str:
    """Create one asset in an empty Blender file, tagged for the export; return its kind."""
    modelling.new_file()
    kind = sources()[name]
    if kind == "material":
        modelling.tag_material(MATERIALS[name].build(Graph(name)), name)
    elif kind == "object":
        source = OBJECTS[name]
        collection = modelling.tagged_collection(
            "object", name, source.title, sm_category=source.category, sm_supports=", ".join(source.supports),
            sm_scale_range=source.scale, sm_yaw_range_rad=source.yaw_range_rad,
        )  # fmt: skip
        builder = modelling.PartBuilder(source.slots)
        source.build(builder)
        builder.build(collection)
    else:
        room = ENVIRONMENTS[name]
        collection = modelling.tagged_collection("environment", name, room.title)
        room.build(modelling.PartBuilder(room.slots), collection)
    bpy.context.view_layer.update()
    return kind


def build(name: str, out: Path, quality: int = 1) -> tuple[Path, list[str]]:
    """Export one asset below ``out``; return the package's folder and the export's problems as text.

    ``quality`` multiplies the textures' maximum side and divides the tolerance.
    """
    kind = make(name)
    side = MATERIALS[name].max_px if kind == "material" else SLOT_TEXTURE_PX[kind]
    settings = ExportSettings(kind=kind, max_texture_px=side * quality, tolerance=TOLERANCE / quality)
    folder = out / FOLDERS[kind]
    folder.mkdir(parents=True, exist_ok=True)
    result = export(folder, settings)
    return result.packages[0], [str(problem) for problem in result.problems]

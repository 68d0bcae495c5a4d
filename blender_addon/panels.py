# SPDX-License-Identifier: GPL-3.0-or-later
"""The Materials tab of the 3D view's sidebar: tags, problems, export."""

from __future__ import annotations

import textwrap

import bpy

from .operators import options

_WIDTH = 34  # characters per line of a problem's details
_ICONS = {"error": "ERROR", "approximation": "INFO", "note": "DOT"}
_OBJECT_TAGS = (("sm_category", "cup"), ("sm_supports", "table, shelf, counter"), ("sm_license", "CC0-1.0"))
_MARKER_TAGS = {"support_surface": (("sm_kind", "table"),), "light_slot": (("sm_kind", "area"),)}
_MATERIAL_TAGS = (("sm_class", "other"), ("sm_replaceable_by", "wood, metal"), ("sm_tile_size_m", "1.0"))


class SCENE_MATERIALS_UL_problems(bpy.types.UIList):
    """List of problems: a severity icon and the message."""

    def draw_item(
        self,
        context: bpy.types.Context,
        layout: bpy.types.UILayout,
        data: object,
        item: bpy.types.PropertyGroup,
        icon: int,
        active_data: object,
        active_property: str,
    ) -> None:
        row = layout.row(align=True)
        row.label(text=item.message, icon=_ICONS.get(item.severity, "DOT"))


class _Panel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Materials"


class SCENE_MATERIALS_PT_tags(_Panel, bpy.types.Panel):
    """Tags of the active object, its material and the collection."""

    bl_label = "Tags"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.operator("scene_materials.tag", text="Tag selection ...", icon="BOOKMARKS")
        thing = context.object
        if context.collection is not None:
            self._block(layout, context.collection, "collection", _OBJECT_TAGS)
        if thing is not None:
            role = str(thing.get("sm_role", ""))
            tags = _MARKER_TAGS.get(role, _OBJECT_TAGS if role == "object" else ())
            self._block(layout, thing, "object", tags)
            if thing.active_material is not None:
                self._block(layout, thing.active_material, "material", _MATERIAL_TAGS)

    @staticmethod
    def _block(
        layout: bpy.types.UILayout, block: bpy.types.ID, target: str, tags: tuple[tuple[str, str], ...]
    ) -> None:
        if target == "collection" and not block.get("sm_role"):
            return
        box = layout.box()
        box.label(text=f"{target.capitalize()}: {block.name}")
        if "sm_role" in block:
            box.prop(block, '["sm_role"]', text="Role")
        for name, value in tags:
            if name in block:
                box.prop(block, f'["{name}"]', text=name.removeprefix("sm_").replace("_", " "))
            else:
                add = box.operator("scene_materials.set_property", text=f"Add {name}", icon="ADD")
                add.target, add.name, add.value = target, name, value


class SCENE_MATERIALS_PT_export(_Panel, bpy.types.Panel):
    """Settings, problems and buttons of the export."""

    bl_label = "Export"

    def draw(self, context: bpy.types.Context) -> None:
        layout, chosen = self.layout, options()
        layout.use_property_split = True
        for name in ("directory", "kind", "license", "author", "max_texture", "tolerance", "bake_normals"):
            layout.prop(chosen, name)
        layout.prop(chosen, "report")
        if chosen.report:
            layout.prop(chosen, "report_python")
        row = layout.row()
        row.operator("scene_materials.check", icon="CHECKMARK")
        export = row.operator("scene_materials.export", text="Export", icon="EXPORT")
        export.directory = bpy.path.abspath(chosen.directory)
        if chosen.status:
            layout.label(text=chosen.status)
        if not chosen.problems:
            return
        layout.template_list(
            "SCENE_MATERIALS_UL_problems", "", chosen, "problems", chosen, "active_problem", rows=6
        )
        if 0 <= chosen.active_problem < len(chosen.problems):
            self._details(layout, chosen.problems[chosen.active_problem])

    @staticmethod
    def _details(layout: bpy.types.UILayout, item: bpy.types.PropertyGroup) -> None:
        box = layout.box()
        texts = ((item.place, "OBJECT_DATA"), (item.message, "INFO"), (item.remedy, "TOOL_SETTINGS"))
        for text, icon in texts:
            for index, line in enumerate(textwrap.wrap(text, _WIDTH)):
                box.label(text=line, icon=icon if index == 0 else "BLANK1")
        if item.object:
            box.operator("scene_materials.select_problem", icon="RESTRICT_SELECT_OFF")


CLASSES = (SCENE_MATERIALS_UL_problems, SCENE_MATERIALS_PT_tags, SCENE_MATERIALS_PT_export)


register, unregister = bpy.utils.register_classes_factory(CLASSES)

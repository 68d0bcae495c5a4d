# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: export (with a progress bar, cancelled by Esc), check, tag, import."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, ClassVar

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    StringProperty,
)
from bpy_extras.io_utils import ImportHelper

from .export import ExportResult, check, export_steps
from .gather.tags import ROLES
from .import_package import import_package
from .problems import ExportRefused, Problem
from .settings import KINDS, ExportSettings

_TICK_S = 0.01
_STEP_BUDGET_S = 0.2  # longest time without redrawing the window

KIND_ITEMS = [(kind, kind.capitalize(), "") for kind in KINDS]
ROLE_ITEMS = [("none", "None", "Nothing special")] + [
    (role, role.replace("_", " ").capitalize(), "") for role in (*ROLES, "material")
]


class ProblemItem(bpy.types.PropertyGroup):
    """One line of the problem list."""

    severity: StringProperty()  # type: ignore[valid-type]
    place: StringProperty()  # type: ignore[valid-type]
    message: StringProperty()  # type: ignore[valid-type]
    remedy: StringProperty()  # type: ignore[valid-type]
    object: StringProperty()  # type: ignore[valid-type]


class ExportOptions(bpy.types.PropertyGroup):
    """The panel's settings, stored in the window manager, not in the .blend file."""

    directory: StringProperty(name="Folder", subtype="DIR_PATH", default="//packages/")  # type: ignore[valid-type]
    kind: EnumProperty(name="Kind", items=KIND_ITEMS, default="auto")  # type: ignore[valid-type]
    tolerance: FloatProperty(  # type: ignore[valid-type]
        name="Tolerance",
        description="Mean change of a channel below which its texture is not enlarged",
        default=1 / 255,
        min=1e-4,
        max=0.5,
        precision=4,
    )
    max_texture: EnumProperty(  # type: ignore[valid-type]
        name="Largest texture",
        items=[(str(1 << n), f"{1 << n} px", "") for n in range(6, 14)],
        default="2048",
    )
    bake_normals: BoolProperty(  # type: ignore[valid-type]
        name="Bake normals", description="Bump and normal inputs become a normal texture"
    )
    license: StringProperty(name="Licence", description="SPDX identifier, such as CC0-1.0")  # type: ignore[valid-type]
    author: StringProperty(name="Author")  # type: ignore[valid-type]
    report: BoolProperty(  # type: ignore[valid-type]
        name="Fidelity report", description="Render each material in Cycles and in Mitsuba, and compare"
    )
    report_python: StringProperty(  # type: ignore[valid-type]
        name="Python with Mitsuba",
        description="The Python executable of an environment that has this project installed",
        subtype="FILE_PATH",
    )
    problems: CollectionProperty(type=ProblemItem)  # type: ignore[valid-type]
    active_problem: IntProperty()  # type: ignore[valid-type]
    status: StringProperty()  # type: ignore[valid-type]

    def settings(self) -> ExportSettings:
        """Convert to the settings of the export functions."""
        return ExportSettings(
            kind=self.kind,
            tolerance=self.tolerance,
            max_texture_px=int(self.max_texture),
            bake_normals=self.bake_normals,
            license=self.license,
            author=self.author,
            report=self.report,
            report_python=bpy.path.abspath(self.report_python),
        )

    def show(self, problems: list[Problem], status: str) -> None:
        """Fill the problem list, the most severe problem first."""
        self.problems.clear()
        order = {"error": 0, "approximation": 1, "note": 2}
        for problem in sorted(problems, key=lambda p: order[p.severity]):
            item = self.problems.add()
            item.severity, item.message, item.remedy = problem.severity, problem.message, problem.remedy
            item.place, item.object = problem.place, problem.object
        self.status = status


def options() -> ExportOptions:
    """The panel's settings in the running Blender."""
    return bpy.context.window_manager.scene_materials


class SCENE_MATERIALS_OT_check(bpy.types.Operator):
    """List all errors and approximations of an export, without writing anything"""

    bl_idname = "scene_materials.check"
    bl_label = "Check"

    def execute(self, context: bpy.types.Context) -> set[str]:
        problems = check(options().settings())
        errors = sum(problem.severity == "error" for problem in problems)
        options().show(problems, f"{errors} errors, {len(problems) - errors} remarks")
        return {"FINISHED"}


class SCENE_MATERIALS_OT_export(bpy.types.Operator):
    """Write everything that is tagged to asset packages; Esc cancels"""

    bl_idname = "scene_materials.export"
    bl_label = "Scene Materials asset package"

    directory: StringProperty(subtype="DIR_PATH")  # type: ignore[valid-type]
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not self.directory:
            self.directory = bpy.path.abspath(options().directory)
            context.window_manager.fileselect_add(self)
            return {"RUNNING_MODAL"}
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        out = Path(bpy.path.abspath(self.directory or options().directory))
        try:
            out.mkdir(parents=True, exist_ok=True)
            self._steps = export_steps(out, options().settings())
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if bpy.app.background:
            return self._advance(math.inf)
        window_manager = context.window_manager
        window_manager.progress_begin(0, 1000)
        self._timer = window_manager.event_timer_add(_TICK_S, window=context.window)
        window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC":
            self._steps.close()
            self._clean_up(context)
            options().status = "cancelled: nothing was written"
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        outcome = self._advance(time.monotonic() + _STEP_BUDGET_S)
        if outcome == {"RUNNING_MODAL"}:
            _redraw(context)
        else:
            self._clean_up(context)
        return outcome

    def _clean_up(self, context: bpy.types.Context) -> None:
        context.window_manager.progress_end()
        context.window_manager.event_timer_remove(self._timer)
        _redraw(context)

    def _advance(self, until: float) -> set[str]:
        """Export until the monotonic clock reads ``until``; returns the operator's state."""
        try:
            while time.monotonic() < until:
                progress = next(self._steps)
                bpy.context.window_manager.progress_update(int(progress.fraction * 1000))
                options().status = f"{progress.fraction:.0%} {progress.text}"
        except StopIteration as stop:
            result: ExportResult = stop.value
            counts = f"{result.num_instances} instances, {result.num_triangles} triangles"
            text = f"{len(result.packages)} packages, {counts}"
            options().show(result.problems, text)
            self.report({"INFO"}, text)
            return {"FINISHED"}
        except ExportRefused as refused:
            errors = sum(problem.severity == "error" for problem in refused.problems)
            options().show(refused.problems, f"refused: {errors} errors")
            self.report({"ERROR"}, f"{errors} errors; the list is in the Materials tab of the sidebar")
            return {"CANCELLED"}
        except OSError as error:
            options().status = str(error)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"RUNNING_MODAL"}


def _redraw(context: bpy.types.Context) -> None:
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


class SCENE_MATERIALS_OT_tag(bpy.types.Operator):
    """Set the role of the selected objects, or of the active material or collection"""

    bl_idname = "scene_materials.tag"
    bl_label = "Tag"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    role: EnumProperty(name="Role", items=ROLE_ITEMS)  # type: ignore[valid-type]
    target: EnumProperty(  # type: ignore[valid-type]
        name="On",
        items=[("objects", "Selected objects", ""), ("collection", "Active collection", ""),
               ("material", "Active material", "")],
    )  # fmt: skip

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self)

    def execute(self, context: bpy.types.Context) -> set[str]:
        blocks: list[Any] = []
        if self.target == "objects":
            blocks = list(context.selected_objects)
        elif self.target == "collection" and context.collection is not None:
            blocks = [context.collection]
        elif self.target == "material" and context.object is not None and context.object.active_material:
            blocks = [context.object.active_material]
        if not blocks:
            self.report({"WARNING"}, "there is nothing to tag")
            return {"CANCELLED"}
        for block in blocks:
            if self.role != "none":
                block["sm_role"] = self.role
            elif "sm_role" in block:
                del block["sm_role"]
        return {"FINISHED"}


class SCENE_MATERIALS_OT_set_property(bpy.types.Operator):
    """Add a tag with a typical value, to edit in the panel"""

    bl_idname = "scene_materials.set_property"
    bl_label = "Add tag"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    target: StringProperty()  # type: ignore[valid-type]
    name: StringProperty()  # type: ignore[valid-type]
    value: StringProperty()  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        thing = context.object
        block = {
            "object": thing,
            "collection": context.collection,
            "material": thing.active_material if thing is not None else None,
            "scene": context.scene,
        }[self.target]
        if block is None:
            return {"CANCELLED"}
        block[self.name] = self.value
        return {"FINISHED"}


class SCENE_MATERIALS_OT_select_problem(bpy.types.Operator):
    """Select the object of the selected problem"""

    bl_idname = "scene_materials.select_problem"
    bl_label = "Select object"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        chosen = options()
        if not 0 <= chosen.active_problem < len(chosen.problems):
            return {"CANCELLED"}
        thing = context.view_layer.objects.get(chosen.problems[chosen.active_problem].object)
        if thing is None:
            self.report({"INFO"}, "the problem does not concern an object")
            return {"CANCELLED"}
        for other in context.selected_objects:
            other.select_set(False)
        thing.select_set(True)
        context.view_layer.objects.active = thing
        return {"FINISHED"}


class SCENE_MATERIALS_OT_import(bpy.types.Operator, ImportHelper):
    """Load an asset package as objects with materials"""

    bl_idname = "scene_materials.import_package"
    bl_label = "Scene Materials asset package"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filename_ext = ".json"
    filter_glob: StringProperty(default="asset.json;*.zip", options={"HIDDEN"})  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            imported = import_package(Path(self.filepath))
        except (OSError, ValueError, KeyError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for remark in imported.remarks:
            self.report({"WARNING"}, remark)
        self.report({"INFO"}, f"loaded {imported.collection.name}")
        return {"FINISHED"}


def _export_entry(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(SCENE_MATERIALS_OT_export.bl_idname)


def _import_entry(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(SCENE_MATERIALS_OT_import.bl_idname)


CLASSES = (
    ProblemItem,
    ExportOptions,
    SCENE_MATERIALS_OT_check,
    SCENE_MATERIALS_OT_export,
    SCENE_MATERIALS_OT_tag,
    SCENE_MATERIALS_OT_set_property,
    SCENE_MATERIALS_OT_select_problem,
    SCENE_MATERIALS_OT_import,
)


def run_command(arguments: list[str]) -> int:
    """Run ``blender -b FILE --command scene_materials ARGUMENTS``; returns the exit code."""
    from .command import build_parser, run

    return run(build_parser("blender -b FILE --command scene_materials").parse_args(arguments))


cli_command: Any = None
"""Handle of the registered command."""


def register() -> None:
    """Register classes, menu entries, options and the command."""
    global cli_command
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.WindowManager.scene_materials = bpy.props.PointerProperty(type=ExportOptions)
    bpy.types.TOPBAR_MT_file_export.append(_export_entry)
    bpy.types.TOPBAR_MT_file_import.append(_import_entry)
    if hasattr(bpy.utils, "register_cli_command"):
        cli_command = bpy.utils.register_cli_command("scene_materials", run_command)


def unregister() -> None:
    """Undo :func:`register`."""
    global cli_command
    if cli_command is not None:
        bpy.utils.unregister_cli_command(cli_command)
        cli_command = None
    bpy.types.TOPBAR_MT_file_import.remove(_import_entry)
    bpy.types.TOPBAR_MT_file_export.remove(_export_entry)
    del bpy.types.WindowManager.scene_materials
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)

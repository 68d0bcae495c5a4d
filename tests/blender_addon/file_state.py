# SPDX-License-Identifier: GPL-3.0-or-later
"""Snapshot of a Blender file as nested plain data, to compare before and after an export."""

from __future__ import annotations

from typing import Any

# Values of the running program rather than of the file: caches, timestamps, load states.
RUNTIME = {
    "rna_type", "bl_rna", "session_uid", "is_evaluated", "has_data", "bindcode", "is_dirty", "tag", "preview",
    "is_runtime_data", "original", "pixels", "size", "depth", "channels", "is_updated", "is_updated_data",
    "frame_current_final", "resolution", "display_aspect", "frame_duration", "type_info", "is_float",
    "depsgraph", "uv_layer_clone", "uv_layer_stencil", "is_tagged", "id_data", "asset_data",
    "is_library_indirect", "matrix_parent_inverse",
}  # fmt: skip


def snapshot(bpy: Any) -> dict[str, Any]:
    """Return the state of the open file: every datablock, its users and properties, selection, and mode."""
    state: dict[str, Any] = {}
    for prop in bpy.data.bl_rna.properties:
        if prop.type != "COLLECTION" or prop.identifier in ("window_managers", "screens", "workspaces"):
            continue
        blocks = getattr(bpy.data, prop.identifier)
        state[prop.identifier] = {block.name_full: _block(block) for block in blocks}
    state["context"] = {
        "scene": bpy.context.scene.name,
        "mode": bpy.context.mode,
        "active": bpy.context.view_layer.objects.active.name if bpy.context.view_layer.objects.active else "",
        "selected": sorted(thing.name for thing in bpy.context.view_layer.objects if thing.select_get()),
        "hidden": sorted(thing.name for thing in bpy.context.view_layer.objects if thing.hide_get()),
    }
    return state


def _block(block: Any) -> Any:
    result = _structure(block, set())
    result["users"] = block.users
    result["custom"] = {
        key: repr(block[key].to_list() if hasattr(block[key], "to_list") else block[key])
        for key in sorted(block.keys())
        if key != "cycles"
    }
    return result


def _structure(item: Any, above: set[tuple[int, str]]) -> dict[str, Any]:
    result: dict[str, Any] = {"type": type(item).__name__}
    key = (item.as_pointer(), type(item).__name__)
    if key in above or len(above) > 8:
        return result
    above = {*above, key}
    for prop in item.bl_rna.properties:
        name = prop.identifier
        if name in RUNTIME:
            continue
        try:
            value = getattr(item, name)
        except (AttributeError, RuntimeError):
            continue
        if prop.type == "POINTER":
            result[name] = _reference(value, above)
        elif prop.type == "COLLECTION":
            result[name] = [_reference(entry, above) for entry in value][:2000]
        elif hasattr(value, "__len__") and not isinstance(value, (str, set, bytes)):
            result[name] = repr([list(v) if hasattr(v, "__len__") else v for v in value])
        else:
            result[name] = repr(sorted(value) if isinstance(value, set) else value)
    return result


def _reference(value: Any, above: set[tuple[int, str]]) -> Any:
    if value is None:
        return None
    is_block = hasattr(value, "name_full") and not getattr(value, "is_embedded_data", False)
    return f"{type(value).__name__}:{value.name_full}" if is_block else _structure(value, above)


def differences(before: Any, after: Any, path: str = "") -> list[str]:
    """Return the paths at which two snapshots differ, with the values."""
    if isinstance(before, dict) and isinstance(after, dict):
        found = []
        for key in sorted(before.keys() | after.keys(), key=str):
            if key not in before or key not in after:
                found.append(f"{path}/{key}: {'appeared' if key in after else 'is gone'}")
            else:
                found += differences(before[key], after[key], f"{path}/{key}")
        return found
    if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        pairs = zip(before, after, strict=True)
        return [line for i, (a, b) in enumerate(pairs) for line in differences(a, b, f"{path}[{i}]")]
    return [] if before == after else [f"{path}: {str(before)[:80]} -> {str(after)[:80]}"]

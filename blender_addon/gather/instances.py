# SPDX-License-Identifier: GPL-3.0-or-later
"""Gathers visible surfaces from the dependency graph: each mesh once, and its instances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import bpy
import numpy as np
from numpy.typing import NDArray

from ..problems import APPROXIMATION, ERROR, NOTE, ProblemList
from .mesh import MeshArrays, gather_mesh
from .tags import MARKER_ROLES, role_of

_SURFACES = ("MESH", "CURVE", "SURFACE", "FONT", "META")
_REFUSED = {
    "CURVES": "hair curves cannot be exported",
    "POINTCLOUD": "point clouds cannot be exported",
    "VOLUME": "volumes cannot be exported",
    "GREASEPENCIL": "grease pencil cannot be exported",
    "GPENCIL": "grease pencil cannot be exported",
}
_MATRIX_EPSILON = 1e-12


@dataclass
class Instance:
    """One instance of a mesh.

    ``matrix`` (4, 4) is world_from_object in Blender units; ``owner`` is the object in the scene that creates
    the instance; ``materials`` are names by slot; ``object_info`` contains the outputs of Object Info nodes.
    """

    name: str
    owner: str
    mesh_key: int
    matrix: NDArray[np.float64]
    materials: tuple[str | None, ...]
    object_info: dict[str, tuple[float, ...]]

    @property
    def is_mirrored(self) -> bool:
        return bool(np.linalg.det(self.matrix[:3, :3]) < 0)


@dataclass
class Gathered:
    """The gathered meshes by key (``Instance.mesh_key``), and their instances."""

    meshes: dict[int, MeshArrays] = field(default_factory=dict)
    instances: list[Instance] = field(default_factory=list)


def hash_name(name: str) -> int:
    """Cycles' 32-bit random id of an object that is not an instance, from its name (util/hash.h).

    This is Bob Jenkins' hash of two words: a polynomial of the name's bytes, and 0.
    """
    mask = 0xFFFFFFFF
    value = 0
    for byte in name.encode():
        value = (value * 37 + byte) & mask
    start = (0xDEADBEEF + (2 << 2) + 13) & mask
    changed, by, other = start, start, (start + value) & mask
    for shift in (14, 11, 25, 16, 4, 14, 24):
        rotated = by << shift | by >> (32 - shift)
        changed, by, other = other, ((changed ^ by) - rotated) & mask, by
    return by


def gather_instances(
    depsgraph: bpy.types.Depsgraph,
    is_wanted: Callable[[str], bool],
    keep: Callable[[int, bpy.types.Mesh, tuple[str | None, ...]], None],
    problems: ProblemList,
) -> Gathered:
    """Read all visible surfaces whose owner's name satisfies ``is_wanted``.

    ``keep`` is called with the key, the evaluated mesh and the materials of each instance, and may copy the
    mesh, which is freed when the iteration over the dependency graph continues.
    """
    result = Gathered()
    for shown in depsgraph.object_instances:
        thing = shown.object
        owner = shown.parent.original if shown.is_instance and shown.parent else thing.original
        if not is_wanted(owner.name) or not shown.show_self or role_of(owner) in (*MARKER_ROLES, "ignore"):
            continue
        if owner.hide_render or thing.original.hide_render or role_of(thing.original) in MARKER_ROLES:
            continue
        if thing.type in _REFUSED:
            problems.add(ERROR, _REFUSED[thing.type], "convert to a mesh or hide it", object=owner.name)
            continue
        if thing.type not in _SURFACES:
            continue
        _check_modifiers(thing.original, problems)
        matrix = np.array(shown.matrix_world, dtype=np.float64)
        if abs(np.linalg.det(matrix[:3, :3])) < _MATRIX_EPSILON:
            problems.add(NOTE, "has a scale of 0 and is left out", object=owner.name)
            continue
        key, materials = _mesh_of(thing, result, keep)
        if len(result.meshes[key].triangles) == 0:
            continue
        info = _object_info(shown, thing, matrix)
        result.instances.append(Instance(thing.original.name, owner.name, key, matrix, materials, info))
    return result


def _mesh_of(
    thing: bpy.types.Object,
    result: Gathered,
    keep: Callable[[int, bpy.types.Mesh, tuple[str | None, ...]], None],
) -> tuple[int, tuple[str | None, ...]]:
    is_mesh = isinstance(thing.data, bpy.types.Mesh)
    key = thing.data.as_pointer() if is_mesh else thing.original.as_pointer()
    data = thing.data if is_mesh else thing.to_mesh()
    materials = _materials(thing, data)
    if key not in result.meshes:
        result.meshes[key] = gather_mesh(data)
    keep(key, data, materials)
    if not is_mesh:
        thing.to_mesh_clear()
    return key, materials


def _materials(thing: bpy.types.Object, data: bpy.types.Mesh) -> tuple[str | None, ...]:
    slots = thing.material_slots
    found: list[str | None] = []
    for index in range(max(len(data.materials), 1)):
        material = data.materials[index] if index < len(data.materials) else None
        if index < len(slots) and slots[index].link == "OBJECT":
            material = slots[index].material
        found.append(material.original.name if material is not None else None)
    return tuple(found)


def _object_info(
    shown: bpy.types.DepsgraphObjectInstance, thing: bpy.types.Object, matrix: NDArray[np.float64]
) -> dict[str, tuple[float, ...]]:
    original = thing.original
    random_id = shown.random_id & 0xFFFFFFFF if shown.is_instance else hash_name(original.name)
    colour = tuple(original.color)
    return {
        "Location": tuple(float(v) for v in matrix[:3, 3]),
        "Color": colour[:3],
        "Alpha": (colour[3],),
        "Object Index": (float(original.pass_index),),
        "Material Index": (0.0,),
        "Random": (random_id / 0xFFFFFFFF,),
    }


def _check_modifiers(thing: bpy.types.Object, problems: ProblemList) -> None:
    for modifier in thing.modifiers:
        if modifier.type == "PARTICLE_SYSTEM" and modifier.particle_system.settings.type == "HAIR":
            problems.add(
                ERROR, "hair cannot be exported", "convert it to a mesh or remove it", object=thing.name
            )
        differs = modifier.show_render != modifier.show_viewport
        if modifier.type in ("SUBSURF", "MULTIRES") and modifier.show_render:
            differs |= modifier.levels != modifier.render_levels
        if differs:
            message = f"modifier {modifier.name!r} is exported as in the viewport, not as rendered"
            remedy = "give it the same levels and visibility for viewport and render"
            problems.add(APPROXIMATION, message, remedy, object=thing.name)

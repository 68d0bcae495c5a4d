# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds a UV layout without overlaps for the faces of one material slot."""

from __future__ import annotations

import math

import bpy
import numpy as np
from numpy.typing import NDArray

from ..gather.mesh import MeshArrays, is_unit_unwrap
from .execute import BAKE_UV, BakeSession
from .textures import BORDER

_ISLAND_MARGIN = 0.004  # of the unit square: two texels at 512
_DOMAINS = {"vert": "POINT", "edge": "EDGE", "poly": "FACE"}
_LARGEST_CHECKED = 200_000  # triangles; testing the UVs of a larger mesh takes longer than a new unwrap


def bake_layout(
    session: BakeSession, thing: bpy.types.Object, arrays: MeshArrays, slot: int
) -> NDArray[np.float32]:
    """UVs (C, 2) of face corners for baking the slot's faces; adds the layer ``BAKE_UV`` to the mesh.

    A border of the unit square stays free, since texture lookups wrap around. The mesh's active UVs are used
    if they are a valid unwrap; otherwise Smart UV Project creates new ones.
    """
    mesh = thing.data
    if BAKE_UV not in mesh.uv_layers:
        mesh.uv_layers.new(name=BAKE_UV)
    own = arrays.uv_layers.get(arrays.active_uv)
    num_triangles = int((arrays.triangle_slots == slot).sum())
    if own is not None and num_triangles <= _LARGEST_CHECKED and is_unit_unwrap(arrays, own, slot):
        values = own
    else:
        _smart_project(session, thing, arrays, slot)
        values = np.empty((len(mesh.loops), 2), np.float32)
        mesh.uv_layers[BAKE_UV].uv.foreach_get("vector", values.ravel())
    return (BORDER + values * (1 - 2 * BORDER)).astype(np.float32)


def _smart_project(session: BakeSession, thing: bpy.types.Object, arrays: MeshArrays, slot: int) -> None:
    mesh = thing.data
    num_polygons = len(mesh.polygons)
    chosen = np.zeros(num_polygons, bool)
    chosen[arrays.triangle_polygons[arrays.triangle_slots == slot]] = True
    mesh.uv_layers.active = mesh.uv_layers[BAKE_UV]
    mesh.polygons.foreach_set("hide", np.zeros(num_polygons, bool))
    with session.only(thing):
        _select(mesh, chosen)
        bpy.ops.object.mode_set(mode="EDIT")
        try:
            with bpy.context.temp_override(edit_object=thing):
                bpy.ops.uv.smart_project(
                    angle_limit=math.radians(66), island_margin=_ISLAND_MARGIN, correct_aspect=False
                )
        finally:
            bpy.ops.object.mode_set(mode="OBJECT")


def _select(mesh: bpy.types.Mesh, chosen: NDArray[np.bool_]) -> None:
    """Select the chosen polygons with their edges and vertices.

    The attributes are written directly: in some meshes Blender 5.0 creates ``.select_edge`` with the wrong
    type, and setting ``select`` of their edges crashes the program.
    """
    totals = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_total", totals)
    corner_chosen = np.repeat(chosen, totals)
    vertex_of_corner = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", vertex_of_corner)
    edge_of_corner = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("edge_index", edge_of_corner)
    vertices = np.zeros(len(mesh.vertices), bool)
    vertices[vertex_of_corner[corner_chosen]] = True
    edges = np.zeros(len(mesh.edges), bool)
    edges[edge_of_corner[corner_chosen]] = True
    for domain, values in (("vert", vertices), ("edge", edges), ("poly", chosen)):
        name = f".select_{domain}"
        layer = mesh.attributes.get(name)
        if layer is not None and layer.data_type != "BOOLEAN":
            mesh.attributes.remove(layer)
            layer = None
        if layer is None:
            layer = mesh.attributes.new(name, "BOOLEAN", _DOMAINS[domain])
        layer.data.foreach_set("value", values)

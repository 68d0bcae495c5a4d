# SPDX-License-Identifier: MIT
"""Reads the triangles of a glTF or GLB file as one mesh, without materials, images and animations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from datagen.foundation.budget import Budget
from datagen.foundation.errors import input_error
from datagen.foundation.meshes.gltf import TRIANGLE_MODES, GltfFile, PlacedNode, triangles_of
from datagen.foundation.meshes.mesh import Mesh, joined


def read_gltf(path: Path, budget: Budget) -> Mesh:
    """Read the triangles of all nodes in the scene's frame, with v upwards. Raises :class:`InputError`."""
    meshes: list[Mesh] = []
    with GltfFile(path, budget) as file:
        nodes = list(file.placed_nodes())
        file.placed_primitives(nodes)
        for placed in nodes:
            if "mesh" not in placed.node:
                continue
            for primitive in file.item("meshes", placed.node["mesh"], placed.name)["primitives"]:
                if primitive.get("mode", 4) in TRIANGLE_MODES:
                    meshes.append(_primitive(file, placed, primitive))
        if not meshes:
            raise input_error(path, "", "no triangles", "a mesh", "export the room's mesh")
        return joined(meshes)


def _primitive(file: GltfFile, placed: PlacedNode, primitive: dict[str, Any]) -> Mesh:
    if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
        raise file.error(
            placed.name, "Draco compression", "uncompressed meshes", "export it without compression"
        )
    attributes = primitive["attributes"]
    positions = file.accessor(attributes["POSITION"], placed.name).astype(np.float32)
    indices = np.arange(len(positions))
    if "indices" in primitive:
        indices = file.accessor(primitive["indices"], placed.name)[:, 0].astype(np.int64)
    faces = triangles_of(indices, int(primitive.get("mode", 4)))
    uv = None
    if "TEXCOORD_0" in attributes:
        uv = file.accessor(attributes["TEXCOORD_0"], placed.name).astype(np.float32)
        uv = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1) if len(uv) == len(positions) else None
    if np.linalg.det(placed.scene_from_node[:3, :3]) < 0:  # a mirroring node reverses the winding
        faces = faces[:, ::-1].copy()
    return Mesh(positions, faces, None, uv).transformed(placed.scene_from_node)

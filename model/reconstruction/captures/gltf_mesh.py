# SPDX-License-Identifier: MIT
"""The triangles of a glTF or GLB file as one mesh; materials, images and animations are passed over."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from datagen.foundation.errors import InputError, input_error
from datagen.foundation.meshes.gltf import GltfFile, PlacedNode, triangles_of
from datagen.foundation.meshes.mesh import Mesh, joined

_TRIANGLE_MODES = (4, 5, 6)  # list, strip, fan
# A file may place its meshes many times, but not without end; a primitive costs as much time as 200 corners.
_FREE_CORNERS, _PRIMITIVE = 10_000_000, 200


def read_gltf(path: Path) -> Mesh:
    """Every placed triangle in the document's frame, v upwards. Buffers must lie beside the document.

    Raises :class:`InputError`.
    """
    try:
        return _read(path)
    except InputError:
        raise
    except (
        OSError,
        KeyError,
        TypeError,
        ValueError,
        IndexError,
        AttributeError,
        OverflowError,
        RecursionError,
    ) as error:
        # the document is a tree of anything: what is missing or of another type shows here
        raise input_error(path, "", repr(error)[:200], "a readable glTF file", "export it again") from None


def _read(path: Path) -> Mesh:
    meshes: list[Mesh] = []
    room = _FREE_CORNERS + path.stat().st_size
    with GltfFile(path) as file:
        for placed in file.placed_nodes():
            if "mesh" not in placed.node:
                continue
            for primitive in file.item("meshes", placed.node["mesh"], placed.name)["primitives"]:
                if int(primitive.get("mode", 4)) not in _TRIANGLE_MODES:
                    continue
                meshes.append(_primitive(file, placed, primitive))
                room -= _PRIMITIVE + 3 * len(meshes[-1].faces) + len(meshes[-1].positions)
                if room < 0:
                    got = f"over {_FREE_CORNERS} corners of a file of {path.stat().st_size} bytes"
                    raise file.error("nodes", got, "a mesh that is placed a few times")
    if not meshes:
        raise input_error(path, "", "no triangles", "a mesh", "export the room's mesh")
    return joined(meshes)


def _primitive(file: GltfFile, placed: PlacedNode, primitive: dict[str, Any]) -> Mesh:
    if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
        raise file.error(placed.name, "Draco compression", "uncompressed meshes", "export it without")
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
    if np.linalg.det(placed.scene_from_node[:3, :3]) < 0:  # a mirroring node turns the winding round
        faces = faces[:, ::-1].copy()
    return Mesh(positions, faces, None, uv).transformed(placed.scene_from_node)

# SPDX-License-Identifier: MIT
"""Reads the mesh of a capture: PLY, OBJ, glTF or GLB, with or without UVs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.budget import Budget
from datagen.foundation.errors import input_error
from datagen.foundation.meshes.gltf import TRIANGLE_MODES, GltfFile, PlacedNode, triangles_of
from datagen.foundation.meshes.mesh import SINGULAR, Mesh, inspect_mesh, joined, welded, without_degenerate
from datagen.foundation.meshes.ply import read_ply
from datagen.foundation.paths import inside

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".gltf")
_OTHER_SUFFIXES = (
    ".3ds", ".abc", ".blend", ".dae", ".fbx", ".off", ".stl", ".usd", ".usda", ".usdc", ".usdz", ".x3d",
)  # fmt: skip
_CONVERT = f"convert it to {', '.join(MESH_SUFFIXES[:3])}, as Blender and MeshLab do"


def find_mesh(path: Path) -> Path:
    """Return the only mesh file in the folder ``path`` or next to the file ``path``.

    Raises :class:`InputError` if there is none or several.
    """
    folder = path if path.is_dir() else path.parent
    found = (
        [f for f in sorted(folder.iterdir()) if f.suffix.lower() in MESH_SUFFIXES] if folder.is_dir() else []
    )
    if len(found) != 1:
        got = ", ".join(f.name for f in found) or "no mesh beside the cameras"
        others = [f for f in sorted(folder.glob("*")) if f.suffix.lower() in _OTHER_SUFFIXES]
        if others and not found:
            got = f"{others[0].name}, of an unsupported format"
            raise input_error(path, "mesh", got, f"a mesh ({', '.join(MESH_SUFFIXES)})", _CONVERT)
        raise input_error(path, "mesh", got, "one mesh in the cameras' frame", "name it with --mesh")
    return inside(folder, found[0]).resolve()


def sound_mesh(mesh: Mesh, world_from_mesh: NDArray[np.float64], path: Path) -> tuple[Mesh, tuple[str, ...]]:
    """Transform a mesh to world space, drop degenerate and repeated triangles, and return notes on faults.

    Raises :class:`InputError`, which names ``path``, for an unusable mesh.
    """
    faults = inspect_mesh(mesh)
    if faults.is_unusable:
        raise input_error(path, "", str(faults), "finite triangles", "repair the mesh and export it again")
    if abs(np.linalg.det(world_from_mesh[:3, :3])) < SINGULAR:
        raise input_error(path, "world_from_mesh", world_from_mesh.tolist(), "an invertible matrix")
    mesh, num_repeated = _without_repeated(without_degenerate(mesh))
    notes = []
    for count, fault in (
        (faults.degenerate, "triangles of zero area were left out"),
        (num_repeated, "repeated triangles were left out"),
        (faults.non_manifold_edges, "edges have more than two triangles"),
        (faults.inconsistent_edges, "edges join triangles of opposite winding"),
    ):
        if count:
            notes.append(f"{path.name}: {count} {fault}")
    return mesh.transformed(world_from_mesh), tuple(notes)


def load_mesh(path: Path, budget: Budget | None = None) -> Mesh:
    """Read a mesh file in its own frame, within the capture's ``budget``. Raises :class:`InputError`."""
    budget = budget or Budget(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES or not path.is_file():
        got = (suffix or "no suffix") if path.is_file() else "no such file"
        remedy = _CONVERT if path.is_file() else "name it with --mesh"
        raise input_error(path, "", got, f"a mesh ({', '.join(MESH_SUFFIXES)})", remedy)
    mesh = _decoded(path, suffix, budget)
    if not len(mesh.faces):
        got = "points without triangles" if len(mesh.positions) else "no triangles"
        raise input_error(path, "", got, "a mesh", "export the surface, not the point cloud")
    return mesh


def _decoded(path: Path, suffix: str, budget: Budget) -> Mesh:
    if suffix == ".ply":
        return read_ply(path, budget)
    if suffix == ".obj":
        from datagen.foundation.meshes.obj import read_obj

        return read_obj(path, budget)
    return _read_gltf(path, budget)


def _without_repeated(mesh: Mesh) -> tuple[Mesh, int]:
    """Remove triangles that repeat the corners of another, in any order; return the mesh and their number.

    Only one of several coincident triangles would receive texels.
    """
    corners = np.sort(welded(mesh)[1][mesh.faces], axis=1)
    order = np.lexsort(corners.T)
    same = np.zeros(len(corners), dtype=bool)
    same[1:] = (corners[order][1:] == corners[order][:-1]).all(axis=1)
    keep = np.ones(len(corners), dtype=bool)
    keep[order[same]] = False  # lexsort is stable, so the first of equal triangles is kept
    if not same.any():
        return mesh, 0
    return Mesh(mesh.positions, mesh.faces[keep], mesh.normals, mesh.uv), int(same.sum())


def _read_gltf(path: Path, budget: Budget) -> Mesh:
    """Read the triangles of all nodes in the scene's frame as one mesh, with UVs whose v points up."""
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

# SPDX-License-Identifier: GPL-3.0-or-later
"""Loads an asset package into Blender: meshes, materials, lights, cameras, markers and tags."""

from __future__ import annotations

import json
import shutil
import tempfile
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from .import_materials import add_sample, make_material, package_file
from .import_places import IMAGE_SHAPE, Places
from .version import fault_of_version

_ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError)  # raised by zipfile
_MAX_ZIP_BYTES = 4 << 30
_MAX_JSON_BYTES = 256 * 1024 * 1024
_SHEAR = 1e-5  # largest relative error of a matrix composed of location, rotation and scale
_OFF_CENTRE_M = 1e-4


@dataclass
class Imported:
    """Result of an import: the new collection, and remarks on content that Blender represents inexactly."""

    collection: bpy.types.Collection
    remarks: list[str] = field(default_factory=list)


def import_package(path: Path) -> Imported:
    """Load a package (its folder, its ``asset.json`` or a zip) into a new collection of the scene.

    An environment light becomes the scene's world, and the first camera becomes the scene's camera if it has
    none. Images of a zip are stored in the .blend file. Raises ``ValueError`` for an invalid package or a
    version of Blender that is too old, and ``KeyError`` for a missing field; then nothing is added.
    """
    fault = fault_of_version()
    if fault is not None:
        raise ValueError("; ".join(fault))
    if path.suffix == ".zip":
        folder = Path(tempfile.mkdtemp(prefix="scene_materials_"))
        try:
            try:
                _unpack(path, folder)
            except _ZIP_ERRORS as error:
                raise ValueError(f"{path}: not readable as a zip: {error}") from error
            return _load_or_undo(folder, pack=True)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    return _load_or_undo(path.parent if path.name == "asset.json" else path, pack=False)


def _unpack(path: Path, folder: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        members = [member for member in archive.infolist() if not member.is_dir()]
        for name in archive.namelist():
            parts = PurePosixPath(name).parts
            if name.startswith("/") or ".." in parts or "\\" in name:
                raise ValueError(f"{path}: member {name!r} points outside the package; refused")
        if sum(member.file_size for member in members) > _MAX_ZIP_BYTES:
            raise ValueError(f"{path}: larger than 4 GB when unpacked")
        for member in members:  # zipfile reads no more than a member's stated size
            target = folder.joinpath(*PurePosixPath(member.filename).parts)
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(member) as packed, target.open("xb") as unpacked:
                shutil.copyfileobj(packed, unpacked)


def _load_or_undo(folder: Path, pack: bool) -> Imported:
    """Load a package; if that fails, remove what it added."""
    scene = bpy.context.scene
    before, world, camera = set(bpy.data.user_map()), scene.world, scene.camera
    shape = {name: getattr(scene.render, name) for name in IMAGE_SHAPE}
    try:
        return _load(folder, pack)
    except BaseException:
        bpy.data.batch_remove(set(bpy.data.user_map()) - before)
        scene.world, scene.camera = world, camera
        for name, value in shape.items():
            setattr(scene.render, name, value)
        raise


def _load(folder: Path, pack: bool) -> Imported:
    source = folder / "asset.json"
    if not source.is_file():
        nested = sorted(folder.glob("*/asset.json"))
        if len(nested) != 1:
            raise ValueError(f"{folder}: expected an asset.json")
        folder, source = nested[0].parent, nested[0]
    if source.stat().st_size > _MAX_JSON_BYTES:
        raise ValueError(f"{source}: larger than 256 MB")
    data = json.loads(source.read_text(encoding="utf-8"))
    if data.get("format") != "scene-materials/asset" or data.get("version") != 1:
        raise ValueError(
            f"{source}: format = {data.get('format')!r}; expected scene-materials/asset, version 1"
        )
    collection = bpy.data.collections.new(data["id"])
    imported = Imported(collection)
    bpy.context.scene.collection.children.link(collection)
    metres = bpy.context.scene.unit_settings.scale_length or 1.0
    if data["kind"] == "material":
        material = make_material(data["title"], data["material"], folder, pack)
        _tag(material, data)
        add_sample(material, collection, metres)
        return imported
    _tag(collection, data)
    _add_parts(collection, data, folder, pack, metres)
    places = Places(collection, metres, imported.remarks)
    places.add_lights(data.get("lights", []))
    if data["kind"] == "object":
        if data.get("footprint_m"):
            imported.remarks.append("the footprint's polygon is left out; an export uses the bounding box")
        return imported
    for light in (light for light in data.get("lights", ()) if light["type"] == "environment"):
        image = package_file(folder, light["image"]) if light.get("image") else None
        places.set_world(light, image, pack)
    places.add_cameras(data.get("cameras", []))
    places.add_markers(data)
    return imported


def _tag(block: bpy.types.ID, data: dict[str, Any]) -> None:
    """Write the package's metadata to the tags of a collection or material."""
    block["sm_role"], block["sm_id"], block["sm_title"] = data["kind"], data["id"], data["title"]
    for key in ("license", "author", "source", "usage"):
        if data["provenance"].get(key):
            block[f"sm_{key}"] = data["provenance"][key]
    if data.get("surfaces"):
        block["sm_surfaces"] = ", ".join(data["surfaces"])
    if data["kind"] != "object":
        return
    block["sm_category"] = data["category"]
    if data.get("supports"):
        block["sm_supports"] = ", ".join(data["supports"])
    for key in ("scale_range", "yaw_range_rad"):
        if data.get(key):
            block[f"sm_{key}"] = [float(value) for value in data[key]]
    if np.abs(np.add(data["minimum_m"], data["maximum_m"])[:2]).max() > _OFF_CENTRE_M:
        block["sm_keep_origin"] = True


def _add_parts(
    collection: bpy.types.Collection, data: dict[str, Any], folder: Path, pack: bool, metres: float
) -> None:
    """Add the surfaces: one object per part, one mesh for all parts that share file and material."""
    materials = {name: make_material(name, entry, folder, pack) for name, entry in data["materials"].items()}
    meshes: dict[tuple[str, str], bpy.types.Mesh] = {}
    for part in data["parts"]:
        matrix = np.array(part.get("asset_from_part", np.eye(4)))
        matrix[:3] /= metres
        if _is_sheared(matrix):  # objects cannot be sheared: the part gets a separate, transformed mesh
            mesh = _mesh(part["name"], package_file(folder, part["mesh"]), matrix)
            mesh.materials.append(materials[part["material"]])
            matrix = np.eye(4)
        else:
            pair = (part["mesh"], part["material"])
            if pair not in meshes:
                meshes[pair] = _mesh(part["name"], package_file(folder, part["mesh"]))
                meshes[pair].materials.append(materials[part["material"]])
            mesh = meshes[pair]
        thing = bpy.data.objects.new(part["name"], mesh)
        thing.matrix_world = matrix.T.tolist()
        collection.objects.link(thing)


def _is_sheared(matrix: NDArray[np.float64]) -> bool:
    """True if location, rotation and scale cannot represent a matrix (4, 4)."""
    kept = np.array(Matrix.LocRotScale(*Matrix(matrix.tolist()).decompose()))
    return bool(np.abs(kept - matrix).max() > _SHEAR * np.abs(matrix[:3, :3]).max() + 1e-6)


def read_ply(path: Path) -> tuple[dict[str, NDArray[np.float32]], NDArray[np.int32]]:
    """Read a PLY file: vertex columns (N,) by name, triangles (M, 3); ``ValueError`` for other content."""
    content = path.read_bytes()
    end = content.find(b"end_header\n")
    if not content.startswith(b"ply") or end < 0:
        raise ValueError(f"{path}: not a PLY file")
    lines = content[:end].decode("ascii", "replace").splitlines()
    if "format binary_little_endian 1.0" not in lines:
        raise ValueError(f"{path}: expected a binary little-endian PLY")
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    names, element = [], ""
    for line in lines:
        if line.startswith("element"):
            element = line.split()[1]
        elif line.startswith("property") and element == "vertex":
            if line.split()[1] not in ("float", "float32"):
                raise ValueError(f"{path}: {line!r}; expected float properties")
            names.append(line.split()[2])
    start, size = end + len(b"end_header\n"), counts["vertex"] * len(names) * 4
    table = np.frombuffer(content, "<f4", counts["vertex"] * len(names), start).reshape(-1, len(names))
    faces = np.frombuffer(
        content, np.dtype([("count", "u1"), ("index", "<i4", 3)]), counts["face"], start + size
    )
    if (faces["count"] != 3).any():
        raise ValueError(f"{path}: expected triangles only")
    if len(faces) and (faces["index"].min() < 0 or faces["index"].max() >= counts["vertex"]):
        raise ValueError(f"{path}: a face refers to a vertex that does not exist")
    return {name: table[:, i] for i, name in enumerate(names)}, faces["index"].astype(np.int32)


def _mesh(name: str, path: Path, matrix: NDArray[np.float64] | None = None) -> bpy.types.Mesh:
    """Create a mesh from a PLY file, transformed by ``matrix`` (4, 4) if given."""
    columns, faces = read_ply(path)
    mesh = bpy.data.meshes.new(name)
    matrix = np.eye(4) if matrix is None else matrix
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    positions = _stacked(columns, "x", "y", "z") @ matrix[:3, :3].T.astype(np.float32)
    positions += matrix[:3, 3].astype(np.float32)
    mesh.vertices.add(len(positions))
    mesh.loops.add(faces.size)
    mesh.polygons.add(len(faces))
    mesh.vertices.foreach_set("co", positions.ravel())
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    if "u" in columns:
        layer = mesh.uv_layers.new(name="UVMap")
        uv = _stacked(columns, "u", "v")[faces.ravel()]
        layer.uv.foreach_set("vector", uv.astype(np.float32).ravel())
    mesh.update(calc_edges=True)
    mesh.validate()
    if "nx" in columns:
        normals = _stacked(columns, "nx", "ny", "nz") @ np.linalg.inv(matrix[:3, :3]).astype(np.float32)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        mesh.normals_split_custom_set_from_vertices(normals.tolist())
    return mesh


def _stacked(columns: dict[str, NDArray[np.float32]], *names: str) -> NDArray[np.float32]:
    return np.stack([columns[name] for name in names], axis=1)

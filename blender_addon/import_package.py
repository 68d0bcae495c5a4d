# SPDX-License-Identifier: GPL-3.0-or-later
"""Loads an asset package into Blender: meshes, Principled materials with the right colour spaces, lights.

Where S is one small grey everywhere, the material is a Principled BSDF of base colour D whose specular level
gives that F0. Otherwise a Diffuse BSDF of (1 - S) D and a Glossy BSDF of S are added, which holds any D and S
(Principled has one base colour for both), and which the add-on exports back to the same channels.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

_LARGEST_DIELECTRIC_F0 = 0.2
_MAX_JSON_BYTES = 256 * 1024 * 1024


def import_package(path: Path) -> bpy.types.Collection:
    """Load a package (its folder, its ``asset.json`` or a zip) into a new collection of the scene.

    Raises ``ValueError`` for what is no package, with the file and the field. A zip's images are packed.
    """
    if path.suffix == ".zip":
        folder = Path(tempfile.mkdtemp(prefix="scene_materials_"))
        try:
            _unpack(path, folder)
            return _load(folder, pack=True)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    return _load(path.parent if path.name == "asset.json" else path, pack=False)


def _unpack(path: Path, folder: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            parts = PurePosixPath(name).parts
            if name.startswith("/") or ".." in parts or "\\" in name:
                raise ValueError(f"{path}: member {name!r} leaves the package; refused")
        archive.extractall(folder)


def _inside(folder: Path, name: str) -> Path:
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\\" in name or ":" in name:
        raise ValueError(f"{folder}/asset.json: path {name!r} leaves the package; refused")
    path = folder.joinpath(*parts)
    if not path.is_file():
        raise ValueError(f"{folder}/asset.json: {name!r} is missing")
    return path


def _load(folder: Path, pack: bool) -> bpy.types.Collection:
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
    bpy.context.scene.collection.children.link(collection)
    for key in ("license", "author", "source", "usage"):
        if data["provenance"].get(key):
            collection[f"sm_{key}"] = data["provenance"][key]
    collection["sm_id"], collection["sm_title"] = data["id"], data["title"]
    if data["kind"] == "material":
        material = _material(data["title"], data["material"], folder, pack)
        material["sm_role"] = "material"
        _sample(material, collection)
        return collection
    collection["sm_role"] = data["kind"]
    if data["kind"] == "object":
        collection["sm_category"] = data["category"]
    materials = {name: _material(name, entry, folder, pack) for name, entry in data["materials"].items()}
    meshes: dict[tuple[str, str], bpy.types.Mesh] = {}
    for part in data["parts"]:
        pair = (part["mesh"], part["material"])
        if pair not in meshes:
            meshes[pair] = _mesh(part["name"], _inside(folder, part["mesh"]))
            meshes[pair].materials.append(materials[part["material"]])
        thing = bpy.data.objects.new(part["name"], meshes[pair])
        matrix = np.array(part.get("asset_from_part", np.eye(4)))
        thing.matrix_world = matrix.T.tolist()
        collection.objects.link(thing)
    return collection


# ---- materials


def _material(name: str, entry: dict[str, Any], folder: Path, pack: bool) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    for key, tag in (("classes", "sm_class"), ("replaceable_by", "sm_replaceable_by")):
        if entry.get(key):
            material[tag] = ", ".join(entry[key])
    if entry.get("tile_size_m"):
        material["sm_tile_size_m"] = entry["tile_size_m"]
    build = _Nodes(material.node_tree, folder, pack)
    diffuse = entry.get("diffuse_albedo", [0.5] * 3)
    specular = entry.get("specular_albedo", [0.04] * 3)
    roughness = entry.get("roughness", 0.5)
    is_grey = isinstance(specular, list) and max(specular) - min(specular) < 1e-6
    if is_grey and specular[0] <= _LARGEST_DIELECTRIC_F0:
        shader = build.principled(diffuse, specular[0], roughness)
    else:
        shader = build.sum(diffuse, specular, roughness)
    build.finish(shader, entry)
    return material


class _Nodes:
    """Makes the nodes of one material."""

    def __init__(self, tree: bpy.types.NodeTree, folder: Path, pack: bool):
        self.tree, self.folder, self.pack = tree, folder, pack
        self.principled_node = tree.nodes["Principled BSDF"]
        self.output = tree.nodes["Material Output"]
        self._column = 0

    def _new(self, kind: str) -> bpy.types.Node:
        node = self.tree.nodes.new(f"ShaderNode{kind}")
        self._column += 1
        node.location = (-320 - 40 * (self._column % 3), 320 - 280 * self._column)
        return node

    def _channel(self, value: Any, socket: bpy.types.NodeSocket) -> None:
        """Set an input to a constant, or link the texture that the channel names."""
        if not isinstance(value, dict):
            is_colour = hasattr(socket.default_value, "__len__")
            socket.default_value = (*value, 1.0) if is_colour else float(value)
            return
        node = self._new("TexImage")
        node.image = bpy.data.images.load(str(_inside(self.folder, value["texture"])), check_existing=True)
        if self.pack:
            node.image.pack()
        is_float = Path(value["texture"]).suffix.lower() == ".exr"
        is_srgb = value["encoding"] == "srgb" and not is_float
        node.image.colorspace_settings.name = "sRGB" if is_srgb else "Non-Color"
        node.image.alpha_mode = "CHANNEL_PACKED"
        source = node.outputs["Color"]
        channel = value.get("channel", "rgb")
        if channel == "a":
            source = node.outputs["Alpha"]
        elif channel != "rgb":
            separate = self._new("SeparateColor")
            self.tree.links.new(source, separate.inputs[0])
            source = separate.outputs["rgb".index(channel)]
        scale, offset = value.get("scale", 1.0), value.get("offset", 0.0)
        if (scale, offset) != (1.0, 0.0):
            adjust = self._new("VectorMath")
            adjust.operation = "MULTIPLY_ADD"
            adjust.inputs[1].default_value, adjust.inputs[2].default_value = (scale,) * 3, (offset,) * 3
            self.tree.links.new(source, adjust.inputs[0])
            source = adjust.outputs[0]
        self.tree.links.new(source, socket)

    def principled(self, diffuse: Any, f0: float, roughness: Any) -> bpy.types.Node:
        node = self.principled_node
        self._channel(diffuse, node.inputs["Base Color"])
        self._channel(roughness, node.inputs["Roughness"])
        node.inputs["IOR"].default_value = 1.5
        node.inputs["Specular IOR Level"].default_value = f0 / 0.08  # F0 = 0.04 * 2 * level
        return node

    def sum(self, diffuse: Any, specular: Any, roughness: Any) -> bpy.types.Node:
        """Diffuse of (1 - S) D plus Glossy of S."""
        self.tree.nodes.remove(self.principled_node)
        glossy, lambert, total = (
            self._new("BsdfAnisotropic"),
            self._new("BsdfDiffuse"),
            self._new("AddShader"),
        )
        self._channel(specular, glossy.inputs["Color"])
        self._channel(roughness, glossy.inputs["Roughness"])
        invert, product = self._new("VectorMath"), self._new("VectorMath")
        invert.operation, product.operation = "SUBTRACT", "MULTIPLY"
        invert.inputs[0].default_value = (1, 1, 1)
        for value, socket in ((specular, invert.inputs[1]), (diffuse, product.inputs[0])):
            if isinstance(value, dict):
                self._channel(value, socket)
            else:
                socket.default_value = value
        self.tree.links.new(invert.outputs[0], product.inputs[1])
        self.tree.links.new(product.outputs[0], lambert.inputs["Color"])
        self.tree.links.new(lambert.outputs[0], total.inputs[0])
        self.tree.links.new(glossy.outputs[0], total.inputs[1])
        return total

    def finish(self, shader: bpy.types.Node, entry: dict[str, Any]) -> None:
        """Opacity, emission and normal around the shader."""
        result = shader.outputs[0]
        if entry.get("normal"):
            normal = self._new("NormalMap")
            self._channel(entry["normal"], normal.inputs["Color"])
            for node in self.tree.nodes:
                if node.type in ("BSDF_PRINCIPLED", "BSDF_DIFFUSE", "BSDF_GLOSSY"):
                    self.tree.links.new(normal.outputs[0], node.inputs["Normal"])
        if entry.get("emission"):
            emission, total = self._new("Emission"), self._new("AddShader")
            strength = max(entry["emission"])
            emission.inputs["Strength"].default_value = strength
            colour = [component / strength for component in entry["emission"]] if strength > 0 else [0.0] * 3
            emission.inputs["Color"].default_value = (*colour, 1)
            self.tree.links.new(result, total.inputs[0])
            self.tree.links.new(emission.outputs[0], total.inputs[1])
            result = total.outputs[0]
        if entry.get("opacity") is not None:
            mix, clear = self._new("MixShader"), self._new("BsdfTransparent")
            self._channel(entry["opacity"], mix.inputs[0])
            self.tree.links.new(clear.outputs[0], mix.inputs[1])
            self.tree.links.new(result, mix.inputs[2])
            result = mix.outputs[0]
        self.tree.links.new(result, self.output.inputs["Surface"])


def _sample(material: bpy.types.Material, collection: bpy.types.Collection) -> None:
    """A square metre that shows a material."""
    mesh = bpy.data.meshes.new(material.name)
    side = float(material.get("sm_tile_size_m", 1.0))
    mesh.from_pydata([(0, 0, 0), (side, 0, 0), (side, side, 0), (0, side, 0)], [], [(0, 1, 2, 3)])
    layer = mesh.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    mesh.materials.append(material)
    collection.objects.link(bpy.data.objects.new(material.name, mesh))


# ---- meshes


def read_ply(path: Path) -> tuple[dict[str, NDArray[np.float32]], NDArray[np.int32]]:
    """Vertex columns by name and triangles of a binary little-endian PLY as the packages hold them."""
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
        raise ValueError(f"{path}: a face refers to a vertex that is not there")
    return {name: table[:, i] for i, name in enumerate(names)}, faces["index"].astype(np.int32)


def _mesh(name: str, path: Path) -> bpy.types.Mesh:
    columns, faces = read_ply(path)
    mesh = bpy.data.meshes.new(name)
    positions = np.stack([columns[c] for c in "xyz"], axis=1)
    mesh.vertices.add(len(positions))
    mesh.loops.add(faces.size)
    mesh.polygons.add(len(faces))
    mesh.vertices.foreach_set("co", positions.ravel())
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    if "u" in columns:
        layer = mesh.uv_layers.new(name="UVMap")
        uv = np.stack([columns["u"], columns["v"]], axis=1)[faces.ravel()]
        layer.uv.foreach_set("vector", uv.astype(np.float32).ravel())
    mesh.update(calc_edges=True)
    mesh.validate()
    if "nx" in columns:
        normals = np.stack([columns[c] for c in ("nx", "ny", "nz")], axis=1)
        mesh.normals_split_custom_set_from_vertices(normals.tolist())
    return mesh

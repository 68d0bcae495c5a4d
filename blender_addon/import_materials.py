# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the materials of an asset package as node graphs.

If S is a constant grey of at most 0.2, the material is a Principled BSDF of base colour D with the specular
level for that F0. Otherwise it is the sum of a Diffuse BSDF of (1 - S) D and a Metallic BSDF of S. This sum
equals the project's BSDF for any D and S (Principled has one base colour for both), and the add-on exports it
to the same channels.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

import bpy
import numpy as np

_LARGEST_DIELECTRIC_F0 = 0.2


def package_file(folder: Path, name: str) -> Path:
    """Path of a file in a package; raises ``ValueError`` if it is outside the package or missing."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\\" in name or ":" in name:
        raise ValueError(f"{folder}/asset.json: path {name!r} points outside the package; refused")
    path = folder.joinpath(*parts)
    if not path.is_file():
        raise ValueError(f"{folder}/asset.json: {name!r} is missing")
    return path


def make_material(name: str, entry: dict[str, Any], folder: Path, pack: bool) -> bpy.types.Material:
    """Create a material from its entry in ``asset.json``; ``pack`` stores its images in the .blend file."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    for key, tag in (("classes", "sm_class"), ("replaceable_by", "sm_replaceable_by")):
        if entry.get(key):
            material[tag] = ", ".join(entry[key])
    for key in ("tile_size_m", "baked_from", "surface"):
        if entry.get(key):
            material[f"sm_{key}"] = entry[key]
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
    """Creates the nodes of one material."""

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
        """Set an input to a constant, or link the channel's texture."""
        if not isinstance(value, dict):
            is_colour = hasattr(socket.default_value, "__len__")
            socket.default_value = (*value, 1.0) if is_colour else float(value)
            return
        node = self._new("TexImage")
        path = package_file(self.folder, value["texture"])
        node.image = bpy.data.images.load(str(path), check_existing=True)
        if self.pack:
            node.image.pack()
        is_float = path.suffix.lower() == ".exr"
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
        """Add a Diffuse BSDF of (1 - S) D to a Metallic BSDF of S (white edge tint: Schlick's curve)."""
        self.tree.nodes.remove(self.principled_node)
        gloss, lambert, total = map(self._new, ("BsdfMetallic", "BsdfDiffuse", "AddShader"))
        gloss.distribution, gloss.fresnel_type = "BECKMANN", "F82"
        gloss.inputs["Edge Tint"].default_value = (1, 1, 1, 1)
        self._channel(specular, gloss.inputs["Base Color"])
        self._channel(roughness, gloss.inputs["Roughness"])
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
        self.tree.links.new(gloss.outputs[0], total.inputs[1])
        return total

    def finish(self, shader: bpy.types.Node, entry: dict[str, Any]) -> None:
        """Add normal, emission and opacity to the shader, and link it to the output."""
        result = shader.outputs[0]
        if entry.get("normal"):
            normal = self._new("NormalMap")
            self._channel(entry["normal"], normal.inputs["Color"])
            for node in self.tree.nodes:
                if node.type in ("BSDF_PRINCIPLED", "BSDF_DIFFUSE", "BSDF_METALLIC"):
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


def add_sample(material: bpy.types.Material, collection: bpy.types.Collection, metres: float) -> None:
    """Add a square of a material to ``collection``, as wide as its tile (by default 1 m).

    ``metres``: number of metres per Blender unit.
    """
    mesh = bpy.data.meshes.new(material.name)
    side = float(material.get("sm_tile_size_m", 1.0)) / metres
    mesh.from_pydata([(0, 0, 0), (side, 0, 0), (side, side, 0), (0, side, 0)], [], [(0, 1, 2, 3)])
    layer = mesh.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    mesh.materials.append(material)
    collection.objects.link(bpy.data.objects.new(material.name, mesh))

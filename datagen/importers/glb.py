# SPDX-License-Identifier: MIT
"""Encoder of meshes and plain materials as binary glTF, for formats that are imported through glTF."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh

_FLOAT, _UINT = 5126, 5125


@dataclass(frozen=True)
class GlbMaterial:
    """A material whose linear ``color`` multiplies ``image``, the (media type, bytes) of an sRGB image."""

    color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    roughness: float = 1.0
    is_metal: bool = False
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    opacity: float = 1.0
    image: tuple[str, bytes] | None = None


def encode_glb(surfaces: Sequence[tuple[str, Mesh]], materials: Mapping[str, GlbMaterial]) -> bytes:
    """Encode a .glb file with one node for each pair (material name, mesh); v of the UVs points up."""
    return _Writer(materials).encode(surfaces)


class _Writer:
    def __init__(self, materials: Mapping[str, GlbMaterial]):
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []
        self.content = bytearray()
        self.images: list[dict[str, Any]] = []
        self.numbers = {name: number for number, name in enumerate(materials)}
        self.materials = [self.material(name, material) for name, material in materials.items()]

    def material(self, name: str, material: GlbMaterial) -> dict[str, Any]:
        factor = [*(min(max(c, 0.0), 1.0) for c in material.color), min(max(material.opacity, 0.0), 1.0)]
        surface: dict[str, Any] = {
            "baseColorFactor": factor,
            "metallicFactor": float(material.is_metal),
            "roughnessFactor": material.roughness,
        }
        if material.image is not None:
            self.images.append({"mimeType": material.image[0], "bufferView": self.view(material.image[1])})
            surface["baseColorTexture"] = {"index": len(self.images) - 1}
        entry: dict[str, Any] = {"name": name or "default", "pbrMetallicRoughness": surface}
        strength = max(material.emission)
        if strength > 0:
            entry["emissiveFactor"] = [c / max(strength, 1.0) for c in material.emission]
            if strength > 1:
                entry["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": strength}}
        if material.opacity < 1:
            entry["alphaMode"] = "BLEND"
        return entry

    def view(self, data: bytes) -> int:
        self.content += bytes(-len(self.content) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.content), "byteLength": len(data)})
        self.content += data
        return len(self.views) - 1

    def accessor(self, array: NDArray) -> int:
        is_index = array.dtype.kind in "iu"
        data = np.ascontiguousarray(array, "<u4" if is_index else "<f4")
        entry: dict[str, Any] = {
            "bufferView": self.view(data.tobytes()),
            "componentType": _UINT if is_index else _FLOAT,
            "count": len(data),
            "type": "SCALAR" if is_index else f"VEC{data.shape[1]}",
        }
        if not is_index:
            entry |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def encode(self, surfaces: Sequence[tuple[str, Mesh]]) -> bytes:
        meshes: list[dict[str, Any]] = []
        nodes: list[dict[str, Any]] = []
        for name, mesh in surfaces:
            attributes = {"POSITION": self.accessor(mesh.positions)}
            if mesh.normals is not None:
                attributes["NORMAL"] = self.accessor(mesh.normals)
            if mesh.uv is not None:
                attributes["TEXCOORD_0"] = self.accessor(mesh.uv * [1, -1] + [0, 1])
            primitive: dict[str, Any] = {
                "attributes": attributes,
                "indices": self.accessor(mesh.faces.ravel()),
            }
            if name in self.numbers:
                primitive["material"] = self.numbers[name]
            nodes.append({"name": name or "surface", "mesh": len(meshes)})
            meshes.append({"primitives": [primitive]})
        document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(nodes)))}],
            "nodes": nodes,
            "meshes": meshes,
            "materials": self.materials,
            "images": self.images,
            "textures": [{"source": number} for number in range(len(self.images))],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.content)}],
            "extensionsUsed": ["KHR_materials_emissive_strength"],
        }
        text = json.dumps({key: value for key, value in document.items() if value != []}).encode()
        text += b" " * (-len(text) % 4)
        self.content += bytes(-len(self.content) % 4)
        total = 12 + 8 + len(text) + 8 + len(self.content)
        head = b"glTF" + struct.pack("<II", 2, total) + struct.pack("<I", len(text)) + b"JSON"
        return head + text + struct.pack("<I", len(self.content)) + b"BIN\0" + bytes(self.content)

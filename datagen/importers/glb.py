# SPDX-License-Identifier: MIT
"""Encoder of meshes and plain materials as binary glTF, for formats that are imported through glTF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from datagen.foundation.meshes.glb import GlbWriter
from datagen.foundation.meshes.mesh import Mesh


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
    """Encode a .glb file with one node per pair (material name, mesh); in the meshes' UVs, v points up."""
    writer, numbers = GlbWriter(), {name: number for number, name in enumerate(materials)}
    entries = [_material_entry(writer, name, material) for name, material in materials.items()]
    meshes: list[dict[str, Any]] = []
    nodes: list[dict[str, Any]] = []
    for name, mesh in surfaces:
        attributes = {"POSITION": writer.array(mesh.positions, "VEC3")}
        if mesh.normals is not None:
            attributes["NORMAL"] = writer.array(mesh.normals, "VEC3")
        if mesh.uv is not None:
            attributes["TEXCOORD_0"] = writer.array(mesh.uv * [1, -1] + [0, 1], "VEC2")
        indices = writer.array(mesh.faces.reshape(-1, 1), "SCALAR")
        primitive: dict[str, Any] = {"attributes": attributes, "indices": indices}
        if name in numbers:
            primitive["material"] = numbers[name]
        nodes.append({"name": name or "surface", "mesh": len(meshes)})
        meshes.append({"primitives": [primitive]})
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": entries,
        "textures": [{"source": number} for number in range(len(writer.images))],
        **writer.tables(),
        "extensionsUsed": ["KHR_materials_emissive_strength"],
    }
    return writer.encode({key: value for key, value in document.items() if value != []})


def _material_entry(writer: GlbWriter, name: str, material: GlbMaterial) -> dict[str, Any]:
    factor = [*(min(max(c, 0.0), 1.0) for c in material.color), min(max(material.opacity, 0.0), 1.0)]
    surface: dict[str, Any] = {
        "baseColorFactor": factor,
        "metallicFactor": float(material.is_metal),
        "roughnessFactor": material.roughness,
    }
    if material.image is not None:
        kind, content = material.image
        surface["baseColorTexture"] = {"index": writer.image(content, kind)}
    entry: dict[str, Any] = {"name": name or "default", "pbrMetallicRoughness": surface}
    strength = max(material.emission)
    if strength > 0:
        entry["emissiveFactor"] = [c / max(strength, 1.0) for c in material.emission]
        if strength > 1:
            entry["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": strength}}
    if material.opacity < 1:
        entry["alphaMode"] = "BLEND"
    return entry

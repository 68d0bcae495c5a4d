# SPDX-License-Identifier: MIT
"""Writes a reconstruction as GLB: metallic-roughness with KHR_materials_specular (``metallic_textures``)."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import write_bytes_atomically
from datagen.foundation.axes import Z_UP_FROM_Y_UP
from datagen.foundation.meshes.mesh import Mesh
from model.reconstruction.export.gltf_lights import PUNCTUAL, emissive, punctual_lights
from model.reconstruction.export.metallic_textures import DIELECTRIC_F0, MAX_DIELECTRIC_F0, ConversionError
from model.reconstruction.export.slots import Reconstruction, export_slots, patch_meshes

_FLOAT, _UINT = 5126, 5125


def write_glb(path: Path, reconstruction: Reconstruction, *, has_punctual: bool = False) -> ConversionError:
    """Write a GLB with geometry (rotated to Y up) and textures; return the error of the conversion.

    Recovered lamps, panels and windows become emissive surfaces; ``has_punctual`` adds point lights for small
    lamps and a directional light for the sun. The sky is omitted, since glTF does not support it.
    """
    made = reconstruction.metallic
    writer = _Glb()
    textures = [writer.image(png) for png in (made.base_color, made.orm, made.specular_color)]
    materials: list[dict[str, Any]] = []
    primitives = []

    def add(mesh: Mesh, material: dict[str, Any]) -> None:
        has_uv = "baseColorTexture" in material["pbrMetallicRoughness"]
        primitives.append({**writer.mesh(mesh, has_uv=has_uv), "material": len(materials)})
        materials.append(material)

    for name, slot in export_slots(reconstruction).items():
        material = _material(name, textures) if slot.has_material else _black(name)
        add(slot.mesh, material if slot.emission is None else emissive(material, slot.emission))
    found = reconstruction.shining_lights
    for name, (mesh, radiance) in (
        {} if found is None else patch_meshes((*found.panels, *found.windows)).items()
    ):
        add(mesh, emissive(_black(name), radiance))
    nodes: list[dict[str, Any]] = [{"mesh": 0, "name": reconstruction.capture.name}]
    lights, light_nodes = punctual_lights(reconstruction) if has_punctual else ([], [])
    used = {name for material in materials for name in material.get("extensions", {})}
    used |= {PUNCTUAL} if lights else set()
    nodes += light_nodes
    document = {
        "asset": {"version": "2.0", "generator": "scene-materials"},
        "extensionsUsed": sorted(used),
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": [{"primitives": primitives, "name": reconstruction.capture.name}],
        "materials": materials,
        "textures": [{"source": k, "sampler": 0} for k in range(len(textures))],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        **writer.tables(),
    }
    if lights:
        document["extensions"] = {PUNCTUAL: {"lights": lights}}
    if not used:
        del document["extensionsUsed"]
    write_bytes_atomically(path, writer.encode(document))
    return made.error


def _material(name: str, textures: list[int]) -> dict[str, Any]:
    base, packed, tint = ({"index": index} for index in textures)
    factor = MAX_DIELECTRIC_F0 / DIELECTRIC_F0
    return {
        "name": name,
        "doubleSided": True,
        "pbrMetallicRoughness": {"baseColorTexture": base, "metallicRoughnessTexture": packed},
        "occlusionTexture": packed,
        "extensions": {
            "KHR_materials_specular": {"specularColorTexture": tint, "specularColorFactor": [factor] * 3}
        },
    }


def _black(name: str) -> dict[str, Any]:
    return {"name": name, "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0}}


def _unit(vectors: NDArray) -> NDArray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), [0.0, 1.0, 0.0])


class _Glb:
    """Collects the binary data of a GLB and the JSON tables that describe it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.images: list[dict[str, Any]] = []

    def _view(self, content: bytes, target: int | None = None) -> int:
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += content
        return len(self.views) - 1

    def array(self, rows: NDArray, kind: str, *, has_bounds: bool = False) -> int:
        """Add an array (N, C) of vertex data (float32) or, if ``kind`` is ``SCALAR``, of indices (uint32);
        return the index of its accessor.
        """
        is_index = kind == "SCALAR"
        stored = np.ascontiguousarray(rows, "<u4" if is_index else "<f4")
        accessor: dict[str, Any] = {
            "bufferView": self._view(stored.tobytes(), 34963 if is_index else 34962),
            "componentType": _UINT if is_index else _FLOAT,
            "count": len(stored),
            "type": kind,
        }
        if has_bounds:
            accessor["min"], accessor["max"] = stored.min(axis=0).tolist(), stored.max(axis=0).tolist()
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def mesh(self, mesh: Mesh, *, has_uv: bool) -> dict[str, Any]:
        """Add a mesh; return the JSON attributes and indices of its primitive."""
        assert mesh.normals is not None and mesh.uv is not None
        turn = Z_UP_FROM_Y_UP[:3, :3]  # multiplication from the right applies the inverse, Y up from Z up
        attributes = {
            "POSITION": self.array(mesh.positions @ turn, "VEC3", has_bounds=True),
            "NORMAL": self.array(_unit(mesh.normals @ turn), "VEC3"),
        }
        if has_uv:
            attributes["TEXCOORD_0"] = self.array(mesh.uv * [1, -1] + [0, 1], "VEC2")
        return {"attributes": attributes, "indices": self.array(mesh.faces.reshape(-1, 1), "SCALAR")}

    def image(self, png: bytes) -> int:
        """Add a PNG image; return its index, which is also that of its texture."""
        self.images.append({"bufferView": self._view(png), "mimeType": "image/png"})
        return len(self.images) - 1

    def tables(self) -> dict[str, Any]:
        """Return the JSON tables of the collected objects."""
        return {
            "images": self.images,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data) + -len(self.data) % 4}],
        }

    def encode(self, document: dict[str, Any]) -> bytes:
        """Encode a GLB file from the JSON ``document`` and the collected data."""
        text = json.dumps(document, sort_keys=True, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.data) + bytes(-len(self.data) % 4)
        chunks = ((b"JSON", text), (b"BIN\0", binary))
        body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body

# SPDX-License-Identifier: MIT
"""A reconstruction as GLB: metallic-roughness with KHR_materials_specular, and the error of that conversion.

glTF's F0 is lerp(min(0.04 c, 1), base, m) with the specular colour c and the metalness m, its diffuse albedo
base (1 - m). Surfaces of F0 up to 0.16 (an index of 2.3) become dielectrics, exactly: m = 0, base = D, c = S
/ 0.04. Beyond, m solves S (1 - m) = 0.16 (1 - m)^2 + D m in the mean over channels, so that viewers without
the extension see metals as metals; c takes up what it can of the remainder.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import write_bytes_atomically
from datagen.foundation.axes import Z_UP_FROM_Y_UP
from datagen.foundation.color import linear_from_srgb, srgb_from_linear
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.mesh import Mesh
from model.reconstruction.export.atlas_images import quantized_bytes
from model.reconstruction.export.gltf_lights import PUNCTUAL, emissive, punctual_lights
from model.reconstruction.export.slots import Reconstruction, export_slots, patch_meshes

DIELECTRIC_F0 = 0.04
MAX_DIELECTRIC_F0 = 0.16
MAX_SIZE = 4096
"""Largest side of textures inside the file: more is beyond most viewers. Larger atlases are averaged down."""
_BAND = 1024
_FLOAT, _UINT = 5126, 5125


@dataclass(frozen=True)
class ConversionError:
    """Absolute error of D and S as a glTF reader has them, over all texels with surface, and the side of the
    textures."""

    diffuse_mean: float
    diffuse_max: float
    specular_mean: float
    specular_max: float
    texture_px: int


def metallic_channels(
    diffuse: NDArray[np.float32], specular: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Base colour (..., 3), metalness (...), and specular colour over its factor 4 (..., 3), all in [0,
    1]."""
    limit = MAX_DIELECTRIC_F0
    d, s = diffuse.mean(axis=-1), specular.mean(axis=-1)
    b = d + s - 2 * limit
    root = np.sqrt(np.maximum(b * b - 4 * limit * (limit - s), 0.0))
    metallic = np.where(specular.max(axis=-1) <= limit, 0.0, np.clip((root - b) / (2 * limit), 0.0, 1.0))
    m = metallic[..., None]
    from_diffuse = diffuse / np.maximum(1 - m, 1e-3)
    from_specular = (specular - limit * (1 - m)) / np.maximum(m, 1e-3)
    base = np.clip(from_diffuse * (1 - m * m) + np.clip(from_specular, 0, 1) * m * m, 0.0, 1.0)
    tint = np.clip((specular - base * m) / np.maximum(limit * (1 - m), 1e-6), 0.0, 1.0)
    tint = np.where(m > 1 - 1e-3, 1.0, tint)
    return tuple(a.astype(np.float32) for a in (base, metallic, tint))  # type: ignore[return-value]


def as_read(base: NDArray, metallic: NDArray, tint: NDArray) -> tuple[NDArray, NDArray]:
    """D and S (..., 3) that a glTF reader gets."""
    m = metallic[..., None]
    return base * (1 - m), np.minimum(MAX_DIELECTRIC_F0 * tint, 1.0) * (1 - m) + base * m


def write_glb(path: Path, reconstruction: Reconstruction, *, has_punctual: bool = False) -> ConversionError:
    """One GLB with geometry (turned to Y up) and textures inside; returns what the conversion costs.

    Lamps, panels and windows that were found are emissive surfaces; ``has_punctual`` adds point lights where
    lamps are small. glTF has no sky.
    """
    images, error = _encode_textures(reconstruction)
    writer = _Glb()
    textures = [writer.image(data) for data in images]
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
        "textures": [{"source": k, "sampler": 0} for k in range(len(images))],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        **writer.tables(),
    }
    if lights:
        document["extensions"] = {PUNCTUAL: {"lights": lights}}
    if not used:
        del document["extensionsUsed"]
    write_bytes_atomically(path, writer.encode(document))
    return error


def _encode_textures(reconstruction: Reconstruction) -> tuple[list[bytes], ConversionError]:
    """PNGs of base colour, roughness and metalness (G and B), specular colour; and the error, bytes
    included."""
    atlas = reconstruction.atlas
    shrink = next(k for k in range(-(-atlas.size // MAX_SIZE), atlas.size + 1) if atlas.size % k == 0)
    bands: list[list[NDArray[np.uint8]]] = [[], [], []]
    sums, most, num = np.zeros(2), np.zeros(2), 0
    for top in range(0, atlas.size, _BAND * shrink):
        rows = slice(top, top + _BAND * shrink)
        diffuse, specular, rough = (_averaged(atlas.maps[name][rows], shrink) for name in atlas.maps)
        base, metallic, tint = metallic_channels(diffuse, specular)
        packed = np.stack([np.zeros_like(metallic), rough[..., 0], metallic], axis=-1)
        encoded = [srgb_from_linear(base), packed, srgb_from_linear(tint)]
        stored = [quantized_bytes(image) for image in encoded]
        for band, image in zip(bands, stored, strict=True):
            band.append(image)
        read = as_read(
            linear_from_srgb(stored[0] / 255.0),
            stored[1][..., 2] / 255.0,
            linear_from_srgb(stored[2] / 255.0),
        )
        on_surface = atlas.face[rows][::shrink, ::shrink] >= 0
        num += int(on_surface.sum())
        for k, (got, truth) in enumerate(zip(read, (diffuse, specular), strict=True)):
            difference = np.abs(got - truth)[on_surface]
            sums[k] += float(difference.sum()) / 3
            most[k] = max(most[k], float(difference.max(initial=0)))
        atlas.release()
    mean = sums / max(num, 1)
    errors = (float(mean[0]), float(most[0]), float(mean[1]), float(most[1]))
    error = ConversionError(*errors, atlas.size // shrink)
    return [encode_png(np.concatenate(band)) for band in bands], error


def _averaged(band: NDArray, shrink: int) -> NDArray[np.float32]:
    """Means of squares of texels, float32."""
    values = np.asarray(band, np.float32)
    if shrink == 1:
        return values
    height, width, channels = values.shape
    return values.reshape(height // shrink, shrink, width // shrink, shrink, channels).mean(axis=(1, 3))


def _material(name: str, textures: list[int]) -> dict[str, Any]:
    base, packed, tint = ({"index": index} for index in textures)
    factor = MAX_DIELECTRIC_F0 / DIELECTRIC_F0
    return {
        "name": name,
        "doubleSided": True,
        "pbrMetallicRoughness": {"baseColorTexture": base, "metallicRoughnessTexture": packed},
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
    """Collects binary data and the tables that describe it."""

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
        """An accessor of vertex data (float32) or, for ``SCALAR``, of indices (uint32)."""
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
        """Attributes and indices of a primitive."""
        assert mesh.normals is not None and mesh.uv is not None
        turn = Z_UP_FROM_Y_UP[:3, :3]  # rows times this is the inverse rotation: Y up from Z up
        attributes = {
            "POSITION": self.array(mesh.positions @ turn, "VEC3", has_bounds=True),
            "NORMAL": self.array(_unit(mesh.normals @ turn), "VEC3"),
        }
        if has_uv:
            attributes["TEXCOORD_0"] = self.array(mesh.uv * [1, -1] + [0, 1], "VEC2")
        return {"attributes": attributes, "indices": self.array(mesh.faces.reshape(-1, 1), "SCALAR")}

    def image(self, png: bytes) -> int:
        """An image; its index is its texture's."""
        self.images.append({"bufferView": self._view(png), "mimeType": "image/png"})
        return len(self.images) - 1

    def tables(self) -> dict[str, Any]:
        """The JSON tables of what was collected."""
        return {
            "images": self.images,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data) + -len(self.data) % 4}],
        }

    def encode(self, document: dict[str, Any]) -> bytes:
        """The GLB file."""
        text = json.dumps(document, sort_keys=True, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.data) + bytes(-len(self.data) % 4)
        head = [len(text).to_bytes(4, "little"), b"JSON", text, len(binary).to_bytes(4, "little"), b"BIN\0"]
        body = b"".join(head) + binary
        return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body

# SPDX-License-Identifier: MIT
"""Writes a reconstruction as GLB: metallic-roughness with KHR_materials_specular (``metallic_textures``).

Lights are emissive surfaces (KHR_materials_emissive_strength), and optionally also point lights for small
lamps and a directional light for the sun (KHR_lights_punctual). Emissive surfaces illuminate the scene in
path tracers, but not in rasterising viewers. In path tracers, a lamp that is also a point light would
illuminate the scene twice.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from datagen.formats.base import write_bytes_atomically
from datagen.foundation.axes import Z_UP_FROM_Y_UP
from datagen.foundation.meshes.glb import GlbWriter
from datagen.foundation.meshes.mesh import Mesh, unit_vectors
from model.reconstruction.export.metallic_textures import DIELECTRIC_F0, MAX_DIELECTRIC_F0, ConversionError
from model.reconstruction.export.slots import Reconstruction, export_slots, patch_meshes
from model.reconstruction.found_lights import SUN, Color

PUNCTUAL, STRENGTH = "KHR_lights_punctual", "KHR_materials_emissive_strength"
SMALL_M = 0.5
"""Maximum side, in metres, of the bounding box of a lamp that is exported as a point light."""
LUMENS_PER_WATT = 683.0
"""Candela per W/sr in each channel, as Blender and other programs convert intensities."""


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


def emissive(material: dict[str, Any], radiance: Color) -> dict[str, Any]:
    """Add emission of ``radiance`` to a glTF material, as a colour factor of at most 1 and a strength."""
    peak = max(radiance)
    if peak <= 0:
        return material
    extensions = {**material.get("extensions", {}), STRENGTH: {"emissiveStrength": peak}}
    return {**material, "emissiveFactor": [c / peak for c in radiance], "extensions": extensions}


def punctual_lights(reconstruction: Reconstruction) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return glTF point lights for small lamps and a directional light for the sun, and their nodes.

    A convex lamp of area A and radiance L has a mean intensity of L A / 4: its mean projected area is A / 4.
    """
    lights: list[dict[str, Any]] = []
    nodes: list[dict[str, Any]] = []
    for name, slot in export_slots(reconstruction).items():
        if slot.emission is None or max(slot.emission) <= 0:
            continue
        positions, area = slot.mesh.positions.astype(np.float64), slot.mesh.areas()
        if float(np.ptp(positions, axis=0).max()) > SMALL_M or area.sum() <= 0:
            continue
        middle = (slot.mesh.triangles().mean(axis=1) * area[:, None]).sum(axis=0) / area.sum()
        peak = max(slot.emission)
        light = {
            "type": "point",
            "name": name,
            "color": [c / peak for c in slot.emission],
            "intensity": LUMENS_PER_WATT * peak * float(area.sum()) / 4,
        }
        place = [float(v) for v in middle @ Z_UP_FROM_Y_UP[:3, :3]]
        nodes.append({"name": name, "translation": place, "extensions": {PUNCTUAL: {"light": len(lights)}}})
        lights.append(light)
    found = reconstruction.shining_lights
    if found is not None and found.sun is not None and max(found.sun.irradiance) > 0:
        peak = max(found.sun.irradiance)
        color = [c / peak for c in found.sun.irradiance]
        link = {PUNCTUAL: {"light": len(lights)}}
        nodes.append({"name": SUN, "rotation": _rotation(found.sun.direction), "extensions": link})
        lights.append(
            {"type": "directional", "name": SUN, "color": color, "intensity": LUMENS_PER_WATT * peak}
        )
    return lights, nodes


def _rotation(direction: Color) -> list[float]:
    """Compute the quaternion (x, y, z, w) that turns +Z to ``direction``; glTF lights emit along -Z."""
    towards = np.array(direction) @ Z_UP_FROM_Y_UP[:3, :3]
    half = np.array([0.0, 0.0, 1.0]) + towards
    if np.linalg.norm(half) < 1e-6:
        return [1.0, 0.0, 0.0, 0.0]
    half /= np.linalg.norm(half)
    axis = np.cross([0.0, 0.0, 1.0], half)
    return [float(v) for v in (*axis, half[2])]


class _Glb(GlbWriter):
    def mesh(self, mesh: Mesh, *, has_uv: bool) -> dict[str, Any]:
        """Add a mesh; return the JSON attributes and indices of its primitive."""
        assert mesh.normals is not None and mesh.uv is not None
        turn = Z_UP_FROM_Y_UP[:3, :3]  # multiplication from the right applies the inverse, Y up from Z up
        attributes = {
            "POSITION": self.array(mesh.positions @ turn, "VEC3", has_bounds=True),
            "NORMAL": self.array(unit_vectors(mesh.normals @ turn, [0.0, 1.0, 0.0]), "VEC3"),
        }
        if has_uv:
            attributes["TEXCOORD_0"] = self.array(mesh.uv * [1, -1] + [0, 1], "VEC2")
        return {"attributes": attributes, "indices": self.array(mesh.faces.reshape(-1, 1), "SCALAR")}

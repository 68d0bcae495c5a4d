# SPDX-License-Identifier: MIT
"""Converts lights to glTF: emissive surfaces (KHR_materials_emissive_strength), and small lamps also to point
lights and the sun to a directional light (KHR_lights_punctual).

Emissive surfaces illuminate the scene in path tracers, but not in rasterising viewers. Path tracers would
count the light of a lamp twice if it were also a point light, so point lights are optional.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from datagen.foundation.axes import Z_UP_FROM_Y_UP
from model.reconstruction.export.slots import Reconstruction, export_slots
from model.reconstruction.found_lights import SUN, Color

PUNCTUAL, STRENGTH = "KHR_lights_punctual", "KHR_materials_emissive_strength"
SMALL_M = 0.5
"""Maximum side, in metres, of the bounding box of a lamp that is exported as a point light."""
LUMENS_A_WATT = 683.0
"""Candela per W/sr in each channel, as Blender and other programs convert intensities."""


def emissive(material: dict[str, Any], radiance: Color) -> dict[str, Any]:
    """Add emission of ``radiance`` to a glTF material, as a colour factor of at most 1 and a strength."""
    peak = max(radiance)
    if peak <= 0:
        return material
    extensions = {**material.get("extensions", {}), STRENGTH: {"emissiveStrength": peak}}
    return {**material, "emissiveFactor": [c / peak for c in radiance], "extensions": extensions}


def punctual_lights(reconstruction: Reconstruction) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return glTF point lights for small lamps and a directional light for the sun, and their nodes.

    A convex lamp of area A and radiance L has a mean intensity of L A / 4, since its mean projected area is A
    / 4.
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
            "intensity": LUMENS_A_WATT * peak * float(area.sum()) / 4,
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
        lights.append({"type": "directional", "name": SUN, "color": color, "intensity": LUMENS_A_WATT * peak})
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

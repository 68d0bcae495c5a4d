# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts Blender's lights to dictionaries of the asset format, in radiometric units.

With power P = energy * colour * 2^exposure, a spot or a point of radius 0 has the radiant intensity I = P /
(4 pi), a sphere of radius r the radiance L = P / (4 pi^2 r^2), an area light of area A the radiance L = P /
(pi A) along -Z, and a sun the irradiance E = P. Without Normalize, L = P / pi for spheres and area lights.
Conversion to metres leaves radiance unchanged and multiplies intensity by (metres per unit)^2.
"""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..bake.closures import ClosureWalk
from ..bake.expression import Constant
from ..problems import APPROXIMATION, ERROR, NOTE, ProblemList

Light = dict[str, Any]


def gather_light(
    thing: bpy.types.Object, matrix: NDArray[np.float64], metres_per_unit: float, problems: ProblemList
) -> Light | None:
    """Convert a light object at ``matrix`` (4, 4) world_from_object; None if it is black or refused."""
    data = thing.data
    power = _power(data, thing.name, problems)
    if power is None or not power.any():
        return None
    frame = matrix.copy()
    frame[:3, 3] *= metres_per_unit
    if data.type == "POINT":
        return _point(thing, power, frame, metres_per_unit, problems)
    if data.type == "SPOT":
        return _spot(thing, power, frame, metres_per_unit, problems)
    if data.type == "SUN":
        return _sun(thing, power, frame)
    return _area(thing, power, frame, metres_per_unit, problems)


def _power(data: bpy.types.Light, name: str, problems: ProblemList) -> NDArray[np.float64] | None:
    colour = np.array(data.color, dtype=np.float64)
    if getattr(data, "use_temperature", False):
        colour = colour * np.array(data.temperature_color)[:3]
    power = data.energy * 2.0 ** getattr(data, "exposure", 0.0) * colour
    if data.use_nodes and data.node_tree is not None:
        found = ProblemList()
        emission = ClosureWalk(name, found, "mask").walk(data.node_tree).emission
        if not isinstance(emission, Constant) or found.errors:
            problems.add(
                ERROR, "the light's nodes vary (texture or IES); only a constant is exported",
                "unlink them or use an area light without nodes", object=name,
            )  # fmt: skip
            return None
        power = power * np.array(emission.value * (3 if emission.width == 1 else 1))
    if (power < 0).any():
        problems.add(ERROR, "emits negative light", "use a positive energy and colour", object=name)
        return None
    return power


def _direction(frame: NDArray[np.float64]) -> list[float]:
    axis = -frame[:3, 2]
    return (axis / np.linalg.norm(axis)).tolist()


def _point(
    thing: bpy.types.Object, power: NDArray, frame: NDArray, metres: float, problems: ProblemList
) -> Light:
    radius = thing.data.shadow_soft_size
    base = {"name": thing.name, "position_m": frame[:3, 3].tolist()}
    if radius <= 0:
        factor = metres**2 / (4 * math.pi)
        return {**base, "type": "point", "intensity": (power * factor).tolist()}
    if not thing.visible_camera:
        problems.add(NOTE, "the light's sphere is visible to the camera after the export", object=thing.name)
    if getattr(thing.data, "use_soft_falloff", False):
        message = (
            "Soft Falloff makes the light a disc that faces each point; the exported sphere is brighter by "
            f"(radius / distance)^2, {(radius / 2) ** 2:.2%} at a distance of 2 units"
        )
        problems.add(APPROXIMATION, message, "turn Soft Falloff off", object=thing.name)
    is_normalized = getattr(thing.data, "normalize", True)
    radiance = power / (4 * math.pi**2 * radius**2) if is_normalized else power / math.pi
    return {**base, "type": "sphere", "radius_m": radius * metres, "radiance": radiance.tolist()}


def spot_profile(cosine: NDArray, half_angle: float, blend: float) -> NDArray:
    """Cycles' spot fall-off: smoothstep of (cosine - cos(half_angle)) / ((1 - cos(half_angle)) blend)."""
    edge = math.cos(half_angle)
    if blend <= 0:
        return (cosine >= edge).astype(float)
    t = np.clip((cosine - edge) / ((1 - edge) * blend), 0, 1)
    return t * t * (3 - 2 * t)


def fitted_beam_width(half_angle: float, blend: float) -> float:
    """Start angle [rad] of the linear fall-off to 0 at ``half_angle`` that has the flux of the spot."""
    angle = (np.arange(4096) + 0.5) / 4096 * half_angle
    weight = np.sin(angle)
    wanted = float((spot_profile(np.cos(angle), half_angle, blend) * weight).sum())
    low, high = 0.0, half_angle * (1 - 1e-6)
    for _ in range(60):
        middle = (low + high) / 2
        falloff = np.clip((half_angle - angle) / (half_angle - middle), 0, 1)
        low, high = (middle, high) if float((falloff * weight).sum()) < wanted else (low, middle)
    return (low + high) / 2


def _spot(
    thing: bpy.types.Object, power: NDArray, frame: NDArray, metres: float, problems: ProblemList
) -> Light:
    data = thing.data
    half = min(data.spot_size / 2, math.radians(89.9))
    if data.spot_blend > 0:
        problems.add(
            APPROXIMATION,
            "the spot's soft edge becomes a linear one of the same flux; the intensity on its axis is exact",
            object=thing.name,
        )
    if data.shadow_soft_size > 0:
        problems.add(
            APPROXIMATION, "the spot's radius is left out: its shadows are sharp", "set Radius to 0",
            object=thing.name,
        )  # fmt: skip
    scale = np.linalg.norm(frame[:3, :3], axis=0)
    if scale.max() / scale.min() > 1.001:
        problems.add(
            APPROXIMATION, "the spot's unequal scale is left out: its cone is round", object=thing.name
        )
    return {
        "type": "spot",
        "name": thing.name,
        "position_m": frame[:3, 3].tolist(),
        "direction": _direction(frame),
        "intensity": (power * metres**2 / (4 * math.pi)).tolist(),
        "cutoff_rad": half,
        "beam_width_rad": fitted_beam_width(half, data.spot_blend),
    }


def _sun(thing: bpy.types.Object, power: NDArray, frame: NDArray) -> Light:
    return {
        "type": "directional",
        "name": thing.name,
        "direction": _direction(frame),
        "irradiance": power.tolist(),
        "angular_diameter_rad": min(float(thing.data.angle), 1.0),
    }


def _area(
    thing: bpy.types.Object, power: NDArray, frame: NDArray, metres: float, problems: ProblemList
) -> Light | None:
    data = thing.data
    if data.spread < math.pi - 1e-4:
        message = f"an area light with a spread of {math.degrees(data.spread):.0f} degrees cannot be exported"
        problems.add(ERROR, message, "set Spread to 180 degrees", object=thing.name)
        return None
    size_u = data.size
    size_v = data.size_y if data.shape in ("RECTANGLE", "ELLIPSE") else data.size
    edge_u = frame[:3, 0] * size_u * metres
    edge_v = -frame[:3, 1] * size_v * metres  # so that edge_u x edge_v points along -Z
    is_disk = data.shape in ("DISK", "ELLIPSE")
    area = float(np.linalg.norm(np.cross(edge_u, edge_v))) / metres**2 * (math.pi / 4 if is_disk else 1)
    if area <= 0:
        problems.add(ERROR, "the area light has no area", "give it a size", object=thing.name)
        return None
    radiance = power / (math.pi * area) if getattr(data, "normalize", True) else power / math.pi
    return {
        "type": "area",
        "name": thing.name,
        "origin_m": (frame[:3, 3] - (edge_u + edge_v) / 2).tolist(),
        "edge_u_m": edge_u.tolist(),
        "edge_v_m": edge_v.tolist(),
        "radiance": radiance.tolist(),
        "shape": "disk" if is_disk else "rectangle",
        "is_visible": bool(thing.visible_camera),
    }

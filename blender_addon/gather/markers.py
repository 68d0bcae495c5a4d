# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts marker objects: support surfaces, light slots, openings, camera regions."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..problems import ERROR, ProblemList
from .tags import SUPPORT_KINDS, check_words, positive, role_of

Rectangle = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
_DEFAULT_CLEARANCE_M = 0.5


def _local_box(thing: bpy.types.Object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if thing.type == "EMPTY":
        size = thing.empty_display_size
        return np.full(3, -size), np.full(3, size)
    corners = np.array([tuple(corner) for corner in thing.bound_box])
    return corners.min(axis=0), corners.max(axis=0)


def _matrix(thing: bpy.types.Object, metres_per_unit: float) -> NDArray[np.float64]:
    matrix = np.array(thing.matrix_world, dtype=np.float64)
    matrix[:3] *= metres_per_unit
    return matrix


def rectangle_of(thing: bpy.types.Object, metres_per_unit: float) -> Rectangle:
    """Origin and edges (3,) [m] of a marker's local XY extent, at the top of a mesh, else at z = 0.

    edge_u x edge_v points along the marker's +Z, or, for an area light, along -Z, its direction of emission.
    """
    matrix = _matrix(thing, metres_per_unit)
    if thing.type == "LIGHT" and thing.data.type == "AREA":
        u = thing.data.size
        v = thing.data.size_y if thing.data.shape in ("RECTANGLE", "ELLIPSE") else u
        edge_u, edge_v = matrix[:3, 0] * u, -matrix[:3, 1] * v
        return matrix[:3, 3] - (edge_u + edge_v) / 2, edge_u, edge_v
    low, high = _local_box(thing)
    z = 0.0 if thing.type == "EMPTY" else high[2]
    origin = matrix[:3, :3] @ np.array([low[0], low[1], z]) + matrix[:3, 3]
    return origin, matrix[:3, 0] * (high[0] - low[0]), matrix[:3, 1] * (high[1] - low[1])


def gather_markers(
    things: list[bpy.types.Object], metres_per_unit: float, problems: ProblemList
) -> dict[str, list[dict[str, Any]]]:
    """Convert the markers among ``things`` to lists of entries, by their keys in ``asset.json``."""
    keys = ("support_surfaces", "light_slots", "openings", "camera_regions")
    found: dict[str, list[dict[str, Any]]] = {key: [] for key in keys}
    for thing in sorted(things, key=lambda t: t.name):
        role = role_of(thing)
        if role == "camera_region":
            low, high = _local_box(thing)
            corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1])
                                for z in (low[2], high[2])])  # fmt: skip
            matrix = _matrix(thing, metres_per_unit)
            world = corners @ matrix[:3, :3].T + matrix[:3, 3]
            if (np.ptp(world, axis=0) <= 0).any():
                problems.add(
                    ERROR, "a camera region needs a volume", "use a box or an empty", object=thing.name
                )
                continue
            box = {"minimum_m": world.min(axis=0).tolist(), "maximum_m": world.max(axis=0).tolist()}
            found["camera_regions"].append(box)
        elif role == "light_slot" and thing.type == "LIGHT" and thing.data.type != "AREA":
            position = _matrix(thing, metres_per_unit)[:3, 3]
            found["light_slots"].append({"name": thing.name, "kind": "point", "origin_m": position.tolist()})
        elif role in ("support_surface", "light_slot", "opening"):
            _add_rectangle(found, thing, role, metres_per_unit, problems)
    return found


def _add_rectangle(
    found: dict[str, list[dict[str, Any]]],
    thing: bpy.types.Object,
    role: str,
    metres_per_unit: float,
    problems: ProblemList,
) -> None:
    origin, edge_u, edge_v = rectangle_of(thing, metres_per_unit)
    normal = np.cross(edge_u, edge_v)
    if np.linalg.norm(normal) <= 0:
        problems.add(ERROR, f"a {role} needs an area", "use a plane or an empty", object=thing.name)
        return
    entry: dict[str, Any] = {
        "name": thing.name,
        "origin_m": origin.tolist(),
        "edge_u_m": edge_u.tolist(),
        "edge_v_m": edge_v.tolist(),
    }
    if role == "light_slot":
        kind = str(thing.get("sm_kind", "area"))
        if kind == "point":
            entry = {
                "name": thing.name, "kind": "point", "origin_m": (origin + (edge_u + edge_v) / 2).tolist()
            }  # fmt: skip
        found["light_slots"].append({**entry, "kind": kind})
    elif role == "opening":
        found["openings"].append(entry)
    else:
        kind = str(thing.get("sm_kind", "table"))
        check_words((kind,), SUPPORT_KINDS, "sm_kind", problems, object=thing.name)
        if normal[2] < 0.999 * np.linalg.norm(normal):
            message = "a support surface must be horizontal and face up"
            problems.add(ERROR, message, "rotate it", object=thing.name)
        clearance = positive(thing, "sm_clearance_m", problems, object=thing.name) or _DEFAULT_CLEARANCE_M
        found["support_surfaces"].append({**entry, "kind": kind, "clearance_m": clearance})

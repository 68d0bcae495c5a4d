# SPDX-License-Identifier: MIT
"""Detection of zero directions and rectangles without area in lights, light slots, openings and supports."""

from __future__ import annotations

from itertools import product

import numpy as np

from datagen.formats.asset import EnvironmentAsset, GeometryAsset, LightSlot, Opening, SupportSurface
from datagen.formats.base import Vector3
from datagen.formats.lights import AreaLight
from datagen.foundation.errors import Problems

_REMEDY = "re-export the asset"


def degenerate_problems(asset: GeometryAsset, where: str) -> Problems:
    """List the degenerate rectangles and directions of an asset; ``where`` names its ``asset.json``."""
    lights, problems = list(enumerate(asset.lights)), Problems(where)
    rectangles: list[tuple[str, AreaLight | LightSlot | Opening | SupportSurface]] = []
    rectangles += [(f"lights[{k}]", light) for k, light in lights if isinstance(light, AreaLight)]
    if isinstance(asset, EnvironmentAsset):
        rectangles += [(f"support_surfaces[{k}]", one) for k, one in enumerate(asset.support_surfaces)]
        rectangles += [(f"light_slots[{k}]", s) for k, s in enumerate(asset.light_slots) if s.kind == "area"]
        rectangles += [(f"openings[{k}]", opening) for k, opening in enumerate(asset.openings)]
    for field, found in rectangles:
        if not has_area(found.edge_u_m, found.edge_v_m):
            got = f"edges {found.edge_u_m} and {found.edge_v_m}"
            problems.add(f"{field} ({found.name})", got, "a rectangle with an area above zero", _REMEDY)
    for (k, light), name in product(lights, ("direction", "sun_direction")):
        if not any(getattr(light, name, (1.0,))):
            problems.add(f"lights[{k}] ({light.name}).{name}", "0 0 0", "a unit vector", _REMEDY)
    return problems


def has_area(edge_u: Vector3, edge_v: Vector3) -> bool:
    """Return whether the edges (3,), in metres, span more than 1e-10 m² at an angle of more than 1e-6 rad."""
    area = float(np.linalg.norm(np.cross(edge_u, edge_v)))
    return area > 1e-10 and area >= 1e-6 * float(np.linalg.norm(edge_u) * np.linalg.norm(edge_v))

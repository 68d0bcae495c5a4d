# SPDX-License-Identifier: MIT
"""Converts emissive surfaces to lamps for export: one per emissive part of the geometry, and one per other
smooth region that was found to emit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import GeometryPart
from datagen.foundation.meshes.mesh import Mesh
from datagen.light.emitters import Emitters
from model.reconstruction.found_lights import FoundLamp, as_color


def found_lamps(emitters: Emitters, mesh: Mesh, parts: Sequence[GeometryPart]) -> tuple[FoundLamp, ...]:
    """Convert emissive ``parts`` to lamps ``lamp-0``, ..., and other emitting regions to ``found-0``, ...

    A part's radiance is the area-weighted mean over its triangles that emit from their front.
    """
    areas = mesh.areas()
    shown = np.zeros((len(mesh.faces), 3))
    lit = emitters.of_face >= 0
    shown[lit] = emitters.radiance[emitters.of_face[lit]]
    lamps: list[FoundLamp] = []
    free = lit.copy()
    for part in parts:
        faces = np.arange(part.first_face, part.first_face + part.num_faces, dtype=np.int32)
        if part.emission is None:
            continue
        free[faces] = False
        weight = areas[faces] * ((emitters.side_of_face[faces] > 0) & shown[faces].any(axis=1))
        radiance = weight @ shown[faces] / max(float(weight.sum()), 1e-30)
        lamps.append(_lamp(f"lamp-{len(lamps)}", faces, 1, radiance, mesh, is_named=True))
    regions = np.unique(emitters.of_face[free])
    shining = [region for region in regions if emitters.radiance[region].any()]
    for number, region in enumerate(shining):
        faces = np.flatnonzero(free & (emitters.of_face == region)).astype(np.int32)
        side = -1 if areas[faces] @ emitters.side_of_face[faces] < 0 else 1
        radiance = emitters.radiance[region].astype(np.float64)
        lamps.append(_lamp(f"found-{number}", faces, side, radiance, mesh, is_named=False))
    return tuple(lamps)


def _lamp(
    slot: str, faces: NDArray, side: int, radiance: NDArray, mesh: Mesh, *, is_named: bool
) -> FoundLamp:
    area = mesh.areas()[faces]
    total = float(area.sum())
    middle = mesh.triangles()[faces].mean(axis=1)
    place = (middle * area[:, None]).sum(axis=0) / max(total, 1e-30)
    return FoundLamp(slot, faces, side, as_color(radiance), as_color(place), total, is_named)

# SPDX-License-Identifier: MIT
"""Kinds of surface in evaluated views, such as metal, white walls and small objects.

By its true maps, a surface is ``metal`` (mean S > 0.2) or otherwise ``glossy`` (R < 0.4) or ``matt`` (R >=
0.4); if not metal, it may also be ``white`` (D > 0.7 in every channel). By the true mesh, it may be ``small``
(a connected piece less than 0.3 m across) or ``sunlit`` (lit directly by the sun); it is ``seldom seen`` if
visible in fewer than 4 views. Kinds overlap. A ``region`` is a part of the scene's geometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.assembly.geometry import RayScene
from datagen.formats.capture import CaptureGeometry, CaptureView
from datagen.formats.lights import DirectionalLight, Light, SkyLight
from datagen.foundation.meshes.mesh import Mesh
from model.evaluation.rendering import JudgedView
from model.reconstruction.unwrap.charts import connected_pieces

KINDS = ("metal", "white", "glossy", "matt", "small", "seldom seen", "sunlit")
METAL_S, WHITE_D, GLOSSY_R = 0.2, 0.7, 0.4
SMALL_M, FEW_VIEWS = 0.3, 4
_LIFT_M = 1e-3  # offset of a shadow ray from its surface, to avoid self-shadowing


@dataclass(frozen=True)
class ViewSurfaces:
    """Kinds of surface in a view, as masks (H, W) by name, and region indices (H, W), -1 for none."""

    kinds: dict[str, NDArray[np.bool_]]
    region: NDArray[np.int32]


def kinds_of_maps(truth: JudgedView) -> dict[str, NDArray[np.bool_]]:
    """Masks (H, W) by name of the kinds that depend on the true maps: metal, white, glossy and matt."""
    surface = truth.surface_mask
    metal = surface & (truth.maps["specular_albedo"].mean(axis=2) > METAL_S)
    rest = surface & ~metal
    rough = truth.maps["roughness"][..., 0]
    return {
        "metal": metal,
        "white": rest & (truth.maps["diffuse_albedo"].min(axis=2) > WHITE_D),
        "glossy": rest & (rough < GLOSSY_R),
        "matt": rest & (rough >= GLOSSY_R),
    }


class SurfaceFinder:
    """Classifier of the surfaces in a scene's views, by rays through their pixels."""

    def __init__(self, geometry: CaptureGeometry, lights: Sequence[Light]):
        self._rays = RayScene(geometry.mesh.positions.astype(np.float64), geometry.mesh.faces)
        starts = np.array([part.first_face for part in geometry.parts])
        self._part = np.searchsorted(starts, np.arange(len(geometry.mesh.faces)), side="right") - 1
        self._is_small = small_faces(geometry.mesh)
        self._suns = [sun for light in lights if (sun := _towards_sun(light)) is not None]

    def find(self, view: CaptureView, truth: JudgedView) -> ViewSurfaces:
        """Find the kinds and regions of surface in a view, whose true maps are ``truth``."""
        directions = view.camera.ray_directions()
        hits = self._rays.cast(view.camera.position_m, directions.reshape(-1, 3))
        shape = truth.surface_mask.shape
        face = hits.face.reshape(shape)
        hit = truth.surface_mask & (face >= 0)
        kinds = kinds_of_maps(truth)
        kinds["small"] = hit & self._is_small[face]
        count = view.source.read_maps(("observation_count",)).get("observation_count")
        if count is not None:
            kinds["seldom seen"] = truth.surface_mask & (count[..., 0] < FEW_VIEWS)
        if self._suns:
            position = view.camera.position_m + hits.distance_m.reshape(shape)[..., None] * directions
            kinds["sunlit"] = self._sunlit(position, face, directions, hit)
        region = np.where(hit, self._part[face], -1).astype(np.int32)
        return ViewSurfaces(kinds, region)

    def _sunlit(
        self, position: NDArray, face: NDArray, directions: NDArray, hit: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Mask (H, W) of the pixels whose surface at ``position`` (H, W, 3) is lit directly by a sun."""
        lit = np.zeros(hit.shape, bool)
        normal = self._rays.normals[face[hit]]
        is_back = np.einsum("ij,ij->i", normal, directions[hit]) > 0
        normal = np.where(is_back[:, None], -normal, normal)
        for sun in self._suns:
            towards = np.broadcast_to(sun, normal.shape)
            origins = position[hit] + _LIFT_M * normal
            free = ~self._rays.occluded(origins, towards, np.inf)
            lit[hit] |= free & (normal @ sun > 0)
        return lit


def small_faces(mesh: Mesh) -> NDArray[np.bool_]:
    """Mask (M,) of the triangles in connected pieces whose bounding box's diagonal is below ``SMALL_M``."""
    piece = connected_pieces(mesh)
    low, high = np.full((int(piece.max()) + 1, 3), np.inf), np.full((int(piece.max()) + 1, 3), -np.inf)
    corners = mesh.triangles()
    np.minimum.at(low, piece, corners.min(axis=1))
    np.maximum.at(high, piece, corners.max(axis=1))
    small = np.linalg.norm(high - low, axis=1) < SMALL_M
    return np.asarray(small[piece])


def _towards_sun(light: Light) -> NDArray[np.float64] | None:
    """Unit vector (3,) towards the sun of a light; None for lights without a sun."""
    if isinstance(light, DirectionalLight):
        direction = -np.array(light.direction)
    elif isinstance(light, SkyLight) and light.sun_scale > 0:
        direction = np.array(light.sun_direction)
    else:
        return None
    return np.asarray(direction / np.linalg.norm(direction))

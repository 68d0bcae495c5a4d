# SPDX-License-Identifier: MIT
"""Measures how well the views of a configuration cover its scene, from camera rays at low resolution.

Shapes: P points of all views, M triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from datagen.assembly.geometry import Floats, Hits, RayScene, WorldScene
from datagen.assembly.materials import MeanMaterial
from datagen.formats.asset import Surface
from datagen.formats.configuration import GLOSSY_ROUGHNESS, METAL_SPECULAR, ViewCoverage
from datagen.foundation.cameras import Camera

PREVIEW_WIDTH_PX = 64
MIN_SHELL_PIXELS = 0.03  # minimum share of the image for a wall or ceiling to count as visible
_WALLS: tuple[Surface, ...] = ("wall", "tiles")
_POINTS = 400  # approximate number of surface points sampled per view
_DEPTH_SLACK = 2e-3  # visibility rays are shortened by this share, so that points do not occlude themselves
_QUADRANTS = 4


def preview_of(camera: Camera) -> Camera:
    """Return the camera at a low resolution, of at most :data:`PREVIEW_WIDTH_PX` columns."""
    width = min(PREVIEW_WIDTH_PX, camera.width_px)
    return camera.scaled(width, max(8, round(width * camera.height_px / camera.width_px)))


@dataclass(frozen=True)
class Shell:
    """Walls and ceiling of a scene's room; ``surfaces`` maps each slot of the room to its kind of surface."""

    scene: WorldScene
    surfaces: dict[str, Surface]

    @cached_property
    def _label_of_face(self) -> NDArray[np.int64]:
        """Label (M,) of triangles: 1 for the ceiling, 2 to 5 for walls by quadrant of the normal, else 0."""
        scene = self.scene
        parts = scene.geometries[0].asset.parts
        kinds = np.array([self.surfaces.get(part.material, "small") for part in parts])
        in_room = scene.item_of_face == 0
        kind = np.where(in_room, kinds[np.where(in_room, scene.part_of_face, 0)], "")
        normals = scene.rays.normals
        quarter = np.round(np.arctan2(normals[:, 1], normals[:, 0]) / (0.5 * np.pi)).astype(int) % _QUADRANTS
        is_wall = np.isin(kind, _WALLS) & (np.abs(normals[:, 2]) < 0.5)
        return np.where(kind == "ceiling", 1, np.where(is_wall, 2 + quarter, 0))

    def is_room(self, faces: NDArray[np.int64], num_pixels: int) -> bool:
        """Return whether an image shows two walls of different directions, or a wall and the ceiling.

        ``faces`` are the indices of the triangles that the rays of its ``num_pixels`` pixels hit.
        """
        pixels = np.bincount(self._label_of_face[faces], minlength=2 + _QUADRANTS)[1:]
        seen = pixels >= MIN_SHELL_PIXELS * num_pixels
        return bool(seen[1:].any() and seen.sum() >= 2)


def visible_mask(camera: Camera, points: Floats, rays: RayScene) -> NDArray[np.bool_]:
    """Mask (P,) of the surface points (P, 3) that project into the camera's image and are not occluded."""
    pixels, depth = camera.project(points)
    limits = [camera.width_px, camera.height_px]
    with np.errstate(invalid="ignore"):
        seen = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels <= limits).all(axis=1)
    towards = points[seen] - camera.position_m
    distance = np.linalg.norm(towards, axis=1)
    reach = distance * (1 - _DEPTH_SLACK)
    seen[seen] = ~rays.occluded(camera.position_m, towards / distance[:, None], reach)
    return seen


def measure(
    scene: WorldScene, shell: Shell, assigned: tuple[dict[str, MeanMaterial], ...], cameras: list[Camera]
) -> ViewCoverage:
    """Measure the coverage of a scene by ``cameras``; ``assigned``: mean material by slot for each asset."""
    previews = [preview_of(camera) for camera in cameras]
    hits: list[Hits] = []
    points: list[Floats] = []
    rooms = 0
    for preview in previews:
        directions = preview.ray_directions().reshape(-1, 3)
        found = scene.rays.cast(preview.position_m, directions)
        seen = np.flatnonzero(found.hit_mask)
        rooms += shell.is_room(found.face[seen], len(directions))
        seen = seen[:: max(1, len(seen) // _POINTS)]
        points.append(preview.position_m + found.distance_m[seen, None] * directions[seen])
        hits.append(found)
    everywhere = np.concatenate(points)
    counts = np.sum([visible_mask(preview, everywhere, scene.rays) for preview in previews], axis=0)
    faces = np.concatenate([found.face[found.hit_mask] for found in hits])
    tables = [
        np.array([(max(w[p.material].specular_albedo), w[p.material].roughness) for p in g.asset.parts])
        for g, w in zip(scene.geometries, assigned, strict=True)
    ]
    specular, rough = scene.rows_of_faces(tables)[faces].T
    num_points, num_hits = max(len(counts), 1), max(len(faces), 1)
    return ViewCoverage(
        median_observations=float(np.median(counts)) if len(counts) else 0.0,
        thin_share=round(int((counts <= 2).sum()) / num_points, 4),
        room_share=round(rooms / max(len(cameras), 1), 4),
        metal_share=round(int((specular > METAL_SPECULAR).sum()) / num_hits, 4),
        gloss_share=round(int((rough < GLOSSY_ROUGHNESS).sum()) / num_hits, 4),
    )

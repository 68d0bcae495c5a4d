# SPDX-License-Identifier: MIT
"""Approximates the lights of an asset by at most ``MAX_SOURCES`` points, which the page switches on and off.

A source of radiance L, area A and vector area V (the sum of its triangles' areas times their normals) has the
intensity L (max(V.w, 0) + (A - |V|) / 4) in direction w, which is exact for a rectangle, and for a closed
convex surface on average over directions. It is at the centroid of the area. While there are too many
sources, the two nearest are merged, which preserves the sum of A L. Environments, spotlights and directional
lights are omitted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import EnvironmentAsset, ObjectAsset
from datagen.formats.lights import AreaLight, Light, PointLight, SphereLight
from datagen.foundation.meshes.mesh import Mesh, area_vectors

MAX_SOURCES = 8
"""Maximum number of sources; must equal the value in ``page/shadows.js``."""
_POINT_RADIUS_M = 0.01  # radius of the sphere of equal intensity that replaces a point light


@dataclass(frozen=True)
class Source:
    """A light source at a point, with vector area V, area A and radiance L by channel."""

    position_m: NDArray[np.float64]
    vector_m2: NDArray[np.float64]
    area_m2: float
    radiance: NDArray[np.float64]

    @property
    def rest_m2(self) -> float:
        """Direction-independent part (A - |V|) / 4 of the projected area, in m^2."""
        return max(self.area_m2 - float(np.linalg.norm(self.vector_m2)), 0.0) / 4

    def merged(self, other: Source) -> Source:
        """Merge two sources into one with the sums of A, V and A L, at the mean position weighted by A L."""
        powers = [float(s.area_m2 * s.radiance.mean()) for s in (self, other)]
        area = self.area_m2 + other.area_m2
        flux = self.area_m2 * self.radiance + other.area_m2 * other.radiance
        middle = np.average([self.position_m, other.position_m], axis=0, weights=powers)
        return Source(middle, self.vector_m2 + other.vector_m2, area, flux / area)

    def described(self) -> dict[str, Any]:
        """Convert the source to JSON data for the page."""
        return {
            "position": self.position_m.tolist(),
            "vector": self.vector_m2.tolist(),
            "rest": self.rest_m2,
            "radiance": self.radiance.tolist(),
        }


def page_sources(
    asset: EnvironmentAsset | ObjectAsset, slots: Mapping[str, Mesh]
) -> tuple[list[Source], int, list[str]]:
    """Return the sources of the asset's lights and emissive materials, the number of lights before merging,
    and notes on omitted lights; ``slots`` are the meshes by material.
    """
    sources, notes = [], []
    for light in asset.lights:
        source = _of_light(light)
        if source is None:
            notes.append(f"{light.name}: this light ({light.type}) is not shown")
        elif source.radiance.max() > 0:
            sources.append(source)
    for slot, mesh in slots.items():
        emission = asset.materials[slot].emission
        if emission is not None and max(emission) > 0:
            source = _of_mesh(mesh, np.array(emission))
            sources += [source] if source.area_m2 > 0 else []
    num_lights = len(sources)
    while len(sources) > MAX_SOURCES:
        positions = np.array([source.position_m for source in sources])
        distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
        np.fill_diagonal(distances, np.inf)
        i, j = np.unravel_index(int(distances.argmin()), distances.shape)
        both = sources[i].merged(sources[j])
        sources = [source for k, source in enumerate(sources) if k not in (i, j)] + [both]
    return sources, num_lights, notes


def _of_light(light: Light) -> Source | None:
    none = np.zeros(3)
    if isinstance(light, PointLight):
        projected = math.pi * _POINT_RADIUS_M**2
        return Source(np.array(light.position_m), none, 4 * projected, np.array(light.intensity) / projected)
    if isinstance(light, SphereLight):
        area = 4 * math.pi * light.radius_m**2
        return Source(np.array(light.position_m), none, area, np.array(light.radiance))
    if isinstance(light, AreaLight):
        u, v = np.array(light.edge_u_m), np.array(light.edge_v_m)
        vector = np.cross(u, v) * (math.pi / 4 if light.shape == "disk" else 1.0)
        area = float(np.linalg.norm(vector))
        return Source(np.array(light.origin_m) + (u + v) / 2, vector, area, np.array(light.radiance))
    return None


def _of_mesh(mesh: Mesh, radiance: NDArray[np.float64]) -> Source:
    corners = mesh.triangles()
    vectors = 0.5 * area_vectors(corners)
    areas = np.linalg.norm(vectors, axis=1)
    total = float(areas.sum())
    middles = corners.mean(axis=1)
    middle = middles.mean(axis=0) if total == 0 else np.average(middles, axis=0, weights=areas)
    return Source(middle, vectors.sum(axis=0), total, radiance)

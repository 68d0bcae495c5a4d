# SPDX-License-Identifier: MIT
"""Slots of a mesh for export (the surface with the atlas, and lamps), and meshes of other lights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import Capture
from datagen.formats.lights import AreaLight, DirectionalLight, EnvironmentLight, Light
from datagen.foundation.exr import encode_view
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.crease_normals import with_normals
from model.reconstruction.atlas.atlas import Atlas
from model.reconstruction.export.metallic_textures import MetallicTextures, metallic_textures
from model.reconstruction.found_lights import (
    ENVIRONMENT_FILE,
    SKY,
    SUN,
    Color,
    FoundLights,
    FoundPatch,
    as_color,
)

SURFACE = "surface"
WORLD_FROM_SKY = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Transform (4, 4) to the world (Z up, the sky's centre column along +Y) from the frame of skies in Mitsuba
and USD (Y up, centre column along +Z)."""


@dataclass(frozen=True)
class Reconstruction:
    """Input of the exports.

    ``mesh`` is unwrapped, with faces in the order of the capture; ``atlas`` is filled; ``images`` is the
    folder written by ``write_atlas_images``; ``lights`` is None if not requested.
    """

    capture: Capture
    mesh: Mesh
    atlas: Atlas
    images: Path
    lights: FoundLights | None = None

    @cached_property
    def metallic(self) -> MetallicTextures:
        """Metallic-roughness textures of the atlas, for GLB and USDZ."""
        return metallic_textures(self.atlas)

    @property
    def shining_lights(self) -> FoundLights | None:
        """Recovered lights, which replace the capture's known lights; None if there is none or none emits."""
        return None if self.lights is None or self.lights.is_dark else self.lights

    @property
    def exported_lights(self) -> tuple[Light, ...]:
        """Lights other than emissive surfaces: the recovered lights or, if there are none, the capture's,
        except those with an image in another package, since the export would depend on that package.
        """
        found = self.shining_lights
        if found is None:
            return tuple(light for light in self.capture.lights if getattr(light, "image", None) is None)
        return _as_lights(found)


@dataclass(frozen=True)
class Slot:
    """Triangles with one material, which uses the atlas if ``has_material`` and is black otherwise;
    ``emission`` is a lamp's radiance, else None."""

    mesh: Mesh
    emission: Color | None
    has_material: bool


def _as_lights(found: FoundLights) -> tuple[Light, ...]:
    """Convert rectangles of panels and windows to area lights, the sky to an environment light, and the sun
    to a directional light.
    """
    areas = (
        AreaLight(
            name=f"{patch.slot}-{number}",
            origin_m=rectangle.origin_m,
            edge_u_m=rectangle.edge_u_m,
            edge_v_m=rectangle.edge_v_m,
            radiance=rectangle.radiance,
        )
        for patch in found.emitting_patches
        for number, rectangle in enumerate(patch.rectangles)
    )
    far: list[Light] = []
    if found.environment is not None:
        far.append(EnvironmentLight(name=SKY, image=ENVIRONMENT_FILE))
    if found.sun is not None:
        away = as_color(-np.array(found.sun.direction))
        far.append(
            DirectionalLight(
                name=SUN,
                direction=away,
                irradiance=found.sun.irradiance,
                angular_diameter_rad=found.sun.angular_diameter_rad,
            )
        )
    return (*areas, *far)


def export_slots(reconstruction: Reconstruction) -> dict[str, Slot]:
    """Return slots by name: ``surface``; ``lamp-0``, ... for emissive parts of the geometry, with recovered
    radiance if any light was recovered; and ``found-0``, ... for other surfaces that were found to emit.
    """
    mesh, geometry = with_normals(reconstruction.mesh), reconstruction.capture.geometry
    found = reconstruction.shining_lights
    lamps: dict[str, Slot] = {}
    is_surface = ~geometry.emitter_mask()
    if found is None:
        for part in geometry.parts:
            if part.emission is not None:
                chosen = np.zeros(len(mesh.faces), dtype=bool)
                chosen[part.first_face : part.first_face + part.num_faces] = True
                lamps[f"lamp-{len(lamps)}"] = Slot(mesh.submesh(chosen), part.emission, False)
    else:
        for lamp in found.lamps:
            chosen = np.zeros(len(mesh.faces), dtype=bool)
            chosen[lamp.faces] = True
            is_surface &= ~chosen
            shape = mesh.submesh(chosen)
            lamps[lamp.slot] = Slot(
                flipped(shape) if lamp.side < 0 else shape, lamp.radiance, not lamp.is_named
            )
    slots = {SURFACE: Slot(mesh.submesh(is_surface), None, True)} if is_surface.any() else {}
    return {**slots, **lamps}


def flipped(mesh: Mesh) -> Mesh:
    """Return the mesh with reversed winding and normals."""
    faces = np.ascontiguousarray(mesh.faces[:, [0, 2, 1]])
    return Mesh(mesh.positions, faces, None if mesh.normals is None else -mesh.normals, mesh.uv)


def patch_meshes(patches: Iterable[FoundPatch]) -> dict[str, tuple[Mesh, Color]]:
    """Return the mesh and radiance of each rectangle of windows and panels, by name."""
    meshes = {}
    for patch in patches:
        for number, rectangle in enumerate(patch.rectangles):
            normal = np.cross(rectangle.edge_u_m, rectangle.edge_v_m)
            normals = np.repeat((normal / np.linalg.norm(normal))[None], 4, axis=0).astype(np.float32)
            positions = rectangle.corners().astype(np.float32)
            faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
            quad = Mesh(positions, faces, normals, np.zeros((4, 2), np.float32))
            meshes[f"{patch.slot}-{number}"] = (quad, rectangle.radiance)
    return meshes


def environment_exr(environment: NDArray[np.float32]) -> bytes:
    """Encode a sky image (H, W, 3) as EXR."""
    return encode_view({"beauty": environment})

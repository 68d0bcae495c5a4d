# SPDX-License-Identifier: MIT
"""Joins the meshes of a configuration into a capture's geometry (a world-space mesh, its parts and lamps).

Visible area and sphere lights become parts with emission, like the emissive parts of assets, since they
occlude other surfaces in photographs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from datagen.formats.asset import EnvironmentAsset, Material, MaterialAsset, ObjectAsset
from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.formats.configuration import Configuration, MaterialAssignment, PlacedAsset
from datagen.formats.lights import AreaLight, Light, SphereLight, moved_light
from datagen.formats.package import Package
from datagen.foundation.errors import input_error
from datagen.foundation.meshes.mesh import SINGULAR, Mesh, inspect_mesh, joined, without_degenerate
from datagen.foundation.meshes.ply import decode_ply
from datagen.library import Library
from datagen.rendering.lights import area_light_mesh

_LIGHTS = "lights/"


def light_of_part(name: str) -> str | None:
    """Return the name of the light that the part ``name`` represents; None for parts of assets."""
    return name.removeprefix(_LIGHTS) if name.startswith(_LIGHTS) else None


def configuration_geometry(
    configuration: Configuration, library: Library
) -> tuple[CaptureGeometry, tuple[str, ...]]:
    """Join all placed parts and visible lights into one geometry; also return notes on properties that it
    cannot represent (opacity).

    Raises :class:`InputError` for packages whose hash differs from the configuration's, singular transforms
    and unusable meshes.
    """
    found = []
    for placed in (configuration.environment, *configuration.objects):
        package = library.package(placed.asset)
        expected = configuration.assets.get(placed.asset)
        if package.sha256 != expected:
            remedy = "name the library that the capture was rendered with by --library"
            raise input_error(package.path, "hash", package.sha256, str(expected), remedy)
        found.append(_parts_of(package, placed, library))
    return _geometry([part for parts in found for part in parts] + _lamps(configuration.lights))


def package_geometry(package: Package, placed: PlacedAsset) -> tuple[CaptureGeometry, tuple[str, ...]]:
    """Like :func:`configuration_geometry`, for a placed package with its own materials and lights."""
    asset, matrix = package.asset, placed.world_from_asset
    lights = asset.lights if isinstance(asset, ObjectAsset | EnvironmentAsset) else ()
    moved = [moved_light(light, matrix, package.id) for light in lights]
    return _geometry(_parts_of(package, placed, None) + _lamps(moved))


def has_surface(light: Light) -> TypeGuard[AreaLight | SphereLight]:
    """Return whether a light is a surface visible to cameras, even a black one of radiance 0."""
    return isinstance(light, SphereLight) or (isinstance(light, AreaLight) and light.is_visible)


def is_lamp(light: Light) -> TypeGuard[AreaLight | SphereLight]:
    """Return whether a light is an emitting surface visible to cameras."""
    return has_surface(light) and any(light.radiance)


def lamp_mesh(lamp: AreaLight | SphereLight) -> Mesh:
    """World-space mesh of a lamp; a sphere becomes a polyhedron of equal area."""
    if isinstance(lamp, AreaLight):
        return area_light_mesh(lamp)
    from trimesh.creation import icosphere

    ball = icosphere(subdivisions=3)
    corners = ball.vertices * (lamp.radius_m * np.sqrt(4 * np.pi / ball.area)) + lamp.position_m
    return Mesh(corners.astype(np.float32), ball.faces.astype(np.int32))


def without_lamps(lights: Iterable[Light]) -> tuple[Light, ...]:
    """Return the ``lights`` that are not lamps."""
    return tuple(light for light in lights if not is_lamp(light))


@dataclass(frozen=True)
class _PlacedPart:
    name: str
    mesh: Mesh
    emission: tuple[float, float, float] | None
    has_opacity: bool


def _parts_of(package: Package, placed: PlacedAsset, library: Library | None) -> list[_PlacedPart]:
    asset = package.asset
    if not isinstance(asset, ObjectAsset | EnvironmentAsset):
        raise input_error(package.path, "kind", asset.kind, "an environment or an object to place")
    found = []
    for part in asset.parts:
        matrix = np.asarray(placed.world_from_asset) @ np.asarray(part.asset_from_part)
        if abs(np.linalg.det(matrix[:3, :3])) < SINGULAR:
            raise input_error(placed.name, f"{part.name} transform", matrix.tolist(), "an invertible matrix")
        mesh = decode_ply(package.read_bytes(part.mesh), f"{package.path}/{part.mesh}")
        faults = inspect_mesh(mesh)
        if faults.is_unusable:
            remedy = "re-export the asset"
            raise input_error(package.path, part.mesh, faults, "a surface of finite triangles", remedy)
        mesh = without_degenerate(mesh.placed(matrix))
        material = _material(placed, asset, part.material, library)
        emission = placed.emission.get(part.material, material.emission)
        is_lamp = emission is not None and any(c > 0 for c in emission)
        has_opacity = material.opacity not in (None, 1.0)
        name = f"{placed.name}/{part.name}"
        found.append(_PlacedPart(name, mesh, emission if is_lamp else None, has_opacity))
    return found


def _lamps(lights: Iterable[Light]) -> list[_PlacedPart]:
    return [
        _PlacedPart(f"{_LIGHTS}{light.name}", lamp_mesh(light), light.radiance, False)
        for light in lights
        if is_lamp(light)
    ]


def _geometry(found: list[_PlacedPart]) -> tuple[CaptureGeometry, tuple[str, ...]]:
    parts: list[GeometryPart] = []
    first = 0
    for part in found:
        parts.append(GeometryPart(part.name, first, len(part.mesh.faces), part.emission))
        first += len(part.mesh.faces)
    notes = dict.fromkeys(
        f"{part.name}: its opacity is not part of the geometry; the part counts as solid"
        for part in found
        if part.has_opacity
    )
    return CaptureGeometry(joined([part.mesh for part in found]), tuple(parts)), tuple(notes)


def _material(
    placed: PlacedAsset, asset: ObjectAsset | EnvironmentAsset, slot: str, library: Library | None
) -> Material:
    assignment = placed.materials.get(slot, MaterialAssignment())
    if assignment.asset is None or library is None:
        return asset.materials[slot]
    chosen = library.package(assignment.asset).asset
    if not isinstance(chosen, MaterialAsset):
        raise input_error(placed.name, f"materials.{slot}", chosen.kind, "a material package")
    return chosen.material

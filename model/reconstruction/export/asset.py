# SPDX-License-Identifier: MIT
"""Writes a reconstruction as an environment package for ``datagen``.

The surface is one part with one material of three textures; every lamp is a separate part with its radiance.
Light from windows is exported as area lights or, if it comes from far away, as an image of the sky.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datagen.formats.asset import (
    AssetCamera,
    Box,
    EnvironmentAsset,
    Part,
    Provenance,
    SlotMaterial,
    Texture,
    lens_of,
)
from datagen.formats.base import matrix4, quantized
from datagen.formats.lights import AreaLight, DirectionalLight, EnvironmentLight, Light
from datagen.formats.package import FileSource, Package, write_package
from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.ply import encode_ply
from model.reconstruction.atlas.atlas import MAP_CHANNELS
from model.reconstruction.export.slots import Reconstruction, Slot, environment_exr, export_slots
from model.reconstruction.found_lights import ENVIRONMENT_FILE, SKY, SUN, FoundLights, as_color

_REGION_MARGIN_M = 0.05  # prevents an empty region for a single camera


def write_asset(path: Path, reconstruction: Reconstruction, asset_id: str) -> Package:
    """Write the reconstruction as an environment package, with the capture's cameras and recovered lights.

    Without recovered lights, the package contains the capture's lights, except those with an image in another
    package, on which it would depend.
    """
    capture = reconstruction.capture
    files: dict[str, FileSource] = {
        f"{name}.png": reconstruction.images / f"{name}.png" for name in MAP_CHANNELS
    }
    materials, parts = {}, []
    for name, slot in export_slots(reconstruction).items():
        files[f"{name}.ply"] = encode_ply(slot.mesh)
        materials[name] = _material(slot)
        parts.append(Part(name=name, mesh=f"{name}.ply", material=name))
    found = reconstruction.shining_lights
    if found is not None and found.environment is not None:
        files[ENVIRONMENT_FILE] = environment_exr(found.environment)
    source = f"materials infer, {len(capture.views)} views"
    asset = EnvironmentAsset(
        id=asset_id,
        title=f"Reconstruction of {capture.name}",
        provenance=Provenance(license="LicenseRef-unstated", source=source),
        materials=materials,
        parts=tuple(parts),
        lights=_found_lights(found)
        if found is not None
        else tuple(light for light in capture.lights if getattr(light, "image", None) is None),
        camera_regions=(_camera_region(capture.cameras),),
        cameras=tuple(
            AssetCamera(
                name=view.name,
                **lens_of(view.camera),
                asset_from_camera=matrix4(view.camera.world_from_camera),
            )
            for view in capture.views
        ),
    )
    return write_package(path, asset, files, overwrite=True)


def _found_lights(found: FoundLights) -> tuple[Light, ...]:
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
        for patch in found.sending
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


def _material(slot: Slot) -> SlotMaterial:
    if not slot.has_material:
        black = (0.0, 0.0, 0.0)  # with R = 1, since smooth surfaces of S = 0 reflect at grazing angles
        return SlotMaterial(
            diffuse_albedo=black, specular_albedo=black, roughness=1.0, emission=slot.emission
        )
    return SlotMaterial(
        classes=("other",),
        diffuse_albedo=Texture(texture="diffuse_albedo.png", encoding="srgb"),
        specular_albedo=Texture(texture="specular_albedo.png", encoding="srgb"),
        roughness=Texture(texture="roughness.png", encoding="linear", channel="r"),
        emission=slot.emission,
    )


def _camera_region(cameras: list[Camera]) -> Box:
    positions = np.array([camera.position_m for camera in cameras])
    low, high = positions.min(axis=0) - _REGION_MARGIN_M, positions.max(axis=0) + _REGION_MARGIN_M
    return Box(
        minimum_m=tuple(quantized(v) for v in low),  # type: ignore[arg-type]
        maximum_m=tuple(quantized(v) for v in high),  # type: ignore[arg-type]
    )

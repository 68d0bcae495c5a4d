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
from datagen.formats.package import FileSource, Package, write_package
from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.ply import encode_ply
from model.reconstruction.atlas.atlas import MAP_CHANNELS
from model.reconstruction.export.slots import Reconstruction, Slot, environment_exr, export_slots
from model.reconstruction.found_lights import ENVIRONMENT_FILE

_REGION_MARGIN_M = 0.05  # prevents an empty region for a single camera


def write_asset(path: Path, reconstruction: Reconstruction, asset_id: str) -> Package:
    """Write the reconstruction as an environment package, with the capture's cameras and
    :attr:`Reconstruction.exported_lights`.
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
        lights=reconstruction.exported_lights,
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

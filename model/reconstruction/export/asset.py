# SPDX-License-Identifier: MIT
"""A reconstruction as an asset package (an environment, so that it can go back into ``datagen``) and as a
Mitsuba scene. glTF is in ``gltf_export``.

All surface is one part with one material of three textures; every lamp of a rendered capture is a part of
its own with its radiance.
"""

from __future__ import annotations

import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import (
    AssetCamera,
    Box,
    EnvironmentAsset,
    Part,
    Provenance,
    SlotMaterial,
    Texture,
)
from datagen.formats.base import matrix4, quantized, write_bytes_atomically
from datagen.formats.capture import Capture
from datagen.formats.lights import EnvironmentLight, Light, PointLight
from datagen.formats.package import FileSource, Package, write_package
from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import encode_ply
from model.reconstruction.atlas.atlas import MAP_CHANNELS, Atlas
from model.reconstruction.geometry.crease_normals import with_normals

SURFACE = "surface"
_REGION_MARGIN_M = 0.05  # a capture of one camera has a region of no size


@dataclass(frozen=True)
class Reconstruction:
    """What is exported: the unwrapped mesh in the capture's face order, its atlas, filled, and the folder in
    which ``write_atlas_images`` has put the maps as ``NAME.png``."""

    capture: Capture
    mesh: Mesh
    atlas: Atlas
    images: Path


def submesh(mesh: Mesh, chosen: NDArray[np.bool_]) -> Mesh:
    """The chosen triangles (M,) with the vertices they use; normals are made where the mesh has none."""
    mesh = with_normals(mesh)
    assert mesh.normals is not None
    faces = mesh.faces[chosen]
    used, compact = np.unique(faces, return_inverse=True)
    return Mesh(
        mesh.positions[used],
        compact.reshape(-1, 3).astype(np.int32),
        mesh.normals[used],
        None if mesh.uv is None else mesh.uv[used],
    )


def split_by_emission(
    reconstruction: Reconstruction,
) -> dict[str, tuple[Mesh, tuple[float, float, float] | None]]:
    """Slot -> triangles and radiance: ``surface``, then ``lamp-0``, ``lamp-1``, ... ."""
    mesh, geometry = with_normals(reconstruction.mesh), reconstruction.capture.geometry
    emits = geometry.emitter_mask()
    parts: dict[str, tuple[Mesh, tuple[float, float, float] | None]] = {}
    if not emits.all():
        parts[SURFACE] = (submesh(mesh, ~emits), None)
    for part in geometry.parts:
        if part.emission is not None:
            chosen = np.zeros(len(mesh.faces), dtype=bool)
            chosen[part.first_face : part.first_face + part.num_faces] = True
            parts[f"lamp-{len([n for n in parts if n != SURFACE])}"] = (submesh(mesh, chosen), part.emission)
    return parts


def write_asset(
    path: Path, reconstruction: Reconstruction, asset_id: str, *, license_id: str = "LicenseRef-unstated"
) -> Package:
    """The reconstruction as an environment package with the capture's cameras and lights.

    Lights whose image lies in another package are left out, as the package would not be whole without it.
    """
    capture = reconstruction.capture
    files: dict[str, FileSource] = {
        f"{name}.png": reconstruction.images / f"{name}.png" for name in MAP_CHANNELS
    }
    materials, parts = {}, []
    for slot, (mesh, emission) in split_by_emission(reconstruction).items():
        files[f"{slot}.ply"] = encode_ply(mesh)
        materials[slot] = _surface_material() if emission is None else SlotMaterial(emission=emission)
        parts.append(Part(name=slot, mesh=f"{slot}.ply", material=slot))
    asset = EnvironmentAsset(
        id=asset_id,
        title=f"Reconstruction of {capture.name}",
        provenance=Provenance(license=license_id, source=f"materials infer, {len(capture.views)} views"),
        materials=materials,
        parts=tuple(parts),
        lights=tuple(light for light in capture.lights if not _needs_other_package(light)),
        camera_regions=(_camera_region(capture.cameras),),
        cameras=tuple(_asset_camera(view.name, view.camera) for view in capture.views),
    )
    return write_package(path, asset, files, overwrite=True)


def _needs_other_package(light: Light) -> bool:
    return isinstance(light, EnvironmentLight) and light.image is not None


def _surface_material() -> SlotMaterial:
    return SlotMaterial(
        classes=("other",),
        diffuse_albedo=Texture(texture="diffuse_albedo.png", encoding="srgb"),
        specular_albedo=Texture(texture="specular_albedo.png", encoding="srgb"),
        roughness=Texture(texture="roughness.png", encoding="linear", channel="r"),
    )


def _camera_region(cameras: list[Camera]) -> Box:
    positions = np.array([camera.position_m for camera in cameras])
    low, high = positions.min(axis=0) - _REGION_MARGIN_M, positions.max(axis=0) + _REGION_MARGIN_M
    return Box(
        minimum_m=tuple(quantized(v) for v in low),  # type: ignore[arg-type]
        maximum_m=tuple(quantized(v) for v in high),  # type: ignore[arg-type]
    )


def _asset_camera(name: str, camera: Camera) -> AssetCamera:
    return AssetCamera(
        name=name,
        width_px=camera.width_px,
        height_px=camera.height_px,
        fx_px=camera.fx_px,
        fy_px=camera.fy_px,
        cx_px=camera.cx_px,
        cy_px=camera.cy_px,
        asset_from_camera=matrix4(camera.world_from_camera),
    )


def write_mitsuba_scene(folder: Path, reconstruction: Reconstruction) -> Path:
    """``scene.xml`` with meshes and textures beside it; its BSDF needs ``mitsuba_plugins.register()``.

    Sensors are the capture's cameras (square pixels: the mean focal length). Point lights and the constant
    sky are written; lights of other kinds are not, and a scene without any light gets a white sky.
    """
    textures = folder / "textures"
    textures.mkdir(parents=True, exist_ok=True)
    for name in MAP_CHANNELS:
        shutil.copyfile(reconstruction.images / f"{name}.png", textures / f"{name}.png")
    scene = ElementTree.Element("scene", version="3.0.0")
    _add(scene, "integrator", "path", ("integer", "max_depth", 8))
    for view in reconstruction.capture.views:
        _add_sensor(scene, view.name, view.camera)
    bsdf = _add(scene, "bsdf", "cook_torrance")
    bsdf.set("id", SURFACE)
    for name in MAP_CHANNELS:
        texture = _add(
            bsdf,
            "texture",
            "bitmap",
            ("string", "filename", f"textures/{name}.png"),
            ("boolean", "raw", "true" if name == "roughness" else "false"),
        )
        texture.set("name", name)
    for slot, (mesh, emission) in split_by_emission(reconstruction).items():
        assert mesh.uv is not None
        downward = Mesh(mesh.positions, mesh.faces, mesh.normals, mesh.uv * [1, -1] + [0, 1])
        write_bytes_atomically(folder / f"{slot}.ply", encode_ply(downward))
        shape = _add(scene, "shape", "ply", ("string", "filename", f"{slot}.ply"))
        if emission is None:
            ElementTree.SubElement(shape, "ref", id=SURFACE)
        else:
            _add(shape, "emitter", "area", ("rgb", "radiance", _numbers(emission)))
    _add_lights(scene, reconstruction.capture.lights)
    ElementTree.indent(scene)
    path = folder / "scene.xml"
    write_bytes_atomically(path, ElementTree.tostring(scene) + b"\n")
    return path


def _add(
    parent: ElementTree.Element, tag: str, kind: str, *values: tuple[str, str, object]
) -> ElementTree.Element:
    node = ElementTree.SubElement(parent, tag, type=kind)
    for value_tag, name, value in values:
        ElementTree.SubElement(node, value_tag, name=name, value=str(value))
    return node


def _numbers(values: object) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(np.asarray(values, dtype=np.float64)))


def _add_sensor(scene: ElementTree.Element, name: str, camera: Camera) -> None:
    focal = 0.5 * (camera.fx_px + camera.fy_px)
    fov = np.degrees(2 * np.arctan(0.5 * camera.width_px / focal))
    sensor = _add(
        scene,
        "sensor",
        "perspective",
        ("float", "fov", repr(float(fov))),
        ("string", "fov_axis", "x"),
        ("float", "principal_point_offset_x", repr(camera.cx_px / camera.width_px - 0.5)),
        ("float", "principal_point_offset_y", repr(camera.cy_px / camera.height_px - 0.5)),
    )
    sensor.set("id", name)
    transform = ElementTree.SubElement(sensor, "transform", name="to_world")
    matrix = camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba: x left, y up
    ElementTree.SubElement(transform, "matrix", value=_numbers(matrix))
    size = (("integer", "width", camera.width_px), ("integer", "height", camera.height_px))
    _add(sensor, "film", "hdrfilm", *size)


def _add_lights(scene: ElementTree.Element, lights: tuple[Light, ...]) -> None:
    for light in lights:
        if isinstance(light, PointLight):
            emitter = _add(scene, "emitter", "point", ("rgb", "intensity", _numbers(light.intensity)))
            x, y, z = (repr(float(v)) for v in light.position_m)
            ElementTree.SubElement(emitter, "point", name="position", x=x, y=y, z=z)
        elif isinstance(light, EnvironmentLight) and light.image is None:
            radiance = np.asarray(light.radiance) * light.scale
            _add(scene, "emitter", "constant", ("rgb", "radiance", _numbers(radiance)))
    if scene.find(".//emitter") is None:
        _add(scene, "emitter", "constant", ("rgb", "radiance", "1 1 1"))

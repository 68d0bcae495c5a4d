# SPDX-License-Identifier: MIT
"""Writes a reconstruction as a standalone Mitsuba scene."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from datagen.formats.base import write_bytes_atomically
from datagen.formats.lights import EnvironmentLight, Light, PointLight
from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import encode_ply
from datagen.foundation.naming import unique
from model.reconstruction.atlas.atlas import MAP_CHANNELS
from model.reconstruction.export.slots import (
    WORLD_FROM_SKY,
    Reconstruction,
    environment_exr,
    export_slots,
    patch_meshes,
)
from model.reconstruction.found_lights import ENVIRONMENT_FILE, SKY, SUN, Color, FoundLights

_MATERIAL = "atlas"


def write_mitsuba_scene(folder: Path, reconstruction: Reconstruction, *, has_sensors: bool = True) -> Path:
    """Write ``scene.xml``, its meshes and its textures to ``folder``; return the path of ``scene.xml``.

    Loading it requires ``mitsuba_plugins.register()``, which provides its BSDF. Sensors are the capture's
    cameras with the mean of fx and fy, since Mitsuba's pixels are square; their ids are the views' names,
    unless a shape or light has this id. Lights are the recovered lights, else the capture's point lights and
    constant sky, else a white sky. Shape ids are the names of meshes.
    """
    textures = folder / "textures"
    textures.mkdir(parents=True, exist_ok=True)
    for name in MAP_CHANNELS:
        image = (reconstruction.images / f"{name}.png").read_bytes()
        write_bytes_atomically(textures / f"{name}.png", image)
    scene = ElementTree.Element("scene", version="3.0.0")
    _add(scene, "integrator", "path", ("integer", "max_depth", 8))
    slots, found = export_slots(reconstruction), reconstruction.shining_lights
    patches = patch_meshes(found.emitting_patches) if found is not None else {}
    ids = {_MATERIAL, SKY, SUN, *slots, *patches}
    for view in reconstruction.capture.views if has_sensors else ():
        sensor_id = unique(view.name, ids)
        ids.add(sensor_id)
        _add_sensor(scene, sensor_id, view.camera)
    bsdf = _add(scene, "bsdf", "cook_torrance")
    bsdf.set("id", _MATERIAL)
    for name in MAP_CHANNELS:
        file = ("string", "filename", f"textures/{name}.png")
        raw = ("boolean", "raw", "true" if name == "roughness" else "false")
        texture = _add(bsdf, "texture", "bitmap", file, raw)
        texture.set("name", name)
    for name, slot in slots.items():
        shape = _add_mesh(scene, folder, name, slot.mesh)
        if slot.has_material:
            ElementTree.SubElement(shape, "ref", id=_MATERIAL)
        else:
            _add(shape, "bsdf", "diffuse", ("rgb", "reflectance", "0"))
        _add_emission(shape, slot.emission)
    for name, (mesh, radiance) in patches.items():
        shape = _add_mesh(scene, folder, name, mesh)
        _add(shape, "bsdf", "diffuse", ("rgb", "reflectance", "0 0 0"))
        _add_emission(shape, radiance)
    if found is None:
        _add_lights(scene, reconstruction.capture.lights)
    else:
        _add_far(scene, folder, found)
    ElementTree.indent(scene)
    path = folder / "scene.xml"
    write_bytes_atomically(path, ElementTree.tostring(scene) + b"\n")
    return path


def _add_mesh(scene: ElementTree.Element, folder: Path, name: str, mesh: Mesh) -> ElementTree.Element:
    """Add a mesh with flipped v, since row 0 of Mitsuba's textures is at v = 0."""
    assert mesh.uv is not None
    downward = Mesh(mesh.positions, mesh.faces, mesh.normals, mesh.uv * [1, -1] + [0, 1])
    write_bytes_atomically(folder / f"{name}.ply", encode_ply(downward))
    shape = _add(scene, "shape", "ply", ("string", "filename", f"{name}.ply"))
    shape.set("id", name)
    return shape


def _add_emission(shape: ElementTree.Element, emission: Color | None) -> None:
    if emission is not None and max(emission) > 0:
        _add(shape, "emitter", "area", ("rgb", "radiance", _numbers(emission)))


def _add_far(scene: ElementTree.Element, folder: Path, found: FoundLights) -> None:
    """Add the sun and the sky."""
    if found.sun is not None:
        emitter = _add(scene, "emitter", "directional", ("rgb", "irradiance", _numbers(found.sun.irradiance)))
        emitter.set("id", SUN)
        x, y, z = (repr(-v) for v in found.sun.direction)
        ElementTree.SubElement(emitter, "vector", name="direction", x=x, y=y, z=z)
    if found.environment is None:
        return
    write_bytes_atomically(folder / ENVIRONMENT_FILE, environment_exr(found.environment))
    emitter = _add(scene, "emitter", "envmap", ("string", "filename", ENVIRONMENT_FILE))
    emitter.set("id", SKY)
    transform = ElementTree.SubElement(emitter, "transform", name="to_world")
    ElementTree.SubElement(transform, "matrix", value=_numbers(WORLD_FROM_SKY))


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

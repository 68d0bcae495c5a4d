# SPDX-License-Identifier: MIT
"""Reads the camera file of Agisoft Metashape (PhotoScan): "Export Cameras", Agisoft XML.

A camera's ``transform`` is chunk_from_camera, with x right, y down and z forward. The transform (rotation,
translation, scale) of the chunk, or of the camera's component if it has one, maps to the coordinates in which
"Export Model" writes meshes, provided that the chunk's reference is local. Sensors have f, cx and cy in
pixels, with the principal point relative to the image centre; b1 is added to f for u, and b2 is skew. Frame
cameras have k1 ... k4 of r^2 ... r^8; p1 multiplies (r^2 + 2 x^2), so it is OpenCV's p2 (manual, appendix
"Camera models"). Equidistant fisheyes equal OpenCV's fisheye if p1 = p2 = 0.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import Distortion
from datagen.foundation.axes import affine
from datagen.foundation.budget import Budget
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import Problem, input_error
from model.reconstruction.captures.posed import (
    EXPORT_AGAIN,
    Calibration,
    PosedImage,
    Reading,
    check_skew,
    head_of,
    numbers,
    polynomial,
    read_xml,
    rotation_part,
)

_FISHEYES = ("fisheye", "equidistant_fisheye")
_EARTH = ("GEOGCS", "GEOCCS", "PROJCS", "GEOGCRS", "PROJCRS", "COMPD_CS", "COMPOUNDCRS")


def find(path: Path) -> Path | None:
    """Return the camera file ``path``, or the only one in the folder ``path``; None for none or several."""
    files = sorted(path.glob("*.xml")) if path.is_dir() else [path] if path.suffix.lower() == ".xml" else []
    found = [file for file in files if "<document" in head_of(file) and "<chunk" in head_of(file)]
    return found[0] if len(found) == 1 else None


def read(path: Path, images: Path | None, budget: Budget) -> Calibration:
    """Read the calibration of every aligned camera. Raises :class:`InputError` with all faults."""
    root = read_xml(path, budget)
    chunks = root.findall("chunk") + root.findall("chunks/chunk")
    if len(chunks) != 1:
        raise input_error(path, "chunk", len(chunks), "one chunk", "export the cameras of one chunk")
    chunk = chunks[0]
    reading = Reading(path)
    sensors: dict[str, PosedImage | None] = {}
    for element in chunk.iterfind("sensors/sensor"):
        key = element.get("id", "")
        sensors[key] = None
        with reading.part():
            sensors[key] = _sensor(element, path)
    _check_local(chunk, path)
    placement = _similarity(chunk.find("transform"), path)
    components = {  # since version 1.7, separately aligned parts have separate transforms
        element.get("id", ""): _similarity(element.find("transform"), path)
        for element in chunk.iterfind("components/component")
        if element.find("transform") is not None
    }
    for camera in chunk.iter("camera"):
        budget.spend("frames", 1, "cameras")
        name, transform = camera.get("label", ""), camera.find("transform")
        if transform is None or camera.get("enabled") in ("false", "0"):
            reading.num_unposed += 1
            continue
        key = camera.get("sensor_id", "")
        if key not in sensors:
            reading.problems.append(
                Problem(path, name, f"sensor {key}", "a sensor of the file", EXPORT_AGAIN)
            )
        sensor = sensors.get(key)
        if sensor is None:
            continue
        with reading.part():
            frame = components.get(camera.get("component_id", ""), placement)
            total = frame @ numbers(transform.text, 16, path, f"{name}.transform").reshape(4, 4)
            rotation = rotation_part(total[:3, :3], path, f"{name}.transform")
            reading.images.append(sensor.posed(name, affine(rotation, total[:3, 3])))
    folder = images or (path.parent / "images" if (path.parent / "images").is_dir() else path.parent)
    nothing = Problem(path, "cameras", "none with a transform", "aligned cameras", EXPORT_AGAIN)
    return reading.calibration(folder, nothing, "cameras are not aligned or not enabled, and were left out")


def _sensor(element: ElementTree.Element, path: Path) -> PosedImage:
    """Parse a sensor, as an unnamed image from the origin; an adjusted calibration is preferred."""
    field = f"sensor {element.get('id')}"
    found = element.findall("calibration")
    calibration = next((c for c in found if c.get("class") == "adjusted"), found[-1] if found else None)
    if calibration is None:
        raise input_error(path, field, "no calibration", "an adjusted calibration", "align the photographs")
    resolution = calibration.find("resolution")
    resolution = element.find("resolution") if resolution is None else resolution
    size = "" if resolution is None else f"{resolution.get('width')} {resolution.get('height')}"
    width, height = (int(v) for v in numbers(size, 2, path, f"{field}.resolution"))
    p = {name: 0.0 for name in ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2")}
    for name in p:
        value = calibration.find(name)
        if value is not None:
            p[name] = float(numbers(value.text, 1, path, f"{field}.{name}")[0])
    for name in ("p3", "p4"):
        value = calibration.find(name)
        if value is not None and float(numbers(value.text, 1, path, f"{field}.{name}")[0]) != 0:
            raise input_error(path, f"{field}.{name}", value.text, "0", "calibrate with k1 ... k4, p1, p2")
    if not (p["f"] > 0 and p["f"] + p["b1"] > 0 and min(width, height) > 0):
        raise input_error(path, f"{field}.f", p["f"], "a positive focal length and size", EXPORT_AGAIN)
    check_skew(p["b2"], p["f"], height, path, f"{field}.b2")
    kind = calibration.get("type") or element.get("type") or "frame"
    fx, fy, cx, cy = p["f"] + p["b1"], p["f"], 0.5 * width + p["cx"], 0.5 * height + p["cy"]
    return PosedImage("", Camera(width, height, fx, fy, cx, cy, np.eye(4)), _distortion(kind, p, path, field))


def _distortion(kind: str, p: dict[str, float], path: Path, field: str) -> Distortion | None:
    if kind == "frame":
        return polynomial((p["k1"], p["k2"], p["k3"], p["k4"]), (p["p2"], p["p1"]))
    if kind in _FISHEYES:
        if p["p1"] or p["p2"]:
            raise input_error(path, f"{field}.p1, p2", (p["p1"], p["p2"]), "0 for a fisheye", EXPORT_AGAIN)
        return Distortion(model="fisheye", coefficients=(p["k1"], p["k2"], p["k3"], p["k4"]))
    remedy = "undistort the images in Metashape (Export > Convert images)"
    raise input_error(path, f"{field}.type", kind, f"frame, {', '.join(_FISHEYES)}", remedy)


def _check_local(chunk: ElementTree.Element, path: Path) -> None:
    """Raise :class:`InputError` for a georeferenced chunk, whose mesh and cameras differ in coordinates."""
    for element in chunk.findall("reference"):
        text = (element.text or "").strip().upper()
        if text.startswith(_EARTH):
            remedy = "set the chunk's reference to Local Coordinates and export cameras and mesh again"
            raise input_error(path, "chunk.reference", text[:40], "Local Coordinates", remedy)


def _similarity(element: ElementTree.Element | None, path: Path) -> NDArray[np.float64]:
    """Parse world_from_chunk (4, 4), including scale; the identity if ``element`` is None."""
    matrix = np.eye(4)
    if element is None:
        return matrix
    rotation, translation, scale = (element.find(name) for name in ("rotation", "translation", "scale"))
    if rotation is not None and rotation.text:
        values = numbers(rotation.text, 9, path, "transform.rotation").reshape(3, 3)
        matrix[:3, :3] = rotation_part(values, path, "transform.rotation")
    if scale is not None and scale.text:
        factor = float(numbers(scale.text, 1, path, "transform.scale")[0])
        if factor <= 0:
            raise input_error(path, "transform.scale", factor, "a positive scale", EXPORT_AGAIN)
        matrix[:3, :3] *= factor
    if translation is not None and translation.text:
        matrix[:3, 3] = numbers(translation.text, 3, path, "transform.translation")
    return matrix

# SPDX-License-Identifier: MIT
"""Reads RealityCapture's (RealityScan's) CSV "Internal/External camera parameters" and XMP sidecars.

In both formats, the focal length is in mm for film whose longer side is 36 mm, and the principal point is an
offset from the centre in units of the longer side. Distortion is k1 ... k4 of r^2 ... r^8, and t1, t2, which
are OpenCV's p2, p1 (t1 multiplies r^2 + 2 x^2). The files contain no image sizes, so the images are required.

In the CSV, (x, y, alt) is the camera's centre, and world_from_camera = Rz(-heading) Rx(pitch) Ry(roll) in
degrees, for a camera that looks along -z with y up: at zero angles it looks straight down, with north (+y) at
the top. In XMP, ``Rotation`` is camera_from_world by rows, for a camera with y down and z forward, and
``Position`` is the centre ("RealityCapture XMP camera math").
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import Distortion
from datagen.foundation.axes import affine
from datagen.foundation.budget import Budget
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import Problem, input_error
from model.reconstruction.captures.photograph_files import photograph_size
from model.reconstruction.captures.posed import (
    EXPORT_AGAIN,
    UNSIZED,
    Calibration,
    ImageFinder,
    PosedImage,
    Reading,
    check_skew,
    head_of,
    numbers,
    polynomial,
    read_text,
    read_xml,
    rotation_part,
)

_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")
_FILM_MM = 36.0


def find_csv(path: Path) -> Path | None:
    """Return the camera CSV ``path``, or the only one in the folder ``path``; None for none or several."""
    files = sorted(path.glob("*.csv")) if path.is_dir() else [path] if path.suffix.lower() == ".csv" else []
    found = [file for file in files if _columns(head_of(file)) is not None]
    return found[0] if len(found) == 1 else None


def find_xmp(path: Path) -> Path | None:
    """Return the folder with XMP sidecars, ``path`` or its subfolder ``images``; None if there is none."""
    for folder in (path, path / "images"):
        if folder.is_dir() and any("capturingreality" in head_of(file) for file in folder.glob("*.xmp")):
            return folder
    return None


def _columns(text: str) -> list[str] | None:
    """Find the column names in the first lines of a CSV; None if a required column is missing."""
    for line in text.lstrip("\ufeff").splitlines()[:3]:
        names = [word.strip().lstrip("#").lower() for word in line.split(",")]
        if set(_NEEDED) <= set(names):
            return names
    return None


def read_csv(path: Path, images: Path | None, budget: Budget) -> Calibration:
    """Read the calibration of every row. Raises :class:`InputError` with all faults and missing images."""
    text = read_text(path)
    names = _columns(text)
    if names is None:
        raise input_error(path, "header", text[:60], f"columns {', '.join(_NEEDED)}", EXPORT_AGAIN)
    folder = images or (path.parent / "images" if (path.parent / "images").is_dir() else path.parent)
    finder = ImageFinder(folder)
    reading = Reading(path)
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    budget.spend("frames", len(lines), "rows")
    try:
        rows = list(csv.reader(lines))
    except csv.Error as error:  # a quotation mark without a second one
        raise input_error(path, "", str(error), "one row per camera", EXPORT_AGAIN) from None
    for number, row in enumerate(rows, start=1):
        if [word.strip().lower() for word in row] == names:
            continue
        with reading.part():
            values = dict(zip(names, row, strict=False))
            reading.images.append(_from_row(values, path, f"row {number}", finder))
    reading.problems += finder.absent(path, reading.missing, UNSIZED)
    nothing = Problem(path, "", "no cameras", "one row per camera", EXPORT_AGAIN)
    return reading.calibration(folder, nothing)


def _from_row(row: Mapping[str, str], path: Path, field: str, finder: ImageFinder) -> PosedImage:
    name = row.get("name", "").strip()
    values: dict[str, float] = {}
    for key in (*_NEEDED[1:], *_OPTIONAL):
        if key in row or key in _NEEDED:
            values[key] = float(numbers(row.get(key), 1, path, f"{field} ({name}) {key}")[0])
    x, y, z = values["x"], values["y"], values["alt"]
    rotation = rotation_of_angles(values["heading"], values["pitch"], values["roll"])
    size = photograph_size(finder.require(name))
    k = tuple(values.get(n, 0.0) for n in ("k1", "k2", "k3", "k4"))
    distortion = _brown(k, (values.get("t1", 0.0), values.get("t2", 0.0)))
    principal = (values.get("px", 0.0), values.get("py", 0.0))
    camera = _camera(size, values["f"], 1.0, principal, affine(rotation, (x, y, z)), path, name)
    return PosedImage(name, camera, distortion)


def rotation_of_angles(heading: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Compute world_from_camera (3, 3), with y down and z forward, from the CSV's angles in degrees."""
    a, b, c = (math.radians(v) for v in (-heading, pitch, roll))
    about_z = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    about_y = np.array([[math.cos(c), 0, math.sin(c)], [0, 1, 0], [-math.sin(c), 0, math.cos(c)]])
    return about_z @ about_x @ about_y @ np.diag([1.0, -1.0, -1.0])


def _brown(k: tuple[float, ...], t: tuple[float, float]) -> Distortion | None:
    return polynomial((k[0], k[1], k[2], k[3]), (t[1], t[0]))


def _camera(
    size: tuple[int, int],
    focal_mm: float,
    aspect: float,
    principal: tuple[float, float],
    pose: NDArray[np.float64],
    where: Path,
    field: str,
) -> Camera:
    scale = float(max(size))
    focal = focal_mm / _FILM_MM * scale
    if not (focal > 0 and aspect > 0):
        raise input_error(where, f"{field} focal length", focal_mm, "a positive value", EXPORT_AGAIN)
    cx, cy = 0.5 * size[0] + principal[0] * scale, 0.5 * size[1] + principal[1] * scale
    return Camera(size[0], size[1], focal, focal * aspect, cx, cy, pose)


def read_xmp(folder: Path, images: Path | None, budget: Budget) -> Calibration:
    """Read the calibration of every sidecar with a pose; images are named after their sidecars.

    Raises :class:`InputError` with all faults.
    """
    images = images or folder
    finder = ImageFinder(images)
    reading = Reading(folder)
    for path in sorted(folder.glob("*.xmp")):
        budget.spend("frames", 1, path.name)
        with reading.part():
            posed = _from_sidecar(path, finder, Budget(path, budget.limits))
            reading.num_unposed += posed is None
            reading.images += [] if posed is None else [posed]
    reading.problems += finder.absent(folder, reading.missing, UNSIZED)
    expected = "XMP files with Rotation and Position"
    nothing = Problem(folder, "", "no poses", expected, "export them after the alignment")
    return reading.calibration(images, nothing, "XMP files have no pose and were left out")


def _from_sidecar(path: Path, finder: ImageFinder, budget: Budget) -> PosedImage | None:
    values: dict[str, str] = {}  # attributes or elements, depending on the software's version
    for element in read_xml(path, budget).iter():
        values.update({k[len(_XCR) :]: v for k, v in element.attrib.items() if k.startswith(_XCR)})
        if element.tag.startswith(_XCR) and element.text:
            values[element.tag[len(_XCR) :]] = element.text
    if "Rotation" not in values or "Position" not in values:
        return None
    camera_from_world = rotation_part(
        numbers(values["Rotation"], 9, path, "Rotation").reshape(3, 3), path, "Rotation"
    )
    pose = affine(camera_from_world.T, numbers(values["Position"], 3, path, "Position"))

    def scalar(name: str, default: str | None = None) -> float:
        return float(numbers(values.get(name, default), 1, path, name)[0])

    size = photograph_size(finder.require(path.stem))
    principal = (scalar("PrincipalPointU", "0"), scalar("PrincipalPointV", "0"))
    focal_mm, aspect = scalar("FocalLength35mm"), scalar("AspectRatio", "1")
    camera = _camera(size, focal_mm, aspect, principal, pose, path, path.stem)
    check_skew(scalar("Skew", "0") * max(size), camera.fx_px, size[1], path, "Skew")
    model = values.get("DistortionModel", "perspective")
    if model not in _MODELS:
        remedy = "align with Brown3, Brown4 or no lens distortion, or export undistorted images"
        raise input_error(path, "DistortionModel", model, f"one of {', '.join(_MODELS)}", remedy)
    distortion = None
    if model != "perspective":
        k = numbers(values.get("DistortionCoeficients"), 6, path, "DistortionCoeficients")
        distortion = _brown(tuple(float(v) for v in k[:4]), (float(k[4]), float(k[5])))
    return PosedImage(path.stem, camera, distortion)

# SPDX-License-Identifier: MIT
"""Reads ``transforms.json`` (NeRF, instant-ngp, nerfstudio).

``transform_matrix`` is world_from_camera of a camera that looks along -z with y up. Intrinsics are at the top
level or in a frame, in pixels with centres at +0.5, or as the field of view ``camera_angle_x`` in radians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from datagen.formats.capture import Distortion
from datagen.foundation.axes import affine
from datagen.foundation.budget import Budget
from datagen.foundation.cameras import Camera
from datagen.foundation.documents import parse_json
from datagen.foundation.errors import Problem, input_error, raise_problems
from model.reconstruction.captures.photograph_files import photograph_size
from model.reconstruction.captures.posed import (
    Calibration,
    ImageFinder,
    ImageMissing,
    PosedImage,
    Reading,
    read_text,
    rotation_part,
)

_OURS_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_MODELS = {
    "OPENCV": "brown", "PINHOLE": "brown", "SIMPLE_PINHOLE": "brown", "SIMPLE_RADIAL": "brown",
    "RADIAL": "brown", "FULL_OPENCV": "brown", "OPENCV_FISHEYE": "fisheye",
}  # fmt: skip


def find(path: Path) -> Path | None:
    """Return the JSON file ``path``, or ``transforms.json`` in the folder ``path``; None if there is none."""
    file = path / "transforms.json" if path.is_dir() else path
    return file if file.suffix == ".json" and file.is_file() else None


def read(path: Path, images: Path | None, budget: Budget) -> Calibration:
    """Read the calibration of every frame, with the absolute path of its image. Images are searched in the
    file's folder and in ``images``. Raises :class:`InputError` with all faults.
    """
    folder = images or path.parent
    finders = [ImageFinder(f) for f in dict.fromkeys((path.parent, folder))]
    data = parse_json(read_text(path), path, budget)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise input_error(
            path, "frames", repr(frames)[:80], "a list of at least one frame", "export it again"
        )
    budget.spend("frames", len(frames), "frames")
    reading = Reading(path)
    for index, frame in enumerate(frames):
        try:
            with reading.part():
                reading.images.append(_posed({**data, **frame}, path, f"frames[{index}]", finders))
        except (TypeError, ValueError, OverflowError) as error:
            reading.problems.append(
                Problem(path, f"frames[{index}]", str(error), "numbers", "export it again")
            )
    remedy = "put the images beside the file, or name their folder with --images"
    reading.problems += finders[-1].absent(path, reading.missing, remedy)
    raise_problems(reading.problems)
    return Calibration(tuple(reading.images), folder)


def _posed(values: dict[str, Any], path: Path, field: str, finders: Sequence[ImageFinder]) -> PosedImage:
    image = _image_path(values, path, field, finders)
    matrix = np.asarray(values.get("transform_matrix"), dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise input_error(path, f"{field}.transform_matrix", matrix.shape, "a 4x4 matrix", "export it again")
    pose = affine(rotation_part(matrix[:3, :3], path, f"{field}.transform_matrix"), matrix[:3, 3])
    return PosedImage(
        str(image), _camera(values, image, path, field, pose @ _OURS_FROM_OPENGL), _distortion(values, path)
    )


def _image_path(values: dict[str, Any], path: Path, field: str, finders: Sequence[ImageFinder]) -> Path:
    name = values.get("file_path")
    if not isinstance(name, str) or not name:
        raise input_error(path, f"{field}.file_path", name, "the path of the image", "export it again")
    for finder in finders:  # also tries suffixes, which the original NeRF files omit
        image = finder.find(name)
        if image is not None:
            return image
    raise ImageMissing(name[:200])


def _camera(values: dict[str, Any], image: Path, path: Path, field: str, pose: np.ndarray) -> Camera:
    if "w" in values and "h" in values:
        width, height = int(values["w"]), int(values["h"])
    else:
        width, height = photograph_size(image)
    if "fl_x" in values or "fl_y" in values:
        fx = float(values["fl_x" if "fl_x" in values else "fl_y"])
        fy = float(values.get("fl_y", fx))
    elif "camera_angle_x" in values or "camera_angle_y" in values:
        has_x = "camera_angle_x" in values
        angle = float(values["camera_angle_x" if has_x else "camera_angle_y"])
        fx = 0.5 * (width if has_x else height) / math.tan(0.5 * angle) if 0 < angle < math.pi else 0.0
        has_both = has_x and "camera_angle_y" in values
        fy = 0.5 * height / math.tan(0.5 * float(values["camera_angle_y"])) if has_both else fx
    else:
        raise input_error(path, field, "no focal length", "fl_x or camera_angle_x", "export it again")
    if not (fx > 0 and fy > 0 and math.isfinite(fx) and math.isfinite(fy) and min(width, height) > 0):
        raise input_error(path, f"{field} focal length", (fx, fy), "positive values", "export it again")
    cx, cy = float(values.get("cx", 0.5 * width)), float(values.get("cy", 0.5 * height))
    return Camera(width, height, fx, fy, cx, cy, pose)


def _distortion(values: dict[str, Any], path: Path) -> Distortion | None:
    model = str(values.get("camera_model", "OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV"))
    if model not in _MODELS:
        raise input_error(path, "camera_model", model, f"one of {', '.join(_MODELS)}", "undistort the images")
    kind = _MODELS[model]
    names = (
        ("k1", "k2", "k3", "k4") if kind == "fisheye" else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    )
    k = tuple(float(values.get(name, 0.0)) for name in names)
    return Distortion(model=kind, coefficients=k) if any(k) else None  # type: ignore[arg-type]

# SPDX-License-Identifier: MIT
"""Reads OpenMVG's ``sfm_data.json`` (``openMVG_main_ConvertSfM_DataFormat -V -I -E``).

A pose consists of the camera_from_world ``rotation`` (rows) and the ``center``; cameras look along +z with y
down. Distortion is ``disto_k1`` or ``disto_k3`` (r^2, r^4, r^6), ``disto_t2`` (k1 k2 k3 t1 t2, with t1 and t2
as OpenCV's p1 and p2) or ``fisheye`` (OpenCV's). The serialiser writes the class of an intrinsic only at its
first occurrence, so classes are recognised by their keys.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import Distortion
from datagen.foundation.axes import affine
from datagen.foundation.budget import Budget
from datagen.foundation.cameras import Camera
from datagen.foundation.documents import parse_json
from datagen.foundation.errors import Problem, input_error
from model.reconstruction.captures.posed import (
    EXPORT_AGAIN,
    Calibration,
    PosedImage,
    Reading,
    head_of,
    polynomial,
    read_text,
    rotation_part,
)

_REMEDY = "export views, intrinsics and extrinsics (openMVG_main_ConvertSfM_DataFormat -V -I -E)"


def find(path: Path) -> Path | None:
    """Return the OpenMVG file ``path``, or ``sfm_data.json`` in the folder ``path``, or None."""
    file = path / "sfm_data.json" if path.is_dir() else path
    return file if file.suffix == ".json" and '"sfm_data_version"' in head_of(file) else None


def read(path: Path, images: Path | None, budget: Budget) -> Calibration:
    """Read the calibration of every view with a pose. Raises :class:`InputError` with all faults."""
    data = parse_json(read_text(path), path, budget, _REMEDY)
    try:
        views = [_payload(entry) for entry in data["views"]]
        intrinsics = {entry["key"]: _payload(entry) for entry in data["intrinsics"]}
        poses = {entry["key"]: entry["value"] for entry in data["extrinsics"]}
    except (KeyError, TypeError, AttributeError) as error:
        expected = "views, intrinsics and extrinsics"
        raise input_error(path, "", repr(error)[:200], expected, _REMEDY) from None
    budget.spend("frames", len(views), "views")
    reading = Reading(path)
    lenses: dict[Any, PosedImage | None] = {}
    for view in views:
        name = str(Path(str(view.get("local_path", ""))) / str(view.get("filename", "")))
        try:
            key = view.get("id_intrinsic")
            if view.get("id_pose") not in poses or key not in intrinsics:
                reading.num_unposed += 1
                continue
            with reading.part():
                pose = _pose(name, poses[view["id_pose"]], path)
                if key not in lenses:  # a lens's fault is reported once, not once per view
                    lenses[key] = None
                    lenses[key] = _lens(intrinsics[key], path, f"intrinsics {key}")
                lens = lenses[key]
                if lens is not None:
                    reading.images.append(lens.posed(name, pose))
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
            reading.problems.append(Problem(path, name, repr(error)[:200], "numbers", _REMEDY))
    # root_path may be from another computer, so only its last part is used, as a folder next to the file
    name = Path(str(data.get("root_path", ""))).name
    candidates = [
        path.parent / f for f in (name, "images") if f.isprintable() and f not in ("", "..") and len(f) < 100
    ]
    folder = images or next((f for f in candidates if f.is_dir()), path.parent)
    nothing = Problem(path, "extrinsics", "no view has a pose", "at least one", _REMEDY)
    return reading.calibration(folder, nothing, "views have no pose or lens and were left out")


def _payload(entry: dict[str, Any]) -> dict[str, Any]:
    """Unwrap an object from the serialiser's pointer. Raises :class:`TypeError` if it is not an object."""
    payload = entry["value"]["ptr_wrapper"]["data"]
    if not isinstance(payload, dict):
        raise TypeError(f"{payload!r}")
    return payload


def _lens(lens: dict[str, Any], path: Path, field: str) -> PosedImage:
    """Parse intrinsics, as an unnamed image from the origin."""
    base = lens.get("value0", lens)  # some classes have the pinhole parameters in a nested object
    width, height, focal = int(base["width"]), int(base["height"]), float(base["focal_length"])
    cx, cy = (float(v) for v in base["principal_point"])
    if not (focal > 0 and min(width, height) > 0 and np.isfinite([focal, cx, cy]).all()):
        raise input_error(path, field, (width, height, focal), "positive values", EXPORT_AGAIN)
    camera = Camera(width, height, focal, focal, cx, cy, np.eye(4))
    return PosedImage("", camera, _distortion(lens, path, field))


def _pose(name: str, pose: dict[str, Any], path: Path) -> NDArray[np.float64]:
    """Compute world_from_camera (4, 4). Raises :class:`InputError` if the pose is invalid."""
    camera_from_world = rotation_part(pose["rotation"], path, f"{name}.rotation")
    center = np.array([float(v) for v in pose["center"]])
    if center.shape != (3,) or not np.isfinite(center).all():
        raise input_error(path, f"{name}.center", center, "three numbers", EXPORT_AGAIN)
    return affine(camera_from_world.T, center)


def _distortion(lens: dict[str, Any], path: Path, field: str) -> Distortion | None:
    known = {"disto_k1": 1, "disto_k3": 3, "disto_t2": 5, "fisheye": 4}
    for key, count in known.items():
        if key not in lens:
            continue
        k = tuple(float(v) for v in lens[key])
        if len(k) != count or not np.isfinite(k).all():
            raise input_error(path, f"{field} {key}", lens[key], f"{count} numbers", EXPORT_AGAIN)
        if key == "fisheye":
            return Distortion(model="fisheye", coefficients=k)
        k1, k2, k3, t1, t2 = (*k, 0.0, 0.0, 0.0, 0.0)[:5]
        return polynomial((k1, k2, k3, 0.0), (t1, t2))
    return None

# SPDX-License-Identifier: MIT
"""Reads Bundler's ``bundle.out`` (v0.3) with its ``list.txt``, which many tools export.

A camera consists of f, k1, k2, the rows of the camera_from_world rotation, and the translation. It looks
along -z with y up. A point P in its frame is projected to p = -(P.x, P.y) / P.z, and imaged at f (1 + k1
|p|^2 + k2 |p|^4) p from the image centre, y up. Cameras with f = 0 have no pose. The file contains no image
sizes, so the images are required.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

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
    head_of,
    polynomial,
    read_text,
    rotation_part,
)

_LISTS = ("list.txt", "image_list.txt", "bundle.out.list.txt")


def find(path: Path) -> Path | None:
    """Return the Bundler file ``path``, or the only one in the folder ``path``; None for none or several."""
    files = sorted(path.glob("*.out")) if path.is_dir() else [path] if path.suffix == ".out" else []
    found = [file for file in files if head_of(file).startswith("# Bundle file")]
    return found[0] if len(found) == 1 else None


def read(path: Path, images: Path | None, budget: Budget) -> Calibration:
    """Read the calibration of every camera with a pose. Raises :class:`InputError` with all faults."""
    names = _names(path)
    budget.spend("frames", len(names), "images")
    try:
        words = [line for line in read_text(path).splitlines() if not line.startswith("#")]
        num_cameras = int(words[0].split()[0])
        rows = [[float(word) for word in line.split()] for line in words[1 : 1 + 5 * num_cameras]]
        table = np.array(rows).reshape(num_cameras, 5, 3)
        if not np.isfinite(table).all():
            raise ValueError("NaN or infinite values")
    except (ValueError, IndexError, OverflowError) as error:
        expected = "the number of cameras, then 5 rows of 3 numbers per camera"
        raise input_error(path, "", str(error)[:200], expected, EXPORT_AGAIN) from None
    if len(names) != num_cameras:
        raise input_error(path, "images", len(names), f"{num_cameras} in the list", EXPORT_AGAIN)
    folder = images or path.parent
    finder = ImageFinder(folder)
    reading = Reading(path)
    for name, (lens, *rows_of_rotation, translation) in zip(names, table, strict=True):
        if lens[0] == 0:
            reading.num_unposed += 1
            continue
        with reading.part():
            image = finder.require(name)
            rotation = rotation_part(np.array(rows_of_rotation), path, name)
            width, height = photograph_size(image)
            pose = affine(rotation.T @ np.diag([1.0, -1.0, -1.0]), -rotation.T @ translation)
            focal = float(lens[0])
            camera = Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, pose)
            distortion = polynomial((float(lens[1]), float(lens[2]), 0.0, 0.0), (0.0, 0.0))
            reading.images.append(PosedImage(name, camera, distortion))
    reading.problems += finder.absent(path, reading.missing, UNSIZED)
    nothing = Problem(path, "cameras", "none with a pose", "at least one", EXPORT_AGAIN)
    return reading.calibration(folder, nothing, "cameras have no pose and were left out")


def _names(path: Path) -> list[str]:
    """Read the image names from the list next to the bundle file; lines may end in 0 and a focal length."""
    for name in (f"{path.stem}.list.txt", *_LISTS):
        if (path.parent / name).is_file():
            lines = filter(str.strip, read_text(path.parent / name).splitlines())
            return [re.sub(r"\s+0\s+[\d.eE+-]+$", "", line.strip()) for line in lines]
    raise input_error(path, "", "no list of images beside it", " or ".join(_LISTS), "add it")

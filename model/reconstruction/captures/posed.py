# SPDX-License-Identifier: MIT
"""Common functions and types of the calibration readers, which return images with cameras and distortion.

Each reader converts the convention of its software to that of the project: world_from_camera with x right, y
down, z forward; pixel centres at +0.5; distortion coefficients in OpenCV's order.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.formats.base import MAX_TEXT_BYTES
from datagen.formats.capture import Distortion
from datagen.foundation.budget import Budget
from datagen.foundation.cameras import Camera
from datagen.foundation.documents import parse_xml
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from datagen.foundation.paths import fault_of
from model.reconstruction.captures.photograph_files import (
    KNOWN_SUFFIXES,
    PHOTOGRAPH_SUFFIXES,
    can_read,
    is_raw,
    unread_problems,
)

EXPORT_AGAIN = "export it again"
UNSIZED = "name its folder with --images, since the file does not state the image's size"
_RIGID_TOLERANCE = 1e-3  # files contain rounded numbers
_MAX_SKEW_PX = 0.25  # at the image border; larger skew would need correction, and real lenses have none


@dataclass(frozen=True)
class PosedImage:
    """An image of a calibration: its file name, its camera with pose, and its distortion."""

    file: str
    camera: Camera
    distortion: Distortion | None

    def posed(self, file: str, world_from_camera: NDArray[np.float64]) -> PosedImage:
        """Return the image ``file``, taken through the same lens from the pose ``world_from_camera``."""
        return PosedImage(file, replace(self.camera, world_from_camera=world_from_camera), self.distortion)


@dataclass(frozen=True)
class Calibration:
    """Images of a calibration, the folder to which their names are relative, and notes for the user."""

    images: tuple[PosedImage, ...]
    folder: Path
    notes: tuple[str, ...] = ()


class ImageMissing(Exception):
    """An image of a calibration is missing; readers report it with :meth:`ImageFinder.absent`."""


class ImageFinder:
    """Finds images in a folder by their names in a calibration.

    Names may be absolute paths of another computer, lack a suffix or differ in case. Calibrations are
    untrusted, so files outside the folder, including those behind links, are not found.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def find(self, name: str) -> Path | None:
        """Find the image ``name`` in the folder, or the only one below it with its file name; else None."""
        name = name.replace("\\", "/")
        if not name.isprintable():  # paths with a zero byte raise ValueError
            return None
        direct = self.folder / name  # an absolute name replaces the folder
        suffixes: tuple[str, ...] = PHOTOGRAPH_SUFFIXES
        if direct.suffix.lower() in suffixes:
            suffixes = ("", *suffixes)
        for suffix in suffixes:
            image = self._admitted(f"{name}{suffix}")
            if image is not None and can_read(image):
                return image
        found = [image for image in self._named(name) if can_read(image)]
        found = [image for image in found if not is_raw(image)] or found  # cameras write raw and JPEG at once
        return found[0] if len(found) == 1 else None

    def require(self, name: str) -> Path:
        """Find the image ``name`` as :meth:`find` does. Raises :class:`ImageMissing` if there is none."""
        image = self.find(name)
        if image is None:
            raise ImageMissing(name)
        return image

    def absent(self, where: Path, names: Sequence[str], remedy: str) -> list[Problem]:
        """Return the problems of ``names`` that :meth:`find` did not find: one per unsupported format, and
        one with ``remedy`` per missing image.
        """
        others = self.unread(names)
        expected = f"one image of this name in {self.folder}"
        return unread_problems(where, list(others.values())) + [
            Problem(where, name, "not found", expected, remedy) for name in names if name not in others
        ]

    def unread(self, names: Sequence[str]) -> dict[str, Path]:
        """Return the files in unsupported formats among the images ``names``, by name."""
        named = {name: self._named(name.replace("\\", "/")) for name in names}
        others = {name: [f for f in files if not can_read(f)] for name, files in named.items()}
        return {name: files[0] for name, files in others.items() if files}

    def _admitted(self, name: str) -> Path | None:
        """Return the file with a relative or absolute name if it is in the folder, else None."""
        if not os.path.lexists(self.folder / name):
            return None
        real, _ = fault_of(self.folder, name, (self.folder,))
        return real if real is not None and real.is_file() else None

    def _named(self, name: str) -> list[Path]:
        """Return the images below the folder with the file name of ``name``, in any known format."""
        return self._by_name.get(Path(name).name.lower(), []) if name.isprintable() else []

    @cached_property
    def _by_name(self) -> dict[str, list[Path]]:
        """All images below the folder by lower-case name, with and without suffix."""
        found: dict[str, list[Path]] = {}
        for path in sorted(self.folder.rglob("*")) if self.folder.is_dir() else []:
            is_image = path.suffix.lower() in KNOWN_SUFFIXES
            image = self._admitted(str(path.relative_to(self.folder))) if is_image else None
            if image is not None:
                for key in {path.name.lower(), path.stem.lower()}:
                    found.setdefault(key, []).append(image)
        return found


class Reading:
    """Collects the images and all faults of the calibration file or folder ``where``."""

    def __init__(self, where: Path):
        self.where = where
        self.images: list[PosedImage] = []
        self.problems: list[Problem] = []
        self.missing: list[str] = []
        self.num_unposed = 0

    @contextmanager
    def part(self) -> Iterator[None]:
        """Context manager for reading one part; its faults are collected instead of raised."""
        try:
            yield
        except ImageMissing as error:
            self.missing.append(str(error))
        except InputError as error:
            self.problems += error.problems

    def calibration(self, folder: Path, nothing: Problem, unposed: str = "") -> Calibration:
        """Return the images and, if images lack a pose, a note: their number followed by ``unposed``.

        Raises :class:`InputError` with all faults, or with ``nothing`` if there are no images either.
        """
        raise_problems(self.problems or ([] if self.images else [nothing]))
        notes = (f"{self.num_unposed} {unposed}",) if self.num_unposed else ()
        return Calibration(tuple(self.images), folder, notes)


def read_text(path: Path) -> str:
    """Read a text file. Raises :class:`InputError` if it is unreadable or too large."""
    try:
        if not path.is_file():  # reading a pipe could block
            raise input_error(path, "", "not a regular file", "an export of cameras", EXPORT_AGAIN)
        if path.stat().st_size > MAX_TEXT_BYTES:
            raise input_error(path, "", "a file of over 256 MB", "an export of cameras", EXPORT_AGAIN)
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise input_error(path, "", str(error), "a readable text file", EXPORT_AGAIN) from None


def head_of(path: Path, num_bytes: int = 4096) -> str:
    """Read the first ``num_bytes`` of a file as text, to detect its format; '' if it cannot be read."""
    try:
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return file.read(num_bytes).decode("utf-8", "replace")
    except OSError:
        return ""


def read_xml(path: Path, budget: Budget) -> ElementTree.Element:
    """Read the root element of an XML file. Raises :class:`InputError`."""
    return parse_xml(read_text(path), path, budget, EXPORT_AGAIN)


def numbers(text: str | None, count: int, where: Path, field: str) -> NDArray[np.float64]:
    """Parse ``count`` finite numbers separated by blanks. Raises :class:`InputError`."""
    try:
        values = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise input_error(where, field, repr(text)[:80], f"{count} numbers", EXPORT_AGAIN)
    return values


def rotation_part(matrix: ArrayLike, where: Path, field: str) -> NDArray[np.float64]:
    """Return the rotation nearest to a (3, 3) matrix, ignoring uniform scale.

    Raises :class:`InputError` if the matrix is not a scaled rotation.
    """
    rotation = np.asarray(matrix, dtype=np.float64)
    is_finite = rotation.shape == (3, 3) and bool(np.isfinite(rotation).all())
    scale = float(np.cbrt(abs(np.linalg.det(rotation)))) if is_finite else 0.0
    is_rigid = scale > 0 and np.allclose(
        rotation.T @ rotation / scale**2, np.eye(3), rtol=0, atol=_RIGID_TOLERANCE
    )
    if not is_rigid or np.linalg.det(rotation) < 0:
        raise input_error(where, field, np.array2string(rotation, separator=","), "a rotation", EXPORT_AGAIN)
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt


def polynomial(
    radial: tuple[float, float, float, float], tangential: tuple[float, float]
) -> Distortion | None:
    """Make the distortion with ``radial`` k1 ... k4 (of r^2 ... r^8) and OpenCV's ``tangential`` p1 and p2;
    None if all coefficients are 0.
    """
    k1, k2, k3, k4 = radial
    coefficients = (k1, k2, *tangential, k3, k4)
    return Distortion(model="polynomial", coefficients=coefficients) if any(coefficients) else None


def check_skew(skew_px: float, focal_px: float, height_px: int, where: Path, field: str) -> None:
    """Raise :class:`InputError` if a skew, which shifts u by ``skew_px`` y / z, matters at the border."""
    if abs(skew_px) * 0.5 * height_px / focal_px > _MAX_SKEW_PX:
        remedy = "calibrate without skew (b2 = 0), or export undistorted images"
        raise input_error(where, field, skew_px, "no skew", remedy)

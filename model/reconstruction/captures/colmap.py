# SPDX-License-Identifier: MIT
"""Reads COLMAP models: ``cameras`` and ``images`` (text or binary), and lines of sight from ``points3D.bin``.

COLMAP stores camera_from_world as a quaternion (w, x, y, z) and a translation. Its cameras look along +z with
y down, and pixel centres are at +0.5, as in this project. Its world frame is arbitrary.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import Distortion
from datagen.foundation.axes import affine
from datagen.foundation.budget import Budget
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import InputError, Problem, input_error
from model.reconstruction.captures.posed import Calibration, PosedImage, Reading, read_text

MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
)  # fmt: skip
"""Name and number of parameters of each lens model, indexed by COLMAP's model id."""
_SUPPORTED = {name for name, _ in MODELS} - {"FOV", "THIN_PRISM_FISHEYE"}
_REMEDY = "export the model again (colmap model_converter)"
_UNDISTORT = "undistort the images (colmap image_undistorter), or calibrate with one of these"
_UNSUPPORTED = "PINHOLE, RADIAL, OPENCV, FULL_OPENCV, OPENCV_FISHEYE, RADIAL_FISHEYE or a SIMPLE_ one"


@dataclass(frozen=True)
class Sights:
    """K lines of sight from V cameras at ``centers`` (V, 3) to N ``points`` (N, 3); the indices ``camera``
    (K,) and ``point`` (K,) define the ends of each line.
    """

    points: NDArray[np.float64]
    centers: NDArray[np.float64]
    camera: NDArray[np.int64]
    point: NDArray[np.int64]


@dataclass(frozen=True)
class _Lens:
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


def find(path: Path) -> Path | None:
    """Return the folder of a model, ``path`` or its subfolder ``sparse`` or ``sparse/0``, or None."""
    for model in (path, path / "sparse", path / "sparse" / "0"):
        if any(all((model / f"{n}{s}").is_file() for n in ("cameras", "images")) for s in (".bin", ".txt")):
            return model
    return None


def read(path: Path, images: Path | None, budget: Budget) -> Calibration:
    """Read the calibration of every registered image, sorted by file name, from binary files if possible.

    ``images`` defaults to the folder ``images`` in ``path``, its parent or its grandparent. Raises
    :class:`InputError` with all faults.
    """
    if all((path / name).is_file() for name in ("cameras.bin", "images.bin")):
        lenses = _read_binary_cameras(path / "cameras.bin", budget)
        poses = {name: values[1:] for name, values in _binary_images(path / "images.bin", budget)}
        where, cameras = path / "images.bin", path / "cameras.bin"
    else:
        lenses = _read_text_cameras(path / "cameras.txt", budget)
        poses = _read_text_images(path / "images.txt", budget)
        where, cameras = path / "images.txt", path / "cameras.txt"
    reading = Reading(where)
    usable: dict[int, PosedImage | None] = {}
    for lens_id in sorted({lens_id for lens_id, _, _ in poses.values()} & set(lenses)):
        usable[lens_id] = None
        with reading.part():
            usable[lens_id] = _image_at_origin(lenses[lens_id], cameras, f"camera {lens_id}")
    for name, (lens_id, quaternion, translation) in sorted(poses.items()):
        if lens_id not in lenses:
            reading.problems.append(
                Problem(where, name, f"camera {lens_id}", "a camera of the model", _REMEDY)
            )
            continue
        with reading.part():
            lens, pose = usable[lens_id], _pose(name, quaternion, translation, where)
            reading.images += [] if lens is None else [lens.posed(name, pose)]
    nothing = Problem(where, "", "no images", "at least one registered image", _REMEDY)
    candidates = (path / "images", path.parent / "images", path.parent.parent / "images")
    return reading.calibration(images or next((f for f in candidates if f.is_dir()), candidates[0]), nothing)


def _pose(name: str, quaternion: NDArray, translation: NDArray, where: Path) -> NDArray[np.float64]:
    """Compute world_from_camera (4, 4). Raises :class:`InputError` if the pose is invalid."""
    length = float(np.linalg.norm(quaternion))
    if not (np.isfinite(length) and length > 1e-6 and np.isfinite(translation).all()):
        raise input_error(where, name, f"quaternion {quaternion.tolist()}", "a rotation", _REMEDY)
    rotation = rotation_of(quaternion / length)
    return affine(rotation.T, -rotation.T @ translation)


def rotation_of(quaternion: NDArray) -> NDArray[np.float64]:
    """Compute the rotation matrix (3, 3) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = (float(q) for q in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _image_at_origin(lens: _Lens, where: Path, field: str) -> PosedImage:
    """Convert a COLMAP lens to an unnamed image from the origin.

    Raises :class:`InputError`, which names ``field``, for unsupported models and invalid parameters.
    """
    model, p = lens.model, lens.parameters
    if model not in _SUPPORTED:
        raise input_error(where, f"{field} model", model, _UNSUPPORTED, _UNDISTORT)
    num_focal = 1 if model.startswith(("SIMPLE", "RADIAL")) else 2
    focal = (p[0], p[0]) if num_focal == 1 else (p[0], p[1])
    center, k = p[num_focal : num_focal + 2], p[num_focal + 2 :]
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        k = (k[0], k[1] if len(k) > 1 else 0.0, 0.0, 0.0)
    kind = "fisheye" if "FISHEYE" in model else "brown"
    if not (min(focal) > 0 and np.isfinite([*focal, *center, *k]).all()):
        raise input_error(where, f"{field} parameters", p, "finite values, focal lengths above 0", _REMEDY)
    distortion = Distortion(model=kind, coefficients=k) if any(k) else None  # type: ignore[arg-type]
    (fx, fy), (cx, cy) = focal, center
    return PosedImage("", Camera(lens.width, lens.height, fx, fy, cx, cy, np.eye(4)), distortion)


def _lines(path: Path) -> list[str]:
    return [line.strip() for line in read_text(path).splitlines() if not line.startswith("#")]


def _read_text_cameras(path: Path, budget: Budget) -> dict[int, _Lens]:
    lenses = {}
    counts = dict(MODELS)
    for line in filter(None, _lines(path)):
        budget.spend("nodes", 1, "cameras")
        words = line.split()
        try:
            parameters = tuple(float(word) for word in words[4:])
            lens = _Lens(words[1], int(words[2]), int(words[3]), parameters)
            lens_id = int(words[0])
        except (ValueError, IndexError):
            raise input_error(path, "line", line[:80], "ID MODEL WIDTH HEIGHT PARAMETERS", _REMEDY) from None
        if counts.get(lens.model, len(parameters)) != len(parameters) or min(lens.width, lens.height) <= 0:
            expected = "a size, and as many parameters as its model has"
            raise input_error(path, f"camera {words[0]}", line[:80], expected, _REMEDY)
        lenses[lens_id] = lens
    return lenses


def _read_text_images(path: Path, budget: Budget) -> dict[str, tuple[int, NDArray, NDArray]]:
    lines = _lines(path)
    while lines and not lines[0]:
        lines.pop(0)
    poses = {}
    for line in lines[::2]:  # the second line of each image lists its points and may be empty
        words = line.split(maxsplit=9)
        if not words:
            continue
        budget.spend("frames", 1, "images")
        try:
            values = np.array([float(word) for word in words[1:8]])
            poses[words[9]] = (int(words[8]), values[:4], values[4:])
        except (ValueError, IndexError):
            expected = "ID QW QX QY QZ TX TY TZ CAMERA NAME, and a line of points after it"
            raise input_error(path, "line", line[:80], expected, _REMEDY) from None
    return poses


class _Cursor:
    """Reads little-endian values from a file's bytes."""

    def __init__(self, path: Path):
        self.path, self.offset = path, 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise input_error(path, got=str(error), expected="a readable file", remedy=_REMEDY) from None

    def take(self, form: str) -> tuple:
        """Read the values of the ``struct`` format ``form``."""
        try:
            values = struct.unpack_from(f"<{form}", self.data, self.offset)
        except struct.error:
            raise self.short() from None
        self.offset += struct.calcsize(f"<{form}")
        return values

    def text(self) -> str:
        """Read a string that ends in a zero byte."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.short()
        value = self.data[self.offset : end].decode("utf-8", "replace")
        self.offset = end + 1
        return value

    def short(self) -> InputError:
        """Return the error for a truncated file."""
        return input_error(self.path, "", "the file ends early", "a whole file", _REMEDY)


def _read_binary_cameras(path: Path, budget: Budget) -> dict[int, _Lens]:
    cursor = _Cursor(path)
    lenses = {}
    for _ in range(cursor.take("Q")[0]):
        budget.spend("nodes", 1, "cameras")
        lens_id, model, width, height = cursor.take("iiQQ")
        if not 0 <= model < len(MODELS):
            raise input_error(path, f"camera {lens_id} model", model, _UNSUPPORTED, _UNDISTORT)
        name, count = MODELS[model]
        lenses[lens_id] = _Lens(name, width, height, cursor.take(f"{count}d"))
    return lenses


def _binary_images(path: Path, budget: Budget) -> Iterator[tuple[str, tuple[int, int, NDArray, NDArray]]]:
    """Yield the name and (image id, camera id, quaternion, translation) of each image."""
    cursor = _Cursor(path)
    for _ in range(cursor.take("Q")[0]):
        budget.spend("frames", 1, "images")
        values = cursor.take("i7di")
        name = cursor.text()
        cursor.take(f"{cursor.take('Q')[0] * 24}x")  # per feature: x and y as doubles, and a point id
        yield name, (values[0], values[8], np.array(values[1:5]), np.array(values[5:8]))


def read_sights(folder: Path, budget: Budget, max_error_px: float) -> Sights:
    """Read the lines of sight to those points of a binary model that have a mean reprojection error of at
    most ``max_error_px``. Raises :class:`InputError`.
    """
    where = folder / "images.bin"
    images = [
        (image_id, _pose(name, quaternion, translation, where)[:3, 3])
        for name, (image_id, _, quaternion, translation) in _binary_images(where, budget)
    ]
    row_of = {image_id: row for row, (image_id, _) in enumerate(images)}
    cursor = _Cursor(folder / "points3D.bin")
    points: list[tuple[float, ...]] = []
    camera: list[int] = []
    point: list[int] = []
    for _ in range(cursor.take("Q")[0]):
        budget.spend("nodes", 1, "points")
        _, *position, _, _, _, error, length = cursor.take("Q3d3BdQ")
        shown_in = cursor.take(f"{2 * length}i")[::2]
        if error <= max_error_px and np.isfinite(position).all():
            camera += [row_of[image_id] for image_id in shown_in]
            point += [len(points)] * length
            points.append(tuple(position))
    return Sights(
        np.array(points).reshape(-1, 3),
        np.array([center for _, center in images]).reshape(-1, 3),
        np.array(camera, np.int64),
        np.array(point, np.int64),
    )

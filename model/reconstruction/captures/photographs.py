# SPDX-License-Identifier: MIT
"""Reads photographs as images of a capture: decoded, upright, linearised, resized and undistorted.

Pixel centres are at +0.5 (``foundation.cameras``), but at integers in OpenCV, so OpenCV's principal point is
ours minus 0.5. Linearisation precedes any resampling.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import ColorImage, Distortion
from datagen.foundation.cameras import Camera
from datagen.foundation.color import linear_from_srgb
from datagen.foundation.encodings import Encoding
from datagen.foundation.errors import InputError, Problem, input_error
from datagen.foundation.images import normalized
from model.reconstruction.captures.options import Exposure
from model.reconstruction.captures.photograph_files import (
    is_raw,
    photograph_size,
    pillow_formats,
    read_photograph,
)
from model.reconstruction.captures.raw_photographs import raw_exposure

PAPER_GAMMA = 2.2
CLIPPED_LEVEL = 0.96
"""Linear value from which a pixel counts as clipped; JPEG stores clipped pixels a few steps below 1."""
MIN_CLIPPED_SHARE = 0.02
"""Share of clipped pixels in a resampled pixel above which it counts as clipped."""
_EXIF_ORIENTATION, _EXIF_IFD = 0x0112, 0x8769
_EXPOSURE_TIME, _F_NUMBER, _ISO = 0x829A, 0x829D, 0x8827
_QUARTER_TURNS = {3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}  # clockwise, to turn a stored image upright
_ASPECT_SLACK_PX = 1.0  # calibrations round sizes differently


@dataclass(frozen=True)
class PhotographSource:
    """A photograph on disk and its ``calibrated`` camera; ``exposure_scale`` multiplies linear values."""

    path: Path
    calibrated: Camera
    distortion: Distortion | None
    encoding: Encoding
    exposure_scale: float = 1.0

    def read(self, camera: Camera) -> ColorImage:
        """Read the photograph and resample it to ``camera``, a pinhole camera with the same pose."""
        stored, at_limit = read_photograph(self.path)
        pixels = fit_orientation(stored, self.path, self.calibrated)
        linear = linearized(pixels, self.encoding if at_limit is None else "linear")
        if not np.isfinite(linear).all():
            raise input_error(self.path, "pixels", "NaN or Inf", "finite values", "export the image again")
        has_limit = pixels.dtype.kind == "u"  # float images have no known limit
        clipped = linear >= CLIPPED_LEVEL if has_limit else None
        if clipped is not None and at_limit is not None:
            clipped = clipped | at_limit[..., None]
        linear *= np.float32(self.exposure_scale)
        found = undistorted(linear, self.calibrated, self.distortion, camera, clipped)
        return replace(found, limit=self.exposure_scale) if has_limit else found

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        """Return an empty dictionary, since photographs have no ground truth."""
        return {}


def exif_orientation(path: Path) -> int:
    """Read the EXIF orientation, 1 to 8; 1 if absent. Raises :class:`InputError` for an unreadable file."""
    if path.suffix.lower() == ".exr" or is_raw(path):
        return 1
    from PIL import Image

    try:
        with Image.open(path, formats=pillow_formats(path)) as image:
            value = int(image.getexif().get(_EXIF_ORIENTATION, 1))
    except Exception as error:  # Pillow may raise any exception of its parsers
        raise input_error(path, "EXIF", str(error)[:200], "a readable image", "export it again") from None
    return value if 1 <= value <= 8 else 1


def relative_exposure(path: Path) -> float | None:
    """Read the relative exposure, time in s * ISO / f-number^2, from EXIF; None if a value is missing."""
    if is_raw(path):
        return raw_exposure(path)
    from PIL import Image

    try:
        with Image.open(path, formats=pillow_formats(path)) as image:
            tags = image.getexif().get_ifd(_EXIF_IFD)
            values = [tags.get(tag) for tag in (_EXPOSURE_TIME, _F_NUMBER, _ISO)]
            values = [value[0] if isinstance(value, tuple) else value for value in values]
            time_s, f_number, iso = (float(value) for value in values if value is not None)
        relative = time_s * iso / f_number**2
    except Exception:  # unreadable EXIF counts as missing, and Pillow may raise any exception of its parsers
        return None
    return relative if f_number > 0 and np.isfinite(relative) and relative > 0 else None


def exposure_scales(images: Sequence[Path], exposure: Exposure) -> list[float]:
    """Compute the factor that compensates for the recorded exposure of each photograph, 1 at the median.

    All factors are 1 if ``exposure`` is "common", or if it is "auto" and a photograph lacks the EXIF values.
    Raises :class:`InputError` with all photographs that lack them if ``exposure`` is "exif".
    """
    recorded = [None if exposure == "common" else relative_exposure(image) for image in images]
    problems = [
        Problem(image, "EXIF", "no exposure time, aperture or ISO", "all three", "use --exposure common")
        for image, value in zip(images, recorded, strict=True)
        if value is None
    ]
    if problems and exposure == "exif":
        raise InputError(*problems)
    if problems:
        return [1.0] * len(recorded)
    values = np.array(recorded, dtype=np.float64)
    return [float(value) for value in np.median(values) / values]


def upright(pixels: NDArray, orientation: int) -> NDArray:
    """Rotate and flip ``pixels`` (H, W, C) upright according to their EXIF ``orientation`` (1 to 8)."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.transpose(1, 0, 2)
    flips = {2: (1,), 3: (0, 1), 4: (0,), 6: (1,), 7: (0, 1), 8: (0,)}.get(orientation, ())
    return np.ascontiguousarray(np.flip(pixels, flips)) if flips else np.ascontiguousarray(pixels)


def _has_aspect_of(width: int, height: int, camera: Camera) -> bool:
    return abs(width * camera.height_px - height * camera.width_px) <= _ASPECT_SLACK_PX * camera.width_px


def fit_orientation(pixels: NDArray, path: Path, camera: Camera) -> NDArray:
    """Return the image (H, W, C) as stored, or upright if only that has the camera's aspect ratio.

    Calibration tools differ in whether they apply the EXIF orientation. Raises :class:`InputError` if neither
    image has the camera's aspect ratio.
    """
    if _has_aspect_of(pixels.shape[1], pixels.shape[0], camera):
        return pixels
    turned = upright(pixels, exif_orientation(path))
    if _has_aspect_of(turned.shape[1], turned.shape[0], camera):
        return turned
    got = f"{pixels.shape[1]}x{pixels.shape[0]}"
    expected = f"the aspect ratio of its camera, {camera.width_px}x{camera.height_px}"
    raise input_error(path, "size", got, expected, "use the calibrated images, uncropped")


def upright_pose(camera: Camera, path: Path) -> NDArray[np.float64]:
    """Compute world_from_camera (4, 4) of ``camera`` with the photograph ``path`` turned upright.

    It differs from the camera's if EXIF turns the photograph and the camera was calibrated on stored pixels.
    """
    pose = camera.world_from_camera.copy()
    turns = _QUARTER_TURNS.get(exif_orientation(path), 0)
    if turns and _has_aspect_of(*photograph_size(path), camera):
        pose[:3, :2] = pose[:3, :2] @ np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), turns)
    return pose


def linearized(pixels: NDArray, encoding: Encoding) -> NDArray[np.float32]:
    """Convert stored pixels (H, W, C) to linear Rec.709 (H, W, 3), at least 0; alpha is dropped."""
    values = normalized(pixels)
    values = values[..., :3] if values.shape[2] >= 3 else np.repeat(values[..., :1], 3, axis=2)
    if encoding == "auto":
        encoding = "srgb" if pixels.dtype.kind == "u" else "linear"
    if encoding == "srgb":
        values = linear_from_srgb(values)
    elif encoding == "gamma22":
        values = np.maximum(values, 0.0) ** PAPER_GAMMA
    return np.ascontiguousarray(np.maximum(values, 0.0), dtype=np.float32)


def undistorted(
    linear: NDArray[np.float32],
    calibrated: Camera,
    distortion: Distortion | None,
    camera: Camera,
    clipped: NDArray[np.bool_] | None = None,
) -> ColorImage:
    """Resample a ``linear`` image (H, W, 3) and its mask ``clipped`` (H, W, 3) from the ``calibrated`` lens
    to the pinhole ``camera``.

    The image is first resized to the camera's size, by area averaging if it shrinks, to prevent aliasing.
    """
    import cv2

    size = (camera.width_px, camera.height_px)
    share = None if clipped is None else clipped.astype(np.float32)
    if (linear.shape[1], linear.shape[0]) != size:
        is_smaller = linear.shape[1] > size[0]
        how = cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
        linear = np.asarray(cv2.resize(linear, size, interpolation=how), np.float32)
        share = None if share is None else np.asarray(cv2.resize(share, size, interpolation=how))
    scaled = calibrated.scaled(*size)
    same = np.allclose(_intrinsics(scaled), _intrinsics(camera), rtol=0, atol=1e-9)
    if distortion is None and same:
        return ColorImage(linear, np.ones(linear.shape[:2], dtype=bool), _is_clipped(share))
    x, y = _distorted_pixels(scaled, distortion, camera)
    valid = (x >= -0.5) & (y >= -0.5) & (x <= size[0] - 0.5) & (y <= size[1] - 0.5)
    border = cv2.BORDER_REPLICATE
    color = np.asarray(cv2.remap(linear, x, y, cv2.INTER_LINEAR, borderMode=border), np.float32)
    color[~valid] = 0
    if share is not None:
        share = np.asarray(cv2.remap(share, x, y, cv2.INTER_LINEAR, borderMode=border)) * valid[..., None]
    return ColorImage(color, valid, _is_clipped(share))


def _is_clipped(share: NDArray | None) -> NDArray[np.bool_] | None:
    return None if share is None else share > MIN_CLIPPED_SHARE


def _intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px


def _distorted_pixels(
    lens: Camera, distortion: Distortion | None, camera: Camera
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute x and y (H, W) in the lens image of the pixels of ``camera``, centres at integers (OpenCV)."""
    size = (camera.width_px, camera.height_px)
    u, v = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = np.stack([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px], axis=-1)
    x, y = np.moveaxis(lens_pixels(lens, distortion, rays) - 0.5, -1, 0)
    folded = _is_beyond_fold(distortion, np.hypot(rays[..., 0], rays[..., 1]))
    return np.where(folded, np.float32(-1e6), x.astype(np.float32)), y.astype(np.float32)


def lens_pixels(lens: Camera, distortion: Distortion | None, rays: NDArray) -> NDArray[np.float64]:
    """Project the rays (x / z, y / z) (..., 2) through a lens to pixels (..., 2), with centres at +0.5."""
    x, y = np.moveaxis(np.asarray(rays, dtype=np.float64), -1, 0)
    if distortion is not None and distortion.model == "fisheye":
        r = np.hypot(x, y)
        bent = _distorted_radius(distortion, r)
        scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)  # the centre stays fixed
        x, y = x * scale, y * scale
    elif distortion is not None:
        r2, factor = x * x + y * y, _radial(distortion, x * x + y * y)
        p1, p2 = (*distortion.coefficients, 0.0, 0.0, 0.0, 0.0)[2:4]
        x, y = (
            x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
    return np.stack([lens.fx_px * x + lens.cx_px, lens.fy_px * y + lens.cy_px], axis=-1)


def _distorted_radius(distortion: Distortion, r: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the radii to which a lens without tangential distortion maps the radii ``r``, of any shape."""
    if distortion.model != "fisheye":
        return r * _radial(distortion, r**2)
    theta = np.arctan(r)
    k = np.zeros(4)
    k[: len(distortion.coefficients)] = distortion.coefficients
    t = theta**2
    return theta * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))))


def _radial(distortion: Distortion, r2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the radial factor of a brown or polynomial lens at squared radii ``r2``, of the same shape."""
    k = np.zeros(8)
    k[: len(distortion.coefficients)] = distortion.coefficients
    if distortion.model == "polynomial":
        return 1 + r2 * (k[0] + r2 * (k[1] + r2 * (k[4] + r2 * k[5])))
    numerator = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    return numerator / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))


def _is_beyond_fold(distortion: Distortion | None, r: NDArray) -> NDArray[np.bool_]:
    """Compute the mask of radii ``r`` beyond the maximum of the distorted radius, where the image repeats."""
    if distortion is None:
        return np.zeros(r.shape, dtype=bool)
    steps = np.linspace(0.0, max(float(r.max()), 1e-6), 512)
    turns = np.flatnonzero(np.diff(_distorted_radius(distortion, steps)) <= 0)
    return r > steps[turns[0]] if turns.size else np.zeros(r.shape, dtype=bool)

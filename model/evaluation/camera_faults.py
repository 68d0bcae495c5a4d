# SPDX-License-Identifier: MIT
"""Simulated faults of cameras, applied to rendered photographs to measure their effect on a method.

The faults are applied in the order of a camera's pipeline. The lens distorts (``distortion``: the uncorrected
k1 on normalised coordinates) and darkens the corners (``vignetting_stops``). Exposures, which methods do not
receive, vary between images with a standard deviation of ``exposure_stops``. Photon noise
(``white_electrons`` at saturation) and read noise (``read_electrons``) are added. Values above saturation are
clipped; before exposures vary, this is the share ``clipped_share`` of the pixels of all images. Values of 14
``bits`` are linear; others are encoded by a tone curve steeper than sRGB's (``contrast``), in 8 bits or
unquantised, optionally compressed as JPEG of quality ``jpeg``, and decoded as sRGB, as in ``materials
infer``. Camera poses have errors of ``pose_mm`` along each axis and ``pose_deg`` about a random axis
(standard deviations), and the mesh has the errors of ``geometry`` unless the method defines others.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from datagen.formats.base import NonNegative, Positive, Slug, StrictModel
from datagen.formats.capture import Capture, ColorImage, ImageSource
from datagen.foundation.cameras import Camera
from datagen.foundation.color import linear_from_srgb, srgb_from_linear
from datagen.foundation.errors import input_error
from datagen.foundation.images import encode_jpeg
from datagen.foundation.random import digest
from datagen.foundation.tables import read_table
from model.evaluation.mesh_errors import GeometryError
from model.reconstruction.captures.photographs import CLIPPED_LEVEL

_EVERY = 7  # stride of the pixels from which the common exposure is computed
_LARGEST_CONTRAST = 0.15  # above 1 / 2 pi the curve is not monotonic


class CameraFaults(StrictModel):
    """Faults of photographs, explained in the module's docstring; ``seed`` seeds all random faults."""

    name: Slug
    bits: Literal[8, 14] | None = None
    exposure_stops: NonNegative = 0.0
    clipped_share: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    contrast: Annotated[float, Field(ge=0, le=_LARGEST_CONTRAST)] = 0.0
    white_electrons: Positive | None = None
    read_electrons: NonNegative = 0.0
    vignetting_stops: NonNegative = 0.0
    distortion: Annotated[float, Field(ge=-0.2, le=0.2)] = 0.0
    jpeg: Annotated[int, Field(ge=1, le=100)] | None = None
    pose_mm: NonNegative = 0.0
    pose_deg: NonNegative = 0.0
    geometry: GeometryError | None = None
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    @model_validator(mode="after")
    def _is_a_camera(self) -> CameraFaults:
        faults = []
        if self.jpeg is not None and self.bits != 8:
            faults.append("bits: 8 with jpeg")
        if self.contrast and self.bits == 14:
            faults.append("no contrast with bits: 14, which are linear")
        if self.read_electrons and self.white_electrons is None:
            faults.append("white_electrons with read_electrons")
        if faults:
            raise ValueError("expected " + "; ".join(faults))
        return self


_FAULTS = read_table(__file__, "cameras.yaml", dict[str, dict[str, Any]])
PRESETS = {
    name: CameraFaults.model_validate({"name": name, **fields})
    for name, fields in {**_FAULTS["single"], **_FAULTS["combined"]}.items()
}
"""Camera faults by name: each fault separately, and three combinations."""
EACH = "each"
"""Value of a suite's ``camera`` that selects all presets with a single fault."""


def chosen_cameras(names: Sequence[str | CameraFaults]) -> tuple[CameraFaults, ...]:
    """Camera faults selected by a suite's ``camera``. Raises ``ValueError`` for unknown or repeated names."""
    found: list[CameraFaults] = []
    for name in names:
        if isinstance(name, CameraFaults):
            found.append(name)
        elif name == EACH:
            found += [PRESETS[single] for single in _FAULTS["single"]]
        elif name in PRESETS:
            found.append(PRESETS[name])
        else:
            raise ValueError(f"expected {EACH}, {', '.join(PRESETS)} or custom faults, not {name!r}")
    known = [camera.name for camera in found]
    if len(set(known)) != len(known):
        raise ValueError("expected every camera to have its own name")
    return tuple(found)


def as_taken(capture: Capture, faults: CameraFaults) -> Capture:
    """Return ``capture`` with images and poses altered by ``faults``; mesh and true maps are unchanged.

    Raises :class:`InputError` for barrel distortion so strong that no ray reaches the corners of a view.
    """
    if faults.distortion < 0:
        # the distorted radius r + k1 r^3 is at most 2 / sqrt(27 |k1|)
        least = -4 / (27 * max(_corner_radius(view.camera) for view in capture.views) ** 2)
        if faults.distortion < least:
            expected = f"at least {least:.3g} for these fields of view"
            where, remedy = f"camera {faults.name}", "choose a weaker one"
            raise input_error(where, "distortion", faults.distortion, expected, remedy)
    scale = 1.0 / _limit(capture, faults.clipped_share)
    views = tuple(
        replace(
            view,
            camera=_moved(view.camera, faults, view.name),
            source=_Taken(view.source, view.camera, view.name, faults, scale),
        )
        for view in capture.views
    )
    return replace(capture, views=views)


def _limit(capture: Capture, clipped_share: float) -> float:
    """Radiance at saturation, which the share ``clipped_share`` of the capture's pixels exceeds."""
    bright = [view.read().color.max(axis=2).ravel()[::_EVERY] for view in capture.views]
    limit = float(np.quantile(np.concatenate(bright), 1.0 - clipped_share))
    return limit if limit > 0 else 1.0


def _random(faults: CameraFaults, view: str, purpose: str) -> np.random.Generator:
    """Random generator for one purpose in one view, independent of those for other purposes and views."""
    return np.random.default_rng(int.from_bytes(digest(faults.seed, view, purpose)[:8], "little"))


def _moved(camera: Camera, faults: CameraFaults, view: str) -> Camera:
    if not faults.pose_mm and not faults.pose_deg:
        return camera
    random = _random(faults, view, "pose")
    pose = camera.world_from_camera.copy()
    pose[:3, 3] += random.normal(0.0, faults.pose_mm / 1000, 3)
    axis = random.normal(size=3)
    angle = np.radians(random.normal(0.0, faults.pose_deg))
    rotation = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    pose[:3, :3] = pose[:3, :3] @ rotation
    return replace(camera, world_from_camera=pose)


@dataclass(frozen=True)
class _Taken:
    """Image source of a view with faults; ``scale`` is 1 / (radiance at saturation)."""

    source: ImageSource
    true_camera: Camera
    view: str
    faults: CameraFaults
    scale: float

    def read(self, camera: Camera) -> ColorImage:
        true = self.source.read(replace(camera, world_from_camera=self.true_camera.world_from_camera))
        color = photographed(true.color.astype(np.float64) * self.scale, camera, self.faults, self.view)
        read = (color / self.scale).astype(np.float32)
        return ColorImage(read, true.valid_mask, color >= CLIPPED_LEVEL, 1.0 / self.scale)

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        return self.source.read_maps(names)


def photographed(color: NDArray, camera: Camera, faults: CameraFaults, view: str = "") -> NDArray[np.float64]:
    """Apply the image faults to linear ``color`` (H, W, 3), which saturates at 1; the result is linear."""
    random = _random(faults, view, "image")
    if faults.distortion:
        color = _distorted(color, camera, faults.distortion)
    color = color * 2.0 ** (faults.exposure_stops * random.normal())
    if faults.vignetting_stops:
        color = color * 2.0 ** (-faults.vignetting_stops * _radius_squared(camera))[..., None]
    if faults.white_electrons is not None:
        electrons = random.poisson(np.clip(color, 0, 4) * faults.white_electrons).astype(np.float64)
        color = (electrons + random.normal(0.0, faults.read_electrons, color.shape)) / faults.white_electrons
    color = np.clip(color, 0.0, 1.0)
    if faults.bits == 14:
        return np.round(color * (2**14 - 1)) / (2**14 - 1)
    encoded = np.asarray(srgb_from_linear(color), np.float64)
    encoded = encoded - faults.contrast * np.sin(2 * np.pi * encoded)
    if faults.bits == 8:
        encoded = np.round(encoded * 255) / 255
    if faults.jpeg is not None:
        encoded = _as_jpeg(encoded, faults.jpeg)
    return np.asarray(linear_from_srgb(encoded), np.float64)


def _radius_squared(camera: Camera) -> NDArray[np.float64]:
    """Squared distance (H, W) of each pixel from the image centre, scaled to 1 at the corners."""
    x = (np.arange(camera.width_px) + 0.5 - 0.5 * camera.width_px) / (0.5 * camera.width_px)
    y = (np.arange(camera.height_px) + 0.5 - 0.5 * camera.height_px) / (0.5 * camera.height_px)
    return np.asarray(0.5 * (x[None] ** 2 + y[:, None] ** 2))


def _corner_radius(camera: Camera) -> float:
    """Distance of the image's farthest corner from the principal point, in normalised coordinates."""
    x = max(camera.cx_px, camera.width_px - camera.cx_px) / camera.fx_px
    y = max(camera.cy_px, camera.height_px - camera.cy_px) / camera.fy_px
    return float(np.hypot(x, y))


def _distorted(color: NDArray, camera: Camera, k1: float) -> NDArray[np.float64]:
    """Distort an image (H, W, 3) by x' = x (1 + k1 r^2) in normalised coordinates; border pixels repeat."""
    import cv2

    x = (np.arange(camera.width_px) + 0.5 - camera.cx_px) / camera.fx_px
    y = (np.arange(camera.height_px) + 0.5 - camera.cy_px) / camera.fy_px
    bent_x, bent_y = np.meshgrid(x, y)
    bent = np.hypot(bent_x, bent_y)
    true = bent.copy()
    for _ in range(10):  # Newton's method, monotonic for both signs of k1
        true -= (true + k1 * true**3 - bent) / (1 + 3 * k1 * true**2)
    stretch = np.divide(true, bent, out=np.ones_like(bent), where=bent > 0)
    true_x, true_y = bent_x * stretch, bent_y * stretch
    columns = (true_x * camera.fx_px + camera.cx_px - 0.5).astype(np.float32)
    rows = (true_y * camera.fy_px + camera.cy_px - 0.5).astype(np.float32)
    image = np.ascontiguousarray(color, np.float32)
    made = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(made, np.float64)


def _as_jpeg(encoded: NDArray, quality: int) -> NDArray[np.float64]:
    from PIL import Image

    data = encode_jpeg(np.round(encoded * 255).astype(np.uint8), quality)
    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image, np.float64) / 255

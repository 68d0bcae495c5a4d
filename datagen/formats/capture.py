# SPDX-License-Identifier: MIT
"""Captures: one representation for the views of a rendered configuration and of a photographed room.

A capture consists of cameras, images and geometry. In memory it is a :class:`Capture`, whose images are read
on demand; on disk, ``capture.json`` (:class:`CaptureFile`) lists images, cameras with distortion, and the
mesh. World: metres, right-handed, Z up; ``foundation.cameras`` defines the other conventions. Images are (H,
W, 3), linear Rec.709, row 0 at the top; all views of a capture share one exposure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from datagen.formats.base import IDENTITY4, Matrix4, Positive, Slug, StrictModel, check_unique
from datagen.formats.configuration import ViewCamera
from datagen.formats.lights import Light
from datagen.foundation.cameras import Camera
from datagen.foundation.encodings import Encoding
from datagen.foundation.errors import InputError, Problem
from datagen.foundation.meshes.mesh import Mesh

CAPTURE_FILE = "capture.json"


class Distortion(StrictModel):
    """Lens distortion in OpenCV's form, on normalised image coordinates.

    The coefficients are k1 k2 p1 p2 k3 k4 k5 k6 for ``brown``, k1 k2 k3 k4 for ``fisheye``, and k1 k2 p1 p2
    k3 k4 for ``polynomial``, which has no denominator: k4 multiplies r^8, as in RealityCapture and Metashape.
    Missing coefficients are 0.
    """

    model: Literal["brown", "polynomial", "fisheye"]
    coefficients: Annotated[tuple[float, ...], Field(min_length=1, max_length=8)]

    @model_validator(mode="after")
    def _fits_the_model(self) -> Distortion:
        limit = {"brown": 8, "polynomial": 6, "fisheye": 4}[self.model]
        if len(self.coefficients) > limit:
            raise ValueError(f"expected at most {limit} coefficients of a {self.model} lens")
        return self


class PhotographRecord(StrictModel):
    """One photograph and its calibrated camera, before undistortion.

    ``image``: path, absolute or relative to ``capture.json``. ``exposure_scale``: factor that scales the
    linear image to the common exposure of all views.
    """

    camera: ViewCamera
    image: str
    distortion: Distortion | None = None
    exposure_scale: Positive = 1.0


class MeshRecord(StrictModel):
    """Path of the mesh file (PLY, OBJ, glTF, GLB) and the transform from its frame to the cameras' world."""

    file: str
    world_from_mesh: Matrix4 = IDENTITY4


class CaptureFile(StrictModel):
    """Content of ``capture.json``.

    ``encoding``: transfer function of the images' values. ``auto`` is sRGB for integer images (PNG, JPEG,
    TIFF) and linear for EXR; ``gamma22``, a power of 2.2, is assumed by Prakash et al. 2022 for photographs.
    ``lights``, if known, illuminate renderings of the result.
    """

    format: Literal["scene-materials/capture"] = "scene-materials/capture"
    version: Literal[1] = 1
    name: Slug
    encoding: Encoding = "auto"
    photographs: Annotated[tuple[PhotographRecord, ...], Field(min_length=1)]
    mesh: MeshRecord
    lights: tuple[Light, ...] = ()

    @model_validator(mode="after")
    def _names_are_unique(self) -> CaptureFile:
        check_unique("the views", [photograph.camera for photograph in self.photographs])
        return self


@dataclass(frozen=True)
class ColorImage:
    """An image of a view and its masks.

    ``color`` (H, W, 3) float32 linear; ``valid_mask`` (H, W): False where undistortion left no value;
    ``limit``: radiance at which the sensor saturates; ``clipped_mask`` (H, W, 3): True where ``color`` is
    therefore only a lower bound. ``limit`` and ``clipped_mask`` are None if the sensor's limit is unknown.
    """

    color: NDArray[np.float32]
    valid_mask: NDArray[np.bool_]
    clipped_mask: NDArray[np.bool_] | None = None
    limit: float | None = None


class ImageSource(Protocol):
    """Reader of the image and stored maps of one view."""

    def read(self, camera: Camera) -> ColorImage:
        """Read the undistorted image of ``camera``. Raises :class:`InputError` if it cannot be read."""

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
        """Read stored ground truth, (H, W, C) by buffer name; empty for photographs."""


@dataclass(frozen=True)
class CaptureView:
    """A view; ``camera`` is the pinhole camera of its undistorted image, at the processed resolution."""

    name: str
    camera: Camera
    source: ImageSource

    def read(self) -> ColorImage:
        return self.source.read(self.camera)


@dataclass(frozen=True)
class GeometryPart:
    """``num_faces`` triangles of a mesh from index ``first_face``; ``emission``: an emitter's radiance."""

    name: str
    first_face: int
    num_faces: int
    emission: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class CaptureGeometry:
    """A mesh in world space, with UVs whose v points up; ``parts`` are consecutive ranges of its faces."""

    mesh: Mesh
    parts: tuple[GeometryPart, ...]

    def __post_init__(self) -> None:
        if sum(part.num_faces for part in self.parts) != len(self.mesh.faces):
            raise ValueError("expected the parts to contain every face once")

    def emitter_mask(self) -> NDArray[np.bool_]:
        """Return the mask (M,) of the emissive triangles."""
        mask = np.zeros(len(self.mesh.faces), dtype=bool)
        for part in self.parts:
            mask[part.first_face : part.first_face + part.num_faces] = part.emission is not None
        return mask


@dataclass(frozen=True)
class Capture:
    """A photographed or rendered room: views and geometry.

    ``lights`` are known for rendered captures only; ``notes``: assumptions made by the reader, as sentences;
    ``mesh_up`` is the axis of the mesh file that was assumed to be up.
    """

    name: str
    views: tuple[CaptureView, ...]
    geometry: CaptureGeometry
    lights: tuple[Light, ...] = ()
    notes: tuple[str, ...] = ()
    mesh_up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"

    def __post_init__(self) -> None:
        if not self.views:
            raise InputError(Problem(self.name, "views", "none", "at least one view", "add photographs"))

    @property
    def cameras(self) -> list[Camera]:
        return [view.camera for view in self.views]

# SPDX-License-Identifier: MIT
"""Estimates the up axis and unit of a capture.

Photographers hold cameras upright, so up is the axis within 30 degrees of the cameras' mean up direction. In
an arbitrary frame, as from structure from motion (``up="cameras"``), up is the direction most nearly
perpendicular to the pixel rows of all images, regardless of the cameras' tilt. The unit is the metre if the
mesh is at most 100 across (bounding box's diagonal), else the millimetre or centimetre, whichever makes it
closer to 8 m across.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.foundation.cameras import Camera
from datagen.foundation.errors import input_error
from model.reconstruction.captures.options import Axis

AXES: tuple[Axis, ...] = get_args(Axis)
_MAX_TILT_RAD = np.radians(30.0)
_MIN_AGREEMENT = 0.3  # minimum length of the mean up vector, near 0 for cameras that look down
_MIN_UPRIGHT = 0.05  # minimum component of the mean up vector along the estimated axis; sets the axis's sign
_MIN_TURN = np.sin(np.radians(10.0)) ** 2  # variance of directions at 10 degrees from their mean
_LARGEST_ROOM, _USUAL_ROOM_M = 100.0, 8.0
_SMALLEST_ROOM = 1.0

_Z_FROM = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
}


def z_up_from(up: Axis) -> NDArray[np.float64]:
    """Return the rotation (3, 3) that maps the axis ``up`` to +z."""
    return np.array(_Z_FROM[up], dtype=np.float64)


def level_rotation(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Compute the rotation (3, 3) that maps the up direction, estimated from cameras without roll, to +z.

    If the pixel rows of all images are almost parallel, up is the cameras' mean up direction. Raises
    :class:`InputError` if the cameras' up directions cancel, as when they look straight down.
    """
    along_rows = np.array([camera.world_from_camera[:3, 0] for camera in cameras])
    mean_up = -np.mean([camera.world_from_camera[:3, 1] for camera in cameras], axis=0)
    variance, directions = np.linalg.eigh(along_rows.T @ along_rows / len(cameras))
    up = directions[:, 0] if variance[1] > _MIN_TURN else mean_up
    if abs(up @ mean_up) <= _MIN_UPRIGHT * np.linalg.norm(up):
        expected = "cameras held upright, from whose poses the axis is estimated"
        raise input_error("--up", "cameras", "no common up direction", expected, "name the axis with --up")
    up = up * np.sign(up @ mean_up) / np.linalg.norm(up)
    level = along_rows - np.outer(along_rows @ up, up)
    lengths = np.linalg.norm(level, axis=1)
    across = level[lengths.argmax()] / lengths.max()
    return np.stack([across, np.cross(up, across), up])


def up_of(matrix: ArrayLike) -> Axis:
    """Return the axis that a transform world_from_source (4, 4) maps closest to +z."""
    row = np.asarray(matrix, dtype=np.float64)[2, :3]
    at = int(np.abs(row).argmax())
    return AXES[at if row[at] > 0 else at + 3]


def estimated_up(cameras: Sequence[Camera]) -> tuple[Axis, str]:
    """Estimate the up axis from the cameras, 'z' by default; also return a message about it for the user."""
    mean = np.mean([-camera.world_from_camera[:3, 1] for camera in cameras], axis=0)
    length = float(np.linalg.norm(mean))
    at = int(np.abs(mean).argmax())
    axis: Axis = AXES[at if mean[at] > 0 else at + 3]
    text = ", ".join(f"{v:.2f}" for v in mean)
    if length >= _MIN_AGREEMENT and abs(mean[at]) / length >= np.cos(_MAX_TILT_RAD):
        return (
            axis,
            f"up: {axis}, the axis nearest to the cameras' mean up direction ({text}); set another with --up",
        )
    return "z", f"up: z by default; no axis is near the cameras' mean up direction ({text}); set it with --up"


def estimated_unit(diagonal: float) -> tuple[float, str]:
    """Estimate the metres per unit of a mesh from the diagonal of its bounding box; also return a message."""
    unit = 1.0
    if np.isfinite(diagonal) and diagonal > _LARGEST_ROOM:
        unit = min((0.01, 0.001), key=lambda u: abs(np.log(diagonal * u / _USUAL_ROOM_M)))
    name = {1.0: "metres", 0.01: "centimetres", 0.001: "millimetres"}[unit]
    doubt = "" if diagonal * unit >= _SMALLEST_ROOM else ", which is small for a room"
    return unit, f"unit: {name}, since the mesh is {diagonal:.4g} across{doubt}; override it with --unit"

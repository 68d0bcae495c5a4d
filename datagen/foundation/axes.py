# SPDX-License-Identifier: MIT
"""Conversion of other programs' axes and units to metres with Z up."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.foundation.errors import input_error


def asset_from_source(up: Literal["y", "z"], unit_scale: float) -> NDArray[np.float64]:
    """Return the (4, 4) transform to metres with Z up from a file with ``unit_scale`` metres per unit.

    ``up``: the file's upward axis. Raises :class:`InputError` unless the scale is positive and finite.
    """
    if not (np.isfinite(unit_scale) and unit_scale > 0):
        raise input_error("unit scale", got=unit_scale, expected="a positive number of metres per unit")
    return affine(unit_scale * (Z_UP_FROM_Y_UP if up == "y" else np.eye(4))[:3, :3])


def affine(linear: ArrayLike, offset: ArrayLike = (0.0, 0.0, 0.0)) -> NDArray[np.float64]:
    """Return the (4, 4) transform that multiplies by ``linear`` (3, 3) and then adds ``offset`` (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, offset
    return matrix


Z_UP_FROM_Y_UP = affine([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from +Y up to +Z up: (x, y, z) becomes (x, -z, y)."""

MITSUBA_FROM_ENVIRONMENT = affine([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
"""Rotation from the project's environment frame (centre +Y, top +Z) to Mitsuba's (+Z, +Y); self-inverse."""


def rotation(axis: str, angle_rad: float) -> NDArray[np.float64]:
    """Return the right-handed rotation matrix (3, 3) about the axis ``x``, ``y`` or ``z``."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    k = "xyz".index(axis)
    a, b = (k + 1) % 3, (k + 2) % 3
    matrix = np.eye(3)
    matrix[a, a], matrix[a, b], matrix[b, a], matrix[b, b] = c, -s, s, c
    return matrix


def unit_vector(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a vector (N,) divided by its length; a zero vector stays zero."""
    return vector / max(float(np.linalg.norm(vector)), 1e-30)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Affine maps from a UV layer to the texture coordinates of an image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from .expression import Constant
from .graph import Stack, input_of, source_of, value_of


@dataclass(frozen=True)
class UvFrame:
    """Affine map ``matrix`` @ (u, v, 1) from the UVs of a layer to texture coordinates.

    ``layer`` is "" for the UV layer active in rendering. ``matrix`` is rounded, so equal maps compare equal.
    """

    layer: str
    matrix: tuple[tuple[float, float, float], tuple[float, float, float]]

    def apply(self, uv: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map UVs (N, 2) to texture coordinates (N, 2)."""
        if self.is_identity:
            return uv
        rows = np.array(self.matrix)
        return (uv.astype(np.float64) @ rows[:, :2].T + rows[:, 2]).astype(np.float32)

    def inverse(self, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        """UVs (N, 2) that this frame maps to ``coordinates``."""
        rows = np.array(self.matrix)
        return np.linalg.solve(rows[:, :2], (coordinates - rows[:, 2]).T).T

    @property
    def is_identity(self) -> bool:
        return self.matrix == IDENTITY


IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def _mapping_matrix(stack: Stack, node: bpy.types.Node) -> NDArray[np.float64] | None:
    """Matrix (3, 3) of a Mapping node in the UV plane; None unless constant, planar and invertible."""
    if node.vector_type not in ("POINT", "TEXTURE"):
        return None
    values: list[tuple[float, ...]] = []
    for name, default in (("Location", 0.0), ("Rotation", 0.0), ("Scale", 1.0)):
        socket = input_of(node, name)
        if socket is None or (socket.is_inactive if hasattr(socket, "is_inactive") else False):
            values.append((default,) * 3)
            continue
        value = value_of(stack, socket)
        if not isinstance(value, Constant):
            return None
        values.append(value.value)
    location, rotation, scale = values
    if abs(rotation[0]) > 1e-9 or abs(rotation[1]) > 1e-9:
        return None
    c, s = math.cos(rotation[2]), math.sin(rotation[2])
    rotate = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    translate = np.array([[1, 0, location[0]], [0, 1, location[1]], [0, 0, 1.0]])
    matrix = translate @ rotate @ np.diag([scale[0], scale[1], 1.0])
    if abs(np.linalg.det(matrix)) < 1e-12:
        return None
    return np.linalg.inv(matrix) if node.vector_type == "TEXTURE" else matrix


def image_frame(stack: Stack, node: bpy.types.Node) -> UvFrame | None:
    """The affine map by which an Image Texture node reads a UV layer; None if it reads in another way."""
    legacy = node.texture_mapping
    steps = (legacy.translation, legacy.rotation, legacy.scale)
    if tuple(map(tuple, steps)) != ((0, 0, 0), (0, 0, 0), (1, 1, 1)):
        return None
    matrix = np.eye(3)
    socket = input_of(node, "Vector")
    while socket is not None:
        source = source_of(stack, socket)
        stack = source.stack
        if source.node is None:
            if source.socket is not socket and source.socket is not None and source.socket.node is not node:
                return None  # an unlinked input of a group or of a Mapping is a constant, not a UV map
            layer = ""
        elif source.node.type == "MAPPING":
            step = _mapping_matrix(stack, source.node)
            if step is None:
                return None
            matrix = matrix @ step
            socket = input_of(source.node, "Vector")
            if socket is None or not source_of(stack, socket).is_linked:
                return None
            continue
        elif source.node.type == "UVMAP" and not source.node.from_instancer:
            layer = source.node.uv_map
        elif (
            source.node.type == "TEX_COORD"
            and source.socket is not None
            and source.socket.name == "UV"
            and not source.node.from_instancer
        ):
            layer = ""
        else:
            return None
        rounded = np.round(matrix, 9) + 0.0
        rows = tuple(tuple(float(v) for v in row) for row in rounded[:2])
        return UvFrame(layer, rows)  # type: ignore[arg-type]
    return None

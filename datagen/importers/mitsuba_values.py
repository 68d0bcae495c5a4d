# SPDX-License-Identifier: MIT
"""Conversion of parameters and textures of Mitsuba's BSDF nodes to channel values."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from datagen.formats.mitsuba.scene import SceneNode
from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.foundation.errors import Problems
from datagen.foundation.paths import fault_of
from datagen.importers import fresnel
from datagen.importers.channels import (
    BakedSource,
    Color,
    ColorValue,
    ImageSource,
    ScalarValue,
    Value,
)
from datagen.importers.common import RESTORE_IT, ImportJob

CHECKER_TILE_PX = 128  # bilinear filtering blurs the edges over 1/128 of a tile
MISSING_GREY = 0.5
_COPY_IT = "copy it there, or name its folder with --allow"
_DEFAULT_INT_IOR, _DEFAULT_EXT_IOR = "bk7", "air"


class NodeValues:
    """Reader of the parameters of BSDF nodes, which collects ``problems`` for the caller to raise."""

    def __init__(self, job: ImportJob):
        self.job, self.cache, self.problems = job, job.cache, job.problems
        self.start_material()

    def start_material(self) -> None:
        """Discard UV transforms and notes of the previous material."""
        self._uv_matrices: list[NDArray[np.float64] | None] = []
        self.notes: list[str] = []

    def ior(self, node: SceneNode) -> float:
        """Return the relative index of refraction of a BSDF, inside over outside."""
        sides = []
        for key, default in (("int_ior", _DEFAULT_INT_IOR), ("ext_ior", _DEFAULT_EXT_IOR)):
            value = node.get(key, default)
            number = fresnel.NAMED_IOR.get(value.lower()) if isinstance(value, str) else float(value)
            if number is None or not (math.isfinite(number) and number > 0):
                self.problems.add(
                    f"{node.where}: {key}",
                    repr(value),
                    "a number above 0, or a material name known to Mitsuba",
                    "use a number",
                )
                number = 1.5
            sides.append(number)
        return sides[0] / sides[1]

    def roughness(self, node: SceneNode, name: str) -> ScalarValue:
        """Return the roughness R of a BSDF; a GGX lobe is replaced by the nearest Beckmann lobe."""
        distribution = str(node.get("distribution", "beckmann"))
        if node.get("alpha_u") is not None or node.child("alpha_u") is not None:
            pair = self.scalar(node, "alpha_u", 0.1), self.scalar(node, "alpha_v", 0.1)
            self.notes.append(f"{name}: anisotropic roughness as the geometric mean of its two widths")
        else:
            pair = (self.scalar(node, "alpha", 0.1),) * 2
        value = self.cache.scalar(
            f"{name}_roughness",
            lambda u, v: fresnel.perceptual_roughness(np.sqrt(u * v), distribution),
            *pair,
        )
        if distribution == "ggx":
            factor = fresnel.ALPHA_BECKMANN_PER_GGX
            self.notes.append(f"{name}: GGX lobe as the Beckmann lobe nearest to it (alpha x {factor})")
        return value

    def color(self, node: SceneNode, key: str, default: float) -> ColorValue:
        """Return the colour parameter ``key``, constant or textured."""
        texture = node.child(key)
        if texture is not None:
            return cast(ColorValue, self.texture(texture))
        return rgb_of(node.get(key, default))

    def scalar(self, node: SceneNode, key: str, default: float) -> ScalarValue:
        """Return the scalar ``key``; a colour is reduced to luminance, a checkerboard to its mean channel."""
        texture = node.child(key)
        if texture is None:
            value = node.get(key, default)
            return float(np.dot(value, LUMINANCE_WEIGHTS)) if isinstance(value, tuple) else float(value)
        found = self.texture(texture)
        if isinstance(found, tuple):
            return float(np.dot(found, LUMINANCE_WEIGHTS))
        if isinstance(found, BakedSource):
            return BakedSource(self.cache.values(found, True).mean(axis=-1), found.label, "linear")
        return found

    def texture(self, node: SceneNode) -> Value:
        """Convert a texture node to a value, and record its UV transform for :meth:`common_matrix`."""
        if node.type == "bitmap":
            return self._bitmap(node)
        remedy = "bake it to an image"
        if node.type == "checkerboard":
            self._note_matrix(node)
            first = rgb_of(node.get("color0", 0.4))
            second = rgb_of(node.get("color1", 0.2))
            if node.child("color0") or node.child("color1"):
                self.problems.add(node.where, "a checkerboard of textures", "two colours", remedy)
            return checkerboard(first, second)
        self.problems.add(node.where, f"type {node.type!r}", "a bitmap or a checkerboard", remedy)
        return (MISSING_GREY,) * 3

    def _bitmap(self, node: SceneNode) -> Value:
        self._note_matrix(node)
        field, instead = f"{node.where}: filename", f"texture replaced by grey {MISSING_GREY}"
        path = file_of(node, field, "the texture", instead, self.job, self.problems)
        if path is None or not path.is_file():
            return (MISSING_GREY,) * 3
        if str(node.get("wrap_mode", "repeat")) != "repeat":
            wrap = f"wrap mode {node.get('wrap_mode')} as repeat"
            self.job.findings.approximate(f"{node.get('filename')}: {wrap}")
        is_raw = bool(node.get("raw", False)) or path.suffix.lower() in (".exr", ".hdr", ".pfm")
        return ImageSource(path, "linear" if is_raw else "srgb")

    def _note_matrix(self, node: SceneNode) -> None:
        matrix, flat = node.get("to_uv"), np.eye(3)
        if matrix is not None:
            flat[:2, :2], flat[:2, 2] = matrix[:2, :2], matrix[:2, 3]
        self._uv_matrices.append(None if matrix is None else flat)

    def common_matrix(self, node: SceneNode) -> NDArray[np.float64] | None:
        """Return the UV transform (3, 3) that the material's textures share; None if none has ``to_uv``."""
        first = next((m for m in self._uv_matrices if m is not None), None)
        if first is None:
            return None
        if not all(np.allclose(np.eye(3) if m is None else m, first) for m in self._uv_matrices):
            expected, remedy = "one UV transform per material", "bake them to one layout"
            self.problems.add(node.where, "textures with different to_uv", expected, remedy)
        return first


def file_of(
    node: SceneNode, field: str, expected: str, instead: str, job: ImportJob, problems: Problems
) -> Path | None:
    """Return the path of the file that ``node`` of the scene ``problems.where`` names; None if refused.

    If the options permit missing files, their paths are returned too, and an approximation that ends in
    ``instead`` is recorded. ``field`` and ``expected`` are parts of the problem recorded for a refused file.
    """
    name = str(node.get("filename", ""))
    path, fault = fault_of(Path(problems.where).parent, name, job.options.allowed)
    if path is None:
        problems.add(field, f"{name!r} ({fault})", "a file inside the scene's folder", _COPY_IT)
    elif not path.is_file():
        if job.options.missing == "refuse":
            problems.add(field, f"{name!r} (no such file)", expected, RESTORE_IT)
            return None
        job.findings.approximate(f"{name}: missing {instead}")
    return path


def rgb_of(value: Any) -> Color:
    """Return the value of a node's colour parameter, three numbers or a grey level, as RGB."""
    if isinstance(value, tuple | list):
        red, green, blue = (float(x) for x in value)
        return red, green, blue
    return (float(value),) * 3


def checkerboard(color0: Color, color1: Color) -> BakedSource:
    """Return a tile of Mitsuba's checkerboard: ``color0`` where both or neither of u, v exceed 0.5."""
    side = CHECKER_TILE_PX
    half = np.arange(side) >= side // 2
    is_first = half[:, None] == half[None, :]
    values = np.where(is_first[..., None], np.asarray(color0), np.asarray(color1)).astype(np.float32)
    return BakedSource(values, "checkerboard", "srgb")


def normal_from_height(height: NDArray[np.float32], uv_per_m: float) -> NDArray[np.float32]:
    """Return tangent-space unit normals (H, W, 3), +Y up, of a tiling height map (H, W) in metres.

    The slope along u is dh/du times ``uv_per_m``; v increases as the row index decreases.
    """
    rows, columns = height.shape
    slope_u = (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)) * (0.5 * columns) * uv_per_m
    slope_v = (np.roll(height, 1, axis=0) - np.roll(height, -1, axis=0)) * (0.5 * rows) * uv_per_m
    normal = np.stack([-slope_u, -slope_v, np.ones_like(height)], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)

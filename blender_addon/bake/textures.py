# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes a material by its plan to constants and to textures of sufficient size."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import bpy
import numpy as np
from numpy.typing import NDArray

from ..problems import APPROXIMATION, NOTE, ProblemList
from ..settings import ExportSettings
from .execute import Array, BakeSession, WorkingMaterial
from .expression import Constant
from .frames import IDENTITY, UvFrame
from .plan import NORMAL, SCALAR_CHANNELS, MaterialPlan, PlainImage
from .pyramid import fill, halve, interpolate, smallest_level

_FIRST_PX = 256
_ODD_PX = 181  # a prime, so that a regular pattern does not alias as at a power of two
BORDER = 1 / 32  # margin around a window or layout, relative to the texture's side
_FLAT = 1e-4  # a texture with less variation is exported as a constant

Window = tuple[float, float, float, float]
UNIT_WINDOW: Window = (0.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True)
class BakedTexture:
    """A baked texture: linear ``pixels`` (H, W, C), float32, row 0 at v = 0.

    ``error``: mean absolute difference from the finest bake or, if cut at the size limit, between this bake
    and one of half the size.
    """

    pixels: Array
    error: float


def padded_window(low: NDArray, high: NDArray) -> Window:
    """Window (u0, v0, u1, v1) of texture coordinates: the box from ``low`` to ``high`` (2,), plus a margin.

    With the margin, lookups that wrap never read the opposite border in textures of 16 texels or more.
    """
    size = np.maximum(high - low, 1e-3)
    middle = (low + high) / 2
    half = size / 2 / (1 - 2 * BORDER)
    return (*(float(v) for v in middle - half), *(float(v) for v in middle + half))  # type: ignore[return-value]


def padded_mask(size: int) -> NDArray[np.bool_]:
    """Mask (size, size) of the texels inside the border that :func:`padded_window` adds."""
    centre = (np.arange(size) + 0.5) / size
    inside = (centre > BORDER) & (centre < 1 - BORDER)
    return inside[:, None] & inside[None, :]


def _enough_px(plan: MaterialPlan, window: Window) -> int | None:
    """Side of a square texture over the window that preserves all detail of the material's images.

    The side is doubled unless the texture's texels coincide with those of an image. None if values other than
    images vary.
    """
    detail = plan.dependencies.detail_px
    if detail is None or plan.frame is None:
        return None
    u0, v0, u1, v1 = window
    side = max(detail[0] * (u1 - u0), detail[1] * (v1 - v0), 1.0)
    size = 1 << math.ceil(math.log2(side))
    return size if window == UNIT_WINDOW and size in detail else 2 * size


Channel = tuple[float, ...] | BakedTexture | PlainImage


@dataclass
class BakedMaterial:
    """Baked ``channels`` of a material by name.

    ``frame`` maps the mesh's UVs to texture coordinates; then the window (u0, v0, u1, v1) is mapped to the
    unit square. ``uv`` (C, 2), by face corner, replaces the UVs if the mesh has a new layout.
    ``normal``: the baked normal texture, None without one.
    """

    channels: dict[str, Channel] = field(default_factory=dict)
    frame: UvFrame | None = None
    window: Window = UNIT_WINDOW
    uv: NDArray[np.float32] | None = None
    normal: BakedTexture | None = None

    def texture_coordinates(self, uv: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map a mesh's UVs (C, 2) to texture coordinates."""
        if self.frame is not None:
            uv = self.frame.apply(uv)
        u0, v0, u1, v1 = self.window
        if self.window == UNIT_WINDOW:
            return uv
        low, size = np.array([u0, v0]), np.array([u1 - u0, v1 - v0])
        return ((uv - low) / size).astype(np.float32)


class MaterialBaker:
    """Bakes materials to constants and textures."""

    def __init__(self, session: BakeSession, settings: ExportSettings, problems: ProblemList):
        self.session, self.settings, self.problems = session, settings, problems

    def on_plane(
        self,
        material: bpy.types.Material,
        plan: MaterialPlan,
        window: Window = UNIT_WINDOW,
        object_info: dict[str, tuple[float, ...]] | None = None,
        side: float = 1.0,
        layer_names: tuple[str, ...] = (),
    ) -> BakedMaterial:
        """Bake a material over the texture coordinates ``window``, on a square of ``side`` (Blender units).

        ``object_info``: values of Object Info nodes, by output; ``layer_names``: UV layers that nodes name.
        """
        result = BakedMaterial(frame=plan.frame, window=window)
        result.channels.update(plan.images)
        pending = {**plan.constants, **plan.varying}
        direct = {name: value for name, value in pending.items() if isinstance(value, Constant)}
        result.channels.update({name: _constant(name, value.value) for name, value in direct.items()})
        pending = {name: value for name, value in pending.items() if name not in direct}
        if not pending and not plan.bakes_normal:
            return self._finish(result, plan)
        working = self.session.working_material(material, pending, object_info)
        frame = plan.frame or UvFrame("", IDENTITY)
        u0, v0, u1, v1 = window
        corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
        uv = frame.inverse(corners).astype(np.float32)
        names = dict.fromkeys((*layer_names, frame.layer or "UVMap"))
        thing = self.session.plane(
            working.material, {name: uv for name in names}, side, frame.layer or "UVMap"
        )
        covered = None if window == UNIT_WINDOW else padded_mask
        enough = _enough_px(plan, window)
        for name in pending:
            if name in plan.constants:
                pixels, _ = self.session.bake(thing, working, name, 4)
                result.channels[name] = _constant(name, tuple(pixels.reshape(-1, 3).mean(axis=0).tolist()))
            else:
                result.channels[name] = self._grow(thing, working, name, plan.name, covered, enough)
        if plan.bakes_normal:
            normal = self._grow(thing, working, NORMAL, plan.name, covered, enough)
            result.normal = normal if isinstance(normal, BakedTexture) else None  # None: flat
        for block in (thing, thing.data, working.material):
            self.session.discard(block)
        return self._finish(result, plan)

    def on_mesh(
        self,
        material: bpy.types.Material,
        plan: MaterialPlan,
        thing: bpy.types.Object,
        slot: int,
        uv: NDArray[np.float32],
        object_info: dict[str, tuple[float, ...]] | None = None,
    ) -> BakedMaterial:
        """Bake a slot of the session's object ``thing`` in the layout ``uv`` (C, 2) of its face corners."""
        result = BakedMaterial(uv=uv)
        mesh = thing.data
        pending = {**plan.constants, **plan.varying}
        working = self.session.working_material(material, pending, object_info)
        idle = self._idle_material()
        originals = list(mesh.materials)
        for index in range(len(originals)):
            mesh.materials[index] = working.material if index == slot else idle
        if not originals:
            mesh.materials.append(working.material)
        for name in pending:
            source = working.outputs[name]
            if isinstance(source, Constant):
                result.channels[name] = _constant(name, source.value)
            else:
                result.channels[name] = self._grow(thing, working, name, plan.name)
        if plan.bakes_normal:
            normal = self._grow(thing, working, NORMAL, plan.name)
            result.normal = normal if isinstance(normal, BakedTexture) else None  # None: flat
        self.session.discard(working.material)
        return self._finish(result, plan)

    def _idle_material(self) -> bpy.types.Material:
        """A material for slots that are not baked; Blender requires a target image in every slot."""
        material = self.session.own(bpy.data.materials, bpy.data.materials.new(".sm_idle"))
        material.use_nodes = True
        node = material.node_tree.nodes.new("ShaderNodeTexImage")
        node.image = self.session.own(bpy.data.images, bpy.data.images.new(".sm_idle", 1, 1, is_data=True))
        material.node_tree.nodes.active = node
        return material

    def _grow(
        self,
        thing: bpy.types.Object,
        working: WorkingMaterial,
        name: str,
        material: str,
        covered: Callable[[int], NDArray[np.bool_]] | None = None,
        enough: int | None = None,
    ) -> Channel:
        """Bake at increasing sizes until a level of half the size or less reproduces the bake.

        ``covered`` returns, for a size, the mask of texels over which errors are computed (default: all that
        are baked). ``enough``: a size known to preserve all detail, or None.
        """
        limit, tolerance = self.settings.max_texture_px, self.settings.tolerance
        is_cut = enough is None or enough > limit
        limit = limit if enough is None else min(enough, limit)
        size = min(_FIRST_PX, limit) if enough is None else limit
        while True:
            pixels, mask = self._bake(thing, working, name, size)
            counted = mask & covered(size) if covered is not None else mask
            if not mask.any():
                return _constant(name, (0.0,) * 3)
            level = smallest_level(pixels, mask, tolerance, counted=counted)
            is_small = level.image.size < pixels.size
            if size == limit or (is_small and self._is_trusted(thing, working, name, pixels, mask)):
                break
            size = min(size * 4, limit)
        if name == "emission":
            return self._mean_emission(pixels[mask], material)
        if np.ptp(level.image.reshape(-1, level.image.shape[2]), axis=0).max() < _FLAT:
            return _constant(name, tuple(float(v) for v in level.image.mean(axis=(0, 1))))
        if level.image.size == pixels.size and size == limit and is_cut:
            error = _last_change(pixels, mask, counted)
            self.problems.add(
                APPROXIMATION,
                f"{name} is limited to {size} px; at half this size it differs by {error:.4f} on average",
                "raise the maximum texture size, or accept the error",
                material=material,
            )
            return BakedTexture(level.image, error)
        return BakedTexture(level.image, level.error)

    def _bake(
        self, thing: bpy.types.Object, working: WorkingMaterial, name: str, size: int
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Bake a channel, clipped to its range, [0, 1] except for emission; scalars keep one component."""
        if name == NORMAL:
            pixels, mask = self.session.bake_normal(thing, working, size)
        else:
            pixels, mask = self.session.bake(thing, working, name, size)
        if name in SCALAR_CHANNELS:
            pixels = pixels[..., :1]
        return np.clip(pixels, 0, None if name == "emission" else 1), mask

    def _is_trusted(
        self,
        thing: bpy.types.Object,
        working: WorkingMaterial,
        name: str,
        pixels: Array,
        mask: NDArray[np.bool_],
    ) -> bool:
        """True if mean and deviation agree with a bake at another size; else ``pixels`` may be aliased."""
        other, other_mask = self._bake(thing, working, name, _ODD_PX)
        if not other_mask.any():
            return False
        a, b = pixels[mask], other[other_mask]
        allowed = 4 * self.settings.tolerance
        return bool(
            np.abs(a.mean(axis=0) - b.mean(axis=0)).max() <= allowed
            and np.abs(a.std(axis=0) - b.std(axis=0)).max() <= allowed
        )

    def _mean_emission(self, values: NDArray[np.float32], material: str) -> tuple[float, ...]:
        mean, spread = values.mean(axis=0), float(values.std(axis=0).max())
        if spread > _FLAT * max(float(mean.max()), 1e-6):
            message = f"the emission varies over the surface (deviation {spread:.3g}); its mean is exported"
            remedy = "split the mesh where the emission changes"
            self.problems.add(APPROXIMATION, message, remedy, material=material)
        return tuple(float(v) for v in mean)

    def _finish(self, result: BakedMaterial, plan: MaterialPlan) -> BakedMaterial:
        if plan.normals and not plan.bakes_normal and NORMAL not in plan.images:
            remedy = "turn on Bake Normals to get a normal texture"
            self.problems.add(NOTE, "bump and normal inputs are left out", remedy, material=plan.name)
        return result


def _constant(name: str, value: tuple[float, ...]) -> tuple[float, ...]:
    width = 1 if name in SCALAR_CHANNELS else 3
    if width == 1:
        value = value[:1]
    elif len(value) == 1:
        value = value * 3
    if name == "emission":
        return tuple(max(0.0, float(v)) for v in value)
    return tuple(min(1.0, max(0.0, float(v))) for v in value)


def _last_change(pixels: Array, mask: NDArray[np.bool_], counted: NDArray[np.bool_]) -> float:
    smaller, weight = halve(pixels, mask.astype(np.float32)[..., None], 0)
    smaller, weight = halve(smaller, weight, 1)
    height, width = pixels.shape[:2]
    coarse = interpolate(fill(smaller, weight[..., 0] > 0), height, width)
    return float(np.abs(coarse - pixels)[counted].mean(axis=0).max())

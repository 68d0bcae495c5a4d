# SPDX-License-Identifier: MIT
"""Assigns materials as in real homes, by kind of surface and in one style per room.

The *palette* is the list of available materials. A *look* is a material class with ranges of D, S and R. A
look of a slot's kind of surface (:data:`datagen.assembly.looks.LOOKS`) is eligible if it matches the room's
style and some palette material fits the slot and can be varied into the look's ranges. A look is drawn by
weight, then a material, then a point in the ranges. A slot that keeps its material gets a small variation.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.assembly.looks import KEPT, LOOKS, Interval, Look, RoomStyle
from datagen.assembly.materials import (
    CLASS_RANGES,
    MeanMaterial,
    MeanMaterials,
    is_assignable,
    is_plain,
    mean_of,
    slots_by_material,
)
from datagen.formats.asset import GeometryAsset, Material, MaterialAsset, Surface
from datagen.formats.base import quantized
from datagen.formats.configuration import ColorAdjustment, MaterialAssignment
from datagen.formats.package import Package
from datagen.formats.recipe import MaterialRecipe
from datagen.foundation.random import Draws, weighted_item

_DYED_HUE_TURNS = 0.2  # classes with at least this range of hues count as dyed and may have any hue
_MAX_FACTOR = 4.0  # largest factor of saturation and value that a configuration can store
_GREY = 0.02  # saturation below which a colour has no hue
_OWN_VALUE, _OWN_SATURATION, _OWN_ROUGHNESS = 1.15, 1.1, 0.05
"""Largest factors of value and saturation and largest offset of R for materials that a slot keeps."""


@dataclass(frozen=True)
class Reach:
    """Ranges of the colour adjustments that bring a material's mean D and R into the ranges of a look."""

    hue_shift: Interval
    saturation_scale: Interval
    value_scale: Interval
    roughness_offset: Interval

    def at(self, where: NDArray[np.float64], strength: float) -> ColorAdjustment:
        """Return the adjustment at fractions ``where`` (4,) in [0, 1] of the four ranges.

        ``strength`` in [0, 1] interpolates to it from the smallest adjustment within the ranges.
        """

        def pick(interval: Interval, at: float, still: float) -> float:
            low, high = interval
            nearest = min(max(still, low), high)
            return quantized(nearest + strength * (low + at * (high - low) - nearest), 4)

        hue, saturation, value, rough = where.tolist()
        return ColorAdjustment(
            hue_shift=pick(self.hue_shift, hue, 0.0),
            saturation_scale=pick(self.saturation_scale, saturation, 1.0),
            value_scale=pick(self.value_scale, value, 1.0),
            roughness_offset=pick(self.roughness_offset, rough, 0.0),
        )


def reach(look: Look, material: Material, mean: MeanMaterial) -> Reach | None:
    """Return the adjustments that bring a material's means into a look's ranges; None if none does.

    The limits of the class are widened for untextured materials of classes with a wide range of hues.
    """
    limits = CLASS_RANGES[material.classes[0]]
    is_tint = not material.textures() and limits.hue_turns >= _DYED_HUE_TURNS
    hue, saturation, value = colorsys.rgb_to_hsv(*mean.diffuse_albedo)
    _, tint, specular = colorsys.rgb_to_hsv(*mean.specular_albedo)
    if not _contains(look.specular, specular) or not _contains(look.tint, tint):
        return None
    max_value, max_saturation = (_MAX_FACTOR,) * 2 if is_tint else (limits.value, limits.saturation)
    values = _scales(look.value, value, look.stain, max_value)
    saturations = _scales(look.saturation, saturation, look.stain, max_saturation)
    step = 2 * limits.roughness_step if is_tint else limits.roughness_step
    offsets = _common((look.roughness[0] - mean.roughness, look.roughness[1] - mean.roughness), (-step, step))
    turns = (0.0, 0.0)
    if saturation > _GREY and look.hue is not None:
        wanted = 0.5 * (look.hue[0] + look.hue[1])
        shift = (wanted - hue + 0.5) % 1.0 - 0.5
        half = 0.5 * (look.hue[1] - look.hue[0])
        is_dyed = look.is_printed or limits.hue_turns >= _DYED_HUE_TURNS
        max_turns = 0.5 if is_dyed else limits.hue_turns
        turns = _common((shift - half, shift + half), (-max_turns, max_turns))  # type: ignore[assignment]
    if values is None or saturations is None or offsets is None or turns is None:
        return None
    return Reach(turns, saturations, values, offsets)


def _contains(interval: Interval, value: float) -> bool:
    return interval[0] <= value <= interval[1]


def _common(one: Interval, other: Interval) -> Interval | None:
    low, high = max(one[0], other[0]), min(one[1], other[1])
    return (low, high) if low <= high else None


def _scales(wanted: Interval, own: float, stain: float, max_factor: float) -> Interval | None:
    """Return the range of factors that scale ``own`` into ``wanted``; None if it is empty.

    Factors are between 1 / max(``max_factor``, ``stain``) and ``max_factor``.
    """
    if own <= _GREY and _contains(wanted, own):
        return (1.0, 1.0)  # scaling black or grey does not produce a colour
    return _common(
        (wanted[0] / max(own, 1e-9), wanted[1] / max(own, 1e-9)), (1 / max(max_factor, stain), max_factor)
    )


@dataclass(frozen=True)
class _Choice:
    look: Look
    packages: tuple[Package, ...]


class LikelyMaterials:
    """Assigns materials of ``palette`` to the assets of a configuration, all in one style."""

    def __init__(
        self, style: RoomStyle, palette: list[Package], recipe: MaterialRecipe, means: MeanMaterials
    ):
        self.style = style
        self.recipe = recipe
        self.means = means
        self.palette = [p for p in palette if isinstance(p.asset, MaterialAsset)]

    def assign(
        self,
        package: Package,
        surfaces: dict[str, Surface],
        draws: Draws,
        foreign_slots: frozenset[tuple[str, str]] = frozenset(),
    ) -> dict[str, MaterialAssignment]:
        """Draw materials for the slots of one placed asset; omit slots whose material is kept unchanged.

        ``surfaces`` maps each slot to its kind of surface. A slot in ``foreign_slots`` (asset id, slot) keeps
        its material only if no palette material fits. The number of draws does not depend on the palette.
        """
        asset = package.as_kind(GeometryAsset)
        found: dict[str, MaterialAssignment] = {}
        for slots in slots_by_material(asset):
            units = draws.units(8)
            if any(asset.materials[slot].emission is not None for slot in slots):
                continue
            is_foreign = any((package.id, slot) in foreign_slots for slot in slots)
            assignment = self._assignment(package, asset, slots, surfaces[slots[0]], is_foreign, units)
            if assignment != MaterialAssignment():
                found.update(dict.fromkeys(slots, assignment))
        return found

    def _assignment(
        self,
        package: Package,
        asset: GeometryAsset,
        slots: tuple[str, ...],
        surface: Surface,
        is_foreign: bool,
        units: NDArray[np.float64],
    ) -> MaterialAssignment:
        strength = self.recipe.variation_strength if units[1] < self.recipe.vary_probability else 0.0
        replaces = self.recipe.replace_probability * (1 - KEPT.get(surface, 0.0))
        if units[0] < replaces or is_foreign:
            choices = self._choices(asset, slots, surface)
            if choices:
                choice = weighted_item(choices, [c.look.weight for c in choices], units[2])
                chosen = choice.packages[int(units[3] * len(choice.packages))]
                material = chosen.as_kind(MaterialAsset).material
                found = reach(choice.look, material, self.means.mean(chosen, material))
                assert found is not None
                return MaterialAssignment(asset=chosen.id, adjustment=found.at(units[4:], strength))
        if is_foreign:
            plain = [p for p in self.palette if is_plain(p)]
            if plain:
                return MaterialAssignment(asset=plain[int(units[3] * len(plain))].id)
        own = [asset.materials[slot] for slot in slots]
        mean = mean_of([self.means.mean(package, material) for material in own])
        return MaterialAssignment(adjustment=_varied(surface, self.style, own[0], mean, units[4:], strength))

    def _choices(self, asset: GeometryAsset, slots: tuple[str, ...], surface: Surface) -> list[_Choice]:
        classes = set.intersection(*(set(asset.materials[slot].replaceable_by) for slot in slots))
        looks = LOOKS.get(surface) or tuple(Look(1.0, c) for c in sorted(classes))
        choices = []
        for look in (styled for each in looks if (styled := each.in_style(self.style)) is not None):
            if look.material_class not in classes:
                continue
            packages = tuple(p for p in self.palette if self._suits(p, look, surface, slots, asset))
            if packages:
                choices.append(_Choice(look, packages))
        return choices

    def _suits(
        self,
        package: Package,
        look: Look,
        surface: Surface,
        slots: tuple[str, ...],
        asset: GeometryAsset,
    ) -> bool:
        material = package.as_kind(MaterialAsset)
        if material.material.classes[0] != look.material_class:
            return False
        if material.surfaces and surface not in material.surfaces:
            return False
        if not all(is_assignable(material, slot, asset) for slot in slots):
            return False
        return reach(look, material.material, self.means.mean(package, material.material)) is not None


def _varied(
    surface: Surface,
    style: RoomStyle,
    material: Material,
    mean: MeanMaterial,
    where: NDArray[np.float64],
    strength: float,
) -> ColorAdjustment:
    """Return a small adjustment of a slot's own material, if possible within the ranges of a look."""
    if strength == 0:
        return ColorAdjustment()
    calm = Reach(
        (0.0, 0.0),
        (1 / _OWN_SATURATION, _OWN_SATURATION),
        (1 / _OWN_VALUE, _OWN_VALUE),
        (-_OWN_ROUGHNESS, _OWN_ROUGHNESS),
    )
    for look in LOOKS.get(surface, ()):
        styled = replace(look, hue=None, only=None).in_style(style)
        if styled is None or look.material_class != material.classes[0]:
            continue
        within = reach(replace(styled, hue=None), material, mean)
        if within is None:
            continue
        met = Reach(
            (0.0, 0.0),
            _common(calm.saturation_scale, within.saturation_scale) or (1.0, 1.0),
            _common(calm.value_scale, within.value_scale) or (1.0, 1.0),
            _common(calm.roughness_offset, within.roughness_offset) or (0.0, 0.0),
        )
        return met.at(where, strength)
    return calm.at(where, strength)

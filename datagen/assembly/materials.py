# SPDX-License-Identifier: MIT
"""Assignment of materials to slots, by class, and their variation.

A slot lists the classes that suit its geometry (``replaceable_by``). It gets a material with one of them as
main class or, with the recipe's ``any_class_probability``, of any class; textured materials require UVs.
Variation stays within :data:`CLASS_RANGES`.
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import GeometryAsset, Material, MaterialAsset, MaterialClass, Texture
from datagen.formats.base import quantized
from datagen.formats.configuration import ColorAdjustment, MaterialAssignment, PlacedAsset
from datagen.formats.package import Package
from datagen.formats.recipe import MaterialRecipe
from datagen.formats.textures import texture_values
from datagen.foundation.images import read_image
from datagen.foundation.random import Draws, weighted_item
from datagen.library import Library

Color = tuple[float, float, float]
_MAX_SIDE_TEXELS = 512  # textures are subsampled to less than twice this size before averaging


@dataclass(frozen=True)
class ClassRange:
    """Limits of the variation of a class, and ranges of the means of its materials.

    ``hue_turns`` is the largest shift of hue, ``saturation`` and ``value`` the largest factors (the smallest
    are their inverses), ``roughness_step`` the largest offset of R. ``value_limits`` bound the brightest
    channel of mean D, ``roughness_limits`` mean R; means outside these limits may only move towards them.
    """

    hue_turns: float
    saturation: float
    value: float
    roughness_step: float
    value_limits: tuple[float, float]
    roughness_limits: tuple[float, float]


CLASS_RANGES: dict[MaterialClass, ClassRange] = {
    "wood": ClassRange(0.02, 1.25, 1.5, 0.15, (0.04, 0.75), (0.2, 0.9)),
    "metal": ClassRange(0.015, 1.15, 1.0, 0.2, (0.0, 1.0), (0.08, 0.7)),
    "plastic": ClassRange(0.5, 1.4, 1.6, 0.2, (0.02, 0.85), (0.1, 0.7)),
    "rubber": ClassRange(0.1, 1.3, 1.5, 0.1, (0.015, 0.4), (0.5, 0.95)),
    "leather": ClassRange(0.03, 1.3, 1.6, 0.15, (0.02, 0.6), (0.3, 0.9)),
    "fabric": ClassRange(0.5, 1.4, 1.5, 0.1, (0.02, 0.85), (0.6, 1.0)),
    "ceramic": ClassRange(0.2, 1.4, 1.3, 0.15, (0.05, 0.88), (0.05, 0.85)),
    "stone": ClassRange(0.02, 1.3, 1.4, 0.2, (0.03, 0.85), (0.1, 0.95)),
    "paper": ClassRange(0.05, 1.4, 1.3, 0.08, (0.15, 0.9), (0.6, 1.0)),
    "glazed": ClassRange(0.3, 1.4, 1.4, 0.08, (0.03, 0.88), (0.03, 0.3)),
    "painted": ClassRange(0.5, 1.5, 1.4, 0.2, (0.04, 0.88), (0.2, 0.95)),
    "plaster": ClassRange(0.02, 1.3, 1.2, 0.08, (0.3, 0.9), (0.7, 1.0)),
    "glass": ClassRange(0.02, 1.1, 1.0, 0.02, (0.0, 1.0), (0.0, 0.3)),
    "organic": ClassRange(0.02, 1.2, 1.3, 0.1, (0.02, 0.7), (0.3, 1.0)),
    "other": ClassRange(0.03, 1.2, 1.2, 0.1, (0.02, 0.85), (0.05, 1.0)),
}
"""Limits by class. Photometric tables list albedos from 0.04 for charcoal to 0.88 for fresh white paint.
Ranges of R cover the finishes of a class (a glaze is never matt, plaster never glossy). Only dyed classes
(plastic, painted, fabric) change their hue freely. See docs/assembly.md."""


@dataclass(frozen=True)
class MeanMaterial:
    """Averages of a material over its textures: D, S, R in [0, 1], and emitted radiance in W/(m² sr)."""

    diffuse_albedo: Color
    specular_albedo: Color
    roughness: float
    emission: Color = (0.0, 0.0, 0.0)


class MeanMaterials:
    """Computes averages of materials; averages of textures are cached."""

    def __init__(self) -> None:
        self._means: dict[tuple[str, str, bool], Color] = {}

    def mean(self, package: Package, material: Material) -> MeanMaterial:
        """Return the averages of a material of a package, before any adjustment."""

        def color(value: Color | Texture) -> Color:
            return self._texture(package, value, False) if isinstance(value, Texture) else value

        rough = material.roughness
        return MeanMaterial(
            color(material.diffuse_albedo),
            color(material.specular_albedo),
            self._texture(package, rough, True)[0] if isinstance(rough, Texture) else rough,
            material.emission or (0.0, 0.0, 0.0),
        )

    def _texture(self, package: Package, value: Texture, is_scalar: bool) -> Color:
        key = (package.sha256, value.model_dump_json(), is_scalar)
        if key not in self._means:
            pixels = read_image(package.local_file(value.texture))
            step = max(1, max(pixels.shape[:2]) // _MAX_SIDE_TEXELS)
            texels = texture_values(value, pixels[::step, ::step], is_scalar).astype(np.float64)
            mean = np.broadcast_to(texels.reshape(-1, 1 if is_scalar else 3).mean(axis=0), (3,))
            self._means[key] = (float(mean[0]), float(mean[1]), float(mean[2]))
        return self._means[key]


def adjusted(mean: MeanMaterial, adjustment: ColorAdjustment) -> MeanMaterial:
    """Return the means of a material after an adjustment; approximate if the material has textures."""

    def turned(color: Color, value_scale: float) -> Color:
        hue, saturation, value = colorsys.rgb_to_hsv(*color)
        hue, saturation = (hue + adjustment.hue_shift) % 1.0, saturation * adjustment.saturation_scale
        return colorsys.hsv_to_rgb(hue, min(1.0, saturation), min(1.0, value * value_scale))

    return MeanMaterial(
        turned(mean.diffuse_albedo, adjustment.value_scale),
        turned(mean.specular_albedo, 1.0),
        min(1.0, max(0.0, mean.roughness + adjustment.roughness_offset)),
        mean.emission,
    )


def draw_adjustment(
    mean: MeanMaterial, main_class: MaterialClass, strength: float, draws: Draws
) -> ColorAdjustment:
    """Draw an adjustment within the :data:`CLASS_RANGES` of a class, scaled by ``strength`` in [0, 1]."""
    limits = CLASS_RANGES[main_class]
    hue = draws.uniform(-1, 1) * limits.hue_turns * strength
    saturation = math.exp(draws.uniform(-1, 1) * math.log(limits.saturation) * strength)
    value = math.exp(draws.uniform(-1, 1) * math.log(limits.value) * strength)
    step = draws.uniform(-1, 1) * limits.roughness_step * strength
    brightest = max(mean.diffuse_albedo)
    if brightest > 0:
        target = _clamped(brightest * value, brightest, *limits.value_limits)
        value = target / brightest
    rough = _clamped(mean.roughness + step, mean.roughness, *limits.roughness_limits)
    return ColorAdjustment(
        hue_shift=quantized(hue, 4),
        saturation_scale=quantized(saturation, 4),
        value_scale=quantized(value, 4),
        roughness_offset=quantized(round(rough - mean.roughness, 6), 4),
    )


def _clamped(moved: float, start: float, low: float, high: float) -> float:
    """Clamp ``moved`` to the smallest interval that contains [low, high] and ``start``."""
    return min(max(moved, min(low, start)), max(high, start))


def suits(material: MaterialAsset, slot: str, asset: GeometryAsset) -> bool:
    """Return whether a slot accepts a material's main class and the material is assignable to the slot."""
    has_class = material.material.classes[0] in asset.materials[slot].replaceable_by
    return has_class and is_assignable(material, slot, asset)


def is_assignable(material: MaterialAsset, slot: str, asset: GeometryAsset) -> bool:
    """Return whether a material is opaque, non-emissive and, if textured, tileable on a slot with UVs."""
    own = material.material
    if own.emission is not None or own.opacity is not None:
        return False
    if not own.textures():
        return True
    has_uv = all(part.uv_per_m is not None for part in asset.parts if part.material == slot)
    return own.tile_size_m is not None and has_uv


def is_plain(package: Package) -> bool:
    """Return whether a package is an untextured, opaque, non-emissive material, which fits any slot."""
    asset = package.asset
    if not isinstance(asset, MaterialAsset):
        return False
    own = asset.material
    return not own.textures() and own.emission is None and own.opacity is None


def slots_by_material(asset: GeometryAsset) -> list[tuple[str, ...]]:
    """Group an asset's slots, sorted by name; bakes of one material (``baked_from``) form one group."""
    groups: dict[tuple[bool, str], list[str]] = {}
    for slot in sorted(asset.materials):
        origin = asset.materials[slot].baked_from
        groups.setdefault((origin is not None, origin or slot), []).append(slot)
    return [tuple(slots) for slots in groups.values()]


def assign_materials(
    package: Package,
    palette: list[Package],
    recipe: MaterialRecipe,
    means: MeanMaterials,
    draws: Draws,
    foreign_slots: frozenset[tuple[str, str]] = frozenset(),
) -> dict[str, MaterialAssignment]:
    """Draw materials for the slots of one placed asset; omit slots whose material is kept unchanged.

    ``palette`` is the list of material packages in a fixed order. A class is drawn first, then one of its
    materials, so that large classes do not dominate. The material of a slot in ``foreign_slots`` (asset id,
    slot) has an image of another split or is a placeholder, and must be replaced (by an untextured material
    if no other fits). The remaining slots keep their material if none fits. Slots with bakes of one material
    (``baked_from``) get the same assignment.
    """
    asset = package.as_kind(GeometryAsset)
    assignments = {}
    for slots in slots_by_material(asset):
        own = [asset.materials[slot] for slot in slots]
        replaces, varies = draws.chance(recipe.replace_probability), draws.chance(recipe.vary_probability)
        pick = draws.units(2)
        # not drawn at probability 0: an additional draw would change the configurations of such recipes
        takes_any = recipe.any_class_probability > 0 and draws.chance(recipe.any_class_probability)
        if any(m.emission is not None for m in own):
            continue
        is_foreign = any((package.id, slot) in foreign_slots for slot in slots)
        fits = is_assignable if takes_any and all(m.replaceable_by for m in own) else suits
        fitting = [
            p
            for p in palette
            if isinstance(p.asset, MaterialAsset) and all(fits(p.asset, slot, asset) for slot in slots)
        ]
        chosen: Package | None = None
        if replaces or is_foreign:
            chosen = _drawn(fitting, recipe.class_weights, pick)
        if is_foreign and chosen is None:
            chosen = _drawn([p for p in palette if is_plain(p)], {}, pick)
        adjustment = ColorAdjustment()
        if varies:
            if chosen is None:
                main_class = own[0].classes[0]
                mean = mean_of([means.mean(package, material) for material in own])
            else:
                material = chosen.as_kind(MaterialAsset).material
                main_class, mean = material.classes[0], means.mean(chosen, material)
            adjustment = draw_adjustment(mean, main_class, recipe.variation_strength, draws)
        if chosen is not None or adjustment != ColorAdjustment():
            assignment = MaterialAssignment(
                asset=None if chosen is None else chosen.id, adjustment=adjustment
            )
            assignments.update(dict.fromkeys(slots, assignment))
    return assignments


def mean_of(bakes: list[MeanMaterial]) -> MeanMaterial:
    """Average the means of the bakes of one material, none of which is emissive."""
    if len(bakes) == 1:
        return bakes[0]

    def color(channel: str) -> Color:
        red, green, blue = np.mean([getattr(bake, channel) for bake in bakes], axis=0).tolist()
        return (red, green, blue)

    roughness = float(np.mean([bake.roughness for bake in bakes]))
    return MeanMaterial(color("diffuse_albedo"), color("specular_albedo"), roughness)


def _drawn(
    fitting: list[Package], class_weights: Mapping[MaterialClass, float], pick: NDArray[np.float64]
) -> Package | None:
    """Select a class, then a package, by ``pick`` (2,) in [0, 1); None if no class has a positive weight."""
    by_class: dict[MaterialClass, list[Package]] = {}
    for package in fitting:
        main_class = package.as_kind(MaterialAsset).material.classes[0]
        by_class.setdefault(main_class, []).append(package)
    classes = sorted(by_class)
    weights = [class_weights.get(name, 1.0) for name in classes]
    if not any(weights):
        return None
    of_class = by_class[weighted_item(classes, weights, pick[0])]
    return of_class[int(pick[1] * len(of_class))]


def mean_materials(placed: PlacedAsset, library: Library, means: MeanMaterials) -> dict[str, MeanMaterial]:
    """Map each slot of a placed asset to the means of its adjusted material, with the slot's emission."""
    package = library.package(placed.asset)
    asset = package.as_kind(GeometryAsset)
    assigned = {}
    for slot in sorted(asset.materials):
        assignment = placed.materials.get(slot, MaterialAssignment())
        mean = means.mean(package, asset.materials[slot])
        emission = placed.emission.get(slot, mean.emission)
        if assignment.asset is not None:
            source = library.package(assignment.asset)
            mean = means.mean(source, source.as_kind(MaterialAsset).material)
        assigned[slot] = replace(adjusted(mean, assignment.adjustment), emission=emission)
    return assigned

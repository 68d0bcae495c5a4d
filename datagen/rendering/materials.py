# SPDX-License-Identifier: MIT
"""Resolves the materials of slots and converts them to BSDFs.

Two slots share a BSDF and a material id if and only if package, material and adjustment are equal. UV scales
are applied to meshes instead of textures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from datagen.formats.asset import EnvironmentAsset, Material, MaterialAsset, ObjectAsset
from datagen.formats.configuration import ColorAdjustment, MaterialAssignment, PlacedAsset
from datagen.foundation.errors import Problem
from datagen.rendering.textures import TextureCache

if TYPE_CHECKING:
    from datagen.formats.package import Package
    from datagen.library import Library


@dataclass(frozen=True)
class SurfaceMaterial:
    """Material of a slot; ``name`` is the id of an assigned material, ``asset/slot`` for the asset's own."""

    name: str
    package: Package
    material: Material
    adjustment: ColorAdjustment
    emission: tuple[float, float, float] | None
    uv_scale: float | None
    is_assigned: bool

    @property
    def key(self) -> tuple:
        """Hashable key, equal for materials with equal BSDFs."""
        return (self.package.sha256, self.name, self.adjustment)

    @property
    def needs_uv(self) -> bool:
        """True if any channel is an image."""
        return bool(self.material.textures())


def resolve_materials(
    placed: PlacedAsset, package: Package, library: Library, problems: list[Problem]
) -> dict[str, SurfaceMaterial]:
    """Map the slots of a placed asset to materials; omit faulty slots and add faults to ``problems``."""
    asset = package.asset
    assert isinstance(asset, ObjectAsset | EnvironmentAsset)
    where = f"configuration: {placed.name}"
    for field, slots in (("materials", placed.materials), ("emission", placed.emission)):
        for slot in slots:
            if slot not in asset.materials:
                expected = f"a slot of {asset.id}: {', '.join(sorted(asset.materials))}"
                problems.append(Problem(where, f"{field}.{slot}", "no such slot", expected, "correct it"))
    resolved = {}
    for slot, own in asset.materials.items():
        assignment = placed.materials.get(slot, MaterialAssignment())
        source, name = package, f"{asset.id}/{slot}"
        material: Material = own
        if assignment.asset is not None:
            source = library.package(assignment.asset)
            if not isinstance(source.asset, MaterialAsset):
                expected, got = "a material", f"{assignment.asset!r} ({source.asset.kind})"
                problems.append(Problem(where, f"materials.{slot}.asset", got, expected, "choose a material"))
                continue
            material, name = source.asset.material, source.asset.id
        emission = placed.emission.get(slot, material.emission)
        if emission is not None and not any(c > 0 for c in emission):
            emission = None
        adjustment, is_assigned = assignment.adjustment, assignment.asset is not None
        resolved[slot] = SurfaceMaterial(
            name, source, material, adjustment, emission, assignment.uv_scale, is_assigned
        )
    return resolved


def make_bsdf(surface: SurfaceMaterial, textures: TextureCache, *, has_mirrored_uv: bool = False) -> Any:
    """Create the ``cook_torrance`` BSDF of a material, wrapped in ``normalmap`` and ``mask`` if needed.

    ``has_mirrored_uv`` states whether the mesh's UVs are clockwise. Mitsuba's tangent frame, which is always
    right-handed, then flips the bitangent; the normal map's green channel is flipped to compensate.
    """
    import mitsuba as mi

    material, package, adjustment = surface.material, surface.package, surface.adjustment
    description: dict[str, Any] = {"type": "cook_torrance"}
    for role in ("diffuse_albedo", "specular_albedo", "roughness"):
        description[role] = textures.channel(package, getattr(material, role), role, adjustment)
    if material.normal is not None:
        normal = textures.channel(package, material.normal, "normal", flip_green=has_mirrored_uv)
        description = {"type": "normalmap", "normalmap": normal, "bsdf": description}
    if material.opacity is not None and material.opacity != 1.0:
        opacity = textures.channel(package, material.opacity, "opacity")
        description = {"type": "mask", "opacity": opacity, "bsdf": description}
    return mi.load_dict(description)

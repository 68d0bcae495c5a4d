# SPDX-License-Identifier: MIT
"""Conversion of Mitsuba BSDFs to D, S and R; docs/importing.md describes the mapping and its errors.

A BSDF is converted to a :class:`Draft` of channel values. The scene importer applies the user's policy to
transparent drafts. Unsupported BSDFs are refused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import MaterialClass
from datagen.formats.mitsuba.scene import SceneNode
from datagen.importers import fresnel
from datagen.importers.channels import (
    BakedSource,
    ColorValue,
    ImageSource,
    ScalarValue,
    Value,
    is_constant,
)
from datagen.importers.common import OPAL_ALBEDO, ImportJob
from datagen.importers.mitsuba_values import NodeValues, rgb_of


@dataclass(frozen=True)
class Draft:
    """A converted material whose textures are not yet written.

    ``uv_matrix`` (3, 3) acts on UVs whose v points down. ``transparency``: '' for opaque, ``thin`` transmits
    light straight, ``body`` refracts it, ``null`` is invisible. ``height``: bump map in scene units.
    """

    name: str
    diffuse: ColorValue = (0.5, 0.5, 0.5)
    specular: ColorValue = (0.0, 0.0, 0.0)
    roughness: ScalarValue = 1.0
    opacity: ScalarValue | None = None
    normal: ImageSource | None = None
    height: Value | None = None
    uv_matrix: NDArray[np.float64] | None = None
    transparency: Literal["", "thin", "body", "null"] = ""
    fallback_class: MaterialClass = "other"
    approximations: tuple[str, ...] = ()

    def with_note(self, sentence: str) -> Draft:
        return replace(self, approximations=(*self.approximations, f"{self.name}: {sentence}"))


class MaterialConverter(NodeValues):
    """Converter of a scene's BSDF nodes, which collects ``problems`` for the caller to raise."""

    def __init__(self, job: ImportJob):
        super().__init__(job)
        self._drafts: dict[int, Draft] = {}

    def draft(self, node: SceneNode) -> Draft:
        """Return the draft of a BSDF; repeated calls for a node return the same object."""
        if id(node) not in self._drafts:
            self.start_material()
            draft = self._convert(node, node.id)
            self._drafts[id(node)] = replace(
                draft,
                uv_matrix=self.common_matrix(node),
                approximations=tuple(dict.fromkeys((*draft.approximations, *self.notes))),
            )
        return self._drafts[id(node)]

    def _convert(self, node: SceneNode, name: str) -> Draft:
        name = name or node.id
        self.job.budget.spend("references", 1, node.where)
        converter = _CONVERTERS.get(node.type)
        if node.tag != "bsdf" or converter is None:
            expected = f"a supported BSDF: {', '.join(_CONVERTERS)}"
            self.problems.add(node.where, f"type {node.type!r}", expected, "replace the BSDF in the scene")
            return Draft(name or "unknown")
        return converter(self, node, name or node.type)

    def _nested(self, node: SceneNode, name: str, index: int = 0) -> Draft:
        nested = node.children_of("bsdf")
        if len(nested) <= index:
            self.problems.add(
                node.where, f"{len(nested)} nested BSDFs", f"at least {index + 1}", "correct the scene"
            )
            return Draft(name)
        return self._convert(nested[index], name)

    # opaque BSDFs

    def _diffuse(self, node: SceneNode, name: str) -> Draft:
        """Convert to S = 0 and R = 1; D is reduced by the albedo that the specular lobe has even at S = 0."""
        reflectance = self.color(node, "reflectance", 0.5)
        if isinstance(reflectance, ImageSource):
            return Draft(name, diffuse=replace(reflectance, offset=-fresnel.DIFFUSE_SHEEN))
        lowered = self.cache.color(f"{name}_diffuse_albedo", lambda d: d - fresnel.DIFFUSE_SHEEN, reflectance)
        return Draft(name, diffuse=lowered)

    def _lobe_width(self, node: SceneNode, name: str) -> ScalarValue:
        """Return R of a BSDF: 0 for a smooth type, the converted ``alpha`` for a ``rough`` type."""
        return self.roughness(node, name) if node.type.startswith("rough") else 0.0

    def _plastic(self, node: SceneNode, name: str) -> Draft:
        roughness, ior = self._lobe_width(node, name), self.ior(node)
        f0 = fresnel.dielectric_f0(ior)
        nonlinear = bool(node.get("nonlinear", False))
        reflectance = self.color(node, "diffuse_reflectance", 0.5)
        strength = self.color(node, "specular_reflectance", 1.0)
        specular = self.cache.color(f"{name}_specular_albedo", lambda s: s * f0, strength)
        diffuse = self.cache.color(
            f"{name}_diffuse_albedo",
            lambda d, s: fresnel.plastic_diffuse_albedo(d, ior, nonlinear) / (1 - s),
            reflectance,
            specular,
        )
        draft = Draft(name, diffuse, specular, roughness, fallback_class="plastic")
        inner = " with scattering inside" if nonlinear else ""
        return draft.with_note(
            f"{node.type}{inner} as D of equal hemispherical albedo, S = {f0:.4f} by Schlick"
        )

    def _conductor(self, node: SceneNode, name: str) -> Draft:
        roughness = self._lobe_width(node, name)
        strength = self.color(node, "specular_reflectance", 1.0)
        if "eta" in node.values or "k" in node.values:
            eta, k = rgb_of(node.get("eta", 0.0)), rgb_of(node.get("k", 1.0))
            mean = fresnel.conductor_mean(np.array(eta), np.array(k))
        else:
            try:
                mean = np.array(fresnel.conductor_preset_mean(str(node.get("material", "Cu"))))
            except ValueError as error:
                self.problems.add(
                    f"{node.where}: material", str(error), "one of Mitsuba's conductors", "give eta and k"
                )
                mean = np.ones(3)
        specular = self.cache.color(
            f"{name}_specular_albedo", lambda s: fresnel.schlick_s_of_mean(s * mean), strength
        )
        draft = Draft(name, (0.0, 0.0, 0.0), specular, roughness, fallback_class="metal")
        if bool((mean < 1).any()):
            draft = draft.with_note("conductor Fresnel as Schlick's curve of equal hemispherical mean")
        return draft

    def _principled(self, node: SceneNode, name: str) -> Draft:
        """Convert to D = base (1 - metal)(1 - transmission), S = lerp(F0, base, metal), R = roughness."""
        base = self.color(node, "base_color", 0.5)
        metal, trans = self.scalar(node, "metallic", 0.0), self.scalar(node, "spec_trans", 0.0)
        if "eta" in node.values:
            f0 = fresnel.dielectric_f0(float(node.get("eta")))
        else:
            f0 = 0.08 * float(node.get("specular", 0.5))
        diffuse = self.cache.color(
            f"{name}_diffuse_albedo", lambda b, m, t: b * (1 - m) * (1 - t), base, scalars=(metal, trans)
        )
        specular = self.cache.color(
            f"{name}_specular_albedo", lambda b, m: f0 * (1 - m) + b * m, base, scalars=(metal,)
        )
        rough = self.scalar(node, "roughness", 0.5)
        draft = Draft(name, diffuse, specular, rough)
        for lobe in ("clearcoat", "sheen", "anisotropic", "flatness", "spec_tint", "sheen_tint"):
            if node.child(lobe) is not None or float(node.get(lobe, 0.0) or 0.0) > 0:
                draft = draft.with_note(f"{lobe} left out")
        if not is_constant(trans) or cast(float, trans) > 0:
            draft = replace(draft, transparency="body")
        return draft

    # transparent BSDFs, whose replacement is decided per shape

    def _dielectric(self, node: SceneNode, name: str) -> Draft:
        roughness, f0 = self._lobe_width(node, name), fresnel.dielectric_f0(self.ior(node))
        opal = (OPAL_ALBEDO,) * 3
        return Draft(name, opal, (f0,) * 3, roughness, transparency="body", fallback_class="glass")

    def _thindielectric(self, node: SceneNode, name: str) -> Draft:
        return replace(self._dielectric(node, name), transparency="thin")

    def _null(self, node: SceneNode, name: str) -> Draft:
        return Draft(name, transparency="null")

    # wrappers

    def _twosided(self, node: SceneNode, name: str) -> Draft:
        draft = self._nested(node, name)
        if len(node.children_of("bsdf")) > 1:
            draft = draft.with_note("the back side gets the front side's material")
        return draft

    def _mask(self, node: SceneNode, name: str) -> Draft:
        return replace(self._nested(node, name), opacity=self.scalar(node, "opacity", 0.5))

    def _bumpmap(self, node: SceneNode, name: str) -> Draft:
        texture = next(iter(node.children_of("texture")), None)
        draft = self._nested(node, name)
        if texture is None:
            return draft
        scale = float(node.get("scale", 1.0))
        height = self.texture(texture)
        if is_constant(height):
            return draft
        values = self.cache.values(height, is_scalar=True)
        baked = BakedSource((values * scale).astype(np.float32), f"{name}_height", "linear")
        return replace(draft, height=baked).with_note(
            "bump map as a normal map at the surface's median UV density"
        )

    def _normalmap(self, node: SceneNode, name: str) -> Draft:
        texture = next(iter(node.children_of("texture")), None)
        source = self.texture(texture) if texture is not None else None
        draft = self._nested(node, name)
        if not isinstance(source, ImageSource):
            self.problems.add(node.where, "no image", "a bitmap texture", "correct the scene")
            return draft
        if source.encoding == "srgb":
            draft = draft.with_note("normal map not marked raw; read as linear")
        return replace(draft, normal=replace(source, encoding="linear"))

    def _blendbsdf(self, node: SceneNode, name: str) -> Draft:
        """Blend the channels of two BSDFs linearly by the weight, with roughness blended as alpha."""
        first, second = self._nested(node, name, 0), self._nested(node, name, 1)
        weight = self.scalar(node, "weight", 0.5)
        if any(draft.transparency or draft.opacity is not None for draft in (first, second)):
            self.problems.add(
                node.where, "a blend with a transparent BSDF", "a blend of opaque BSDFs", "replace it"
            )
            return first

        def mix(a: ColorValue, b: ColorValue, label: str) -> ColorValue:
            return self.cache.color(
                f"{name}_{label}", lambda x, y, w: x * (1 - w) + y * w, a, b, scalars=(weight,)
            )

        rough = self.cache.scalar(
            f"{name}_roughness",
            lambda x, y, w: np.sqrt(x * x * (1 - w) + y * y * w),
            first.roughness,
            second.roughness,
            weight,
        )
        return replace(
            first,
            diffuse=mix(first.diffuse, second.diffuse, "diffuse_albedo"),
            specular=mix(first.specular, second.specular, "specular_albedo"),
            roughness=rough,
            approximations=tuple(dict.fromkeys(first.approximations + second.approximations)),
        ).with_note("blend of two BSDFs as one of blended channels")


_CONVERTERS: dict[str, Callable[[MaterialConverter, SceneNode, str], Draft]] = {
    "diffuse": MaterialConverter._diffuse,
    "plastic": MaterialConverter._plastic,
    "roughplastic": MaterialConverter._plastic,
    "conductor": MaterialConverter._conductor,
    "roughconductor": MaterialConverter._conductor,
    "dielectric": MaterialConverter._dielectric,
    "thindielectric": MaterialConverter._thindielectric,
    "roughdielectric": MaterialConverter._dielectric,
    "principled": MaterialConverter._principled,
    "twosided": MaterialConverter._twosided,
    "mask": MaterialConverter._mask,
    "blendbsdf": MaterialConverter._blendbsdf,
    "bumpmap": MaterialConverter._bumpmap,
    "normalmap": MaterialConverter._normalmap,
    "null": MaterialConverter._null,
}

# SPDX-License-Identifier: MIT
"""Mitsuba BSDFs to D, S and R. The mapping and its errors are set out in docs/importing.md.

A BSDF first becomes a :class:`Draft`, which says what is to be seen and where each channel comes from; the
drafts of see-through BSDFs carry their kind, so that the scene importer can apply the policy that the user
chose. BSDFs without a mapping are refused by name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import MaterialClass
from datagen.formats.mitsuba.scene import SceneNode
from datagen.foundation.budget import Budget
from datagen.foundation.errors import InputError, Problem
from datagen.foundation.findings import Findings
from datagen.foundation.paths import fault_of
from datagen.importers import fresnel
from datagen.importers.channels import (
    BakedSource,
    Color,
    ColorValue,
    ImageCache,
    ImageSource,
    ScalarValue,
    Value,
    combine,
    is_constant,
)
from datagen.importers.common import ImportOptions

CHECKER_TILE_PX = 128  # a checker edge then blurs over 1/128 of a tile under bilinear filtering
MISSING_GREY = 0.5
INSIDE_SCENE = "a file inside the scene's folder"
COPY_IT = "copy it there, or name its folder with --allow"
_DEFAULT_INT_IOR, _DEFAULT_EXT_IOR = "bk7", "air"


@dataclass(frozen=True)
class Draft:
    """A material before its files are written. ``uv_matrix`` (3, 3) acts on Mitsuba's (u, v), v downwards.

    ``transparency``: ``thin`` passes light straight, ``body`` refracts, ``null`` is not there at all.
    ``height`` is a bump map in scene units per texel value.
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


@dataclass
class _Textures:
    """Texture look-ups of one BSDF, with the UV transforms that they ask for."""

    matrices: list[NDArray[np.float64]] = field(default_factory=list)
    has_plain: bool = False


class MaterialConverter:
    """Converts BSDF nodes of one scene; problems are collected in ``problems`` and raised by the caller."""

    def __init__(
        self,
        scene_file: Path,
        options: ImportOptions,
        findings: Findings,
        cache: ImageCache,
        budget: Budget | None = None,
    ):
        self.scene_file = scene_file
        self.budget = budget or Budget(scene_file, options.limits)
        self.options = options
        self.findings = findings
        self.cache = cache
        self.problems: list[Problem] = []
        self._drafts: dict[int, Draft] = {}
        self._textures = _Textures()
        self._notes: list[str] = []

    def draft(self, node: SceneNode) -> Draft:
        """The draft of a BSDF; a second call with the same node gives the same object."""
        if id(node) not in self._drafts:
            self._textures = _Textures()
            self._notes = []
            draft = self._convert(node, node.id)
            self._drafts[id(node)] = replace(
                draft,
                uv_matrix=self._common_matrix(node),
                approximations=tuple(dict.fromkeys((*draft.approximations, *self._notes))),
            )
        return self._drafts[id(node)]

    def problem(self, field_: str, got: str, expected: str, remedy: str) -> None:
        self.problems.append(Problem(self.scene_file, field_, got, expected, remedy))

    def _convert(self, node: SceneNode, name: str) -> Draft:
        name = name or node.id
        self.budget.spend("references", 1, node.where)
        method = getattr(self, f"_{node.type}", None)
        if node.tag != "bsdf" or method is None:
            self.problem(
                node.where,
                f"type {node.type!r}",
                "a BSDF that the importer knows: diffuse, plastic, roughplastic, conductor, roughconductor, "
                "dielectric, thindielectric, roughdielectric, principled, twosided, mask, blendbsdf, "
                "bumpmap, normalmap, null",
                "replace the BSDF in the scene",
            )
            return Draft(name or "unknown")
        return cast(Draft, method(node, name or node.type))

    def _nested(self, node: SceneNode, name: str, index: int = 0) -> Draft:
        nested = node.children_of("bsdf")
        if len(nested) <= index:
            self.problem(
                node.where, f"{len(nested)} nested BSDFs", f"at least {index + 1}", "correct the scene"
            )
            return Draft(name)
        return self._convert(nested[index], name)

    # opaque BSDFs

    def _diffuse(self, node: SceneNode, name: str) -> Draft:
        """S = 0, R = 1; D is lowered by the sheen that Schlick's curve has even so: equal albedo."""
        reflectance = self._color(node, "reflectance", 0.5)
        if isinstance(reflectance, ImageSource):
            return Draft(name, diffuse=replace(reflectance, offset=-fresnel.DIFFUSE_SHEEN))
        lowered = combine(
            lambda d: d - fresnel.DIFFUSE_SHEEN,
            self.cache,
            f"{name}_diffuse_albedo",
            (reflectance, False),
            is_scalar=False,
        )
        return Draft(name, diffuse=cast(ColorValue, lowered))

    def _plastic(self, node: SceneNode, name: str) -> Draft:
        return self._any_plastic(node, name, roughness=0.0)

    def _roughplastic(self, node: SceneNode, name: str) -> Draft:
        return self._any_plastic(node, name, roughness=self._roughness(node, name))

    def _any_plastic(self, node: SceneNode, name: str, roughness: ScalarValue) -> Draft:
        ior = self._ior(node)
        f0 = fresnel.dielectric_f0(ior)
        nonlinear = bool(node.get("nonlinear", False))
        reflectance = self._color(node, "diffuse_reflectance", 0.5)
        strength = self._color(node, "specular_reflectance", 1.0)
        specular = combine(
            lambda s: s * f0, self.cache, f"{name}_specular_albedo", (strength, False), is_scalar=False
        )
        diffuse = combine(
            lambda d, s: fresnel.plastic_diffuse_albedo(d, ior, nonlinear) / (1 - s),
            self.cache,
            f"{name}_diffuse_albedo",
            (reflectance, False),
            (specular, False),
            is_scalar=False,
        )
        draft = Draft(
            name, cast(ColorValue, diffuse), cast(ColorValue, specular), roughness, fallback_class="plastic"
        )
        inner = " with scattering inside" if nonlinear else ""
        return draft.with_note(
            f"{node.type}{inner} as D of equal hemispherical albedo, S = {f0:.4f} by Schlick"
        )

    def _conductor(self, node: SceneNode, name: str) -> Draft:
        return self._any_conductor(node, name, roughness=0.0)

    def _roughconductor(self, node: SceneNode, name: str) -> Draft:
        return self._any_conductor(node, name, roughness=self._roughness(node, name))

    def _any_conductor(self, node: SceneNode, name: str, roughness: ScalarValue) -> Draft:
        strength = self._color(node, "specular_reflectance", 1.0)
        if "eta" in node.values or "k" in node.values:
            eta, k = self._constant_color(node, "eta", 0.0), self._constant_color(node, "k", 1.0)
            mean = fresnel.conductor_mean(np.array(eta), np.array(k))
        else:
            try:
                mean = np.array(fresnel.conductor_preset_mean(str(node.get("material", "Cu"))))
            except ValueError as error:
                self.problem(
                    f"{node.where}: material", str(error), "a conductor of Mitsuba", "give eta and k"
                )
                mean = np.ones(3)
        specular = combine(
            lambda s: fresnel.schlick_s_of_mean(s * mean),
            self.cache,
            f"{name}_specular_albedo",
            (strength, False),
            is_scalar=False,
        )
        draft = Draft(name, (0.0, 0.0, 0.0), cast(ColorValue, specular), roughness, fallback_class="metal")
        if bool((mean < 1).any()):
            draft = draft.with_note("conductor Fresnel as Schlick's curve of equal hemispherical mean")
        return draft

    def _principled(self, node: SceneNode, name: str) -> Draft:
        """D = base (1 - metal)(1 - transmission); S = lerp(F0, base, metal); R = roughness (method 1)."""
        base = self._color(node, "base_color", 0.5)
        metal, trans = self._scalar(node, "metallic", 0.0), self._scalar(node, "spec_trans", 0.0)
        if "eta" in node.values:
            f0 = fresnel.dielectric_f0(float(node.get("eta")))
        else:
            f0 = 0.08 * float(node.get("specular", 0.5))
        diffuse = combine(
            lambda b, m, t: b * (1 - m) * (1 - t),
            self.cache,
            f"{name}_diffuse_albedo",
            (base, False),
            (metal, True),
            (trans, True),
            is_scalar=False,
        )
        specular = combine(
            lambda b, m: f0 * (1 - m) + b * m,
            self.cache,
            f"{name}_specular_albedo",
            (base, False),
            (metal, True),
            is_scalar=False,
        )
        rough = self._scalar(node, "roughness", 0.5)
        draft = Draft(name, cast(ColorValue, diffuse), cast(ColorValue, specular), rough)
        for lobe in ("clearcoat", "sheen", "anisotropic", "flatness", "spec_tint", "sheen_tint"):
            if node.child(lobe) is not None or float(node.get(lobe, 0.0) or 0.0) > 0:
                draft = draft.with_note(f"{lobe} left out")
        if not is_constant(trans) or cast(float, trans) > 0:
            draft = replace(draft, transparency="body")
        return draft

    # see-through BSDFs: what stands in for them is decided per shape

    def _dielectric(self, node: SceneNode, name: str) -> Draft:
        return self._glass(node, name, "body", 0.0)

    def _roughdielectric(self, node: SceneNode, name: str) -> Draft:
        return self._glass(node, name, "body", self._roughness(node, name))

    def _thindielectric(self, node: SceneNode, name: str) -> Draft:
        return self._glass(node, name, "thin", 0.0)

    def _null(self, node: SceneNode, name: str) -> Draft:
        return Draft(name, transparency="null")

    def _glass(
        self, node: SceneNode, name: str, kind: Literal["thin", "body"], roughness: ScalarValue
    ) -> Draft:
        f0 = fresnel.dielectric_f0(self._ior(node))
        opal = 0.7  # about what clear glass shows of a bright room behind it
        return Draft(name, (opal,) * 3, (f0,) * 3, roughness, transparency=kind, fallback_class="glass")

    # wrappers

    def _twosided(self, node: SceneNode, name: str) -> Draft:
        draft = self._nested(node, name)
        if len(node.children_of("bsdf")) > 1:
            draft = draft.with_note("the back side gets the front side's material")
        return draft

    def _mask(self, node: SceneNode, name: str) -> Draft:
        return replace(self._nested(node, name), opacity=self._scalar(node, "opacity", 0.5))

    def _bumpmap(self, node: SceneNode, name: str) -> Draft:
        texture = next(iter(node.children_of("texture")), None)
        draft = self._nested(node, name)
        if texture is None:
            return draft
        scale = float(node.get("scale", 1.0))
        height = self._texture(texture)
        if is_constant(height):
            return draft
        values = self.cache.values(height, is_scalar=True)
        baked = BakedSource((values * scale).astype(np.float32), f"{name}_height", "linear")
        return replace(draft, height=baked).with_note(
            "bump map as a normal map at the surface's median UV density"
        )

    def _normalmap(self, node: SceneNode, name: str) -> Draft:
        texture = next(iter(node.children_of("texture")), None)
        source = self._texture(texture) if texture is not None else None
        draft = self._nested(node, name)
        if not isinstance(source, ImageSource):
            self.problem(node.where, "no image", "a bitmap texture", "correct the scene")
            return draft
        if source.encoding == "srgb":
            draft = draft.with_note("normal map not marked raw; read as linear")
        return replace(draft, normal=replace(source, encoding="linear"))

    def _blendbsdf(self, node: SceneNode, name: str) -> Draft:
        """Channels blended by the weight; alpha, not R, is what is blended."""
        first, second = self._nested(node, name, 0), self._nested(node, name, 1)
        weight = self._scalar(node, "weight", 0.5)
        if (
            first.transparency
            or second.transparency
            or first.opacity is not None
            or second.opacity is not None
        ):
            self.problem(
                node.where, "a blend with a see-through BSDF", "a blend of opaque ones", "replace it"
            )
            return first

        def mix(a: Value, b: Value, label: str) -> ColorValue:
            value = combine(
                lambda x, y, w: x * (1 - w) + y * w,
                self.cache,
                f"{name}_{label}",
                (a, False),
                (b, False),
                (weight, True),
                is_scalar=False,
            )
            return cast(ColorValue, value)

        rough = combine(
            lambda x, y, w: np.sqrt(x * x * (1 - w) + y * y * w),
            self.cache,
            f"{name}_roughness",
            (first.roughness, True),
            (second.roughness, True),
            (weight, True),
            is_scalar=True,
        )
        return replace(
            first,
            diffuse=mix(first.diffuse, second.diffuse, "diffuse_albedo"),
            specular=mix(first.specular, second.specular, "specular_albedo"),
            roughness=cast(ScalarValue, rough),
            approximations=tuple(dict.fromkeys(first.approximations + second.approximations)),
        ).with_note("blend of two BSDFs as one of blended channels")

    # parameters

    def _ior(self, node: SceneNode) -> float:
        sides = []
        for key, default in (("int_ior", _DEFAULT_INT_IOR), ("ext_ior", _DEFAULT_EXT_IOR)):
            value = node.get(key, default)
            number = fresnel.named_ior(value) if isinstance(value, str) else float(value)
            if number is None or not (math.isfinite(number) and number > 0):
                self.problem(
                    f"{node.where}: {key}",
                    repr(value),
                    "a number or a name that Mitsuba knows",
                    "use a number",
                )
                number = 1.5
            sides.append(number)
        return sides[0] / sides[1]

    def _roughness(self, node: SceneNode, name: str) -> ScalarValue:
        distribution = str(node.get("distribution", "beckmann"))
        if node.get("alpha_u") is not None or node.child("alpha_u") is not None:
            pair = self._scalar(node, "alpha_u", 0.1), self._scalar(node, "alpha_v", 0.1)
            self._notes.append(f"{name}: anisotropic roughness as the geometric mean of its two widths")
        else:
            pair = (self._scalar(node, "alpha", 0.1),) * 2
        value = combine(
            lambda u, v: fresnel.perceptual_roughness(np.sqrt(u * v), distribution),
            self.cache,
            f"{name}_roughness",
            (pair[0], True),
            (pair[1], True),
            is_scalar=True,
        )
        if distribution == "ggx":
            factor = fresnel.ALPHA_BECKMANN_PER_GGX
            self._notes.append(f"{name}: GGX lobe as the Beckmann lobe nearest to it (alpha x {factor})")
        return cast(ScalarValue, value)

    def _color(self, node: SceneNode, key: str, default: float) -> ColorValue:
        texture = node.child(key)
        if texture is not None:
            return cast(ColorValue, self._texture(texture))
        return self._constant_color(node, key, default)

    def _constant_color(self, node: SceneNode, key: str, default: float) -> Color:
        value = node.get(key, default)
        if isinstance(value, tuple | list):
            red, green, blue = (float(x) for x in value)
            return red, green, blue
        return (float(value),) * 3

    def _scalar(self, node: SceneNode, key: str, default: float) -> ScalarValue:
        texture = node.child(key)
        if texture is None:
            value = node.get(key, default)
            return (
                float(np.dot(value, [0.212671, 0.715160, 0.072169]))
                if isinstance(value, tuple)
                else float(value)
            )
        found = self._texture(texture)
        if isinstance(found, tuple):
            return float(np.dot(found, [0.212671, 0.715160, 0.072169]))
        if isinstance(found, BakedSource):
            return BakedSource(self.cache.values(found, True).mean(axis=-1), found.label, "linear")
        return found

    def _texture(self, node: SceneNode) -> Value:
        if node.type == "bitmap":
            return self._bitmap(node)
        if node.type == "checkerboard":
            self._note_matrix(node)
            first, second = (
                self._constant_color(node, "color0", 0.4),
                self._constant_color(node, "color1", 0.2),
            )
            if node.child("color0") or node.child("color1"):
                self.problem(
                    node.where, "a checkerboard of textures", "of two colours", "bake it to an image"
                )
            return checkerboard(first, second)
        self.problem(node.where, f"type {node.type!r}", "a bitmap or a checkerboard", "bake it to an image")
        return (MISSING_GREY,) * 3

    def _bitmap(self, node: SceneNode) -> Value:
        name = str(node.get("filename", ""))
        path, fault = fault_of(self.scene_file.parent, name, self.options.allowed)
        self._note_matrix(node)
        if path is None:
            self.problem(f"{node.where}: filename", f"{name!r} ({fault})", INSIDE_SCENE, COPY_IT)
            return (MISSING_GREY,) * 3
        if not path.is_file():
            if self.options.missing == "refuse":
                self.problem(
                    f"{node.where}: filename",
                    f"{name!r} (no such file)",
                    "the texture",
                    "restore it, or import with --missing replace",
                )
            else:
                self.findings.approximate(f"{name}: missing texture replaced by grey {MISSING_GREY}")
            return (MISSING_GREY,) * 3
        if str(node.get("wrap_mode", "repeat")) != "repeat":
            self.findings.approximate(f"{name}: wrap mode {node.get('wrap_mode')} as repeat")
        is_raw = bool(node.get("raw", False)) or path.suffix.lower() in (".exr", ".hdr", ".pfm")
        return ImageSource(path, "linear" if is_raw else "srgb")

    def _note_matrix(self, node: SceneNode) -> None:
        matrix = node.get("to_uv")
        if matrix is None:
            self._textures.has_plain = True
        else:
            flat = np.eye(3)
            flat[:2, :2], flat[:2, 2] = matrix[:2, :2], matrix[:2, 3]
            self._textures.matrices.append(flat)

    def _common_matrix(self, node: SceneNode) -> NDArray[np.float64] | None:
        matrices = self._textures.matrices
        if not matrices:
            return None
        same = all(np.allclose(m, matrices[0]) for m in matrices)
        if not same or (self._textures.has_plain and not np.allclose(matrices[0], np.eye(3))):
            self.problem(
                node.where,
                "textures with different to_uv",
                "one UV transform a material",
                "bake them to one layout",
            )
        return matrices[0]


def checkerboard(color0: Color, color1: Color) -> BakedSource:
    """One tile of Mitsuba's checkerboard: color0 where u and v are both in the same half, rows downwards."""
    side = CHECKER_TILE_PX
    half = np.arange(side) >= side // 2
    is_first = half[:, None] == half[None, :]
    values = np.where(is_first[..., None], np.asarray(color0), np.asarray(color1)).astype(np.float32)
    return BakedSource(values, "checkerboard", "srgb")


def normal_from_height(height: NDArray[np.float32], uv_per_m: float) -> NDArray[np.float32]:
    """Tangent-space normals (H, W, 3) of a tiling height map in metres, +Y up, for a given UV density.

    The slope along u is dh/du * uv_per_m; rows run downwards, so that +v is minus the row direction.
    """
    rows, columns = height.shape
    slope_u = (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)) * (0.5 * columns) * uv_per_m
    slope_v = (np.roll(height, 1, axis=0) - np.roll(height, -1, axis=0)) * (0.5 * rows) * uv_per_m
    normal = np.stack([-slope_u, -slope_v, np.ones_like(height)], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def raise_problems(problems: list[Problem]) -> None:
    """Raise an :class:`InputError` with all problems, each once."""
    if problems:
        raise InputError(*dict.fromkeys(problems))

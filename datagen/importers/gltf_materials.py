# SPDX-License-Identifier: MIT
"""Conversion of glTF materials to D, S and R; other properties are approximated or refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import SlotMaterial, Texture
from datagen.foundation.errors import InputError
from datagen.foundation.images import normalized
from datagen.foundation.meshes.gltf import GltfFile
from datagen.foundation.meshes.gltf_compressed import BASIS
from datagen.foundation.naming import slug, unique
from datagen.importers.channels import (
    BakedSource,
    ChannelName,
    Color,
    ColorValue,
    ImageSource,
    ScalarValue,
)
from datagen.importers.classes import REPLACEABLE, guess_class
from datagen.importers.common import OPAL_ALBEDO, RESTORE_IT, ImportJob
from datagen.importers.pbr import DEFAULT_F0, metallic_roughness

_LEFT_OUT = (
    "KHR_materials_clearcoat", "KHR_materials_sheen", "KHR_materials_iridescence", "KHR_materials_anisotropy",
    "KHR_materials_volume", "KHR_materials_dispersion",
)  # fmt: skip


@dataclass
class GltfMaterial:
    """A converted material with the UV set and UV transform (3, 3; None: identity) of its textures."""

    slot: str
    material: SlotMaterial
    uv_set: int = 0
    uv_matrix: NDArray[np.float64] | None = None


class GltfMaterialConverter:
    """Converter of a glTF file's materials, which collects ``problems`` for the caller to raise."""

    def __init__(self, file: GltfFile, job: ImportJob):
        self.file, self.job = file, job
        self.cache, self.textures, self.problems = job.cache, job.textures, job.problems
        self._done: dict[int, GltfMaterial] = {}

    def convert(self, index: int | None, *hints: str) -> GltfMaterial:
        """Convert material ``index`` (None: glTF's default); its name and ``hints`` determine its class."""
        key = -1 if index is None else index
        if key not in self._done:
            entry = {} if index is None else self.file.item("materials", index, "primitive.material")
            self._uv_sets: set[int] = set()
            self._uv_matrices: list[NDArray[np.float64]] = []
            self._notes: list[str] = []
            name = str(entry.get("name") or ("default" if index is None else f"material_{index}"))
            taken = {m.slot for m in self._done.values()}
            material = self._material(entry, unique(name, taken), hints)
            self._done[key] = self._with_uv(GltfMaterial(unique(name, taken), material))
        return self._done[key]

    def _with_uv(self, material: GltfMaterial) -> GltfMaterial:
        sets, matrices, where = self._uv_sets, self._uv_matrices, f"material {material.slot!r}"
        if len(sets) > 1:
            self.problems.add(where, f"UV sets {sorted(sets)}", "one UV set per material", "bake to one set")
        if any(not np.allclose(m, matrices[0]) for m in matrices):
            expected = "one UV transform per material"
            self.problems.add(where, "different texture transforms", expected, "bake them")
        matrix = matrices[0] if matrices and not np.allclose(matrices[0], np.eye(3)) else None
        return replace(material, uv_set=min(sets, default=0), uv_matrix=matrix)

    def _material(self, entry: dict[str, Any], name: str, hints: tuple[str, ...]) -> SlotMaterial:
        pbr, extensions = entry.get("pbrMetallicRoughness", {}), entry.get("extensions", {})
        if "KHR_materials_pbrSpecularGlossiness" in extensions and not pbr:
            remedy = "convert it to metallic-roughness"
            self.problems.add(f"material {name!r}", "specular-glossiness", "metallic-roughness", remedy)
        for extension in _LEFT_OUT:
            if extension in extensions:
                self._note(name, f"{extension.removeprefix('KHR_materials_')} left out")
        if "KHR_materials_unlit" in extensions:
            self._note(name, "unlit, converted to a lit surface of its colour")
        base = self._base(pbr, name)
        packed = self._image(pbr.get("metallicRoughnessTexture"), name, "linear")
        rough = self._times(packed, float(pbr.get("roughnessFactor", 1.0)), "g")
        metal = self._times(packed, float(pbr.get("metallicFactor", 1.0)), "b")
        base = self._transmission(base, extensions, name)
        f0 = self._f0(extensions, name)
        diffuse, specular, rough = metallic_roughness(self.cache, slug(name), base, metal, rough, f0)
        if "occlusionTexture" in entry:
            self.job.findings.note(f"{name}: occlusion map left out, since light is traced")
        emission = self._emission(entry, extensions, name)
        classes = self.job.options.classes or (guess_class(name, *hints),)
        return SlotMaterial(
            classes=classes,
            diffuse_albedo=self.textures.color(diffuse),
            specular_albedo=self.textures.color(specular),
            roughness=self.textures.scalar(rough),
            opacity=self._opacity(entry, pbr, name),
            normal=self._normal(entry.get("normalTexture"), name),
            emission=emission,
            approximations=tuple(dict.fromkeys(self._notes)),
            replaceable_by=REPLACEABLE[classes[0]] if emission is None else (),
        )

    def _note(self, name: str, sentence: str) -> None:
        self._notes.append(self.job.findings.approximate(f"{name}: {sentence}"))

    def _base(self, pbr: dict[str, Any], name: str) -> ColorValue:
        factor = _color(pbr.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))[:3])
        image = self._image(pbr.get("baseColorTexture"), name, "srgb")
        if image is None:
            return factor
        if min(factor) == max(factor):
            return replace(image, scale=factor[0])
        return self.cache.color(
            f"{slug(name)}_base", lambda c: c * np.asarray(factor, dtype=np.float32), image
        )

    def _times(self, image: ImageSource | None, factor: float, channel: ChannelName) -> ScalarValue:
        return factor if image is None else replace(image, channel=channel, scale=factor)

    def _f0(self, extensions: dict[str, Any], name: str) -> ColorValue:
        """Return F0 of the dielectric part: ((ior - 1) / (ior + 1))^2 times tint and specular strength."""
        ior = float(extensions.get("KHR_materials_ior", {}).get("ior", 1.5))
        f0 = ((ior - 1) / (ior + 1)) ** 2 if ior > 0 else 1.0
        specular = extensions.get("KHR_materials_specular")
        if specular is None:
            return (f0 if ior != 1.5 else DEFAULT_F0,) * 3
        tint = np.asarray(specular.get("specularColorFactor", (1.0, 1.0, 1.0)), dtype=np.float32)
        strength = float(specular.get("specularFactor", 1.0))
        weight = self._image(specular.get("specularTexture"), name, "linear")
        color = self._image(specular.get("specularColorTexture"), name, "srgb")
        return self.cache.color(
            f"{slug(name)}_f0",
            lambda c, w: np.minimum(f0 * tint * c, 1.0) * w * strength,
            color if color is not None else (1.0, 1.0, 1.0),
            scalars=(replace(weight, channel="a") if weight is not None else 1.0,),
        )

    def _transmission(self, base: ColorValue, extensions: dict[str, Any], name: str) -> ColorValue:
        factor = float(extensions.get("KHR_materials_transmission", {}).get("transmissionFactor", 0.0))
        if factor <= 0:
            return base
        if self.job.options.dielectric == "refuse" and name not in self.job.options.dielectric_as:
            remedy = "import with --dielectric replace"
            self.problems.add(f"material {name!r}", f"transmission {factor:g}", "an opaque material", remedy)
            return base
        self._note(name, f"transmission {factor:g} as opaque opal glass")
        return self.cache.color(f"{slug(name)}_opal", lambda c: c * (1 - factor + OPAL_ALBEDO * factor), base)

    def _opacity(self, entry: dict[str, Any], pbr: dict[str, Any], name: str) -> float | Texture | None:
        mode = entry.get("alphaMode", "OPAQUE")
        if mode == "OPAQUE":
            return None
        factor = float(pbr.get("baseColorFactor", (1.0,) * 4)[3])
        image = self._image(pbr.get("baseColorTexture"), name, "srgb")
        if image is not None and self.cache.pixels(image.file).shape[2] not in (2, 4):
            image = None  # an image without alpha is opaque
        cutoff = float(entry.get("alphaCutoff", 0.5)) if mode == "MASK" else None
        if image is None:
            value = factor if cutoff is None else float(factor >= cutoff)
            return None if value >= 1 else value
        alpha: ScalarValue = ImageSource(image.file, "linear", "a", factor)
        if cutoff is not None:
            limit = cutoff
            alpha = self.cache.scalar(
                f"{slug(name)}_opacity", lambda a: (a >= limit).astype(np.float32), alpha
            )
        result = self.textures.scalar(alpha)
        return None if result == 1.0 else result

    def _normal(self, info: dict[str, Any] | None, name: str) -> Texture | None:
        image = self._image(info, name, "linear", "normal map left out")
        if image is None or info is None:
            return None
        scale = float(info.get("scale", 1.0))
        if scale == 1.0:
            return image.texture(self.textures.add_file(image.file))
        values = normalized(self.cache.pixels(image.file))[..., :3] * 2 - 1
        values = values * np.array([scale, scale, 1.0], dtype=np.float32)
        values /= np.maximum(np.linalg.norm(values, axis=-1, keepdims=True), 1e-6)
        return self.textures.add_baked(
            BakedSource(values * 0.5 + 0.5, f"{slug(name)}_normal_scaled", "linear")
        )

    def _emission(
        self, entry: dict[str, Any], extensions: dict[str, Any], name: str
    ) -> tuple[float, float, float] | None:
        strength = float(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
        factor = np.asarray(entry.get("emissiveFactor", (0.0, 0.0, 0.0)), dtype=np.float64) * strength
        if not (factor > 0).any():
            return None
        image = self._image(entry.get("emissiveTexture"), name, "srgb", "emissive map left out")
        if "emissiveTexture" in entry:
            if image is None:
                return None
            factor = factor * self.cache.values(image, is_scalar=False).mean(axis=(0, 1))
            self._note(name, "emissive map as its mean")
            if factor.max() < 0.02:
                self._note(name, "faint emission left out")
                return None
        red, green, blue = (float(f"{x:.6g}") for x in factor)
        return red, green, blue

    def _image(
        self, info: dict[str, Any] | None, name: str, encoding: str, instead: str = "only its factor is used"
    ) -> ImageSource | None:
        """Return the image of a texture reference, if available, and record its UV set and transform."""
        if info is None:
            return None
        texture = self.file.item("textures", info.get("index"), f"material {name!r}")
        extensions = texture.get("extensions", {})
        source = texture.get("source", extensions.get(BASIS, {}).get("source"))
        source = extensions.get("EXT_texture_webp", {}).get("source", source)
        try:
            path = self.file.image_file(source, f"material {name!r}")
        except InputError as error:
            self.problems += error.problems
            return None
        if not path.is_file():
            if self.job.options.missing == "refuse":
                got = f"{path.name!r} (no such file)"
                self.problems.add(f"material {name!r}", got, "its image", RESTORE_IT)
            else:
                self._note(name, f"missing image {path.name}: {instead}")
            return None
        transform = info.get("extensions", {}).get("KHR_texture_transform", {})
        self._uv_sets.add(int(transform.get("texCoord", info.get("texCoord", 0))))
        self._uv_matrices.append(_uv_matrix(transform))
        return ImageSource(path, "srgb" if encoding == "srgb" else "linear")


def _uv_matrix(transform: dict[str, Any]) -> NDArray[np.float64]:
    """Return the (3, 3) matrix of a KHR_texture_transform, which acts on UVs whose v points down."""
    angle = float(transform.get("rotation", 0.0))
    su, sv = transform.get("scale", (1.0, 1.0))
    ou, ov = transform.get("offset", (0.0, 0.0))
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine * su, sine * sv, ou], [-sine * su, cosine * sv, ov], [0.0, 0.0, 1.0]])


def _color(values: Any) -> Color:
    red, green, blue = (min(max(float(v), 0.0), 1.0) for v in values)
    return red, green, blue

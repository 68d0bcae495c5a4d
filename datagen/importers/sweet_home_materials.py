# SPDX-License-Identifier: MIT
"""Conversion of Phong materials (MTL) to D, S and R. Colours are sRGB, as in Sweet Home 3D.

As in the program's renderings, D is ``map_Kd``, not multiplied by ``Kd``, or ``Kd`` if there is no map. The
Phong model has no F0; ``phong_channels`` derives it by a convention (docs/importing.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal, cast

import numpy as np

from datagen.formats.asset import MaterialClass, SlotMaterial
from datagen.foundation.color import linear_from_srgb
from datagen.foundation.images import normalized
from datagen.importers.annotate import Annotations
from datagen.importers.channels import Color, ColorValue, ImageSource, ScalarValue
from datagen.importers.classes import REPLACEABLE, guess_class
from datagen.importers.common import OPAL_ALBEDO, RESTORE_IT, ImportJob
from datagen.importers.fresnel import perceptual_roughness
from datagen.importers.obj_model import PhongMaterial

F0_PER_SPECULAR = 0.08
"""F0 of a non-metal at Ks = 1; Ks = 0.5, the default in Blender and Disney's model, gives 0.04."""
MIN_F0, MAX_ALBEDO = 0.02, 0.9
_METAL_F0 = (0.3, 0.95)  # range for metals; a darker "metal" is treated as painted
_INVISIBLE = 0.02  # opacity below which Sweet Home 3D does not show a surface
_OPAQUE = 0.999
_MIRROR_F0 = 0.9
_LEFT_OUT = (
    "map_ks", "map_ns", "map_ka", "map_ke", "map_bump", "bump", "map_refl", "refl", "map_disp", "disp",
)  # fmt: skip

Treatment = Literal["opaque", "remove", "pane"]


@dataclass(frozen=True)
class PhongChannels:
    """D, S (linear) and R of a material of constant colour."""

    diffuse: Color
    specular: Color
    roughness: float


@dataclass
class ConvertedMaterial:
    """A converted material; ``treatment`` ``remove`` removes its surface, ``pane`` removes it if flat."""

    slot: str
    material: SlotMaterial
    treatment: Treatment = "opaque"


def phong_roughness(exponent: float) -> float:
    """Return R of the Beckmann lobe that has the peak of a Blinn-Phong lobe: alpha^2 = 2 / (exponent + 2)."""
    return float(perceptual_roughness(np.sqrt(2 / (max(exponent, 0.0) + 2)), "beckmann"))


def phong_channels(phong: PhongMaterial, is_metal: bool, is_mirror: bool = False) -> PhongChannels:
    """Convert a material without textures to D, S and R.

    Non-metals: D = Kd (at most 0.9), S = 0.08 Ks (at least 0.02), R from Ns, or 1 without a highlight.
    Metals: D = 0, S = Kd + Ks (at most 0.95); if S < 0.3, they count as non-metals. Mirrors: S = 0.9, R = 0.
    """
    kd = linear_from_srgb(np.clip(phong.diffuse, 0.0, 1.0))
    ks = np.clip(phong.specular, 0.0, 1.0)
    if is_mirror:
        return PhongChannels((0.0, 0.0, 0.0), (_MIRROR_F0,) * 3, 0.0)
    shines = phong.illumination >= 2 and ks.max() > 0
    roughness = float(f"{phong_roughness(phong.exponent):.4g}") if shines else 1.0
    metal = np.minimum(kd + linear_from_srgb(ks), _METAL_F0[1])
    if is_metal and shines and metal.max() >= _METAL_F0[0]:
        return PhongChannels((0.0, 0.0, 0.0), _color(metal), roughness)
    f0 = max(F0_PER_SPECULAR * float(ks.mean()), MIN_F0) if phong.illumination >= 2 else MIN_F0
    return PhongChannels(_color(np.minimum(kd, MAX_ALBEDO)), (float(f"{f0:.4g}"),) * 3, roughness)


class PhongConverter:
    """Converter of a model's materials, which collects ``problems`` for the caller to raise.

    ``find_file`` returns the path of an image by its lower-case base name, or None. ``hints``: names from
    which a material's class may be guessed.
    """

    def __init__(
        self,
        job: ImportJob,
        find_file: Callable[[str], Path | None],
        hints: tuple[str, ...],
        known: Annotations,
    ):
        self.options, self.findings, self.problems = job.options, job.findings, job.problems
        self.cache, self.textures = job.cache, job.textures
        self.find_file, self.hints, self.known = find_file, hints, known
        self._notes: list[str] = []

    def convert(self, slot: str, phong: PhongMaterial, *, is_mirror: bool, has_uv: bool) -> ConvertedMaterial:
        """Convert the material of a slot; ``has_uv``: whether its surface has texture coordinates."""
        self._notes = []
        image = self._image(slot, phong.maps.get("map_kd"))
        stem = image.file.stem if image is not None else ""
        classes = self._classes(slot, stem, is_mirror)
        channels = phong_channels(phong, classes[0] == "metal", is_mirror)
        if classes[0] == "metal" and max(channels.diffuse) > 0:
            classes = ("painted",)
        diffuse, specular = cast(ColorValue, channels.diffuse), cast(ColorValue, channels.specular)
        opacity: ScalarValue | None = None
        if image is not None and not has_uv:
            self._note(f"{slot}: no texture coordinates, the mean of {image.file.name} is used")
            mean = _color(self.cache.values(image, is_scalar=False).mean(axis=(0, 1), dtype=np.float64))
            image, diffuse = None, mean
        if image is not None:
            opacity = self._cut_out(image, phong, slot)
            if max(channels.diffuse) == 0:  # a metal: its texture tints the reflection
                specular = image
            else:
                diffuse = image
        for keyword in _LEFT_OUT:
            if keyword in phong.maps:
                self._note(f"{slot}: {keyword} left out")
        treatment = self._treatment(slot, phong)
        if treatment == "pane" and image is None:
            diffuse = _color(np.asarray(diffuse) * phong.opacity + OPAL_ALBEDO * (1 - phong.opacity))
        emission = self._emission(slot, phong)
        material = SlotMaterial(
            classes=classes,
            diffuse_albedo=self.textures.color(diffuse),
            specular_albedo=self.textures.color(specular),
            roughness=channels.roughness,
            opacity=None if opacity is None else self.textures.scalar(opacity),
            emission=emission,
            approximations=tuple(dict.fromkeys(self._notes)),
            replaceable_by=REPLACEABLE[classes[0]] if emission is None and opacity is None else (),
        )
        return ConvertedMaterial(slot, self.known.corrected(slot, material), treatment)

    def _note(self, sentence: str) -> None:
        self._notes.append(self.findings.approximate(sentence))

    def _classes(self, slot: str, stem: str, is_mirror: bool) -> tuple[MaterialClass, ...]:
        if self.options.classes:
            return self.options.classes
        if is_mirror:
            return ("metal",)
        guess = guess_class(slot, stem)
        if guess == "other" and self.hints:
            by_name = guess_class(*self.hints)
            guess = by_name if by_name != "glass" else guess  # only the top of a glass table is of glass
        return (guess,)

    def _image(self, slot: str, statement: str | None) -> ImageSource | None:
        """Return the image that a map statement names, or None; options and folders in it are ignored."""
        if not statement:
            return None
        name = _file_name(statement)
        # Sweet Home 3D uses the last word of a name with blanks, and some models rely on that
        for candidate in (name, name.split()[-1]):
            file = self.find_file(candidate.lower())
            if file is not None:
                return ImageSource(file, "srgb")
        if self.options.missing == "refuse":
            self.problems.add(f"material {slot!r}", f"{name!r} (no such file)", "its image", RESTORE_IT)
        else:
            self._note(f"{slot}: missing image {name}: only its colour is used")
        return None

    def _cut_out(self, image: ImageSource, phong: PhongMaterial, slot: str) -> ScalarValue | None:
        """Return the opacity, from the alpha of the colour image or from ``map_d``; None if opaque."""
        mask: ImageSource | None = None
        pixels = self.cache.pixels(image.file)
        if pixels.shape[2] in (2, 4):
            mask = ImageSource(image.file, "linear", "a")
        elif "map_d" in phong.maps and _file_name(phong.maps["map_d"]).lower() != image.file.name.lower():
            found = self._image(slot, phong.maps["map_d"])
            mask = None if found is None else ImageSource(found.file, "linear", "r")
        if mask is None:
            return None
        channel = -1 if mask.channel == "a" else 0
        values = normalized(self.cache.pixels(mask.file))[..., channel]
        return None if float(values.min()) >= _OPAQUE else mask

    def _treatment(self, slot: str, phong: PhongMaterial) -> Treatment:
        """Return how to treat a surface of uniform opacity; record a problem if it is refused."""
        if phong.opacity >= _OPAQUE:
            return "opaque"
        if phong.opacity < _INVISIBLE:
            self.findings.note(f"{slot}: an invisible surface (d {phong.opacity:g}), left out")
            return "remove"
        chosen = self.options.dielectric_as.get(slot)
        if chosen == "remove":
            return "remove"
        if chosen is None and self.options.dielectric == "refuse":
            remedy = "import with --dielectric replace, or choose with --dielectric-as NAME=opaque|remove"
            expected = "opaque materials: the project's BSDF does not transmit light"
            got = f"transparent (d {phong.opacity:g})"
            self.problems.add(f"material {slot!r}", got, expected, remedy)
        elif chosen is None:
            self._note(f"{slot}: transparent (d {phong.opacity:g}) as opaque opal glass, flat panes left out")
            return "pane"
        self._note(f"{slot}: transparent (d {phong.opacity:g}) as opaque")
        return "opaque"

    def _emission(self, slot: str, phong: PhongMaterial) -> Color | None:
        if max(phong.emission) <= 0:
            return None
        emission = linear_from_srgb(np.clip(phong.emission, 0.0, 1.0))
        if emission.max() < 0.02:
            self._note(f"{slot}: faint emission left out")
            return None
        self._note(f"{slot}: Ke has no unit, taken as W/(m^2 sr)")
        return _color(emission)


def _file_name(statement: str) -> str:
    """Return the last component of the path in a map statement.

    The path, which may contain blanks, follows the last option and its arguments.
    """
    words = statement.replace("\\", "/").split()
    while len(words) > 1 and words[0].startswith("-"):
        words = words[1:]
        while len(words) > 1 and _is_argument(words[0]):
            words = words[1:]
    return PurePosixPath(" ".join(words)).name


def _is_argument(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return word in ("on", "off", "r", "g", "b", "m", "l", "z")
    return True


def _color(values: np.ndarray) -> Color:
    red, green, blue = (min(max(float(f"{x:.4g}"), 0.0), 1.0) for x in values)
    return red, green, blue

# SPDX-License-Identifier: MIT
"""Import of PBR texture folders with the file names of ambientCG or Poly Haven as material packages.

Examples: ``Wood051_1K_Color.jpg``, ``Wood051_1K-JPG_NormalGL.jpg``, ``oak_diff_1k.jpg``, ``oak_arm_1k.jpg``.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from datagen.formats.asset import Material, MaterialAsset, MaterialClass, Texture
from datagen.foundation.errors import Problem, input_error, raise_problems
from datagen.foundation.images import encode_png
from datagen.foundation.naming import slug
from datagen.foundation.paths import fault_of
from datagen.importers.channels import (
    ColorValue,
    ImageSource,
    ScalarValue,
    encode_exr,
)
from datagen.importers.classes import ROLE_OF_WORD, guess_class
from datagen.importers.common import ImportedAsset, ImportJob, ImportOptions, provenance
from datagen.importers.packaging import finish
from datagen.importers.pbr import green_points_up, metallic_roughness

_IMAGES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff", ".tga", ".bmp")
_RESOLUTION = re.compile(r"[_-]\d+k(?=[_\-.]|$)|[_-](jpg|png)(?=_|$)", re.I)
_LEFT_OUT = ("occlusion", "displacement", "emission", "specular")
DEFAULT_TILE_M = 1.0


def role_of(name: str) -> str:
    """Return the role that an image's file name implies, such as ``roughness``; '' if none."""
    stem = _RESOLUTION.sub("", Path(name).stem).lower().replace("-", "_")
    words = stem.split("_")
    for length in (2, 1):
        role = ROLE_OF_WORD.get("_".join(words[-length:])) if len(words) > length or length == 1 else None
        if role:
            return role
    return ""


def find_maps(folder: Path) -> dict[str, list[Path]]:
    """Return the images of a folder by role, sorted by name; symbolic links are not resolved."""
    maps: dict[str, list[Path]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in _IMAGES and (path.is_file() or path.is_symlink()):
            role = role_of(path.name)
            if role:
                maps.setdefault(role, []).append(path)
    return maps


def is_material_folder(folder: Path) -> bool:
    """Return whether a folder contains a colour map and at least one other map, recognised by name."""
    maps = find_maps(folder) if folder.is_dir() else {}
    return "color" in maps and len(maps) > 1


def import_material_folder(
    folder: Path, out_library: Path, options: ImportOptions | None = None
) -> ImportedAsset:
    """Convert a texture folder to a material package in ``out_library/materials/<id>``.

    Raises :class:`InputError` for a folder without a colour map, several images for one channel, a missing
    licence, or an unreadable image.
    """
    return _MaterialImporter(folder, options or ImportOptions()).run(out_library)


class _MaterialImporter(ImportJob):
    def __init__(self, folder: Path, options: ImportOptions):
        if not folder.is_dir():
            raise input_error(folder, "", "no such folder", "a folder of textures", "check the path")
        super().__init__(folder, options)
        self.folder, self.maps = folder, find_maps(folder)

    def one(self, role: str) -> Path | None:
        """Return the image of a role, or None; forbidden or multiple images are recorded as problems."""
        found = []
        for path in self.maps.get(role, []):
            file, fault = fault_of(self.folder, path.name, self.options.allowed)
            if file is None:
                expected = "an image in the folder"
                remedy = "copy it there, or name its folder with --allow"
                self.problems.append(Problem(path, role, fault, expected, remedy))
            else:
                found.append(path)
        if len(found) > 1:
            names = ", ".join(p.name for p in found)
            expected = "one image; put each resolution into a separate folder"
            self.problems.add(role, names, expected, "remove the others")
        return found[0] if found else None

    def run(self, out_library: Path) -> ImportedAsset:
        source, title = provenance(self.folder, self.folder, self.options, self.findings)
        color = self.one("color")
        if "color" not in self.maps:
            expected = "a colour map (..._Color, ..._diff)"
            self.problems.add("color", "none", expected, "check the folder")
        (roughness, metallic), normal, opacity = self.scalars(), self.normal(), self.one("opacity")
        raise_problems(self.problems)
        assert color is not None
        name = self.options.asset_id or slug(self.folder.name)
        base: ColorValue = ImageSource(color, "linear" if color.suffix.lower() == ".exr" else "srgb")
        diffuse, specular, roughness = metallic_roughness(self.cache, name, base, metallic, roughness)
        for role in _LEFT_OUT:
            if role in self.maps:
                self.findings.approximate(f"{name}: {role} map left out")
        tile = self.options.tile_size_m
        if tile is None:
            tile = DEFAULT_TILE_M
            self.findings.note(f"{name}: tile width assumed to be {tile:g} m; give --tile-size if known")
        material = Material(
            classes=self.classes(color, title),
            diffuse_albedo=self.textures.color(diffuse),
            specular_albedo=self.textures.color(specular),
            roughness=self.textures.scalar(roughness),
            opacity=self.textures.scalar(ImageSource(opacity, "linear")) if opacity else None,
            normal=normal,
            tile_size_m=tile,
            approximations=self.findings.approximations,
        )
        asset = MaterialAsset(
            id=name,
            title=self.options.title or title or self.folder.name.replace("-", " ").title(),
            provenance=source,
            material=material,
        )
        return finish(asset, self.textures.files, out_library / "materials", self.options, self.findings)

    def scalars(self) -> tuple[ScalarValue, ScalarValue]:
        """Return roughness and metalness, as images or constants."""
        packed, rough, metal = self.one("arm"), self.one("roughness"), self.one("metalness")
        roughness: ScalarValue = 0.5
        metallic: ScalarValue = 0.0
        if packed is not None:
            roughness, metallic = ImageSource(packed, "linear", "g"), ImageSource(packed, "linear", "b")
        if rough is not None:
            roughness = ImageSource(rough, "linear", "r")
        if metal is not None:
            metallic = ImageSource(metal, "linear", "r")
        if packed is None and rough is None:
            self.findings.approximate(f"{self.folder.name}: no roughness map, R = 0.5")
        return roughness, metallic

    def normal(self) -> Texture | None:
        """Return the normal map in OpenGL orientation; the green channel of DirectX maps is inverted."""
        up, down, unknown = self.one("normal_gl"), self.one("normal_dx"), self.one("normal")
        path = up or down or unknown
        if path is None:
            return None
        is_up = up is not None
        if up is None and down is None:
            pixels = self.cache.pixels(path)
            height = self.one("displacement")
            slopes = None if height is None else self.cache.pixels(height)
            is_up = pixels.dtype.kind != "u" or green_points_up(pixels, slopes)
            made = "OpenGL" if is_up else "DirectX"
            self.findings.note(
                f"{path.name}: orientation taken from the pixels ({made}), since the name has none"
            )
        if is_up:
            return Texture(texture=self.textures.add_file(path), encoding="linear")
        flipped = np.array(self.cache.pixels(path)[..., :3])
        is_float = flipped.dtype.kind == "f"
        flipped[..., 1] = (1 if is_float else np.iinfo(flipped.dtype).max) - flipped[..., 1]
        name = f"textures/{slug(path.stem)}_gl{'.exr' if is_float else '.png'}"
        self.textures.files[name] = encode_exr(flipped) if is_float else encode_png(flipped)
        return Texture(texture=name, encoding="linear")

    def classes(self, color: Path, title: str) -> tuple[MaterialClass, ...]:
        if self.options.classes:
            return self.options.classes
        guessed = guess_class(title, self.folder.name, color.stem)
        if guessed == "other":
            self.findings.note(f"{self.folder.name}: material class unknown; give it with --class")
        return (guessed,)

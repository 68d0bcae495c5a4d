# SPDX-License-Identifier: MIT
"""Statistics of the materials of each class in a library, the source of ``CLASS_RANGES``.

    python -m datagen.assembly.class_statistics LIBRARY [LIBRARY ...]

Prints for each main class the number of materials and the 5th, 50th and 95th percentiles of the brightest
channel of mean D and of mean R, each followed by its limits in ``CLASS_RANGES``. The last columns are medians
over materials of the spreads within a texture: of hue (in turns), saturation and value (factors), and R.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.assembly.materials import CLASS_RANGES, MeanMaterials
from datagen.formats.asset import MATERIAL_CLASSES, Material, MaterialAsset, PanoramaAsset, Texture
from datagen.formats.package import Package
from datagen.formats.textures import texture_values
from datagen.foundation.command_line import LibraryPaths, run_function
from datagen.foundation.images import read_image
from datagen.library import Library

_MAX_SIDE_TEXELS = 128  # textures are subsampled to below twice this size: spreads need few texels
_MIN_SATURATION = 0.05  # hue and saturation of less saturated texels are noise


@dataclass(frozen=True)
class MaterialSample:
    """Mean R and brightest channel of mean D (``value``) of a material, and spreads of its texels.

    Spreads are standard deviations: of hue in turns, of saturation and value as factors (geometric), and of
    R. They are NaN without a texture; spreads of hue and saturation also if all texels are grey.
    """

    value: float
    roughness: float
    hue_spread: float
    saturation_spread: float
    value_spread: float
    roughness_spread: float


def _spread_of_color(texels: NDArray) -> tuple[float, float, float]:
    """Return the spreads of hue, saturation and value of texels (H, W, 3), as in :class:`MaterialSample`."""
    import cv2

    hsv = cv2.cvtColor(np.ascontiguousarray(texels, dtype=np.float32), cv2.COLOR_RGB2HSV).reshape(-1, 3)
    hue, saturation, value = hsv.T.astype(np.float64)
    turn = np.exp(2j * np.pi * hue / 360)
    colored = saturation > _MIN_SATURATION
    hue_spread = saturation_spread = float("nan")
    if colored.any():
        turns = np.angle(turn[colored] / turn[colored].mean()) / (2 * np.pi)
        hue_spread = float(np.sqrt((turns**2).mean()))
        saturation_spread = float(np.exp(np.log(saturation[colored]).std()))
    bright = value > 1e-3
    return hue_spread, saturation_spread, float(np.exp(np.log(value[bright]).std())) if bright.any() else 1.0


def sample_material(package: Package, material: Material, means: MeanMaterials) -> MaterialSample:
    """Measure the means and spreads of one material of a package."""
    mean = means.mean(package, material)

    def texels(texture: Texture, is_scalar: bool) -> NDArray:
        pixels = read_image(package.local_file(texture.texture))
        step = max(1, max(pixels.shape[:2]) // _MAX_SIDE_TEXELS)
        return texture_values(texture, pixels[::step, ::step], is_scalar)

    nan = float("nan")
    color, rough = (nan, nan, nan), nan
    if isinstance(material.diffuse_albedo, Texture):
        color = _spread_of_color(texels(material.diffuse_albedo, False))
    if isinstance(material.roughness, Texture):
        rough = float(texels(material.roughness, True).std())
    return MaterialSample(max(mean.diffuse_albedo), mean.roughness, *color, rough)


def sample_library(library: Library) -> dict[str, list[MaterialSample]]:
    """Measure the materials of a library without emission and opacity, grouped by main class."""
    means = MeanMaterials()
    found: dict[str, list[MaterialSample]] = defaultdict(list)
    for package in library:
        asset = package.asset
        if isinstance(asset, MaterialAsset):
            materials: list[Material] = [asset.material]
        elif isinstance(asset, PanoramaAsset):
            continue
        else:
            materials = [asset.materials[slot] for slot in sorted(asset.materials)]
        for material in materials:
            if material.emission is None and material.opacity is None:
                found[material.classes[0]].append(sample_material(package, material, means))
    return found


def main(paths: LibraryPaths) -> None:
    """Print the statistics of the materials of libraries by class."""
    with Library(paths) as library:
        found = sample_library(library)
    print("class      n    value 5/50/95 %   limits     roughness 5/50/95 %  limits     spread h/s/v/R")
    for name in MATERIAL_CLASSES:
        samples = found.get(name, [])
        if not samples:
            continue
        limits = CLASS_RANGES[name]  # type: ignore[index]
        value = np.percentile([s.value for s in samples], [5, 50, 95])
        rough = np.percentile([s.roughness for s in samples], [5, 50, 95])
        spreads = [
            np.array([getattr(s, f"{channel}_spread") for s in samples])
            for channel in ("hue", "saturation", "value", "roughness")
        ]
        medians = [f"{np.median(s[np.isfinite(s)]):.3f}" if np.isfinite(s).any() else "-" for s in spreads]
        print(
            f"{name:9s} {len(samples):3d}   {value[0]:.2f} {value[1]:.2f} {value[2]:.2f}"
            f"    {limits.value_limits[0]:.2f}-{limits.value_limits[1]:.2f}"
            f"    {rough[0]:.2f} {rough[1]:.2f} {rough[2]:.2f}"
            f"       {limits.roughness_limits[0]:.2f}-{limits.roughness_limits[1]:.2f}  {' '.join(medians)}"
        )


if __name__ == "__main__":
    run_function(main)

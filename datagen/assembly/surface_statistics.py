# SPDX-License-Identifier: MIT
"""Statistics of materials by kind of surface, the source of :data:`datagen.assembly.looks.LOOKS`.

    python -m datagen.assembly.surface_statistics LIBRARY [LIBRARY ...]

Prints for each kind of surface (wall, floor, fitting ...) in environments the number and area of slots, and
the minimum, area-weighted median and maximum over slots of the value, saturation and hue of mean D, of the
brightest channel of mean S, and of mean R. Emissive and transparent slots and hues of greys are excluded.
"""

from __future__ import annotations

import colorsys
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from datagen.assembly.geometry import load_geometry
from datagen.assembly.materials import MeanMaterials
from datagen.assembly.surfaces import surfaces_of
from datagen.formats.asset import SURFACES, EnvironmentAsset
from datagen.foundation.command_line import LibraryPaths, run_function
from datagen.library import Library

_MIN_SATURATION = 0.05  # the hue of a less saturated colour is noise


@dataclass(frozen=True)
class SurfaceSample:
    """Area of a slot and its material's means: value, saturation and hue (in turns, NaN for greys) of D,
    brightest channel of S, and R.
    """

    area_m2: float
    value: float
    saturation: float
    hue: float
    specular: float
    roughness: float


def sample_surfaces(library: Library) -> dict[str, list[SurfaceSample]]:
    """Measure all opaque, non-emissive slots of the library's environments, by kind of surface."""
    means = MeanMaterials()
    found: dict[str, list[SurfaceSample]] = defaultdict(list)
    for package in library:
        asset = package.asset
        if not isinstance(asset, EnvironmentAsset):
            continue
        geometry = load_geometry(package)
        areas = np.bincount(geometry.part_of_face, geometry.rays.areas, len(asset.parts))
        surfaces = surfaces_of(geometry)
        for slot, material in asset.materials.items():
            if material.emission is not None or material.opacity is not None:
                continue
            mean = means.mean(package, material)
            hue, saturation, value = colorsys.rgb_to_hsv(*mean.diffuse_albedo)
            area = sum(float(areas[k]) for k, part in enumerate(asset.parts) if part.material == slot)
            shown = hue if saturation > _MIN_SATURATION else float("nan")
            sample = SurfaceSample(area, value, saturation, shown, max(mean.specular_albedo), mean.roughness)
            found[surfaces[slot]].append(sample)
    return found


def weighted_median(values: list[float], weights: list[float]) -> float:
    """Return the lower weighted median of the finite values with positive weight; NaN if there are none."""
    pairs = sorted((v, w) for v, w in zip(values, weights, strict=True) if np.isfinite(v) and w > 0)
    if not pairs:
        return float("nan")
    half = 0.5 * sum(w for _, w in pairs)
    total = 0.0
    for value, weight in pairs:
        total += weight
        if total >= half:
            return value
    return pairs[-1][0]


def _range(samples: list[SurfaceSample], field: str) -> str:
    values = [float(getattr(sample, field)) for sample in samples]
    finite = [v for v in values if np.isfinite(v)]
    if not finite:
        return "-"
    middle = weighted_median(values, [sample.area_m2 for sample in samples])
    return f"{min(finite):.2f} {middle:.2f} {max(finite):.2f}"


def main(paths: LibraryPaths) -> None:
    """Print the statistics of the materials in libraries by kind of surface."""
    with Library(paths) as library:
        found = sample_surfaces(library)
    print(
        "| surface | slots | m2 | value of D | saturation | hue | S | R |\n|---|---|---|---|---|---|---|---|"
    )
    for name in SURFACES:
        samples = found.get(name, [])
        if samples:
            area = sum(sample.area_m2 for sample in samples)
            cells = (_range(samples, f) for f in ("value", "saturation", "hue", "specular", "roughness"))
            print(f"| {name} | {len(samples)} | {area:.0f} | {' | '.join(cells)} |")


if __name__ == "__main__":
    run_function(main)

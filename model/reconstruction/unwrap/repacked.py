# SPDX-License-Identifier: MIT
"""Chooses the atlas size and the scales of an unwrap's charts, for texels as fine as photographed pixels.

A lawn outside the windows may be twenty times as large as the room, so at one scale for all charts, most
texels would belong to unphotographed surfaces. Charts therefore get as many texels per metre as views have
pixels there, and large unphotographed charts get fewer, unless this saves little.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import ViewGeometry
from model.reconstruction.unwrap.charts import chart_of_faces, packed, uv_areas
from model.reconstruction.unwrap.uv import UvReport, padding_texels

MIN_SIZE, MAX_SIZE = 256, 16384
MAX_PIXELS = 20_000
FINE_QUANTILE = 0.9
"""Quantile of pixels per metre, over pixels, to which texels are matched."""
_GRAZING_COSINE = 0.1  # bounds the footprints of grazing views
MAX_REDUCTION = 8.0
"""Ratio of the highest texel density (per metre) to the lowest, which large unphotographed charts have."""
SMALL_SIDE = 64.0
"""Minimum square root of a chart's number of texels, unless the chart already has the highest density."""
MAX_SIDE_RATIO = 0.8
"""Maximum ratio of the atlas side after repacking to the side before, at equal texel density of the finest
charts, for which the mesh's own layout is replaced."""


@dataclass(frozen=True)
class PixelDensity:
    """Samples of the views' pixels on the surface.

    ``face`` (K,): triangle that the pixel shows; ``per_m`` (K,): pixels per metre there, f sqrt(cos) / z,
    with focal length f in pixels, cosine of the angle of incidence and depth z.
    """

    face: NDArray[np.int32]
    per_m: NDArray[np.float64]

    @property
    def footprint_m(self) -> float | None:
        """Side in metres of a pixel's footprint at :data:`FINE_QUANTILE`; None if no surface is visible."""
        return float(1 / np.quantile(self.per_m, FINE_QUANTILE)) if len(self.per_m) else None


def pixel_density(views: Iterable[tuple[Camera, ViewGeometry]]) -> PixelDensity:
    """Sample the surface pixels of each view at a regular stride, fewer than 2 x ``MAX_PIXELS`` per view."""
    faces, densities = [np.zeros(0, np.int32)], [np.zeros(0)]
    for camera, view in views:
        step = max(1, view.face.size // MAX_PIXELS)
        z = view.depth_z_m.ravel()[::step].astype(np.float64)
        cosine = view.cosine(camera).ravel()[::step]
        hit = z > 0
        focal = np.sqrt(camera.fx_px * camera.fy_px)
        faces.append(view.face.ravel()[::step][hit])
        densities.append(focal * np.sqrt(np.maximum(cosine[hit], _GRAZING_COSINE)) / z[hit])
    return PixelDensity(np.concatenate(faces), np.concatenate(densities))


def atlas_size(footprint_m: float | None, metres_per_side: float) -> int:
    """Compute the side, a multiple of 256 in [256, 16384], of an atlas over ``metres_per_side`` with texels
    of ``footprint_m`` metres; 256 if that is None."""
    if footprint_m is None:
        return MIN_SIZE
    return int(np.clip(np.ceil(metres_per_side / footprint_m / 256) * 256, MIN_SIZE, MAX_SIZE))


def repacked(mesh: Mesh, report: UvReport, density: PixelDensity) -> tuple[Mesh, UvReport]:
    """Return ``mesh`` with its charts scaled to the views' pixels and packed again, and its ``report``; both
    unchanged if this saves little.
    """
    if density.footprint_m is None:
        return mesh, report
    assert mesh.uv is not None
    chart = np.unique(chart_of_faces(mesh), return_inverse=True)[1]
    num = int(chart.max()) + 1
    finest = 1 / density.footprint_m
    area_m2, area_uv = (np.bincount(chart, areas, num) for areas in (mesh.areas(), uv_areas(mesh)))
    wanted = np.maximum(
        _chart_densities(density, chart, num), SMALL_SIDE / np.sqrt(np.maximum(area_m2, 1e-30))
    )
    wanted = np.clip(wanted, finest / MAX_REDUCTION, finest)
    scale = np.where(
        area_uv > 0, wanted * np.sqrt(area_m2 / np.maximum(area_uv, 1e-30)), 0.0
    )  # texels per unit of UV
    of_vertex = np.zeros(len(mesh.positions), np.int64)
    of_vertex[mesh.faces] = chart[:, None]
    scaled = (mesh.uv * scale[of_vertex, None]).astype(np.float32)
    made, side = packed(replace(mesh, uv=scaled), chart)
    max_ratio = MAX_SIDE_RATIO if report.source == "mesh" else 1.0
    if side > max_ratio * report.metres_per_side * finest:
        return mesh, report
    return made, replace(
        report,
        is_repacked=True,
        coverage=float(uv_areas(made).sum()),
        metres_per_side=side / finest,
        padding_texels=padding_texels(made),
    )


def _chart_densities(density: PixelDensity, chart: NDArray, num: int) -> NDArray[np.float64]:
    """Compute the quantile :data:`FINE_QUANTILE` of pixels per metre on each of ``num`` charts, 0 if
    unphotographed; ``chart`` (M,): chart of each triangle.
    """
    which = chart[density.face]
    order = np.lexsort((density.per_m, which))
    count = np.bincount(which, minlength=num)
    fine = np.cumsum(count) - count + np.floor(FINE_QUANTILE * np.maximum(count - 1, 0)).astype(np.int64)
    found = np.zeros(num)
    found[count > 0] = density.per_m[order][fine[count > 0]]
    return found

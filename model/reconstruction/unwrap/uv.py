# SPDX-License-Identifier: MIT
"""Makes UVs for an atlas: the mesh's own UVs if they are a valid unwrap, else new ones.

UVs are valid if all are inside the unit square, none is degenerate and no triangles overlap, up to small
tolerances. New ones are planar charts of one scale (``planar``), packed by xatlas (``charts.packed``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh, compacted
from datagen.foundation.progress import Advance, no_advance
from datagen.geometry.traced import face_normals
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.unwrap.charts import PACK_SIZE, chart_of_faces, packed, uv_areas
from model.reconstruction.unwrap.planar import PlanarCharts

MIN_PADDING_TEXELS = 1
MAX_PACKINGS = 4
"""Maximum number of packings; triangles that overlap in one become separate charts in the next."""
_MAX_PADDING, _MAX_CHART_FACES = 8, 1_000_000
_CHECK_SIZE = 1024
_CHECK_OFFSET = (0.5123, 0.4871)  # avoids samples on edges, where two triangles meet
_MAX_OVERLAP = 0.002  # share of the covered area; tolerates a few texels along touching charts
_MAX_UNMAPPED = 0.001  # share of the surface with degenerate UVs
_RANGE_SLACK = 1e-5


@dataclass(frozen=True)
class UvReport:
    """Quality of an unwrap.

    ``source``: origin of the UVs; ``rejected``: fault of the mesh's UVs, or ''; ``coverage``: share of the
    atlas with a surface; ``metres_per_side``: length on the surface that corresponds to the atlas side, as
    the median or, if ``is_repacked`` (the scales of charts were changed), on the finest charts; ``stretch``:
    ratio of the 95th to the 5th percentile of texel density by area before repacking, ideally 1;
    ``num_charts``: number of charts; ``padding_texels``: see :func:`padding_texels`.
    """

    source: Literal["mesh", "planar"]
    rejected: str
    coverage: float
    metres_per_side: float
    stretch: float
    num_charts: int = 1
    padding_texels: int | None = None
    is_repacked: bool = False

    @property
    def notes(self) -> list[str]:
        """Messages for the user about faults of the unwrap."""
        notes = [f"the mesh's own UVs are not used: {self.rejected}"] if self.rejected else []
        if self.padding_texels is not None and self.padding_texels < MIN_PADDING_TEXELS:
            notes.append("charts touch each other: colours may bleed over seams in coarse mip levels")
        return notes


def unwrapped(mesh: Mesh, progress: Advance = no_advance) -> tuple[Mesh, UvReport]:
    """Return the mesh with UVs for an atlas; triangles keep their order, but vertices may be split."""
    fault = "" if mesh.uv is None else own_uv_fault(mesh)
    if mesh.uv is not None and not fault:
        return mesh, _report(mesh, "mesh", "")
    charts = PlanarCharts(mesh)
    for number in range(MAX_PACKINGS):
        made, _side_m = packed(charts.projected(), charts.chart)
        progress(number + 1, MAX_PACKINGS)
        overlapping = _overlapping(made)
        if not overlapping.any():
            break
        charts.separate(overlapping)
    progress(MAX_PACKINGS, MAX_PACKINGS)
    return compacted(made), _report(made, "planar", fault)


def own_uv_fault(mesh: Mesh) -> str:
    """Return the reason why the mesh's UVs are not a valid unwrap, or '' if they are."""
    assert mesh.uv is not None
    used = mesh.uv[np.unique(mesh.faces)]
    low, high = float(used.min()), float(used.max())
    if low < -_RANGE_SLACK or high > 1 + _RANGE_SLACK:
        return f"UVs run from {low:.3g} to {high:.3g}, outside [0, 1]"
    areas = mesh.areas()
    unmapped = float(areas[uv_areas(mesh) <= 1e-12].sum() / max(areas.sum(), 1e-30))
    if unmapped > _MAX_UNMAPPED:
        return f"{unmapped:.1%} of the surface has UVs without area"
    surface = TexelSurface(mesh, face_normals(mesh), _CHECK_SIZE)
    highest, is_several = surface.overlaps(_CHECK_OFFSET)
    share = float(is_several.sum() / max(int((highest >= 0).sum()), 1))
    return f"{share:.1%} of the layout overlaps itself" if share > _MAX_OVERLAP else ""


def padding_texels(mesh: Mesh) -> int | None:
    """Compute the texels between the two nearest charts on an atlas of 1024 texels per side, at most 8; None
    for meshes of over a million triangles.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    if len(mesh.faces) > _MAX_CHART_FACES:
        return None
    bare = compacted(Mesh(mesh.positions, mesh.faces, None, mesh.uv))
    face = TexelSurface(bare, face_normals(bare), _CHECK_SIZE).faces(0, 0, _CHECK_SIZE, _CHECK_SIZE)
    chart = np.where(face >= 0, chart_of_faces(bare)[np.maximum(face, 0)], -1)
    highest, lowest = chart, np.where(chart >= 0, chart, np.iinfo(np.int32).max)
    for distance in range(1, _MAX_PADDING + 1):
        highest, lowest = maximum_filter(highest, 3), minimum_filter(lowest, 3)
        if ((chart >= 0) & (highest != lowest)).any():
            return distance - 1
    return _MAX_PADDING


def _overlapping(mesh: Mesh) -> NDArray[np.bool_]:
    """Compute the mask (M,) of triangles that overlap one of lower index in UVs, all False for few texels."""
    highest, is_several = TexelSurface(mesh, face_normals(mesh), PACK_SIZE).overlaps(_CHECK_OFFSET)
    overlapping = np.zeros(len(mesh.faces), np.bool_)
    several = highest[is_several]
    if len(several) > 0.1 * _MAX_OVERLAP * (highest >= 0).sum():
        overlapping[several] = True
    return overlapping


def _report(mesh: Mesh, source: Literal["mesh", "planar"], rejected: str) -> UvReport:
    areas, of_uv = mesh.areas(), uv_areas(mesh)
    usable = (areas > 0) & (of_uv > 0)
    density = np.sqrt(of_uv[usable] / areas[usable])
    order = np.argsort(density)
    share = np.cumsum(areas[usable][order]) / areas[usable].sum()
    low, middle, high = (density[order][np.searchsorted(share, q)] for q in (0.05, 0.5, 0.95))
    return UvReport(
        source,
        rejected,
        coverage=float(min(of_uv.sum(), 1.0)),
        metres_per_side=float(1 / middle),
        stretch=float(high / low),
        num_charts=len(np.unique(chart_of_faces(mesh))),
        padding_texels=padding_texels(mesh),
    )

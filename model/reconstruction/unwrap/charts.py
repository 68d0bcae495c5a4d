# SPDX-License-Identifier: MIT
"""Connected pieces of a mesh, on its surface and in its UVs (charts), and the packing of charts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh, compacted, welded

PACK_SIZE = 2048
PADDING = 2
"""Texels between charts in an atlas of about :data:`PACK_SIZE` texels per side."""
_EXPECTED_COVERAGE = 0.7
_TRIALS = (1.0, 0.96, 1.04)
"""Scales of the charts that are tried, since the side of a packing varies by up to a fifth by chance."""


def chart_of_faces(mesh: Mesh) -> NDArray[np.int32]:
    """Compute each triangle's chart index (M,); triangles that share a position and UV share a chart."""
    return _pieces(compacted(Mesh(mesh.positions, mesh.faces, None, mesh.uv)).faces)


def connected_pieces(mesh: Mesh) -> NDArray[np.int32]:
    """Compute each triangle's piece (M,); triangles that share a corner's position share a piece."""
    return _pieces(welded(mesh)[1][mesh.faces])


def uv_areas(mesh: Mesh) -> NDArray[np.float64]:
    """Compute the areas (M,) of the triangles' UVs."""
    assert mesh.uv is not None
    corners = mesh.uv.astype(np.float64)[mesh.faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])


def _pieces(corners: NDArray) -> NDArray[np.int32]:
    """Number the connected pieces of triangles whose corners (M, 3) are vertex indices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    num = int(corners.max(initial=-1)) + 1
    first, second = corners[:, :2].ravel(), corners[:, 1:].ravel()
    graph = coo_array((np.ones(len(first), np.int32), (first, second)), shape=(num, num))
    return connected_components(graph, directed=False)[1][corners[:, 0]].astype(np.int32)


def packed(mesh: Mesh, chart: NDArray) -> tuple[Mesh, float]:
    """Return ``mesh`` with its charts packed by xatlas, and the unit square's side in units of ``mesh.uv``.

    ``mesh.uv`` has each chart at its intended relative scale, at any position; ``chart`` (M,): chart of each
    triangle. Charts are rotated, mirrored, and stretched to whole texels, so the narrowest are a texel wide.
    """
    assert mesh.uv is not None
    uv = mesh.uv.astype(np.float64)
    chart = np.unique(chart, return_inverse=True)[1].astype(np.uint32)
    of_vertex = np.zeros(len(uv), np.int64)
    of_vertex[mesh.faces] = chart[:, None]
    low, high = np.full((int(chart.max()) + 1, 2), np.inf), np.full((int(chart.max()) + 1, 2), -np.inf)
    np.minimum.at(low, np.repeat(chart, 3), uv[mesh.faces].reshape(-1, 2))
    np.maximum.at(high, np.repeat(chart, 3), uv[mesh.faces].reshape(-1, 2))
    texel = max(np.sqrt(uv_areas(mesh).sum() / _EXPECTED_COVERAGE), 1e-30) / PACK_SIZE
    uv = (uv - low[of_vertex]) / texel + _apart((high - low) / texel)[of_vertex]
    layouts = [(factor, *_placed(factor * uv, mesh.faces, chart)) for factor in _TRIALS]
    factor, placed, side = min(layouts, key=lambda layout: layout[2] / layout[0])
    return replace(mesh, uv=placed.astype(np.float32)), side * texel / factor


def _apart(sizes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lay out boxes of ``sizes`` (K, 2) in rows, disjointly, since xatlas joins charts with equal UVs; return
    their corners (K, 2)."""
    order = np.argsort(-sizes[:, 1], kind="stable")
    width, height = (sizes[order] + 1).T
    starts = np.cumsum(width) - width
    row = np.unique((starts / np.sqrt((width * height).sum())).astype(np.int64), return_inverse=True)[1]
    first = np.searchsorted(row, np.arange(row[-1] + 1))
    tops = np.cumsum(np.concatenate([[0.0], height[first[:-1]]]))
    places = np.empty_like(sizes)
    places[order] = np.stack([starts - starts[first][row], tops[row]], axis=1)
    return places


def _placed(
    uv: NDArray[np.float64], faces: NDArray, chart: NDArray[np.uint32]
) -> tuple[NDArray[np.float64], float]:
    """Pack charts whose ``uv`` (N, 2) are in texels; return UVs in the unit square and its side in texels."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(uv.astype(np.float32), faces.astype(np.uint32), chart[:, None])
    options = xatlas.PackOptions()
    options.texels_per_unit, options.padding, options.bilinear = 1.0, PADDING, True
    atlas.generate(xatlas.ChartOptions(), options)
    if atlas.atlas_count != 1:
        raise RuntimeError(f"xatlas made {atlas.atlas_count} atlases of one mesh")
    source, _, placed = atlas.get_mesh(0)
    side = float(max(atlas.width, atlas.height))
    made = np.full(uv.shape, np.nan)
    is_placed = atlas.get_mesh_vertex_assignment(0)[0] == 0
    made[source[is_placed]] = placed[is_placed] * [atlas.width / side, atlas.height / side]
    return _collapsed(made, faces), side


def _collapsed(uv: NDArray[np.float64], faces: NDArray) -> NDArray[np.float64]:
    """Replace NaN: vertices of degenerate triangles, which xatlas omits, get another corner's UV, or 0."""
    for face in faces[np.isnan(uv[faces, 0]).any(axis=1)]:
        sound = face[~np.isnan(uv[face, 0])]
        missing = face[np.isnan(uv[face, 0])]
        uv[missing] = uv[sound[0]] if len(sound) else 0.0
    return np.nan_to_num(uv)

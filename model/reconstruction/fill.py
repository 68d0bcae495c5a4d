# SPDX-License-Identifier: MIT
"""Fills what no view has seen of an atlas, and chooses how large an atlas should be.

Inside a chart that is seen in part, unseen texels take the nearest seen texel of the same chart; the
triangles of charts that are not seen at all take the mean of the nearest seen triangle in the room. Texels
between charts take the nearest texel with surface, so that filtering at seams and in smaller versions finds
no foreign colour. ``count`` keeps telling seen from filled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.cameras import Camera
from datagen.meshes import Mesh
from model.reconstruction.geometry import ViewGeometry
from model.reconstruction.merge import NUM_CHANNELS, Atlas

BAND = 1024
"""Rows that are worked on at a time."""
GUTTER = 128
"""Texels above and below a band that may fill it."""
MAX_CHARTS = 20_000  # beyond, charts are so small that filling by triangle is as good
MIN_SIZE, MAX_SIZE = 256, 16384
_GRAZING_COSINE = 0.1  # footprints grow without bound towards grazing views


def chart_of_faces(mesh: Mesh) -> NDArray[np.int32]:
    """(M,) chart of each triangle: those that share a vertex, UVs and all, belong together."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    faces, num = mesh.faces.astype(np.int64), len(mesh.positions)
    rows = np.concatenate([faces[:, 0], faces[:, 1]])
    columns = np.concatenate([faces[:, 1], faces[:, 2]])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(num, num))
    return connected_components(graph, directed=False)[1][faces[:, 0]].astype(np.int32)


def fill_unseen(atlas: Atlas, mesh: Mesh) -> None:
    """Give every texel a value; ``mesh`` is the one that the atlas was merged for."""
    means, num_seen = _face_means(atlas, len(mesh.faces))
    if not num_seen.any():
        return  # nothing was seen at all: there is nothing to fill with
    charts = chart_of_faces(mesh)
    is_filled = _fill_charts(atlas, mesh, charts, num_seen)
    nearest = _nearest_means(mesh, means, num_seen)
    for top in range(0, atlas.size, BAND):
        rows = slice(top, top + BAND)
        face = atlas.face[rows]
        left = (face >= 0) & (atlas.count[rows] == 0) & ~is_filled[charts[np.maximum(face, 0)]]
        _put(atlas, rows, left, nearest[face[left]])
    _fill_gutters(atlas)


def _put(atlas: Atlas, rows: slice, mask: NDArray[np.bool_], values: NDArray) -> None:
    first = 0
    for array in atlas.maps.values():
        channels = array.shape[2]
        array[rows][mask] = values[:, first : first + channels]
        first += channels


def _face_means(atlas: Atlas, num_faces: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Mean (M, 7) of each triangle's seen texels, and how many there are (M,)."""
    sums, num_seen = np.zeros((num_faces, NUM_CHANNELS)), np.zeros(num_faces, np.int64)
    for top in range(0, atlas.size, BAND):
        rows = slice(top, top + BAND)
        seen = atlas.count[rows] > 0
        face = atlas.face[rows][seen]
        num_seen += np.bincount(face, minlength=num_faces)
        column = 0
        for array in atlas.maps.values():
            values = array[rows][seen].astype(np.float32)
            for channel in range(values.shape[1]):
                sums[:, column] += np.bincount(face, values[:, channel], num_faces)
                column += 1
    return sums / np.maximum(num_seen, 1)[:, None], num_seen


def _nearest_means(mesh: Mesh, means: NDArray, num_seen: NDArray) -> NDArray:
    """(M, 7) the mean of each triangle or, where it has none, of the nearest that has one."""
    from scipy.spatial import cKDTree

    centroids = mesh.triangles().mean(axis=1)
    known = np.flatnonzero(num_seen)
    _, index = cKDTree(centroids[known]).query(centroids)
    return means[known[index]]


def _fill_charts(atlas: Atlas, mesh: Mesh, charts: NDArray, num_seen: NDArray) -> NDArray[np.bool_]:
    """Fill within charts that are seen in part; returns which charts are now complete, by chart."""
    assert mesh.uv is not None
    num_charts = int(charts.max()) + 1
    seen_in_chart = np.bincount(charts, num_seen, num_charts) > 0
    is_filled = np.zeros(num_charts, dtype=bool)
    if int(seen_in_chart.sum()) > MAX_CHARTS:
        return is_filled
    corners = mesh.uv.astype(np.float64)[mesh.faces]
    low, high = np.full((num_charts, 2), np.inf), np.full((num_charts, 2), -np.inf)
    np.minimum.at(low, charts, corners.min(axis=1))
    np.maximum.at(high, charts, corners.max(axis=1))
    for chart in np.flatnonzero(seen_in_chart):
        left, right = _span(low[chart, 0], high[chart, 0], atlas.size)
        top, bottom = _span(1 - high[chart, 1], 1 - low[chart, 1], atlas.size)
        window = (slice(top, bottom), slice(left, right))
        face = atlas.face[window]
        own = (face >= 0) & (charts[np.maximum(face, 0)] == chart)
        seen = own & (atlas.count[window] > 0)
        unseen = own & ~seen
        if unseen.any() and seen.any():
            _copy_nearest(atlas, window, seen, unseen)
        is_filled[chart] = bool(seen.any())
    return is_filled


def _span(low: float, high: float, size: int) -> tuple[int, int]:
    return max(int(low * size) - 1, 0), min(int(np.ceil(high * size)) + 1, size)


def _copy_nearest(atlas: Atlas, window: tuple[slice, slice], source: NDArray, target: NDArray) -> None:
    """Values of the nearest ``source`` texel of a window for its ``target`` texels."""
    nearest = nearest_index(source)[target]
    for array in atlas.maps.values():
        part = array[window]
        part[target] = part.reshape(-1, part.shape[2])[nearest]


def nearest_index(source: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(H, W): flat index of the nearest True pixel, about Euclidean. At least one must be True."""
    import cv2

    mask = np.where(source, 0, 255).astype(np.uint8)
    labels: Any = cv2.distanceTransformWithLabels(mask, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
    index = np.zeros(int(labels.max()) + 1, dtype=np.int64)
    at = np.flatnonzero(source)
    index[labels.ravel()[at]] = at
    return index[labels]


def _fill_gutters(atlas: Atlas) -> None:
    for top in range(0, atlas.size, BAND):
        start, stop = max(top - GUTTER, 0), min(top + BAND + GUTTER, atlas.size)
        rows = slice(top, min(top + BAND, atlas.size))
        covered = atlas.face[start:stop] >= 0
        if not covered.any():
            continue
        empty = np.zeros_like(covered)
        empty[top - start : rows.stop - start] = ~covered[top - start : rows.stop - start]
        _copy_nearest(atlas, (slice(start, stop), slice(0, atlas.size)), covered, empty)


def atlas_size(
    views: Sequence[tuple[Camera, ViewGeometry]], metres_per_side: float, quantile: float = 0.1
) -> int:
    """Side of an atlas whose texels are as fine as the views' pixels on the surface.

    A pixel covers z / f / sqrt(cos) on a surface at depth z; the finest tenth of all pixels (``quantile``)
    sets the texel. The result is a multiple of 256 in [256, 16384].
    """
    footprints = []
    for camera, view in views:
        step = max(1, view.face.size // 20_000)
        z = view.depth_z_m.ravel()[::step].astype(np.float64)
        normal = view.normal_world.reshape(-1, 3)[::step]
        cosine = -(normal * camera.ray_directions().reshape(-1, 3)[::step]).sum(axis=1)
        hit = z > 0
        focal = np.sqrt(camera.fx_px * camera.fy_px)
        footprints.append(z[hit] / focal / np.sqrt(np.maximum(cosine[hit], _GRAZING_COSINE)))
    joined = np.concatenate(footprints) if footprints else np.zeros(0)
    if joined.size == 0:
        return MIN_SIZE
    wanted = metres_per_side / float(np.quantile(joined, quantile))
    return int(np.clip(np.ceil(wanted / 256) * 256, MIN_SIZE, MAX_SIZE))

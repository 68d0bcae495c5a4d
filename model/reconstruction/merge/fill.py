# SPDX-License-Identifier: MIT
"""Fills unobserved texels of an atlas.

In a partly observed chart, an unobserved texel gets the value of the nearest observed one, which fades with
distance into the chart's typical value (a median), since the border of the observed part is the least
accurate. A hardly observed chart has the typical value of its connected piece of the mesh. Triangles of
unobserved charts get the mean of the triangle with the most observed texels among the nearest ones. Texels
between charts get the value of the nearest texel with a surface, which avoids filtering artefacts at seams
and in mip levels. ``count`` remains 0 at filled texels.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.peak_memory import num_threads
from datagen.foundation.progress import Advance, no_advance
from datagen.multiview.compiled import compiled
from model.reconstruction.atlas.atlas import MAP_COLUMNS, Atlas
from model.reconstruction.merge.medians import NUM_CHANNELS
from model.reconstruction.unwrap.charts import chart_of_faces, connected_pieces

BAND = 1024
"""Number of rows that are processed at once."""
GUTTER = 128
"""Number of rows above and below a band whose texels may fill its gutters (texels between charts)."""
FADE_TEXELS = 16.0
"""Distance in texels from the observed part of a chart at which the nearest observed texel and the chart's
typical value have equal weights."""
HARDLY_SEEN = 0.03
"""Ratio of the observed areas of a chart and its connected piece at which their typical values have equal
weights."""
NEAREST = 8
"""Number of nearest observed triangles among which the one with the most observed texels is copied to an
unobserved triangle, since small triangles at silhouettes mix materials."""
MAX_CHARTS = 20_000  # if there are more, charts are so small that filling by triangle suffices
_LARGE_WINDOW = 2**22  # memory is released after charts with more texels


def fill_unseen(atlas: Atlas, mesh: Mesh, progress: Advance = no_advance) -> None:
    """Fill all unobserved texels, including those between charts; ``mesh`` is the unwrapped mesh."""

    def part(number: int) -> Advance:
        """Return the progress callback of part ``number``, 0 to 3."""
        return lambda done, total: progress(100 * number + 100 * done // total, 400)

    means, num_seen = _face_means(atlas, len(mesh.faces), part(0))
    if not num_seen.any():
        return
    charts = chart_of_faces(mesh)
    typical = typical_values(charts, connected_pieces(mesh), means, num_seen).astype(np.float32)
    is_filled = _fill_charts(atlas, mesh, charts, num_seen, typical, part(1))
    nearest = _nearest_means(mesh, means, num_seen).astype(np.float16).view(np.uint16)
    needs = ~is_filled[charts]
    for rows in _bands(atlas, part(2)):
        for name, columns in MAP_COLUMNS.items():
            values = atlas.maps[name][rows].view(np.uint16)  # copied faster than half floats
            _put_means(values, atlas.face[rows], atlas.count[rows], needs, nearest, columns.start)
    _fill_gutters(atlas, part(3))


def _bands(atlas: Atlas, progress: Advance) -> Iterator[slice]:
    """Yield the row range of each band; finished bands are released from memory."""
    for top in range(0, atlas.size, BAND):
        bottom = min(top + BAND, atlas.size)
        yield slice(top, bottom)
        atlas.release()
        progress(bottom, atlas.size)


def _face_means(
    atlas: Atlas, num_faces: int, progress: Advance
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Compute the mean (M, 7) of each triangle's observed texels, and their number (M,)."""
    sums, num_seen = np.zeros((num_faces, NUM_CHANNELS)), np.zeros(num_faces, np.int64)
    for rows in _bands(atlas, progress):
        face, count = atlas.face[rows], atlas.count[rows]
        _count_seen(face, count, num_seen)
        for name, columns in MAP_COLUMNS.items():
            _add_values(atlas.maps[name][rows].astype(np.float32), face, count, sums, columns.start)
    return sums / np.maximum(num_seen, 1)[:, None], num_seen


@compiled
def _count_seen(face_of: Any, count: Any, num_seen: Any) -> None:
    for row in range(face_of.shape[0]):
        for column in range(face_of.shape[1]):
            if count[row, column] > 0:
                num_seen[face_of[row, column]] += 1


@compiled
def _add_values(values: Any, face_of: Any, count: Any, sums: Any, first: Any) -> None:
    for row in range(face_of.shape[0]):
        for column in range(face_of.shape[1]):
            if count[row, column] > 0:
                for channel in range(values.shape[2]):
                    sums[face_of[row, column], first + channel] += values[row, column, channel]


@compiled
def _put_means(values: Any, face_of: Any, count: Any, needs: Any, means: Any, first: Any) -> None:
    for row in range(face_of.shape[0]):
        for column in range(face_of.shape[1]):
            face = face_of[row, column]
            if face >= 0 and count[row, column] == 0 and needs[face]:
                for channel in range(values.shape[2]):
                    values[row, column, channel] = means[face, first + channel]


def _nearest_means(mesh: Mesh, means: NDArray, num_seen: NDArray) -> NDArray:
    """Return the mean (M, 7) of each triangle or, if it is unobserved, of the triangle with the most observed
    texels among the :data:`NEAREST` ones, in the same connected piece unless all of it is unobserved.
    """
    from scipy.spatial import cKDTree

    centroids = mesh.triangles().mean(axis=1)
    piece = connected_pieces(mesh)
    known = np.flatnonzero(num_seen)
    is_seen = np.isin(piece, piece[known])
    apart = 10 * float(np.linalg.norm(np.ptp(centroids, axis=0)))  # exceeds all distances within a piece
    by_piece = np.column_stack([centroids, apart * piece])
    source = np.arange(len(centroids))
    for which, place in ((is_seen, by_piece), (~is_seen, centroids)):
        rows = np.flatnonzero(which & (num_seen == 0))
        distance, near = cKDTree(place[known]).query(place[rows], np.arange(min(NEAREST, len(known))) + 1)
        texels = np.where(distance < apart, num_seen[known][near], 0)
        source[rows] = known[near[np.arange(len(rows)), texels.argmax(axis=1)]]
    return means[source]


def _fill_charts(
    atlas: Atlas, mesh: Mesh, charts: NDArray, num_seen: NDArray, typical: NDArray, progress: Advance
) -> NDArray[np.bool_]:
    """Fill partly observed charts, with ``typical`` values (C, 7) far from their observed parts; return the
    mask (C,) of filled charts.
    """
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
    partly = np.flatnonzero(seen_in_chart)
    is_filled[partly] = True

    def fill(chart: int) -> None:
        left, right = _span(low[chart, 0], high[chart, 0], atlas.size)
        top, bottom = _span(1 - high[chart, 1], 1 - low[chart, 1], atlas.size)
        window = (slice(top, bottom), slice(left, right))
        face, count = atlas.face[window], atlas.count[window]
        seen, unseen = np.zeros(face.shape, np.bool_), np.zeros(face.shape, np.bool_)
        if _split_chart(face, count, charts, chart, seen, unseen):
            _copy_nearest(atlas, window, seen, unseen)
            _fade(atlas, window, seen, unseen, typical[chart])
        if face.size > _LARGE_WINDOW:
            atlas.release()

    with ThreadPoolExecutor(num_threads()) as pool:
        for done, _ in enumerate(pool.map(fill, partly), start=1):
            progress(done, len(partly))
    atlas.release()
    return is_filled


@compiled
def _split_chart(face_of: Any, count: Any, charts: Any, chart: Any, seen: Any, unseen: Any) -> Any:
    """Set the masks ``seen`` and ``unseen`` of a chart's texels; return whether both are non-empty."""
    num_seen, num_unseen = 0, 0
    for row in range(face_of.shape[0]):
        for column in range(face_of.shape[1]):
            face = face_of[row, column]
            if face >= 0 and charts[face] == chart:
                is_seen = count[row, column] > 0
                seen[row, column], unseen[row, column] = is_seen, not is_seen
                num_seen += is_seen
                num_unseen += not is_seen
    return num_seen > 0 and num_unseen > 0


def _span(low: float, high: float, size: int) -> tuple[int, int]:
    return max(int(low * size) - 1, 0), min(int(np.ceil(high * size)) + 1, size)


def _copy_nearest(
    atlas: Atlas, window: tuple[slice, slice], source: NDArray[np.bool_], target: NDArray[np.bool_]
) -> None:
    """Copy the value of the nearest texel in ``source`` to each texel in ``target``, within a window."""
    labels, places = nearest_labels(source)
    for array in atlas.maps.values():
        _copy_labelled(array.view(np.uint16)[window], labels, places, target)


def _fade(
    atlas: Atlas,
    window: tuple[slice, slice],
    seen: NDArray[np.bool_],
    unseen: NDArray[np.bool_],
    typical: NDArray[np.float32],
) -> None:
    """Blend the ``unseen`` texels of a window into ``typical`` (7,) with increasing distance to ``seen``."""
    import cv2

    distance = cv2.distanceTransform(np.where(seen, np.uint8(0), np.uint8(255)), cv2.DIST_L2, 5)[unseen]
    share = (1 / (1 + (distance / FADE_TEXELS) ** 2))[:, None].astype(np.float32)
    for name, columns in MAP_COLUMNS.items():
        values, own = atlas.maps[name][window], typical[columns]
        values[unseen] = own + share * (values[unseen].astype(np.float32) - own)


def typical_values(charts: NDArray, piece: NDArray, means: NDArray, num_seen: NDArray) -> NDArray[np.float64]:
    """Compute the typical value (C, K) of each chart, 0 for those without observed triangles.

    ``charts`` and ``piece`` (M,): chart and connected piece of each triangle; ``means`` (M, K) and
    ``num_seen`` (M,): mean and number of its observed texels. A typical value is the weighted median over the
    chart's triangles, shrunk towards the median over the charts of its piece (:data:`HARDLY_SEEN`).
    """
    num_charts = int(charts.max()) + 1
    piece_of = np.zeros(num_charts, np.int64)
    piece_of[charts] = np.unique(piece, return_inverse=True)[1]
    seen = np.bincount(charts, num_seen, num_charts)
    of_chart = _medians(charts, means, num_seen, num_charts)
    of_piece = _medians(piece_of, of_chart, seen, int(piece_of.max()) + 1)[piece_of]
    seen_in_piece = np.bincount(piece_of, seen)[piece_of]
    share = seen**2 / np.maximum(seen**2 + (HARDLY_SEEN * seen_in_piece) ** 2, 1e-12)
    return np.where(seen[:, None] > 0, of_piece + share[:, None] * (of_chart - of_piece), 0.0)


def _medians(group: NDArray, values: NDArray, weight: NDArray, num: int) -> NDArray[np.float64]:
    """Compute the weighted median (num, K) of ``values`` (N, K) in each ``group`` (N,), 0 without weight."""
    found = np.zeros((num, values.shape[1]))
    rows = np.flatnonzero(weight)
    total = np.bincount(group, weight, num)
    for column in range(values.shape[1]):
        order = rows[np.lexsort((values[rows, column], group[rows]))]
        owner = group[order]
        below = np.cumsum(weight[order])
        start = np.concatenate([[0.0], np.cumsum(total)[:-1]])[owner]
        reached = below - start >= 0.5 * total[owner]
        chosen = order[reached][np.unique(owner[reached], return_index=True)[1]]
        found[group[chosen], column] = values[chosen, column]
    return found


def nearest_labels(source: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the label (H, W) of the True pixel nearest to each pixel, by approximate Euclidean distance, and
    the flat index (L,) of the True pixel of each label. At least one pixel of ``source`` (H, W) must be True.
    """
    import cv2

    mask = np.where(source, np.uint8(0), np.uint8(255))
    labels: Any = cv2.distanceTransformWithLabels(mask, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
    places = np.zeros(int(np.count_nonzero(source)) + 1, dtype=np.int32)
    _find_places(source, labels, places)
    return labels, places


@compiled
def _find_places(source: Any, labels: Any, places: Any) -> None:
    for row in range(source.shape[0]):
        for column in range(source.shape[1]):
            if source[row, column]:
                places[labels[row, column]] = row * source.shape[1] + column


@compiled
def _copy_labelled(values: Any, labels: Any, places: Any, target: Any) -> None:
    width = target.shape[1]
    for row in range(target.shape[0]):
        for column in range(width):
            if target[row, column]:
                place = places[labels[row, column]]
                for channel in range(values.shape[2]):
                    values[row, column, channel] = values[place // width, place % width, channel]


def _fill_gutters(atlas: Atlas, progress: Advance) -> None:
    def fill(rows: slice) -> None:
        start, stop = max(rows.start - GUTTER, 0), min(rows.stop + GUTTER, atlas.size)
        covered = atlas.face[start:stop] >= 0
        if covered.any():
            empty = ~covered
            empty[: rows.start - start] = False
            empty[rows.stop - start :] = False
            _copy_nearest(atlas, (slice(start, stop), slice(0, atlas.size)), covered, empty)

    tops = range(0, atlas.size, BAND)
    with ThreadPoolExecutor(num_threads()) as pool:
        for first in range(0, len(tops), num_threads()):
            group = [slice(top, min(top + BAND, atlas.size)) for top in tops[first : first + num_threads()]]
            deque(pool.map(fill, group), maxlen=0)
            atlas.release()
            progress(group[-1].stop, atlas.size)

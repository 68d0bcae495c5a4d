# SPDX-License-Identifier: MIT
"""Surfels: the photographed surfaces of a room as cells of about 2.5 cm, with all observations of each.

There are V views, N surfels, M observations (a surfel in a view) and C cells. Space is divided into cubic
cells. Points in a cell are assigned to one of its six sides by the signed axis nearest to their normal, which
separates the two faces of a wall. A surfel is an occupied side. Its observation in a view is the weighted
mean of its pixels there; its radiance is the weighted median over the views. Surfels are numbered by cell,
independently of the order of the views. Colours are linear and share one exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.foundation.errors import InputError, input_error
from datagen.foundation.peak_memory import num_threads
from datagen.geometry.views import TracedView
from datagen.multiview.compiled import compiled

Floats32 = NDArray[np.float32]
CELLS_ACROSS = 300
"""Cells along the diagonal of the photographed volume: 2.5 cm for a diagonal of 7.5 m."""
MIN_CELL_PIXELS = 1.0
"""Minimum size of a cell in pixels at the median depth; many views would have no pixel in smaller cells."""
MAX_EDGE_SHARE = 0.5
"""Share of pixels at depth edges above which a surfel is mixed. A higher share would miss slats of a blind,
between which no edge is detected since they are coplanar."""
NUM_SIDES = 6
EDGE_WEIGHT = 0.02
"""Weight of a pixel that is clipped or at a crease or depth edge, where surfaces mix; others weigh 1."""
_MAX_EXTENT = 1.25  # of the grid, relative to the central 98 % of the pixels; those outside are ignored


@dataclass(frozen=True)
class CellGrid:
    """Grid of cubic cells.

    ``low`` (3,): lower corner in metres; ``cell_m``: edge length of a cell; ``shape`` (3,): cells along each
    axis; ``surfel`` (6 C,): index of the surfel on each side of each cell, -1 for none.
    """

    low: NDArray[np.float64]
    cell_m: float
    shape: NDArray[np.int64]
    surfel: NDArray[np.int32]

    @property
    def high(self) -> NDArray[np.float64]:
        """Corner (3,) opposite to ``low``, in metres."""
        return self.low + self.cell_m * self.shape


@dataclass(frozen=True)
class Observations:
    """M observations of the surfels, ordered by surfel and then by view.

    The observations of surfel i are rows ``start[i]`` to ``start[i + 1]`` - 1. ``view`` (M,): index of the
    view; ``radiance`` (M, 3); ``weight`` (M,): sum of the pixels' weights (:data:`EDGE_WEIGHT`); ``normal``
    (M, 3): mean over the pixels, since views from two sides of a chair leg or a tap show different normals.
    """

    start: NDArray[np.int64]
    view: NDArray[np.int32]
    radiance: Floats32
    weight: Floats32
    normal: Floats32


@dataclass(frozen=True)
class Surfels:
    """Surfels of a room.

    ``position_m`` (N, 3): point on the surface; ``normal`` (N, 3): unit, facing the cameras; ``face`` (N,):
    triangle; ``radiance`` (N, 3): median over views; ``is_mixed`` (N,): whether most pixels of the surfel are
    at depth edges, where other surfaces contribute to the radiance; ``camera_m`` (V, 3): camera positions.
    Per view: ``pixel_surfel`` (P,), index of each pixel's surfel, -1 for none, and ``pixel_weight`` (P,).
    """

    grid: CellGrid
    position_m: Floats32
    normal: Floats32
    face: NDArray[np.int32]
    radiance: Floats32
    is_mixed: NDArray[np.bool_]
    observations: Observations
    camera_m: Floats32
    pixel_surfel: tuple[NDArray[np.int32], ...]
    pixel_weight: tuple[Floats32, ...]

    def __len__(self) -> int:
        return len(self.position_m)

    def surfel_of_observation(self) -> NDArray[np.int32]:
        """Index (M,) of each observation's surfel."""
        return np.repeat(np.arange(len(self), dtype=np.int32), np.diff(self.observations.start))

    def directions(self, surfel: NDArray, view: NDArray) -> Floats32:
        """Unit directions (K, 3) from surfels to cameras, with indices ``surfel`` (K,) and ``view`` (K,)."""
        toward = self.camera_m[view] - self.position_m[surfel]
        return toward / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-9)


def build_surfels(views: Sequence[TracedView]) -> Surfels:
    """Build the surfels of the non-emitting surfaces in the views.

    Raises :class:`InputError` if the views show no extended surface.
    """
    cameras = [camera_row(view) for view in views]
    low, cell_m, shape = _extent(views)
    with ThreadPoolExecutor(num_threads()) as pool:
        cells = list(pool.map(lambda view, row: _cells_of(view, row, low, cell_m, shape), views, cameras))
    occupied = np.zeros(int(np.prod(shape)) * NUM_SIDES, np.bool_)
    for cell, _, _ in cells:
        occupied[cell[cell >= 0]] = True
    surfel = np.full(len(occupied), -1, np.int32)
    num = int(occupied.sum())
    surfel[occupied] = np.arange(num, dtype=np.int32)
    grid = CellGrid(low, cell_m, shape, surfel)

    def observe(index: int) -> tuple[NDArray, ...]:
        view = views[index]
        color = np.ascontiguousarray(view.color.reshape(-1, 3), np.float32)
        normal = np.ascontiguousarray(view.geometry.normal_world.reshape(-1, 3), np.float32)
        pixels = *cells[index], color, normal, view.geometry.depth_z_m.ravel()
        return _observe_view(*pixels, cameras[index], low, cell_m, surfel, num)

    with ThreadPoolExecutor(num_threads()) as pool:
        seen = list(pool.map(observe, range(len(views))))
    pixel_surfel = tuple(np.where(cell >= 0, surfel[np.maximum(cell, 0)], -1) for cell, _, _ in cells)
    pixel_weight = tuple(weight for _, weight, _ in cells)
    return _gathered(views, grid, seen, pixel_surfel, pixel_weight)


def camera_row(view: TracedView) -> NDArray[np.float64]:
    """Pack a camera in an array (18,): world_from_camera rotation by rows (9), position [m] (3), fx, fy,
    cx, cy, width, height [px].
    """
    camera = view.camera
    matrix = camera.world_from_camera
    return np.array(
        [*matrix[:3, :3].ravel(), *matrix[:3, 3], camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px,
         camera.width_px, camera.height_px]
    )  # fmt: skip


def _extent(views: Sequence[TracedView]) -> tuple[NDArray[np.float64], float, NDArray[np.int64]]:
    """Lower corner, cell size and shape of the grid, from a sparse subset of the pixels."""
    points, footprint = [], []
    for view in views:
        depth = view.geometry.depth_z_m[..., 0]
        rows, columns = np.nonzero(depth[2::5, 2::5] > 0)
        rows, columns = rows * 5 + 2, columns * 5 + 2
        z = depth[rows, columns].astype(np.float64)
        points.append(view.camera.unproject(np.stack([columns, rows], axis=1) + 0.5, z))
        footprint.append(z / view.camera.fx_px)
    position = np.concatenate(points) if points else np.zeros((0, 3))
    if not len(position):
        raise _nothing_shown("no view shows the mesh")
    low, high = np.percentile(position, [1, 99], axis=0)
    diagonal = float(np.linalg.norm(high - low))
    if diagonal <= 0:
        raise _nothing_shown("the views show no extended surface")
    cell_m = max(diagonal / CELLS_ACROSS, MIN_CELL_PIXELS * float(np.median(np.concatenate(footprint))))
    margin = 0.5 * (_MAX_EXTENT - 1) * np.maximum(high - low, 0.1 * diagonal)
    low = np.maximum(position.min(axis=0) - cell_m, low - margin)
    high = np.minimum(position.max(axis=0) + cell_m, high + margin)
    return low, cell_m, np.ceil((high - low) / cell_m).astype(np.int64) + 1


def _nothing_shown(got: str) -> InputError:
    expected = "a surface that covers many pixels"
    return input_error("photographs", "", got, expected, "check the unit and the frame of the mesh")


@compiled
def cell_of(position, normal, low, cell_m, shape):
    """Key of the cell side of a point (3,) with a normal (3,), -1 outside the grid."""
    index = 0
    for axis in range(3):
        at = int(np.floor((position[axis] - low[axis]) / cell_m))
        if at < 0 or at >= shape[axis]:
            return -1
        index = index * shape[axis] + at
    x, y, z = abs(normal[0]), abs(normal[1]), abs(normal[2])
    if x >= y and x >= z:
        side = 0 if normal[0] <= 0 else 1
    elif y >= z:
        side = 2 if normal[1] <= 0 else 3
    else:
        side = 4 if normal[2] <= 0 else 5
    return index * NUM_SIDES + side


@compiled
def place_pixel(index, depth, width, camera, out):
    """Write the world position of the centre of pixel ``index`` to ``out`` (3,); see :func:`camera_row`."""
    u = (index % width + 0.5 - camera[14]) / camera[12] * depth
    v = (index // width + 0.5 - camera[15]) / camera[13] * depth
    for axis in range(3):
        out[axis] = (
            camera[3 * axis] * u + camera[3 * axis + 1] * v + camera[3 * axis + 2] * depth + camera[9 + axis]
        )


@compiled
def surfels_around(place, side, low, cell_m, shape, surfel, near, share):
    """Find the surfels of one ``side`` around the point ``place`` (3,), for trilinear interpolation.

    Returns their number, at most 8; writes their indices to ``near`` and their weights to ``share``.
    """
    num = 0
    for corner in range(8):
        key = 0
        w = 1.0
        inside = True
        for axis in range(3):
            along = (place[axis] - low[axis]) / cell_m - 0.5
            base = int(np.floor(along))
            bit = (corner >> axis) & 1
            at = base + bit
            if at < 0 or at >= shape[axis]:
                inside = False
                break
            key = key * shape[axis] + at
            w *= along - base if bit else 1 - (along - base)
        if not inside:
            continue
        which = surfel[key * NUM_SIDES + side]
        if which >= 0:
            near[num], share[num] = which, w + 1e-4
            num += 1
    return num


@compiled
def _classify(depth, normal, usable, clipped, camera, low, cell_m, shape):
    """Return keys (P,) of the pixels' cell sides (see :func:`cell_of`), -1 for none, their weights (P,), and
    a mask (P,) of depth edges; ``clipped`` is (P,) or empty.
    """
    width, height = int(camera[16]), int(camera[17])
    cell = np.full(width * height, -1, np.int32)
    weight = np.zeros(width * height, np.float32)
    at_edge = np.zeros(width * height, np.bool_)
    here, there = np.zeros(3), np.zeros(3)
    for index in range(width * height):
        z = depth[index]
        if z <= 0 or not usable[index]:
            continue
        place_pixel(index, z, width, camera, here)
        cell[index] = cell_of(here, normal[index], low, cell_m, shape)
        tolerance = 1.5 * z / camera[12]
        is_crease = False
        x, y = index % width, index // width
        for step in range(4):
            dx, dy = (1, -1, 0, 0)[step], (0, 0, 1, -1)[step]
            if not (0 <= x + dx < width and 0 <= y + dy < height):
                continue
            other = index + dy * width + dx
            if depth[other] <= 0:
                at_edge[index] = True
                break
            place_pixel(other, depth[other], width, camera, there)
            off, along = 0.0, 0.0
            for axis in range(3):
                off += normal[index, axis] * (there[axis] - here[axis])
                along += normal[index, axis] * normal[other, axis]
            if abs(off) > tolerance:
                at_edge[index] = True
                break
            is_crease |= along < 0.8
        is_clipped = len(clipped) > 0 and clipped[index]
        weight[index] = EDGE_WEIGHT if is_crease or at_edge[index] or is_clipped else 1.0
    return cell, weight, at_edge


@compiled
def _observe_view(cell, weight, at_edge, color, normal, depth, camera, low, cell_m, surfel, num):
    """Return the surfels (K,) in a view in increasing order, their radiance (K, 3) and weight (K,), the pixel
    (K,) nearest to the cell centre with its squared distance (K,), the numbers (K, 2) of all pixels and of
    those at depth edges, and the normalised mean normal (K, 3).
    """
    sums = np.zeros((num, 6), np.float32)
    total = np.zeros(num, np.float32)
    nearest = np.full(num, -1, np.int32)
    distance = np.full(num, np.inf, np.float32)
    pixels = np.zeros((num, 2), np.int32)
    here = np.zeros(3)
    width = int(camera[16])
    for index in range(len(cell)):
        if cell[index] < 0:
            continue
        at = surfel[cell[index]]
        w = weight[index]
        total[at] += w
        pixels[at, 0] += 1
        pixels[at, 1] += at_edge[index]
        for channel in range(3):
            sums[at, channel] += w * color[index, channel]
            sums[at, 3 + channel] += w * normal[index, channel]
        place_pixel(index, depth[index], width, camera, here)
        off = np.float32(0.0 if w == 1.0 else 1e6)  # edge pixels are chosen only if there are no others
        for axis in range(3):
            part = (here[axis] - low[axis]) / cell_m
            off += (part - np.floor(part) - 0.5) ** 2
        if off < distance[at]:
            distance[at], nearest[at] = off, index
    found = np.flatnonzero(total > 0).astype(np.int32)
    radiance = np.empty((len(found), 3), np.float32)
    facing = np.empty((len(found), 3), np.float32)
    for row in range(len(found)):
        length = np.float32(1e-12)
        for channel in range(3):
            radiance[row, channel] = sums[found[row], channel] / total[found[row]]
            length += sums[found[row], 3 + channel] ** 2
        for channel in range(3):
            facing[row, channel] = sums[found[row], 3 + channel] / np.sqrt(length)
    return found, radiance, total[found], nearest[found], distance[found], pixels[found], facing


def _cells_of(
    view: TracedView, row: NDArray, low: NDArray, cell_m: float, shape: NDArray
) -> tuple[NDArray[np.int32], Floats32, NDArray[np.bool_]]:
    usable = view.valid_mask & (view.geometry.surface_mask[..., 0] > 0)
    clipped = np.zeros(0, np.bool_) if view.clipped_mask is None else view.clipped_mask.any(axis=2).ravel()
    depth, normal = view.geometry.depth_z_m.ravel(), view.geometry.normal_world.reshape(-1, 3)
    pixels = depth, np.ascontiguousarray(normal), usable.ravel(), clipped
    return _classify(*pixels, row, low, cell_m, shape)


def _gathered(
    views: Sequence[TracedView],
    grid: CellGrid,
    seen: Sequence[tuple[NDArray, ...]],
    pixel_surfel: tuple[NDArray[np.int32], ...],
    pixel_weight: tuple[Floats32, ...],
) -> Surfels:
    """Merge the observations of all views, ordered by surfel, and choose a surface point of each surfel."""
    num = int(grid.surfel.max()) + 1
    surfel, radiance, weight, pixel, distance, pixels, facing = map(np.concatenate, zip(*seen, strict=True))
    view = np.repeat(np.arange(len(views), dtype=np.int32), [len(part[0]) for part in seen])
    order = np.argsort(surfel, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(surfel, minlength=num))]).astype(np.int64)
    observations = Observations(start, view[order], radiance[order], weight[order], facing[order])
    ranked = np.lexsort((distance, surfel))
    chosen = ranked[start[:-1]]  # every surfel is observed in some view
    position, normal = np.empty((num, 3), np.float32), np.empty((num, 3), np.float32)
    face = np.empty(num, np.int32)
    for index, of_view in enumerate(views):
        mine = chosen[view[chosen] == index]
        at, geometry = pixel[mine], of_view.geometry
        z = geometry.depth_z_m.ravel()[at].astype(np.float64)
        row, column = np.divmod(at, of_view.camera.width_px)
        position[surfel[mine]] = of_view.camera.unproject(np.stack([column, row], axis=1) + 0.5, z)
        normal[surfel[mine]] = geometry.normal_world.reshape(-1, 3)[at]
        face[surfel[mine]] = geometry.face.ravel()[at]
    radiance = weighted_medians(observations.start, observations.radiance, observations.weight)
    counts = np.add.reduceat(pixels[order], start[:-1])
    is_mixed = counts[:, 1] > MAX_EDGE_SHARE * counts[:, 0]
    camera_m = np.array([view.camera.position_m for view in views], np.float32)
    return Surfels(
        grid, position, normal, face, radiance, is_mixed, observations, camera_m, pixel_surfel, pixel_weight
    )


@compiled
def weighted_medians(start, values, weight):
    """Weighted median (N, 3) of rows ``start[i]`` to ``start[i + 1]`` - 1 of ``values`` (M, 3), per channel.

    It is the first value at which the cumulative weight exceeds half of the total; if the weight equals half,
    the mean of that value and the next; 0 without rows.
    """
    num = len(start) - 1
    found = np.zeros((num, 3), np.float32)
    for i in range(num):
        first, last = start[i], start[i + 1]
        half = np.float32(0.5) * weight[first:last].sum()
        for channel in range(3):
            rows = values[first:last, channel]
            order = np.argsort(rows)
            total = np.float32(0.0)
            for k in range(last - first):
                total += weight[first + order[k]]
                if total >= half:
                    following = rows[order[min(k + 1, last - first - 1)]]
                    is_tie = total <= half * np.float32(1 + 1e-6)
                    found[i, channel] = 0.5 * (rows[order[k]] + following) if is_tie else rows[order[k]]
                    break
    return found


def grouped_medians(values: NDArray, weight: NDArray, group: NDArray, num: int) -> NDArray[np.float32]:
    """Compute the weighted median (``num``, 3) over each ``group`` (M,) of the rows of ``values`` (M, 3)."""
    order = np.argsort(group, kind="stable")
    start = np.searchsorted(group[order], np.arange(num + 1))
    return np.asarray(
        weighted_medians(start, values[order].astype(np.float32), weight[order].astype(np.float32))
    )


def near_surfels(surfels: Surfels, num: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Distances, in cells, and indices of the nearest surfels with similar normals, (N, min(num, N)) each.

    A difference of 1 between unit normals counts as 3 cells. The first neighbour is the surfel itself.
    """
    cell = surfels.grid.cell_m
    tree = cKDTree(np.concatenate([surfels.position_m, surfels.normal * (3 * cell)], axis=1))
    nearest = np.arange(min(num, len(surfels))) + 1
    distance, index = tree.query(tree.data, k=nearest, workers=-1)
    return distance / cell, index


def clipped_shares(views: Sequence[TracedView], surfels: Surfels) -> NDArray[np.float64]:
    """Share (N, 3) of each surfel's pixels that are clipped, by channel."""
    clipped, total = np.zeros((len(surfels), 3)), np.zeros(len(surfels))
    for view, surfel in zip(views, surfels.pixel_surfel, strict=True):
        mine = surfel >= 0
        total += np.bincount(surfel[mine], minlength=len(surfels))
        if view.clipped_mask is not None:
            mask = view.clipped_mask.reshape(-1, 3)[mine]
            for channel in range(3):
                clipped[:, channel] += np.bincount(surfel[mine], mask[:, channel], len(surfels))
    return clipped / np.maximum(total, 1)[:, None]


def surfel_means(surfels: Surfels, maps: Sequence[NDArray]) -> Floats32:
    """Weighted means (N, K) of ``maps``, one (H, W, K) per view, over all pixels of each surfel."""
    channels = maps[0].shape[-1]
    sums, total = np.zeros((len(surfels), channels)), np.zeros(len(surfels))
    for view_map, surfel, weight in zip(maps, surfels.pixel_surfel, surfels.pixel_weight, strict=True):
        values = np.ascontiguousarray(view_map.reshape(-1, channels), np.float32)
        _add_pixels(surfel, weight, values, sums, total)
    return (sums / np.maximum(total, 1e-12)[:, None]).astype(np.float32)


@compiled
def _add_pixels(surfel, weight, values, sums, total):
    for index in range(len(surfel)):
        at = surfel[index]
        if at >= 0:
            total[at] += weight[index]
            for channel in range(values.shape[1]):
                sums[at, channel] += weight[index] * values[index, channel]

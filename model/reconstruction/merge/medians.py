# SPDX-License-Identifier: MIT
"""The compiled loop of the merge, which computes medians over views for each texel.

Texels are processed in squares of 8 x 8, whose covered texels are the lanes of vector instructions. For each
view whose frustum may intersect a square's bounding sphere, all lanes are projected and tested (visibility as
in ``datagen.multiview``), and visible values are appended to the lanes' lists. The lists of a square are
padded with Inf to equal length and sorted together (``lane_sort``); any weights are permuted with the values.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datagen.multiview.compiled import compiled
from model.reconstruction.atlas.texels import surface_point
from model.reconstruction.merge.lane_sort import LANES, STEP, middle_mean, sort_lanes, sort_weighted_lanes

SIDE = 8
"""Side in texels of a square; a square has LANES texels."""
NUM_CHANNELS = 7
PACKET = 8
"""Floats per pixel: D (3), S (3), R (1) and the index of the smooth region, bounded by creases (1)."""
CAMERA = 19
"""Floats per camera: camera_from_world (9, by rows), centre (3), fx, fy, cx, cy, width, height, maximum
depth."""
_X, _Y, _Z, _NX, _NY, _NZ, _U, _V, _DEPTH, _LIMIT, _REGION = (row * LANES for row in range(11))
_ROWS = 11
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_INFINITY = np.float32(np.inf)
MIN_WEIGHT = np.float32(1e-3)  # division by a smaller weight would amplify rounding errors


class ViewArrays(NamedTuple):
    """Concatenated pixels of all V views, P in total."""

    cameras: NDArray[np.float32]
    """(V, CAMERA): parameters of each camera."""
    first_pixel: NDArray[np.int64]
    """(V,): index of each view's first pixel."""
    depth: NDArray[np.float32]
    """(P,): depth along z in metres, 0 at pixels without a value."""
    packets: NDArray[np.float32]
    """(P, PACKET): values of each pixel."""
    weight: NDArray[np.float32]
    """(P, 3): weights of each pixel's D, S and R, or (0, 3) if all are equal."""


class Rules(NamedTuple):
    """Parameters of visibility (:class:`datagen.multiview.visibility.VisibilityOptions`) and of weighting."""

    depth_tolerance: np.float32
    slope_tolerance_px: np.float32
    slope_limit: np.float32
    is_traced: bool
    is_weighted: bool


class Surface(NamedTuple):
    """Arrays of a :class:`TexelSurface`, and the smooth region (M,) of each triangle."""

    size: int
    uv: NDArray[np.float32]
    vertices: NDArray[np.int32]
    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    regions: NDArray[np.float32]


@compiled
def _project(state: Any, camera: Any, rules: Any) -> None:
    """Project all lanes of ``state`` into a view; the limit of the depth test is -1 outside the view."""
    r00, r01, r02, r10, r11, r12 = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    r20, r21, r22, cx, cy, cz = camera[6], camera[7], camera[8], camera[9], camera[10], camera[11]
    fx, fy, px, py, width, height = camera[12], camera[13], camera[14], camera[15], camera[16], camera[17]
    tolerance, slope_px, slope_limit = rules.depth_tolerance, rules.slope_tolerance_px, rules.slope_limit
    for lane in range(LANES):  # a constant number, so that the compiler vectorises the loop
        x, y, z = state[_X + lane] - cx, state[_Y + lane] - cy, state[_Z + lane] - cz
        nx, ny, nz = state[_NX + lane], state[_NY + lane], state[_NZ + lane]
        facing = -(nx * x + ny * y + nz * z)
        depth = r20 * x + r21 * y + r22 * z
        u = (r00 * x + r01 * y + r02 * z) / depth * fx + px
        v = (r10 * x + r11 * y + r12 * z) / depth * fy + py
        is_inside = (depth > _ZERO) & (facing > _ZERO)
        is_inside = is_inside & (u >= _ZERO) & (v >= _ZERO) & (u < width) & (v < height)
        step = abs(r00 * nx + r01 * ny + r02 * nz) / fx + abs(r10 * nx + r11 * ny + r12 * nz) / fy
        slope = slope_px * step * depth / facing  # Inf at grazing angles, bounded by slope_limit
        slope = slope if slope < slope_limit else slope_limit
        state[_U + lane] = u
        state[_V + lane] = v
        state[_DEPTH + lane] = depth
        state[_LIMIT + lane] = depth * (tolerance + slope) if is_inside else -_ONE


@compiled
def may_see(camera: Any, x: Any, y: Any, z: Any, radius: Any) -> Any:
    """Return whether a sphere about (x, y, z) may intersect a view's frustum up to its maximum depth."""
    dx, dy, dz = x - camera[9], y - camera[10], z - camera[11]
    depth = camera[6] * dx + camera[7] * dy + camera[8] * dz
    if depth + radius <= _ZERO or depth - radius > camera[18]:
        return False
    across = (camera[0] * dx + camera[1] * dy + camera[2] * dz) * camera[12]
    down = (camera[3] * dx + camera[4] * dy + camera[5] * dz) * camera[13]
    left, right = camera[14], camera[16] - camera[14]
    upper, lower = camera[15], camera[17] - camera[15]
    return (
        across + left * depth >= -radius * np.sqrt(camera[12] * camera[12] + left * left)
        and right * depth - across >= -radius * np.sqrt(camera[12] * camera[12] + right * right)
        and down + upper * depth >= -radius * np.sqrt(camera[13] * camera[13] + upper * upper)
        and lower * depth - down >= -radius * np.sqrt(camera[13] * camera[13] + lower * lower)
    )


@compiled
def _append_view(
    state: Any,
    num: Any,
    views: Any,
    view: Any,
    rules: Any,
    traced: Any,
    rows: Any,
    columns: Any,
    mix: Any,
    found: Any,
    values: Any,
) -> None:
    """Append the values of a view to the lists of the lanes visible in it, in ``values`` (lists * V, LANES).

    Values are interpolated between pixels of the same smooth region and of similar depth.
    """
    camera, first, depths, packets = views.cameras[view], views.first_pixel[view], views.depth, views.packets
    width, height, num_views = int(camera[16]), int(camera[17]), len(views.first_pixel)
    last_x, last_y = np.float32(width - 1), np.float32(height - 1)
    reach = rules.depth_tolerance + rules.slope_limit
    is_traced, is_weighted = rules.is_traced, rules.is_weighted
    for lane in range(num):
        limit = state[_LIMIT + lane]
        if limit < _ZERO:
            continue
        u, v, depth = state[_U + lane], state[_V + lane], state[_DEPTH + lane]
        if is_traced:
            if not traced[view, rows[lane], columns[lane]]:
                continue
        elif abs(depths[first + int(v) * width + int(u)] - depth) > limit:
            continue
        x = min(max(u - _HALF, _ZERO), last_x)  # border pixels extend beyond their centres
        y = min(max(v - _HALF, _ZERO), last_y)
        left, top = int(x), int(y)
        s, t = x - np.float32(left), y - np.float32(top)
        i = first + top * width + left
        j = i + 1 if left + 1 < width else i
        down = width if top + 1 < height else 0
        k, m = i + down, j + down
        wi, wj, wk, wm = (_ONE - s) * (_ONE - t), s * (_ONE - t), (_ONE - s) * t, s * t
        tolerance = depth * reach
        region = state[_REGION + lane]
        wi = wi if packets[i, 7] == region and abs(depths[i] - depth) <= tolerance else _ZERO
        wj = wj if packets[j, 7] == region and abs(depths[j] - depth) <= tolerance else _ZERO
        wk = wk if packets[k, 7] == region and abs(depths[k] - depth) <= tolerance else _ZERO
        wm = wm if packets[m, 7] == region and abs(depths[m] - depth) <= tolerance else _ZERO
        total = wi + wj + wk + wm
        if not total > MIN_WEIGHT:
            continue
        scale = _ONE / total
        for c in range(PACKET):
            mix[c] = wi * packets[i, c] + wj * packets[j, c] + wk * packets[k, c] + wm * packets[m, c]
        row = found[lane]
        for c in range(NUM_CHANNELS):
            values[c * num_views + row, lane] = mix[c] * scale
        if is_weighted:
            heavy = views.weight
            for group in range(3):
                here = wi * heavy[i, group] + wj * heavy[j, group]
                here += wk * heavy[k, group] + wm * heavy[m, group]
                values[(NUM_CHANNELS + group) * num_views + row, lane] = here * scale
        found[lane] = row + 1


@compiled
def merge_tile(
    face_of: Any,
    left: Any,
    top: Any,
    surface: Any,
    views: Any,
    rules: Any,
    traced: Any,
    comparisons: Any,
    starts: Any,
    medians: Any,
    counts: Any,
) -> None:
    """Set ``medians`` (H, W, 7) and ``counts`` (H, W) of a tile with the triangles ``face_of`` (H, W).

    ``traced`` (V, H, W): visibility of texels in views, used if ``rules.is_traced``; ``comparisons`` and
    ``starts``: result of :func:`networks` for V values.
    """
    height, width = face_of.shape
    num_views = len(views.first_pixel)
    state, mix = np.zeros(_ROWS * LANES, np.float32), np.zeros(PACKET, np.float32)
    lists = NUM_CHANNELS + 3 if rules.is_weighted else NUM_CHANNELS
    values = np.zeros((lists * num_views + STEP, LANES), np.float32)
    weights = np.zeros((num_views + STEP if rules.is_weighted else 0, LANES), np.float32)
    line = np.zeros((num_views + STEP, LANES), np.float32)
    rows, columns, found = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)
    for block_y in range(0, height, SIDE):
        for block_x in range(0, width, SIDE):
            num = 0
            low_x, low_y, low_z = _INFINITY, _INFINITY, _INFINITY
            high_x, high_y, high_z = -_INFINITY, -_INFINITY, -_INFINITY
            found[:] = 0
            for row in range(block_y, min(block_y + SIDE, height)):
                for column in range(block_x, min(block_x + SIDE, width)):
                    face = face_of[row, column]
                    if face < 0:
                        continue
                    x, y, z = surface_point(
                        face,
                        left + column + 0.5,
                        top + row + 0.5,
                        surface.size,
                        surface.uv,
                        surface.vertices,
                        surface.positions,
                    )
                    low_x, low_y, low_z = min(low_x, x), min(low_y, y), min(low_z, z)
                    high_x, high_y, high_z = max(high_x, x), max(high_y, y), max(high_z, z)
                    state[_X + num], state[_Y + num], state[_Z + num] = x, y, z
                    for axis in range(3):
                        state[_NX + axis * LANES + num] = surface.normals[face, axis]
                    state[_REGION + num] = surface.regions[face]
                    rows[num], columns[num] = row, column
                    num += 1
            if num == 0:
                continue
            x, y, z = _HALF * (low_x + high_x), _HALF * (low_y + high_y), _HALF * (low_z + high_z)
            dx, dy, dz = high_x - low_x, high_y - low_y, high_z - low_z
            radius = np.float32(0.501) * np.sqrt(dx * dx + dy * dy + dz * dz) + np.float32(1e-6)
            for view in range(num_views):
                if may_see(views.cameras[view], x, y, z, radius):
                    _project(state, views.cameras[view], rules)
                    _append_view(state, num, views, view, rules, traced, rows, columns, mix, found, values)
            most = 0
            for lane in range(num):
                counts[rows[lane], columns[lane]] = found[lane]
                most = max(most, found[lane])
            if most == 0:
                continue
            size = (most + STEP - 1) // STEP
            network = comparisons[starts[size] : starts[size + 1]]
            for channel in range(NUM_CHANNELS):
                first = channel * num_views
                for row in range(size * STEP):
                    for lane in range(LANES):
                        line[row, lane] = values[first + row, lane] if row < found[lane] else _INFINITY
                if rules.is_weighted:
                    group = NUM_CHANNELS + (0 if channel < 3 else 1 if channel < 6 else 2)
                    for row in range(most):
                        weights[row] = values[group * num_views + row]
                    sort_weighted_lanes(line, weights, network)
                else:
                    sort_lanes(line, network)
                for lane in range(num):
                    seen = found[lane]
                    if seen == 0:
                        continue
                    if rules.is_weighted:
                        median = middle_mean(line, weights, lane, seen)
                    else:
                        median = _HALF * (line[(seen - 1) // 2, lane] + line[seen // 2, lane])
                    medians[rows[lane], columns[lane], channel] = median

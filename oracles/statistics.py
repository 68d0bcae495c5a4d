# SPDX-License-Identifier: MIT
"""Multi-view statistics in float64 NumPy, twice: pixel by pixel in plain loops, and vectorised over pixels.

The loops follow the definitions literally. The vectorised version must return equal results; it also returns
each pixel's margin to the nearest threshold (float32 may decide differently if it is small), and is the
baseline for speed. Both are independent of the kernels that they check. A view is any object with ``camera``,
``color`` (H, W, 3), ``depth_z_m`` (H, W, 1), ``normal_world`` (H, W, 3) and ``surface_mask`` (H, W, 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Occlusion = Callable[[NDArray, NDArray], NDArray]
"""Mask (N,) of the occluded points, as a function of camera centres (N, 3) and points (N, 3)."""


@dataclass(frozen=True)
class OracleOptions:
    """Fields of ``StatisticsOptions`` and ``VisibilityOptions``; ``occlusion`` replaces the depth test."""

    best_views: int = 12
    include_self: bool = True
    is_bilinear: bool = True
    depth_tolerance: float = 0.005
    slope_tolerance_px: float = 1.0
    slope_limit: float = 0.05
    occlusion: Occlusion | None = None


def _unit(vector: NDArray) -> NDArray:
    length = math.sqrt(float(vector @ vector))
    return vector / length if length > 0 else vector


def _point(view: Any, row: int, column: int) -> NDArray:
    camera = view.camera
    z = float(view.depth_z_m[row, column, 0])
    x = (column + 0.5 - camera.cx_px) / camera.fx_px * z
    y = (row + 0.5 - camera.cy_px) / camera.fy_px * z
    pose = np.asarray(camera.world_from_camera, dtype=np.float64)
    return pose[:3, :3] @ np.array([x, y, z]) + pose[:3, 3]


def _projection(view: Any, point: NDArray) -> tuple[float, float, float]:
    camera = view.camera
    pose = np.asarray(camera.world_from_camera, dtype=np.float64)
    x, y, z = pose[:3, :3].T @ (point - pose[:3, 3])
    if z <= 0:
        return math.nan, math.nan, z
    return x / z * camera.fx_px + camera.cx_px, y / z * camera.fy_px + camera.cy_px, z


def _is_visible(view: Any, point: NDArray, normal: NDArray, options: OracleOptions) -> bool:
    camera = view.camera
    u, v, z = _projection(view, point)
    if not (z > 0 and 0 <= u < camera.width_px and 0 <= v < camera.height_px):
        return False
    centre = np.asarray(camera.world_from_camera, dtype=np.float64)[:3, 3]
    if not normal @ (centre - point) > 0:
        return False
    if options.occlusion is not None:
        return not bool(options.occlusion(centre[None], point[None])[0])
    rotation = np.asarray(camera.world_from_camera, dtype=np.float64)[:3, :3].T
    n = rotation @ normal
    ray = np.array([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0])
    slope = z * (abs(n[0]) / camera.fx_px + abs(n[1]) / camera.fy_px) / abs(n @ ray)
    tolerance = options.depth_tolerance * z + min(options.slope_tolerance_px * slope, options.slope_limit * z)
    return abs(float(view.depth_z_m[int(v), int(u), 0]) - z) <= tolerance


def _color(view: Any, point: NDArray, options: OracleOptions) -> NDArray:
    u, v, z = _projection(view, point)
    image = np.asarray(view.color, dtype=np.float64)
    height, width = image.shape[:2]
    if not options.is_bilinear:
        return image[int(v), int(u)]
    x, y = min(max(u - 0.5, 0.0), width - 1.0), min(max(v - 0.5, 0.0), height - 1.0)
    total, weights = np.zeros(3), 0.0
    for row in (int(y), int(y) + 1):
        for column in (int(x), int(x) + 1):
            weight = (1 - abs(x - column)) * (1 - abs(y - row))
            if weight > 0:
                difference = abs(float(view.depth_z_m[row, column, 0]) - z)
                if difference <= (options.depth_tolerance + options.slope_limit) * z:
                    total += weight * image[row, column]
                    weights += weight
    return total / weights if weights > 1e-3 else image[int(v), int(u)]


def statistics_by_loops(
    views: Sequence[Any], index: int, options: OracleOptions
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Minimum, median, maximum (H, W, 3) and count (H, W) of the colours of each pixel of view ``index``."""
    own = views[index]
    height, width = own.color.shape[:2]
    centres = [np.asarray(view.camera.world_from_camera, dtype=np.float64)[:3, 3] for view in views]
    minimum, median, maximum = (np.array(own.color, dtype=np.float64) for _ in range(3))
    count = np.zeros((height, width))
    for row in range(height):
        for column in range(width):
            if not (own.depth_z_m[row, column, 0] > 0 and own.surface_mask[row, column, 0] >= 0.5):
                continue
            point = _point(own, row, column)
            normal = _unit(np.asarray(own.normal_world[row, column], dtype=np.float64))
            distances = [math.dist(centre, point) for centre in centres]
            candidates = []
            for i, view in enumerate(views):
                if i == index:
                    is_candidate = options.include_self
                else:
                    is_candidate = _is_visible(view, point, normal, options)
                if is_candidate:
                    toward = (centres[i] - point) / distances[i]
                    candidates.append((-float(normal @ toward) + distances[i] / max(distances), i))
            chosen = [i for _, i in sorted(candidates)[: options.best_views]]
            if not chosen:
                continue
            colors = [
                np.asarray(own.color[row, column], dtype=np.float64)
                if i == index
                else _color(views[i], point, options)
                for i in chosen
            ]
            count[row, column] = len(chosen)
            for channel in range(3):
                values = sorted(float(color[channel]) for color in colors)
                middle = len(values) // 2
                minimum[row, column, channel], maximum[row, column, channel] = values[0], values[-1]
                median[row, column, channel] = (
                    values[middle] if len(values) % 2 else (values[middle - 1] + values[middle]) / 2
                )
    return minimum, median, maximum, count


def statistics_vectorized(
    views: Sequence[Any], index: int, options: OracleOptions
) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Like :func:`statistics_by_loops`; also returns each pixel's margin (H, W) to the nearest threshold.

    The margin is the minimum, over all views, of

    - the projection's distance in pixels to the image's border (to the pixel's border if depth is tested or
      colours are fetched from the nearest pixel);
    - with bilinear fetches, the distance of the weights' sum from its limit;
    - 20 times each of the following, whose float32 errors are smaller: |n . omega| (normal, unit direction to
      the camera), the gap between relative depth error and tolerance, and the cost gap between the last
      chosen and the first rejected view.
    """
    own = views[index]
    height, width = own.color.shape[:2]
    rows, columns = np.nonzero((own.depth_z_m[..., 0] > 0) & (own.surface_mask[..., 0] >= 0.5))
    z = own.depth_z_m[rows, columns, 0].astype(np.float64)
    camera = own.camera
    x = (columns + 0.5 - camera.cx_px) / camera.fx_px * z
    local = np.stack([x, (rows + 0.5 - camera.cy_px) / camera.fy_px * z, z], axis=-1)
    pose = np.asarray(camera.world_from_camera, dtype=np.float64)
    points = local @ pose[:3, :3].T + pose[:3, 3]
    normals = own.normal_world[rows, columns].astype(np.float64)
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = normals / np.where(lengths > 0, lengths, 1)
    centres = np.stack([np.asarray(view.camera.world_from_camera, dtype=np.float64)[:3, 3] for view in views])
    farthest = np.zeros(len(points))
    for centre in centres:
        farthest = np.maximum(farthest, np.linalg.norm(centre - points, axis=-1))
    costs = np.full((len(views), len(points)), np.inf)
    colors = np.zeros((len(views), len(points), 3))
    margin = np.full(len(points), np.inf)
    for i, view in enumerate(views):
        offset = centres[i] - points
        distance = np.linalg.norm(offset, axis=-1)
        cosine = np.einsum("nc,nc->n", normals, offset) / distance
        if i == index:
            visible = np.full(len(points), options.include_self)
            colors[i] = own.color[rows, columns]
        else:
            visible, colors[i], own_margin = _observe_vectorized(view, points, normals, cosine, options)
            margin = np.minimum(margin, own_margin)
        costs[i] = np.where(visible, distance / farthest - cosine, np.inf)
    k = min(options.best_views, len(views))
    order = np.argsort(costs, axis=0, kind="stable")
    ranked = np.take_along_axis(costs, order, axis=0)
    if k < len(views):
        with np.errstate(invalid="ignore"):
            gap = ranked[k] - ranked[k - 1]
        margin = np.minimum(margin, np.where(np.isnan(gap), np.inf, 20 * gap))
    chosen = np.take_along_axis(colors, order[:k, :, None], axis=0)
    is_set = np.isfinite(ranked[:k])
    number = is_set.sum(axis=0)
    values = np.sort(np.where(is_set[..., None], chosen, np.inf), axis=0)

    def at_rank(rank: NDArray) -> NDArray:
        return np.take_along_axis(values, np.maximum(rank, 0)[None, :, None], axis=0)[0]

    has_any = (number > 0)[:, None]
    results = (values[0], (at_rank((number - 1) // 2) + at_rank(number // 2)) / 2, at_rank(number - 1))
    outputs = [np.array(own.color, dtype=np.float64) for _ in range(3)]
    for output, result in zip(outputs, results, strict=True):
        output[rows, columns] = np.where(has_any, result, output[rows, columns])
    count, margins = np.zeros((height, width)), np.full((height, width), np.inf)
    count[rows, columns], margins[rows, columns] = number, margin
    return outputs[0], outputs[1], outputs[2], count, margins


def _observe_vectorized(
    view: Any, points: NDArray, normals: NDArray, cosine: NDArray, options: OracleOptions
) -> tuple[NDArray, NDArray, NDArray]:
    camera = view.camera
    height, width = view.color.shape[:2]
    pose = np.asarray(camera.world_from_camera, dtype=np.float64)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    z = local[:, 2]
    safe_z = np.where(z > 0, z, 1)
    ray_x, ray_y = local[:, 0] / safe_z, local[:, 1] / safe_z
    u, v = ray_x * camera.fx_px + camera.cx_px, ray_y * camera.fy_px + camera.cy_px
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    border = np.min(np.abs([u, v, u - width, v - height]), axis=0)
    margin = np.where(z > 0, border, np.abs(z))
    candidate = inside & (cosine > 0)
    margin = np.where(inside, np.minimum(margin, 20 * np.abs(cosine)), margin)
    column, row = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
    to_pixel_border = np.minimum(np.abs(u - np.round(u)), np.abs(v - np.round(v)))
    if options.occlusion is not None:
        visible = candidate & ~options.occlusion(np.broadcast_to(pose[:3, 3], points.shape), points)
    else:
        n = normals @ pose[:3, :3]
        facing = np.abs(n[:, 0] * ray_x + n[:, 1] * ray_y + n[:, 2])
        slope = (np.abs(n[:, 0]) / camera.fx_px + np.abs(n[:, 1]) / camera.fy_px) / np.maximum(facing, 1e-30)
        tolerance = options.depth_tolerance + np.minimum(
            options.slope_tolerance_px * slope, options.slope_limit
        )
        difference = np.abs(view.depth_z_m[row, column, 0].astype(np.float64) - z) / safe_z
        visible = candidate & (difference <= tolerance)
        decision = np.minimum(to_pixel_border, 20 * np.abs(difference - tolerance))
        margin = np.where(candidate, np.minimum(margin, decision), margin)
    image = view.color
    if not options.is_bilinear:
        return visible, image[row, column], np.where(candidate, np.minimum(margin, to_pixel_border), margin)
    x = np.clip(np.where(inside, u, 0) - 0.5, 0, width - 1)
    y = np.clip(np.where(inside, v, 0) - 0.5, 0, height - 1)
    x0, y0 = x.astype(int), y.astype(int)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    a, b = x - x0, y - y0
    total, weights = np.zeros((len(points), 3)), np.zeros(len(points))
    limit = options.depth_tolerance + options.slope_limit
    for tap_row, tap_column, weight in (
        (y0, x0, (1 - a) * (1 - b)),
        (y0, x1, a * (1 - b)),
        (y1, x0, (1 - a) * b),
        (y1, x1, a * b),
    ):
        tap_difference = np.abs(view.depth_z_m[tap_row, tap_column, 0].astype(np.float64) - z) / safe_z
        weight = np.where(tap_difference <= limit, weight, 0)
        total += weight[:, None] * image[tap_row, tap_column]
        weights += weight
        margin = np.where(visible, np.minimum(margin, 20 * np.abs(tap_difference - limit)), margin)
    margin = np.where(visible, np.minimum(margin, np.abs(weights - 1e-3)), margin)
    blended = total / np.where(weights > 1e-3, weights, 1)[:, None]
    return visible, np.where((weights > 1e-3)[:, None], blended, image[row, column]), margin

# SPDX-License-Identifier: MIT
"""Visibility and projections of points in all views, from the kernels of the statistics, as NumPy arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datagen.multiview.visibility import PackedViews, VisibilityOptions, observe
from mitsuba_plugins.arrays import vectors_from_rows

if TYPE_CHECKING:
    import mitsuba as mi


class PointObservations(NamedTuple):
    """Visibility and projections of N points in V views, as NumPy arrays."""

    visible_mask: NDArray[np.bool_]
    """(V, N), True where the point is visible."""
    pixels: NDArray[np.float32]
    """(V, N, 2), projections in pixels; NaN where not visible."""
    cosine: NDArray[np.float32]
    """(V, N), cosine between normal and direction to the camera; 0 where not visible."""
    distance_m: NDArray[np.float32]
    """(V, N), distance between camera and point, whether visible or not."""


def observe_points(
    views: PackedViews,
    points: NDArray,
    normals: NDArray,
    options: VisibilityOptions | None = None,
    scene: mi.Scene | None = None,
) -> PointObservations:
    """Project points (N, 3) with unit normals (N, 3) into every view and test their visibility.

    The result has V x N entries; process large numbers of points in blocks.
    """
    import drjit as dr
    import mitsuba as mi

    options = options or VisibilityOptions()
    position, normal = mi.Point3f(vectors_from_rows(points)), vectors_from_rows(normals)
    dr.eval(position, normal)
    rows = []
    for view in range(views.num_views):
        observed = observe(views, dr.opaque(mi.UInt32, view), position, normal, options, scene)
        outputs = (observed.is_visible, observed.u_px, observed.v_px, observed.cosine, observed.distance_m)
        dr.eval(outputs)
        rows.append([np.asarray(value.numpy()) for value in outputs])
    visible, u, v, cosine, distance = (np.stack(column) for column in zip(*rows, strict=True))
    pixels = np.where(visible[..., None], np.stack([u, v], axis=-1), np.float32(np.nan))
    return PointObservations(visible, pixels, np.where(visible, cosine, np.float32(0)), distance)

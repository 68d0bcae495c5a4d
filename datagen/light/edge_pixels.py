# SPDX-License-Identifier: MIT
"""Radiance of surfels that are visible only at depth edges, where a pixel shows several surfaces.

Let x be the radiance of the surface at the centre of pixel p, a_p the share of the pixel that it covers, and
b_p the radiance of everything else in the pixel times its share. The pixel has the radiance L = a_p x + b_p.
Rays through the pixel estimate a_p and b_p: other surfaces have the radiance of their surfels, the background
that of nearby pixels without a surface. The result is

    x_p = (L - b_p) / a_p,

whose standard error is SHARE_ERROR B / a_p, with B = b_p / (1 - a_p) the radiance behind the surface; for a
dark slat against a bright sky, it is many times x_p. Therefore x_p is shrunk towards the median of its
surfel, and this median towards the median of a block of the same smooth region, with weights from its own
variance and the variance of texture. Since an inaccurate mesh predicts its edges badly, 1 - a_p and b_p are
multiplied by a slope (:func:`edge_slope`), computed from the median of (L - X) / (a_p X + b_p - X) over edge
pixels of surfels whose radiance X is known from pixels without edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.geometry.traced import PIXEL_RAYS, TracedGeometry, rays_within_pixels
from datagen.geometry.views import TracedView
from datagen.light.background import photographed_background
from datagen.light.cells import unmixed_cells
from datagen.light.emitters import photographed_emitters
from datagen.light.radiance_field import RadianceField
from datagen.light.surfels import Surfels, build_surfels, grouped_medians
from mitsuba_plugins.arrays import point_argument, rows_from_vectors, vectors_from_rows

SHARE_ERROR = 0.04
"""Standard error of a_p, due to the finite numbers of rays here and of samples in the photographed pixel."""
TEXTURE = 0.5
"""Assumed standard deviation of the radiance within a block or surfel, relative to the median."""
BLOCK_CELLS = 20
"""Edge length, in cells, of the blocks to whose medians surfels with few or uncertain pixels are shrunk."""
MIN_SHARE = 0.1
"""Lower bound on the divisor a_p."""
WINDOW, MIN_SPREAD = 9, 0.01
"""Width in pixels of the regression window for the radiance of the background, and variance of the shares at
which the regression and the nearest empty pixel have equal weight."""
SAMPLED_EVERY = 7
"""One of this number of edge pixels far from mixed surfels is used; they affect only the slope."""
MIN_CONTRAST = 0.2
"""Minimum difference between X and the predicted L, relative to the larger one, in pixels used for the
slope."""
_TINY = 1e-30  # avoids a division by 0 where no radiance is behind, at any exposure
EXACT_SLOPE = 0.9
"""Lowest median of the ratios found with an exact mesh; the slope is the median divided by it. In the
development rooms, medians are 0.90 to 1.04 with exact meshes and 0.25 to 0.84 with inaccurate ones."""
PRIOR_PIXELS = 1000
"""Number of pixels of sufficient contrast at which the measured slope and the prior, 1, have equal weight."""


def unmixed(
    views: Sequence[TracedView],
    traced: TracedGeometry,
    emits: NDArray[np.bool_],
    region_of_face: NDArray[np.int32],
) -> list[TracedView]:
    """Return the views with the radiance of other surfaces removed from edge pixels of mixed surfels.

    ``emits`` (M,) and ``region_of_face`` (M,) are as in :func:`~datagen.light.lighting.light_surfels`.
    """
    surfels = build_surfels(views)
    emitters = photographed_emitters(views, traced, emits, region_of_face)
    grid = surfels.grid
    background = photographed_background(views, grid.low, grid.high)
    field = RadianceField(traced.scene, unmixed_cells(surfels), emitters, background)
    edges = [_edge_pixels(surfels, index, view) for index, view in enumerate(views)]
    parts = [_parts(field, view, at, region_of_face) for view, at in zip(views, edges, strict=True)]
    colors = [view.color.reshape(-1, 3)[at] for view, at in zip(views, edges, strict=True)]
    owner = np.concatenate([surfels.pixel_surfel[index][at] for index, at in enumerate(edges)])
    color, share = np.concatenate(colors), np.concatenate([part[0] for part in parts])
    other = np.concatenate([part[1] for part in parts])
    if not len(color):
        return list(views)
    slope = edge_slope(color, share, other, surfels.radiance[owner], ~surfels.is_mixed[owner])
    share, other = 1 - slope * (1 - share), slope * other
    divisor = np.maximum(share, MIN_SHARE)
    behind = other @ LUMINANCE_WEIGHTS / np.maximum(1 - share, 1 / PIXEL_RAYS)
    own = (color - other) / divisor[:, None]
    variance = np.square(SHARE_ERROR * behind / divisor) + _TINY
    found = _shrunk(surfels, region_of_face, owner, own, variance)
    found = np.where(surfels.is_mixed[owner, None], found, color).astype(np.float32)
    ends = np.cumsum([0, *map(len, edges)])
    result = []
    for view, at, first, last in zip(views, edges, ends[:-1], ends[1:], strict=True):
        changed = view.color.reshape(-1, 3).copy()
        changed[at] = found[first:last]
        result.append(replace(view, color=changed.reshape(view.color.shape)))
    return result


def edge_slope(
    color: NDArray, share: NDArray, other: NDArray, known: NDArray, is_known: NDArray[np.bool_]
) -> float:
    """Slope, in [0, 1], of the ``color`` (K, 3) of edge pixels against their prediction (module docstring).

    The prediction is ``share`` (K,) times the radiance ``known`` (K, 3) of the pixel's own surface, valid
    where ``is_known`` (K,), plus ``other`` (K, 3). Returns 1 if no pixel has sufficient contrast.
    """
    own = known @ LUMINANCE_WEIGHTS
    expected = share * own + other @ LUMINANCE_WEIGHTS - own
    contrast = np.abs(expected) / np.maximum(np.maximum(own, own + expected), 1e-12)
    used = is_known & (contrast > MIN_CONTRAST)
    num = int(used.sum())
    if not num:
        return 1.0
    shown = (color @ LUMINANCE_WEIGHTS - own)[used] / expected[used]
    slope = float(np.clip(np.median(shown) / EXACT_SLOPE, 0, 1))
    return (num * slope + PRIOR_PIXELS) / (num + PRIOR_PIXELS)


def _shrunk(
    surfels: Surfels,
    region_of_face: NDArray[np.int32],
    owner: NDArray[np.int32],
    own: NDArray,
    variance: NDArray,
) -> NDArray[np.float64]:
    """Shrink the radiance ``own`` (K, 3) of pixels, with luminance ``variance`` (K,), towards the median of
    their surfel ``owner`` (K,), itself shrunk towards that of its block and smooth region; at least 0.
    """
    side_m = BLOCK_CELLS * surfels.grid.cell_m
    cell = np.floor((surfels.position_m - surfels.grid.low) / side_m).astype(np.int64)
    place = np.column_stack([region_of_face[surfels.face], cell])
    block = np.unique(place, axis=0, return_inverse=True)[1].ravel()
    precision = 1 / variance
    in_block = np.maximum(grouped_medians(own, precision, block[owner], int(block.max()) + 1), 0)[block]
    of_surfel = 1 / np.maximum(np.bincount(owner, precision, len(surfels)), _TINY)
    in_surfel = _toward(in_block, grouped_medians(own, precision, owner, len(surfels)), of_surfel)
    return _toward(in_surfel[owner], own, variance)


def _toward(center: NDArray, values: NDArray, variance: NDArray) -> NDArray[np.float64]:
    """Shrink ``values`` (K, 3) with luminance ``variance`` (K,) towards ``center`` (K, 3), about which they
    have the relative standard deviation :data:`TEXTURE`; the result (K, 3) is at least 0.
    """
    spread = np.square(TEXTURE * (center @ LUMINANCE_WEIGHTS))
    weight = (spread / (spread + variance))[:, None]
    return np.maximum(weight * values + (1 - weight) * center, 0)


def _edge_pixels(surfels: Surfels, index: int, view: TracedView) -> NDArray[np.int64]:
    """Flat indices (K,) of unclipped pixels at edges and creases of view ``index``: those of mixed surfels,
    those around them, and a sample of the rest.
    """
    from scipy.ndimage import maximum_filter

    owner, shape = surfels.pixel_surfel[index], view.color.shape[:2]
    at_edge = (owner >= 0) & (surfels.pixel_weight[index] < 1)
    is_mixed = at_edge & surfels.is_mixed[owner]
    is_near = maximum_filter(is_mixed.reshape(shape), WINDOW).ravel()
    chosen = at_edge & (is_near | (np.arange(len(owner)) % SAMPLED_EVERY == 0))
    if view.clipped_mask is not None:
        chosen &= ~view.clipped_mask.any(axis=2).ravel()
    return np.flatnonzero(chosen)


def _parts(
    field: RadianceField, view: TracedView, pixel: NDArray[np.int64], region_of_face: NDArray[np.int32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Shares a_p (K,) and radiances b_p (K, 3) of pixels with flat indices (K,); see the module's docstring.

    Surfaces of unknown radiance count as the pixel's own surface.
    """
    from scipy.ndimage import maximum_filter

    if not len(pixel):
        return np.zeros(0, np.float32), np.zeros((0, 3), np.float32)
    empty = (view.geometry.depth_z_m[..., 0] <= 0) & view.valid_mask
    at_edge = np.zeros(empty.size, bool)
    at_edge[pixel] = True
    rim = np.flatnonzero(empty & maximum_filter(at_edge.reshape(empty.shape), WINDOW))
    radiance, is_known, face = _rays_through(field, view, np.concatenate([pixel, rim]))
    leaves = face < 0
    share = empty.astype(np.float32).ravel()
    share[np.concatenate([pixel, rim])] = leaves.mean(axis=1)
    num = len(pixel)
    radiance, is_known, face, leaves = radiance[:num], is_known[:num], face[:num], leaves[:num]
    own_face = view.geometry.face.ravel()[pixel]
    is_own = ~leaves & (region_of_face[np.maximum(face, 0)] == region_of_face[own_face][:, None])
    outside = _outside(view, pixel, share.reshape(empty.shape))
    if outside is not None:
        radiance = np.where(leaves[..., None], outside[:, None], radiance)
        is_known = is_known | leaves
    counts = is_known & ~is_own
    other = (radiance * counts[..., None]).sum(axis=1) / PIXEL_RAYS
    return (1 - counts.mean(axis=1)).astype(np.float32), other.astype(np.float32)


def _rays_through(
    field: RadianceField, view: TracedView, pixel: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.int32]]:
    """Radiance (K, J, 3) along J = :data:`~datagen.geometry.traced.PIXEL_RAYS` rays through each pixel,
    whether it is known (K, J), and the triangle hit by each ray (K, J), -1 for none.
    """
    import drjit as dr
    import mitsuba as mi

    toward = rays_within_pixels(view.camera, pixel).reshape(-1, 3)
    direction: Any = vectors_from_rows(toward)
    position = point_argument(view.camera.position_m)
    result = field.trace(mi.Ray3f(position, direction), mi.Bool(True)).result
    face = dr.select(dr.isfinite(result.distance_m), mi.Int32(result.face), -1)
    dr.eval(result, face)
    shape = len(pixel), PIXEL_RAYS
    radiance = rows_from_vectors(result.radiance).reshape(*shape, 3)
    return (
        radiance,
        np.asarray(result.is_known.numpy(), bool).reshape(shape),
        np.asarray(face.numpy()).reshape(shape),
    )


def _outside(view: TracedView, pixel: NDArray[np.int64], share: NDArray) -> NDArray[np.float32] | None:
    """Radiance (K, 3) of the background at the pixels with flat indices (K,); None without empty pixels.

    Radiance is regressed on ``share`` (H, W), the part of each pixel without a surface, in a window around
    the pixel, and evaluated at share 1. Where shares hardly vary, the nearest empty pixel's colour is used.
    """
    from scipy.ndimage import distance_transform_edt, uniform_filter

    if not (share == 1).any():
        return None
    rows, columns = distance_transform_edt(share < 1, return_distances=False, return_indices=True)
    nearest = view.color[rows.ravel()[pixel], columns.ravel()[pixel]]

    def mean(values: NDArray) -> NDArray:
        return uniform_filter(values, WINDOW)

    mean_share = mean(share)
    spread = np.maximum(mean(share * share) - mean_share**2, 0)
    found = np.empty_like(nearest)
    weight = (spread / (spread + MIN_SPREAD)).ravel()[pixel]
    for channel in range(3):
        color = view.color[..., channel]
        mean_color = mean(color)
        slope = (mean(share * color) - mean_share * mean_color) / (spread + 1e-6)
        at_one = np.maximum(mean_color + slope * (1 - mean_share), 0).ravel()[pixel]
        found[:, channel] = weight * at_one + (1 - weight) * nearest[:, channel]
    return found

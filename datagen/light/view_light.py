# SPDX-License-Identifier: MIT
"""Light recorded by the views of a room, per pixel, as input of networks.

There are N surfels and M observations. All values derive from the views' colours and the mesh, never from
the ground truth, so datasets (``datagen run --only stats``) and captures (``materials infer``) agree.
Irradiance is computed per surfel and mirror reflections per observation; pixels interpolate between the
surfels around them on their side of the surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.buffers import LIGHT_BUFFERS, MIRROR_ROUGHNESS, split_channels
from datagen.geometry.traced import TracedGeometry, smooth_regions
from datagen.geometry.views import TracedView
from datagen.light.lighting import MIN_SHADING, GatherOptions, light_surfels
from datagen.light.surfels import NUM_SIDES, camera_row, cell_of, place_pixel, surfels_around
from datagen.multiview.compiled import compiled

GATHERING = GatherOptions(irradiance_rays=64, estimate_rays=24, fits_estimates=False)
"""Fewer rays than in the reconstruction and no fitted gains, since network inputs may be noisy."""
MIRROR_RAYS = 6
"""Rays per observation and roughness; few, since pixels average several observations."""
_MIRROR_SEED = 23


class ViewLight:
    """Computes the light of all views; :meth:`buffers` returns that of one view.

    ``emits``: mask of the emissive triangles. The result does not depend on the order of the views.
    Raises :class:`InputError` if the views show no extended surface.
    """

    def __init__(self, views: Sequence[TracedView], traced: TracedGeometry, emits: NDArray[np.bool_]):
        order = sorted(range(len(views)), key=lambda index: camera_row(views[index]).tobytes())
        self._views = [views[index] for index in order]
        self._place = {index: place for place, index in enumerate(order)}
        self._lit = light_surfels(self._views, traced, emits, smooth_regions(traced.mesh), GATHERING)
        photographed = self._lit.irradiance.photographed[:, None]
        self._of_surfel = np.concatenate([self._lit.diffuse, photographed], axis=1)
        mirrors = [self._mirrored(roughness) for roughness in MIRROR_ROUGHNESS.values()]
        self._of_observation = np.concatenate(mirrors, axis=1)
        self._min_diffuse = MIN_SHADING * float(np.median(self._lit.diffuse))

    def _mirrored(self, roughness: float) -> NDArray[np.float32]:
        """Specular term Ls0 (M, 3) of every observation at ``roughness``, extrapolated to all light."""
        surfels = self._lit.surfels
        owner = surfels.surfel_of_observation()
        position, normal = surfels.position_m[owner], surfels.normal[owner]
        directions = surfels.directions(owner, surfels.observations.view)
        rough = np.full(len(owner), roughness)
        shading = self._lit.baker.specular(position, normal, directions, rough, MIRROR_RAYS, _MIRROR_SEED)
        return shading.extrapolated().ls0

    def buffers(self, index: int, color_median: NDArray) -> dict[str, NDArray[np.float32]]:
        """Return the :data:`~datagen.foundation.buffers.LIGHT_BUFFERS` (H, W, 3 or 1) of view ``index``.

        They are 0 without a surface. ``color_median`` (H, W, 3) is the median colour of each pixel's surface
        point over its best views.
        """
        place = self._place[index]
        view, surfels = self._views[place], self._lit.surfels
        rows = np.flatnonzero(surfels.observations.view == place)
        row_of = np.full(len(surfels), -1, np.int64)
        row_of[surfels.surfel_of_observation()[rows]] = rows
        grid, depth, own = surfels.grid, view.geometry.depth_z_m.ravel(), surfels.pixel_surfel[place]
        normal = np.ascontiguousarray(view.geometry.normal_world.reshape(-1, 3))
        cells = grid.low, grid.cell_m, grid.shape, grid.surfel
        sources = row_of, self._of_surfel, self._of_observation
        values = _interpolated(depth, normal, own, camera_row(view), *cells, *sources)
        values = values.reshape(*view.color.shape[:2], -1)
        found = split_channels(values, LIGHT_BUFFERS)
        diffuse = found["reflectance"]  # Ld, by which the colour is divided
        is_lit = (diffuse > self._min_diffuse).all(axis=2, keepdims=True)
        reflectance = np.where(is_lit, color_median / np.where(is_lit, diffuse, 1), 0).astype(np.float32)
        return {**found, "reflectance": reflectance}


@compiled
def _interpolated(
    depth, normal, own, camera, low, cell_m, shape, surfel, row_of, of_surfel, of_observation
):  # fmt: skip
    """Interpolate values of surfels (N, K) and observations (M, J) to P pixels; the result (P, K + J) is 0
    without a surfel.
    """
    num_first, num_second = of_surfel.shape[1], of_observation.shape[1]
    out = np.zeros((len(depth), num_first + num_second), np.float32)
    width = int(camera[16])
    here = np.zeros(3)
    near = np.zeros(8, np.int64)
    share = np.zeros(8, np.float32)
    for index in range(len(depth)):
        if own[index] < 0:
            continue
        place_pixel(index, depth[index], width, camera, here)
        side = cell_of(here, normal[index], low, cell_m, shape) % NUM_SIDES
        num = surfels_around(here, side, low, cell_m, shape, surfel, near, share)
        total, total_seen = np.float32(0), np.float32(0)
        for k in range(num):
            which, w = near[k], share[k]
            total += w
            for c in range(num_first):
                out[index, c] += w * of_surfel[which, c]
            row = row_of[which]
            if row >= 0:
                total_seen += w
                for c in range(num_second):
                    out[index, num_first + c] += w * of_observation[row, c]
        for c in range(num_first):
            out[index, c] /= total
        for c in range(num_second):  # never 0: the view observes the pixel's own surfel
            out[index, num_first + c] /= total_seen
    return out

# SPDX-License-Identifier: MIT
"""Caches the radiance of all photographed surfaces of a room, and of rays that miss its mesh.

Pixels on surfaces are grouped by cubes of space and the signed axis nearest to their normal, which separates
the two sides of a wall. The radiance of a cube is the median over views of each view's mean. The background
may be near, so a ray gets the radiance of the photographed background ray that is nearest in direction and in
the position where it leaves the surfaces' bounding box. Rays without a near one have no known radiance.

Colours are linear and at one exposure; radiance has the same unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.geometry.views import TracedView

Floats = NDArray[np.float64]

MAX_PIXELS = 4_000_000
"""Maximum number of pixels of all views, above which only every k-th pixel along both axes is used."""
CUBES_ACROSS = 150
"""Number of cubes along the diagonal of the photographed box, 5 cm a side in a room of 7 m."""
_MAX_BACKGROUND = 20_000
_REACH_CUBES = 2.0  # maximum distance to the nearest cube of known radiance, in cubes
_POSITION_WEIGHT = 2.25  # weight of a distance of one diagonal, relative to 1 rad of direction
_BACKGROUND_REACH = 1.0


@dataclass(frozen=True)
class SeenPixels:
    """P pixels on the mesh: view index (P,), flat index in the view (P,), world position and normal (P, 3),
    and cube index (P,) in the :class:`RadianceCache`.
    """

    view: NDArray[np.int64]
    pixel: NDArray[np.int64]
    position_m: Floats
    normal: Floats
    cube: NDArray[np.int64]


class RadianceCache:
    """Radiance of the surfaces and background in ``views``.

    Raises :class:`ValueError` if the views show no extended surface.
    """

    def __init__(self, views: Sequence[TracedView]):
        total = sum(view.valid_mask.size for view in views)
        step = max(1, int(np.ceil(np.sqrt(total / MAX_PIXELS))))
        parts = [_pixels_of(view, index, step) for index, view in enumerate(views)]
        if sum(len(part[0]) for part in parts) == 0:
            raise ValueError("no view sees the mesh")
        position, normal, color = (np.concatenate([part[k] for part in parts]) for k in (2, 3, 4))
        low, high = np.percentile(position, [2, 98], axis=0)
        self.size_m = float(np.linalg.norm(high - low))
        if self.size_m <= 0:
            raise ValueError("the views see no extended surface")
        self.cube_m = self.size_m / CUBES_ACROSS
        self._low, self._high = position.min(axis=0), position.max(axis=0)
        self._shape = np.ceil((self._high - self._low) / self.cube_m).astype(np.int64) + 3
        view_of = np.concatenate([part[0] for part in parts])
        cube = self.cubes(position, normal)
        self.pixels = SeenPixels(view_of, np.concatenate([part[1] for part in parts]), position, normal, cube)
        self._fill(cube, view_of, position, normal, color, len(views))
        self._set_background(views, step)

    def cubes(self, position_m: NDArray, normal: NDArray) -> NDArray[np.int64]:
        """Compute the cube index (N,) of points and normals (N, 3), clamped to the border of the grid."""
        at = ((position_m - self._low) / self.cube_m).astype(np.int64) + 1
        at = np.clip(at, 0, self._shape - 1)
        axis = np.abs(normal).argmax(axis=1)
        side = 2 * axis + (normal[np.arange(len(normal)), axis] > 0)
        return ((at[:, 0] * self._shape[1] + at[:, 1]) * self._shape[2] + at[:, 2]) * 6 + side

    def _fill(
        self,
        cube: NDArray[np.int64],
        view: NDArray[np.int64],
        position: Floats,
        normal: Floats,
        color: Floats,
        num_views: int,
    ) -> None:
        order = np.argsort(cube * num_views + view, kind="stable")
        keys, starts = np.unique((cube * num_views + view)[order], return_index=True)
        num = np.diff(np.append(starts, len(order)))
        of_view = np.add.reduceat(color[order], starts) / num[:, None]  # mean of each view in each cube
        cube_of_run = keys // num_views
        self._keys, first = np.unique(cube_of_run, return_index=True)
        count = np.diff(np.append(first, len(cube_of_run)))
        self._radiance = np.empty((len(first), 3))
        for channel in range(3):
            values = of_view[np.lexsort((of_view[:, channel], cube_of_run)), channel]
            self._radiance[:, channel] = 0.5 * (values[first + (count - 1) // 2] + values[first + count // 2])
        pixels = np.add.reduceat(num, first)
        place = np.add.reduceat(np.add.reduceat(position[order], starts), first) / pixels[:, None]
        facing = np.add.reduceat(np.add.reduceat(normal[order], starts), first)
        facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)
        self._tree = cKDTree(np.concatenate([place, facing * self.cube_m], axis=1))

    def at(self, position_m: Floats, normal: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Look up the radiance (N, 3) of surface points with ``normal`` towards the viewer, and the mask (N,)
        where it is known: in the point's cube, or else in a cube at most two cubes away.
        """
        wanted = self.cubes(position_m, normal)
        index = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        is_known = self._keys[index] == wanted
        rest = np.flatnonzero(~is_known)
        if len(rest):
            query = np.concatenate([position_m[rest], normal[rest] * self.cube_m], axis=1)
            distance, nearest = self._tree.query(query, distance_upper_bound=_REACH_CUBES * self.cube_m)
            found = np.isfinite(distance)
            index[rest[found]], is_known[rest[found]] = nearest[found], True
        return np.where(is_known[:, None], self._radiance[index], 0.0), is_known

    def _set_background(self, views: Sequence[TracedView], step: int) -> None:
        rays, colors = [], []
        for view in views:
            pixel = _grid(view, step)
            pixel = pixel[((view.geometry.face < 0) & view.valid_mask).ravel()[pixel]]
            direction = view.camera.ray_directions().reshape(-1, 3)[pixel]
            rays.append(self._leaving(np.broadcast_to(view.camera.position_m, direction.shape), direction))
            colors.append(view.color.reshape(-1, 3)[pixel])
        ray, color = np.concatenate(rays), np.concatenate(colors).astype(np.float64)
        chosen = np.random.default_rng(0).permutation(len(ray))[:_MAX_BACKGROUND]
        self._background = color[chosen]
        self._rays = cKDTree(ray[chosen]) if len(chosen) else None

    def _leaving(self, origin: Floats, direction: Floats) -> Floats:
        """Represent rays as points (N, 6): the position where they leave the surfaces' bounding box, in
        weighted diagonals, and their direction.
        """
        safe = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
        distance = np.maximum((np.where(safe > 0, self._high, self._low) - origin) / safe, 0.0).min(axis=1)
        place = (origin + distance[:, None] * direction) * (_POSITION_WEIGHT / self.size_m)
        return np.concatenate([place, direction], axis=1)

    def beyond(self, origin: Floats, direction: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Look up the radiance (N, 3) along rays that miss the mesh, and the mask (N,) where it is known."""
        if self._rays is None or not len(origin):
            return np.zeros((len(origin), 3)), np.zeros(len(origin), dtype=bool)
        distance, nearest = self._rays.query(
            self._leaving(origin, direction), distance_upper_bound=_BACKGROUND_REACH
        )
        is_known = np.isfinite(distance)
        found = self._background[np.minimum(nearest, len(self._background) - 1)]
        return np.where(is_known[:, None], found, 0.0), is_known


def _grid(view: TracedView, step: int) -> NDArray[np.int64]:
    """Return the flat indices of every ``step``-th pixel along both axes."""
    height, width = view.valid_mask.shape
    rows, columns = np.arange(step // 2, height, step), np.arange(step // 2, width, step)
    return (rows[:, None] * width + columns).ravel()


def _pixels_of(view: TracedView, index: int, step: int) -> tuple[NDArray, ...]:
    """Return view index (P,), flat index (P,), position, normal and colour (P, 3) of pixels on the mesh."""
    depth = view.geometry.depth_z_m.ravel()
    pixel = _grid(view, step)
    pixel = pixel[depth[pixel] > 0]
    direction = view.camera.ray_directions().reshape(-1, 3)[pixel]
    along = depth[pixel].astype(np.float64) / (direction @ view.camera.forward)
    return (
        np.full(len(pixel), index, np.int64),
        pixel,
        view.camera.position_m + direction * along[:, None],
        view.geometry.normal_world.reshape(-1, 3)[pixel].astype(np.float64),
        view.color.reshape(-1, 3)[pixel].astype(np.float64),
    )

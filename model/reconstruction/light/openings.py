# SPDX-License-Identifier: MIT
"""Finds openings: rectangles through which rays from a room's surfaces leave its mesh, and their radiance.

Rays that leave the background's bounding box through one connected part of a face belong to one opening. Its
plane is parallel to the face, at the depth where these rays cover the smallest area. All rays through an
opening are averaged, regardless of the face of the box through which they leave; since rays from surfels are
cosine-distributed, their mean radiance preserves the irradiance.

Where the mesh has a hole, photographs show the missing surface, which does not emit and is therefore darker
than white paint would be there: openings that are no brighter are holes, not windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.light.background import Background, box_squares
from datagen.light.radiance_field import RadianceField
from datagen.light.surfels import Surfels
from mitsuba_plugins.arrays import vectors_from_rows
from model.reconstruction.found_lights import FoundPatch, Rectangle, as_color
from model.reconstruction.light.rectangles import cover, cut

FINE = 96
"""Number of squares along each edge of a face of the bounding box."""
RAYS = 600_000
MIN_RAYS, MIN_OPEN = 2, 0.4
"""Minimum number of rays through an open square, and minimum ratio to the median over crossed squares; the
ratio is below 1, since a square at the edge of a window is only partly open."""
PLANES, MAX_DEPTH, MIN_INSIDE = 16, 0.25, 0.9
"""Number of candidate planes per face of the box, maximum depth of a plane relative to the box, and minimum
share of an opening's rays that start on the inner side of its plane."""
MAX_BUNDLES, MIN_BUNDLE = 32, 1e-3
"""Maximum number of bundles of rays, found in decreasing order of size, and minimum share of leaving rays in
each."""
MIN_SIDE = 1 / 60
"""Square root of a window's minimum area, relative to the box's diagonal; smaller openings may be cracks."""
MAX_BLOCK = FINE // 6
"""Maximum width and height of a rectangle in squares; larger ones are cut, to keep gradients of radiance."""
DARK = 1e-3
"""Minimum luminance of a window relative to the median over surfels."""
AROUND = 64
"""Number of surfels around an opening; their mean diffuse shading is the radiance of white paint there."""
_GAP = 1e-3  # from plane to rectangles, in box diagonals, so that rectangles never coincide with a wall


@dataclass(frozen=True)
class LeavingRays:
    """N rays from surfels that leave the mesh.

    ``origin``, ``direction`` and ``radiance`` are (N, 3); radiance is valid where ``is_known`` (N,). ``face``
    (N,): face of the bounding box through which the ray leaves, 2 axis + (1 if upper).
    """

    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    face: NDArray[np.int64]
    radiance: NDArray[np.float32]
    is_known: NDArray[np.bool_]

    def chosen(self, which: NDArray) -> LeavingRays:
        """Select rays; ``which`` is a mask (N,) or indices."""
        return LeavingRays(*(getattr(self, field.name)[which] for field in fields(self)))


def leaving_rays(field: RadianceField, surfels: Surfels) -> LeavingRays:
    """Trace about :data:`RAYS` cosine-distributed rays from surfels, and return those that leave the mesh."""
    import mitsuba as mi

    random = np.random.default_rng(0x77696E64)
    count = max(1, RAYS // len(surfels))
    step = max(1, len(surfels) // RAYS)
    normal = np.repeat(surfels.normal[::step], count, axis=0).astype(np.float64)
    gap = _GAP * float(np.linalg.norm(field.background.high - field.background.low))
    origin = np.repeat(surfels.position_m[::step], count, axis=0) + normal * gap
    sphere = random.normal(size=normal.shape)
    direction = normal + sphere / np.linalg.norm(sphere, axis=1, keepdims=True)  # cosine-distributed
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    ray = mi.Ray3f(mi.Point3f(vectors_from_rows(origin)), vectors_from_rows(direction))
    left = ~np.asarray(field.scene.ray_test(ray).numpy(), dtype=bool)
    return _gathered(field.background, origin[left], direction[left])


def _gathered(background: Background, origin: NDArray, direction: NDArray) -> LeavingRays:
    import mitsuba as mi

    face, _ = box_squares(origin, direction, background.low, background.high, FINE)
    if not len(origin):
        return LeavingRays(origin, direction, face, np.zeros((0, 3), np.float32), np.zeros(0, bool))
    at = background.bin_of(mi.Point3f(vectors_from_rows(origin)), vectors_from_rows(direction))
    bins = np.asarray(at.numpy()).astype(np.int64)
    return LeavingRays(origin, direction, face, background.radiance[bins], background.is_known[bins])


def found_openings(
    rays: LeavingRays, background: Background, median_luminance: float
) -> tuple[FoundPatch, ...]:
    """Find the openings through which ``rays`` leave, in decreasing order of power, without those darker than
    :data:`DARK` times ``median_luminance``.
    """
    windows: list[FoundPatch] = []
    rest = rays
    for _ in range(MAX_BUNDLES):
        bundle, face = _largest_bundle(rest, background)
        if bundle.sum() < max(MIN_RAYS, MIN_BUNDLE * len(rays.face)):
            break
        own = rest.chosen(bundle)
        plane = _narrowest(own, background, face)
        is_through = plane.within(rest, _is_open(_Squares.of(own, plane).num))
        seen = _Squares.of(rest.chosen(is_through), plane)
        found = (_window(part, seen, plane) for part in _components(_is_open(seen.num)))
        windows += [window for window in found if window is not None]
        rest = rest.chosen(~(bundle | is_through))
    floor = DARK * median_luminance
    windows = [window for window in windows if np.array(window.radiance) @ LUMINANCE_WEIGHTS > floor]
    windows.sort(key=lambda window: -window.area_m2 * float(np.array(window.radiance) @ LUMINANCE_WEIGHTS))
    return tuple(windows)


def divide_openings(
    openings: Sequence[FoundPatch], surfels: Surfels, diffuse: NDArray[np.float32]
) -> tuple[tuple[FoundPatch, ...], tuple[FoundPatch, ...]]:
    """Divide openings into windows, brighter than ``diffuse`` shading (N, 3) of nearby surfels, and holes."""
    white, tree = diffuse @ LUMINANCE_WEIGHTS, cKDTree(surfels.position_m)
    windows: list[FoundPatch] = []
    holes: list[FoundPatch] = []
    for opening in openings:
        _, around = tree.query(opening.place_m, min(AROUND, len(white)))
        is_hole = float(np.array(opening.radiance) @ LUMINANCE_WEIGHTS) <= float(white[around].mean())
        (holes if is_hole else windows).append(opening)
    return _named(windows, "window"), _named(holes, "hole")


def _named(patches: Sequence[FoundPatch], kind: str) -> tuple[FoundPatch, ...]:
    return tuple(replace(patch, slot=f"{kind}-{number}") for number, patch in enumerate(patches))


@dataclass(frozen=True)
class _Plane:
    """A plane parallel to a face of the box, ``depth_m`` inside it, with the same squares as the face."""

    box: Background
    face: int
    depth_m: float

    @property
    def axis(self) -> int:
        return self.face // 2

    @property
    def at_m(self) -> float:
        """Coordinate of the plane along its normal axis, in metres."""
        if self.face % 2:
            return float(self.box.high[self.axis]) - self.depth_m
        return float(self.box.low[self.axis]) + self.depth_m

    @property
    def across(self) -> tuple[int, int]:
        """The two axes parallel to the plane."""
        first, second = (axis for axis in range(3) if axis != self.axis)
        return first, second

    @property
    def square_m(self) -> NDArray[np.float64]:
        """Edge lengths (2,) of a square in metres; they differ unless the face of the box is a square."""
        return (self.box.high - self.box.low)[list(self.across)] / FINE

    def crossed(self, rays: LeavingRays) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Compute the mask (N,) of rays from the inner side, and the flat index (N,) of each ray's square."""
        along = rays.direction[:, self.axis]
        along = np.where(np.abs(along) < 1e-9, np.where(self.face % 2, 1e-9, -1e-9), along)
        distance = (self.at_m - rays.origin[:, self.axis]) / along
        across = list(self.across)
        place = rays.origin[:, across] + distance[:, None] * rays.direction[:, across]
        square = np.clip((place - self.box.low[across]) / self.square_m, 0, FINE - 1).astype(np.int64)
        return distance >= 0, square[:, 0] * FINE + square[:, 1]

    def within(self, rays: LeavingRays, is_open: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Compute the mask (N,) of the rays that cross the plane through open squares."""
        is_inside, square = self.crossed(rays)
        return is_inside & is_open.ravel()[square]


@dataclass(frozen=True)
class _Squares:
    """Sums over the rays through each square of a plane: the numbers of rays, ``num``, and of rays of known
    radiance, ``known``, (FINE, FINE) each, and the ``sums`` (FINE, FINE, 3) of known radiance.
    """

    num: NDArray[np.int64]
    known: NDArray[np.int64]
    sums: NDArray[np.float64]

    @classmethod
    def of(cls, rays: LeavingRays, plane: _Plane) -> _Squares:
        is_inside, square = plane.crossed(rays)
        shape = (FINE, FINE)
        known = is_inside & rays.is_known
        radiance = rays.radiance[known].astype(np.float64)
        sums = [np.bincount(square[known], radiance[:, c], FINE * FINE) for c in range(3)]
        return cls(
            np.bincount(square[is_inside], minlength=FINE * FINE).reshape(shape),
            np.bincount(square[known], minlength=FINE * FINE).reshape(shape),
            np.stack(sums, axis=-1).reshape(*shape, 3).astype(np.float64),
        )


def _is_open(num: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Compute the mask (FINE, FINE) of open squares from the number of rays ``num`` through each."""
    crossed = num[num > 0]
    if not len(crossed):
        return np.zeros((FINE, FINE), dtype=bool)
    enough = max(MIN_RAYS, MIN_OPEN * float(np.median(crossed)))
    padded = np.pad(num.reshape(FINE, FINE) >= enough, 2)
    return ndimage.binary_closing(padded, np.ones((3, 3)))[2:-2, 2:-2]


def _components(is_open: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Separate the open squares into masks (FINE, FINE) of connected components."""
    labels, count = ndimage.label(is_open)
    return [labels == label for label in range(1, count + 1)]


def _largest_bundle(rays: LeavingRays, background: Background) -> tuple[NDArray[np.bool_], int]:
    """Find the largest set of rays through one connected part of a face: its mask (N,) and the face."""
    best, of_face, most = np.zeros(len(rays.face), dtype=bool), 0, 0
    for face in range(6):
        is_on_face = rays.face == face
        if is_on_face.sum() <= most:
            continue
        plane = _Plane(background, face, 0.0)
        for part in _components(_is_open(_Squares.of(rays.chosen(is_on_face), plane).num)):
            bundle = is_on_face & plane.within(rays, part)
            if bundle.sum() > most:
                best, of_face, most = bundle, face, int(bundle.sum())
    return best, of_face


def _narrowest(rays: LeavingRays, background: Background, face: int) -> _Plane:
    """Find the plane parallel to ``face`` in which the rays cover the smallest area."""
    best, least = _Plane(background, face, 0.0), np.inf
    side = float((background.high - background.low)[face // 2])
    for depth in np.linspace(0, MAX_DEPTH * side, PLANES):
        plane = _Plane(background, face, float(depth))
        is_inside, square = plane.crossed(rays)
        if is_inside.mean() < MIN_INSIDE:
            break
        num_open = int(_is_open(np.bincount(square[is_inside], minlength=FINE * FINE)).sum())
        if num_open < least:
            best, least = plane, num_open
    return best


def _window(part: NDArray[np.bool_], seen: _Squares, plane: _Plane) -> FoundPatch | None:
    """Make a window of the connected open squares ``part``; None if it is too small or its radiance unknown.

    Its rectangles cover most of the squares and together emit the power of all squares.
    """
    area_m2 = float(part.sum() * plane.square_m.prod())
    diagonal = float(np.linalg.norm(plane.box.high - plane.box.low))
    if area_m2 < (MIN_SIDE * diagonal) ** 2 or not seen.known[part].any():
        return None
    mean = seen.sums[part].sum(axis=0) / seen.known[part].sum()
    blocks = [block for whole in cover(part) for block in cut(whole, MAX_BLOCK)]
    rectangles = [_rectangle(block, plane, seen, mean) for block in blocks]
    area = np.array([rectangle.area_m2 for rectangle in rectangles])
    share = area / area.sum()
    place = share @ np.stack([rectangle.corners().mean(axis=0) for rectangle in rectangles])
    radiance = share @ np.array([rectangle.radiance for rectangle in rectangles])
    scale = area_m2 / float(area.sum())
    scaled = tuple(replace(r, radiance=as_color(scale * np.array(r.radiance))) for r in rectangles)
    return FoundPatch("", scaled, as_color(place), area_m2, as_color(radiance))


def _rectangle(block: tuple[int, int, int, int], plane: _Plane, seen: _Squares, mean: NDArray) -> Rectangle:
    """Make the inward-facing rectangle of a ``block`` (row, column, rows, columns) of squares."""
    row, column, rows, columns = block
    window = (slice(row, row + rows), slice(column, column + columns))
    known = int(seen.known[window].sum())
    radiance = seen.sums[window].sum(axis=(0, 1)) / known if known else mean
    first, second = plane.across
    is_upper = plane.face % 2 == 1
    gap = _GAP * float(np.linalg.norm(plane.box.high - plane.box.low))
    origin, u, v = plane.box.low.astype(np.float64), np.zeros(3), np.zeros(3)
    origin[plane.axis] = plane.at_m + (gap if is_upper else -gap)
    origin[first] += row * plane.square_m[0]
    origin[second] += column * plane.square_m[1]
    u[first], v[second] = rows * plane.square_m[0], columns * plane.square_m[1]
    if (np.cross(u, v)[plane.axis] > 0) == is_upper:  # the normal must point inwards
        u, v = v, u
    return Rectangle(as_color(origin), as_color(u), as_color(v), as_color(radiance))

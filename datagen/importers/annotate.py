# SPDX-License-Identifier: MIT
"""Finds, in the bare triangles of a room, where things may stand, cameras may be and lamps may hang.

The heuristics are set out in docs/importing.md; a YAML file of :class:`Annotations` overrides each of them.
Frame: metres, Z up. Grids are indexed [x, y, z]; a *cell* is a small cube of the room grid (``RoomGrid``) or
a small square of a surface (``_SQUARE_M``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import (
    Box,
    LightSlot,
    MaterialClass,
    Opening,
    SupportKind,
    SupportSurface,
)
from datagen.formats.base import StrictModel, Vector3, quantized, read_yaml
from datagen.formats.lights import AreaLight, Light
from datagen.meshes import Mesh

_MAX_POINTS = 6_000_000  # sampled surface points; coarser sampling beyond keeps the memory below 100 MB
_SQUARE_M = 0.025
_MAX_GRID_CELLS = 6_000_000
_MIN_CELL_M = 0.06
_CAMERA_BAND_M = (0.7, 1.9)  # heights above the floor that a camera region must be free in
_CAMERA_MARGIN_M = 0.2
_STANDING_ROOM_M = 0.12  # a support needs this much free height
_LEVEL_M = 0.012  # horizontal triangles within this height belong to one surface
_MIN_SIDE_M = 0.15
_MAX_SURFACES = 40
_SLOT_SIDE_M = 0.6


class Annotations(StrictModel):
    """Sidecar for imported environments: every list that is given replaces the derived one.

    ``classes`` and ``replaceable_by`` correct the guesses for material slots, by slot name.
    """

    support_surfaces: tuple[SupportSurface, ...] | None = None
    light_slots: tuple[LightSlot, ...] | None = None
    openings: tuple[Opening, ...] | None = None
    camera_regions: tuple[Box, ...] | None = None
    classes: dict[str, tuple[MaterialClass, ...]] = {}
    replaceable_by: dict[str, tuple[MaterialClass, ...]] = {}


def read_annotations(path: Path | None) -> Annotations:
    """Annotations of a YAML file; empty ones for None. Raises :class:`InputError`."""
    return Annotations() if path is None else read_yaml(Annotations, path)


@dataclass(frozen=True)
class RoomPlaces:
    """What was found; ``floor_m`` is the height of the main floor, None if there is no enclosed space."""

    floor_m: float | None
    support_surfaces: tuple[SupportSurface, ...] = ()
    camera_regions: tuple[Box, ...] = ()
    light_slots: tuple[LightSlot, ...] = ()


def find_places(
    triangles: NDArray[np.float64],
    classes: NDArray[np.int64],
    seat_classes: set[int],
    seeds: NDArray[np.float64],
) -> RoomPlaces:
    """Places in a room of ``triangles`` (M, 3, 3).

    ``classes`` (M,) is an index a triangle, those in ``seat_classes`` are upholstery; ``seeds`` (K, 3) are
    points known to be inside (cameras), and may be empty.
    """
    points, owner, spacing = _surface_points(triangles)
    grid = RoomGrid.build(points, seeds, max(_MIN_CELL_M, 1.4 * spacing))
    if grid is None:
        return RoomPlaces(None)
    near = [h for h in _levels(triangles, grid) if abs(h - grid.floor_m) < 0.15]
    if near:  # the largest horizontal surface there, rather than skirtings and carpets
        grid = replace(grid, floor_m=near[0])
    soft = np.isin(classes, list(seat_classes))[owner] if seat_classes else np.zeros(len(owner), bool)
    surfaces = tuple(without_stairs(list(_support_surfaces(triangles, points, soft, grid, 1.25 * spacing))))
    regions = tuple(grid.camera_regions())
    return RoomPlaces(grid.floor_m, surfaces, regions, tuple(grid.ceiling_slots(regions)))


def openings_of(lights: tuple[Light, ...]) -> tuple[Opening, ...]:
    """Upright area lights of window size: scenes stand them into windows and doors. They point inwards."""
    found = []
    for light in lights:
        if isinstance(light, AreaLight) and light.shape == "rectangle":
            normal = np.cross(light.edge_u_m, light.edge_v_m)
            area = float(np.linalg.norm(normal))
            if area > 0.4 and abs(normal[2]) < 0.5 * area:
                found.append(
                    Opening(
                        name=light.name,
                        origin_m=light.origin_m,
                        edge_u_m=light.edge_u_m,
                        edge_v_m=light.edge_v_m,
                    )
                )
    return tuple(found)


def slots_of(lights: tuple[Light, ...]) -> tuple[LightSlot, ...]:
    """A slot for every area light that came with the scene."""
    return tuple(
        LightSlot(
            name=light.name,
            kind="area",
            origin_m=light.origin_m,
            edge_u_m=light.edge_u_m,
            edge_v_m=light.edge_v_m,
        )
        for light in lights
        if isinstance(light, AreaLight)
    )


def _vector(values: NDArray | list[float]) -> Vector3:
    x, y, z = (quantized(float(v), 6) for v in values)
    return x, y, z


def _surface_points(
    triangles: NDArray[np.float64],
) -> tuple[NDArray[np.float32], NDArray[np.int64], float]:
    """Points spread over the triangles (P, 3), their triangles (P,), and the distance that none exceeds.

    The distance is ``0.8 * _SQUARE_M``, more where that would give too many points.
    """
    lengths = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)  # edge k: corner k to k + 1
    turn = (lengths.argmax(axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(triangles, turn[:, :, None], axis=1).transpose(1, 0, 2)
    base = lengths.max(axis=1)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    height = 2 * area / np.maximum(base, 1e-30)
    spacing = 0.8 * _SQUARE_M
    while (area / spacing**2 + base / spacing + 1).sum() > _MAX_POINTS:
        spacing *= 1.1
    num_rows = np.maximum(1, np.ceil(height / spacing)).astype(np.int64)  # rows run along the longest edge
    row_owner = np.repeat(np.arange(len(triangles)), num_rows)
    row_v = (_counted(num_rows) + 0.5) / num_rows[row_owner]
    num_columns = np.maximum(1, np.ceil(base[row_owner] * (1 - row_v) / spacing)).astype(np.int64)
    row = np.repeat(np.arange(len(row_owner)), num_columns)
    owner, v = row_owner[row], row_v[row][:, None]
    u = ((_counted(num_columns) + 0.5) / num_columns[row])[:, None] * (1 - v)
    points = a[owner] * (1 - u - v) + b[owner] * u + c[owner] * v
    return points.astype(np.float32), owner, spacing


def _counted(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """0 .. counts[0] - 1, 0 .. counts[1] - 1, ... in one array."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


@dataclass(frozen=True)
class RoomGrid:
    """Cubes of side ``cell_m`` from ``origin_m``, ``occupied`` or ``interior`` (free and enclosed)."""

    origin_m: NDArray[np.float64]
    cell_m: float
    occupied: NDArray[np.bool_]
    interior: NDArray[np.bool_]
    floor_m: float

    @classmethod
    def build(
        cls, points: NDArray[np.float32], seeds: NDArray[np.float64], min_cell_m: float
    ) -> RoomGrid | None:
        """The grid of the room that holds most seeds (or is largest); None if no space is enclosed.

        ``min_cell_m`` must exceed the distance between points, else walls have holes.
        """
        from scipy import ndimage

        lower, upper = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
        extent = np.maximum(upper - lower, 1e-3)
        cell = max(min_cell_m, float(np.cbrt(np.prod(extent) / _MAX_GRID_CELLS)))
        origin = lower - 1.5 * cell
        shape = tuple(int(n) for n in np.ceil(extent / cell) + 3)
        occupied = np.zeros(shape, dtype=bool)
        index = ((points - origin) / cell).astype(np.int64)
        occupied[index[:, 0], index[:, 1], index[:, 2]] = True
        walls = np.zeros(shape, dtype=np.int8)
        for axis in range(3):
            walls += np.logical_or.accumulate(occupied, axis=axis)
            walls += np.flip(np.logical_or.accumulate(np.flip(occupied, axis), axis=axis), axis)
        inside = ((seeds - origin) / cell).astype(np.int64) if len(seeds) else np.zeros((0, 3), np.int64)
        inside = inside[((inside >= 0) & (inside < shape)).all(axis=1)]
        for num_sides in (5, 4):  # of six; film sets lack a wall, or a wall and the ceiling
            labels, count = ndimage.label(~occupied & (walls >= num_sides))
            hits = labels[tuple(inside.T)]
            hits = hits[hits > 0]
            if len(hits) or (count and not len(inside)):
                break
        else:
            return None
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        interior = labels == (int(np.bincount(hits).argmax()) if len(hits) else int(sizes.argmax()))
        lowest = np.where(interior.any(axis=2), interior.argmax(axis=2), -1)
        levels = np.bincount(lowest[lowest >= 0])
        floor_cell = int(levels.argmax())
        edge = origin[2] + floor_cell * cell
        near = points[np.abs(points[:, 2] - edge) < 1.5 * cell][:, 2]
        if len(near):  # the height that most points share, rather than the edge of a cube
            bins = np.round(near / 0.005).astype(np.int64)
            values, counts = np.unique(bins, return_counts=True)
            edge = float(near[bins == values[counts.argmax()]].mean())
        return cls(origin, cell, occupied, interior, float(edge))

    def is_interior(self, points: NDArray) -> NDArray[np.bool_]:
        """Whether points (P, 3) lie in the free space of the room."""
        index = ((points - self.origin_m) / self.cell_m).astype(np.int64)
        valid = ((index >= 0) & (index < self.interior.shape)).all(axis=1)
        result = np.zeros(len(points), dtype=bool)
        result[valid] = self.interior[tuple(index[valid].T)]
        return result

    def _layer(self, height_m: float) -> int:
        return int(np.clip((height_m - self.origin_m[2]) / self.cell_m, 0, self.interior.shape[2] - 1))

    def camera_regions(self) -> Iterator[Box]:
        """Up to four boxes that are free from knee to head height, standing on the floor."""
        from scipy import ndimage

        low, high = (
            self._layer(self.floor_m + _CAMERA_BAND_M[0]),
            self._layer(self.floor_m + _CAMERA_BAND_M[1]),
        )
        band = self.interior[:, :, low : high + 1].all(axis=2)
        margin = max(1, math.ceil(_CAMERA_MARGIN_M / self.cell_m))
        free = ndimage.binary_erosion(band, iterations=margin)
        for x0, x1, y0, y1 in _rectangles(free, 4, max(2, math.ceil(0.3 / self.cell_m))):
            column = self.interior[x0:x1, y0:y1, low:].all(axis=(0, 1))
            free_layers = len(column) if column.all() else int(np.argmin(column))
            top = self.origin_m[2] + (low + max(free_layers - 1, high + 1 - low)) * self.cell_m
            minimum = [*(self.origin_m[:2] + np.array([x0, y0]) * self.cell_m), self.floor_m]
            maximum = [*(self.origin_m[:2] + np.array([x1, y1]) * self.cell_m), top]
            yield Box(minimum_m=_vector(minimum), maximum_m=_vector(maximum))

    def ceiling_slots(self, regions: tuple[Box, ...]) -> Iterator[LightSlot]:
        """A square lamp below the ceiling over the middle of each camera region."""
        for number, region in enumerate(regions[:2]):
            x, y = ((a + b) / 2 for a, b in zip(region.minimum_m[:2], region.maximum_m[:2], strict=True))
            start = self._layer((region.minimum_m[2] + region.maximum_m[2]) / 2)
            cell = ((np.array([x, y]) - self.origin_m[:2]) / self.cell_m).astype(int)
            reach = max(1, round(_SLOT_SIDE_M / 2 / self.cell_m))
            block = self.occupied[
                max(0, cell[0] - reach) : cell[0] + reach + 1,
                max(0, cell[1] - reach) : cell[1] + reach + 1,
                start:,
            ].any(axis=(0, 1))
            if not block.any():
                continue
            height = self.origin_m[2] + (start + int(block.argmax())) * self.cell_m - 0.05
            half = _SLOT_SIDE_M / 2
            yield LightSlot(
                name=f"ceiling_{number}",
                kind="area",
                origin_m=_vector([x - half, y - half, height]),
                edge_u_m=(0.0, _SLOT_SIDE_M, 0.0),
                edge_v_m=(_SLOT_SIDE_M, 0.0, 0.0),  # u x v points down
            )


def _support_surfaces(
    triangles: NDArray[np.float64],
    points: NDArray[np.float32],
    soft: NDArray[np.bool_],
    grid: RoomGrid,
    square_m: float,
) -> Iterator[SupportSurface]:
    """Axis-aligned rectangles on horizontal triangles with free space above, largest first at each level."""
    from scipy import ndimage

    found: list[tuple[float, NDArray, NDArray]] = []  # height, origin, size
    for height in _levels(triangles, grid):
        above = height - grid.floor_m
        if 0.04 < above < 0.3:
            continue  # steps and skirtings
        on_level = np.abs(points[:, 2] - height) < _LEVEL_M
        surface = points[on_level]
        inside = grid.is_interior(surface + np.array([0, 0, 1.3 * grid.cell_m], dtype=np.float32))
        if not inside.any():
            continue
        surface, cushions = surface[inside], soft[on_level][inside]
        corner = surface[:, :2].min(axis=0) - square_m
        shape = tuple(int(n) for n in np.ceil((surface[:, :2].max(axis=0) - corner) / square_m) + 2)
        covered = _raster(surface, corner, shape, square_m)
        covered = ndimage.binary_closing(covered, structure=np.ones((3, 3)))
        over = points[(points[:, 2] > height + _LEVEL_M) & (points[:, 2] < height + 2.5)]
        near = over[over[:, 2] < height + _STANDING_ROOM_M]
        free = covered & ~ndimage.binary_dilation(_raster(near, corner, shape, square_m))
        is_floor = abs(above) <= 0.04
        minimum = max(3, round((0.5 if is_floor else _MIN_SIDE_M) / square_m))
        for x0, x1, y0, y1 in _rectangles(free, 6 if is_floor else 2, minimum):
            origin = corner + np.array([x0, y0]) * square_m
            size = np.array([x1 - x0, y1 - y0]) * square_m
            if any(_is_same(height, origin, size, *other) for other in found):
                continue
            within = ((over[:, :2] >= origin) & (over[:, :2] <= origin + size)).all(axis=1)
            clearance = float(over[within][:, 2].min() - height) if within.any() else 2.5
            is_soft = np.count_nonzero(cushions) * 2 > len(cushions)
            kind = _kind_of(above, is_soft)
            yield SupportSurface(
                name=f"{kind}_{len(found)}",
                kind=kind,
                origin_m=_vector([*origin, height]),
                edge_u_m=_vector([size[0], 0.0, 0.0]),
                edge_v_m=_vector([0.0, size[1], 0.0]),
                clearance_m=quantized(clearance, 4),
            )
            found.append((height, origin, size))
            if len(found) >= _MAX_SURFACES:
                return


def _is_same(
    height: float,
    origin: NDArray,
    size: NDArray,
    other_height: float,
    other_origin: NDArray,
    other_size: NDArray,
) -> bool:
    """Whether two rectangles are layers of one surface (a floor and its tiles) and cover each other."""
    common = np.minimum(origin + size, other_origin + other_size) - np.maximum(origin, other_origin)
    return abs(height - other_height) < 0.05 and bool((common > 0.1).all())


def without_stairs(surfaces: list[SupportSurface]) -> list[SupportSurface]:
    """The surfaces less treads: those with a neighbour one step above and one step below beside them.

    Shelves have such neighbours too, but over and under them.
    """

    def is_step(low: SupportSurface, high: SupportSurface) -> bool:
        if not 0.1 < high.origin_m[2] - low.origin_m[2] < 0.36:
            return False
        gaps, overlaps = [], []
        for axis, edge in ((0, "edge_u_m"), (1, "edge_v_m")):
            a0, b0 = low.origin_m[axis], high.origin_m[axis]
            a1, b1 = a0 + getattr(low, edge)[axis], b0 + getattr(high, edge)[axis]
            gaps.append(max(a0, b0) - min(a1, b1))
            overlaps.append(max(0.0, min(a1, b1) - max(a0, b0)) / min(a1 - a0, b1 - b0))
        return max(gaps) < 0.15 and overlaps[0] * overlaps[1] < 0.4

    kept = []
    for surface in surfaces:
        if surface.kind != "floor":
            above = any(is_step(surface, other) for other in surfaces)
            below = any(is_step(other, surface) for other in surfaces)
            if above and below:
                continue
        kept.append(surface)
    return kept


def _kind_of(above_floor_m: float, is_soft: bool) -> SupportKind:
    if abs(above_floor_m) <= 0.04:
        return "floor"
    if is_soft and above_floor_m < 0.65:
        return "seat"
    if above_floor_m < 0.82:
        return "table"
    return "counter" if above_floor_m < 1.1 else "shelf"


def _levels(triangles: NDArray[np.float64], grid: RoomGrid) -> list[float]:
    """Heights at which horizontal triangles of the room add up to a surface, by area, largest first."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    flat = (area > 1e-9) & (np.abs(cross[:, 2]) > 0.995 * 2 * area)  # either side: windings are unreliable
    heights, areas = triangles[flat][:, :, 2].mean(axis=1), area[flat]
    inside = (heights > grid.floor_m - 0.1) & (heights < grid.floor_m + 2.2)
    heights, areas = heights[inside], areas[inside]
    order = np.argsort(heights)
    heights, areas = heights[order], areas[order]
    if not len(heights):
        return []
    groups = np.cumsum(np.concatenate([[0], np.diff(heights) > 0.5 * _LEVEL_M]))
    total = np.bincount(groups, weights=areas)
    mean = np.bincount(groups, weights=areas * heights) / total
    big = np.flatnonzero(total > _MIN_SIDE_M**2)
    return [float(mean[k]) for k in big[np.argsort(-total[big])][:_MAX_SURFACES]]


def _raster(
    points: NDArray[np.float32], corner: NDArray, shape: tuple[int, ...], square_m: float
) -> NDArray[np.bool_]:
    mask = np.zeros(shape, dtype=bool)
    index = ((points[:, :2] - corner) / square_m).astype(np.int64)
    valid = ((index >= 0) & (index < shape)).all(axis=1)
    mask[index[valid, 0], index[valid, 1]] = True
    return mask


def _rectangles(mask: NDArray[np.bool_], count: int, min_side: int) -> Iterator[tuple[int, int, int, int]]:
    """Largest free rectangles (x0, x1, y0, y1), one after the other, none overlapping another."""
    mask = mask.copy()
    for _ in range(count):
        x0, x1, y0, y1 = largest_rectangle(mask, min_side)
        if x1 <= x0:
            return
        yield x0, x1, y0, y1
        mask[x0:x1, y0:y1] = False


def largest_rectangle(mask: NDArray[np.bool_], min_side: int = 1) -> tuple[int, int, int, int]:
    """The all-True rectangle of greatest area with both sides at least ``min_side``; (0, 0, 0, 0) if none.

    Row by row over the heights of the columns of True above (the largest rectangle in a histogram).
    """
    best, result = 0, (0, 0, 0, 0)
    heights = np.zeros(mask.shape[1] + 1, dtype=np.int64)  # the last stays 0 and closes every open column
    for row in range(mask.shape[0]):
        heights[:-1] = np.where(mask[row], heights[:-1] + 1, 0)
        if heights.max() * mask.shape[1] <= best:
            continue
        stack: list[tuple[int, int]] = []  # (start, height), heights increasing
        for column, height in enumerate(heights.tolist()):
            start = column
            while stack and stack[-1][1] > height:
                start, tall = stack.pop()
                if tall >= min_side and column - start >= min_side and tall * (column - start) > best:
                    best = tall * (column - start)
                    result = (row + 1 - tall, row + 1, start, column)
            if height and (not stack or stack[-1][1] < height):
                stack.append((start, height))
    return result


def opening_of(mesh: Mesh, name: str, inside_m: NDArray[np.float64]) -> Opening:
    """The upright rectangle that frames a mesh (a window pane), pointing to the side of ``inside_m``."""
    points = mesh.positions.astype(np.float64)
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    _, axes = np.linalg.eigh(flat.T @ flat)
    along = np.array([axes[0, 1], axes[1, 1], 0.0])  # the longer horizontal axis
    reach = (points - center) @ along
    width, height = float(np.ptp(reach)), float(np.ptp(points[:, 2]))
    edge_u, edge_v = along * width, np.array([0.0, 0.0, height])
    if float(np.cross(edge_u, edge_v) @ (inside_m - center)) < 0:
        edge_u = -edge_u
    origin = center - 0.5 * (edge_u + edge_v)
    return Opening(name=name, origin_m=_vector(origin), edge_u_m=_vector(edge_u), edge_v_m=_vector(edge_v))

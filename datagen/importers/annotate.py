# SPDX-License-Identifier: MIT
"""Support surfaces, camera regions and ceiling light slots, derived from a room's triangles.

docs/importing.md describes the heuristics; a YAML file of :class:`Annotations` overrides their results.
Frame: metres, Z up. Surfaces are rasterised on a horizontal grid of squares of side ``square_m``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from datagen.formats.asset import (
    AssetCamera,
    Box,
    LightSlot,
    MaterialClass,
    Opening,
    Part,
    SlotMaterial,
    SupportKind,
    SupportSurface,
)
from datagen.formats.base import StrictModel, quantized, read_yaml, vector3
from datagen.formats.lights import AreaLight, Light
from datagen.foundation.findings import Findings
from datagen.foundation.meshes.mesh import Mesh, area_vectors
from datagen.foundation.rectangles import rectangles
from datagen.importers.room_grid import DIGITS, MIN_CELL_M, RoomGrid, surface_points

_STANDING_ROOM_M = 0.12  # minimum free height above a support
_LEVEL_M = 0.012  # height tolerance within which horizontal triangles form one surface
_MIN_SIDE_M = 0.15
_MAX_SURFACES = 40
_Rectangle = tuple[float, NDArray, NDArray]  # height, origin and size


class Annotations(StrictModel):
    """The user's annotations of an imported environment; each given list replaces the derived one.

    ``classes`` and ``replaceable_by`` override the guesses for the material slots that they name.
    """

    support_surfaces: tuple[SupportSurface, ...] | None = None
    light_slots: tuple[LightSlot, ...] | None = None
    openings: tuple[Opening, ...] | None = None
    camera_regions: tuple[Box, ...] | None = None
    classes: dict[str, Annotated[tuple[MaterialClass, ...], Field(min_length=1)]] = {}
    replaceable_by: dict[str, tuple[MaterialClass, ...]] = {}

    def over(self, places: RoomPlaces, openings: tuple[Opening, ...]) -> dict[str, Any]:
        """Return fields of an environment by name: the user's values, if given, else the derived ones."""
        derived = {
            "support_surfaces": places.support_surfaces,
            "camera_regions": places.camera_regions,
            "light_slots": places.light_slots,
            "openings": openings,
        }
        given = {name: getattr(self, name) for name in derived}
        return {name: derived[name] if value is None else value for name, value in given.items()}

    def corrected(self, slot: str, material: SlotMaterial) -> SlotMaterial:
        """Return the material of a slot with the user's ``classes`` and ``replaceable_by``, if given."""
        given = {"classes": self.classes, "replaceable_by": self.replaceable_by}
        return material.model_copy(update={k: v[slot] for k, v in given.items() if slot in v})


def read_annotations(path: Path | None) -> Annotations:
    """Read annotations from a YAML file (None: no annotations). Raises :class:`InputError` if invalid."""
    return Annotations() if path is None else read_yaml(Annotations, path)


@dataclass(frozen=True)
class RoomPlaces:
    """Derived annotations of a room; ``floor_m``: height of the main floor, None if no space is enclosed."""

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
    """Derive the annotations of a room from its ``triangles`` (M, 3, 3).

    ``classes`` (M,): integer label of each triangle; labels in ``seat_classes`` mark upholstery. ``seeds``
    (K, 3): points inside the room, such as camera positions; K may be 0.
    """
    points, owner, spacing = surface_points(triangles)
    grid = RoomGrid.build(points, seeds, max(MIN_CELL_M, 1.4 * spacing))
    if grid is None:
        return RoomPlaces(None)
    near = [h for h in _levels(triangles, grid) if abs(h - grid.floor_m) < 0.15]
    if near:  # use the largest horizontal surface, not a skirting board or carpet
        grid = replace(grid, floor_m=near[0])
    soft = np.isin(classes, list(seat_classes))[owner] if seat_classes else np.zeros(len(owner), bool)
    surfaces = tuple(without_stairs(list(_support_surfaces(triangles, points, soft, grid, 1.25 * spacing))))
    regions = tuple(grid.camera_regions())
    return RoomPlaces(grid.floor_m, surfaces, regions, tuple(grid.ceiling_slots(regions)))


def places_of_parts(
    meshes: Sequence[Mesh],
    parts: Sequence[Part],
    slots: Mapping[str, SlotMaterial],
    cameras: Sequence[AssetCamera],
    findings: Findings,
) -> RoomPlaces:
    """Derive the annotations of an environment by :func:`find_places`, with its cameras as seeds.

    ``meshes`` are the parts' meshes in the asset's frame. Fabric and leather are upholstery.
    """
    triangles = [mesh.triangles() for mesh in meshes]
    owners = np.repeat(np.arange(len(meshes)), [len(t) for t in triangles])
    seats = {k for k, p in enumerate(parts) if slots[p.material].classes[0] in ("fabric", "leather")}
    seeds = np.array([[row[3] for row in c.asset_from_camera[:3]] for c in cameras]).reshape(-1, 3)
    places = find_places(np.concatenate(triangles), owners, seats, seeds)
    if places.floor_m is None:
        findings.note(
            "annotations: no enclosed space found; give supports and camera regions with --annotations"
        )
    return places


def is_window_sized(opening: Opening | AreaLight, min_area_m2: float) -> bool:
    """Return whether an opening is within 30 degrees of vertical and larger than ``min_area_m2``."""
    normal = np.cross(opening.edge_u_m, opening.edge_v_m)
    area = float(np.linalg.norm(normal))
    return area > min_area_m2 and bool(abs(normal[2]) < 0.5 * area)


def openings_of(lights: tuple[Light, ...]) -> tuple[Opening, ...]:
    """Return an opening at each vertical rectangular light over 0.4 m², usually a window or door."""
    found = []
    for light in lights:
        if isinstance(light, AreaLight) and light.shape == "rectangle" and is_window_sized(light, 0.4):
            edges = {"edge_u_m": light.edge_u_m, "edge_v_m": light.edge_v_m}
            found.append(Opening(name=light.name, origin_m=light.origin_m, **edges))
    return tuple(found)


def slots_of(lights: tuple[Light, ...]) -> tuple[LightSlot, ...]:
    """Return a light slot for every area light of ``lights``."""
    return tuple(
        LightSlot(name=a.name, kind="area", origin_m=a.origin_m, edge_u_m=a.edge_u_m, edge_v_m=a.edge_v_m)
        for a in lights
        if isinstance(a, AreaLight)
    )


def _support_surfaces(
    triangles: NDArray[np.float64],
    points: NDArray[np.float32],
    soft: NDArray[np.bool_],
    grid: RoomGrid,
    square_m: float,
) -> Iterator[SupportSurface]:
    """Yield axis-aligned rectangles with free space above them, level by level, largest first per level."""
    from scipy import ndimage

    found: list[_Rectangle] = []
    for height in _levels(triangles, grid):
        above = height - grid.floor_m
        if 0.04 < above < 0.3:
            continue  # steps and skirting boards
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
        for x0, x1, y0, y1 in rectangles(free, 6 if is_floor else 2, minimum):
            origin = corner + np.array([x0, y0]) * square_m
            size = np.array([x1 - x0, y1 - y0]) * square_m
            if any(_is_same((height, origin, size), other) for other in found):
                continue
            within = ((over[:, :2] >= origin) & (over[:, :2] <= origin + size)).all(axis=1)
            clearance = float(over[within][:, 2].min() - height) if within.any() else 2.5
            is_soft = np.count_nonzero(cushions) * 2 > len(cushions)
            kind = _kind_of(above, is_soft)
            yield SupportSurface(
                name=f"{kind}_{len(found)}",
                kind=kind,
                origin_m=vector3([*origin, height], DIGITS),
                edge_u_m=vector3([size[0], 0.0, 0.0], DIGITS),
                edge_v_m=vector3([0.0, size[1], 0.0], DIGITS),
                clearance_m=quantized(clearance, 4),
            )
            found.append((height, origin, size))
            if len(found) >= _MAX_SURFACES:
                return


def _is_same(one: _Rectangle, other: _Rectangle) -> bool:
    """Return whether two horizontal rectangles overlap by over 10 cm in x and y and are within 5 cm in z."""
    common = np.minimum(one[1] + one[2], other[1] + other[2]) - np.maximum(one[1], other[1])
    return abs(one[0] - other[0]) < 0.05 and bool((common > 0.1).all())


def without_stairs(surfaces: list[SupportSurface]) -> list[SupportSurface]:
    """Return the surfaces except stair treads, which adjoin surfaces one step above and one step below.

    The boards of a shelf do not count as adjoining, since they lie directly above each other.
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
        above = any(is_step(surface, other) for other in surfaces)
        below = any(is_step(other, surface) for other in surfaces)
        if surface.kind == "floor" or not (above and below):
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
    """Return the heights of the room's horizontal surfaces, in order of decreasing total area."""
    cross = area_vectors(triangles)
    area = 0.5 * np.linalg.norm(cross, axis=1)
    # facing up or down, since windings are unreliable
    flat = (area > 1e-9) & (np.abs(cross[:, 2]) > 0.995 * 2 * area)
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


def opening_of(mesh: Mesh, name: str, inside_m: NDArray[np.float64]) -> Opening:
    """Return the vertical rectangle that bounds ``mesh``, such as a pane, and faces ``inside_m`` (3,)."""
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
    origin_m, edge_u_m, edge_v_m = (vector3(vector, DIGITS) for vector in (origin, edge_u, edge_v))
    return Opening(name=name, origin_m=origin_m, edge_u_m=edge_u_m, edge_v_m=edge_v_m)

# SPDX-License-Identifier: MIT
"""Finds faults of a furnished room, measured on the shapes that will be rendered.

Furniture must rest on a support and not intersect, doors must open, windows stay free, and a person must be
able to walk from every door to the front of every cupboard. Lengths are in metres. Items are tested by the
bounding boxes of their shapes, such as a leg or a board.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.parametric.items import Placed, hull_of
from datagen.parametric.shapes import Floats
from datagen.parametric.shell import Shell, swing

CELL_M = 0.05
BODY_M = 0.24  # radius of the disc that a walking person occupies
CONTACT_M = 0.004  # maximum distance of an item from the support on which it rests
OVERLAP_M = 0.0015  # boxes that overlap by less are in contact, not in collision
MIN_WALKABLE_M2 = 1.1
_THRESHOLD_M = 0.5  # distance from a door at which a person must be able to stand
_LOW_M, _HIGH_M = 0.05, 1.85  # height range of obstacles for a walking person


@dataclass(frozen=True)
class Fault:
    """A fault of kind ``what`` of the item named ``item``; ``why`` is a predicate ("cannot be reached")."""

    what: str  # floats, intersects, outside, door, window or walk
    item: str
    why: str

    def __str__(self) -> str:
        return f"{self.item} {self.why}"


@dataclass(frozen=True)
class Furnished:
    """A room to check; ``built`` are the parts of the shell as items, ``items`` the furniture."""

    shell: Shell
    built: tuple[Placed, ...]
    items: tuple[Placed, ...]


def faults_of(room: Furnished) -> list[Fault]:
    """Return all faults of a room; walking is checked only if there are no others."""
    boxes = [item.boxes() for item in room.items]
    bounds = [hull_of(b) for b in boxes]
    found = _outside(room, bounds)
    found += _floating(room, bounds)
    found += _intersecting(room, boxes, bounds)
    found += _openings(room, boxes)
    if not found:
        found += _walking(room, boxes)
    return found


def _outside(room: Furnished, bounds: list[Floats]) -> list[Fault]:
    shell = room.shell
    limit = np.array([shell.width / 2, shell.depth / 2, shell.height])
    low, high = np.array([-limit[0], -limit[1], 0.0]) - OVERLAP_M, limit + OVERLAP_M
    found = []
    for item, b in zip(room.items, bounds, strict=True):
        if (b[0] < low).any() or (b[1] > high).any():
            depth = max(float((low - b[0]).max()), float((b[1] - high).max()))
            why = f"extends {1000 * depth:.0f} mm into a wall, floor or ceiling"
            found.append(Fault("outside", item.name, why))
    return found


def _floating(room: Furnished, bounds: list[Floats]) -> list[Fault]:
    shell = room.shell
    by_name = {item.name: (item, b) for item, b in zip(room.items, bounds, strict=True)}
    found = []
    for item, b in zip(room.items, bounds, strict=True):
        gap, on = _gap(shell, item, b, by_name)
        if gap > CONTACT_M:
            found.append(Fault("floats", item.name, f"is {1000 * gap:.0f} mm off {on}"))
    return found


def _gap(
    shell: Shell, item: Placed, b: Floats, by_name: dict[str, tuple[Placed, Floats]]
) -> tuple[float, str]:
    """Return the distance [m] of an item from its support, inf if not above it, and the support's name."""
    if item.item.hold == "ceiling":
        return abs(shell.height - float(b[1, 2])), "the ceiling"
    if item.item.hold == "wall":
        near = [  # distances of the item from each wall
            shell.width / 2 + b[0, 0],
            shell.width / 2 - b[1, 0],
            shell.depth / 2 + b[0, 1],
            shell.depth / 2 - b[1, 1],
        ]
        return abs(min(map(float, near))), "the wall"
    if item.stands_on:
        if item.stands_on not in by_name:
            return math.inf, f"{item.stands_on}, which does not exist"
        host, of_host = by_name[item.stands_on]
        foot = b[:, :2] if host.item.name == "rug" else b[:, :2].mean(axis=0, keepdims=True)
        inside = (foot >= of_host[0, :2]).all() and (foot <= of_host[1, :2]).all()
        levels = [host.at[2] + s.z for s in host.item.supports] or [float(of_host[1, 2])]
        gap = min(abs(float(b[0, 2]) - level) for level in levels)
        return (gap if inside else math.inf), item.stands_on
    return abs(float(b[0, 2])), "the floor"


def _intersecting(room: Furnished, boxes: list[Floats], bounds: list[Floats]) -> list[Fault]:
    fixed = [p for p in room.built if p.item.name in ("trim", "window", "door", "beams")]
    names = [p.name for p in (*room.items, *fixed)]
    all_boxes = [*boxes, *(p.boxes() for p in fixed)]
    all_bounds = [*bounds, *(hull_of(b) for b in all_boxes[len(boxes) :])]
    found = []
    for i in range(len(boxes)):
        for j in range(i + 1, len(all_boxes)):
            if not meets(all_bounds[i], all_bounds[j]):
                continue
            deep = overlap(all_boxes[i], all_boxes[j])
            if deep > OVERLAP_M:
                found.append(Fault("intersects", names[i], f"cuts {1000 * deep:.0f} mm into {names[j]}"))
    return found


def meets(one: Floats, other: Floats, margin: float = 0.0) -> bool:
    """Return whether the gap between two boxes (2, 3) is below ``margin`` along every axis."""
    return bool((one[0] < other[1] + margin).all() and (other[0] < one[1] + margin).all())


def overlap(one: Floats, other: Floats) -> float:
    """Return the penetration depth [m] of two items, given as boxes (k, 2, 3); negative if disjoint."""
    low = np.maximum(one[:, None, 0], other[None, :, 0])
    high = np.minimum(one[:, None, 1], other[None, :, 1])
    return float((high - low).min(axis=2).max())


def _openings(room: Furnished, boxes: list[Floats]) -> list[Fault]:
    shell = room.shell
    found = []
    for k, door in enumerate(shell.doors):
        sector = swing(shell, door)
        for item, b in zip(room.items, boxes, strict=True):
            rows = (b[:, 0, 2] < door.height) & (b[:, 1, 2] > 0.004)
            if any(_in_sector(box, sector, door.width) for box in b[rows]):
                found.append(Fault("door", item.name, f"is in the swing of door {k}"))
    for k, window in enumerate(shell.windows):
        zone = _window_zone(shell, k)
        for item, b in zip(room.items, boxes, strict=True):
            is_hung = item.item.name in ("curtains", "blind", "radiator") or item.item.hold == "ceiling"
            rows = (b[:, :, 2][:, 1] > window.sill + 0.3) & (b[:, 0, 2] < window.sill + window.height)
            if is_hung or not rows.any():
                continue
            bound = hull_of(b[rows])
            wide = np.minimum(bound[1, :2], zone[1]) - np.maximum(bound[0, :2], zone[0])
            if (wide > 0).all() and float(wide.max()) > 0.45 * window.width:
                found.append(Fault("window", item.name, f"is in front of window {k}"))
    return found


def _window_zone(shell: Shell, k: int) -> Floats:
    window = shell.windows[k]
    corners = [
        shell.point(window.wall, window.s + side * window.width / 2, gap)
        for side in (-1, 1)
        for gap in (0.0, 0.4)
    ]
    return np.stack([np.min(corners, axis=0), np.max(corners, axis=0)])


def _in_sector(box: Floats, sector: Floats, radius: float) -> bool:
    """Return whether a box (2, 3) overlaps the quarter disc with outline ``sector`` (k, 2), centre first."""
    hinge, rest = sector[0], sector[1:]
    low, high = rest.min(axis=0), rest.max(axis=0)
    low, high = np.minimum(low, hinge) + 1e-3, np.maximum(high, hinge) - 1e-3
    if (box[0, :2] >= high).any() or (box[1, :2] <= low).any():
        return False
    nearest = np.clip(hinge, np.maximum(box[0, :2], low), np.minimum(box[1, :2], high))
    return float(np.linalg.norm(nearest - hinge)) < radius


def free_cells(shell: Shell, boxes: Floats) -> NDArray[np.bool_]:
    """Return the mask (rows along y, columns along x) of the 5 cm floor cells where a person can stand.

    ``boxes`` (k, 2, 3) are the bounding boxes of obstacles.
    """
    from scipy.ndimage import distance_transform_edt

    columns, rows = int(shell.width / CELL_M), int(shell.depth / CELL_M)
    free = np.ones((rows + 2, columns + 2), dtype=bool)
    free[[0, -1], :] = False
    free[:, [0, -1]] = False
    if len(boxes):
        hit = (boxes[:, 0, 2] < _HIGH_M) & (boxes[:, 1, 2] > _LOW_M)
        origin = np.array([-shell.width / 2, -shell.depth / 2])
        first = np.floor((boxes[hit, 0, :2] - origin) / CELL_M).astype(int) + 1
        last = np.ceil((boxes[hit, 1, :2] - origin) / CELL_M).astype(int) + 1
        spans = np.maximum(np.concatenate([first, last], axis=1), 0)
        for x0, y0, x1, y1 in np.unique(spans, axis=0).tolist():  # unique, since books in a row share cells
            free[y0:y1, x0:x1] = False
    distance = distance_transform_edt(free) * CELL_M
    return np.asarray(distance[1:-1, 1:-1] > BODY_M)


def walkable(shell: Shell, boxes: Floats) -> tuple[NDArray[np.bool_], str]:
    """Return the mask of the :func:`free_cells` reachable from all doors, and a fault or ''."""
    from scipy.ndimage import label

    free = free_cells(shell, boxes)
    labels, _ = label(free)
    component = 0
    for k, door in enumerate(shell.doors):
        spot = shell.point(door.wall, door.s, _THRESHOLD_M)
        row, column = cell_of(shell, spot)
        around = labels[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4]
        near = around[around > 0]
        if not len(near):
            return free & False, f"door {k} is blocked"
        if component and component not in near:
            return free & False, f"there is no path from door 0 to door {k}"
        component = component or int(np.bincount(near).argmax())
    reached = labels == component if component else free
    area = float(reached.sum()) * CELL_M**2
    if area < MIN_WALKABLE_M2:
        return reached, f"only {area:.1f} m2 of the floor are walkable"
    return reached, ""


def cell_of(shell: Shell, place: tuple[float, float]) -> tuple[int, int]:
    """Return the row and column of the floor cell at a position (x, y)."""
    return int((place[1] + shell.depth / 2) / CELL_M), int((place[0] + shell.width / 2) / CELL_M)


def front_zone(item: Placed, depth: float) -> Floats:
    """Return the bounds (2, 2) in x and y of the floor area up to ``depth`` metres in front of an item."""
    b = item.item.bounds
    corners = np.array([[x, y, 0.0] for x in b[:, 0] for y in (b[0, 1], b[0, 1] - depth)])
    matrix = item.room_from_item
    places = (corners @ matrix[:3, :3].T + matrix[:3, 3])[:, :2]
    return np.stack([places.min(axis=0), places.max(axis=0)])


def reaches(shell: Shell, reached: NDArray[np.bool_], item: Placed) -> bool:
    """Return whether the mask of reachable cells (rows, columns) has a cell in front of an item."""
    zone = front_zone(item, item.item.front_m + 0.35)
    (r0, c0), (r1, c1) = (cell_of(shell, (float(x), float(y))) for x, y in zone)
    return bool(reached[max(r0, 0) : r1 + 1, max(c0, 0) : c1 + 1].any())


def _walking(room: Furnished, boxes: list[Floats]) -> list[Fault]:
    reached, why = walkable(room.shell, np.concatenate(boxes) if boxes else np.zeros((0, 2, 3)))
    if why:
        return [Fault("walk", "room", why)]
    return [
        Fault("walk", item.name, "cannot be reached")
        for item in room.items
        if item.item.front_m > 0 and item.item.hold == "floor" and not reaches(room.shell, reached, item)
    ]

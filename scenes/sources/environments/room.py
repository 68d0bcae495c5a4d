# SPDX-License-Identifier: GPL-3.0-or-later
"""The shell of a room: thick walls with openings, floor, ceiling, skirting, windows, doors.

The interior is x in [-width/2, width/2], y in [-depth/2, depth/2], z in [0, height] [m]. In the *frame of a
wall*, s = x points from the wall's centre to the right, seen from inside; the wall's face is at y = 0 and the
room at y < 0. Furniture is modelled in this frame, with its back at y = 0 and its front towards -y.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import bpy
import numpy as np
from numpy.typing import ArrayLike

from datagen.foundation.axes import affine
from scenes.sources.materials.catalogue import table
from scenes.sources.modelling import PartBuilder, tag
from scenes.sources.parts import add_parts
from scenes.sources.shapes import Face, Point, Shape, box, box_uvs, cylinder, frame, join, sheet, tube

THICKNESS = 0.28
_PARTS = table("environments/parts.yaml")
_WALLS = {"north": 0.0, "west": 90.0, "south": 180.0, "east": -90.0}


@dataclass(frozen=True)
class Window:
    """A window centred at ``s`` along a wall, from z = ``sill`` upwards; ``panes``: columns and rows."""

    wall: str
    s: float
    width: float = 1.4
    sill: float = 0.85
    height: float = 1.35
    panes: tuple[int, int] = (2, 1)


@dataclass(frozen=True)
class Door:
    """A closed door, centred at ``s`` along a wall, with a leaf of ``width`` x ``height``."""

    wall: str
    s: float
    width: float = 0.86
    height: float = 2.03


@dataclass
class Room:
    """Builds a room's shell with a part builder, and markers (supports, openings ...) in a collection."""

    builder: PartBuilder
    collection: bpy.types.Collection
    width: float
    depth: float
    height: float
    windows: Sequence[Window] = ()
    doors: Sequence[Door] = ()
    skirting: float = 0.09

    def frame(self, wall: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the origin (3,) of a wall's frame and its unit vectors to the right and out of the room."""
        x = {"east": self.width / 2, "west": -self.width / 2}.get(wall, 0.0)
        y = {"north": self.depth / 2, "south": -self.depth / 2}.get(wall, 0.0)
        c, s = np.cos(np.radians(_WALLS[wall])), np.sin(np.radians(_WALLS[wall]))
        return np.array([x, y, 0.0]), np.array([c, s, 0.0]), np.array([-s, c, 0.0])

    def length(self, wall: str) -> float:
        return self.width if wall in ("north", "south") else self.depth

    def on_wall(self, wall: str, shape: Shape, s: float = 0.0, gap: float = 0.0, z: float = 0.0) -> Shape:
        """Move a shape ``s`` to the right, ``gap`` off the wall, ``z`` up; return it in the room's frame."""
        return shape.moved(s, -gap, z).turned("z", _WALLS[wall], self.frame(wall)[0])

    def add(
        self, name: str, wall: str = "", s: float = 0.0, gap: float = 0.0, z: float = 0.0, *, part: str = ""
    ) -> None:
        """Add the part ``name`` of parts.yaml, renamed ``part`` if given; place it at ``wall`` if given."""
        add_parts(self.builder, {part or name: _PARTS[name]})
        if wall:
            self.place(wall, part or name, s, gap, z)

    def place(self, wall: str, part: str, s: float, gap: float = 0.0, z: float = 0.0) -> None:
        """Place a part at a wall, with the arguments of :meth:`on_wall`."""
        origin, right, out = self.frame(wall)
        x, y, _ = origin + right * s - out * gap
        self.builder.place(part, x, y, z, _WALLS[wall])

    def holes(self, wall: str) -> list[tuple[float, float, float, float]]:
        """Bounds (s0, s1, z0, z1) of the windows of a wall."""
        own = [w for w in self.windows if w.wall == wall]
        return [(w.s - w.width / 2, w.s + w.width / 2, w.sill, w.sill + w.height) for w in own]

    def clear_runs(
        self, wall: str, door_gap: float, window_gap: float | None = None, least: float = 0.03
    ) -> Iterator[tuple[float, float]]:
        """Yield the bounds (s0, s1) of the stretches of a wall between openings, if longer than ``least``.

        Stretches end ``door_gap`` before doors and ``window_gap`` before windows; None ignores windows.
        """
        gaps = [
            (d.s - d.width / 2 - door_gap, d.s + d.width / 2 + door_gap) for d in self.doors if d.wall == wall
        ]
        if window_gap is not None:
            gaps += [(low - window_gap, high + window_gap) for low, high, _, _ in self.holes(wall)]
        half = self.length(wall) / 2
        start = -half
        for low, high in [*sorted(gaps), (half, half)]:
            if low - start > least:
                yield start, low
            start = high

    # the shell -------------------------------------------------------------------------------------------
    def build_shell(self) -> None:
        """Build floor, ceiling, walls with their openings, skirting, windows and doors."""
        w, d, h, t = self.width, self.depth, self.height, THICKNESS
        self.builder["floor", "floor"] += box((w + 2 * t, d + 2 * t, 0.2), (0, 0, -0.2), bevel=0, grain=0)
        self.builder["ceiling", "ceiling"] += box((w + 2 * t, d + 2 * t, 0.2), (0, 0, h), bevel=0)
        for wall in _WALLS:
            self.builder["walls", "walls"] += self._wall(wall)
            if self.skirting:
                self._skirting(wall, self.skirting)
        for number, window in enumerate(self.windows):
            self._window(window, number)
        for door in self.doors:
            self._door(door)
        self._outside()

    def _outside(self) -> None:
        """Add a lawn and a hedge around the room, since the sky is black below the horizon."""
        reach, level = 20.0, -0.35
        self.builder["outside", "lawn"] += box(
            (2 * reach, 2 * reach, 0.1), (0, 0, level - 0.1), bevel=0, grain=0
        )
        rng = np.random.default_rng(12)
        s = np.linspace(-reach, reach, 61)
        for degrees in (0.0, 90.0, 180.0, 270.0):
            top = 2.1 + 0.25 * np.sin(1.7 * s + degrees) + rng.uniform(-0.12, 0.12, len(s))
            belly = -reach + rng.uniform(-0.2, 0.2, (5, len(s)))
            heights = level + np.linspace(-0.05, 1, 5)[:, None] * (top - level)
            points = np.stack([np.broadcast_to(s, belly.shape), belly, heights], axis=-1)
            # reversed, since s decreases to the right when seen from the room
            self.builder["outside", "hedge"] += sheet(points[:, ::-1], 0.6).turned("z", degrees)

    def _wall(self, wall: str) -> Shape:
        holes = self.holes(wall)
        # north and south walls include the corners; walls extend into floor and ceiling against light leaks
        half = self.length(wall) / 2 + (THICKNESS if wall in ("north", "south") else 0.0)
        xs = sorted({-half, half, *(v for hole in holes for v in hole[:2])})
        zs = sorted({-0.05, self.height + 0.05, *(v for hole in holes for v in hole[2:])})
        inner = {(i, j): k for k, (i, j) in enumerate((i, j) for j in range(len(zs)) for i in range(len(xs)))}
        count = len(inner)
        points = [(x, 0.0, z) for z in zs for x in xs] + [(x, THICKNESS, z) for z in zs for x in xs]

        def is_solid(i: int, j: int) -> bool:
            if not (0 <= i < len(xs) - 1 and 0 <= j < len(zs) - 1):
                return False
            x, z = (xs[i] + xs[i + 1]) / 2, (zs[j] + zs[j + 1]) / 2
            return not any(a < x < b and c < z < e for a, b, c, e in holes)

        faces: list[tuple[int, ...]] = []
        for i in range(len(xs) - 1):
            for j in range(len(zs) - 1):
                if not is_solid(i, j):
                    continue
                a, b, c, e = inner[i, j], inner[i + 1, j], inner[i + 1, j + 1], inner[i, j + 1]
                faces += [(a, b, c, e), (b + count, a + count, e + count, c + count)]
                for p, q, di, dj in ((a, b, 0, -1), (b, c, 1, 0), (c, e, 0, 1), (e, a, -1, 0)):
                    if not is_solid(i + di, j + dj):
                        faces.append((q, p, p + count, q + count))
        array = np.array(points)
        return self.on_wall(wall, Shape(array, faces, box_uvs(array, faces, grain=0)))

    def _skirting(self, wall: str, height: float) -> None:
        for low, high in self.clear_runs(wall, 0.08, least=0.02):
            length, middle = high - low, (high + low) / 2
            board = box((length, 0.014, height), (middle, -0.007, 0), 0.004, grain=0)
            lip = box((length, 0.008, 0.012), (middle, -0.004, height - 0.002), 0.003, grain=0)
            self.builder["skirting", "trim"] += self.on_wall(wall, board + lip)

    def _window(self, window: Window, number: int) -> None:
        w, h, z = window.width, window.height, window.sill
        depth = THICKNESS * 0.55
        rim = 0.055
        bars = frame(w, h, rim, 0.06, (0, depth, z))
        columns, rows = window.panes
        inner_w, inner_h = w - 2 * rim, h - 2 * rim
        for k in range(columns):
            # a frame for each casement
            left = -inner_w / 2 + k * inner_w / columns
            cw = inner_w / columns
            x = left + cw / 2
            bars += frame(cw - 0.004, inner_h - 0.004, 0.05, 0.045, (x, depth - 0.012, z + rim + 0.002))
            for r in range(1, rows):
                at = (x, depth - 0.012, z + rim + r * inner_h / rows - 0.011)
                bars.append(box((cw - 0.104, 0.03, 0.022), at, 0.003, grain=0))
        self.builder["windows", "trim"] += self.on_wall(window.wall, join(bars), window.s)
        handle = cylinder(0.011, 0.02).turned("x", 90, (0, depth - 0.034, z + 0.45 * h))
        drops = ((0.05, 0.0), (0.055, 0.05), (0.05, 0.11))
        lever = tube([(0, depth - y, z + 0.45 * h - drop) for y, drop in drops], 0.008, 8, smooth=3)
        offset = inner_w / columns / 2 if columns == 1 else 0.0
        self.builder["window_handles", "hardware"] += self.on_wall(
            window.wall, (handle + lever).moved(x=-offset + (0.025 if columns > 1 else 0.027)), window.s
        )
        if z > 0.3:
            board = box((w + 0.12, 0.10, 0.03), (0, -0.022, z - 0.029), 0.008, 2, grain=0) + box(
                (w - 0.002, depth - 0.03, 0.0305), (0, (depth - 0.03) / 2 - 0.001, z - 0.029), 0.001, grain=0
            )
            self.builder["sills", "sill"] += self.on_wall(window.wall, board, window.s)
            name, far = f"sill {number}", -depth + 0.075
            self.surface(name, "sill", window.wall, window.s, w - 0.12, 0.022, far, z + 0.0015, 0.45)
        # architrave around the opening
        foot = z + (0.001 if z > 0.3 else 0.0)
        casing = [
            box((0.07, 0.018, h + 0.07), (side * (w / 2 + 0.03), -0.009, foot), 0.005, grain=2)
            for side in (-1, 1)
        ]
        casing.append(box((w + 0.20, 0.022, 0.08), (0, -0.011, z + h + 0.012), 0.006, grain=0))
        self.builder["windows", "trim"] += self.on_wall(window.wall, join(casing), window.s)
        origin, right, out = self.frame(window.wall)
        origin = origin + right * (window.s - w / 2) + out * (THICKNESS + 0.005) + [0, 0, z]
        # right x up is the direction into the room
        self._rectangle("opening", f"window {number}", origin, right * w, (0, 0, h))

    def _door(self, door: Door) -> None:
        w, h = door.width, door.height
        leaf = [box((w, 0.03, h), (0, 0.012 - 0.015, 0.006), 0.003, grain=2)]
        for low, high in ((0.12, 0.78), (0.92, h - 0.14)):
            for side in (-1, 1):
                pw = (w - 0.36) / 2
                x = side * (pw / 2 + 0.06)
                leaf.append(box((pw, 0.012, high - low), (x, -0.019, low), 0.011, grain=2))
        self.builder["doors", "door"] += self.on_wall(door.wall, join(leaf), door.s)
        casing = [
            box((0.085, 0.03, h + 0.01), (side * (w / 2 + 0.044), -0.015, 0), 0.006, 2, grain=2)
            for side in (-1, 1)
        ]
        casing.append(box((w + 0.19, 0.034, 0.085), (0, -0.017, h + 0.01), 0.006, 2, grain=0))
        self.builder["doors", "trim"] += self.on_wall(door.wall, join(casing), door.s)
        x = w / 2 - 0.07
        plate = box((0.042, 0.006, 0.2), (x, -0.021, 0.94), 0.003, 2)
        path = [(x, -0.02, 1.06), (x, -0.062, 1.06), (x - 0.02, -0.068, 1.06), (x - 0.12, -0.066, 1.058)]
        lever = tube(path, 0.009, 10, smooth=4)
        self.builder["door_handles", "hardware"] += self.on_wall(door.wall, plate + lever, door.s)

    # markers ---------------------------------------------------------------------------------------------
    def surface(
        self, name: str, kind: str, wall: str, s: float, width: float, near: float, far: float, z: float, clearance: float
    ) -> None:  # fmt: skip
        """Add a support surface at height ``z``, centred at ``s``, ``near`` to ``far`` metres off a wall."""
        origin, right, out = self.frame(wall)
        low, high = min(near, far), max(near, far)
        origin = origin + [0, 0, z] + right * (s - width / 2) - out * high
        self._support(name, kind, origin, right * width, out * (high - low), clearance)

    def surface_at(
        self, name: str, kind: str, centre: tuple[float, float], size: tuple[float, float], z: float, clearance: float
    ) -> None:  # fmt: skip
        """Add a rectangular support surface centred at ``centre``."""
        (x, y), (width, depth) = centre, size
        origin = (x - width / 2, y - depth / 2, z)
        self._support(name, kind, origin, (width, 0, 0), (0, depth, 0), clearance)

    def _support(
        self, name: str, kind: str, origin: ArrayLike, u: ArrayLike, v: ArrayLike, clearance: float
    ) -> None:
        self._rectangle("support_surface", name, origin, u, v, sm_kind=kind, sm_clearance_m=clearance)

    def area_slot(self, name: str, centre: Point, size: tuple[float, float]) -> None:
        """Add a rectangular light slot centred at ``centre``, for an area light that emits downwards."""
        (x, y, z), (width, depth) = centre, size
        # u = +x, v = -y: their cross product points down
        origin = (x - width / 2, y + depth / 2, z)
        self._rectangle("light_slot", name, origin, (width, 0, 0), (0, -depth, 0), sm_kind="area")

    def point_slot(self, name: str, at: Point) -> None:
        """Add a light slot for a point light."""
        x, y, z = at
        origin = (x - 0.01, y - 0.01, z)
        self._rectangle("light_slot", name, origin, (0.02, 0, 0), (0, 0.02, 0), sm_kind="point")

    def camera_region(self, name: str, low: Point, high: Point) -> None:
        """Add a camera region: the box from ``low`` to ``high`` [m]."""
        corners = list(product(*zip(low, high, strict=True)))
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        self._marker(name, corners, faces, sm_role="camera_region")

    def _rectangle(
        self, role: str, name: str, origin: ArrayLike, edge_u: ArrayLike, edge_v: ArrayLike, **tags: object
    ) -> None:
        """Add a rectangle whose local +Z is edge_u x edge_v; the edges [m] must be perpendicular."""
        u, v = np.array(edge_u, dtype=float), np.array(edge_v, dtype=float)
        lu, lv = np.linalg.norm(u), np.linalg.norm(v)
        corners = [(0, 0, 0), (lu, 0, 0), (lu, lv, 0), (0, lv, 0)]
        thing = self._marker(name, corners, [(0, 1, 2, 3)], sm_role=role, **tags)
        u, v = u / lu, v / lv
        thing.matrix_world = affine(np.column_stack([u, v, np.cross(u, v)]), origin).T.tolist()

    def _marker(
        self, name: str, points: Sequence[Point], faces: Sequence[Face], **tags: object
    ) -> bpy.types.Object:
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata(points, [], faces)
        thing = bpy.data.objects.new(name, mesh)
        tag(thing, **tags)
        thing.hide_render = False
        self.collection.objects.link(thing)
        return thing

    # soft furnishings ------------------------------------------------------------------------------------
    def curtains(self, window: Window, slot: str, *, open_share: float = 0.62, seed: int = 0) -> None:
        """Add a pair of curtains on a rail above a window; ``open_share``: uncovered share of the rail."""
        rng = np.random.default_rng(seed)
        top = window.sill + window.height + 0.16
        bottom = 0.02
        full = window.width + 0.5
        cloth_width = full * (1 - open_share) / 2
        rail = tube([(-full / 2 - 0.08, -0.1, top), (full / 2 + 0.08, -0.1, top)], 0.012, 12)
        ends = [
            cylinder(0.02, 0.05, (0, 0, -0.025), 0.008).turned("y", 90, (side * (full / 2 + 0.1), -0.1, top))
            for side in (-1, 1)
        ]
        brackets = [box((0.02, 0.1, 0.02), (side * full / 2, -0.05, top - 0.03), 0.003) for side in (-1, 1)]
        self.builder["curtain_rails", "hardware"] += self.on_wall(
            window.wall, join([rail, *ends, *brackets]), window.s
        )
        for side in (-1, 1):
            columns, rows = 61, 7
            u, v = np.linspace(0, 1, columns), np.linspace(0, 1, rows)[:, None]
            folds = 4 + rng.integers(0, 2)
            phase = rng.uniform(0, 6.28)
            wobble = 0.25 * np.sin(2 * np.pi * (u * 2.3 + 0.4 * v) + phase)
            amplitude = (0.026 + 0.016 * (1 - v)) * (1 + 0.3 * np.sin(5 * u + phase))
            y = -0.1 + amplitude * np.sin(2 * np.pi * folds * u + wobble * (1 - v) * 2)
            spread = 1.0 + 0.10 * (1 - v)
            x = (
                side * (full / 2 - cloth_width * (1 - u) * spread)
                if side > 0
                else side * full / 2 + cloth_width * u * spread
            )
            z = bottom + (top - 0.02 - bottom) * v + 0 * u
            points = np.stack([np.broadcast_to(x, z.shape), y, z], axis=-1)
            self.builder["curtains", slot] += self.on_wall(window.wall, sheet(points, 0.0016), window.s)

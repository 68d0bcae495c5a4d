# SPDX-License-Identifier: GPL-3.0-or-later
"""The shell of a room: thick walls with openings, floor, ceiling, skirting, windows, doors.

The interior is x in [-width/2, width/2], y in [-depth/2, depth/2], z in [0, height] [m]. In the *frame of a
wall*, s = x points from the wall's centre to the right, seen from inside; the wall's face is at y = 0 and the room
at y < 0. Furniture is modelled in such a frame, with its back at y = 0 and its front towards -y.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import bpy
import numpy as np

from scenes.sources import modelling
from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import Point, Shape, box, box_uvs, cylinder, join, sheet, tube

THICKNESS = 0.28
_WALLS = {"north": 0.0, "west": 90.0, "south": 180.0, "east": -90.0}


@dataclass(frozen=True)
class Window:
    """A window centred at ``s`` along a wall, from z = ``sill`` to ``sill + height``; ``panes``: columns, rows."""

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
    """Builds the shell of a room with a part builder, and adds the environment's markers to a collection."""

    builder: PartBuilder
    collection: bpy.types.Collection
    width: float
    depth: float
    height: float
    windows: tuple[Window, ...] = ()
    doors: tuple[Door, ...] = ()

    def frame(self, wall: str) -> tuple[float, float, float]:
        """Origin (x, y) and rotation [degrees] of a wall's frame in the room."""
        x = {"east": self.width / 2, "west": -self.width / 2}.get(wall, 0.0)
        y = {"north": self.depth / 2, "south": -self.depth / 2}.get(wall, 0.0)
        return x, y, _WALLS[wall]

    def length(self, wall: str) -> float:
        return self.width if wall in ("north", "south") else self.depth

    def on_wall(self, wall: str, shape: Shape, s: float = 0.0, gap: float = 0.0, z: float = 0.0) -> Shape:
        """Move a shape from a wall's frame into the room: ``s`` along the wall, ``gap`` away from it, up by ``z``."""
        x, y, degrees = self.frame(wall)
        return shape.moved(s, -gap, z).turned("z", degrees).moved(x, y)

    def place(
        self, wall: str, part: str, s: float, gap: float = 0.0, z: float = 0.0
    ) -> tuple[float, float, float]:
        """Place a part at a wall as :meth:`on_wall` does; return its x, y [m] and rotation [degrees]."""
        x, y, degrees = self.frame(wall)
        c, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        px, py = x + c * s + sine * gap, y + sine * s - c * gap
        self.builder.place(part, px, py, z, degrees)
        return float(px), float(py), degrees

    def clear_runs(
        self, wall: str, door_gap: float, window_gap: float | None = None, least: float = 0.03
    ) -> Iterator[tuple[float, float]]:
        """Yield the bounds in s of the free stretches of a wall that are longer than ``least``.

        They keep the distance ``door_gap`` from doors and ``window_gap`` from windows (None: windows are ignored).
        """
        gaps = [
            (d.s - d.width / 2 - door_gap, d.s + d.width / 2 + door_gap) for d in self.doors if d.wall == wall
        ]
        if window_gap is not None:
            gaps += [
                (o.s - o.width / 2 - window_gap, o.s + o.width / 2 + window_gap)
                for o in self.windows
                if o.wall == wall
            ]
        half = self.length(wall) / 2
        start = -half
        for low, high in [*sorted(gaps), (half, half)]:
            if low - start > least:
                yield start, low
            start = high

    # the shell -------------------------------------------------------------------------------------------
    def build_shell(self, skirting: float = 0.09) -> None:
        """Build floor, ceiling, walls with their openings, skirting, windows and doors."""
        w, d, h, t = self.width, self.depth, self.height, THICKNESS
        self.builder["floor", "floor"] += box((w + 2 * t, d + 2 * t, 0.2), (0, 0, -0.2), bevel=0, grain=0)
        self.builder["ceiling", "ceiling"] += box((w + 2 * t, d + 2 * t, 0.2), (0, 0, h), bevel=0)
        for wall in _WALLS:
            holes = [
                (o.s - o.width / 2, o.s + o.width / 2, o.sill, o.sill + o.height)
                for o in self.windows
                if o.wall == wall
            ]
            self.builder["walls", "walls"] += self._wall(wall, holes)
            if skirting:
                self._skirting(wall, skirting)
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
            # reversed: seen from inside, s decreases to the right
            self.builder["outside", "hedge"] += sheet(points[:, ::-1], 0.6).turned("z", degrees)

    def _wall(self, wall: str, holes: list[tuple[float, float, float, float]]) -> Shape:
        # north and south walls also fill the corners; all walls extend into floor and ceiling against light leaks
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
        frame = 0.055
        bars = [
            box((w, 0.06, frame), (0, depth, z), 0.004, grain=0),
            box((w, 0.06, frame), (0, depth, z + h - frame), 0.004, grain=0),
        ]
        bars += [
            box((frame, 0.06, h - 2 * frame), (side * (w - frame) / 2, depth, z + frame), 0.004, grain=2)
            for side in (-1, 1)
        ]
        columns, rows = window.panes
        inner_w, inner_h = w - 2 * frame, h - 2 * frame
        for k in range(columns):
            # a frame for each casement
            left = -inner_w / 2 + k * inner_w / columns
            cw = inner_w / columns
            x = left + cw / 2
            bars += [
                box((cw - 0.004, 0.045, 0.05), (x, depth - 0.012, z + frame + dz), 0.004, grain=0)
                for dz in (0.002, inner_h - 0.052)
            ]
            bars += [
                box(
                    (0.05, 0.045, inner_h - 0.104),
                    (x + side * (cw / 2 - 0.027), depth - 0.012, z + frame + 0.052),
                    0.004,
                    grain=2,
                )
                for side in (-1, 1)
            ]
            for r in range(1, rows):
                bars.append(
                    box(
                        (cw - 0.104, 0.03, 0.022),
                        (x, depth - 0.012, z + frame + r * inner_h / rows - 0.011),
                        0.003,
                        grain=0,
                    )
                )
        self.builder["windows", "trim"] += self.on_wall(window.wall, join(bars), window.s)
        handle = cylinder(0.011, 0.02).turned("x", 90).moved(0, depth - 0.034, z + 0.45 * h)
        lever = tube(
            [
                (0, depth - 0.05, z + 0.45 * h),
                (0, depth - 0.055, z + 0.45 * h - 0.05),
                (0, depth - 0.05, z + 0.45 * h - 0.11),
            ],
            0.008,
            8,
            smooth=3,
        )
        offset = inner_w / columns / 2 if columns == 1 else 0.0
        self.builder["window_handles", "hardware"] += self.on_wall(
            window.wall, (handle + lever).moved(x=-offset + (0.025 if columns > 1 else 0.027)), window.s
        )
        if z > 0.3:
            board = box((w + 0.12, 0.10, 0.03), (0, -0.022, z - 0.029), 0.008, 2, grain=0) + box(
                (w - 0.002, depth - 0.03, 0.0305), (0, (depth - 0.03) / 2 - 0.001, z - 0.029), 0.001, grain=0
            )
            self.builder["sills", "sill"] += self.on_wall(window.wall, board, window.s)
            self.surface(
                f"sill {number}",
                "sill",
                window.wall,
                window.s,
                w - 0.12,
                0.022,
                -depth + 0.075,
                z + 0.0015,
                0.45,
            )
        # architrave around the opening
        casing = [
            box(
                (0.07, 0.018, h + 0.07),
                (side * (w / 2 + 0.03), -0.009, z + (0.001 if z > 0.3 else 0.0)),
                0.005,
                grain=2,
            )
            for side in (-1, 1)
        ]
        casing.append(box((w + 0.20, 0.022, 0.08), (0, -0.011, z + h + 0.012), 0.006, grain=0))
        self.builder["windows", "trim"] += self.on_wall(window.wall, join(casing), window.s)
        x, y, degrees = self.frame(window.wall)
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        right, out = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
        origin = np.array([x, y, 0]) + right * (window.s - w / 2) + out * (THICKNESS + 0.005) + [0, 0, z]
        # right x up is the direction into the room
        modelling.rectangle_marker(
            self.collection, "opening", f"window {number}", tuple(origin), tuple(right * w), (0, 0, h)
        )

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
        lever = tube(
            [(x, -0.02, 1.06), (x, -0.062, 1.06), (x - 0.02, -0.068, 1.06), (x - 0.12, -0.066, 1.058)],
            0.009,
            10,
            smooth=4,
        )
        self.builder["door_handles", "hardware"] += self.on_wall(door.wall, plate + lever, door.s)

    # markers ---------------------------------------------------------------------------------------------
    def surface(
        self, name: str, kind: str, wall: str, s: float, width: float, near: float, far: float, z: float, clearance: float
    ) -> None:  # fmt: skip
        """Add a support surface centred at ``s`` along a wall, between the distances ``near`` and ``far`` from it."""
        x, y, degrees = self.frame(wall)
        c, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        low, high = min(near, far), max(near, far)
        right, back = np.array([c, sine, 0]), np.array([-sine, c, 0])
        origin = np.array([x, y, z]) + right * (s - width / 2) - back * high
        self._support(name, kind, origin, right * width, back * (high - low), clearance)

    def surface_at(
        self, name: str, kind: str, centre: tuple[float, float], size: tuple[float, float], z: float, clearance: float, degrees: float = 0.0
    ) -> None:  # fmt: skip
        """Add a support surface: a rectangle about ``centre``, rotated about z by ``degrees``."""
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        right, back = np.array([c, s, 0]), np.array([-s, c, 0])
        origin = np.array([*centre, z]) - right * size[0] / 2 - back * size[1] / 2
        self._support(name, kind, origin, right * size[0], back * size[1], clearance)

    def _support(
        self, name: str, kind: str, origin: np.ndarray, u: np.ndarray, v: np.ndarray, clearance: float
    ) -> None:
        modelling.rectangle_marker(
            self.collection,
            "support_surface",
            name,
            tuple(origin),
            tuple(u),
            tuple(v),
            sm_kind=kind,
            sm_clearance_m=clearance,
        )

    def area_slot(self, name: str, centre: Point, size: tuple[float, float]) -> None:
        """Add a light slot: a rectangle about ``centre`` for a lamp that emits downwards."""
        x, y, z = centre
        # u = +x, v = -y: their cross product points down
        modelling.rectangle_marker(
            self.collection,
            "light_slot",
            name,
            (x - size[0] / 2, y + size[1] / 2, z),
            (size[0], 0, 0),
            (0, -size[1], 0),
            sm_kind="area",
        )

    def point_slot(self, name: str, at: Point) -> None:
        modelling.point_marker(self.collection, name, at)

    def camera_region(self, name: str, low: Point, high: Point) -> None:
        modelling.box_marker(self.collection, name, low, high)

    # soft furnishings ------------------------------------------------------------------------------------
    def curtains(self, window: Window, slot: str, *, open_share: float = 0.62, seed: int = 0) -> None:
        """Add a pair of curtains on a rail above a window; ``open_share`` is the uncovered share of the rail."""
        rng = np.random.default_rng(seed)
        top = window.sill + window.height + 0.16
        bottom = 0.02
        full = window.width + 0.5
        cloth_width = full * (1 - open_share) / 2
        rail = tube([(-full / 2 - 0.08, -0.1, top), (full / 2 + 0.08, -0.1, top)], 0.012, 12)
        ends = [
            cylinder(0.02, 0.05, (0, 0, -0.025), 0.008)
            .turned("y", 90)
            .moved(side * (full / 2 + 0.1), -0.1, top)
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

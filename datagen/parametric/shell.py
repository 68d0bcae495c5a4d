# SPDX-License-Identifier: MIT
"""Makes the shell of a room: walls with openings, floor, ceiling, trim, windows, doors, and outside scenery.

Lengths are in metres. The interior is x in [-width/2, width/2], y in [-depth/2, depth/2], z in [0, height].
In a wall's frame, s runs right as seen from inside, the wall's face is y = 0, and the room is at y < 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np

from datagen.foundation.axes import rotation
from datagen.foundation.random import Draws
from datagen.parametric.items import Item, Placed
from datagen.parametric.shapes import (
    Floats,
    Point,
    Shape,
    box,
    cylinder,
    flat,
    frame,
    grid,
    lathe,
    middles,
    tube,
)

Wall = Literal["north", "west", "south", "east"]
WALLS: tuple[Wall, ...] = ("north", "west", "south", "east")
THICKNESS = 0.28
_RECESS = 0.55 * THICKNESS  # distance of the window frames behind the wall's inner face
_YAW: dict[Wall, float] = {"north": 0.0, "west": 0.5 * math.pi, "south": math.pi, "east": -0.5 * math.pi}
CASING_M = 0.09  # width of the casing around doors and windows
DOOR_HEIGHT = 2.03


@dataclass(frozen=True)
class Window:
    """A window centred at ``s`` metres along the wall; ``panes``: numbers of columns and rows."""

    wall: Wall
    s: float
    width: float
    sill: float
    height: float
    panes: tuple[int, int] = (2, 1)


@dataclass(frozen=True)
class Door:
    """A closed door that opens inwards, centred at ``s`` along the wall; ``hinge``: -1 left, 1 right."""

    wall: Wall
    s: float
    width: float
    hinge: Literal[-1, 1]
    height: float = DOOR_HEIGHT


@dataclass(frozen=True)
class Shell:
    """Size and openings of a room; the wall ``accent`` has another material, the walls ``tiled`` have tiles.

    ``storey_m`` is the height of the floor above the ground outside.
    """

    width: float
    depth: float
    height: float
    windows: tuple[Window, ...]
    doors: tuple[Door, ...]
    accent: Wall | None = None
    tiled: tuple[Wall, ...] = ()
    storey_m: float = 0.35
    has_beams: bool = False

    def length(self, wall: Wall) -> float:
        return self.width if wall in ("north", "south") else self.depth

    def yaw(self, wall: Wall) -> float:
        """Return the rotation about z, in radians, from the wall's frame to the room's."""
        return _YAW[wall]

    def point(self, wall: Wall, s: float, gap: float = 0.0) -> tuple[float, float]:
        """Return the position (x, y) at ``s`` along a wall and ``gap`` metres in front of it."""
        half = 0.5 * (self.depth if wall in ("north", "south") else self.width)
        x, y, _ = rotation("z", _YAW[wall]) @ np.array([s, half - gap, 0.0])
        return round(float(x), 9), round(float(y), 9)

    def on_wall(self, item: Item, name: str, wall: Wall, s: float, z: float, gap: float = 0.0) -> Placed:
        """Return an item placed with its back ``gap`` metres in front of a wall, at ``s``, height ``z``."""
        return Placed(item, name, (*self.point(wall, s, gap), z), _YAW[wall])

    def holes(self, wall: Wall) -> list[tuple[float, float, float, float]]:
        """Return the windows of a wall as (s0, s1, z0, z1)."""
        own = [w for w in self.windows if w.wall == wall]
        return [(w.s - w.width / 2, w.s + w.width / 2, w.sill, w.sill + w.height) for w in own]

    def spans(self, wall: Wall) -> list[tuple[float, float, float, float]]:
        """Return the openings of a wall, including their casings, as (s0, s1, z0, z1)."""
        found = self.holes(wall)
        for d in self.doors:
            if d.wall == wall:
                found.append((d.s - d.width / 2, d.s + d.width / 2, 0.0, d.height))
        return [(a - CASING_M, b + CASING_M, max(0.0, c - CASING_M), e + CASING_M) for a, b, c, e in found]


def swing(shell: Shell, door: Door) -> Floats:
    """Return the outline (k, 2) of the sector that a door sweeps, hinge first, in the room's frame."""
    hinge = door.s + door.hinge * door.width / 2
    angles = np.linspace(0, 0.5 * math.pi, 10)
    arc = [(hinge - door.hinge * door.width * math.cos(a), -door.width * math.sin(a)) for a in angles]
    yaw = rotation("z", _YAW[door.wall])[:2, :2]
    foot = np.array(shell.point(door.wall, 0.0))
    return np.array([(hinge, 0.0), *arc]) @ yaw.T + foot


def shell_items(shell: Shell, draws: Draws) -> list[Placed]:
    """Return all built-in parts as placed items: walls, floor, ceiling, trim, windows, doors, beams."""
    w, d, h, t = shell.width, shell.depth, shell.height, THICKNESS
    body = Item("shell")
    body.shapes.append(("floor", box((w + 2 * t, d + 2 * t, 0.2), (0, 0, -0.2), 0.0, grain=0)))
    body.shapes.append(("ceiling", box((w + 2 * t, d + 2 * t, 0.2), (0, 0, h), 0.0)))
    found = [Placed(body, "shell", (0.0, 0.0, 0.0), 0.0)]
    for wall in WALLS:
        found.append(shell.on_wall(_wall(shell, wall), f"wall_{wall}", wall, 0.0, 0.0))
    skirting = draws.uniform(0.06, 0.14)
    cornice = draws.chance(0.25)
    for wall in WALLS:
        trim = Item("trim", hold="wall")
        if wall not in shell.tiled:
            _skirting(trim, shell, wall, skirting)
        if cornice and not shell.tiled:
            _cornice(trim, shell, wall)
        if trim.shapes:
            found.append(shell.on_wall(trim, f"trim_{wall}", wall, 0.0, 0.0))
    for k, window in enumerate(shell.windows):
        found.append(shell.on_wall(_window(window), f"window_{k}", window.wall, window.s, window.sill))
    panels = draws.choice(("framed", "flat", "glazed"))
    for k, door in enumerate(shell.doors):
        found.append(shell.on_wall(_door(door, panels), f"door_{k}", door.wall, door.s, 0.0))
    if shell.has_beams:
        found.append(_beams(shell))
    return found


def _wall(shell: Shell, wall: Wall) -> Item:
    """Make a wall of full thickness with window holes; north and south walls include the corners."""
    reach = THICKNESS if wall in ("north", "south") else 0.0
    half = shell.length(wall) / 2 + reach
    holes = shell.holes(wall)
    xs = sorted({-half, half, *(v for hole in holes for v in hole[:2])})
    zs = sorted({-0.05, shell.height + 0.05, *(v for hole in holes for v in hole[2:])})

    def is_solid(i: int, j: int) -> bool:
        if not (0 <= i < len(xs) - 1 and 0 <= j < len(zs) - 1):
            return False
        x, z = (xs[i] + xs[i + 1]) / 2, (zs[j] + zs[j + 1]) / 2
        return not any(a < x < b and c < z < e for a, b, c, e in holes)

    quads = []
    for i in range(len(xs) - 1):
        for j in range(len(zs) - 1):
            if not is_solid(i, j):
                continue
            x0, x1, z0, z1 = xs[i], xs[i + 1], zs[j], zs[j + 1]
            near = [(x0, 0.0, z0), (x1, 0.0, z0), (x1, 0.0, z1), (x0, 0.0, z1)]
            far = [(x, THICKNESS, z) for x, _, z in near]
            quads.append(near)
            quads.append([far[1], far[0], far[3], far[2]])
            for a, b, di, dj in ((0, 1, 0, -1), (1, 2, 1, 0), (2, 3, 0, 1), (3, 0, -1, 0)):
                if not is_solid(i + di, j + dj):
                    quads.append([near[b], near[a], far[a], far[b]])
    slot = "wall_tiles" if wall in shell.tiled else "wall_accent" if wall == shell.accent else "walls"
    item = Item("wall", hold="wall")
    item.shapes.append((slot, flat(np.array(quads))))
    return item


def _skirting(item: Item, shell: Shell, wall: Wall, height: float) -> None:
    half = shell.length(wall) / 2
    gaps = sorted((a, b) for a, b, low, _ in shell.spans(wall) if low < height + 0.02)
    start = -half
    for a, b in [*gaps, (half, half)]:
        if a - start > 0.02:
            middle = (a + start) / 2
            item.add("trim", box((a - start, 0.014, height), (middle, -0.007, 0), 0.003, grain=0))
            at = (middle, -0.0045, height - 0.002)
            item.add("trim", box((a - start, 0.009, 0.014), at, 0.003, grain=0))
        start = b


def _cornice(item: Item, shell: Shell, wall: Wall) -> None:
    length, h = shell.length(wall), shell.height
    for depth, low, high in ((0.05, 0.022, 0.0), (0.032, 0.045, 0.021), (0.016, 0.08, 0.044)):
        item.add("trim", box((length, depth, low - high), (0, -depth / 2, h - low), 0.003, grain=0))


def _beams(shell: Shell) -> Placed:
    item = Item("beams", hold="ceiling")
    for x in middles(shell.width, max(2, round(shell.width / 1.1))):
        item.add("second", box((0.12, shell.depth, 0.14), (x, 0, -0.14), 0.008, grain=1))
    return Placed(item, "beams", (0.0, 0.0, shell.height), 0.0)


def _window(window: Window) -> Item:
    """Make a window with handles, sill board and casing; z = 0 is the lower edge of the opening."""
    item = Item("window", hold="wall")
    w, h, y = window.width, window.height, _RECESS
    rim = 0.055
    item.add("trim", *frame(w, h, rim, 0.06, (0, y, 0.0)))
    columns, rows = window.panes
    inner_w, inner_h = w - 2 * rim, h - 2 * rim
    for k in range(columns):
        cw = inner_w / columns
        x = -inner_w / 2 + (k + 0.5) * cw
        item.add("trim", *frame(cw - 0.004, inner_h - 0.004, 0.05, 0.045, (x, y - 0.012, rim + 0.002)))
        for r in range(1, rows):
            at = (x, y - 0.012, rim + r * inner_h / rows - 0.011)
            item.add("trim", box((cw - 0.104, 0.03, 0.022), at, 0.003, grain=0))
        hx = x + (cw / 2 - 0.027) * (1 if k % 2 == 0 else -1)
        level = min(0.45 * h, 1.05)
        item.add("metal", box((0.026, 0.01, 0.07), (hx, y - 0.038, level), 0.003))
        lever = ((0.04, 0.035), (0.065, 0.033), (0.068, -0.08))
        item.add("metal", tube([(hx, y - dy, level + dz) for dy, dz in lever], 0.0075, 8))
    if window.sill > 0.3:
        item.add("sill", box((w + 0.12, 0.07, 0.03), (0, -0.0345, -0.029), 0.006, grain=0))
        at = (0, (y - 0.03) / 2 + 0.0001, -0.029)
        item.add("sill", box((w - 0.002, y - 0.03, 0.0305), at, 0.0005, grain=0))
        item.support("sill", (0, y / 2 - 0.05), (w - 0.12, y - 0.02), 0.0015, 0.45)
    foot = 0.001 if window.sill > 0.3 else 0.0
    upright = box((0.07, 0.018, h + 0.012 - foot), (0, -0.009, foot), 0.004, grain=2)
    item.pair("trim", w / 2 + 0.03, upright)
    item.add("trim", box((w + 0.16, 0.022, 0.075), (0, -0.011, h + 0.012), 0.005, grain=0))
    return item


def _door(door: Door, panels: str) -> Item:
    """Make a door with ``panels`` (``framed``, ``flat``, ``glazed``), handle, casing and hinges."""
    item = Item("door", hold="wall")
    w, h = door.width, door.height
    item.add("door", box((w, 0.03, h), (0, -0.003, 0.006), 0.003, grain=2))
    if panels == "framed":
        for (low, high), side in product(((0.14, 0.8), (0.94, h - 0.14)), (-1, 1)):
            pw = (w - 0.36) / 2
            x = side * (pw / 2 + 0.06)
            item.add("door", box((pw, 0.012, high - low), (x, -0.0195, low), 0.009, grain=2))
    elif panels == "glazed":
        for r in range(3):
            z = 0.75 + r * (h - 0.95) / 3
            item.add("opal", box((w - 0.3, 0.004, (h - 0.95) / 3 - 0.05), (0, -0.0195, z), 0.001))
    item.pair("trim", w / 2 + 0.0415, box((0.08, 0.03, h + 0.01), (0, -0.015, 0), 0.005, grain=2))
    item.add("trim", box((w + 0.18, 0.034, 0.08), (0, -0.017, h + 0.01), 0.005, grain=0))
    x = -door.hinge * (w / 2 - 0.07)
    item.add("metal", box((0.042, 0.006, 0.2), (x, -0.0205, 0.94), 0.002))
    reach = door.hinge * 0.12
    lever = [(x, -0.02, 1.06), (x, -0.062, 1.06), (x + reach * 0.2, -0.068, 1.06), (x + reach, -0.066, 1.058)]
    item.add("metal", tube(lever, 0.009, 10))
    for z in (0.25, h - 0.3):
        item.add("metal", cylinder(0.008, 0.1, (door.hinge * (w / 2 + 0.001), -0.032, z), 10))
    return item


def openings(shell: Shell) -> list[tuple[str, Floats, Floats, Floats]]:
    """Return the name, corner (3,) and edges u, v (3,) of each window's outer face; u x v points inwards."""
    found = []
    for k, window in enumerate(shell.windows):
        yaw = rotation("z", _YAW[window.wall])
        corner = np.array([*shell.point(window.wall, window.s, -(THICKNESS + 0.005)), window.sill])
        right = yaw @ np.array([1.0, 0.0, 0.0])
        up = np.array([0.0, 0.0, window.height])
        found.append((f"window {k}", corner - 0.5 * window.width * right, window.width * right, up))
    return found


def outside(shell: Shell, draws: Draws) -> list[Placed]:
    """Make random scenery outside the windows: the ground, and hedges, trees or houses."""
    item = Item("outside")
    level = -shell.storey_m
    scene = draws.choice(("garden", "street", "trees"))
    reach = 400.0  # hides all but 1 degree of Mitsuba's sky below the horizon, which is black
    ground = "asphalt" if scene == "street" else "lawn"
    item.add(ground, box((2 * reach, 2 * reach, 0.1), (0, 0, level - 0.1), 0.0, grain=0))
    for wall in sorted({w.wall for w in shell.windows}):
        turn = math.degrees(_YAW[wall])
        start = 0.5 * (shell.depth if wall in ("north", "south") else shell.width) + THICKNESS
        if scene == "street":
            for shape, slot in _houses(draws, start + draws.uniform(9, 14), level):
                item.add(slot, shape.turned("z", turn))
        else:
            far = start + draws.uniform(5, 10)
            if scene == "garden":
                item.add("hedge", _hedge(draws, far, level).turned("z", turn))
            for _ in range(draws.integer(4, 8) if scene == "trees" else draws.integer(1, 3)):
                x, y = draws.uniform(-9, 9), far + draws.uniform(1.0, 8.0)
                for shape, slot in _tree(draws, level):
                    item.add(slot, shape.moved(x, y).turned("z", turn))
            for shape, slot in _houses(draws, far + 11, level):
                item.add(slot, shape.turned("z", turn))
    return [Placed(item, "outside", (0.0, 0.0, 0.0), 0.0)]


def _hedge(draws: Draws, y: float, level: float) -> Shape:
    s = np.linspace(-14, 14, 57)
    height = draws.uniform(1.2, 2.2)
    rows = np.array([0.0, 0.4, 0.8, 1.0, 1.0])
    depth = np.array([0.0, -0.06, 0.0, 0.12, 0.8])
    noise = draws.units(5, 57) - 0.5
    points = np.empty((5, 57, 3))
    points[..., 0] = s[None] + 0.15 * noise
    points[..., 1] = y + depth[:, None] + 0.18 * noise
    points[..., 2] = level + rows[:, None] * height + 0.12 * noise
    return grid(points)


def _tree(draws: Draws, level: float) -> list[tuple[Shape, str]]:
    tall = draws.uniform(3.5, 8.0)
    trunk: list[Point] = [(0, 0, level), (0.1, 0, level + 0.3 * tall), (0.0, 0.05, level + 0.75 * tall)]
    found = [(tube(trunk, 0.06 + 0.012 * tall, 8), "bark")]
    for _ in range(9):
        radius = draws.uniform(0.12, 0.22) * tall
        angle = np.linspace(-math.pi / 2, math.pi / 2, 7)
        crown = lathe([(radius * math.cos(a), radius * math.sin(a)) for a in angle], segments=11)
        bumps = 1 + 0.22 * np.sin(7 * crown.points @ draws.sphere(1)[0] / radius + draws.uniform(0, 6))
        place = draws.sphere(1)[0] * tall * np.array([0.2, 0.2, 0.16])
        shape = replace(crown, points=crown.points * bumps[:, None])
        found.append((shape.moved(place[0], place[1], level + 0.72 * tall + place[2]), "foliage"))
    return found


def _houses(draws: Draws, y: float, level: float) -> list[tuple[Shape, str]]:
    """Return the shapes and slots of a row of houses whose fronts are at ``y`` and face -y."""
    found: list[tuple[Shape, str]] = []
    x = -24.0
    while x < 24.0:
        w, h = draws.uniform(6, 11), draws.uniform(5.5, 13.0)
        slot = draws.choice(("facade", "facade_b", "facade"))
        back = draws.uniform(0.0, 1.2)
        found.append((box((w, 6.0, h), (x + w / 2, y + 3 + back, level), 0.0), slot))
        found.append((box((w + 0.4, 6.6, 0.35), (x + w / 2, y + 3 + back, level + h - 0.01), 0.02), "roof"))
        columns, rows = max(2, round(w / 2.4)), max(1, int(h / 2.9))
        for c, r in product(range(columns), range(rows)):
            at = (x + (c + 0.5) * w / columns, y + back, level + 0.9 + r * 2.9)
            found.append((box((1.25, 0.08, 1.65), (at[0], at[1] - 0.01, at[2] - 0.05), 0.01), "mount"))
            found.append((box((1.1, 0.06, 1.5), (at[0], at[1] - 0.04, at[2]), 0.01), "pane"))
        x += w + draws.choice((0.02, 0.02, 2.5))
    return found

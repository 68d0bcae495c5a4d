# SPDX-License-Identifier: MIT
"""Adds parts of furniture to an item, in the item's frame: fronts with handles, legs, rows of books."""

from __future__ import annotations

import math
from itertools import product

from datagen.foundation.random import Draws
from datagen.parametric.items import Item, Style
from datagen.parametric.shapes import Point, box, cylinder, lathe, tube
from datagen.parametric.slots import BOOKS

GAP = 0.0035  # gap between neighbouring fronts
_FRONT = 0.019


def front(
    item: Item,
    style: Style,
    size: tuple[float, float],
    at: Point,
    *,
    slot: str = "front",
    handle: str = "middle",
    is_drawer: bool = False,
) -> None:
    """Add a door or drawer front of ``size`` (width, height).

    ``at`` is the midpoint of its lower rear edge; ``handle`` is ``left``, ``right`` or ``middle``.
    """
    w, h = size[0] - GAP, size[1] - GAP
    x, y, z = at[0], at[1] - _FRONT / 2, at[2] + GAP / 2
    if style.front == "framed" and min(w, h) > 0.16:
        rail = min(0.065, 0.22 * min(w, h))
        item.add(slot, box((w - rail, 0.011, h - rail), (x, y + 0.004, z + rail / 2), 0.001))
        for side in (-1, 1):
            item.add(slot, box((rail, _FRONT, h), (x + side * (w - rail) / 2, y, z), 0.002, grain=2))
        for dz in (0.0, h - rail):
            item.add(slot, box((w - 2 * rail + 0.0004, _FRONT, rail), (x, y, z + dz), 0.002, grain=0))
    else:
        item.add(slot, box((w, _FRONT, h), (x, y, z), 0.002, grain=0 if is_drawer else 2))
    _handle(item, style, (w, h), (x, at[1] - _FRONT, z), handle, is_drawer)


def _handle(
    item: Item, style: Style, size: tuple[float, float], at: Point, where: str, is_drawer: bool
) -> None:
    w, h = size
    x, y, z = at
    dx = {"left": -1, "right": 1}.get(where, 0) * (w / 2 - 0.035)
    level = z + h / 2
    if h > 1.5:
        level = min(max(1.05 - z * 0.3, z + 0.3), z + h - 0.1)
    if style.handle == "knob":
        knob = lathe(
            [(0, 0), (0.006, 0.0), (0.006, 0.012), (0.014, 0.018), (0.015, 0.024), (0.011, 0.029), (0, 0.03)],
            segments=14,
        )
        item.add("metal", knob.turned("x", 90).moved(x + dx, y, level))
    elif style.handle == "bar":
        is_level = is_drawer or where == "middle"
        length = min(0.16 if is_level else 0.18, 0.55 * w if is_drawer else 0.5 * h)
        ends = (-length / 2, length / 2)

        def place(along: float, dy: float) -> Point:
            return (x + dx + along, y + dy, level) if is_level else (x + dx, y + dy, level + along)

        bar = [place(along, -0.028) for along in (ends[0] - 0.012, 0.0, ends[1] + 0.012)]
        item.add("metal", tube(bar, 0.0055))
        for end in ends:
            item.add("metal", tube([place(end, 0.001), place(end, -0.026)], 0.0042, 6))
    else:
        if is_drawer or h < 1.2:
            size_of_grip = (min(0.5 * w, 0.14), 0.022, 0.003)
            item.add("metal", box(size_of_grip, (x, y - 0.006, z + h + 0.0002), 0.001))
        else:
            item.add("metal", box((0.012, 0.022, 0.16), (x + (dx or 0.3 * w), y - 0.01, level), 0.002))


def fronts(
    item: Item,
    style: Style,
    width: float,
    at: Point,
    rows: list[tuple[str, float]],
    columns: int = 1,
    slot: str = "front",
) -> None:
    """Add ``columns`` fronts per row; ``rows``, lowest first, are ("drawer" or "door", height in metres).

    ``at`` is the midpoint of the lower rear edge of the lowest row.
    """
    z = at[2]
    each = width / columns
    for kind, height in rows:
        for k in range(columns):
            x = at[0] - width / 2 + (k + 0.5) * each
            is_drawer = kind == "drawer"
            where = "middle" if is_drawer else ("right" if k % 2 == 0 and columns > 1 else "left")
            front(item, style, (each, height), (x, at[1], z), slot=slot, handle=where, is_drawer=is_drawer)
        z += height


def legs(
    item: Item,
    style: Style,
    corners: tuple[float, float, float, float],
    height: float,
    thickness: float = 0.045,
    slot: str | None = None,
) -> None:
    """Add four legs ``height`` metres high, inside the corners of the rectangle (x0, x1, y0, y1)."""
    x0, x1, y0, y1 = corners
    t = thickness
    for x, y in product((x0 + t / 2, x1 - t / 2), (y0 + t / 2, y1 - t / 2)):
        if style.legs == "square":
            leg = box((t, t, height), (x, y, 0), 0.004, grain=2)
        elif style.legs == "metal":
            leg = box((0.7 * t, 0.7 * t, height), (x, y, 0), 0.003, grain=2)
        else:
            low = 0.3 * t if style.legs == "tapered" else 0.42 * t
            profile = [(0, 0), (low, 0), (low + 0.001, 0.004), (0.5 * t, height), (0, height)]
            leg = lathe(profile, (x, y, 0), 12)
        item.add(slot or style.leg_slot, leg)


def books(item: Item, draws: Draws, x0: float, x1: float, y: float, z: float, height: float) -> float:
    """Add upright books from x0 to at most x1, rear faces at ``y``; return the x at which the row ends."""
    x = x0
    slots = draws.shuffled(BOOKS)[: draws.integer(3, 6)]
    while True:
        w, h = draws.uniform(0.016, 0.046), draws.uniform(0.62, 0.93) * min(height, 0.33)
        d = draws.uniform(0.13, 0.19)
        if x + w > x1:
            return x
        middle = x + w / 2
        item.add(draws.choice(slots), box((w - 0.001, d, h), (middle, y - d / 2, z), 0.0015, grain=2))
        if w > 0.02:
            item.add("pages", box((w - 0.005, d - 0.006, 0.002), (middle, y - d / 2 + 0.004, z + h), 0.0))
        x += w


def castor(item: Item, x: float, y: float) -> None:
    wheel = cylinder(0.026, 0.02, bevel=0.004, segments=14).turned("x", 90)
    item.add("dark", wheel.moved(x, y + 0.01, 0.026))


def ring_of(count: int, radius: float, start: float = 0.0) -> list[tuple[float, float]]:
    """Return ``count`` points (x, y) at equal angles on a circle, the first at ``start`` radians."""
    angles = [start + 2 * math.pi * k / count for k in range(count)]
    return [(radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]

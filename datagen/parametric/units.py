# SPDX-License-Identifier: MIT
"""Makes kitchen units, appliances and a café counter; lengths in metres."""

from __future__ import annotations

from itertools import product

import numpy as np

from datagen.foundation.random import Draws
from datagen.parametric.items import Item, Style
from datagen.parametric.joinery import front, fronts
from datagen.parametric.shapes import (
    Point,
    Shape,
    box,
    cylinder,
    lathe,
    loft,
    middles,
    rounded_box,
    rounded_ring,
    tube,
)

COUNTER_M = 0.91


def tap(item: Item, x: float, y: float, z: float, reach: float, height: float) -> None:
    """Add a tap ``height`` metres high on (x, y, z), whose spout ends ``reach`` metres towards -y."""
    item.add("metal", cylinder(0.026, 0.045, (x, y, z - 0.001), 16, 0.004))
    arc = [
        (x, y - reach / 2 * (1 - np.cos(a)), z + height - 0.07 + 0.07 * np.sin(a))
        for a in np.linspace(0, np.pi, 9)
    ]
    neck = [(x, y, z + 0.03), (x, y, z + height - 0.1), *arc, (x, y - reach, z + height - 0.1)]
    item.add("metal", tube(neck, 0.0115, 10))
    item.add("metal", tube([(x + 0.02, y, z + 0.028), (x + 0.075, y - 0.005, z + 0.05)], 0.006, 8))


def sink_bowl(width: float, length: float, depth: float, at: Point) -> Shape:
    """Make a sink bowl of ``width`` (x), ``length`` (y) and ``depth``; ``at`` is the centre of its rim."""
    (x, y, z), radius = at, 0.05
    rings = []
    for w, d, h, r in (
        (width + 0.03, length + 0.03, 0.0005, radius + 0.015),
        (width + 0.03, length + 0.03, 0.003, radius + 0.015),
        (width + 0.004, length + 0.004, 0.004, radius),
        (width - 0.004, length - 0.004, -0.004, radius),
        (width - 0.02, length - 0.02, -depth + 0.03, radius),
        (width - 0.06, length - 0.06, -depth + 0.004, radius),
        (0.05, 0.05, -depth, 0.024),
    ):
        rings.append(rounded_ring(w, d, r, z + h, (x, y)))
    return loft(np.array(rings), (False, True))


def _worktop(item: Item, x0: float, x1: float, hole: tuple[float, float, float, float] | None) -> None:
    """Add a worktop from x0 to x1 with an optional rectangular ``hole`` (x0, x1, y0, y1)."""
    d, z, t = 0.62, COUNTER_M - 0.038, 0.038
    pieces = [(x0, x1, -d, 0.0)]
    if hole is not None:
        a, b, c, e = hole
        pieces = [(x0, a, -d, 0.0), (b, x1, -d, 0.0), (a, b, -d, c), (a, b, e, 0.0)]
    for a, b, c, e in pieces:
        bevel = 0.003 if hole is None else 0.0006
        item.add("worktop", box((b - a, e - c, t), ((a + b) / 2, (c + e) / 2, z), bevel, grain=0))


def kitchen_run(style: Style, draws: Draws, modules: list[str], has_wall_units: bool) -> Item:
    """Make a row of kitchen ``modules``, each 0.6 m wide, under a worktop 0.62 m deep.

    A module is ``sink``, ``hob``, ``drawers``, ``doors``, ``washer`` or, at an end, ``tall`` or ``fridge``.
    """
    item = Item("kitchen_run", front_m=0.8)
    width = 0.6 * len(modules)
    low: list[float] = []
    places = [(-width / 2 + 0.6 * (k + 0.5), kind) for k, kind in enumerate(modules)]
    for x, kind in places:
        if kind in ("tall", "fridge"):
            _tall_unit(item, style, x, kind)
            continue
        low.append(x)
        item.add("wood", box((0.6, 0.5, 0.1005), (x, -0.27, 0), 0.001))
        item.add("wood", box((0.598, 0.56, 0.772), (x, -0.285, 0.1), 0.001))
        y, z = -0.5655, 0.1
        if kind == "drawers":
            fronts(item, style, 0.6, (x, y, z), [("drawer", 0.3), ("drawer", 0.3), ("drawer", 0.17)])
        elif kind == "hob":
            _oven(item, x, y)
        elif kind == "washer":
            _washer_front(item, x, y - 0.019, 0.12, 0.72)
            item.add("appliance", box((0.59, 0.02, 0.74), (x, y - 0.009, 0.11), 0.006))
        else:
            fronts(item, style, 0.6, (x, y, z), [("door", 0.77)], 2)
    x0, x1 = min(low) - 0.3, max(low) + 0.3
    hole = None
    for x, kind in places:
        if kind == "sink":
            hole = (x - 0.24, x + 0.24, -0.5, -0.12)
            item.add("sink", sink_bowl(0.475, 0.375, 0.18, (x, -0.31, COUNTER_M)))
            tap(item, x, -0.075, COUNTER_M, 0.19, 0.3)
        if kind == "hob":
            item.add("black_glass", box((0.56, 0.5, 0.006), (x, -0.31, COUNTER_M), 0.002))
            zones = ((-0.14, -0.12, 0.09), (0.14, -0.12, 0.07), (-0.14, 0.12, 0.07), (0.14, 0.12, 0.09))
            for dx, dy, r in zones:
                ring = [(r, 0), (r, 0.0008), (r - 0.006, 0.0008), (r - 0.006, 0)]
                item.add("metal", lathe(ring, (x + dx, -0.31 + dy, COUNTER_M + 0.0058), 28))
    _worktop(item, x0, x1, hole)
    splashback = (x1 - x0, 0.009, 0.52 if has_wall_units else 0.16)
    item.add("wall_tiles", box(splashback, ((x0 + x1) / 2, -0.0045, COUNTER_M), 0.001))
    if has_wall_units:
        _wall_units(item, style, draws, places)
    clear = 0.48 if has_wall_units else 0.9
    stops = [x0 + 0.03, *([hole[0] - 0.03, hole[1] + 0.03] if hole else []), x1 - 0.03]

    def support(left: float, right: float) -> None:
        if right - left > 0.15:
            item.support("counter", ((left + right) / 2, -0.34), (right - left, 0.46), COUNTER_M, clear)

    for k in range(0, len(stops), 2):
        left, right = stops[k], stops[k + 1]
        for hob in [x for x, kind in places if kind == "hob" and left < x < right]:
            support(left, hob - 0.32)
            left = hob + 0.32
        support(left, right)
    return item


def _tall_unit(item: Item, style: Style, x: float, kind: str) -> None:
    h = 2.12
    if kind == "fridge":
        item.add("appliance", rounded_box((0.59, 0.6, 1.84), 0.012, (x, -0.31, 0.03), 2))
        for z, height in ((0.05, 0.62), (0.68, 1.18)):
            item.add("appliance", rounded_box((0.588, 0.05, height), 0.014, (x, -0.637, z), 2))
            level = z + height - 0.32 if z < 0.3 else z + 0.12
            item.add("metal", tube([(x - 0.25, -0.69, level), (x - 0.25, -0.69, level + 0.24)], 0.008))
            for dz in (0.01, 0.23):
                foot = [(x - 0.25, y, level + dz) for y in (-0.66, -0.688)]
                item.add("metal", tube(foot, 0.006, 6))
        for dx, y in product((-0.24, 0.24), (-0.08, -0.5)):
            item.add("dark", cylinder(0.02, 0.032, (x + dx, y, 0), 10))
        return
    item.add("wood", box((0.6, 0.5, 0.1005), (x, -0.27, 0), 0.001))
    item.add("wood", box((0.598, 0.56, h - 0.1), (x, -0.285, 0.1), 0.001))
    fronts(item, style, 0.6, (x, -0.5655, 0.1), [("door", 1.3), ("door", h - 1.4)])


def _oven(item: Item, x: float, y: float) -> None:
    item.add("appliance", box((0.594, 0.02, 0.766), (x, y - 0.01, 0.103), 0.003))
    item.add("black_glass", box((0.5, 0.006, 0.4), (x, y - 0.022, 0.2), 0.002))
    item.add("metal", tube([(x - 0.22, y - 0.06, 0.65), (x + 0.22, y - 0.06, 0.65)], 0.009, 10))
    for dx in (-0.19, 0.19):
        item.add("metal", tube([(x + dx, y - 0.018, 0.65), (x + dx, y - 0.058, 0.65)], 0.006, 6))
    for k in range(4):
        knob = lathe([(0, 0), (0.022, 0), (0.02, 0.02), (0.016, 0.022), (0, 0.022)], segments=16)
        item.add("machine", knob.turned("x", 90).moved(x - 0.21 + 0.14 * k, y - 0.019, 0.78))


def _wall_units(item: Item, style: Style, draws: Draws, places: list[tuple[float, str]]) -> None:
    z, h = 1.44, 0.7
    for x, kind in places:
        if kind in ("tall", "fridge"):
            continue
        if kind == "hob":
            item.add("sink", box((0.59, 0.48, 0.05), (x, -0.245, z + 0.1), 0.004))
            item.add("sink", box((0.28, 0.26, 0.56), (x, -0.135, z + 0.149), 0.003))
            continue
        item.add("wood", box((0.598, 0.33, h), (x, -0.166, z), 0.001))
        if draws.chance(0.8):
            fronts(item, style, 0.6, (x, -0.3305, z), [("door", h)], 2)
        else:
            front(item, style, (0.6, h), (x, -0.3305, z), handle="left")


def _washer_front(item: Item, x: float, y: float, z: float, height: float) -> None:
    """Add the front of a washing machine at ``y``, from ``z`` to ``height`` metres above it."""
    c = z + 0.42 * height
    rim = [(0.13, 0), (0.172, 0), (0.175, 0.012), (0.16, 0.028), (0.135, 0.03), (0.128, 0.016), (0.13, 0)]
    ring = lathe(rim, segments=32)
    item.add("metal", ring.turned("x", 90).moved(x, y + 0.001, c))
    angle = np.linspace(0, np.pi / 2, 6)
    dome = [(0.134 * np.cos(a), 0.002 + 0.022 * np.sin(a)) for a in angle[:-1]]
    bowl = lathe([(0, 0.001), (0.134, 0.001), *dome, (0, 0.024)], segments=28)
    item.add("black_glass", bowl.turned("x", 90).moved(x, y, c))
    item.add("machine", box((0.54, 0.005, 0.1), (x, y - 0.0025, z + height - 0.12), 0.002))
    knob = lathe([(0, 0), (0.03, 0), (0.028, 0.024), (0.022, 0.027), (0, 0.027)], segments=20)
    item.add("metal", knob.turned("x", 90).moved(x + 0.06, y - 0.004, z + height - 0.07))
    item.add("appliance", box((0.17, 0.004, 0.085), (x - 0.17, y - 0.0065, z + height - 0.1125), 0.002))


def washing_machine(style: Style, draws: Draws, stacked: bool = False) -> Item:
    """Make a washing machine, with a dryer on top if ``stacked``."""
    item = Item("washing_machine", front_m=0.7)
    for k in range(2 if stacked else 1):
        z = 0.86 * k + (0.002 if k else 0.0)
        for dx, y in product((-0.24, 0.24), (-0.07, -0.5)):
            item.add("dark", cylinder(0.02, 0.022, (dx, y, z), 10))
        item.add("appliance", rounded_box((0.6, 0.56, 0.835), 0.012, (0, -0.29, z + 0.02), 2))
        _washer_front(item, 0.0, -0.57, z + 0.02, 0.835)
    if not stacked:
        item.support("counter", (0, -0.29), (0.52, 0.48), 0.855, 0.8)
    return item


def utility_run(style: Style, draws: Draws, count: int) -> Item:
    """Make a row of units with a sink and ``count`` washing machines under a worktop."""
    return kitchen_run(style, draws, ["sink", *["washer"] * count, "doors"], draws.chance(0.6))


def bar_counter(style: Style, draws: Draws, width: float) -> Item:
    """Make a café counter ``width`` metres wide, with panels in front (-y), a coffee machine and cups."""
    item = Item("bar_counter", front_m=0.8)
    d, h = 0.66, 1.08
    item.add("wood", box((width - 0.06, d - 0.1, 0.0905), (0, -d / 2, 0), 0.001))
    item.add("front", box((width, d - 0.06, h - 0.13), (0, -d / 2, 0.09), 0.003, grain=0))
    count = max(3, round(width / 0.35))
    for x in middles(width, count):
        item.add("front", box((width / count - 0.05, 0.02, h - 0.3), (x, -d + 0.022, 0.17), 0.008, grain=2))
    item.add("worktop", box((width + 0.06, d + 0.04, 0.04), (0, -d / 2, h - 0.04), 0.005, grain=0))
    x = -width / 2 + 0.45
    item.add("sink", rounded_box((0.62, 0.42, 0.36), 0.03, (x, -0.28, h + 0.06), 2))
    item.add("machine", box((0.5, 0.3, 0.061), (x, -0.26, h), 0.004))
    item.add("machine", box((0.58, 0.02, 0.1), (x, -0.493, h + 0.3), 0.004))
    for dx in (-0.16, 0.16):
        item.add("metal", cylinder(0.036, 0.06, (x + dx, -0.53, h + 0.2), 16))
        item.add("metal", tube([(x + dx, -0.47, h + 0.24), (x + dx, -0.53, h + 0.24)], 0.02, 8))
        item.add("grip", tube([(x + dx, -0.56, h + 0.215), (x + dx, -0.66, h + 0.205)], 0.013, 8))
    item.add("metal", box((0.5, 0.14, 0.012), (x, -0.54, h), 0.002))
    cup = [(0, 0), (0.024, 0), (0.04, 0.05), (0.038, 0.05), (0.022, 0.004), (0, 0.004)]
    for k in range(6):
        item.add("sanitary", lathe(cup, (x - 0.22 + 0.088 * k, -0.28, h + 0.4205), 16))
    item.support("counter", (0.3, -d / 2), (width - 1.1, d - 0.1), h, 1.0)
    return item

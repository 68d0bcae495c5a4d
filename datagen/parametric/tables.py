# SPDX-License-Identifier: MIT
"""Makes tables, desks and workbenches; lengths in metres."""

from __future__ import annotations

import math
from itertools import product

from datagen.foundation.random import Draws
from datagen.parametric.items import Item, Style
from datagen.parametric.joinery import fronts, legs, ring_of
from datagen.parametric.shapes import box, cylinder, lathe, rounded_box, tube


def table(
    style: Style, draws: Draws, width: float, depth: float, height: float = 0.74, name: str = "table"
) -> Item:
    """Make a rectangular table on four legs with an apron, on two trestles, or on panels."""
    item = Item(name)
    thick = draws.uniform(0.022, 0.04)
    under = height - thick
    item.add("top", box((width, depth, thick), (0, -depth / 2, under), 0.005, grain=0))
    base = draws.weighted(("legs", "trestle", "panel"), (0.62, 0.22, 0.16)) if width > 1.0 else "legs"
    slot, middle = style.leg_slot, -depth / 2
    if base == "legs":
        inset = draws.uniform(0.015, 0.06)
        corners = (-width / 2 + inset, width / 2 - inset, -depth + inset, -inset)
        t = 0.06 if width > 1.2 else 0.042
        legs(item, style, corners, under + 0.0005, t)
        rail = 0.07 if height > 0.6 else 0.04
        z = under - rail + 0.0005
        for y in (-depth + inset + t / 2, -inset - t / 2):
            item.add(slot, box((width - 2 * inset - t, 0.02, rail), (0, y, z), 0.002, grain=0))
        side = box((0.02, depth - 2 * inset - t, rail), (0, middle, z), 0.002, grain=1)
        item.pair(slot, width / 2 - inset - t / 2, side)
    elif base == "trestle":
        for x in (-width / 2 + 0.25, width / 2 - 0.25):
            item.add(slot, box((0.07, depth - 0.1, 0.05), (x, middle, under - 0.05), 0.004, grain=1))
            item.add(slot, box((0.08, depth - 0.06, 0.045), (x, middle, 0), 0.006, grain=1))
            for y in (-depth * 0.3, -depth * 0.7):
                item.add(slot, box((0.06, 0.06, under - 0.09), (x, y, 0.042), 0.004, grain=2))
        item.add(slot, box((width - 0.5, 0.035, 0.08), (0, middle, 0.3), 0.004, grain=0))
    else:
        side = box((0.045, depth - 0.08, under + 0.0005), (0, middle, 0), 0.004, grain=2)
        item.pair(slot, width / 2 - 0.06, side)
        item.add(slot, box((width - 0.16, 0.025, 0.16), (0, middle, under - 0.16), 0.003, grain=0))
    item.support("table", (0, middle), (width - 0.06, depth - 0.06), height)
    return item


def round_table(style: Style, draws: Draws, diameter: float, height: float = 0.74) -> Item:
    """Make a round table on a central foot."""
    item = Item("round_table")
    r, c = diameter / 2, -diameter / 2
    edge = [(0, 0.026), (r - 0.006, 0.026), (r, 0.02), (r, 0.006), (r - 0.006, 0), (0, 0)]
    item.add("top", lathe([(x, height - z) for x, z in edge], (0, c, 0), 40))
    foot = 0.52 * r if height > 0.6 else 0.6 * r
    if draws.chance(0.5):
        base = [(0, 0), (foot, 0), (foot, 0.012), (0.06, 0.03), (0.035, 0.06)]
        head = [(0.035, height - 0.05), (0.12, height - 0.027), (0, height - 0.027)]
        item.add(style.leg_slot, lathe([*base, *head], (0, c, 0), 28))
    else:
        item.add(style.leg_slot, cylinder(0.032, height - 0.085, (0, c, 0.06), 18))
        item.add(style.leg_slot, cylinder(0.13, 0.012, (0, c, height - 0.038), 20))
        for x, y in ring_of(4, foot, math.pi / 4):
            path = [(0, c, 0.075), (0.5 * x, c + 0.5 * y, 0.045), (x, c + y, 0.018)]
            item.add(style.leg_slot, tube(path, 0.017, 8))
    side = 1.3 * r
    item.support("table", (0, c), (side, side), height)
    return item


def desk(style: Style, draws: Draws, width: float) -> Item:
    """Make a desk, with a pedestal of drawers on one side if it is wider than 1.15 m."""
    item = Item("desk", front_m=0.8)
    h, depth, thick = 0.74, 0.7, 0.028
    item.add("top", box((width, depth, thick), (0, -depth / 2, h - thick), 0.004, grain=0))
    side = draws.choice((-1, 1))
    w = 0.4
    if width > 1.15:
        x = side * (width / 2 - w / 2 - 0.03)
        item.add("wood", box((w, depth - 0.08, h - thick - 0.06), (x, -depth / 2, 0.0605), 0.002, grain=2))
        for fx, fy in product((x - w / 2 + 0.05, x + w / 2 - 0.05), (-0.1, -depth + 0.1)):
            item.add(style.leg_slot, cylinder(0.016, 0.061, (fx, fy, 0), 10))
        rows = [("drawer", 0.28), ("drawer", 0.18), ("drawer", h - thick - 0.06 - 0.46)]
        fronts(item, style, w, (x, -depth + 0.04, 0.06), rows)
        corners = (
            (-width / 2 + 0.03, -width / 2 + 0.075) if side > 0 else (width / 2 - 0.075, width / 2 - 0.03)
        )
        legs(item, style, (corners[0], corners[1], -depth + 0.04, -0.04), h - thick + 0.0005, 0.045)
        at = (-side * (w / 2 - 0.02), -0.08, h - thick - 0.22)
        item.add("wood", box((width - w - 0.2, 0.018, 0.22), at, 0.002, grain=0))
    else:
        spread = (-width / 2 + 0.02, width / 2 - 0.02, -depth + 0.02, -0.02)
        legs(item, style, spread, h - thick + 0.0005, 0.045)
        item.add("wood", box((width - 0.09, 0.018, 0.16), (0, -0.06, h - thick - 0.16), 0.002, grain=0))
    item.support("table", (0, -depth / 2 - 0.05), (width - 0.1, depth - 0.22), h)
    return item


def monitor(style: Style, draws: Draws) -> Item:
    """Make a screen with a keyboard and a mouse in front of it."""
    item = Item("monitor", hold="surface")
    w = draws.uniform(0.52, 0.68)
    h = w * 0.57
    item.add("machine", rounded_box((w, 0.03, h), 0.01, (0, -0.1, 0.12), 2))
    item.add("screen", box((w - 0.02, 0.003, h - 0.03), (0, -0.1155, 0.138), 0.001))
    item.add("legs", box((0.05, 0.02, 0.25), (0, -0.075, 0.006), 0.004))
    item.add("legs", rounded_box((0.24, 0.17, 0.012), 0.005, (0, -0.1, 0), 2))
    item.add("machine", rounded_box((0.42, 0.13, 0.018), 0.006, (0, -0.36, 0), 2))
    item.add("machine", rounded_box((0.062, 0.105, 0.032), 0.014, (0.29, -0.36, 0), 2))
    return item


def workbench(style: Style, draws: Draws, width: float) -> Item:
    """Make a heavy bench ``width`` metres wide with a shelf below, a vice and drawers."""
    item = Item("workbench", front_m=0.6)
    d, h = draws.uniform(0.65, 0.75), draws.uniform(0.86, 0.92)
    item.add("top", box((width, d, 0.06), (0, -d / 2, h - 0.06), 0.006, grain=0))
    for x in (-width / 2 + 0.08, width / 2 - 0.08):
        for y in (-d + 0.08, -0.08):
            item.add("wood", box((0.09, 0.09, h - 0.0595), (x, y, 0), 0.005, grain=2))
        item.add("wood", box((0.045, d - 0.25, 0.09), (x, -d / 2, 0.14), 0.004, grain=1))
    for y in (-d + 0.08, -0.08):
        item.add("wood", box((width - 0.25, 0.045, 0.09), (0, y, 0.14), 0.004, grain=0))
    for k in range(4):
        at = (0, -0.15 - (k + 0.5) * (d - 0.24) / 4 + 0.03, 0.2305)
        item.add("wood", box((width - 0.26, (d - 0.24) / 4 - 0.006, 0.022), at, 0.003, grain=0))
    w = min(0.5, 0.3 * width)
    x = width / 2 - 0.14 - w / 2
    item.add("steel", box((w, d - 0.2, 0.27), (x, -d / 2, h - 0.335), 0.003))
    fronts(item, style, w, (x, -d + 0.1, h - 0.335), [("drawer", 0.135)] * 2, slot="steel")
    x = -width / 2 + 0.3
    item.add("tool", box((0.16, 0.05, 0.13), (x, -d - 0.03, h - 0.15), 0.008))
    item.add("tool", box((0.16, 0.04, 0.13), (x, -d - 0.09, h - 0.15), 0.008))
    item.add("metal", tube([(x, -d - 0.005, h - 0.1), (x, -d - 0.16, h - 0.1)], 0.012))
    item.add("metal", tube([(x - 0.1, -d - 0.155, h - 0.1), (x + 0.1, -d - 0.155, h - 0.1)], 0.007))
    item.support("table", (0, -d / 2), (width - 0.1, d - 0.1), h)
    item.support("shelf", (-0.1, -d / 2), (width - 0.8, d - 0.34), 0.2525, h - 0.65)
    return item

# SPDX-License-Identifier: MIT
"""Makes storage furniture: wardrobes, chests, bookcases, racks, tool boards, bins, lockers; in metres."""

from __future__ import annotations

from itertools import product

import numpy as np

from datagen.formats.asset import SupportKind
from datagen.foundation.random import Draws
from datagen.parametric.items import Item, Style
from datagen.parametric.joinery import books, castor, fronts, legs
from datagen.parametric.shapes import Shape, box, lathe, loft, middles, rounded_box, tube

_MIRRORED = 0.4  # probability that a wardrobe has mirrors on its doors


def cabinet(
    name: str,
    style: Style,
    size: tuple[float, float, float],
    rows: list[tuple[str, float]],
    columns: int,
    foot: float,
    slots: tuple[str, str] = ("wood", "front"),
) -> Item:
    """Make a closed cabinet of ``size`` (width, depth, height) on a plinth or legs ``foot`` metres high.

    ``rows`` (with relative heights) and ``columns`` are as in :func:`fronts`; ``slots`` are for body, fronts.
    """
    w, d, h = size
    item = Item(name, front_m=0.5)
    body, face = slots
    if foot > 0.09:
        legs(item, style, (-w / 2 + 0.03, w / 2 - 0.03, -d + 0.04, -0.03), foot + 0.0005, 0.04)
    elif foot > 0:
        item.add(body, box((w - 0.03, d - 0.07, foot + 0.0005), (0, -d / 2 + 0.015, 0), 0.002, grain=0))
    grain = 0 if w > h else 2
    item.add(body, box((w, d - 0.02, h - foot - 0.02), (0, -d / 2 + 0.01, foot), 0.002, grain=grain))
    item.add(body, box((w + 0.01, d + 0.004, 0.02), (0, -d / 2, h - 0.02), 0.003, grain=0))
    scale = (h - foot - 0.026) / sum(height for _, height in rows)
    scaled = [(k, height * scale) for k, height in rows]
    fronts(item, style, w - 0.004, (0, -d + 0.02, foot + 0.002), scaled, columns, face)
    return item


def chest(style: Style, draws: Draws, width: float) -> Item:
    """Make a chest of drawers ``width`` metres wide."""
    h = draws.uniform(0.74, 0.95)
    rows = [("drawer", 0.26), ("drawer", 0.22), ("drawer", 0.2)] + ([("drawer", 0.17)] if h > 0.84 else [])
    size, columns = (width, draws.uniform(0.42, 0.48), h), 1 if width < 0.7 else 2
    item = cabinet("chest", style, size, rows, columns, draws.choice((0.05, 0.13)))
    d = -item.bounds[0, 1]
    item.support("table", (0, -d / 2), (width - 0.06, d - 0.1), h)
    return item


def bedside(style: Style, draws: Draws) -> Item:
    """Make a bedside table with two drawers or a door."""
    w, h = draws.uniform(0.38, 0.5), draws.uniform(0.46, 0.58)
    rows = [("drawer", 0.2), ("drawer", 0.16)] if draws.chance(0.6) else [("door", 0.3)]
    item = cabinet("bedside", style, (w, 0.4, h), rows, 1, draws.choice((0.05, 0.15)))
    item.front_m = 0.3
    item.support("table", (0, -0.2), (w - 0.05, 0.34), h, 0.6)
    return item


def sideboard(style: Style, draws: Draws, width: float, height: float = 0.78) -> Item:
    """Make a low cabinet of ``width`` by ``height`` metres with doors, and perhaps drawers above them."""
    count = max(2, round(width / 0.5))
    rows = [("door", 0.46), ("drawer", 0.17)] if height > 0.6 and draws.chance(0.6) else [("door", 0.5)]
    size = (width, draws.uniform(0.4, 0.47), height)
    item = cabinet("sideboard", style, size, rows, count, draws.choice((0.06, 0.14)))
    d = -item.bounds[0, 1]
    item.support("table", (0, -d / 2), (width - 0.06, d - 0.1), height)
    return item


def wardrobe(style: Style, draws: Draws, doors: int) -> Item:
    """Make a wardrobe with ``doors`` doors, perhaps with mirrors on some of them."""
    w, h = doors * draws.uniform(0.45, 0.52), draws.uniform(2.0, 2.25)
    rows = [("drawer", 0.22), ("door", 1.7)] if draws.chance(0.35) else [("door", 1.9)]
    d = draws.uniform(0.56, 0.62)
    item = cabinet("wardrobe", style, (w, d, h), rows, doors, 0.06)
    if draws.chance(_MIRRORED):
        low = h - 1.66
        for k in draws.shuffled(range(doors))[: draws.integer(1, doors)]:
            pane = (w / doors - 0.16, 0.004, h - low - 0.12)
            item.add("mirror", box(pane, ((k + 0.5) * w / doors - w / 2, -d - 0.001, low), 0.0))
    item.front_m = 0.6
    return item


def bookcase(
    style: Style, draws: Draws, width: float, height: float, depth: float = 0.3, fill: float = 0.6
) -> Item:
    """Make open shelves with books in a share ``fill`` of the bays, and support surfaces elsewhere."""
    item = Item("bookcase", front_m=0.45)
    t = 0.024
    item.add("wood", box((width - 2 * t, 0.008, height - 0.06), (0, -0.006, 0.05), 0.0))
    columns = max(1, round(width / 0.8))
    for k in range(columns + 1):
        x = -width / 2 + t / 2 + k * (width - t) / columns
        item.add("wood", box((t, depth, height), (x, -depth / 2, 0), 0.002, grain=2))
    bay = (width - t) / columns - t
    count = max(2, round((height - 0.1) / 0.34))
    pitch = (height - 0.07 - t) / count
    for c in range(columns):
        x = -width / 2 + t + bay / 2 + c * (bay + t)
        item.add("wood", box((bay, 0.02, 0.066), (x, -depth + 0.03, 0), 0.001))
        for k in range(count + 1):
            z = 0.066 + k * pitch
            item.add("wood", box((bay, depth - 0.018, t), (x, -depth / 2 - 0.003, z), 0.001, grain=0))
            if k == count:
                continue
            free = pitch - t
            left, right = x - bay / 2 + 0.005, x + bay / 2 - 0.005
            if draws.chance(fill):
                stop = left + draws.uniform(0.25, 1.0) * (right - left)
                left = books(item, draws, left, stop, -0.02 - draws.uniform(0.0, 0.04), z + t, free) + 0.02
            if right - left > 0.12:
                at = (0.5 * (left + right), -depth / 2 - 0.02)
                item.support("shelf", at, (right - left, depth - 0.06), z + t, free - 0.02)
    if height < 1.5:
        item.support("shelf", (0, -depth / 2), (width - 0.06, depth - 0.06), 0.066 + count * pitch + t, 0.6)
    return item


def cube_shelf(style: Style, draws: Draws, columns: int, rows: int) -> Item:
    """Make a shelf of ``columns`` by ``rows`` square bays, some with baskets, books or toys."""
    item = Item("cube_shelf", front_m=0.45)
    each, d, t = 0.36, 0.38, 0.03
    w, h = columns * each + t, rows * each + t
    for k in range(columns + 1):
        item.add("wood", box((t, d, h), (-w / 2 + t / 2 + k * each, -d / 2, 0), 0.003, grain=2))
    for c in range(columns):
        x = -w / 2 + t / 2 + (c + 0.5) * each
        for r in range(rows + 1):
            item.add("wood", box((each - t, d - 0.004, t), (x, -d / 2, r * each), 0.002, grain=0))
        for r in range(rows):
            z = r * each + t
            pick = draws.unit()
            if pick < 0.35:
                size = (each - t - 0.03, d - 0.05, 0.24)
                item.add("basket", rounded_box(size, 0.02, (x, -d / 2 - 0.005, z), 2))
            elif pick < 0.5:
                books(item, draws, x - 0.15, x + 0.15, -0.05, z, 0.31)
            elif pick < 0.62:
                for j, slot in enumerate(("toy_a", "toy_b", "book_f")):
                    at = (x - 0.09 + 0.09 * j, -d / 2 - 0.06 * (j % 2), z)
                    item.add(slot, box((0.075, 0.075, 0.075), at, 0.006))
            else:
                item.support("shelf", (x, -d / 2), (each - t - 0.02, d - 0.06), z, each - t - 0.02)
    item.support("table" if h < 1.0 else "shelf", (0, -d / 2), (w - 0.04, d - 0.06), h, 0.7)
    return item


def rack(style: Style, draws: Draws, width: float) -> Item:
    """Make a shelf ``width`` metres wide with boxes and cans, for storerooms and workshops."""
    item = Item("rack", front_m=0.5)
    h, d = draws.uniform(1.75, 2.0), draws.uniform(0.38, 0.5)
    boards = "steel" if draws.chance(0.6) else "wood"
    for x, y in product((-width / 2 + 0.02, width / 2 - 0.02), (-0.02, -d + 0.02)):
        item.add("steel", box((0.035, 0.035, h), (x, y, 0), 0.002, grain=2))
    for k in range(4):
        z = 0.12 + k * (h - 0.2) / 3
        for y in (-0.006 - 0.008, -d + 0.006 + 0.008):
            item.add("steel", box((width - 0.075, 0.012, 0.05), (0, y, z - 0.03), 0.001))
        item.add(boards, box((width - 0.076, d - 0.045, 0.018), (0, -d / 2, z), 0.001, grain=0))
        x = -width / 2 + 0.07
        while x < width / 2 - 0.3 and k < 3:
            bw, bh = draws.uniform(0.2, 0.36), draws.uniform(0.14, min(0.32, (h - 0.2) / 3 - 0.1))
            if x + bw > width / 2 - 0.06:
                break
            if draws.chance(0.55):
                item.add("box", box((bw, d - 0.12, bh), (x + bw / 2, -d / 2, z + 0.018), 0.004))
                label = (x + bw / 2, -d + 0.059, z + 0.018 + bh * 0.45)
                item.add("mount", box((0.09, 0.002, 0.05), label, 0.0))
            elif draws.chance(0.4):
                can = [(0, 0), (0.08, 0), (0.082, 0.004), (0.082, 0.16), (0.076, 0.166), (0, 0.166)]
                item.add("tool", lathe(can, (x + 0.1, -d / 2, z + 0.018), 20))
            else:
                item.support("shelf", (x + bw / 2, -d / 2), (bw, d - 0.1), z + 0.018, (h - 0.2) / 3 - 0.08)
            x += bw + 0.03
    item.support("shelf", (0, -d / 2), (width - 0.12, d - 0.1), 0.12 + (h - 0.2) + 0.018, 0.4)
    return item


def wall_shelf(style: Style, draws: Draws, width: float, boards: int = 2) -> Item:
    """Make boards on brackets, ``width`` metres long; z = 0 is the lowest board's underside."""
    item = Item("wall_shelf", hold="wall")
    d = 0.24
    for k in range(boards):
        z = 0.36 * k
        item.add("second", box((width, d, 0.026), (0, -d / 2, z), 0.003, grain=0))
        for x in (-0.38 * width, 0.38 * width):
            item.add("metal", box((0.025, 0.004, 0.12), (x, -0.002, z - 0.121), 0.001))
            item.add("metal", tube([(x, -0.006, z - 0.11), (x, -d * 0.7, z - 0.012)], 0.006, 6))
            item.add("metal", box((0.025, d * 0.75, 0.004), (x, -d * 0.375, z - 0.0045), 0.001))
        left = -width / 2 + 0.03
        if draws.chance(0.5):
            left = books(item, draws, left, left + 0.5 * width, -0.03, z + 0.026, 0.3) + 0.02
        if width / 2 - left > 0.15:
            at = (0.5 * (left + width / 2 - 0.03), -d / 2)
            item.support("shelf", at, (width / 2 - 0.03 - left, d - 0.05), z + 0.026, 0.3)
    return item


def tool_board(style: Style, draws: Draws, width: float) -> Item:
    """Make a wall board ``width`` metres wide, with tools on hooks."""
    item = Item("tool_board", hold="wall")
    h = 0.72
    item.add("second", box((width, 0.018, h), (0, -0.009, 0), 0.002, grain=0))
    x = -width / 2 + 0.12
    while x < width / 2 - 0.1:
        kind = draws.choice(("hammer", "saw", "driver", "square", "tongs"))
        top = h - draws.uniform(0.08, 0.16)
        if kind == "hammer":
            item.add("grip", tube([(x, -0.04, top - 0.3), (x, -0.04, top)], 0.013, 10))
            item.add("tool", box((0.11, 0.026, 0.03), (x, -0.04, top - 0.012), 0.004))
        elif kind == "saw":
            item.add("tool", box((0.075, 0.002, 0.36), (x, -0.03, top - 0.4), 0.0))
            item.add("grip", rounded_box((0.1, 0.022, 0.11), 0.01, (x, -0.031, top - 0.05), 2))
        elif kind == "driver":
            for k in range(3):
                ends = [(x + 0.04 * k - 0.04, -0.035, z) for z in (top, top - 0.1, top - 0.21)]
                item.add("grip", tube(ends[:2], 0.012, 8))
                item.add("tool", tube(ends[1:], 0.0035, 6))
        elif kind == "square":
            item.add("tool", box((0.03, 0.003, 0.26), (x - 0.05, -0.03, top - 0.26), 0.001))
            item.add("grip", box((0.13, 0.014, 0.03), (x, -0.03, top - 0.03), 0.003))
        else:
            for side in (-1, 1):
                path = ((0.004, 0.06), (0.025, 0.12), (0.022, 0.2))
                item.add("grip", tube([(x + side * dx, -0.034, top - drop) for dx, drop in path], 0.009, 8))
            item.add("tool", box((0.03, 0.014, 0.07), (x, -0.034, top - 0.07), 0.004))
        item.add("metal", tube([(x, -0.017, top - 0.01), (x, -0.055, top - 0.008)], 0.003, 6))
        x += draws.uniform(0.16, 0.24)
    return item


def coat_rail(style: Style, draws: Draws, width: float) -> Item:
    """Make a wall board ``width`` metres wide, with hooks and garments on some of them."""
    item = Item("coat_rail", hold="wall")
    item.add("second", box((width, 0.022, 0.12), (0, -0.011, 0), 0.004, grain=0))
    count = max(3, round(width / 0.19))
    for x in middles(width, count):
        item.add("metal", tube([(x, -0.02, 0.075), (x, -0.06, 0.07), (x, -0.075, 0.095)], 0.006, 8))
        item.add("metal", tube([(x, -0.02, 0.04), (x, -0.04, 0.025), (x, -0.048, 0.045)], 0.005, 8))
        if draws.chance(0.4):
            slot = draws.choice(("towel", "cushion_a", "cushion_b", "throw"))
            item.add(slot, _coat(draws, width / count).moved(x, -0.012, 0.055))
    return item


def _coat(draws: Draws, spacing: float) -> Shape:
    """Make a garment that hangs from its loop at the origin, for hooks ``spacing`` metres apart."""
    length, half = draws.uniform(0.7, 1.0), min(0.23, 0.45 * spacing + 0.02)
    phase = draws.uniform(0, 6)
    rings = []
    for t in np.linspace(1, 0, 14):
        w = half * (0.18 + 0.82 * min(1.0, (t * 3.2) ** 0.7)) * (1 - 0.08 * t)
        deep = 0.05 * (0.35 + 0.65 * min(1.0, 3 * t))
        angle = np.linspace(0, 2 * np.pi, 25)[:-1]
        fold = 1 + 0.16 * t * np.sin(5 * angle + phase) + 0.06 * np.sin(9 * angle)
        y = np.minimum(-0.062 + deep * np.sin(angle) * fold, -0.012)
        rings.append(np.stack([w * np.cos(angle) * fold, y, np.full(24, -t * length)], axis=1))
    return loft(np.array(rings), (True, True))


def drying_rack(style: Style, draws: Draws) -> Item:
    """Make a folding rack with laundry over some bars."""
    item = Item("drying_rack", front_m=0.3)
    w, d, h = 0.56, draws.uniform(1.0, 1.3), 0.92
    for x in (-w / 2, w / 2):
        item.add("metal", tube([(x, -0.12, 0.008), (x, -d + 0.1, h)], 0.008))
        item.add("metal", tube([(x, -d + 0.12, 0.008), (x, -0.1, h)], 0.008))
        item.add("metal", tube([(x, -0.04, h), (x, -d + 0.04, h)], 0.008))
    count = 9
    for k in range(count):
        y = -0.06 - k * (d - 0.12) / (count - 1)
        item.add("metal", tube([(-w / 2, y, h + 0.001), (w / 2, y, h + 0.001)], 0.0035, 6))
        if draws.chance(0.35) and k % 2 == 0:
            lw, lh = draws.uniform(0.2, w - 0.1), draws.uniform(0.2, 0.42)
            slot = draws.choice(("towel", "bedding", "throw"))
            for side in (-1, 1):
                item.add(slot, box((lw, 0.005, lh), (0, y + side * 0.0085, h - lh + 0.003), 0.002))
            item.add(slot, box((lw, 0.022, 0.006), (0, y, h + 0.004), 0.0028))
    return item


def basket(style: Style, draws: Draws) -> Item:
    """Make a tall round basket, perhaps with a towel."""
    item = Item("basket")
    r, h = draws.uniform(0.17, 0.23), draws.uniform(0.3, 0.55)
    outside = [(0, 0), (0.82 * r, 0), (0.86 * r, 0.015), (r, h - 0.01), (r + 0.006, h)]
    inside = [(r - 0.008, h), (0.84 * r, 0.02), (0, 0.02)]
    item.add("basket", lathe([*outside, *inside], (0, -r - 0.02, 0), 28))
    if draws.chance(0.6):
        item.add("towel", rounded_box((1.25 * r, 1.2 * r, 0.14), 0.06, (0, -r - 0.02, h - 0.12), 2, 0.03))
    return item


def pedal_bin(style: Style, draws: Draws) -> Item:
    """Make a round bin with a domed lid and a pedal."""
    item = Item("bin")
    r, h = draws.uniform(0.12, 0.16), draws.uniform(0.38, 0.66)
    c = -r - 0.01
    body = [(0, 0), (r - 0.003, 0), (r, 0.004), (r, h), (0, h)]
    lid = [(0, -0.0005), (r + 0.003, -0.0005), (r + 0.003, 0.022), (0.7 * r, 0.05), (0, 0.06)]
    item.add("steel", lathe(body, (0, c, 0), 40))
    item.add("metal", lathe([(x, h + z) for x, z in lid], (0, c, 0), 40))
    item.add("dark", box((0.07, 0.06, 0.012), (0, c - r - 0.02, 0.006), 0.003))
    return item


def trolley(style: Style, draws: Draws) -> Item:
    """Make a trolley on castors with two or three trays."""
    item = Item("trolley", front_m=0.3)
    w, d, h = draws.uniform(0.5, 0.75), draws.uniform(0.36, 0.42), draws.uniform(0.74, 0.86)
    for x, y in product((-w / 2 + 0.02, w / 2 - 0.02), (-0.03, -d + 0.01)):
        castor(item, x, y)
        item.add("metal", tube([(x, y, 0.055), (x, y, h)], 0.011, 10))
    for y in (-0.03, -d + 0.01):
        item.add("metal", tube([(-w / 2 + 0.02, y, h), (w / 2 - 0.02, y, h)], 0.011, 10))
    count = draws.integer(2, 3)
    for k in range(count):
        z = 0.13 + k * (h - 0.17) / (count - 1)
        item.add("steel", box((w - 0.04, d - 0.06, 0.012), (0, -d / 2 - 0.01, z), 0.002, grain=0))
        for y in (-0.045, -d + 0.025):
            item.add("steel", box((w - 0.06, 0.004, 0.04), (0, y, z + 0.011), 0.0, grain=0))
        free = (h - 0.17) / (count - 1) - 0.04 if k < count - 1 else 0.6
        kind: SupportKind = "shelf" if k < count - 1 else "table"
        item.support(kind, (0, -d / 2 - 0.01), (w - 0.1, d - 0.12), z + 0.012, free)
    return item


def lockers(style: Style, draws: Draws) -> Item:
    """Make a row of two to four lockers with vents."""
    item = Item("lockers", front_m=0.5)
    count, each, d, h = draws.integer(2, 4), draws.uniform(0.28, 0.36), 0.48, draws.uniform(1.6, 1.9)
    w = count * each
    item.add("steel", box((w, d - 0.02, h - 0.08), (0, -d / 2 + 0.01, 0.08), 0.003, grain=2))
    item.add("dark", box((w - 0.04, d - 0.08, 0.081), (0, -d / 2 + 0.01, 0), 0.0))
    for k in range(count):
        x = -w / 2 + (k + 0.5) * each
        item.add("steel", box((each - 0.008, 0.018, h - 0.1), (x, -d + 0.0115, 0.09), 0.003, grain=2))
        for j in range(5):
            item.add("dark", box((each * 0.4, 0.002, 0.006), (x, -d + 0.002, h - 0.16 - 0.03 * j), 0.0))
        item.add("metal", box((0.022, 0.02, 0.1), (x + each / 2 - 0.045, -d - 0.006, 0.95), 0.003))
    item.support("shelf", (0, -d / 2), (w - 0.06, d - 0.1), h, 0.4)
    return item

# SPDX-License-Identifier: MIT
"""Makes baths, basins, toilets and towel rails; lengths in metres."""

from __future__ import annotations

from itertools import product

import numpy as np

from datagen.foundation.random import Draws
from datagen.parametric.items import Item, Style
from datagen.parametric.joinery import fronts
from datagen.parametric.shapes import box, cylinder, lathe, loft, rounded_box, rounded_ring, tube
from datagen.parametric.units import tap


def bathtub(style: Style, draws: Draws) -> Item:
    """Make a bath with a panel and a tap, with its long side at the wall."""
    item = Item("bathtub", front_m=0.55)
    w, d, h = draws.uniform(1.6, 1.8), draws.uniform(0.72, 0.8), 0.56
    c = -d / 2
    outside = ((0, 0, 0.03, 0.05), (0, 0, 0.03, 0.012), (0.02, 0.02, 0.03, 0), (0.16, 0.14, 0.16, 0))
    inside = (
        (0.19, 0.17, 0.16, 0.02),
        (0.26, 0.22, 0.15, 0.25),
        (0.42, 0.3, 0.14, 0.4),
        (0.7, 0.44, 0.1, 0.42),
    )
    rings = [rounded_ring(w - a, d - b, r, h - z, (0, c)) for a, b, r, z in (*outside, *inside)]
    item.add("sanitary", loft(np.array(rings), (False, True)))
    slot = draws.choice(("sanitary", "wall_tiles", "wood"))
    item.add(slot, box((w - 0.012, d - 0.012, h - 0.452), (0, c, 0), 0.002, grain=0))
    rim = [rounded_ring(w - 0.012, d - 0.012, 0.012, z, (0, c)) for z in (h - 0.453, h - 0.045)]
    item.add(slot, loft(np.array(rim)))
    x = draws.choice((-1, 1)) * (w / 2 - 0.035)
    item.add("metal", cylinder(0.024, 0.05, (x, c, h - 0.001), 14))
    spout = [(x, c, h + 0.03), (x, c, h + 0.11), (x * 0.96, c, h + 0.15), (x * 0.83, c, h + 0.14)]
    item.add("metal", tube(spout, 0.013, 10))
    for dy in (-0.07, 0.07):
        item.add("metal", cylinder(0.02, 0.06, (x, c + dy, h - 0.001), 14, 0.005))
    item.support("sill", (0, -0.035), (w - 0.5, 0.06), h, 0.5)
    return item


def vanity(style: Style, draws: Draws, width: float) -> Item:
    """Make a basin with a tap on a cabinet ``width`` metres wide."""
    item = Item("vanity", front_m=0.6)
    d, h = 0.48, 0.85
    on_legs = draws.chance(0.35)
    foot = 0.22 if on_legs else 0.06
    if on_legs:
        for x, y in product((-width / 2 + 0.035, width / 2 - 0.035), (-d + 0.04, -0.035)):
            item.add("legs", box((0.035, 0.035, foot + 0.0005), (x, y, 0), 0.003))
    else:
        item.add("wood", box((width - 0.04, d - 0.1, foot + 0.0005), (0, -d / 2 + 0.03, 0), 0.001))
    item.add("wood", box((width, d - 0.02, h - foot - 0.03), (0, -d / 2 + 0.01, foot), 0.002))
    rows = [("drawer", 0.3), ("drawer", 0.26)] if draws.chance(0.5) else [("door", 0.55)]
    scale = (h - foot - 0.034) / sum(height for _, height in rows)
    scaled = [(k, v * scale) for k, v in rows]
    fronts(item, style, width - 0.004, (0, -d + 0.02, foot + 0.002), scaled, 2 if width > 0.75 else 1)
    kind = draws.choice(("bowl", "slab"))
    if kind == "slab":
        rings = [
            rounded_ring(width + 0.01, d, 0.02, h - 0.031, (0, -d / 2)),
            rounded_ring(width + 0.01, d, 0.02, h + 0.026, (0, -d / 2)),
            rounded_ring(width, d, 0.02, h + 0.03, (0, -d / 2)),
            rounded_ring(width - 0.14, d - 0.15, 0.07, h + 0.03, (0, -d / 2 - 0.025)),
            rounded_ring(width - 0.17, d - 0.18, 0.08, h + 0.018, (0, -d / 2 - 0.025)),
            rounded_ring(width - 0.26, d - 0.24, 0.09, h - 0.02, (0, -d / 2 - 0.025)),
            rounded_ring(0.1, 0.08, 0.035, h - 0.026, (0, -d / 2 - 0.025)),
        ]
        item.add("sanitary", loft(np.array(rings), (True, True)))
        tap(item, 0, -0.055, h + 0.03, 0.13, 0.19)
    else:
        item.add("worktop", box((width + 0.01, d, 0.03), (0, -d / 2, h - 0.03), 0.003, grain=0))
        r = 0.19
        bowl = [
            (0.06, 0.0),
            (0.1, 0.004),
            (0.165, 0.06),
            (r, 0.125),
            (r - 0.004, 0.13),
            (r - 0.01, 0.125),
            (0.155, 0.065),
            (0.09, 0.016),
            (0, 0.012),
        ]
        x = 0.0 if width < 0.9 else draws.choice((-1, 1)) * (width / 2 - 0.32)
        item.add("sanitary", lathe([(0, 0), *bowl], (x, -d / 2 - 0.02, h), 36))
        tap(item, x, -0.04, h, 0.15, 0.3)
        if x:
            item.support("counter", (-0.28 * np.sign(x) * width, -d / 2), (width - 0.7, d - 0.12), h, 0.5)
    return item


def toilet(style: Style, draws: Draws) -> Item:
    """Make a toilet with a cistern."""
    item = Item("toilet", front_m=0.5)
    c = -0.44

    def oval(w: float, d: float, z: float, y: float) -> np.ndarray:
        a = np.linspace(0, 2 * np.pi, 33)[:-1]
        front_half = np.where(np.sin(a) < 0, d * 0.6, d * 0.4)
        return np.stack([0.5 * w * np.cos(a), y + front_half * np.sin(a), np.full(32, z)], axis=1)

    body = [(0.24, 0.4, 0.0), (0.22, 0.38, 0.06), (0.23, 0.4, 0.18), (0.35, 0.5, 0.34), (0.37, 0.52, 0.395),
            (0.36, 0.51, 0.4)]  # fmt: skip
    lid = [
        (0.37, 0.52, 0.402),
        (0.38, 0.53, 0.408),
        (0.38, 0.53, 0.424),
        (0.36, 0.51, 0.432),
        (0.2, 0.3, 0.435),
    ]
    for rings in (body, lid):
        item.add("sanitary", loft(np.array([oval(*ring, c) for ring in rings]), (True, True)))
    item.add("sanitary", rounded_box((0.34, 0.14, 0.2), 0.03, (0, -0.27, 0.2), 2))
    item.add("sanitary", rounded_box((0.38, 0.17, 0.36), 0.025, (0, -0.09, 0.4), 3))
    item.add("sanitary", rounded_box((0.4, 0.19, 0.04), 0.014, (0, -0.1, 0.762), 2))
    item.add("sanitary", rounded_box((0.2, 0.2, 0.4), 0.03, (0, -0.14, 0.0), 2))
    item.add("metal", cylinder(0.022, 0.008, (0, -0.1, 0.801), 18))
    return item


def towel_rail(style: Style, draws: Draws) -> Item:
    """Make a heated towel ladder with a towel, for a wall."""
    item = Item("towel_rail", hold="wall")
    w, h = 0.5, draws.uniform(1.0, 1.4)
    for x in (-w / 2, w / 2):
        item.add("metal", tube([(x, -0.06, 0), (x, -0.06, h)], 0.014, 10))
        for z in (0.08, h - 0.08):
            item.add("metal", tube([(x, -0.0005, z), (x, -0.058, z)], 0.009, 8))
    count = int(h / 0.09)
    for k in range(count):
        if k % 5 == 4:
            continue
        z = 0.06 + k * (h - 0.12) / (count - 1)
        item.add("metal", tube([(-w / 2, -0.06, z), (w / 2, -0.06, z)], 0.01, 8))
    long = draws.uniform(0.4, 0.6)
    for y in (-0.078, -0.042):
        item.add("towel", box((0.38, 0.01, long), (0, y, h - 0.12 - long), 0.004))
    item.add("towel", box((0.38, 0.046, 0.012), (0, -0.06, h - 0.126 + 0.003), 0.005))
    return item

# SPDX-License-Identifier: MIT
"""Makes seats and beds: chairs, stools, sofas, benches, beds; lengths in metres."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from datagen.foundation.random import Draws
from datagen.parametric.items import Item, Style
from datagen.parametric.joinery import castor, legs, ring_of
from datagen.parametric.shapes import (
    Shape,
    box,
    cylinder,
    flipped,
    grid,
    joined,
    lathe,
    middles,
    rounded_box,
    tube,
)


def chair(style: Style, draws: Draws) -> Item:
    """Make a chair with a back of slats, a board or upholstery."""
    item, seat_height = Item("chair"), 0.46
    w, d = draws.uniform(0.42, 0.48), draws.uniform(0.44, 0.5)
    back = draws.choice(("slats", "board", "soft"))
    top = draws.uniform(0.8, 0.92)
    frame = "metal" if style.legs == "metal" else "wood"
    legs(item, style, (-w / 2, w / 2, -d, -d + 0.04), seat_height - 0.03, 0.038, frame)
    for side in (-1, 1):
        x = side * (w / 2 - 0.019)
        path = ((-0.05, 0.0), (-0.045, 0.25), (-0.05, seat_height), (-0.03, 0.65), (-0.018, top))
        item.add(frame, tube([(x, y, z) for y, z in path], 0.0165, 10))
    for y in (-d + 0.02, -0.055):
        item.add(frame, box((w - 0.04, 0.02, 0.05), (0, y, seat_height - 0.08), 0.003, grain=0))
    at = (0, -d / 2 - 0.015, seat_height - 0.08)
    item.pair(frame, w / 2 - 0.02, box((0.02, d - 0.09, 0.045), at, 0.003))
    at = (0, -d / 2 - 0.0275, seat_height - 0.029)
    if back == "soft" or draws.chance(0.5):
        item.add("seat", rounded_box((w, d - 0.055, 0.06), 0.022, at, 2, 0.008))
    else:
        item.add("wood", box((w, d - 0.055, 0.022), at, 0.008, grain=0))
    if back == "slats":
        for z in np.linspace(seat_height + 0.13, top - 0.075, 3):
            y = float(np.interp(z, [seat_height, 0.65, top], [-0.05, -0.03, -0.018]))
            item.add("wood", box((w - 0.04, 0.014, 0.055), (0, y, float(z)), 0.004, grain=0))
    elif back == "board":
        item.add("wood", box((w - 0.035, 0.016, 0.24), (0, -0.027, top - 0.26), 0.006, grain=0))
    else:
        size = (w - 0.03, 0.05, top - seat_height - 0.1)
        item.add("seat", rounded_box(size, 0.02, (0, -0.03, seat_height + 0.1), 2, 0.006))
    return item


def stool(style: Style, draws: Draws, height: float = 0.46) -> Item:
    """Make a round stool ``height`` metres high."""
    item = Item("stool")
    r = draws.uniform(0.16, 0.19)
    seat = [(0, 0.035), (r - 0.012, 0.035), (r, 0.024), (r, 0.008), (r - 0.01, 0), (0, 0.003)]
    item.add("wood", lathe([(x, height - z) for x, z in seat], (0, -0.2, 0), 28))
    slot = "metal" if style.legs == "metal" else "wood"
    for x, y in ring_of(4, 1.0, math.pi / 4):
        leg = [(0.17 * x, -0.2 + 0.17 * y, 0.0036), (0.1 * x, -0.2 + 0.1 * y, height - 0.03)]
        item.add(slot, tube(leg, 0.014, 10))
    rest = ring_of(20, 0.15 if height < 0.6 else 0.152)
    path = [(x, -0.2 + y, 0.35 * height) for x, y in [*rest, rest[0]]]
    item.add(slot, tube(path, 0.008, 6))
    return item


def office_chair(style: Style, draws: Draws) -> Item:
    """Make a swivel chair on five castors."""
    item = Item("office_chair")
    c = -0.33
    for x, y in ring_of(5, 0.27, draws.uniform(0, 1)):
        foot = [(0.03 * x / 0.27, c + 0.03 * y / 0.27, 0.09), (x, c + y, 0.06)]
        item.add(style.leg_slot, tube(foot, 0.016, 8))
        castor(item, x, c + y)
    item.add("metal", cylinder(0.024, 0.33, (0, c, 0.08), 14))
    item.add("machine", cylinder(0.035, 0.12, (0, c, 0.1), 16, 0.004))
    item.add("machine", box((0.24, 0.26, 0.035), (0, c, 0.4), 0.01))
    item.add("seat", rounded_box((0.49, 0.47, 0.075), 0.035, (0, c - 0.01, 0.433), 2, 0.012))
    tall = draws.uniform(0.42, 0.62)
    spine = ((0.1, 0.415), (0.25, 0.43), (0.295, 0.55), (0.3, 0.8))
    item.add("machine", tube([(0, c + y, z) for y, z in spine], 0.019, 8))
    item.add("seat", rounded_box((0.44, 0.06, tall), 0.028, (0, c + 0.263, 0.58), 2, 0.01))
    if draws.chance(0.7):
        for side in (-1, 1):
            x = side * 0.275
            item.add("machine", tube([(side * 0.2, c, 0.42), (x, c, 0.44), (x, c, 0.63)], 0.013, 8))
            item.add("machine", rounded_box((0.06, 0.25, 0.03), 0.013, (x, c, 0.63), 2))
    return item


def sofa(style: Style, draws: Draws, seats: int) -> Item:
    """Make an upholstered sofa with ``seats`` seats on short legs, with loose cushions."""
    item = Item("sofa" if seats > 1 else "armchair", front_m=0.45)
    arm = draws.uniform(0.12, 0.2) if style.is_soft else draws.uniform(0.09, 0.14)
    each = draws.uniform(0.58, 0.68) if seats > 1 else 0.56
    d = draws.uniform(0.82, 0.94) if seats > 1 else draws.uniform(0.76, 0.84)
    w = seats * each + 2 * arm
    foot, seat = 0.11, draws.uniform(0.41, 0.45)
    top, side = draws.uniform(0.76, 0.88), draws.uniform(0.56, 0.64)
    r = 0.05 if style.is_soft else 0.022
    leg = [(0, 0), (0.013, 0), (0.022, foot + 0.01), (0, foot + 0.01)]
    for x, y in product((-w / 2 + 0.07, w / 2 - 0.07), (-d + 0.07, -0.07)):
        item.add("legs", lathe(leg, (x, y, 0), 12))
    base = (w - 2 * arm + 0.02, d - 0.06, seat - 0.13 - foot)
    item.add("sofa", rounded_box(base, 0.02, (0, -d / 2 - 0.02, foot), 2))
    for s in (-1, 1):
        item.add("sofa", rounded_box((arm, d, side - foot), r, (s * (w - arm) / 2, -d / 2, foot), 3))
    back = (w - 2 * arm + 0.004, 0.2, top - foot - 0.03)
    item.add("sofa", rounded_box(back, r, (0, -0.1, foot + 0.002), 3))
    for k in range(seats):
        x = -w / 2 + arm + (k + 0.5) * each
        at = (x, -d / 2 - 0.1, seat - 0.135)
        item.add("sofa", rounded_box((each - 0.006, d - 0.19, 0.14), 0.045, at, 2, 0.012))
        height = top - seat + 0.04
        pillow = rounded_box((each - 0.012, 0.15, height), 0.055, (0, 0, 0), 2, 0.02)
        item.add("sofa", pillow.turned("x", -9).moved(x, -0.235, seat - 0.012))
    for k in range(draws.integer(0, 2) if seats > 1 else draws.integer(0, 1)):
        x = (-1) ** k * (w / 2 - arm - 0.23) if seats > 1 else 0.0
        throw = rounded_box((0.42, 0.13, 0.42), 0.05, (0, 0, 0), 2, 0.03)
        tilt = throw.turned("y", draws.uniform(-8, 8)).turned("x", -20)
        lowest = float(tilt.points[:, 2].min())
        item.add("cushion_a" if k == 0 else "cushion_b", tilt.moved(x, -0.43, seat + 0.012 - lowest))
    item.support("seat", (0, -d / 2 - 0.16), (w - 2 * arm - 0.08, d - 0.5), seat + 0.012, 0.8)
    return item


def bench(style: Style, draws: Draws, width: float, upholstered: bool) -> Item:
    """Make a bench ``width`` metres long; an upholstered one has a back."""
    item = Item("bench", front_m=0.4)
    d = 0.5 if upholstered else 0.4
    if upholstered:
        item.add("wood", box((width, d - 0.06, 0.32), (0, -d / 2 + 0.03, 0), 0.004, grain=0))
        count = max(1, round(width / 0.7))
        each = width / count
        for x in middles(width, count):
            at = (x, -d / 2 - 0.03, 0.322)
            item.add("seat", rounded_box((each - 0.004, d - 0.06, 0.11), 0.03, at, 2, 0.01))
            item.add("seat", rounded_box((each - 0.006, 0.09, 0.4), 0.03, (x, -0.05, 0.45), 2, 0.008))
    else:
        legs(item, style, (-width / 2 + 0.03, width / 2 - 0.03, -d + 0.02, -0.02), 0.42, 0.045)
        for k in range(3):
            item.add("wood", box((width, 0.12, 0.028), (0, -0.07 - k * 0.13, 0.42), 0.004, grain=0))
        item.support("seat", (0, -d / 2), (width - 0.1, d - 0.1), 0.448, 0.8)
    return item


def bed(style: Style, draws: Draws, width: float, is_child: bool = False) -> Item:
    """Make a bed with bedding, for a mattress ``width`` metres wide; its head is at y = 0."""
    item = Item("bed", front_m=0.55)
    length = draws.uniform(2.0, 2.08) if not is_child else 1.78
    head = draws.uniform(0.85, 1.15)
    w = width + 0.08
    level = draws.uniform(0.27, 0.34)
    kind = draws.choice(("board", "soft", "slats"))
    frame = "metal" if kind == "slats" and style.legs == "metal" else "wood"
    if kind == "soft":
        item.add("sofa", rounded_box((w + 0.04, 0.1, head), 0.04, (0, -0.051, 0), 3, 0.01))
    elif kind == "board":
        item.add("wood", box((w + 0.02, 0.035, head), (0, -0.03, 0), 0.008, grain=0))
    else:
        item.pair(frame, w / 2 - 0.02, box((0.05, 0.05, head), (0, -0.03, 0), 0.006, grain=2))
        for z in np.linspace(level + 0.12, head - 0.09, 4):
            item.add(frame, box((w - 0.05, 0.02, 0.07), (0, -0.03, float(z)), 0.004, grain=0))
    y0 = -0.075 if kind != "soft" else -0.115
    rail = box((0.028, length - 0.04, 0.17), (0, y0 - length / 2, level - 0.12), 0.004, grain=1)
    item.pair(frame, w / 2 - 0.014, rail)
    item.add(frame, box((w - 0.057, 0.028, 0.17), (0, y0 - length + 0.03, level - 0.12), 0.004, grain=0))
    item.add("wood", box((w - 0.06, length - 0.08, 0.02), (0, y0 - length / 2, level - 0.04), 0.0))
    for x, y in product((-w / 2 + 0.05, w / 2 - 0.05), (y0 - 0.06, y0 - length + 0.08)):
        item.add(style.leg_slot, box((0.05, 0.05, level - 0.12), (x, y, 0), 0.004, grain=2))
    thick = draws.uniform(0.18, 0.24)
    base = level - 0.018
    item.add("mattress", rounded_box((width, length - 0.09, thick), 0.045, (0, y0 - length / 2, base), 3))
    top = base + thick
    cover = draws.uniform(0.62, 0.72) * length
    item.add("bedding", _duvet(width + 0.1, cover, top, y0 - length + 0.012))
    if draws.chance(0.5):
        item.add("throw", _duvet(width + 0.15, 0.5, top + 0.028, y0 - length + draws.uniform(0.1, 0.3)))
    count = 2 if width > 1.2 else 1
    for k in range(count):
        x = (k - (count - 1) / 2) * width / count
        pillow = rounded_box((min(0.68, width / count - 0.06), 0.42, 0.13), 0.055, (0, 0, 0), 2, 0.04)
        item.add("bedding", pillow.turned("x", draws.uniform(4, 12)).moved(x, y0 - 0.28, top + 0.03))
        if draws.chance(0.35):
            scatter = rounded_box((0.4, 0.4, 0.11), 0.045, (0, 0, 0), 2, 0.03)
            item.add("cushion_a", scatter.turned("x", 60).moved(x, y0 - 0.57, top + 0.13))
    item.support("bed", (0, y0 - length * 0.72), (width - 0.2, length * 0.4), top + 0.05, 1.2)
    return item


def _duvet(width: float, length: float, z: float, y: float) -> Shape:
    """Make a blanket on a mattress whose top is at ``z``, from ``y`` towards +y, overhanging the sides."""
    s = np.linspace(-1, 1, 41)
    t = np.linspace(0, 1, 26)
    half = width / 2
    hang = 0.16
    run = s * (half + hang)
    over = np.maximum(np.abs(run) - half + 0.04, 0.0)
    x = np.sign(run) * np.minimum(np.abs(run), half - 0.04 + 0.04 * np.tanh(over / 0.04))
    drop = np.maximum(over - 0.03, 0.0)
    ss, tt = np.meshgrid(s, t)
    wave = 0.006 * np.sin(7.0 * tt + 3.1 * ss) * np.cos(5.3 * ss + 2.0 * tt)
    wave = wave + 0.004 * np.sin(17 * ss + 4 * tt)
    top = np.empty((len(t), len(s), 3))
    top[..., 0] = x[None] + np.where(drop[None] > 0, 0.008 * np.sin(21 * tt + 2.0), 0.0) * np.sign(ss)
    top[..., 1] = y + tt * length
    edge = 0.018 * np.exp(-tt / 0.02) + 0.012 * np.exp(-(1 - tt) / 0.03)
    top[..., 2] = z + 0.045 - drop[None] + wave - edge
    under = top.copy()
    under[..., 2] -= np.where(drop[None] > 0, 0.0, 0.025)
    under[..., 0] -= np.sign(ss) * np.where(drop[None] > 0, 0.018, 0.0)
    return joined([grid(top), flipped(grid(under))])

# SPDX-License-Identifier: MIT
"""Makes fittings and small items: radiators, curtains, rugs, plants, switches; lengths in metres."""

from __future__ import annotations

from itertools import product

import numpy as np

from datagen.foundation.random import Draws
from datagen.parametric.items import Item, Style
from datagen.parametric.joinery import ring_of
from datagen.parametric.shapes import (
    Point,
    Shape,
    box,
    cylinder,
    flat,
    flipped,
    grid,
    joined,
    lathe,
    middles,
    rounded_box,
    tube,
)

PLATE_M = 0.082  # side of the plate of a switch or socket


def radiator(style: Style, draws: Draws, width: float, height: float) -> Item:
    """Make a panel or column radiator of ``width`` by ``height`` metres, for a wall."""
    item = Item("radiator", hold="wall")
    if draws.chance(0.6):
        item.add("radiator", rounded_box((width, 0.07, height), 0.012, (0, -0.075, 0), 2))
        for x in middles(width, int(width / 0.05)):
            item.add("radiator", box((0.022, 0.008, height - 0.06), (x, -0.112, 0.03), 0.0035))
    else:
        for x, y in product(middles(width, int(width / 0.055)), (-0.05, -0.095)):
            item.add("radiator", tube([(x, y, 0.0), (x, y, height)], 0.0165, 8))
        for z in (0.03, height - 0.03):
            item.add("radiator", box((width, 0.06, 0.035), (0, -0.0725, z - 0.0175), 0.01))
    item.pair("metal", 0.4 * width, box((0.03, 0.045, 0.03), (0, -0.0235, height - 0.08), 0.002))
    item.add("metal", cylinder(0.018, 0.07, (width / 2 + 0.03, -0.075, 0.02), 12, 0.005))
    item.add("metal", tube([(width / 2 - 0.01, -0.075, 0.03), (width / 2 + 0.03, -0.075, 0.03)], 0.008, 6))
    return item


def curtains(style: Style, draws: Draws, window: float, height: float, floor: float, off_wall: float) -> Item:
    """Make two open curtains on a rail ``off_wall`` metres from the wall, for a window of width ``window``.

    ``height`` is the rail's height above the item's z = 0, ``floor`` the length of the curtains.
    """
    item = Item("curtains", hold="wall")
    open_share = draws.uniform(0.16, 0.34)
    half = window / 2 + 0.24
    item.add("metal", tube([(-half, -off_wall, height), (half, -off_wall, height)], 0.012, 10))
    for x in (-half, half):
        end = cylinder(0.02, 0.03, bevel=0.006, segments=12).turned("y", 90)
        item.add("metal", end.moved(x - 0.015, -off_wall, height))
    for x in (-half + 0.06, half - 0.06):
        item.add("metal", tube([(x, -0.0005, height), (x, 0.002 - off_wall, height)], 0.007, 6))
    for side in (-1, 1):
        width = max(open_share * (window + 0.3), 0.24)
        outer = side * (half - 0.03)
        inner = outer - side * width
        left, right = min(inner, outer), max(inner, outer)
        item.add("curtain", _drape(draws, left, right, height - 0.016, floor).moved(0, -off_wall, 0))
    return item


def _drape(draws: Draws, x0: float, x1: float, top: float, length: float) -> Shape:
    folds = max(3, round((x1 - x0) / 0.075))
    s = np.linspace(0, 1, folds * 12 + 1)
    t = np.linspace(0, 1, 8)
    ss, tt = np.meshgrid(s, t)
    phase = draws.uniform(0, 6)
    wander = 0.3 * np.sin(3.0 * ss + phase) * tt
    depth = (0.024 + 0.012 * (1 - tt)) * np.sin(2 * np.pi * folds * ss + wander)
    points = np.empty((*ss.shape, 3))
    points[..., 0] = x0 + ss * (x1 - x0) + 0.003 * np.sin(4 * np.pi * folds * ss + phase) * tt
    points[..., 1] = -depth
    points[..., 2] = top - (1 - tt) * length
    front = grid(points)
    back = points.copy()
    back[..., 1] += 0.004
    return joined([front, flipped(grid(back))])


def roller_blind(style: Style, draws: Draws, window: float, height: float) -> Item:
    """Make a roller blind for a ``window`` by ``height`` m window; z = 0 is the window's lower edge."""
    item = Item("blind", hold="wall")
    drop = draws.uniform(0.15, 0.55) * height
    roll = [(x, -0.05, height + 0.06) for x in (-window / 2 - 0.092, window / 2 + 0.092)]
    item.add("metal", tube(roll, 0.024, 12))
    item.add("blind", box((window + 0.06, 0.002, drop), (0, -0.073, height + 0.06 - drop), 0.0))
    item.add("blind", box((window + 0.06, 0.012, 0.024), (0, -0.073, height + 0.06 - drop - 0.022), 0.004))
    item.pair("metal", window / 2 + 0.1, box((0.012, 0.075, 0.07), (0, -0.038, height + 0.025), 0.003))
    return item


def slatted_blind(style: Style, draws: Draws, window: float, height: float) -> Item:
    """Make a slatted blind for a ``window`` by ``height`` m window; z = 0 is the window's lower edge."""
    item = Item("blind", hold="wall")
    drop = draws.uniform(0.3, 0.95) * height
    tilt = draws.uniform(-12, 18)
    w = window + 0.18
    item.add("slats", box((w, 0.05, 0.045), (0, -0.05, height + 0.03), 0.004))
    slat = box((w, 0.046, 0.0025), (0, 0, -0.00125), 0.0006, grain=0).turned("x", tilt)
    z = height
    while z > height + 0.03 - drop:
        item.add("slats", slat.moved(0, -0.05, z))
        z -= 0.045
    item.add("slats", box((w, 0.05, 0.016), (0, -0.05, z - 0.012), 0.003))
    for x in (-0.36 * w, 0.36 * w):
        item.add("slats", tube([(x, -0.05, z), (x, -0.05, height + 0.04)], 0.0012, 4))
    item.pair("slats", w / 2 + 0.008, box((0.014, 0.076, 0.05), (0, -0.0385, height + 0.028), 0.003))
    return item


def rug(style: Style, draws: Draws, width: float, depth: float, is_round: bool = False) -> Item:
    """Make a rug 9 mm thick, centred in x, with y from -depth to 0; a round one has diameter ``width``."""
    item = Item("rug")
    if is_round:
        r = width / 2
        item.add("rug", lathe([(0, 0), (r, 0), (r, 0.006), (r - 0.004, 0.009), (0, 0.0095)], (0, -r, 0), 48))
        return item
    if draws.chance(0.45):
        b = draws.uniform(0.06, 0.16)
        item.add("rug", box((width - 2 * b, depth - 2 * b, 0.0085), (0, -depth / 2, 0), 0.001, grain=0))
        for y in (-b / 2, -depth + b / 2):
            item.add("rug_border", box((width, b, 0.009), (0, y, 0), 0.003, grain=0))
        side = box((b, depth - 2 * b, 0.009), (0, -depth / 2, 0), 0.003, grain=1)
        item.pair("rug_border", width / 2 - b / 2, side)
    else:
        item.add("rug", box((width, depth, 0.009), (0, -depth / 2, 0), 0.004, grain=0))
    return item


def picture(style: Style, draws: Draws, width: float, height: float, art: str) -> Item:
    """Make a framed print in a mount; ``art`` is the slot of the print; z = 0 is the frame's lower edge."""
    item = Item("picture", hold="wall")
    f = draws.uniform(0.012, 0.035)
    _framed(item, "mount", (width, height), f, 0.022, (-0.012, -0.008), 0.003)
    m = draws.choice((0.0, 0.06, 0.09)) if min(width, height) > 0.3 else 0.0
    w, h = width / 2 - f - m, height - f - m
    quad = np.array([[[-w, -0.0118, f + m], [w, -0.0118, f + m], [w, -0.0118, h], [-w, -0.0118, h]]])
    item.add(art, flat(quad, is_print=True))
    return item


def _framed(
    item: Item, slot: str, size: tuple[float, float], rim: float, depth: float, ys: tuple[float, float],
    bevel: float,
) -> None:  # fmt: skip
    """Add a frame of ``size`` (width, height) with bars ``rim`` wide and a pane; ``ys``: y of frame, pane."""
    width, height = size
    for z in (0.0, height - rim):
        item.add("frame", box((width, depth, rim), (0, ys[0], z), bevel, grain=0))
    inner, low = height - 2 * rim + 0.001, rim - 0.0005
    upright = box((rim, depth - 0.0001, inner), (0, ys[0], low), bevel, grain=2)
    item.pair("frame", width / 2 - rim / 2, upright)
    item.add(slot, box((width - 2 * rim + 0.001, 0.006, inner), (0, ys[1], low), 0.0))


def mirror(style: Style, draws: Draws, width: float, height: float) -> Item:
    """Make a framed mirror of ``width`` by ``height`` metres; z = 0 is its lower edge."""
    item = Item("mirror", hold="wall")
    _framed(item, "mirror", (width, height), draws.uniform(0.008, 0.03), 0.024, (-0.013, -0.012), 0.002)
    return item


def board(style: Style, draws: Draws, width: float, height: float, slot: str) -> Item:
    """Make a wall board; ``slot`` is ``white_board`` (with a tray) or ``slate_board``."""
    item = Item("board", hold="wall")
    rim = "metal" if slot == "white_board" else "second"
    for z in (0.0, height - 0.02):
        item.add(rim, box((width, 0.02, 0.02), (0, -0.011, z), 0.003, grain=0))
    item.pair(rim, width / 2 - 0.01, box((0.02, 0.0198, height - 0.04), (0, -0.011, 0.02), 0.003))
    item.add(slot, box((width - 0.039, 0.01, height - 0.039), (0, -0.008, 0.0195), 0.0))
    if slot == "white_board":
        item.add("metal", box((0.5, 0.06, 0.008), (0, -0.049, -0.0085), 0.002))
        for k, colour in enumerate(("toy_a", "toy_b", "dark")):
            pen = [(x + 0.15 * k, -0.05, 0.0075) for x in (-0.18, -0.06)]
            item.add(colour, tube(pen, 0.0078, 8))
    return item


def television(style: Style, draws: Draws, width: float) -> Item:
    """Make a television ``width`` metres wide on its stand."""
    item = Item("television", hold="surface")
    h = width * 0.575
    item.add("machine", box((width, 0.035, h), (0, -0.13, 0.07), 0.006))
    item.add("screen", box((width - 0.02, 0.003, h - 0.03), (0, -0.1485, 0.09), 0.001))
    for x in (-0.3 * width, 0.3 * width):
        item.add("machine", box((0.03, 0.2, 0.012), (x, -0.13, 0), 0.003))
        item.add("machine", box((0.03, 0.03, 0.07), (x, -0.13, 0.005), 0.003))
    return item


def clock(style: Style, draws: Draws) -> Item:
    """Make a round wall clock; z = 0 is its lowest point."""
    item = Item("clock", hold="wall")
    r = draws.uniform(0.13, 0.18)
    rim = lathe([(0, 0), (r, 0), (r, 0.035), (r - 0.012, 0.035), (r - 0.014, 0.025)], segments=40)
    item.add("frame", rim.turned("x", 90).moved(0, -0.0005, r))
    face = lathe([(0, 0.024), (r - 0.0145, 0.024), (r - 0.0145, 0.026), (0, 0.026)], segments=40)
    item.add("mount", face.turned("x", 90).moved(0, -0.0005, r))
    for length, angle in ((0.55, draws.uniform(0, 360)), (0.78, draws.uniform(0, 360))):
        hand = box((0.007, 0.002, length * r), (0, 0, -0.02), 0.0).turned("y", angle)
        item.add("dark", hand.moved(0, -0.0295 - 0.001 * length, r))
    return item


def plant(style: Style, draws: Draws) -> Item:
    """Make a tall plant in a floor pot."""
    item = Item("plant")
    r, h = draws.uniform(0.14, 0.2), draws.uniform(0.24, 0.36)
    c = -0.42
    outside = [(0, 0), (0.72 * r, 0), (0.76 * r, 0.01), (r, h - 0.01), (r, h)]
    inside = [(r - 0.016, h), (r - 0.02, h - 0.035), (0, h - 0.035)]
    item.add("pot", lathe([*outside, *inside], (0, c, 0), 28))
    item.add("soil", cylinder(r - 0.019, 0.012, (0, c, h - 0.0365), 20))
    count = draws.integer(10, 18)
    is_broad = draws.chance(0.5)
    for k in range(count):
        angle = 2.4 * k + draws.uniform(-0.3, 0.3)
        tall = draws.uniform(0.35, 1.15)
        lean = draws.uniform(0.05, 0.24) if not is_broad else draws.uniform(0.12, 0.3)
        dx, dy = np.cos(angle), np.sin(angle)
        foot = (0.03 * dx, c + 0.03 * dy, h - 0.03)
        tip = (lean * dx, c + lean * dy, h + tall * 0.7)
        middle = (0.3 * lean * dx, c + 0.3 * lean * dy, h + tall * 0.45)
        item.add("stem", tube([foot, middle, tip], 0.005, 5))
        length = draws.uniform(0.2, 0.34) if is_broad else draws.uniform(0.32, 0.55)
        width = 0.3 * length if is_broad else 0.1 * length
        reach = min(0.42 - lean - 0.03, length)
        item.add("leaf", _leaf(tip, angle, reach, length, width))
    return item


def _leaf(tip: Point, angle: float, reach: float, length: float, width: float) -> Shape:
    t = np.linspace(0, 1, 9)
    rise = length * (0.55 * t - 0.5 * t**2)
    half = width * np.sqrt(np.maximum(np.sin(np.pi * np.clip(t * 0.94 + 0.04, 0, 1)), 0.0))
    points = np.empty((9, 3, 3))
    for j, side in enumerate((-1.0, 0.0, 1.0)):
        points[:, j, 0] = t * reach
        points[:, j, 1] = side * half
        points[:, j, 2] = rise + (0.2 * half if side else 0.0)
    front = grid(points)
    under = grid(points - np.array([0, 0, 0.0008]))
    is_up = front.normals[:, 2].mean() > 0
    leaf = joined([front, flipped(under)] if is_up else [flipped(front), under])
    return leaf.turned("z", float(np.degrees(angle))).moved(*tip)


def pouf(style: Style, draws: Draws) -> Item:
    """Make a low upholstered seat, round or square."""
    item = Item("pouf")
    r, h = draws.uniform(0.2, 0.28), draws.uniform(0.34, 0.44)
    if draws.chance(0.5):
        item.add("cushion_b", rounded_box((2 * r, 2 * r, h), 0.05, (0, -r - 0.02, 0), 3))
    else:
        low, high = np.linspace(0, np.pi / 2, 5), np.linspace(0, np.pi / 2, 6)
        rim = [(r - 0.05 + 0.05 * np.sin(a), 0.05 - 0.05 * np.cos(a)) for a in low]
        top = [(r - 0.06 + 0.06 * np.cos(a), h - 0.06 + 0.06 * np.sin(a)) for a in high]
        item.add("cushion_b", lathe([(0, 0), *rim, *top, (0, h + 0.006)], (0, -r - 0.02, 0), 36))
    item.support("seat", (0, -r - 0.02), (r, r), h, 0.6)
    return item


def crates(style: Style, draws: Draws) -> Item:
    """Make a stack of cardboard boxes."""
    item = Item("crates")
    z, w, d = 0.0, draws.uniform(0.4, 0.58), draws.uniform(0.34, 0.46)
    for _ in range(draws.integer(1, 3)):
        h = draws.uniform(0.24, 0.4)
        item.add("box", box((w, d, h), (draws.uniform(-0.02, 0.02), -d / 2 - 0.03, z), 0.004))
        item.add("mount", box((0.05, d + 0.001, 0.0012), (0, -d / 2 - 0.03, z + h - 0.0005), 0.0))
        z += h + 0.0012
        w, d = w * draws.uniform(0.8, 1.0), d * draws.uniform(0.85, 1.0)
    item.support("table", (0, -d / 2 - 0.03), (w - 0.08, d - 0.08), z, 0.8)
    return item


def shoes(style: Style, draws: Draws) -> Item:
    """Make a pair of shoes."""
    item = Item("shoes")
    slot = draws.choice(("dark", "seat", "grip"))
    for side in (-1, 1):
        x = 0.075 * side
        item.add("dark", rounded_box((0.095, 0.27, 0.022), 0.01, (x, -0.16, 0), 2))
        item.add(slot, rounded_box((0.09, 0.26, 0.06), 0.028, (x, -0.16, 0.018), 2))
        item.add(slot, rounded_box((0.085, 0.11, 0.1), 0.025, (x, -0.085, 0.02), 2))
    return item


def teepee(style: Style, draws: Draws) -> Item:
    """Make a child's play tent of fabric on four poles."""
    item = Item("tent")
    r, h, c = 0.55, 1.45, -0.58
    feet = ring_of(4, r, np.pi / 4)
    for x, y in feet:
        item.add("wood", tube([(x, c + y, 0.006), (-0.12 * x, c - 0.12 * y, h)], 0.013, 8))
    top = 0.86
    for k in range(4):
        (xa, ya), (xb, yb) = feet[k], feet[(k + 1) % 4]
        if k == 2:  # the entrance faces the room
            continue
        low = np.array([[xa, c + ya, 0.03], [xb, c + yb, 0.03]])
        high = np.array([[xa, c + ya, 0.0], [xb, c + yb, 0.0]]) * (1 - top) + np.array([0, c, 0]) * top
        high[:, 2] = top * h
        rows = np.linspace(0, 1, 5)[:, None, None]
        columns = np.linspace(0, 1, 9)[None, :, None]
        lower = low[0] + columns * (low[1] - low[0])
        upper = high[0] + columns * (high[1] - high[0])
        sheet = lower + rows * (upper - lower)
        inward = np.array([0, c, 0]) - sheet
        inward[..., 2] = 0
        sag = 0.05 * np.sin(np.pi * columns) * np.sin(np.pi * rows * 0.9)
        sheet = sheet + sag * inward / np.maximum(np.linalg.norm(inward, axis=2, keepdims=True), 1e-9)
        front = grid(sheet)
        item.add("bedding", joined([front, flipped(grid(sheet + 0.003 * inward))]))
    return item


def switch(gangs: int) -> Item:
    """Make a switch with ``gangs`` (1 or 2) rockers side by side; z = 0 is its lower edge."""
    item = Item("switch", hold="wall")
    item.add("switch", box((PLATE_M, 0.009, PLATE_M), (0, -0.005, 0), 0.002))
    width = 0.06 / gangs - 0.001
    for k in range(gangs):
        x = (k - (gangs - 1) / 2) * (width + 0.001)
        item.add("switch", box((width, 0.0045, 0.06), (x, -0.0115, 0.011), 0.001))
    return item


def socket(count: int) -> Item:
    """Make a row of ``count`` sockets, each with a round face and two holes; z = 0 is its lower edge."""
    item = Item("socket", hold="wall")
    item.add("switch", box((count * PLATE_M, 0.009, PLATE_M), (0, -0.005, 0), 0.002))
    for k in range(count):
        x = (k - (count - 1) / 2) * PLATE_M
        face = cylinder(0.0215, 0.002, bevel=0.0004).turned("x", 90)
        item.add("switch", face.moved(x, -0.0093, PLATE_M / 2))
        for side in (-1, 1):
            hole = cylinder(0.0026, 0.0012, segments=8).turned("x", 90)
            item.add("dark", hole.moved(x + 0.0095 * side, -0.0102, PLATE_M / 2))
    return item

# SPDX-License-Identifier: MIT
"""Makes lamps with realistic sizes, colour temperatures and luminous fluxes; lengths in metres.

Most shades are translucent, with the cloth or paper itself modelled as the emitter, without a bulb. Opaque
shades hide their bulb from most cameras.
"""

from __future__ import annotations

import math

import numpy as np

from datagen.foundation.random import Draws
from datagen.parametric.items import Item, Lamp, LampPlace
from datagen.parametric.shapes import Point, ball, box, cylinder, lathe, middles, rounded_box, tube

_WARM = (2500.0, 3100.0)  # colour temperatures of incandescent, halogen and warm LED lamps [K]
_COOL = (3500.0, 5000.0)  # colour temperatures in offices and workshops [K]
_THIN = 0.0025
_TRANSLUCENT = 0.75
"""Probability that a shade is translucent."""
_TRANSMITTED = 0.7
"""Share of a bulb's flux that leaves a translucent shade."""


def _bulb(item: Item, slot: str, at: Point, kelvin: float, lumen: float, radius: float) -> None:
    item.add(slot, ball(radius, (at[0], at[1], at[2] - radius), 12))
    item.lamps.append(Lamp(slot, kelvin, lumen, 4 * math.pi * radius**2))


def _shade(item: Item, slot: str, at: Point, low: float, high: float, height: float) -> None:
    """Add an open shade with its lower rim at ``at`` and radii ``low`` (bottom) and ``high`` (top)."""
    t = _THIN
    profile = [(low, 0), (high, height), (high - t, height), (low - t, 0), (low, 0)]
    item.add(slot, lathe(profile, at, 32))


def _shaded(
    item: Item,
    draws: Draws,
    slot: str,
    shade: tuple[Point, float, float, float],
    bulb: tuple[Point, float],
    kelvin: float,
    lumen: float,
) -> None:
    """Add a luminous ``shade`` (:func:`_shade` arguments), or an opaque one and ``bulb`` (centre, radius)."""
    if not draws.chance(_TRANSLUCENT):
        _shade(item, "shade", *shade)
        _bulb(item, slot, bulb[0], kelvin, lumen, bulb[1])
        return
    _, low, high, height = shade
    _shade(item, slot, *shade)
    both_sides = 2 * math.pi * (low + high) * math.hypot(low - high, height)
    item.lamps.append(Lamp(slot, kelvin, _TRANSMITTED * lumen, both_sides))


def _wires(item: Item, y: float, top: float, low: float, reach: float, radius: float) -> None:
    """Add three wires from a pole at (0, y), ``top`` metres high, to a shade ``reach`` metres away."""
    for angle in (0.3, 2.4, 4.5):
        end = (reach * math.cos(angle), y + reach * math.sin(angle), low)
        item.add("metal", tube([(0, y, top), end], radius, 4))


def ceiling_disc(draws: Draws, slot: str) -> Item:
    """Make a flat opal ceiling lamp."""
    item = Item("ceiling_lamp", hold="ceiling")
    r = draws.uniform(0.16, 0.26)
    item.add("metal", cylinder(r + 0.008, 0.03, (0, 0, -0.03), 36, 0.003))
    dome = [(r * math.cos(a), -0.032 - 0.045 * math.sin(a)) for a in np.linspace(math.pi / 2, 0, 7)]
    item.add(slot, lathe([*dome, (0, -0.032)], segments=36))
    item.lamps.append(Lamp(slot, draws.uniform(*_WARM), draws.uniform(1500, 2600), math.pi * r**2))
    s = 0.62 * r
    item.places.append(LampPlace((0, 0, -0.085), (2 * s, 2 * s)))
    return item


def pendant(draws: Draws, slot: str, drop: float, is_globe: bool = False) -> Item:
    """Make a lamp that hangs ``drop`` metres below the ceiling: a shade with a bulb, or an opal globe."""
    item = Item("pendant", hold="ceiling")
    item.add("metal", cylinder(0.05, 0.025, (0, 0, -0.025), 20, 0.005))
    kelvin = draws.uniform(*_WARM)
    kind = "globe" if is_globe else draws.choice(("cone", "drum", "bell"))
    if kind == "globe":
        r = draws.uniform(0.1, 0.17)
        item.add("dark", tube([(0, 0, -0.024), (0, 0, -drop + 2 * r + 0.04)], 0.003, 6))
        item.add("metal", cylinder(0.03, 0.05, (0, 0, -drop + 2 * r - 0.006), 16, 0.004))
        item.add(slot, ball(r, (0, 0, -drop), 24))
        item.lamps.append(Lamp(slot, kelvin, draws.uniform(600, 1100), 4 * math.pi * r**2))
        item.places.append(LampPlace((0, 0, -drop - 0.07)))
        return item
    low = draws.uniform(0.15, 0.26)
    h = draws.uniform(0.14, 0.26)
    high = {"cone": 0.05, "drum": low - 0.01, "bell": 0.45 * low}[kind]
    item.add("dark", tube([(0, 0, -0.024), (0, 0, -drop + h - 0.02)], 0.003, 6))
    item.add("metal", cylinder(0.02, 0.07, (0, 0, -drop + h - 0.075), 12, 0.003))
    if kind == "drum":
        for angle in (0.0, 2.1, 4.2):
            end = ((high - 0.001) * math.cos(angle), (high - 0.001) * math.sin(angle), -drop + h - 0.02)
            item.add("metal", tube([(0, 0, -drop + h - 0.03), end], 0.002, 4))
    else:
        item.add("metal", cylinder(high + 0.003, 0.01, (0, 0, -drop + h - 0.004), 20))
    bulb = ((0, 0, -drop + h - 0.105), 0.03)
    _shaded(item, draws, slot, ((0, 0, -drop), low, high, h), bulb, kelvin, draws.uniform(700, 1300))
    item.places.append(LampPlace((0, 0, -drop + 0.03), (0.9 * low, 0.9 * low)))
    return item


def panel(draws: Draws, slot: str) -> Item:
    """Make a flat office ceiling luminaire."""
    item = Item("panel_lamp", hold="ceiling")
    length, w = 1.2, draws.uniform(0.25, 0.6)
    item.add("metal", box((length + 0.03, w + 0.03, 0.055), (0, 0, -0.055), 0.004))
    item.add(slot, box((length, w, 0.006), (0, 0, -0.0605), 0.001))
    item.lamps.append(Lamp(slot, draws.uniform(*_COOL), draws.uniform(3000, 4500), length * w))
    item.places.append(LampPlace((0, 0, -0.064), (length * 0.95, w * 0.95)))
    return item


def batten(draws: Draws, slot: str) -> Item:
    """Make a fluorescent tube on a ceiling batten."""
    item, length = Item("batten_lamp", hold="ceiling"), 1.5
    item.add("radiator", box((length, 0.07, 0.05), (0, 0, -0.05), 0.006))
    item.pair("radiator", length / 2 - 0.02, box((0.03, 0.05, 0.05), (0, 0, -0.098), 0.004))
    item.add(slot, tube([(-length / 2 + 0.036, 0, -0.078), (length / 2 - 0.036, 0, -0.078)], 0.014, 12))
    item.places.append(LampPlace((0, 0, -0.1), (0.9 * length, 0.06)))
    area = 2 * math.pi * 0.014 * length
    item.lamps.append(Lamp(slot, draws.uniform(*_COOL), draws.uniform(2800, 4200), area))
    return item


def spots(draws: Draws, slot: str) -> Item:
    """Make a ceiling rail with three or four spotlights."""
    item, length = Item("spots", hold="ceiling"), 1.2
    item.add("metal", box((length, 0.034, 0.03), (0, 0, -0.03), 0.004))
    count = draws.integer(3, 4)
    for x in middles(length, count):
        item.add("metal", tube([(x, 0, -0.028), (x, 0, -0.075)], 0.008, 8))
        tilt, turn = draws.uniform(10, 40), draws.uniform(0, 360)
        profile = [(0, 0.02), (0.029, 0.02), (0.031, 0.0), (0.034, 0.0), (0.032, 0.09), (0.02, 0.1)]
        body = lathe(profile, segments=18)
        glass = cylinder(0.0285, 0.004, (0, 0, 0.012), 16, 0.0005)
        for name, shape in (("metal", body), (slot, glass)):
            item.add(name, shape.moved(0, 0, -0.09).turned("x", tilt).turned("z", turn).moved(x, 0, -0.08))
    item.places.append(LampPlace((0, 0, -0.2), (0.9 * length, 0.06)))
    kelvin, lumen = draws.uniform(2700, 3500), 420.0
    item.lamps.append(Lamp(slot, kelvin, lumen * count, count * math.pi * 0.0285**2))
    return item


def floor_lamp(draws: Draws, slot: str) -> Item:
    """Make a floor lamp of a foot, a pole and a shade."""
    item = Item("floor_lamp")
    c, h = -0.22, draws.uniform(1.45, 1.65)
    foot = [(0, 0), (0.14, 0), (0.14, 0.012), (0.132, 0.02), (0.02, 0.03), (0, 0.03)]
    item.add("metal", lathe(foot, (0, c, 0), 28))
    if draws.chance(0.3):
        for k in range(3):
            dx, dy = math.cos(2 * math.pi * k / 3 + 0.5), math.sin(2 * math.pi * k / 3 + 0.5)
            leg = [(0.2 * dx, c + 0.2 * dy, 0.002), (0.015 * dx, c + 0.015 * dy, h - 0.24)]
            item.add("wood", tube(leg, 0.013, 8))
    item.add("metal", tube([(0, c, 0.02), (0, c, h - 0.14)], 0.011, 10))
    low, high = draws.uniform(0.17, 0.21), draws.uniform(0.12, 0.17)
    _wires(item, c, h - 0.25, h - 0.279, low - 0.004, 0.0022)
    kelvin, lumen = draws.uniform(*_WARM), draws.uniform(500, 900)
    _shaded(item, draws, slot, ((0, c, h - 0.28), low, high, 0.28), ((0, c, h - 0.11), 0.03), kelvin, lumen)
    item.places.append(LampPlace((0, c, h - 0.04)))
    return item


def table_lamp(draws: Draws, slot: str) -> Item:
    """Make a table lamp of a foot and a small shade."""
    item = Item("table_lamp", hold="surface")
    h, c = draws.uniform(0.36, 0.5), -0.14
    if draws.chance(0.6):
        r = draws.uniform(0.05, 0.085)
        belly = [(0, 0), (0.75 * r, 0), (0.8 * r, 0.006), (r, 0.3 * h), (0.75 * r, 0.45 * h)]
        neck = [(0.2 * r, 0.52 * h), (0.012, 0.54 * h), (0, 0.54 * h)]
        item.add("pot", lathe([*belly, *neck], (0, c, 0), 28))
    else:
        body = [(0, 0), (0.075, 0), (0.075, 0.012), (0.01, 0.018), (0.009, 0.54 * h), (0, 0.54 * h)]
        item.add("metal", lathe(body, (0, c, 0), 28))
    item.add("metal", tube([(0, c, 0.53 * h), (0, c, 0.7 * h)], 0.006, 8))
    low, high = draws.uniform(0.1, 0.135), draws.uniform(0.07, 0.1)
    _wires(item, c, 0.62 * h, 0.581 * h, low - 0.003, 0.0018)
    kelvin, lumen = draws.uniform(*_WARM), draws.uniform(250, 500)
    shade = ((0, c, 0.58 * h), low, high, 0.42 * h)
    _shaded(item, draws, slot, shade, ((0, c, 0.78 * h), 0.024), kelvin, lumen)
    item.places.append(LampPlace((0, c, 0.93 * h)))
    return item


def desk_lamp(draws: Draws, slot: str) -> Item:
    """Make a lamp on a jointed arm."""
    item = Item("desk_lamp", hold="surface")
    c = -0.12
    item.add("metal", cylinder(0.085, 0.02, (0, c, 0), 28, 0.005))
    item.add("metal", tube([(0, c, 0.015), (0.1, c, 0.26)], 0.007, 8))
    item.add("metal", tube([(0.1, c - 0.008, 0.255), (-0.1, c - 0.06, 0.44)], 0.007, 8))
    head = lathe(
        [(0.06, 0), (0.022, 0.1), (0, 0.1), (0, 0.097), (0.02, 0.097), (0.0575, 0), (0.06, 0)], segments=24
    )
    item.add("shade", head.turned("x", -12).moved(-0.1, c - 0.075, 0.35))
    _bulb(item, slot, (-0.1, c - 0.07, 0.39), draws.uniform(2700, 4200), draws.uniform(300, 500), 0.02)
    return item


def wall_lamp(draws: Draws, slot: str) -> Item:
    """Make a wall lamp: an opal bar, or an opal globe on an arm; z = 0 is its middle."""
    item = Item("wall_lamp", hold="wall")
    if draws.chance(0.5):
        item.add("metal", box((0.1, 0.03, 0.06), (0, -0.0155, -0.03), 0.004))
        item.add("metal", rounded_box((0.5, 0.03, 0.02), 0.006, (0, -0.045, 0.012), 2))
        item.add(slot, tube([(-0.24, -0.05, -0.006), (0.24, -0.05, -0.006)], 0.017, 12))
        item.lamps.append(Lamp(slot, draws.uniform(2700, 4000), 900, 2 * math.pi * 0.017 * 0.48))
    else:
        item.add("metal", cylinder(0.05, 0.02, bevel=0.004).turned("x", 90).moved(0, -0.0005, 0))
        item.add("metal", tube([(0, -0.018, 0), (0, -0.09, 0), (0, -0.1, 0.02)], 0.008, 8))
        item.add(slot, ball(0.06, (0, -0.1, 0.015), 18))
        item.lamps.append(Lamp(slot, draws.uniform(*_WARM), 500, 4 * math.pi * 0.06**2))
    return item

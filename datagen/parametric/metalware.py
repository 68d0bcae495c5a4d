# SPDX-License-Identifier: MIT
"""Makes furniture of sheet metal and tubes: bins, trolleys, lockers."""

from __future__ import annotations

from datagen.formats.asset import SupportKind
from datagen.foundation.random import Draws
from datagen.parametric.items import Item, Style
from datagen.parametric.seating import castor
from datagen.parametric.shapes import box, lathe, tube


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
    for x in (-w / 2 + 0.02, w / 2 - 0.02):
        for y in (-0.03, -d + 0.01):
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

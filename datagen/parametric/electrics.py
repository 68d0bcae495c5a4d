# SPDX-License-Identifier: MIT
"""Places light switches at doors, and sockets along the walls."""

from __future__ import annotations

from datagen.foundation.random import Draws
from datagen.parametric.items import Item
from datagen.parametric.layout import Furnisher
from datagen.parametric.shapes import box, cylinder
from datagen.parametric.shell import CASING_M, WALLS

_PLATE_M = 0.082
_SWITCH_M, _LOW_M, _HIGH_M = 1.05, 0.27, 1.12  # heights of switches, sockets, sockets above tables
_CLEAR_M = 0.02  # distance from the casings of doors and windows


def switch(gangs: int) -> Item:
    """Make a switch with ``gangs`` (1 or 2) rockers side by side; z = 0 is its lower edge."""
    item = Item("switch", hold="wall")
    item.add("switch", box((_PLATE_M, 0.009, _PLATE_M), (0, -0.005, 0), 0.002))
    width = 0.06 / gangs - 0.001
    for k in range(gangs):
        x = (k - (gangs - 1) / 2) * (width + 0.001)
        item.add("switch", box((width, 0.0045, 0.06), (x, -0.0115, 0.011), 0.001))
    return item


def socket(count: int) -> Item:
    """Make a row of ``count`` sockets, each with a round face and two holes; z = 0 is its lower edge."""
    item = Item("socket", hold="wall")
    item.add("switch", box((count * _PLATE_M, 0.009, _PLATE_M), (0, -0.005, 0), 0.002))
    for k in range(count):
        x = (k - (count - 1) / 2) * _PLATE_M
        face = cylinder(0.0215, 0.002, bevel=0.0004).turned("x", 90)
        item.add("switch", face.moved(x, -0.0093, _PLATE_M / 2))
        for side in (-1, 1):
            hole = cylinder(0.0026, 0.0012, segments=8).turned("x", 90)
            item.add("dark", hole.moved(x + 0.0095 * side, -0.0102, _PLATE_M / 2))
    return item


def wire(room: Furnisher, draws: Draws) -> None:
    """Place a switch at the handle of each door, else at its hinges, and up to five sockets.

    Switches and sockets may be behind furniture.
    """
    shell = room.shell
    item = switch(draws.choice((1, 1, 2)))
    reach = CASING_M + _CLEAR_M + _PLATE_M / 2 + draws.uniform(0.03, 0.1)
    for door in shell.doors:
        for side in (-door.hinge, door.hinge):
            s = door.s + side * (door.width / 2 + reach)
            if room.hang(item, _SWITCH_M, [door.wall], s, _CLEAR_M, is_slim=True) is not None:
                break
    for _ in range(draws.integer(2, 5)):
        wall, z = draws.choice(WALLS), _HIGH_M if draws.chance(0.25) else _LOW_M
        plates = socket(draws.choice((1, 2)))
        half = shell.length(wall) / 2 - 0.15
        room.hang(plates, z, [wall], draws.uniform(-half, half), _CLEAR_M, is_slim=True)

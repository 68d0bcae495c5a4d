# SPDX-License-Identifier: GPL-3.0-or-later
"""A kitchen of 4.2 x 3.6 m: units along the north wall under a window, a table for four."""

from __future__ import annotations

from scenes.sources.environments import decor, fixtures, furniture, storage
from scenes.sources.environments.room import Room

TOP, DEEP = 0.9, 0.62


def kitchen(room: Room) -> None:
    w = room.builder
    _units(room)
    _table(room)
    decor.radiator(room, "west", 0.2, width=0.8, height=0.6)
    for k, (s, z, art) in enumerate(((-0.55, 1.55, "art_blocks"), (0.15, 1.6, "art_landscape"))):
        decor.picture(w, f"picture_{k}", size=(0.4, 0.52), art=art)
        room.place("south", f"picture_{k}", s - 0.2, z=z)
    decor.pendant(room, -0.35, -0.55, drop=0.85, radius=0.2, slot_m=0.22)
    decor.ceiling_light(room, 0.5, 0.65, radius=0.17, slot_m=0.22)
    _shelves(room)
    w.build(room.collection)
    room.surface_at("floor", "floor", (1.4, -0.7), (0.8, 1.4), 0.0, 2.2)


def _units(room: Room) -> None:
    w = room.builder
    # from the left: drawers, sink unit, oven, cupboard; the fridge is free-standing on the right
    layout = (
        ("drawers", -1.75, 0.7, 1, (0.3, 0.33, 0.37)),
        ("sink_unit", -0.95, 0.9, 2, (1.0,)),
        ("cupboard", 0.75, 1.3, 3, (0.26, 0.74)),
    )
    for name, s, width, columns, rows in layout:
        size = (width, 0.58, TOP - 0.038)
        storage.cabinet(w, name, size, columns, rows, slot="units", plinth=0.1, top_thick=0)
        room.place("north", name, s)
    room.add("oven_case", "north", -0.2)
    room.add("oven", "north", -0.2, z=0.243)
    room.add("worktop", "north", -0.34)
    w["sink", "sink"] += fixtures.basin_shape(0.5, 0.38, 0.17)
    room.place("north", "sink", -0.95, gap=0.32, z=TOP)
    fixtures.tap(w, "tap", "hardware")
    room.place("north", "tap", -0.95, gap=0.085, z=TOP)
    room.add("hob", "north", -0.2, gap=0.31, z=TOP)
    room.add("splashback", "north", -0.34)
    room.add("splash_high", "north", 0.0)
    room.add("fridge", "north", 1.76, gap=0.02)
    fixtures.wall_cupboard(w, "upper_left", width=1.3, height=0.72, depth=0.34, columns=3)
    room.place("north", "upper_left", -1.43, z=1.48)
    for name, s, width in (("counter left", -1.66, 0.78), ("counter right", 0.78, 1.15)):
        room.surface(name, "counter", "north", s, width, 0.09, 0.56, TOP, 0.5)
    room.surface("fridge top", "shelf", "north", 1.76, 0.5, 0.06, 0.5, 1.87, 0.5)


def _table(room: Room) -> None:
    w = room.builder
    furniture.table(w, "table", size=(1.3, 0.8), height=0.74, leg=0.07)
    w.place("table", -0.35, -0.55)
    room.surface_at("table", "table", (-0.35, -0.55), (1.2, 0.7), 0.74, 0.9)
    furniture.chair(w)
    for x, y, degrees in ((-0.68, -1.12, 180.0), (0.02, -1.16, 176.0), (-0.7, 0.0, 4.0), (0.05, 0.02, -5.0)):
        w.place("chair", x, y, 0, degrees)


def _shelves(room: Room) -> None:
    w = room.builder
    for k, z in enumerate((1.35, 1.7)):
        room.add("wall_board", "east", 0.55, z=z, part=f"shelf_{k}")
        room.surface(f"wall shelf {k}", "shelf", "east", 0.55, 0.92, 0.02, 0.2, z, 0.3)
    room.add("wall_clock", "east", -0.75, z=1.85)
    decor.blind(w, -0.055, 2.05, 2.39, 0.34, 0.024)
    room.place("north", "blind", 0.1)

# SPDX-License-Identifier: GPL-3.0-or-later
"""A kitchen of 4.2 x 3.6 m: units along the north wall under a window, a table for four."""

from __future__ import annotations

import bpy

from scenes.sources.environments import decor, furniture, kitchen_furniture, storage
from scenes.sources.environments.room import Door, Room, Window
from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import box, lathe, tube

TOP, DEEP = 0.9, 0.62


def kitchen(w: PartBuilder, collection: bpy.types.Collection) -> None:
    windows = (Window("north", 0.1, 1.5, 1.06, 1.1, (2, 1)), Window("west", 0.2, 1.1, 0.9, 1.25, (2, 1)))
    room = Room(w, collection, 4.2, 3.6, 2.55, windows, (Door("south", 1.35),))
    room.build_shell()
    _units(room)
    _table(room)
    decor.radiator(room, "west", 0.2, width=0.8, height=0.6)
    for k, (s, z, art) in enumerate(((-0.55, 1.55, "art_blocks"), (0.15, 1.6, "art_landscape"))):
        decor.picture(w, f"picture_{k}", size=(0.4, 0.52), art=art)
        room.place("south", f"picture_{k}", s - 0.2, z=z)
    decor.pendant(room, -0.35, -0.55, drop=0.85, radius=0.2, slot_m=0.22)
    decor.ceiling_light(room, 0.5, 0.65, radius=0.17, slot_m=0.22)
    _shelves(room)
    w.build(collection)
    room.surface_at("floor", "floor", (1.4, -0.7), (0.8, 1.4), 0.0, 2.2)
    room.camera_region("between", (-1.9, 0.4, 0.02), (1.35, 0.95, 1.95))
    room.camera_region("door side", (0.95, -1.7, 0.02), (1.75, 0.2, 2.3))
    room.camera_region("west side", (-1.8, -1.7, 0.02), (-1.45, 0.6, 2.3))
    room.camera_region("over the table", (-1.5, -1.3, 0.93), (1.3, 0.95, 1.62))


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
    w["oven_case", "units"] += [
        box((0.6, 0.54, 0.24), (0, -0.27, 0.1), 0.002),
        box((0.58, 0.5, 0.1), (0, -0.25, 0), 0.001),
        box((0.6, 0.53, TOP - 0.038 - 0.34), (0, -0.265, 0.34), 0.002),
    ]
    kitchen_furniture.oven(w, height=TOP - 0.038 - 0.245)
    room.place("north", "oven_case", -0.2)
    room.place("north", "oven", -0.2, z=0.243)
    kitchen_furniture.worktop(w, 3.52, DEEP, TOP, (-0.61, -0.32, 0.5, 0.38))
    room.place("north", "worktop", -0.34)
    w["sink", "sink"] += kitchen_furniture.basin_shape(0.5, 0.38, 0.17)
    room.place("north", "sink", -0.95, gap=0.32, z=TOP)
    kitchen_furniture.tap(w, "tap", "hardware")
    room.place("north", "tap", -0.95, gap=0.085, z=TOP)
    kitchen_furniture.hob(w)
    room.place("north", "hob", -0.2, gap=0.31, z=TOP)
    w["splashback", "splashback"] += box((3.52, 0.012, 0.16 - 0.002), (0, -0.006, TOP), 0.001, grain=0)
    room.place("north", "splashback", -0.34)
    for left, right in ((-2.1, -0.75), (0.95, 1.42)):
        w["splash_high", "splashback"] += box(
            (right - left, 0.012, 0.42), ((left + right) / 2, -0.006, TOP + 0.16), 0.001, grain=0
        )
    room.place("north", "splash_high", 0.0)
    kitchen_furniture.fridge(w)
    room.place("north", "fridge", 1.76, gap=0.02)
    kitchen_furniture.wall_cupboard(w, "upper_left", width=1.3, height=0.72, depth=0.34, columns=3)
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
        w[f"shelf_{k}", "shelf"] += box((1.0, 0.22, 0.026), (0, -0.11, -0.026), 0.004, 2, grain=0)
        for x in (-0.38, 0.38):
            w[f"shelf_{k}", "hardware"] += [
                tube([(x, -0.006, -0.16), (x, -0.006, -0.03), (x, -0.19, -0.03)], 0.006, 8),
                tube([(x, -0.006, -0.14), (x, -0.15, -0.03)], 0.005, 8),
            ]
        room.place("east", f"shelf_{k}", 0.55, z=z)
        room.surface(f"wall shelf {k}", "shelf", "east", 0.55, 0.92, 0.02, 0.2, z, 0.3)
    outside = [(0, -0.03), (0.14, -0.03), (0.155, -0.024), (0.16, -0.012), (0.152, 0.002), (0.142, 0.004)]
    inside = [(0.138, -0.012), (0, -0.014)]
    clock = lathe([*outside, *inside], 48).turned("x", 90)
    w["wall_clock", "mounts"] += clock.moved(0, -0.03, 0)
    for angle, length, width in ((52.0, 0.075, 0.008), (-76.0, 0.11, 0.005)):
        w["wall_clock", "knobs"] += box((width, 0.003, length), (0, 0, -0.012), 0.001).turned(
            "y", angle, (0, -0.0195, 0)
        )
    room.place("east", "wall_clock", -0.75, z=1.85)
    decor.blind(w, -0.055, 2.05, 2.39, 0.34, 0.024)
    room.place("north", "blind", 0.1)

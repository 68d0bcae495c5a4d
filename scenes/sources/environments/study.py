# SPDX-License-Identifier: GPL-3.0-or-later
"""A study of 3.8 x 3.2 m: desk at the window, bookcase, reading chair and many books."""

from __future__ import annotations

import numpy as np

from scenes.sources.environments import decor, furniture, storage
from scenes.sources.environments.room import Room
from scenes.sources.shapes import box, cylinder, frame, lathe, soft_box, tube


def study(room: Room) -> None:
    w = room.builder
    _desk(room)
    _bookcase(room)
    furniture.sofa(
        w, "armchair", width=0.86, seats=1, depth=0.84, cover="armchair", legs="armchair_legs", seed=5
    )
    w.place("armchair", 1.32, -0.98, 0, -128)
    decor.rug(w, "rug", "rug", (1.9, 1.3), (0.0, -0.55), seed=4)
    decor.radiator(room, "east", 0.2, width=0.7, height=0.55)
    _board(room)
    decor.picture(w, "picture", size=(0.62, 0.44), art="art_dusk")
    room.place("south", "picture", -0.55, z=1.6)
    decor.blind(w, -0.05, 1.86, 2.29, 0.42, 0.022)
    room.place("north", "blind", -0.45)
    decor.ceiling_light(room, 0.0, -0.1, radius=0.2, slot_m=0.26)
    decor.floor_lamp(room, 1.55, -0.2, height=1.5)
    decor.plant(w, height=1.05, seed=9, pot_radius=0.14, leaves=24)
    w.place("plant", 1.5, 1.22)
    w.build(room.collection)
    room.surface_at("floor", "floor", (-0.35, -0.75), (1.1, 0.7), 0.0115, 2.2)


def _desk(room: Room) -> None:
    w = room.builder
    room.add("desk", "north", -0.45, gap=0.06)
    rows = (1, 1, 1.6)
    storage.cabinet(w, "drawers", (0.42, 0.52, 0.56), 1, rows, plinth=0.03, top_thick=0.012, overhang=0.0)
    room.place("north", "drawers", 0.02, gap=0.16)
    room.surface("desk", "table", "north", -0.45, 1.5, 0.10, 0.76, 0.745, 0.9)
    # office chair: five-star base, column, padded seat and back
    for k in range(5):
        a = 2 * np.pi * k / 5 + 0.3
        end = (0.29 * np.cos(a), 0.29 * np.sin(a))
        path = [(0, 0, 0.1), (end[0] * 0.5, end[1] * 0.5, 0.088), (*end, 0.066)]
        w["chair", "chair_base"] += tube(path, [0.023, 0.019, 0.015], 10, smooth=3)
        w["chair", "castors"] += [
            cylinder(0.026, 0.016, (0, 0, -0.017), 0.004, 20)
            .turned("x", 90)
            .turned("z", float(np.degrees(a)) + 25, (*end, 0.0262)),
            cylinder(0.009, 0.05, (*end, 0.026), 0.002, 12),
        ]
    w["chair", "chair_base"] += [
        cylinder(0.026, 0.2, (0, 0, 0.09), 0.003),
        cylinder(0.017, 0.16, (0, 0, 0.26), 0.002),
        box((0.2, 0.2, 0.03), (0, 0, 0.405), 0.008, 2),
    ]
    w["chair", "chair_shell"] += soft_box(
        (0.5, 0.48, 0.085), (0, 0, 0.43), 0.04, (0.004, 0.004, 0.016), 11, 0.001, 3
    )
    w["chair", "chair_shell"] += (
        soft_box((0.46, 0.09, 0.56), (0, 0, 0), 0.042, (0.004, 0.02, 0.006), 11, 0.001, 4)
        .bent(lambda p: p + np.column_stack([0 * p[:, 0], -0.06 * (p[:, 0] / 0.23) ** 2, 0 * p[:, 0]]))
        .turned("x", -9, (0, 0.255, 0.56))
    )
    w["chair", "chair_base"] += tube(
        [(0, 0.06, 0.415), (0, 0.26, 0.42), (0, 0.315, 0.5), (0, 0.34, 0.72)], 0.018, 12, smooth=4
    ).scaled(1.6, 1, 1)
    for side in (-1, 1):
        w["chair", "castors"] += soft_box(
            (0.06, 0.26, 0.028), (side * 0.285, 0.0, 0.65), 0.012, (0, 0, 0.002), 6
        )
        arm = ((0.16, 0.02, 0.42), (0.27, 0.02, 0.43), (0.29, 0.02, 0.5), (0.287, 0.0, 0.66))
        w["chair", "chair_base"] += tube([(side * x, y, z) for x, y, z in arm], 0.011, 10, smooth=4)
    w.place("chair", -0.75, 0.28, 0, 164)
    room.add("bin")
    w.place("bin", 0.52, 1.32)


def _bookcase(room: Room) -> None:
    w = room.builder
    levels = (0.09, 0.42, 0.75, 1.08, 1.41, 1.74)
    storage.shelf_unit(w, "bookcase", (2.1, 0.29, 2.08), levels, columns=3, slot="bookcase")
    room.place("west", "bookcase", 0.2, gap=0.004)
    step = (2.1 - 0.022) / 3
    bay = step - 0.022
    for k, z in enumerate(levels):
        for column in range(3):
            left = -1.05 + 0.022 + column * step
            share = (0.95, 0.62, 0.9, 0.0, 0.85, 0.5, 0.95)[(2 * k + 3 * column) % 7]
            if share:
                start, seed = (left + 0.005, -0.275 + 0.19, z + 0.0005), 100 + 10 * k + column
                storage.book_row(w, storage.BOOKS, start, share * bay, height=0.3, seed=seed)
            free = bay * (1 - share) - (0.09 if share else 0.02)
            if free > 0.13:
                name, s = f"bookcase {k}.{column}", 0.2 + left + bay - free / 2 - 0.012
                room.surface(name, "shelf", "west", s, free - 0.01, 0.03, 0.27, z, 0.29)
    room.place("west", "books", 0.2, gap=0.004)


def _board(room: Room) -> None:
    w = room.builder
    w["board", "board"] += box((0.8, 0.012, 0.56), (0, -0.007, 0), 0.002, grain=0)
    w["board", "bookcase"] += frame(0.86, 0.62, 0.03, 0.022, (0, -0.011, -0.03), segments=2)
    rng = np.random.default_rng(3)
    for k in range(7):
        size = ((0.075, 0.075), (0.105, 0.148), (0.1, 0.07))[k % 3]
        sheet = box((size[0], 0.0006, size[1]), bevel=0).turned("y", float(rng.uniform(-6, 6)))
        x, z = -0.3 + 0.1 * k, 0.06 + 0.3 * (k % 2) + float(rng.uniform(-0.02, 0.03))
        w["board", "note_b" if k % 3 == 0 else "note_a"] += sheet.moved(x, -0.0138 - 0.0008 * (k % 2), z)
        w["board", "castors"] += lathe([(0, 0), (0.005, 0.001), (0.004, 0.006), (0, 0.007)], 10).turned(
            "x", 90, (x, -0.0145, z + size[1] * 0.9)
        )
    room.place("east", "board", -0.85, z=1.25)
    room.add("wall_shelf", "south", -0.55, z=1.2)
    room.surface("wall shelf", "shelf", "south", -0.55, 0.84, 0.02, 0.18, 1.224, 0.12)

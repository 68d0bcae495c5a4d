# SPDX-License-Identifier: GPL-3.0-or-later
"""A living room of 5.2 x 4.4 m with two windows to the east."""

from __future__ import annotations

from scenes.sources.environments import decor, furniture, storage
from scenes.sources.environments.room import Room


def living_room(room: Room) -> None:
    w = room.builder
    for k, window in enumerate(room.windows):
        room.curtains(window, "curtains", open_share=0.6, seed=k)
    decor.radiator(room, "east", 0.95, width=0.9, height=0.38)
    _seating(room)
    _tables(room)
    _storage(room)
    for k, (wall, s, z, art, size) in enumerate((
        ("south", 0.95, 1.62, "art_landscape", (0.7, 0.5)), ("south", 0.15, 1.62, "art_blocks", (0.42, 0.56)), ("north", 1.75, 1.55, "art_dusk", (0.5, 0.66)),
    )):  # fmt: skip
        decor.picture(w, f"picture_{k}", size=size, art=art)
        room.place(wall, f"picture_{k}", s, z=z)
    decor.pendant(room, -0.4, -0.2, drop=0.55, radius=0.24, slot_m=0.26)
    decor.floor_lamp(room, -2.2, -1.72)
    decor.plant(w, height=1.3, seed=2, pot_radius=0.17, leaves=30)
    w.place("plant", 2.1, 1.8)
    w.build(room.collection)
    room.surface_at("floor east", "floor", (1.3, 0.0), (0.8, 1.5), 0.0, 2.2)
    room.surface_at("floor west", "floor", (-2.15, -0.5), (0.7, 1.1), 0.0, 2.2)


def _seating(room: Room) -> None:
    w = room.builder
    furniture.sofa(w, "sofa", cushions=("cushion_a", "cushion_b"), seed=1)
    room.place("south", "sofa", 0.55, gap=0.03)
    room.surface("sofa seat", "seat", "south", 0.55, 0.7, 0.52, 0.86, 0.455, 1.2)
    furniture.sofa(w, "armchair", width=0.92, seats=1, depth=0.86, cover="armchair", seed=7)
    w.place("armchair", 1.75, 1.72, 0, -38)
    decor.rug(w, "rug", "rug", (2.6, 1.9), (-0.45, -0.35), border="rug_border", seed=3)


def _tables(room: Room) -> None:
    w = room.builder
    furniture.table(
        w, "coffee_table", size=(1.15, 0.62), height=0.42, leg=0.055, shelf=0.16, round_corner=0.05
    )
    w.place("coffee_table", -0.5, -0.3, 0.011)
    room.surface_at("coffee table", "table", (-0.5, -0.3), (1.05, 0.54), 0.431, 1.0)
    room.surface_at("coffee table shelf", "shelf", (-0.5, -0.3), (0.8, 0.34), 0.171, 0.13)
    room.add("side_table")
    w.place("side_table", 0.85, -1.72)
    room.surface_at("side table", "table", (0.85, -1.72), (0.3, 0.3), 0.522, 1.2)


def _storage(room: Room) -> None:
    w = room.builder
    storage.cabinet(w, "sideboard", (1.9, 0.42, 0.55), 3, (0.4, 0.6), plinth=0.1)
    room.place("north", "sideboard", -0.5, gap=0.005)
    room.add("tv", "north", -0.62, z=0.55)
    for name, s, width in (("left", -1.32, 0.2), ("right", 0.22, 0.4)):
        room.surface(f"sideboard {name}", "table", "north", s, width, 0.04, 0.38, 0.55, 1.0)
    levels = (0.09, 0.44, 0.80, 1.16, 1.52)
    storage.shelf_unit(w, "bookcase", (1.7, 0.3, 1.9), levels, columns=2)
    room.place("west", "bookcase", 0.95, gap=0.004)
    bay, step = 0.817, 0.839
    for k, z in enumerate(levels):
        for column in range(2):
            left = -0.85 + 0.022 + column * step
            share = (0.92, 0.55, 0.0, 0.7, 0.45)[(k + 2 * column) % 5]
            if share:
                start = (left + 0.005, -0.285 + 0.19, z + 0.0005)
                storage.book_row(w, storage.BOOKS, start, share * bay, height=0.33, seed=10 * k + column)
            free = bay * (1 - share) - 0.09
            if free > 0.15:
                name, centre = f"bookcase {k}.{column}", left + bay - free / 2 - 0.015
                room.surface(name, "shelf", "west", 0.95 + centre, free - 0.02, 0.03, 0.28, z, 0.31)
    room.place("west", "books", 0.95, gap=0.004)
    room.surface("bookcase top", "shelf", "west", 0.95, 1.6, 0.03, 0.28, 1.9, 0.6)

# SPDX-License-Identifier: GPL-3.0-or-later
"""A bathroom of 3.0 x 2.6 m: bath under a high window, tiles to 1.3 m, washbasin with mirror, shelves."""

from __future__ import annotations

import numpy as np

from scenes.sources.environments import decor, fixtures, storage
from scenes.sources.environments.room import Room
from scenes.sources.shapes import box, lathe, soft_box, tube

TILED = 1.3


def bathroom(room: Room) -> None:
    w = room.builder
    _tiling(room)
    fixtures.bathtub(w)
    room.place("north", "bathtub", -0.607, gap=0.014)
    fixtures.tap(w, "bath_tap", "chrome", height=0.2, reach=0.14)
    w.place("bath_tap", 0.31, 0.9, 0.56, -90)
    # a low wall with a shelf at the foot of the bath
    room.add("pier")
    w.place("pier", 0.375, 0.895)
    room.surface_at("pier", "shelf", (0.375, 0.9), (0.2, 0.74), 0.775, 0.5)
    _washing(room)
    room.add("toilet", "north", 1.05, gap=0.014)
    _storage(room)
    decor.rug(w, "mat", "mat", (0.8, 0.5), (-0.5, 0.15), seed=2)
    decor.ceiling_light(room, 0.1, -0.2, radius=0.19, slot_m=0.25, metal="chrome")
    w.build(room.collection)
    room.surface_at("floor", "floor", (-0.85, -0.8), (0.5, 0.5), 0.0, 2.0)


def _tiling(room: Room) -> None:
    w, t = room.builder, 0.012
    for wall in ("north", "east", "west", "south"):
        for low, high in room.clear_runs(wall, 0.09):
            middle, length = (high + low) / 2, high - low
            tiles = box((length, t, TILED), (middle, -t / 2, 0), 0.001, grain=0)
            edge = box((length, 0.018, 0.03), (middle, -0.009, TILED), 0.006, 3, grain=0)
            w["wall_tiles", "tiles"] += room.on_wall(wall, tiles)
            w["wall_tiles", "tile_edge"] += room.on_wall(wall, edge)


def _washing(room: Room) -> None:
    w = room.builder
    storage.cabinet(w, "vanity", (0.9, 0.44, 0.62), 2, handle="chrome", plinth=0.0)
    room.place("east", "vanity", 0.35, gap=0.014, z=0.2)
    room.add("basin", "east", 0.35, gap=0.24, z=0.82)
    fixtures.tap(w, "basin_tap", "chrome", height=0.27, reach=0.15)
    room.place("east", "basin_tap", 0.35, gap=0.045, z=0.82)
    for k, s in enumerate((0.02, 0.69)):
        room.surface(f"vanity {k}", "counter", "east", s, 0.16, 0.06, 0.42, 0.82, 0.5)
    room.add("bathroom_mirror", "east", 0.35, z=1.38, part="mirror")
    room.add("mirror_shelf")
    room.add("lamp_bar", "east", 0.35, z=2.29)
    room.place("south", "mirror_shelf", -0.6, z=1.45, gap=0.0)
    room.surface("wall shelf", "shelf", "south", -0.6, 0.64, 0.02, 0.11, 1.468, 0.4)


def _storage(room: Room) -> None:
    w = room.builder
    room.add("towel_rail", "west", 0.35, z=1.15, gap=0.014)
    fixtures.towel(w)
    room.place("west", "towel", 0.35, z=1.149, gap=0.094)
    storage.shelf_unit(w, "tall_shelf", (0.5, 0.28, 1.7), (0.12, 0.5, 0.88, 1.26), back=False)
    room.place("west", "tall_shelf", -0.85, gap=0.02)
    for k, z in enumerate((0.5, 1.26)):
        room.surface(f"tall shelf {k}", "shelf", "west", -0.85, 0.42, 0.04, 0.27, z, 0.34)
    room.surface("tall shelf top", "shelf", "west", -0.85, 0.44, 0.04, 0.27, 1.7, 0.5)
    for k, z in enumerate((0.12, 0.88)):
        for j in range(3):
            at, puff = (0, -0.15, z + 0.001 + 0.076 * j), (0.004, 0.006, 0.004)
            roll = soft_box((0.36, 0.24, 0.075), at, 0.034, puff, 9, 0.001, 5 * k + j)
            w["folded_towels", "towels" if (j + k) % 2 else "towel_white"] += roll
    room.place("west", "folded_towels", -0.85, gap=0.02)
    room.add("laundry")
    w.place("laundry", 1.2, -0.85)
    # stool
    w["stool", "stool"] += lathe(
        [(0, 0.42), (0.155, 0.42), (0.165, 0.428), (0.165, 0.445), (0.155, 0.452), (0, 0.452)], 40
    )
    for k in range(4):
        a = np.pi / 4 + k * np.pi / 2
        leg = [(0.15 * np.cos(a), 0.15 * np.sin(a), 0.003), (0.1 * np.cos(a), 0.1 * np.sin(a), 0.425)]
        w["stool", "stool"] += tube(leg, [0.012, 0.016], 10)
    w.place("stool", -1.2, -0.25)
    room.surface_at("stool", "seat", (-1.2, -0.25), (0.2, 0.2), 0.452, 0.8)

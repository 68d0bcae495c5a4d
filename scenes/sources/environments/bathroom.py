# SPDX-License-Identifier: GPL-3.0-or-later
"""A bathroom of 3.0 x 2.6 m: bath under a high window, tiles to 1.3 m, washbasin with mirror, shelves."""

from __future__ import annotations

import bpy
import numpy as np

from scenes.sources.environments import bathroom_furniture, decor, kitchen_furniture, storage
from scenes.sources.environments.room import Door, Room, Window
from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import Shape, box, lathe, loft, rounded_ring, soft_box, tube

TILED = 1.3


def bathroom(w: PartBuilder, collection: bpy.types.Collection) -> None:
    windows = (Window("north", 0.0, 1.1, 1.35, 0.85, (2, 1)),)
    room = Room(w, collection, 3.0, 2.6, 2.5, windows, (Door("south", 0.85, 0.8),))
    room.build_shell(skirting=0.0)
    _tiling(room)
    bathroom_furniture.bathtub(w)
    room.place("north", "bathtub", -0.607, gap=0.014)
    kitchen_furniture.tap(w, "bath_tap", "chrome", height=0.2, reach=0.14)
    w.place("bath_tap", 0.31, 0.9, 0.56, -90)
    # a low wall with a shelf at the foot of the bath
    w["pier", "tiles"] += box((0.2, 0.78, 0.75), (0, 0, 0), 0.002, grain=1)
    w["pier", "shelves"] += box((0.24, 0.82, 0.025), (0, 0, 0.75), 0.004, 2, grain=1)
    w.place("pier", 0.375, 0.895)
    room.surface_at("pier", "shelf", (0.375, 0.9), (0.2, 0.74), 0.775, 0.5)
    _washing(room)
    bathroom_furniture.toilet(w)
    room.place("north", "toilet", 1.05, gap=0.014)
    _storage(room)
    decor.rug(w, "mat", "mat", (0.8, 0.5), (-0.5, 0.15), seed=2)
    decor.ceiling_light(room, 0.1, -0.2, radius=0.19, slot_m=0.25, metal="chrome")
    w.build(collection)
    room.surface_at("floor", "floor", (-0.85, -0.8), (0.5, 0.5), 0.0, 2.0)
    room.camera_region("middle", (-0.5, -1.1, 0.02), (0.75, 0.3, 2.25))
    room.camera_region("west", (-1.0, -0.5, 0.02), (0.75, 0.3, 2.25))


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
    outside = [(0, 0), (0.1, 0), (0.125, 0.01), (0.185, 0.075), (0.205, 0.125), (0.206, 0.131), (0.2, 0.132)]
    inside = [(0.196, 0.126), (0.176, 0.078), (0.115, 0.022), (0.03, 0.014), (0, 0.012)]
    basin = lathe([*outside, *inside], 48)
    w["basin", "enamel"] += basin.scaled(1, 0.9, 1)
    w["basin", "chrome"] += lathe(
        [(0, 0.012), (0.022, 0.0145), (0.024, 0.017), (0.016, 0.0185), (0, 0.018)], 24
    )
    room.place("east", "basin", 0.35, gap=0.24, z=0.82)
    kitchen_furniture.tap(w, "basin_tap", "chrome", height=0.27, reach=0.15)
    room.place("east", "basin_tap", 0.35, gap=0.045, z=0.82)
    for k, s in enumerate((0.02, 0.69)):
        room.surface(f"vanity {k}", "counter", "east", s, 0.16, 0.06, 0.42, 0.82, 0.5)
    w["mirror", "mirror"] += box((0.7, 0.006, 0.85), (0, -0.004, 0), 0.002, 1)
    w["mirror", "chrome"] += box((0.716, 0.004, 0.866), (0, -0.002, -0.008), 0.001)
    room.place("east", "mirror", 0.35, z=1.38)
    w["mirror_shelf", "shelves"] += box((0.7, 0.12, 0.018), (0, -0.06, 0), 0.003, 2, grain=0)
    # the lamp bar over the mirror
    w["lamp_bar", "chrome"] += box((0.6, 0.03, 0.03), (0, -0.015, 0), 0.004, 2)
    w["lamp_bar", "lamp_shade"] += tube([(-0.27, -0.06, 0.015), (0.27, -0.06, 0.015)], 0.024, 16)
    room.place("east", "lamp_bar", 0.35, z=2.29)
    w["mirror_shelf", "chrome"] += [
        tube([(x, -0.002, -0.01), (x, -0.1, -0.004)], 0.005, 8) for x in (-0.28, 0.28)
    ]
    room.place("south", "mirror_shelf", -0.6, z=1.45, gap=0.0)
    room.surface("wall shelf", "shelf", "south", -0.6, 0.64, 0.02, 0.11, 1.468, 0.4)


def _storage(room: Room) -> None:
    w = room.builder
    bar = tube([(-0.32, -0.08, 0), (0.32, -0.08, 0)], 0.009, 12)
    ends = [tube([(x, -0.002, 0), (x, -0.08, 0)], 0.008, 10) for x in (-0.3, 0.3)]
    w["towel_rail", "chrome"] += [bar, *ends]
    room.place("west", "towel_rail", 0.35, z=1.15, gap=0.014)
    bathroom_furniture.towel(w)
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
    w["laundry", "laundry"] += _basket()
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


def _basket() -> Shape:
    rings = []
    for scale, z in (
        (0.92, 0.0),
        (0.95, 0.006),
        (1.0, 0.25),
        (1.04, 0.5),
        (1.05, 0.507),
        (1.06, 0.51),
        (1.06, 0.535),
        (0.9, 0.55),
        (0.3, 0.556),
    ):
        rings.append(rounded_ring(0.38 * scale, 0.3 * scale, 0.07 * scale, z))
    return loft(rings)

# SPDX-License-Identifier: GPL-3.0-or-later
"""A dining room of 4.6 x 3.8 m: table for six, sideboard, dresser, tall windows to the south."""

from __future__ import annotations

from scenes.sources.environments import decor, furniture, storage
from scenes.sources.environments.room import Room
from scenes.sources.shapes import box


def dining_room(room: Room) -> None:
    w = room.builder
    _panelling(room)
    for k, window in enumerate(room.windows):
        room.curtains(window, "curtains", open_share=0.66, seed=30 + k)
    decor.rug(w, "rug", "rug", (3.0, 2.1), (0.0, 0.05), border="rug_border", seed=6)
    furniture.table(w, "table", size=(1.9, 0.95), height=0.75, leg=0.085, thick=0.036)
    w.place("table", 0.0, 0.05, 0.0115)
    room.surface_at("table", "table", (0.0, 0.05), (1.8, 0.86), 0.7615, 0.85)
    furniture.chair(w)
    front = ((-0.55, -0.62, 178.0), (0.1, -0.6, 183.0), (0.68, -0.63, 174.0))
    back = ((-0.5, 0.74, -3.0), (0.12, 0.72, 2.0), (0.62, 0.9, -24.0))
    for x, y, degrees in (*front, *back):
        w.place("chair", x, y, 0.0115, degrees)
    storage.cabinet(
        w, "sideboard", (1.7, 0.46, 0.88), 3, (0.28, 0.72), top="top", handle="brass", plinth=0.1,
        panelled=True, top_thick=0.022,
    )  # fmt: skip
    room.place("north", "sideboard", 0.2, gap=0.02)
    room.surface("sideboard", "table", "north", 0.2, 1.6, 0.06, 0.44, 0.88, 0.42)
    _dresser(room)
    room.add("round_mirror", "north", 0.2, z=1.75, gap=0.002, part="mirror")
    decor.picture(w, "picture", size=(0.55, 0.7), art="art_landscape")
    room.place("east", "picture", 0.65, z=1.72, gap=0.004)
    decor.pendant(room, 0.0, 0.05, drop=1.0, radius=0.26, slot_m=0.3, metal="brass")
    for k, s in enumerate((-0.55, 0.95)):
        _sconce(room, k, s)
    decor.plant(w, height=1.15, seed=21, pot_radius=0.15, leaves=26)
    w.place("plant", -1.98, 1.55)
    w.build(room.collection)
    room.surface_at("floor", "floor", (-1.85, 0.2), (0.6, 1.2), 0.0, 2.2)


def _panelling(room: Room) -> None:
    """Add a dado rail to every wall, interrupted by the door and the windows."""
    w, z = room.builder, 0.92
    for wall in ("north", "east", "west", "south"):
        for low, high in room.clear_runs(wall, 0.09, 0.07):
            rail = box((high - low, 0.024, 0.05), ((high + low) / 2, -0.012, z), 0.008, 2, grain=0)
            w["panelling", "panelling"] += room.on_wall(wall, rail)


def _dresser(room: Room) -> None:
    w = room.builder
    storage.cabinet(w, "dresser", (1.1, 0.42, 0.9), 2, (0.3, 0.7), handle="brass", panelled=True)
    room.place("east", "dresser", -0.75, gap=0.025)
    storage.shelf_unit(w, "dresser_shelves", (1.06, 0.24, 1.15), (0.03, 0.38, 0.73), slot="dresser")
    room.place("east", "dresser_shelves", -0.75, gap=0.025, z=0.9)
    for k, z in enumerate((0.93, 1.28, 1.63)):
        room.surface(f"dresser shelf {k}", "shelf", "east", -0.75, 0.96, 0.05, 0.24, z, 0.31)
    room.surface("dresser", "table", "east", -0.75, 1.0, 0.28, 0.43, 0.9, 0.9)
    room.surface("dresser top", "shelf", "east", -0.75, 0.98, 0.05, 0.24, 2.05, 0.5)


def _sconce(room: Room, number: int, s: float) -> None:
    """Add a wall lamp at ``s`` along the north wall, next to the mirror."""
    part = f"sconce_{number}"
    room.add("sconce", "north", s, z=1.75, part=part)
    room.point_slot(f"sconce {number}", (s, room.depth / 2 - 0.115, 1.75 + 0.15))

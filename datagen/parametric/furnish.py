# SPDX-License-Identifier: MIT
"""Furnishing rules shared by many kinds of room: curtains, pictures, plants, chairs around tables, lamps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import product

from datagen.foundation.random import Draws
from datagen.parametric import fittings, lamps, seating, storage, tables
from datagen.parametric.items import Item, Placed, Style
from datagen.parametric.layout import SIDES, Furnisher, Unfit
from datagen.parametric.shapes import middles
from datagen.parametric.shell import CASING_M, WALLS

_SPACING_M = 2.5  # distance between ceiling lamps of one room
_SWITCH_M, _LOW_M, _HIGH_M = 1.05, 0.27, 1.12  # heights of switches, low sockets, sockets above tables
_CLEAR_M = 0.02  # distance of switches and sockets from the casings of doors and windows
_PICTURES_M = ((0.4, 0.5), (0.5, 0.7), (0.7, 0.5), (0.9, 0.6), (0.6, 0.8), (0.3, 0.4), (1.1, 0.75))


def _cupboard(style: Style, draws: Draws) -> Item:
    size = (draws.uniform(0.42, 0.65), 0.36, draws.uniform(0.9, 1.8))
    return storage.cabinet("cupboard", style, size, [("door", 1.0)], 1, 0.06)


def _files(style: Style, draws: Draws) -> Item:
    size = (0.45, 0.6, draws.choice((0.75, 1.3)))
    return storage.cabinet("files", style, size, [("drawer", 0.3)] * 3, 1, 0.04, ("steel", "steel"))


_EXTRAS: Mapping[str, Callable[[Style, Draws], Item]] = {
    "basket": storage.basket,
    "bin": storage.pedal_bin,
    "bench": lambda style, draws: seating.bench(style, draws, draws.uniform(0.8, 1.4), False),
    "chair": lambda style, draws: seating.chair(style, draws),
    "chest": lambda style, draws: storage.chest(style, draws, draws.uniform(0.55, 1.05)),
    "crates": fittings.crates,
    "cubes": lambda style, draws: storage.cube_shelf(style, draws, draws.integer(1, 2), draws.integer(1, 3)),
    "cupboard": _cupboard,
    "files": _files,
    "lockers": storage.lockers,
    "open_shelf": lambda style, draws: storage.bookcase(
        style, draws, draws.uniform(0.7, 1.3), draws.uniform(0.9, 2.0), 0.32, 0.3
    ),
    "bookcase": lambda style, draws: storage.bookcase(
        style, draws, draws.uniform(0.6, 1.3), draws.uniform(0.8, 2.1)
    ),
    "plant": fittings.plant,
    "pouf": fittings.pouf,
    "rack": lambda style, draws: storage.rack(style, draws, draws.uniform(0.7, 1.3)),
    "shoes": fittings.shoes,
    "sideboard": lambda style, draws: storage.sideboard(
        style, draws, draws.uniform(0.8, 1.6), draws.uniform(0.75, 0.95)
    ),
    "side_table": lambda style, draws: tables.round_table(style, draws, draws.uniform(0.4, 0.55), 0.5),
    "trolley": storage.trolley,
    "stool": lambda style, draws: seating.stool(style, draws, draws.choice((0.45, 0.6))),
}
"""Functions by name that make furniture of random size, for the walls of many kinds of room."""


def dress_windows(room: Furnisher, curtains: float, blinds: float, radiators: float) -> None:
    """Place radiators, curtains and blinds at windows, with the given probabilities.

    Curtains, blinds or neither are drawn once per room, radiators for each window with a high enough sill.
    """
    draws, style = room.draws, room.style
    pick = draws.unit()
    slatted = draws.chance(0.5)
    for window in room.shell.windows:
        below: list[Placed] = []
        if window.sill > 0.62 and draws.chance(radiators):
            height = min(0.55, window.sill - 0.28)
            item = fittings.radiator(style, draws, min(window.width, 1.6) * draws.uniform(0.65, 1.0), height)
            radiator = room.before_window(item, window, draws.uniform(0.1, 0.15))
            below = [radiator] if radiator is not None else []
        if pick < curtains:
            top = min(window.sill + window.height + draws.uniform(0.1, 0.2), room.shell.height - 0.06)
            long = draws.chance(0.7) or window.sill < 0.4
            hem = 0.03 if long else window.sill - 0.2
            off_wall = 0.165 if below else 0.125  # leaves space for a radiator
            item = fittings.curtains(style, draws, window.width, top - hem, top - hem - 0.02, off_wall)
            if room.before_window(item, window, hem, below) is not None:
                continue
        if pick < curtains + blinds:
            make = fittings.slatted_blind if slatted else fittings.roller_blind
            room.before_window(make(style, draws, window.width, window.height), window, window.sill)


def chairs_around(room: Furnisher, table: Placed, chair: Item, along: int) -> None:
    """Place ``along`` chairs at each long side of a table, and one at each end.

    Raises :class:`Unfit` if fewer than two chairs fit.
    """
    half = float(table.item.bounds[1, 0])
    made = 0
    for side, k in product(SIDES[:2], range(along)):
        offset = (k + 0.5) * 2 * half / along - half
        made += room.seat(chair, table, side, offset, 0.16) is not None
    for side in SIDES[2:]:
        made += room.seat(chair, table, side, 0.0, 0.16) is not None
    if made < 2:
        raise Unfit(f"{table.name} has no space for chairs")


def seats(room: Furnisher, count: int) -> list[Placed]:
    """Place up to ``count`` armchairs in corners or in the middle of the room."""
    found = []
    for _ in range(count):
        item = seating.sofa(room.style, room.draws, 1)
        placed = room.at_wall(item, where="corner", gap=0.14) or room.in_middle(item)
        if placed is not None:
            found.append(placed)
    return found


def lamp_on(room: Furnisher, host: Placed, x: float = 0.0) -> Placed | None:
    """Place a table lamp on the item ``host``, ``x`` metres to the right of its middle."""
    support = host.item.supports[0]
    back = max(0.02, support.size[1] / 2 - 0.16)
    return room.on(lamps.table_lamp(room.draws, room.new_name("glow")), host, x, back)


def floor_lamp_somewhere(room: Furnisher) -> Placed | None:
    """With probability 0.75, place a floor lamp in a corner or at a wall."""
    if room.draws.chance(0.75):
        return room.at_wall(lamps.floor_lamp(room.draws, room.new_name("glow")), where="corner", gap=0.05)
    return None


def plant_somewhere(room: Furnisher) -> Placed | None:
    """Place a plant in a corner or at a wall."""
    return room.at_wall(fittings.plant(room.style, room.draws), where="corner", gap=0.04)


def pictures(room: Furnisher, most: int) -> None:
    """Hang up to ``most`` pictures or pairs of pictures on free walls, at eye height."""
    draws, style = room.draws, room.style
    for _ in range(most):
        w, h = draws.choice(_PICTURES_M)
        z = 1.52 - h / 2 + draws.uniform(-0.06, 0.12)
        item = fittings.picture(style, draws, w, h, room.new_name("art"))
        first = room.hang(item, z)
        if first is not None and draws.chance(0.35):
            wall = room.wall_of(first)
            twin = fittings.picture(style, draws, w, h, room.new_name("art"))
            if wall is not None:
                along = float(first.room_from_item[:2, 0] @ first.at[:2])
                room.hang(twin, z, [wall], along + w + draws.uniform(0.05, 0.12))


def fill(room: Furnisher, names: Sequence[str], least: int, most: int) -> None:
    """Place ``least`` to ``most`` items from ``names`` along the walls, or fewer if there is no space."""
    draws = room.draws
    wanted = draws.integer(least, most)
    for name in draws.shuffled([*names, *names]):
        if wanted == 0:
            return
        item = _EXTRAS[name](room.style, draws)
        wanted -= room.at_wall(item, where="corner" if draws.chance(0.5) else "any") is not None


def decorate(
    room: Furnisher, rug: float, round_rug: float = 0.15, most: int = 5, is_home: bool = True
) -> None:
    """Place pictures, plants, perhaps a wall shelf, and perhaps a rug on the free floor.

    The number of pictures is 2 to ``most`` in homes (1 if ``most`` is 1), else 1 to 3. ``rug`` is the
    probability of a rug, ``round_rug`` the probability that it is round.
    """
    draws, style = room.draws, room.style
    if draws.chance(0.55):
        shelf = storage.wall_shelf(style, draws, draws.uniform(0.6, 1.1), draws.integer(1, 2))
        room.hang(shelf, draws.uniform(1.25, 1.5))
    pictures(room, draws.integer(min(2, most), most) if is_home else draws.integer(1, 3))
    for _ in range(draws.integer(0, 2)):
        plant_somewhere(room)
    if draws.chance(rug):
        _free_rug(room, draws.chance(round_rug))


def _free_rug(room: Furnisher, is_round: bool) -> None:
    draws, style = room.draws, room.style
    for _ in range(10):
        if is_round:
            d = draws.uniform(1.0, 1.7)
            item = fittings.rug(style, draws, d, d, True)
        else:
            item = fittings.rug(style, draws, draws.uniform(1.1, 2.2), draws.uniform(0.7, 1.5))
        x = draws.uniform(-0.4, 0.4) * room.shell.width
        y = draws.uniform(-0.4, 0.4) * room.shell.depth
        if room.lay(item, x, y, 0.5 * math.pi * draws.integer(0, 1)) is not None:
            return


def ceiling_light(
    room: Furnisher, kinds: Sequence[str], over: Placed | None = None, many: bool = False
) -> None:
    """Hang lamps of one of ``kinds``: one in the middle, a row over the table ``over``, or a grid (``many``).

    Raises :class:`Unfit` if none fits.
    """
    draws, shell = room.draws, room.shell
    kind, look = draws.choice(kinds), draws.integer(0, 2**31)
    places: list[tuple[float, float]] = []
    if over is not None and kind in ("pendant", "globe"):
        middle = over.room_from_item @ [*over.item.bounds.mean(axis=0)[:2], 0.0, 1.0]
        length = float(over.item.bounds[1, 0] - over.item.bounds[0, 0])
        count = 1 if length < 1.5 else draws.integer(2, 3)
        drop = shell.height - draws.uniform(1.45, 1.65)
        along = over.room_from_item[:2, 0]
        for k in range(count):
            x, y = middle[:2] + along * (k - (count - 1) / 2) * length / (count + 0.4)
            places.append((float(x), float(y)))
    else:
        columns = max(1, round(shell.width / _SPACING_M)) if many else 1
        rows = max(1, round(shell.depth / _SPACING_M)) if many else 1
        drop = draws.uniform(0.35, 0.6) if shell.height < 2.7 else draws.uniform(0.5, 0.95)
        places = list(product(middles(shell.width, columns), middles(shell.depth, rows)))
    made = 0
    for x, y in places:
        item = _ceiling_lamp(room.new_name("glow"), kind, drop, Draws("lamp", look))
        for dx, dy in ((0.0, 0.0), (0.3, 0.25), (-0.3, 0.25), (0.4, -0.4)):  # beams may be in the way
            if room.hang_from_ceiling(item, x + dx, y + dy) is not None:
                made += 1
                break
    if not made:
        raise Unfit("the ceiling has no space for a lamp")


def _ceiling_lamp(slot: str, kind: str, drop: float, draws: Draws) -> Item:
    flat = {"disc": lamps.ceiling_disc, "panel": lamps.panel, "batten": lamps.batten, "spots": lamps.spots}
    return flat[kind](draws, slot) if kind in flat else lamps.pendant(draws, slot, drop, kind == "globe")


def desk_place(room: Furnisher, needed: bool) -> bool:
    """Place a desk at a wall, with a chair and perhaps a screen and a lamp; return whether the desk fits.

    Raises :class:`Unfit` if ``needed`` and the desk or chair does not fit.
    """
    draws, style = room.draws, room.style
    desk = room.at_wall(tables.desk(style, draws, draws.uniform(1.1, 1.6)), needed=needed)
    if desk is None:
        return False
    chair = seating.office_chair(style, draws) if draws.chance(0.6) else seating.chair(style, draws)
    seated = room.seat(chair, desk, "front", draws.uniform(-0.1, 0.1), 0.1)
    if seated is None and needed:
        raise Unfit("no space for a chair at the desk")
    if draws.chance(0.7):
        room.on(tables.monitor(style, draws), desk, draws.uniform(-0.2, 0.2), 0.02)
    if draws.chance(0.6):
        side = draws.choice((-1, 1)) * (desk.item.bounds[1, 0] - 0.2)
        room.on(lamps.desk_lamp(draws, room.new_name("glow")), desk, side, 0.04)
    return True


def wire(room: Furnisher, draws: Draws) -> None:
    """Place a switch by each door, if possible at its handle, and some sockets, even behind furniture."""
    shell = room.shell
    item = fittings.switch(draws.choice((1, 1, 2)))
    reach = CASING_M + _CLEAR_M + fittings.PLATE_M / 2 + draws.uniform(0.03, 0.1)
    for door in shell.doors:
        for side in (-door.hinge, door.hinge):
            s = door.s + side * (door.width / 2 + reach)
            if room.hang(item, _SWITCH_M, [door.wall], s, _CLEAR_M, is_slim=True) is not None:
                break
    for _ in range(draws.integer(2, 5)):
        wall, z = draws.choice(WALLS), _HIGH_M if draws.chance(0.25) else _LOW_M
        plates = fittings.socket(draws.choice((1, 2)))
        half = shell.length(wall) / 2 - 0.15
        room.hang(plates, z, [wall], draws.uniform(-half, half), _CLEAR_M, is_slim=True)

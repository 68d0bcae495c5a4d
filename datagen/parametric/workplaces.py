# SPDX-License-Identifier: MIT
"""Furnishes workplaces and rooms for guests: required items first, then others that fit.

Each function raises :class:`Unfit` if a required item does not fit.
"""

from __future__ import annotations

from datagen.parametric import fittings, furnish, seating, storage, tables, units
from datagen.parametric.layout import LEFT_RIGHT, SIDES, Furnisher, Unfit
from datagen.parametric.shell import WALLS


def office(room: Furnisher) -> None:
    """Place desks with screens, cabinets and a board."""
    draws, style = room.draws, room.style
    pods = draws.integer(1, 2) if room.shell.width > 4.8 else 0
    made = 0
    for _ in range(pods):
        width = draws.uniform(1.3, 1.6)
        first = room.in_middle(tables.table(style, draws, width, 0.75, name="desk_row"))
        if first is None:
            continue
        made += 1
        room.seat(seating.office_chair(style, draws), first, "front", 0.0, 0.1)
        room.on(tables.monitor(style, draws), first, draws.uniform(-0.2, 0.2), 0.05)
    for _ in range(draws.integer(1, 3)):
        made += furnish.desk_place(room, False)
    if not made:
        furnish.desk_place(room, True)
    for _ in range(draws.integer(1, 2)):
        if draws.unit() < 0.5:
            size = draws.uniform(0.8, 1.6), draws.uniform(1.2, 2.05)
            room.at_wall(storage.bookcase(style, draws, *size, 0.36))
        else:
            room.at_wall(storage.sideboard(style, draws, draws.uniform(1.2, 1.8), draws.uniform(0.7, 1.1)))
    if draws.chance(0.6):
        room.hang(fittings.board(style, draws, draws.uniform(1.2, 1.8), 0.95, "white_board"), 0.95)
    if draws.chance(0.6):
        room.hang(fittings.clock(style, draws), 1.95)
    furnish.fill(room, ("files", "lockers", "bin", "bookcase", "chair", "crates"), 2, 6)
    furnish.decorate(room, rug=0.1, is_home=False)
    furnish.ceiling_light(room, ("panel", "panel", "spots"), many=True)


def meeting_room(room: Furnisher) -> None:
    """Place a long table with chairs, and a board."""
    draws, style = room.draws, room.style
    length = draws.uniform(1.9, min(3.0, max(room.shell.width, room.shell.depth) - 2.1))
    table = room.in_middle(tables.table(style, draws, length, draws.uniform(0.95, 1.15)), True, 0.15)
    assert table is not None
    office = draws.chance(0.5)
    chair = seating.office_chair(style, draws) if office else seating.chair(style, draws)
    furnish.chairs_around(room, table, chair, max(2, int(length / 0.72)))
    room.hang(fittings.board(style, draws, draws.uniform(1.5, 2.0), 1.05, "white_board"), 0.9)
    room.at_wall(storage.sideboard(style, draws, draws.uniform(1.2, 1.8)))
    if draws.chance(0.5):
        room.hang(fittings.clock(style, draws), 1.95)
    furnish.fill(room, ("sideboard", "trolley", "open_shelf", "chair"), 1, 4)
    furnish.decorate(room, rug=0.0, is_home=False)
    furnish.ceiling_light(room, ("panel", "pendant", "spots"), over=table, many=True)


def reading_room(room: Furnisher) -> None:
    """Place bookcases along the walls, and seats."""
    draws, style = room.draws, room.style
    for _ in range(draws.integer(3, 5)):
        size = draws.uniform(1.0, 2.4), draws.uniform(1.9, 2.25)
        room.at_wall(storage.bookcase(style, draws, *size, fill=0.9))
    group = furnish.seats(room, draws.integer(2, 3))
    if not group:
        raise Unfit("the reading room has no space for seats")
    if draws.chance(0.6):
        table = room.in_middle(tables.round_table(style, draws, draws.uniform(0.5, 0.7), 0.5))
        if table is not None:
            furnish.lamp_on(room, table)
    furnish.floor_lamp_somewhere(room)
    furnish.fill(room, ("bench", "pouf", "chest"), 2, 5)
    furnish.decorate(room, rug=0.7)
    furnish.ceiling_light(room, ("pendant", "globe", "spots"))


def laundry(room: Furnisher) -> None:
    """Place washing machines, racks and baskets."""
    draws, style = room.draws, room.style
    made = None
    if draws.chance(0.5):
        run = units.utility_run(style, draws, draws.integer(1, 2))
        made = room.at_wall(run, room.blank_walls(), "corner")
    if made is None:
        machine = units.washing_machine(style, draws, draws.chance(0.4))
        first = room.at_wall(machine, where="corner", needed=True)
        assert first is not None
        if draws.chance(0.6):
            room.beside(units.washing_machine(style, draws), first, draws.choice(LEFT_RIGHT))
    if draws.chance(0.6):
        room.in_middle(storage.drying_rack(style, draws))
    for _ in range(draws.integer(1, 2)):
        room.at_wall(storage.basket(style, draws))
    if draws.chance(0.7):
        room.at_wall(storage.rack(style, draws, draws.uniform(0.8, 1.2)))
    if draws.chance(0.6):
        room.hang(storage.wall_shelf(style, draws, draws.uniform(0.8, 1.3), draws.integer(1, 2)), 1.5)
    furnish.fill(room, ("bin", "basket", "rack", "trolley", "crates", "cupboard"), 2, 4)
    if draws.chance(0.5):
        room.hang(storage.coat_rail(style, draws, draws.uniform(0.6, 1.0)), 1.6)
    furnish.pictures(room, draws.integer(0, 1))
    furnish.ceiling_light(room, ("batten", "disc", "panel"))


def workshop(room: Furnisher) -> None:
    """Place a workbench under a tool board, and racks."""
    draws, style = room.draws, room.style
    bench = room.at_wall(tables.workbench(style, draws, draws.uniform(1.5, 2.3)), where="middle", needed=True)
    assert bench is not None
    room.over(storage.tool_board(style, draws, draws.uniform(1.0, 1.5)), bench, 1.15)
    for _ in range(draws.integer(1, 3)):
        room.at_wall(storage.rack(style, draws, draws.uniform(0.9, 1.5)))
    if draws.chance(0.6):
        rows = [("drawer", height) for height in (0.3, 0.15, 0.15, 0.1)]
        item = storage.cabinet("drawers", style, (0.7, 0.45, 0.95), rows, 1, 0.1, ("steel", "steel"))
        item.support("table", (0, -0.23), (0.62, 0.36), 0.95)
        room.at_wall(item)
    if draws.chance(0.7):
        room.in_middle(seating.stool(style, draws, 0.6))
    if draws.chance(0.5):
        size = draws.uniform(1.2, 1.7), draws.uniform(0.7, 0.9)
        room.in_middle(tables.table(style, draws, *size, 0.85, "work_table"))
    room.hang(fittings.clock(style, draws), 2.0)
    furnish.fill(room, ("rack", "lockers", "bin", "crates", "stool"), 2, 5)
    if draws.chance(0.5):
        room.hang(storage.tool_board(style, draws, draws.uniform(0.8, 1.2)), 1.2)
    if draws.chance(0.5):
        room.hang(storage.wall_shelf(style, draws, draws.uniform(0.8, 1.4), 2), 1.3)
    furnish.ceiling_light(room, ("batten", "batten", "pendant"), many=True)


def cafe(room: Furnisher) -> None:
    """Place a counter with shelves, small tables with chairs, and a bench."""
    draws, style = room.draws, room.style
    width = draws.uniform(1.8, min(2.8, max(room.shell.width, room.shell.depth) - 1.6))
    counter = units.bar_counter(style, draws, width)
    bar = None
    for wall in draws.shuffled(WALLS):
        bar = room.at_wall(counter, [wall], "any", gap=draws.uniform(0.95, 1.1))
        if bar is not None:
            shelf = storage.wall_shelf(style, draws, width * 0.8, 3)
            where = bar.room_from_item[:2, :2] @ [1.0, 0.0] @ bar.at[:2]
            room.hang(shelf, 1.3, [wall], float(where))
            board = fittings.board(style, draws, min(1.4, width * 0.5), 0.7, "slate_board")
            room.hang(board, 1.5)
            break
    if bar is None:
        raise Unfit("no wall has space for the counter")
    chair = seating.chair(style, draws)
    made = 0
    if draws.chance(0.6):
        bench = room.at_wall(seating.bench(style, draws, draws.uniform(1.6, 2.6), True), where="any")
        if bench is not None:
            half = float(bench.item.bounds[1, 0])
            for x in (-half / 2, half / 2):
                item, at = tables.round_table(style, draws, 0.62), bench.point(x, -0.62)
                table = room.offer(item, at, bench.yaw_rad, near=(bench,), ignores=(bench.name,))
                if table is not None:
                    made += 1
                    room.seat(chair, table, "front", 0.0, 0.1)
    for _ in range(6):
        size = draws.uniform(0.6, 0.75)
        is_round = draws.chance(0.6)
        item = tables.round_table(style, draws, size) if is_round else tables.table(style, draws, size, size)
        table = room.in_middle(item)
        if table is None:
            continue
        sides = draws.shuffled(SIDES)[: draws.integer(2, 3)]
        made += any([room.seat(chair, table, side, 0.0, 0.12) is not None for side in sides])
    if made < 2:
        raise Unfit("fewer than two tables for guests")
    furnish.fill(room, ("sideboard", "trolley", "bin", "open_shelf", "plant"), 2, 6)
    furnish.decorate(room, rug=0.0, is_home=False)
    furnish.ceiling_light(room, ("pendant", "globe", "spots"), many=True)

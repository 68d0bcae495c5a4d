# SPDX-License-Identifier: MIT
"""Furnishes the rooms of a home: required items first, then others that fit.

Each function raises :class:`Unfit` if a required item does not fit.
"""

from __future__ import annotations

from datagen.parametric import fittings, furnish, lamps, sanitary, seating, storage, tables, units
from datagen.parametric.layout import LEFT_RIGHT, SIDES, Furnisher, Unfit


def bedroom(room: Furnisher) -> None:
    """Place a bed with bedside tables, a wardrobe and a chest of drawers."""
    draws, style = room.draws, room.style
    bed = seating.bed(style, draws, draws.choice((1.4, 1.6, 1.8)))
    placed = room.at_wall(bed, where="middle", needed=True)
    assert placed is not None
    for side in LEFT_RIGHT:
        table = storage.bedside(style, draws)
        found = room.beside(table, placed, side)
        if found is not None and draws.chance(0.8):
            furnish.lamp_on(room, found)
    room.at_wall(storage.wardrobe(style, draws, draws.integer(2, 4)), where="corner")
    room.at_wall(storage.chest(style, draws, draws.uniform(0.7, 1.2)))
    extra = draws.unit()
    if extra < 0.35:
        room.at_wall(seating.sofa(style, draws, 1), where="corner", gap=0.12)
    elif extra < 0.65:
        furnish.desk_place(room, False)
    else:
        room.before(seating.bench(style, draws, 1.2, False), placed, 0.04)
    if draws.chance(0.5):
        room.hang(fittings.mirror(style, draws, draws.uniform(0.4, 0.6), draws.uniform(1.2, 1.6)), 0.35)
    furnish.fill(room, ("chest", "bookcase", "pouf", "basket", "chair"), 2, 5)
    furnish.decorate(room, rug=0.6)
    furnish.ceiling_light(room, ("disc", "pendant", "spots"))


def childs_room(room: Furnisher) -> None:
    """Place a bed, a shelf of toys, a desk or low table, and perhaps a tent."""
    draws, style = room.draws, room.style
    room.at_wall(seating.bed(style, draws, 0.9, is_child=True), where="corner", needed=True)
    room.at_wall(storage.cube_shelf(style, draws, draws.integer(2, 4), draws.integer(2, 3)), needed=True)
    if draws.chance(0.6):
        furnish.desk_place(room, False)
    else:
        table = room.in_middle(tables.table(style, draws, 0.75, 0.55, 0.5, "low_table"))
        if table is not None:
            for side in draws.shuffled(SIDES)[:2]:
                room.seat(seating.stool(style, draws, 0.3), table, side, 0.0, 0.1)
    if draws.chance(0.5):
        room.at_wall(fittings.teepee(style, draws), where="corner", gap=0.06)
    room.at_wall(storage.wardrobe(style, draws, 2), where="corner")
    if draws.chance(0.6):
        room.at_wall(storage.basket(style, draws))
    furnish.fill(room, ("cubes", "basket", "pouf", "chest"), 2, 6)
    furnish.decorate(room, rug=0.8, round_rug=0.5)
    furnish.ceiling_light(room, ("globe", "disc", "pendant"))


def study(room: Furnisher) -> None:
    """Place a desk and bookcases."""
    draws, style = room.draws, room.style
    furnish.desk_place(room, True)
    for _ in range(draws.integer(1, 3)):
        size = draws.uniform(0.8, 1.8), draws.uniform(1.5, 2.2)
        room.at_wall(storage.bookcase(style, draws, *size, fill=0.85))
    if draws.chance(0.7):
        room.at_wall(seating.sofa(style, draws, 1), where="corner", gap=0.15)
        furnish.floor_lamp_somewhere(room)
    if draws.chance(0.4):
        room.at_wall(storage.sideboard(style, draws, draws.uniform(0.9, 1.5)))
    furnish.fill(room, ("chest", "basket", "chair", "crates"), 2, 5)
    furnish.decorate(room, rug=0.6)
    furnish.ceiling_light(room, ("pendant", "disc", "spots"))


def living_room(room: Furnisher) -> None:
    """Place a sofa, a table in front of it, a television opposite, armchairs and shelves."""
    draws, style = room.draws, room.style
    item = seating.sofa(style, draws, draws.integer(2, 3))
    sofa = room.at_wall(item, where="middle", needed=True, gap=draws.uniform(0.03, 0.25))
    assert sofa is not None
    wide = float(sofa.item.bounds[1, 0] - sofa.item.bounds[0, 0])
    width, depth = draws.uniform(0.9, min(1.25, wide - 0.5)), draws.uniform(0.5, 0.65)
    table = tables.table(style, draws, width, depth, draws.uniform(0.38, 0.46), "coffee_table")
    rug = None
    if draws.chance(0.65):
        cloth = fittings.rug(style, draws, draws.uniform(1.9, 2.6), draws.uniform(1.3, 1.7))
        rug = room.before(cloth, sofa, 0.06)
    if rug is not None:
        h = rug.item.bounds
        at = rug.point(0.0, 0.5 * h[0, 1] + depth / 2, h[1, 2])
        room.offer(table, at, rug.yaw_rad, stands_on=rug.name)
    else:
        room.before(table, sofa, draws.uniform(0.36, 0.45))
    bench = storage.sideboard(style, draws, draws.uniform(1.4, 2.0), draws.uniform(0.42, 0.56))
    across = room.before(bench, sofa, room.shell.depth, turned=True)
    stand = across or room.at_wall(bench, where="middle")
    if stand is not None:
        size = min(1.35, float(stand.item.bounds[1, 0] * 2) - 0.3)
        room.on(fittings.television(style, draws, size), stand, 0.0, 0.06)
    furnish.seats(room, draws.integer(0, 2))
    if draws.chance(0.7):
        room.at_wall(storage.bookcase(style, draws, draws.uniform(0.8, 1.7), draws.uniform(1.1, 2.1)))
    if draws.chance(0.5):
        item = tables.round_table(style, draws, 0.45, 0.52)
        side = room.beside(item, sofa, draws.choice(LEFT_RIGHT), 0.06)
        if side is not None:
            furnish.lamp_on(room, side)
    furnish.floor_lamp_somewhere(room)
    if draws.chance(0.35):
        room.hang(fittings.mirror(style, draws, draws.uniform(0.6, 0.9), draws.uniform(0.8, 1.2)), 0.95)
    furnish.fill(room, ("sideboard", "chest", "bookcase", "trolley", "pouf", "basket", "side_table"), 2, 5)
    furnish.decorate(room, rug=0.0 if rug else 0.3)
    furnish.ceiling_light(room, ("pendant", "globe", "disc", "spots"))


def dining_room(room: Furnisher) -> None:
    """Place a table with chairs and a sideboard."""
    draws, style = room.draws, room.style
    is_round = draws.chance(0.3)
    long = draws.uniform(1.4, 2.2)
    if is_round:
        item = tables.round_table(style, draws, draws.uniform(1.05, 1.3))
    else:
        item = tables.table(style, draws, long, draws.uniform(0.85, 1.0))
    table = room.in_middle(item, True, 0.25)
    assert table is not None
    chair = seating.chair(style, draws)
    furnish.chairs_around(room, table, chair, 1 if is_round else max(2, int(long / 0.68)))
    sideboard = storage.sideboard(style, draws, draws.uniform(1.2, 2.0), draws.uniform(0.75, 0.95))
    room.at_wall(sideboard, where="middle")
    if draws.chance(0.5):
        size = draws.uniform(0.8, 1.2), draws.uniform(1.8, 2.1)
        room.at_wall(storage.bookcase(style, draws, *size, 0.36, 0.25), where="corner")
    if draws.chance(0.35):
        room.hang(fittings.mirror(style, draws, draws.uniform(0.6, 1.0), draws.uniform(0.7, 1.1)), 1.0)
    furnish.fill(room, ("chest", "trolley", "open_shelf", "chair", "bench", "basket"), 2, 6)
    furnish.decorate(room, rug=0.0)
    furnish.ceiling_light(room, ("pendant", "pendant", "globe"), over=table)


def kitchen(room: Furnisher) -> None:
    """Place a row of kitchen units, and a table or a second row."""
    draws, style = room.draws, room.style
    wanted = draws.integer(5, 7)
    run = None
    for count in range(wanted, 2, -1):
        ends = draws.shuffled(["fridge", "tall", "doors"])[: min(2, count - 2)]
        core = ["sink", "hob", *(draws.choice(("drawers", "doors")) for _ in range(count - 2 - len(ends)))]
        modules = [*ends[:1], *draws.shuffled(core), *ends[1:]]
        low = [m if m not in ("tall", "fridge") else "doors" for m in modules]
        run = room.at_wall(units.kitchen_run(style, draws, modules, True), room.blank_walls(), "corner")
        run = run or room.at_wall(units.kitchen_run(style, draws, low, False), where="corner")
        if run is not None:
            break
    if run is None:
        raise Unfit("no wall has space for the kitchen")
    extra = draws.unit()
    if extra < 0.6:
        is_round = draws.chance(0.4)
        if is_round:
            item = tables.round_table(style, draws, draws.uniform(0.8, 1.05))
        else:
            item = tables.table(style, draws, draws.uniform(0.9, 1.4), draws.uniform(0.7, 0.85))
        table = room.in_middle(item)
        if table is not None:
            furnish.chairs_around(room, table, seating.chair(style, draws), 1 if is_round else 2)
    else:
        room.at_wall(units.kitchen_run(style, draws, ["drawers", "doors"], False))
    if draws.chance(0.6):
        room.hang(storage.wall_shelf(style, draws, draws.uniform(0.7, 1.2), draws.integer(1, 2)), 1.45)
    furnish.fill(room, ("trolley", "bin", "sideboard", "stool", "rack", "basket", "open_shelf"), 2, 5)
    furnish.decorate(room, rug=0.0, most=1)
    furnish.ceiling_light(room, ("spots", "disc", "pendant", "panel"))


def bathroom(room: Furnisher) -> None:
    """Place a bath, a basin with a mirror, and a toilet."""
    draws, style = room.draws, room.style
    if max(room.shell.width, room.shell.depth) > 2.1:
        room.at_wall(sanitary.bathtub(style, draws), where="corner", gap=0.016, needed=draws.chance(0.6))
    basin = room.at_wall(sanitary.vanity(style, draws, draws.uniform(0.6, 1.2)), needed=True, gap=0.016)
    assert basin is not None
    width = float(basin.item.bounds[1, 0] * 2) * draws.uniform(0.7, 1.0)
    glass = room.over(fittings.mirror(style, draws, width, draws.uniform(0.6, 0.85)), basin, 1.2)
    if glass is not None:
        room.over(lamps.wall_lamp(draws, room.new_name("glow")), basin, 2.13)
    room.at_wall(sanitary.toilet(style, draws), needed=True, gap=0.016)
    if draws.chance(0.7):
        room.hang(sanitary.towel_rail(style, draws), 0.5)
    if draws.chance(0.5):
        room.at_wall(storage.basket(style, draws))
    if draws.chance(0.4):
        tall = (0.4, 0.34, draws.uniform(1.5, 1.8))
        cupboard = storage.cabinet("cupboard", style, tall, [("door", 0.8)] * 2, 1, 0.06)
        room.at_wall(cupboard, where="corner")
    if draws.chance(0.3):
        furnish.plant_somewhere(room)
    furnish.fill(room, ("bin", "basket", "stool", "trolley", "cupboard"), 2, 6)
    if draws.chance(0.6):
        room.hang(storage.wall_shelf(style, draws, draws.uniform(0.4, 0.7), draws.integer(1, 2)), 1.4)
    furnish.pictures(room, draws.integer(0, 2))
    furnish.ceiling_light(room, ("disc", "spots", "panel"))


def hallway(room: Furnisher) -> None:
    """Place a console table or cabinet with a mirror, coats and shoes."""
    draws, style = room.draws, room.style
    kind = draws.unit()
    if kind < 0.5:
        item = tables.table(style, draws, draws.uniform(0.8, 1.2), 0.34, 0.82, "console")
        item.front_m = 0.4
        tallest, z = 0.95, 1.05
    else:
        item = storage.sideboard(style, draws, draws.uniform(0.8, 1.4), draws.uniform(0.8, 1.0))
        tallest, z = 0.8, 1.2
    host = room.at_wall(item)
    if host is not None:
        size = draws.uniform(0.45, 0.7), draws.uniform(0.6, tallest)
        room.over(fittings.mirror(style, draws, *size), host, z)
        if kind < 0.5:
            furnish.lamp_on(room, host, 0.3)
    coats = room.hang(storage.coat_rail(style, draws, draws.uniform(0.8, 1.3)), 1.6)
    if coats is not None and draws.chance(0.7):
        wall = room.wall_of(coats)
        bench = seating.bench(style, draws, draws.uniform(0.8, 1.1), False)
        bench.front_m = 0.3
        if wall is not None:
            room.at_wall(bench)
    if draws.chance(0.5):
        room.at_wall(storage.wardrobe(style, draws, draws.integer(2, 3)), where="corner")
    for _ in range(draws.integer(0, 3)):
        room.at_wall(fittings.shoes(style, draws))
    if draws.chance(0.5):
        room.at_wall(storage.basket(style, draws))
    furnish.fill(room, ("chest", "basket", "shoes", "pouf", "bookcase"), 2, 5)
    furnish.decorate(room, rug=0.7)
    is_long = max(room.shell.width, room.shell.depth) > 4
    furnish.ceiling_light(room, ("disc", "globe", "spots", "pendant"), many=is_long)


def bedsit(room: Furnisher) -> None:
    """Place a kitchen, a bed, a table and seats in one room."""
    draws, style = room.draws, room.style
    modules = ["fridge", "sink", "drawers", "hob"] if draws.chance(0.6) else ["sink", "hob", "fridge"]
    room.at_wall(units.kitchen_run(style, draws, modules, True), room.blank_walls(), "corner", needed=True)
    bed = room.at_wall(seating.bed(style, draws, draws.choice((0.9, 1.2, 1.4))), where="corner", needed=True)
    assert bed is not None
    table = room.in_middle(tables.round_table(style, draws, draws.uniform(0.7, 0.9)))
    if table is not None:
        furnish.chairs_around(room, table, seating.chair(style, draws), 1)
    room.at_wall(storage.wardrobe(style, draws, 2), where="corner")
    if draws.chance(0.6):
        room.at_wall(seating.sofa(style, draws, 2))
    else:
        furnish.desk_place(room, False)
    furnish.floor_lamp_somewhere(room)
    furnish.decorate(room, rug=0.4)
    furnish.ceiling_light(room, ("disc", "pendant", "spots"), many=True)

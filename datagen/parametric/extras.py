# SPDX-License-Identifier: MIT
"""Makers, by name, of randomly sized furniture that stands along the walls of many kinds of room."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from datagen.foundation.random import Draws
from datagen.parametric import fittings, metalware, seating, storage, tables
from datagen.parametric.items import Item, Style


def _cupboard(style: Style, draws: Draws) -> Item:
    size = (draws.uniform(0.42, 0.65), 0.36, draws.uniform(0.9, 1.8))
    return storage.cabinet("cupboard", style, size, [("door", 1.0)], 1, 0.06)


def _files(style: Style, draws: Draws) -> Item:
    size = (0.45, 0.6, draws.choice((0.75, 1.3)))
    return storage.cabinet("files", style, size, [("drawer", 0.3)] * 3, 1, 0.04, ("steel", "steel"))


EXTRAS: Mapping[str, Callable[[Style, Draws], Item]] = {
    "basket": storage.basket,
    "bin": metalware.pedal_bin,
    "bench": lambda style, draws: seating.bench(style, draws, draws.uniform(0.8, 1.4), False),
    "chair": lambda style, draws: seating.chair(style, draws),
    "chest": lambda style, draws: storage.chest(style, draws, draws.uniform(0.55, 1.05)),
    "crates": fittings.crates,
    "cubes": lambda style, draws: storage.cube_shelf(style, draws, draws.integer(1, 2), draws.integer(1, 3)),
    "cupboard": _cupboard,
    "files": _files,
    "lockers": metalware.lockers,
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
    "trolley": metalware.trolley,
    "stool": lambda style, draws: seating.stool(style, draws, draws.choice((0.45, 0.6))),
}

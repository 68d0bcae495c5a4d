# SPDX-License-Identifier: MIT
"""The kinds of rooms: sizes, openings, and the rules that furnish them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from datagen.parametric import homes, workplaces
from datagen.parametric.layout import Furnisher
from datagen.parametric.slots import Classes

Range = tuple[float, float]
_DRY: Classes = ("wood", "stone", "glazed", "fabric")
_WET: Classes = ("glazed", "stone", "wood")
_WORK: Classes = ("stone", "glazed", "wood")


@dataclass(frozen=True)
class Kind:
    """A kind of room: ranges of sizes in metres, and of the numbers of openings and tiled walls.

    ``curtains``, ``blinds``, ``radiators``, ``beams`` and ``steel_fronts`` (of cabinets) are probabilities.
    """

    furnish: Callable[[Furnisher], None]
    width: Range
    depth: Range
    height: Range = (2.4, 2.9)
    windows: tuple[int, int] = (1, 2)
    doors: tuple[int, int] = (1, 1)
    sill: Range = (0.72, 1.0)
    floor: Classes = _DRY
    tiled: tuple[int, int] = (0, 0)
    curtains: float = 0.55
    blinds: float = 0.25
    radiators: float = 0.7
    beams: float = 0.04
    steel_fronts: float = 0.0


KINDS: dict[str, Kind] = {
    "bathroom": Kind(
        homes.bathroom,
        (2.3, 3.4),
        (2.0, 3.0),
        (2.4, 2.7),
        (0, 1),
        sill=(1.0, 1.4),
        floor=_WET,
        tiled=(1, 4),
        curtains=0.0,
        blinds=0.4,
        radiators=0.0,
    ),
    "bedroom": Kind(homes.bedroom, (3.3, 4.8), (3.2, 4.4)),
    "bedsit": Kind(homes.bedsit, (4.6, 6.2), (4.0, 5.2)),
    "cafe": Kind(
        workplaces.cafe,
        (5.2, 7.5),
        (4.6, 6.4),
        (2.7, 3.5),
        (1, 3),
        sill=(0.35, 0.8),
        floor=_WORK,
        curtains=0.1,
        blinds=0.15,
        beams=0.3,
        steel_fronts=0.4,
    ),
    "childs_room": Kind(homes.childs_room, (3.0, 4.4), (2.9, 4.2)),
    "dining_room": Kind(homes.dining_room, (3.4, 5.2), (3.2, 4.8), beams=0.1),
    "hallway": Kind(homes.hallway, (3.2, 6.0), (1.7, 2.4), (2.4, 2.8), (0, 1), (2, 3), curtains=0.3),
    "kitchen": Kind(
        homes.kitchen,
        (3.2, 5.2),
        (2.7, 4.2),
        sill=(0.98, 1.1),
        floor=_WET,
        curtains=0.15,
        blinds=0.4,
        steel_fronts=0.2,
    ),
    "laundry": Kind(
        workplaces.laundry,
        (2.4, 3.6),
        (2.2, 3.4),
        (2.3, 2.6),
        (0, 1),
        sill=(0.95, 1.4),
        floor=_WET,
        tiled=(0, 2),
        curtains=0.0,
        blinds=0.2,
        steel_fronts=0.3,
    ),
    "living_room": Kind(
        homes.living_room, (4.2, 6.4), (3.8, 5.4), (2.5, 3.1), (1, 3), sill=(0.12, 0.9), beams=0.1
    ),
    "meeting_room": Kind(
        workplaces.meeting_room,
        (4.6, 6.5),
        (3.9, 5.2),
        (2.6, 3.1),
        (1, 3),
        curtains=0.05,
        blinds=0.7,
        sill=(0.4, 0.95),
    ),
    "office": Kind(
        workplaces.office,
        (3.8, 6.8),
        (3.4, 5.2),
        (2.5, 3.1),
        (1, 3),
        curtains=0.05,
        blinds=0.7,
        steel_fronts=0.35,
    ),
    "reading_room": Kind(workplaces.reading_room, (4.4, 6.2), (4.0, 5.4), (2.6, 3.2), beams=0.15),
    "study": Kind(homes.study, (2.9, 4.4), (2.8, 4.0)),
    "workshop": Kind(
        workplaces.workshop,
        (4.0, 6.4),
        (3.4, 5.0),
        (2.5, 3.3),
        (0, 2),
        sill=(1.0, 1.4),
        floor=_WORK,
        curtains=0.0,
        blinds=0.1,
        beams=0.25,
        radiators=0.3,
        steel_fronts=0.6,
    ),
}
"""All kinds of room, by name."""

# SPDX-License-Identifier: MIT
"""The kinds of rooms: sizes, openings, and the rules that furnish them."""

from __future__ import annotations

from dataclasses import dataclass

from datagen.foundation.tables import read_table
from datagen.parametric import homes, workplaces
from datagen.parametric.layout import Furnisher
from datagen.parametric.slots import Classes

Range = tuple[float, float]
_DRY: Classes = ("wood", "stone", "glazed", "fabric")


@dataclass(frozen=True)
class Kind:
    """A kind of room: ranges of sizes in metres and of the numbers of windows, doors and ``tiled`` walls.

    ``floor``: material classes of the floor. ``curtains``, ``blinds``, ``radiators``, ``beams`` and
    ``steel_fronts`` (of cabinets) are probabilities.
    """

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


KINDS = read_table(__file__, "kinds.yaml", dict[str, Kind])
"""All kinds of room, by name."""


def furnish(kind: str, room: Furnisher) -> None:
    """Furnish a room by the function of ``homes`` or ``workplaces`` that is named after its kind.

    Raises :class:`Unfit` if a required item does not fit.
    """
    getattr(homes if hasattr(homes, kind) else workplaces, kind)(room)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources of objects: a table in objects.yaml, and modules for the objects whose shapes are computed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from scenes.sources.materials.catalogue import Slot, slots_of, table
from scenes.sources.modelling import PartBuilder
from scenes.sources.objects import books_and_paper, devices, fruit, household, living, play, shoes
from scenes.sources.parts import Parts, add_parts


@dataclass(frozen=True)
class ObjectSource:
    """The source of an object. ``supports``: kinds of surface on which it can stand; ``scale``: range of its
    scale factor; ``yaw_deg``: largest rotation away from facing -Y.
    """

    title: str
    category: str
    slots: dict[str, Slot]
    build: Callable[[PartBuilder], None]
    supports: tuple[str, ...] = ("table", "shelf", "counter", "sill")
    scale: tuple[float, float] = (0.92, 1.1)
    yaw_deg: float = 180.0

    @property
    def yaw_range_rad(self) -> tuple[float, float]:
        limit = math.radians(self.yaw_deg)
        return -limit, limit


def _source(
    name: str, /, about: dict[str, Any], parts: Parts | None = None, **slots: dict[str, Any]
) -> ObjectSource:
    if parts is None:
        build = next(getattr(module, name) for module in _MODULES if hasattr(module, name))
    else:
        build = partial(add_parts, parts=parts)
    return ObjectSource(**about, slots=slots_of(slots), build=build)


_MODULES = (books_and_paper, devices, fruit, household, living, play, shoes)
OBJECTS = {name: _source(name, **row) for name, row in table("objects/objects.yaml").items()}

# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources of objects: titles, categories and slots in objects.yaml, and modules of functions that build them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from scenes.sources.materials.catalogue import Slot, slots_of, table
from scenes.sources.modelling import PartBuilder


@dataclass(frozen=True)
class ObjectSource:
    """An object's source. ``supports``: kinds of support surface; ``scale``: range of its scale factor;
    ``yaw_deg``: largest rotation from facing -Y.
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


OBJECTS = {
    name: ObjectSource(**row.pop("about"), slots=slots_of(row), build=getattr(module, name))
    for module, rows in (
        (import_module(f"{__name__}.{name}"), rows) for name, rows in table("objects/objects.yaml").items()
    )
    for name, row in rows.items()
}

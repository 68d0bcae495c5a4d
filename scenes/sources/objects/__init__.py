# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources of objects: titles, categories and slots in objects.yaml, and modules that build them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

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


def _source(module: str, name: str, /, about: dict[str, Any], **slots: dict[str, Any]) -> ObjectSource:
    build = getattr(import_module(f"{__name__}.{module}"), name)
    return ObjectSource(**about, slots=slots_of(slots), build=build)


OBJECTS = {
    name: _source(module, name, **row)
    for module, rows in table("objects/objects.yaml").items()
    for name, row in rows.items()
}

# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources of environments: a table in rooms.yaml and, for each room, a module that furnishes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import bpy

from scenes.sources.environments.room import Door, Room, Window
from scenes.sources.materials.catalogue import Slot, slots_of, table
from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import Point


@dataclass(frozen=True)
class EnvironmentSource:
    """The source of a room. ``shell``: size and openings, as arguments of :class:`Room`;
    ``camera_regions``: lower and upper corners [m] by name.
    """

    title: str
    slots: dict[str, Slot]
    shell: dict[str, Any]
    camera_regions: dict[str, tuple[Point, Point]]
    furnish: Callable[[Room], None]

    def build(self, builder: PartBuilder, collection: bpy.types.Collection) -> None:
        """Add the room to a collection that is tagged as an environment."""
        room = Room(builder, collection, **self.shell)
        room.build_shell()
        self.furnish(room)
        for name, corners in self.camera_regions.items():
            room.camera_region(name, *corners)


def _source(name: str, /, title: str, slots: dict[str, Any], windows: Any, doors: Any, shell: Any,
            camera_regions: Any) -> EnvironmentSource:  # fmt: skip
    openings = {"windows": [Window(*row) for row in windows], "doors": [Door(*row) for row in doors]}
    furnish = getattr(import_module(f"{__name__}.{name}"), name)
    return EnvironmentSource(title, slots_of(slots), {**shell, **openings}, camera_regions, furnish)


ENVIRONMENTS = {
    name: _source(name, **row) for name, row in table("environments/rooms.yaml").items() if "title" in row
}

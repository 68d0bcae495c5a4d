# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources of environments: title and slots in rooms.yaml, and for each room a module that builds it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

import bpy

from scenes.sources.materials.catalogue import Slot, slots_of, table
from scenes.sources.modelling import PartBuilder


@dataclass(frozen=True)
class EnvironmentSource:
    """The source of a room: ``build`` adds it to a collection that is tagged as an environment."""

    title: str
    slots: dict[str, Slot]
    build: Callable[[PartBuilder, bpy.types.Collection], None]


ENVIRONMENTS = {
    name: EnvironmentSource(
        row["title"], slots_of(row["slots"]), getattr(import_module(f"{__name__}.{name}"), name)
    )
    for name, row in table("environments/rooms.yaml").items()
    if "title" in row
}

# SPDX-License-Identifier: MIT
"""Slots of generated rooms, each with a kind of surface, permitted material classes and a plain colour.

Planning assigns library materials to almost all slots; the plain colours remain where no material fits.
"""

from __future__ import annotations

from dataclasses import dataclass

from datagen.formats.asset import MaterialClass, SlotMaterial, Surface
from datagen.formats.base import UnitColor
from datagen.foundation.tables import read_table

Classes = tuple[MaterialClass, ...]


@dataclass(frozen=True)
class Slot:
    """A slot with a plain material, which materials of ``classes`` may replace unless ``is_fixed``.

    ``metal_share``: probability per room that the slot is metal instead.
    """

    surface: Surface
    classes: Classes
    color: UnitColor
    roughness: float = 0.5
    specular: UnitColor = (0.04, 0.04, 0.04)
    is_fixed: bool = False
    metal_share: float = 0.0

    def material(self, classes: Classes | None = None) -> SlotMaterial:
        """Return the slot's plain material; ``classes``, if given, replaces the permitted classes."""
        allowed = classes or self.classes
        return SlotMaterial(
            classes=allowed[:1],
            diffuse_albedo=self.color,
            specular_albedo=self.specular,
            roughness=self.roughness,
            replaceable_by=() if self.is_fixed else allowed,
            surface=self.surface,
        )


_METAL: UnitColor = (0.56, 0.55, 0.53)
_BARE: UnitColor = (0.0, 0.0, 0.0)


SLOTS = read_table(__file__, "slots.yaml", dict[str, Slot])
"""Slots by name; those of lamps (``glow``) and pictures (``art``) are added for each room."""
_FINISHED = ("frame", "legs", "shade", "slats")


def in_metal(slot: str) -> SlotMaterial:
    """Return the plain metal material of a slot; frames, legs, shades and slats count as ``fitting``."""
    surface: Surface = "fitting" if slot in _FINISHED else SLOTS[slot].surface
    return Slot(surface, ("metal",), _BARE, 0.3, _METAL).material()


BOOKS = ("book_a", "book_b", "book_c", "book_d", "book_e", "book_f")

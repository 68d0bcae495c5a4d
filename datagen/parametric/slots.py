# SPDX-License-Identifier: MIT
"""Slots of generated rooms, each with a kind of surface, permitted material classes and a plain colour.

Plans assign materials of the library to almost all slots; the plain colours remain where no material fits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from datagen.formats.asset import MaterialClass, SlotMaterial, Surface
from datagen.formats.base import UnitColor

Classes = tuple[MaterialClass, ...]


@dataclass(frozen=True)
class Slot:
    """A slot with a plain material, which materials of ``classes`` may replace unless the slot is fixed."""

    surface: Surface
    classes: Classes
    color: UnitColor
    roughness: float = 0.5
    specular: UnitColor = (0.04, 0.04, 0.04)
    is_fixed: bool = False

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


def _fixed(surface: Surface, material: MaterialClass, color: UnitColor, roughness: float = 0.6) -> Slot:
    return Slot(surface, (material,), color, roughness, is_fixed=True)


SLOTS: Mapping[str, Slot] = {
    "walls": Slot("wall", ("painted", "plaster", "paper"), (0.72, 0.7, 0.66), 0.8),
    "wall_accent": Slot("wall", ("painted", "plaster", "paper", "wood", "stone"), (0.3, 0.36, 0.38), 0.8),
    "wall_tiles": Slot("tiles", ("glazed", "stone"), (0.75, 0.75, 0.73), 0.15),
    "ceiling": Slot("ceiling", ("painted", "plaster"), (0.8, 0.8, 0.78), 0.85),
    "floor": Slot("floor", ("wood", "stone", "glazed", "fabric"), (0.3, 0.2, 0.12), 0.4),
    "trim": Slot("joinery", ("painted", "wood"), (0.75, 0.74, 0.71), 0.35),
    "door": Slot("joinery", ("painted", "wood"), (0.75, 0.74, 0.71), 0.35),
    "sill": Slot("joinery", ("stone", "painted", "wood"), (0.6, 0.59, 0.56), 0.3),
    "metal": Slot("fitting", ("metal",), _BARE, 0.25, _METAL),
    "wood": Slot("furniture", ("wood", "painted"), (0.34, 0.22, 0.12), 0.4),
    "front": Slot("furniture", ("wood", "painted"), (0.6, 0.58, 0.54), 0.35),
    "second": Slot("furniture", ("wood", "painted"), (0.24, 0.15, 0.08), 0.4),
    "steel": Slot("furniture", ("metal", "painted"), (0.05, 0.05, 0.05), 0.4),
    "top": Slot("tabletop", ("wood", "stone", "painted"), (0.36, 0.24, 0.13), 0.35),
    "worktop": Slot("worktop", ("stone", "wood", "metal"), (0.25, 0.24, 0.23), 0.25),
    "legs": Slot("legs", ("metal", "wood", "painted"), (0.02, 0.02, 0.02), 0.4),
    "seat": Slot("upholstery", ("fabric", "leather"), (0.25, 0.24, 0.22), 0.8),
    "sofa": Slot("upholstery", ("fabric", "leather"), (0.22, 0.24, 0.26), 0.85),
    "cushion_a": Slot("upholstery", ("fabric",), (0.5, 0.3, 0.12), 0.9),
    "cushion_b": Slot("upholstery", ("fabric",), (0.12, 0.2, 0.24), 0.9),
    "mattress": Slot("towel", ("fabric",), (0.75, 0.74, 0.7), 0.9),
    "bedding": Slot("towel", ("fabric",), (0.6, 0.58, 0.54), 0.9),
    "throw": Slot("towel", ("fabric",), (0.2, 0.25, 0.3), 0.9),
    "towel": Slot("towel", ("fabric",), (0.6, 0.55, 0.5), 0.95),
    "curtain": Slot("curtain", ("fabric",), (0.5, 0.47, 0.42), 0.85),
    "blind": Slot("curtain", ("fabric", "paper"), (0.7, 0.68, 0.63), 0.8),
    "slats": Slot("joinery", ("painted", "wood", "metal"), (0.7, 0.69, 0.66), 0.4),
    "rug": Slot("rug", ("fabric", "organic"), (0.3, 0.2, 0.16), 0.95),
    "rug_border": Slot("rug", ("fabric", "organic"), (0.12, 0.1, 0.1), 0.95),
    "shade": Slot("shade", ("fabric", "paper", "painted", "metal"), (0.7, 0.66, 0.58), 0.8),
    "appliance": Slot("appliance", ("painted", "metal"), (0.72, 0.72, 0.72), 0.25),
    "sanitary": Slot("sanitary", ("glazed", "ceramic"), (0.8, 0.8, 0.79), 0.06),
    "sink": Slot("sanitary", ("metal", "glazed"), _BARE, 0.3, _METAL),
    "radiator": Slot("radiator", ("painted", "metal"), (0.75, 0.75, 0.73), 0.3),
    "frame": Slot("frame", ("wood", "painted", "metal"), (0.1, 0.07, 0.05), 0.4),
    "basket": Slot("small", ("organic", "fabric", "plastic"), (0.35, 0.25, 0.14), 0.8),
    "box": Slot("cover", ("paper", "fabric", "wood"), (0.42, 0.3, 0.19), 0.8),
    "pot": Slot("vessel", ("ceramic", "glazed", "painted"), (0.5, 0.3, 0.2), 0.6),
    "tool": Slot("utensil", ("metal", "wood", "plastic"), (0.1, 0.1, 0.1), 0.35, _METAL),
    "grip": Slot("gadget", ("rubber", "plastic", "wood"), (0.3, 0.05, 0.03), 0.5),
    "machine": Slot("gadget", ("plastic", "metal"), (0.03, 0.03, 0.03), 0.3),
    "toy_a": Slot("gadget", ("plastic", "painted"), (0.6, 0.12, 0.08), 0.35),
    "toy_b": Slot("gadget", ("plastic", "painted"), (0.1, 0.25, 0.55), 0.35),
    "book_a": Slot("cover", ("paper", "fabric"), (0.35, 0.06, 0.05), 0.6),
    "book_b": Slot("cover", ("paper", "fabric"), (0.06, 0.12, 0.24), 0.6),
    "book_c": Slot("cover", ("paper", "fabric"), (0.62, 0.57, 0.46), 0.6),
    "book_d": Slot("cover", ("paper", "fabric"), (0.05, 0.14, 0.09), 0.6),
    "book_e": Slot("cover", ("paper", "fabric"), (0.03, 0.03, 0.03), 0.5),
    "book_f": Slot("cover", ("paper", "fabric"), (0.45, 0.28, 0.06), 0.6),
    "pages": _fixed("cover", "paper", (0.72, 0.69, 0.6), 0.9),
    "mount": _fixed("cover", "paper", (0.8, 0.79, 0.75), 0.9),
    "screen": _fixed("gadget", "glass", (0.008, 0.008, 0.009), 0.08),
    "black_glass": _fixed("gadget", "glass", (0.012, 0.012, 0.013), 0.06),
    "white_board": _fixed("gadget", "glazed", (0.78, 0.79, 0.79), 0.12),
    "slate_board": _fixed("gadget", "painted", (0.025, 0.03, 0.028), 0.75),
    "mirror": Slot("small", ("glass",), _BARE, 0.03, (0.86, 0.87, 0.87), is_fixed=True),
    "switch": _fixed("gadget", "plastic", (0.78, 0.78, 0.75), 0.35),
    "opal": _fixed("shade", "glass", (0.8, 0.79, 0.76), 0.3),
    "dark": _fixed("gadget", "rubber", (0.02, 0.02, 0.02), 0.7),
    "soil": _fixed("small", "organic", (0.04, 0.025, 0.015), 0.95),
    "stem": _fixed("small", "organic", (0.08, 0.07, 0.03), 0.7),
    "leaf": _fixed("small", "organic", (0.045, 0.11, 0.03), 0.4),
    "lawn": _fixed("small", "organic", (0.075, 0.11, 0.035), 0.95),
    "hedge": _fixed("small", "organic", (0.03, 0.06, 0.018), 0.9),
    "asphalt": _fixed("small", "stone", (0.09, 0.088, 0.085), 0.9),
    "facade": _fixed("small", "plaster", (0.5, 0.44, 0.36), 0.9),
    "facade_b": _fixed("small", "stone", (0.28, 0.14, 0.1), 0.9),
    "pane": _fixed("small", "glass", (0.02, 0.025, 0.03), 0.06),
    "roof": _fixed("small", "ceramic", (0.14, 0.08, 0.06), 0.8),
    "bark": _fixed("small", "organic", (0.09, 0.07, 0.05), 0.95),
    "foliage": _fixed("small", "organic", (0.06, 0.11, 0.03), 0.85),
}  # fmt: skip
"""Slots by name; those of lamps (``glow``) and pictures (``art``) are added for each room."""
METAL_SHARE: Mapping[str, float] = {
    "appliance": 0.75, "frame": 0.35, "legs": 0.25, "machine": 0.5, "shade": 0.3, "slats": 0.5, "steel": 0.85,
    "tool": 0.6, "worktop": 0.35,
}  # fmt: skip
"""Probability, by slot, that the slot is of metal in a room."""
_FINISHED = ("frame", "legs", "shade", "slats")


def in_metal(slot: str) -> SlotMaterial:
    """Return the plain metal material of a slot; slender parts have the finish of handles and taps."""
    surface: Surface = "fitting" if slot in _FINISHED else SLOTS[slot].surface
    return Slot(surface, ("metal",), _BARE, 0.3, _METAL).material()


BOOKS = ("book_a", "book_b", "book_c", "book_d", "book_e", "book_f")

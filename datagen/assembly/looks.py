# SPDX-License-Identifier: MIT
"""Likely materials and colours of the surfaces of real rooms.

A :class:`Look` is a material class with ranges of the means of D (hue, saturation and value in linear HSV),
S and R. All looks of a room follow one :class:`RoomStyle`, which consists of a wood tone for furniture and
one for the floor, a metal for handles and taps, an accent colour, and white, dark or wooden joinery.

Sources: EN 12464-1:2021 recommends reflectances of 0.7 to 0.9 for ceilings, 0.5 to 0.8 for walls, 0.2 to 0.6
for floors and 0.2 to 0.7 for large objects; ranges are wider where practice differs (dark floors, coloured
walls). Hues, saturations and roughness are from ``python -m datagen.assembly.surface_statistics`` over
imported rooms. Planed wood has CIELAB values of about L* 45 to 85, a* 3 to 13 and b* 16 to 25, which is a
saturation of 0.45 to 0.75 in linear HSV; oil and lacquer raise it to 0.85, whitewash and weathering lower it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from datagen.formats.asset import MaterialClass, Surface
from datagen.foundation.random import Draws

Finish = Literal["steel", "brass", "black"]
Joinery = Literal["white", "wood", "dark"]
Interval = tuple[float, float]
ANY: Interval = (0.0, 1.0)

_FINISHES: tuple[Finish, ...] = ("steel", "brass", "black")
_FINISH_WEIGHTS = (0.62, 0.2, 0.18)
_JOINERY: tuple[Joinery, ...] = ("white", "wood", "dark")
_JOINERY_WEIGHTS = (0.78, 0.13, 0.09)
_ACCENTS: tuple[Interval, ...] = ((0.01, 0.11), (0.11, 0.18), (0.22, 0.45), (0.5, 0.64), (0.93, 1.0))
_ACCENT_WEIGHTS = (0.32, 0.12, 0.24, 0.27, 0.05)
"""Weights of the accent hues earth, ochre, green, blue and rose (ranges in turns)."""
ACCENT_SPREAD = 0.03  # range of hues within one accent, in turns


@dataclass(frozen=True)
class Wood:
    """Wood tone as ranges of mean D in linear HSV, with hue in turns."""

    value: Interval
    saturation: Interval
    hue: Interval


_WOODS: tuple[Wood, ...] = (
    Wood((0.45, 0.68), (0.18, 0.38), (0.07, 0.105)),  # whitewashed
    Wood((0.5, 0.72), (0.4, 0.58), (0.065, 0.095)),  # ash, maple, birch
    Wood((0.45, 0.7), (0.54, 0.74), (0.055, 0.09)),  # pine, beech
    Wood((0.3, 0.5), (0.5, 0.72), (0.055, 0.09)),  # oak
    Wood((0.18, 0.36), (0.15, 0.38), (0.07, 0.105)),  # grey oak
    Wood((0.2, 0.42), (0.62, 0.84), (0.035, 0.065)),  # cherry, teak, mahogany
    Wood((0.1, 0.24), (0.5, 0.78), (0.04, 0.07)),  # walnut
    Wood((0.02, 0.1), (0.3, 0.68), (0.03, 0.08)),  # dark stain
)
_WOOD_WEIGHTS = (0.1, 0.14, 0.16, 0.24, 0.07, 0.1, 0.13, 0.06)
WOOD_STAIN = 2.5  # largest factor by which wood is darkened, as by a stain


@dataclass(frozen=True)
class RoomStyle:
    """Style of a room: wood tones of furniture and floor, accent hue in turns, metal finish and joinery."""

    wood: Wood
    floor: Wood
    accent_hue: float
    finish: Finish
    joinery: Joinery

    @classmethod
    def draw(cls, draws: Draws) -> RoomStyle:
        """Draw a style; with probability 0.5, the wood tone of the floor is that of the furniture."""
        wood = draws.weighted(_WOODS, _WOOD_WEIGHTS)
        other = draws.weighted(_WOODS, _WOOD_WEIGHTS)
        floor = wood if draws.chance(0.5) else other
        accent = draws.uniform(*draws.weighted(_ACCENTS, _ACCENT_WEIGHTS))
        finish = draws.weighted(_FINISHES, _FINISH_WEIGHTS)
        return cls(wood, floor, accent, finish, draws.weighted(_JOINERY, _JOINERY_WEIGHTS))


@dataclass(frozen=True)
class Look:
    """A material class with ranges of its means: ``value``, ``saturation`` and ``hue`` (in turns; None keeps
    it) of D, ``roughness`` R, ``specular`` (brightest channel of S) and ``tint`` (saturation of S).

    ``follows`` names the part of the style that replaces ranges: a wood tone or the accent hue. ``only`` is
    the finish or joinery required of the style. Value and saturation may be divided by up to ``stain``, if it
    exceeds the limit of the class. ``is_printed`` allows any hue in any class.
    """

    weight: float
    material_class: MaterialClass
    value: Interval = ANY
    saturation: Interval = ANY
    roughness: Interval = ANY
    hue: Interval | None = None
    specular: Interval = ANY
    tint: Interval = ANY
    follows: Literal["", "wood", "floor", "accent"] = ""
    only: Finish | Joinery | None = None
    stain: float = 1.0
    is_printed: bool = False

    def in_style(self, style: RoomStyle) -> Look | None:
        """Replace the ranges that follow the style; return None if the style excludes the look."""
        if self.only is not None and self.only not in (style.finish, style.joinery):
            return None
        plain = replace(self, follows="", only=None)
        if self.follows in ("wood", "floor"):
            tone = style.wood if self.follows == "wood" else style.floor
            return replace(plain, value=tone.value, saturation=tone.saturation, hue=tone.hue)
        if self.follows == "accent":
            return replace(plain, hue=(style.accent_hue - ACCENT_SPREAD, style.accent_hue + ACCENT_SPREAD))
        return plain


def _wood(
    weight: float,
    roughness: Interval = (0.2, 0.6),
    only: Joinery | None = None,
    follows: Literal["wood", "floor"] = "wood",
) -> Look:
    return Look(weight, "wood", roughness=roughness, follows=follows, only=only, stain=WOOD_STAIN)


def _white(weight: float, roughness: Interval = (0.15, 0.45), only: Joinery | None = None) -> Look:
    return Look(weight, "painted", (0.55, 0.85), (0.0, 0.14), roughness, only=only)


def _dark(weight: float, roughness: Interval = (0.12, 0.5), only: Joinery | None = None) -> Look:
    return Look(weight, "painted", (0.004, 0.06), (0.0, 0.35), roughness, only=only)


def _muted(weight: float) -> Look:
    return Look(weight, "painted", (0.06, 0.42), (0.1, 0.5), (0.15, 0.5), follows="accent")


def _steel(weight: float, roughness: Interval = (0.05, 0.42), only: Finish | None = None) -> Look:
    bare, bright, untinted = (0.0, 0.02), (0.4, 1.0), (0.0, 0.12)
    return Look(weight, "metal", bare, ANY, roughness, specular=bright, tint=untinted, only=only)


def _finish(weight: float) -> tuple[Look, ...]:
    """One look for each finish of a style: steel, brass, and black (anodised or cast) metal."""
    brass = Look(
        weight, "metal", (0.0, 0.02), ANY, (0.1, 0.42), specular=(0.6, 1.0), tint=(0.3, 0.62), only="brass"
    )
    black = Look(weight, "metal", (0.0, 0.06), ANY, (0.3, 0.65), specular=(0.05, 0.2), only="black")
    return _steel(weight, only="steel"), brass, black


def _cloth(weight: float, value: Interval, saturation: Interval, accent: bool = False) -> Look:
    return Look(weight, "fabric", value, saturation, (0.6, 1.0), follows="accent" if accent else "")


KEPT: dict[Surface, float] = {"cover": 0.7, "frame": 0.3, "joinery": 0.3}
"""Probability, by kind of surface, that a material to be replaced is kept; book covers thus stay varied."""
LOOKS: dict[Surface, tuple[Look, ...]] = {
    "ceiling": (
        Look(4, "painted", (0.66, 0.88), (0.0, 0.1), (0.6, 1.0)),
        Look(1, "plaster", (0.6, 0.88), (0.0, 0.16), (0.7, 1.0)),
    ),
    "wall": (
        Look(4, "painted", (0.55, 0.86), (0.0, 0.16), (0.5, 1.0)),
        Look(1.2, "plaster", (0.5, 0.86), (0.0, 0.25), (0.7, 1.0)),
        Look(1.8, "painted", (0.32, 0.62), (0.08, 0.4), (0.5, 1.0), follows="accent"),
        Look(0.4, "painted", (0.06, 0.25), (0.15, 0.6), (0.45, 1.0), follows="accent"),
        Look(1, "paper", (0.35, 0.8), (0.0, 0.45), (0.5, 1.0), follows="accent", is_printed=True),
    ),
    "tiles": (
        Look(4, "glazed", (0.08, 0.82), (0.0, 0.6), (0.05, 0.32)),
        Look(2, "stone", (0.04, 0.8), (0.0, 0.5), (0.08, 0.45)),
        _white(0.7),
    ),
    "floor": (
        _wood(5, (0.16, 0.55), follows="floor"),
        Look(2, "stone", (0.04, 0.65), (0.0, 0.5), (0.1, 0.6)),
        Look(1.2, "glazed", (0.1, 0.75), (0.0, 0.5), (0.08, 0.3)),
        Look(0.8, "fabric", (0.06, 0.5), (0.0, 0.6), (0.7, 1.0)),
        Look(0.1, "rubber", (0.02, 0.2), (0.0, 0.3), (0.5, 0.9)),
    ),
    "rug": (
        _cloth(3, (0.05, 0.6), (0.0, 0.45)),
        _cloth(2, (0.03, 0.4), (0.2, 0.8), accent=True),
        Look(0.8, "organic", (0.1, 0.5), (0.0, 0.8), (0.5, 1.0)),
    ),
    "joinery": (
        _white(4, (0.2, 0.5), "white"),
        _wood(4, (0.22, 0.6), "wood"),
        _dark(4, (0.2, 0.55), "dark"),
        Look(0.5, "stone", (0.3, 0.8), (0.0, 0.3), (0.08, 0.45)),
    ),
    "radiator": (
        _white(6),
        _dark(0.6),
        Look(0.3, "metal", (0.0, 0.06), roughness=(0.3, 0.65), specular=(0.05, 0.2)),
    ),
    "furniture": (_wood(4), _white(2.2), _muted(1.2), _dark(0.6), _steel(0.8, (0.2, 0.42))),
    "tabletop": (
        _wood(5),
        _white(1),
        _dark(0.5),
        Look(0.7, "stone", (0.03, 0.8), (0.0, 0.4), (0.08, 0.4)),
        _steel(0.4, (0.2, 0.42)),
    ),
    "worktop": (
        Look(3, "stone", (0.03, 0.75), (0.0, 0.5), (0.08, 0.4)),
        _wood(2.5, (0.25, 0.55)),
        _steel(1, (0.18, 0.4)),
    ),
    "legs": (
        _wood(2),
        *_finish(3),
        _dark(1.5),
        _white(0.7),
        Look(2, "glazed", (0.02, 0.85), (0.0, 0.6), (0.04, 0.35)),
        Look(1, "ceramic", (0.03, 0.8), (0.0, 0.9), (0.3, 0.9)),
        Look(1, "plastic", (0.003, 0.08), (0.0, 0.4), (0.15, 0.55)),
    ),
    "upholstery": (
        _cloth(4, (0.05, 0.6), (0.0, 0.42)),
        _cloth(2, (0.04, 0.4), (0.2, 0.75), accent=True),
        Look(1.8, "leather", (0.01, 0.5), (0.0, 0.92), (0.3, 0.75), hue=(-0.01, 0.12)),
    ),
    "curtain": (
        _cloth(4, (0.2, 0.75), (0.0, 0.32)),
        _cloth(1.5, (0.06, 0.5), (0.15, 0.7), accent=True),
        Look(1, "paper", (0.45, 0.8), (0.0, 0.3), (0.6, 1.0)),
        Look(0.5, "organic", (0.15, 0.5), (0.0, 0.8), (0.5, 1.0)),
    ),
    "towel": (
        _cloth(3, (0.35, 0.8), (0.0, 0.4)),
        _cloth(2, (0.06, 0.5), (0.15, 0.75), accent=True),
        Look(0.7, "organic", (0.1, 0.5), (0.0, 0.85), (0.5, 1.0)),
    ),
    "shade": (
        _cloth(4, (0.35, 0.85), (0.0, 0.4)),
        Look(2, "paper", (0.5, 0.85), (0.0, 0.3), (0.6, 1.0)),
        _white(0.5),
        _dark(0.5),
        *_finish(0.5),
    ),
    "appliance": (
        _steel(4, (0.16, 0.42)),
        Look(2.5, "painted", (0.6, 0.85), (0.0, 0.08), (0.1, 0.35)),
        Look(1, "painted", (0.005, 0.03), (0.0, 0.3), (0.08, 0.4)),
    ),
    "sanitary": (
        Look(6, "glazed", (0.68, 0.86), (0.0, 0.12), (0.03, 0.16)),
        Look(0.5, "ceramic", (0.6, 0.86), (0.0, 0.2), (0.1, 0.65)),
        _steel(3, (0.16, 0.42)),
    ),
    "fitting": _finish(5),
    "frame": (_wood(3), _dark(2), _white(1.2), *_finish(1)),
    "cover": (
        Look(3, "paper", (0.02, 0.75), (0.0, 0.9), (0.3, 1.0)),
        Look(1, "fabric", (0.02, 0.5), (0.0, 0.8), (0.6, 1.0)),
        Look(0.8, "leather", (0.01, 0.4), (0.0, 0.92), (0.3, 0.8)),
    ),
    "vessel": (
        Look(4, "glazed", (0.02, 0.85), (0.0, 0.7), (0.04, 0.35)),
        Look(2, "ceramic", (0.03, 0.8), (0.0, 0.9), (0.3, 0.9)),
        _white(1),
        _dark(0.5),
        _muted(0.5),
        *_finish(0.6),
        Look(1, "plastic", (0.02, 0.85), (0.0, 0.9), (0.15, 0.5)),
        Look(1, "rubber", (0.01, 0.4), (0.0, 0.9), (0.5, 0.9)),
    ),
    "utensil": (
        _steel(5),
        Look(3, "wood", (0.05, 0.6), (0.0, 0.92), (0.25, 0.65)),
        Look(2, "plastic", (0.005, 0.1), (0.0, 0.5), (0.2, 0.55)),
        Look(0.7, "plastic", (0.2, 0.8), (0.0, 0.9), (0.2, 0.5)),
        Look(1.5, "painted", (0.02, 0.85), (0.0, 0.9), (0.1, 0.45)),
        Look(1, "ceramic", (0.1, 0.85), (0.0, 0.5), (0.1, 0.8)),
        Look(1, "glazed", (0.05, 0.85), (0.0, 0.7), (0.04, 0.3)),
        Look(1, "rubber", (0.01, 0.3), (0.0, 0.9), (0.5, 0.9)),
        Look(1, "stone", (0.05, 0.7), (0.0, 0.4), (0.08, 0.5)),
        Look(1, "leather", (0.01, 0.4), (0.0, 0.92), (0.3, 0.8)),
    ),
    "gadget": (
        Look(3, "plastic", (0.003, 0.08), (0.0, 0.4), (0.12, 0.55)),
        Look(2, "plastic", (0.5, 0.85), (0.0, 0.12), (0.15, 0.5)),
        Look(0.6, "plastic", (0.1, 0.6), (0.3, 0.95), (0.15, 0.5)),
        _steel(1.5, (0.15, 0.42)),
        Look(1, "wood", (0.05, 0.55), (0.0, 0.92), (0.2, 0.55)),
        _dark(1),
        _white(0.8),
        Look(1, "rubber", (0.01, 0.15), (0.0, 0.3), (0.5, 0.9)),
        Look(1, "leather", (0.01, 0.35), (0.0, 0.92), (0.35, 0.75)),
        Look(1, "fabric", (0.02, 0.4), (0.0, 0.5), (0.6, 1.0)),
    ),
}
"""Looks by kind of surface, with weights relative to others of the kind. Surfaces without looks, such as
``small``, take any class that suits the slot."""

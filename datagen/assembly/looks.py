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
from datagen.foundation.tables import read_table

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
"""Weights of the ranges of accent hues in ``_ACCENTS`` [turns]: earth, ochre, green, blue and rose."""
ACCENT_SPREAD = 0.03  # largest deviation from the accent hue, in turns


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
        """Draw a style; with probability 0.5, floor and furniture have the same wood tone."""
        wood = draws.weighted(_WOODS, _WOOD_WEIGHTS)
        other = draws.weighted(_WOODS, _WOOD_WEIGHTS)
        floor = wood if draws.chance(0.5) else other
        accent = draws.uniform(*draws.weighted(_ACCENTS, _ACCENT_WEIGHTS))
        finish = draws.weighted(_FINISHES, _FINISH_WEIGHTS)
        return cls(wood, floor, accent, finish, draws.weighted(_JOINERY, _JOINERY_WEIGHTS))


@dataclass(frozen=True)
class Look:
    """A material class with ranges of its means: ``value``, ``saturation`` and ``hue`` (in turns; None:
    unchanged) of D, ``roughness`` R, ``specular`` (brightest channel of S) and ``tint`` (saturation of S).

    Looks of a surface are drawn in proportion to ``weight``. ``follows`` names the part of the style that
    replaces ranges: a wood tone or the accent hue. ``only`` is the finish or joinery required of the style.
    Value and saturation may be divided by up to ``stain``, if it exceeds the limit of the class.
    ``is_printed`` allows any hue in any class.
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
        """Return the look with the ranges that follow the style; None if the style excludes it."""
        if self.only is not None and self.only not in (style.finish, style.joinery):
            return None
        plain = replace(self, follows="", only=None)
        if self.follows in ("wood", "floor"):
            tone = style.wood if self.follows == "wood" else style.floor
            return replace(plain, value=tone.value, saturation=tone.saturation, hue=tone.hue)
        if self.follows == "accent":
            return replace(plain, hue=(style.accent_hue - ACCENT_SPREAD, style.accent_hue + ACCENT_SPREAD))
        return plain


KEPT: dict[Surface, float] = {"cover": 0.7, "frame": 0.3, "joinery": 0.3}
"""Probability, by kind of surface, of keeping a material due for replacement; high to vary book covers."""
LOOKS = read_table(__file__, "looks.yaml", dict[Surface, tuple[Look, ...]])
"""Looks by kind of surface. Surfaces without looks, such as ``small``, take any class that suits the slot."""

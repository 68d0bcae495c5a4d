# SPDX-License-Identifier: GPL-3.0-or-later
"""Registry of object sources, and slots that many objects share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from scenes.sources.materials.graph import srgb
from scenes.sources.modelling import PartBuilder, Slot

Build = Callable[[PartBuilder], None]
TABLETOP = "table, shelf, counter, sill"


@dataclass(frozen=True)
class ObjectSource:
    """An object's source. ``supports``: kinds of support surface, separated by commas; ``scale``: range of its
    scale factor; ``yaw_range_rad``: range of its rotation from facing -Y.
    """

    title: str
    category: str
    supports: str
    scale: tuple[float, float]
    yaw_range_rad: tuple[float, float]
    slots: dict[str, Slot]
    build: Build


OBJECTS: dict[str, ObjectSource] = {}


def thing(
    title: str, category: str, *, supports: str = TABLETOP, scale: tuple[float, float] = (0.92, 1.1),
    yaw: float | None = None, **slots: Slot,
) -> Callable[[Build], Build]:  # fmt: skip
    """Decorator that registers an object's builder by its name; ``slots`` are the slots by name.

    ``yaw``: maximum rotation from facing -Y, in degrees, None for any.
    """

    def register(build: Build) -> Build:
        limit = math.pi if yaw is None else math.radians(yaw)
        OBJECTS[build.__name__] = ObjectSource(
            title, category, supports, scale, (-limit, limit), slots, build
        )
        return build

    return register


def glaze(code: str, rough: float = 0.1, source: str = "") -> Slot:
    return Slot(("glazed", "ceramic"), ("glazed", "ceramic"), source, srgb(code), rough, ior=1.55)


def clay(code: str, rough: float = 0.7) -> Slot:
    return Slot(("ceramic",), ("ceramic", "glazed"), color=srgb(code), roughness=rough)


def wood(source: str = "oak") -> Slot:
    return Slot(("wood",), ("wood", "painted"), source)


def wood_tone(code: str, rough: float = 0.45) -> Slot:
    """Plain wood for parts that are too small to show its grain."""
    return Slot(("wood",), ("wood", "painted"), color=srgb(code), roughness=rough)


def metal(
    code: tuple[float, float, float] = (0.56, 0.57, 0.58), rough: float = 0.25, source: str = ""
) -> Slot:
    return Slot(("metal",), ("metal",), source, code, rough, 1.0)


def painted(code: str, rough: float = 0.35, metal_too: bool = True) -> Slot:
    return Slot(
        ("painted",),
        ("painted", "metal", "plastic") if metal_too else ("painted", "wood"),
        color=srgb(code),
        roughness=rough,
    )


def plastic(code: str, rough: float = 0.4) -> Slot:
    return Slot(("plastic",), ("plastic", "painted"), color=srgb(code), roughness=rough)


def rubber(code: str = "1e1e1e", rough: float = 0.72) -> Slot:
    return Slot(("rubber",), ("rubber",), color=srgb(code), roughness=rough)


def fabric(source: str) -> Slot:
    return Slot(("fabric",), ("fabric",), source)


def cloth(code: str, rough: float = 0.9) -> Slot:
    """Fabric of one colour on small parts."""
    return Slot(("fabric",), ("fabric", "leather"), color=srgb(code), roughness=rough, ior=1.4)


def leather(source: str = "leather_brown") -> Slot:
    return Slot(("leather",), ("leather", "fabric"), source)


def paper(code: str, rough: float = 0.88) -> Slot:
    return Slot(("paper",), ("paper",), color=srgb(code), roughness=rough, ior=1.45)


def stone(source: str = "marble_white") -> Slot:
    return Slot(("stone",), ("stone", "ceramic"), source)


def organic(code: str, rough: float = 0.5) -> Slot:
    """An organic material, such as fruit skin, leaves or wax, that is never replaced."""
    return Slot(("organic",), (), color=srgb(code), roughness=rough, ior=1.45)


def fixed(code: str, rough: float = 0.4, kind: str = "other") -> Slot:
    """A material, such as that of a screen or a clock's hands, that is never replaced."""
    return Slot((kind,), (), color=srgb(code), roughness=rough)

# SPDX-License-Identifier: MIT
"""Furniture as data: shapes by slot, support surfaces, lamps, and required free space, in metres.

In an item's frame, the back is the plane y = 0, the front faces -y, x points right for a viewer in front, and
the item rests at z = 0. Items that hang from a ceiling have z = 0 there and extend downwards.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from datagen.formats.asset import SupportKind
from datagen.foundation.axes import affine, rotation
from datagen.foundation.random import Draws
from datagen.parametric.shapes import Floats, Point, Shape

Handle = Literal["bar", "knob", "grip"]
Front = Literal["flat", "framed"]
Legs = Literal["square", "round", "tapered", "metal"]
Hold = Literal["floor", "wall", "ceiling", "surface"]
# shifts of a low-discrepancy sequence, so that shapes use different sections of a pattern
_STEP = np.array([0.6180339887, 0.7548776662])
_PATTERN_M = 4.0


@dataclass(frozen=True)
class Style:
    """Style shared by all furniture of a room."""

    front: Front
    handle: Handle
    legs: Legs
    is_soft: bool
    """True if upholstery is rounded."""

    @property
    def leg_slot(self) -> str:
        """Slot of legs and frames; metal ones share the slot of handles and taps."""
        return "metal" if self.legs == "metal" else "legs"

    @classmethod
    def draw(cls, draws: Draws) -> Style:
        front: Front = draws.weighted(("flat", "framed"), (0.6, 0.4))
        handle: Handle = draws.weighted(("bar", "knob", "grip"), (0.45, 0.3, 0.25))
        legs: Legs = draws.weighted(("square", "round", "tapered", "metal"), (0.23, 0.16, 0.23, 0.38))
        return cls(front, handle, legs, draws.chance(0.55))


@dataclass(frozen=True)
class Support:
    """A rectangle on which objects may stand: its middle (x, y), size, height and the free height above."""

    kind: SupportKind
    middle: tuple[float, float]
    size: tuple[float, float]
    z: float
    clearance_m: float


@dataclass(frozen=True)
class Lamp:
    """A luminous slot with colour temperature, luminous flux and area of the emitting surface."""

    slot: str
    kelvin: float
    lumen: float
    area_m2: float


@dataclass(frozen=True)
class LampPlace:
    """Place for a light that planning may add: a point or, with ``size``, a downward-facing rectangle."""

    at: Point
    size: tuple[float, float] | None = None


def hull_of(boxes: Floats) -> Floats:
    """Return the bounding box (2, 3) of ``boxes`` (k, 2, 3)."""
    return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


@dataclass
class Item:
    """Furniture on a floor, wall, ceiling or surface (``hold``); ``front_m``: free floor needed in front."""

    name: str
    hold: Hold = "floor"
    front_m: float = 0.0
    shapes: list[tuple[str, Shape]] = field(default_factory=list)
    supports: list[Support] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)
    places: list[LampPlace] = field(default_factory=list)
    _boxes: Floats = field(default_factory=lambda: np.zeros((0, 2, 3)))

    def add(self, slot: str, *shapes: Shape) -> None:
        """Append shapes to a slot, each with a different section of the slot's pattern."""
        for shape in shapes:
            shift = _PATTERN_M * ((len(self.shapes) + 1) * _STEP % 1.0)
            self.shapes.append((slot, shape.shifted_uv(float(shift[0]), float(shift[1]))))

    def pair(self, slot: str, reach: float, shape: Shape) -> None:
        """Append a shape twice, moved by ``reach`` metres to the left and to the right."""
        self.add(slot, shape.moved(-reach), shape.moved(reach))

    def support(
        self,
        kind: SupportKind,
        middle: tuple[float, float],
        size: tuple[float, float],
        z: float,
        clearance_m: float = 1.2,
    ) -> None:
        self.supports.append(Support(kind, middle, size, z, clearance_m))

    def boxes(self) -> Floats:
        """Return the bounding box (k, 2, 3) of each of the item's shapes, in the item's frame."""
        if len(self._boxes) != len(self.shapes):
            self._boxes = np.stack([shape.bounds for _, shape in self.shapes])
        return self._boxes

    @property
    def bounds(self) -> Floats:
        """Lower and upper corner (2, 3) of the bounding box, in the item's frame."""
        return hull_of(self.boxes())


@dataclass(frozen=True)
class Placed:
    """An item rotated by ``yaw_rad`` about z, then moved to ``at``; ``stands_on`` names the item below it."""

    item: Item
    name: str
    at: Point
    yaw_rad: float
    stands_on: str = ""

    @property
    def room_from_item(self) -> Floats:
        """Rigid transform (4, 4) from the item's frame to the room's."""
        return affine(np.round(rotation("z", self.yaw_rad), 12), self.at)

    def point(self, x: float, y: float, z: float = 0.0) -> Point:
        """Transform a point from the item's frame to the room's."""
        at = self.room_from_item @ np.array([x, y, z, 1.0])
        return (float(at[0]), float(at[1]), float(at[2]))

    def boxes(self) -> Floats:
        """Return the bounding boxes (k, 2, 3) of the item's shapes, in the room's frame."""
        matrix = self.room_from_item
        turn = matrix[:3, :3]
        if np.allclose(np.abs(turn), np.round(np.abs(turn)), atol=1e-5):  # multiples of 90 degrees
            ends = self.item.boxes() @ np.round(turn).T + matrix[:3, 3]
            return np.sort(ends, axis=1)
        found = []
        for _, shape in self.item.shapes:
            points = shape.points @ turn.T + matrix[:3, 3]
            found.append((points.min(axis=0), points.max(axis=0)))
        return np.array(found)

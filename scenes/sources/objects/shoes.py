# SPDX-License-Identifier: GPL-3.0-or-later
"""Shoes."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import Slot, Workshop
from scenes.sources.objects.registry import (
    cloth,
    fabric,
    leather,
    rubber,
    thing,
)
from scenes.sources.shapes import Shape, join, loft, tube


def _sole(length: float, width: float, scale: float = 1.0, count: int = 36) -> np.ndarray:
    """Outline of a right foot's sole about its middle, toe towards -y."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    y = -length / 2 * np.sin(angle)
    t = (y + length / 2) / length  # 0 at the toe
    half = (
        width
        / 2
        * (
            0.80
            + 0.20 * np.cos(2 * np.pi * np.clip((t - 0.28) / 1.25, -0.5, 0.5))
            - 0.16 * np.exp(-(((t - 0.62) / 0.16) ** 2))
        )
    )
    x = half * np.cos(angle) + 0.006 * np.sin(np.pi * t)
    return np.column_stack([x * scale, y * (1 - (1 - scale) * 0.4)])


def _upper(
    length: float, width: float, base: float, heights: tuple[float, float, float], opening: float
) -> list[np.ndarray]:
    """Rings from the sole to the collar; ``heights`` at toe, instep and heel."""
    rings = []
    outline = _sole(length, width)
    t = (outline[:, 1] + length / 2) / length
    top = np.interp(t, [0.0, 0.25, 0.5, 1.0], [heights[0] * 0.75, heights[0], heights[1], heights[2]])
    for s in (0.0, 0.2, 0.45, 0.7, 0.88, 1.0):
        lean = 1 - 0.62 * s**2.2 * np.interp(t, [0.0, 0.3, 0.55, 1.0], [0.55, 0.9, 0.35, 0.12])
        y_in = outline[:, 1] + (opening - outline[:, 1]) * s**3 * np.interp(
            t, [0, 0.45, 0.75, 1.0], [0.86, 0.55, 0.06, 0.05]
        )
        rings.append(np.column_stack([outline[:, 0] * lean, y_in, base + top * s]))
    return rings


def _shoe(
    w: Workshop,
    part: str,
    *,
    upper: str,
    sole: str,
    lining: str,
    length: float = 0.285,
    width: float = 0.102,
    heights: tuple[float, float, float] = (0.05, 0.085, 0.075),
    thick: float = 0.024,
    mirror: bool = False,
) -> list[tuple[str, Shape]]:
    flip = (lambda p: p * [-1, 1, 1]) if mirror else (lambda p: p)
    base = _sole(length, width)
    rim = [
        np.column_stack([base * s, np.full(len(base), z)])
        for s, z in ((0.95, 0.0), (1.0, 0.004), (1.02, thick * 0.7), (1.0, thick), (0.97, thick))
    ]
    pieces = [(sole, loft(np.array(rim)))]
    rings = _upper(length * 0.985, width * 0.97, thick - 0.002, heights, length * 0.2)
    centre = rings[-1].mean(axis=0)
    inner = [rings[-1] + [0, 0, 0.002]]
    inner += [
        np.column_stack(
            [
                centre[0] + (rings[-1][:, 0] - centre[0]) * s,
                centre[1] + (rings[-1][:, 1] - centre[1]) * s,
                rings[-1][:, 2] - d,
            ]
        )
        for s, d in ((0.95, 0.0), (0.93, 0.012))
    ]
    pieces.append((upper, loft(np.array([*rings, *inner[:2]]), capped=False)))
    floor = [
        np.column_stack(
            [
                centre[0] + (rings[-1][:, 0] - centre[0]) * s,
                centre[1] + (rings[-1][:, 1] - centre[1]) * s,
                np.full(len(rings[-1]), z),
            ]
        )
        for s, z in ((0.9, thick + 0.02), (0.5, thick + 0.006), (0.05, thick + 0.005))
    ]
    pieces.append((lining, loft(np.array([*inner[1:], *floor]), capped=False)))
    result = []
    for slot, shape in pieces:
        bent = shape.bent(flip)
        if mirror:
            bent = bent.flipped()
        result.append((slot, bent))
    return result


def _laces(length: float, thick: float, heights: tuple[float, float, float], width: float) -> Shape:
    rings = _upper(length * 0.985, width * 0.97, thick - 0.002, heights, length * 0.2)
    front = rings[-1][:, 1].min()
    bars = []
    for k in range(5):
        y = front - 0.008 - 0.0135 * k
        z = thick + heights[1] * (0.97 - 0.105 * k) + 0.001
        half = 0.017 + 0.002 * k
        bars.append(
            tube(
                [
                    (-half, y, z - 0.008),
                    (-half * 0.4, y - 0.002, z),
                    (half * 0.4, y + 0.002, z),
                    (half, y, z - 0.008),
                ],
                0.0022,
                6,
                smooth=2,
            )
        )
    return join(bars)


def _pair(w: Workshop, pieces: dict[bool, list[tuple[str, Shape]]], gap: float) -> None:
    for mirror, items in pieces.items():
        side = 1 if mirror else -1
        for slot, shape in items:
            w["left" if mirror else "right", slot] += shape.turned("z", 4.0 * side).moved(
                x=side * gap / 2, y=0.012 * side
            )


SHOES = "floor"


@thing(
    "Trainers",
    "shoe",
    supports=SHOES,
    upper=fabric("canvas_grey"),
    sole=rubber("dedbd2", 0.6),
    lining=cloth("2d2f33"),
    lace=cloth("e6e3da"),
)
def shoes_trainers(w: Workshop) -> None:
    pieces = {}
    for mirror in (False, True):
        items = _shoe(w, "shoe", upper="upper", sole="sole", lining="lining", thick=0.03, mirror=mirror)
        items.append(("lace", _laces(0.285, 0.03, (0.05, 0.085, 0.075), 0.102)))
        pieces[mirror] = items
    _pair(w, pieces, 0.13)


@thing(
    "Leather shoes",
    "shoe",
    supports=SHOES,
    upper=leather("leather_brown"),
    sole=leather("leather_black"),
    lining=cloth("a88a62", 0.7),
    lace=cloth("2a1c12"),
)
def shoes_leather(w: Workshop) -> None:
    heights = (0.042, 0.078, 0.066)
    pieces = {}
    for mirror in (False, True):
        items = _shoe(
            w,
            "shoe",
            upper="upper",
            sole="sole",
            lining="lining",
            length=0.295,
            width=0.096,
            heights=heights,
            thick=0.014,
            mirror=mirror,
        )
        items.append(("lace", _laces(0.295, 0.014, heights, 0.096)))
        pieces[mirror] = items
    _pair(w, pieces, 0.125)


@thing(
    "Slippers",
    "shoe",
    supports=SHOES,
    upper=Slot(("fabric",), ("fabric", "leather"), "felt_grey"),
    sole=rubber("3b3632", 0.8),
    lining=cloth("c9b898"),
)
def shoes_slippers(w: Workshop) -> None:
    pieces = {
        mirror: _shoe(
            w,
            "shoe",
            upper="upper",
            sole="sole",
            lining="lining",
            length=0.27,
            width=0.105,
            heights=(0.052, 0.06, 0.036),
            thick=0.012,
            mirror=mirror,
        )
        for mirror in (False, True)
    }
    _pair(w, pieces, 0.13)

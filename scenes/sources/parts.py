# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the parts of objects from tables, which map each part to a list of rows ``{slot: shape}``.

A shape is a dict. Its first key is the name of the function that makes it, with the first argument as value.
Further keys are other arguments of the function, or methods of :class:`Shape` with lists of arguments,
applied in order. A list of positions as ``at`` or ``moved`` makes one shape per position. An outline, path or
list of rings may be given as ``{kind: arguments}``, with a kind from ``_OUTLINES``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Point,
    Shape,
    box,
    cylinder,
    extrude,
    frame,
    hoop,
    join,
    lathe,
    loft,
    mirrored,
    panel,
    pillow,
    rounded_rectangle,
    rounded_ring,
    soft_box,
    sphere,
    tube,
    vessel,
)

Parts = dict[str, list[dict[str, dict[str, Any]]]]


def handle(
    z_low: float, z_high: float, r_low: float, r_high: float, reach: float, thick: float = 0.0055
) -> Shape:
    """Make a vessel's handle on the +x side, with its ends in the wall, at radii ``r_low`` and ``r_high``."""
    middle = (z_low + z_high) / 2
    path = [(r_high - 0.004, 0, z_high), (r_high + 0.55 * reach, 0, z_high + 0.004), (r_high + reach, 0, middle + 0.25 * (z_high - z_low)),
            (r_low + 0.9 * reach, 0, middle - 0.25 * (z_high - z_low)), (r_low + 0.35 * reach, 0, z_low), (r_low - 0.004, 0, z_low + 0.002)]  # fmt: skip
    bar = tube(path, [thick * 1.25, thick, thick * 0.95, thick * 0.95, thick, thick * 1.3], 10, smooth=5)
    return bar.scaled(1, 1.35, 1)


def plate(radius: float) -> Shape:
    """A plate on z = 0."""
    r = radius
    profile = [(0, 0.0025), (0.52 * r, 0.0025), (0.54 * r, 0), (0.58 * r, 0), (0.61 * r, 0.003), (0.70 * r, 0.0065), (0.76 * r, 0.013),
               (0.97 * r, 0.0215), (0.995 * r, 0.0235), (r, 0.0255), (0.99 * r, 0.0268), (0.965 * r, 0.0262), (0.77 * r, 0.0178),
               (0.72 * r, 0.0125), (0.66 * r, 0.0075), (0.3 * r, 0.0066), (0, 0.0064)]  # fmt: skip
    return lathe(profile, 48)


def dial_face(radius: float) -> Shape:
    """Make a disc about the origin that faces -Y, with UVs in [0, 1]."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.stack([np.cos(angle), np.zeros(40), np.sin(angle)], axis=-1)
    uv = np.stack([0.5 + 0.5 * np.cos(angle), 0.5 + 0.5 * np.sin(angle)], axis=-1)
    return Shape(ring * radius, [tuple(range(40))], uv, True)


def drum_shade(top: float, bottom: float, height: float, segments: int = 36) -> Shape:
    """Make an open conical lampshade with the radii ``top`` and ``bottom``, 3 mm thick."""
    t = 0.003
    outside = [(bottom, 0.0), (bottom + t / 2, 0.002), (top + t / 2, height - 0.002), (top, height)]
    inside = [(top - t / 2, height - 0.002), (bottom - t / 2, 0.002), (bottom, 0.0)]
    return lathe([*outside, *inside], segments)


def spider(radius: float, z: float) -> Shape:
    """Make the three arms at height ``z``, and the stem below, that hold a lampshade of ``radius``."""
    arms = [
        tube([(0, 0, z), (radius * np.cos(a), radius * np.sin(a), z)], 0.0018, 6) for a in (0.3, 2.4, 4.5)
    ]
    return join([*arms, cylinder(0.012, 0.16, (0, 0, z - 0.15), 0.002, 12)])


def _superellipse(half_width: float, half_height: float, x: float, z: float = 0.011) -> list[Point]:
    """Return 20 points of a superellipse of exponent 2.6 about (x, 0, z), in the plane normal to x."""
    p = 2.6
    return [
        (
            x,
            half_width * np.sign(np.cos(a)) * abs(np.cos(a)) ** (2 / p),
            z + half_height * np.sign(np.sin(a)) * abs(np.sin(a)) ** (2 / p),
        )
        for a in np.linspace(0, 2 * np.pi, 20, endpoint=False)
    ]


def _oval(width: float, depth: float, z: float, y: float) -> NDArray:
    """Return an oval about (0, y) at height ``z``, longer towards -y, as points (32, 3)."""
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    front = np.where(np.sin(angle) < 0, 1.12, 0.88)
    return np.column_stack([width / 2 * np.cos(angle), y + depth / 2 * np.sin(angle) * front, np.full(32, z)])


_SHAPES = {
    function.__name__: function
    for function in (
        box, cylinder, dial_face, drum_shade, extrude, frame, handle, hoop, lathe, loft, panel, pillow, plate,
        soft_box, sphere, spider, tube, vessel,
    )
}  # fmt: skip
_OUTLINES: dict[str, Callable[[Any], Any]] = {
    "mirrored": mirrored,
    "rounded_rectangle": lambda size: rounded_rectangle(*size),
    "rounded_rings": lambda rows: [rounded_ring(*row) for row in rows],
    "ovals": lambda rows: [_oval(*row) for row in rows],
    "superellipses": lambda rows: [_superellipse(*row) for row in rows],
}


def add_parts(builder: PartBuilder, parts: Parts) -> None:
    """Add the shapes of the table ``parts`` to a builder."""
    for part, rows in parts.items():
        for row in rows:
            for slot, keys in row.items():
                builder[part, slot] += shapes_of(keys)


def shapes_of(keys: dict[str, Any]) -> Iterator[Shape]:
    """Yield the shapes that ``keys``, the value of a slot in a table's row, describes."""
    for key in {"at", "moved"} & keys.keys():
        if isinstance(keys[key][0], tuple):
            for place in keys[key]:
                yield from shapes_of({**keys, key: place})
            return
    (function, first), *others = keys.items()
    steps = {key: value for key, value in others if hasattr(Shape, key)}
    arguments = {key: value for key, value in others if key not in steps}
    if isinstance(first, dict):
        ((kind, of),) = first.items()
        first = _OUTLINES[kind](of)
    made = _SHAPES[function](first, **arguments)
    for shape in [made] if isinstance(made, Shape) else made:
        for step, values in steps.items():
            for given in zip(values[::2], values[1::2], strict=True) if step == "turned" else [values]:
                shape = getattr(shape, step)(*given)
        yield shape

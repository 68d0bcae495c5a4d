# SPDX-License-Identifier: GPL-3.0-or-later
"""Kitchen furniture, added to a builder's part: back at y = 0, front towards -y, on z = 0; metres."""

from __future__ import annotations

import numpy as np

from scenes.sources.environments.storage import bent_bar
from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Shape,
    box,
    extrude,
    face_normals,
    lathe,
    loft,
    rounded_rectangle,
    rounded_ring,
    soft_box,
    tube,
)


def basin_shape(width: float, depth: float, deep: float) -> Shape:
    """An open rectangular basin about the z axis with a rolled rim at z = 0 and its floor at z = -``deep``."""
    wall = 0.004
    rings = []
    for scale, z, extra in ((1.0, -0.001, 0.014), (1.0, 0.0025, 0.012), (1.0, 0.0025, 0.0), (0.985, -0.012, 0.0), (0.9, -0.85 * deep, 0.0),
                            (0.85, -0.97 * deep, 0.0), (0.55, -deep, 0.0), (0.1, -deep - 0.002, 0.0)):  # fmt: skip
        corner = min(0.05 * max(scale, 0.5), 0.45 * depth * scale)
        rings.append(rounded_ring(width * scale + 2 * extra, depth * scale + 2 * extra, corner, z))
    inside = loft(np.array(rings)[::-1], capped=False)
    outer = [
        np.column_stack([ring[:, :2] * (1 + wall / max(width, depth) * 2), ring[:, 2] - wall])
        for ring in rings[3:]
    ]
    outside = loft(np.array([rings[0], *outer])[::-1], capped=False)
    # the inside must face up, the outside down
    inside = inside if faces_up(inside) else inside.flipped()
    outside = outside.flipped() if faces_up(outside) else outside
    plug = ((0, -0.001), (0.024, -0.001), (0.03, 0.001), (0.03, 0.003), (0.02, 0.0015), (0, 0.001))
    return inside + outside + lathe([(r, -deep + z) for r, z in plug], 24)


def faces_up(shape: Shape) -> bool:
    return float(face_normals(shape.points, shape.faces)[:, 2].sum()) > 0


def worktop(
    w: PartBuilder, width: float, depth: float, height: float, hole: tuple[float, float, float, float]
) -> None:
    """Add a worktop with its upper side at ``height`` and with a ``hole`` (x, y, width, depth)."""
    x, y, hole_width, hole_depth = hole
    thick, x0, x1 = 0.038, x - hole_width / 2, x + hole_width / 2
    front, back = (-depth, y - hole_depth / 2), (y + hole_depth / 2, 0.0)
    for left, right, (low, high) in (
        (-width / 2, x0, (-depth, 0.0)), (x0, x1, front), (x0, x1, back), (x1, width / 2, (-depth, 0.0)),
    ):  # fmt: skip
        at = ((left + right) / 2, (low + high) / 2, height - thick)
        w["worktop", "worktop"] += box((right - left, high - low, thick), at, 0.0, grain=0)


def tap(w: PartBuilder, part: str, slot: str, *, height: float = 0.3, reach: float = 0.2) -> None:
    """Add a swan-neck mixer tap with its spout towards -y."""
    w[part, slot] += lathe(
        [(0, 0), (0.028, 0), (0.028, 0.006), (0.021, 0.012), (0.02, 0.09), (0.013, 0.1), (0, 0.1)], 24
    )
    rise = [(0, 0, 0.09), (0, 0, height * 0.75), (0, -0.25 * reach, height), (0, -0.75 * reach, height)]
    spout = [*rise, (0, -reach, height * 0.8), (0, -reach, height * 0.62)]
    w[part, slot] += tube(spout, 0.0115, 14, smooth=5)
    w[part, slot] += tube(
        [(0.015, 0, 0.06), (0.05, 0, 0.068), (0.085, -0.01, 0.09)], [0.009, 0.006, 0.005], 10, smooth=3
    )


def hob(w: PartBuilder) -> None:
    """Add a glass-ceramic hob about the z axis, with its zones marked by thin rings."""
    w["hob", "dark_glass"] += extrude(rounded_rectangle(0.58, 0.5, 0.012, 3), 0.006, 0.0015)
    for x, y, r in ((-0.15, -0.11, 0.09), (-0.15, 0.12, 0.075), (0.14, -0.11, 0.075), (0.14, 0.12, 0.1)):
        inner, outer = r - 0.0015, r + 0.0015
        ring = [(inner, 0.0055), (outer, 0.0055), (outer, 0.0063), (inner, 0.0063), (inner, 0.0055)]
        w["hob", "hob_marks"] += lathe(ring, 40).moved(x, y)


def oven(w: PartBuilder, height: float) -> None:
    """Add the front of a built-in oven, at y = -0.56: control panel with knobs, window, bar handle."""
    width, y = 0.594, -0.56
    w["oven", "appliances"] += [
        box((width, 0.03, 0.105), (0, y + 0.005, height - 0.105), 0.003, 2, grain=0),
        box((width, 0.035, height - 0.112), (0, y + 0.005, 0), 0.004, 2, grain=0),
    ]
    w["oven", "dark_glass"] += [
        box((width - 0.12, 0.006, height - 0.26), (0, y - 0.014, 0.06), 0.002),
        box((0.12, 0.004, 0.045), (0, y - 0.0105, height - 0.075), 0.001),
    ]
    for x in (-0.23, -0.16, 0.16, 0.23):
        lower = [(0, 0), (0.021, 0), (0.021, 0.004), (0.017, 0.007)]
        upper = [(0.016, 0.024), (0.013, 0.026), (0, 0.0262)]
        w["oven", "knobs"] += lathe([*lower, *upper], 24).turned("x", 90, (x, y - 0.009, height - 0.052))
    z = height - 0.155
    w["oven", "appliances"] += [
        tube([(-0.24, y - 0.05, z), (0.24, y - 0.05, z)], 0.009, 12),
        *[tube([(x, y - 0.01, z), (x, y - 0.05, z)], 0.006, 8) for x in (-0.21, 0.21)],
    ]


def fridge(w: PartBuilder) -> None:
    """Add a fridge with a freezer drawer below."""
    width, height, depth = 0.6, 1.86, 0.64
    w["fridge", "fridge"] += box((width, depth - 0.07, height), (0, -(depth - 0.07) / 2, 0.01), 0.006, 2)
    for low, high in ((0.04, 0.62), (0.63, height)):
        w["fridge", "fridge"] += soft_box(
            (width, 0.062, high - low), (0, -depth + 0.031, low), 0.014, (0, 0, 0), 7
        )
        z = (high - 0.36, high - 0.08) if low < 0.3 else (low + 0.1, low + 0.5)
        x = -width / 2 + 0.05
        w["fridge", "hardware"] += [
            tube([(x, -depth - 0.045, z[0]), (x, -depth - 0.045, z[1])], 0.009, 10),
            *[
                tube([(x, -depth + 0.004, z[0] + o), (x, -depth - 0.045, z[0] + o)], 0.006, 8)
                for o in (0.03, z[1] - z[0] - 0.03)
            ],
        ]


def wall_cupboard(w: PartBuilder, part: str, width: float, height: float, depth: float, columns: int) -> None:
    """Add a wall cupboard with its underside at z = 0."""
    w[part, "upper_units"] += box(
        (width, depth - 0.022, height), (0, -(depth - 0.022) / 2, 0), 0.002, grain=0
    )
    each = width / columns
    for k in range(columns):
        x = -width / 2 + each * (k + 0.5)
        w[part, "upper_units"] += box(
            (each - 0.003, 0.02, height - 0.004), (x, -depth + 0.011, 0.002), 0.003, 2, grain=2
        )
        side = 1 if k % 2 == 0 else -1
        px = x + side * (each / 2 - 0.035)
        y = -depth + 0.001
        path = [(px, y, 0.05), (px, y - 0.028, 0.05), (px, y - 0.028, 0.2), (px, y, 0.2)]
        w[part, "hardware"] += bent_bar(path)

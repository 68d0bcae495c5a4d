# SPDX-License-Identifier: GPL-3.0-or-later
"""Kitchen furniture, added to a builder's part: back at y = 0, front towards -y, on z = 0; metres."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Shape,
    box,
    extrude,
    face_normals,
    join,
    lathe,
    loft,
    rounded_rectangle,
    soft_box,
    tube,
)


def basin_shape(
    width: float, depth: float, deep: float, wall: float = 0.004, corner: float = 0.05, taper: float = 0.88
) -> Shape:
    """An open rectangular basin about the z axis with a rolled rim at z = 0 and its floor at z = -``deep``."""
    rings = []
    for scale, z, extra in ((1.0, -0.001, 0.014), (1.0, 0.0025, 0.012), (1.0, 0.0025, 0.0), (0.985, -0.012, 0.0), (taper + 0.02, -0.85 * deep, 0.0),
                            (taper - 0.03, -0.97 * deep, 0.0), (0.55, -deep, 0.0), (0.1, -deep - 0.002, 0.0)):  # fmt: skip
        outline = np.array(
            rounded_rectangle(
                width * scale + 2 * extra,
                depth * scale + 2 * extra,
                min(corner * max(scale, 0.5), 0.45 * depth * scale),
                5,
            )
        )
        rings.append(np.column_stack([outline, np.full(len(outline), z)]))
    inside = loft(np.array(rings)[::-1], capped=False)
    outer = [
        np.column_stack([ring[:, :2] * (1 + wall / max(width, depth) * 2), ring[:, 2] - wall])
        for ring in rings[3:]
    ]
    outside = loft(np.array([rings[0], *outer])[::-1], capped=False)
    # the inside must face up, the outside down
    inside = inside if faces_up(inside) else inside.flipped()
    outside = outside.flipped() if faces_up(outside) else outside
    plug = lathe(
        [
            (0, -deep - 0.001),
            (0.024, -deep - 0.001),
            (0.03, -deep + 0.001),
            (0.03, -deep + 0.003),
            (0.02, -deep + 0.0015),
            (0, -deep + 0.001),
        ],
        24,
    )
    return inside + outside + plug


def faces_up(shape: Shape) -> bool:
    return float(face_normals(shape.points, shape.faces)[:, 2].sum()) > 0


def worktop(
    w: PartBuilder,
    part: str,
    slot: str,
    *,
    width: float,
    depth: float,
    height: float,
    holes: tuple[tuple[float, float, float, float], ...] = (),
    thick: float = 0.038,
) -> None:
    """Add a worktop with its upper side at ``height`` and with ``holes``, each (x, y, width, depth)."""
    xs = sorted({-width / 2, width / 2, *(v for x, _, hw, _ in holes for v in (x - hw / 2, x + hw / 2))})
    for left, right in pairwise(xs):
        middle = (left + right) / 2
        hole = next((h for h in holes if abs(h[0] - middle) < h[2] / 2), None)
        bands = (
            [(-depth, 0.0)]
            if hole is None
            else [(-depth, hole[1] - hole[3] / 2), (hole[1] + hole[3] / 2, 0.0)]
        )
        for low, high in bands:
            bevel = 0.0 if len(xs) > 2 else 0.003
            w[part, slot] += box(
                (right - left, high - low, thick),
                (middle, (low + high) / 2, height - thick),
                bevel,
                grain=0,
            )


def tap(w: PartBuilder, part: str, slot: str, *, height: float = 0.3, reach: float = 0.2) -> None:
    """Add a swan-neck mixer tap with its spout towards -y."""
    w[part, slot] += lathe(
        [(0, 0), (0.028, 0), (0.028, 0.006), (0.021, 0.012), (0.02, 0.09), (0.013, 0.1), (0, 0.1)], 24
    )
    w[part, slot] += tube(
        [
            (0, 0, 0.09),
            (0, 0, height * 0.75),
            (0, -0.25 * reach, height),
            (0, -0.75 * reach, height),
            (0, -reach, height * 0.8),
            (0, -reach, height * 0.62),
        ],
        0.0115,
        14,
        smooth=5,
    )
    w[part, slot] += tube(
        [(0.015, 0, 0.06), (0.05, 0, 0.068), (0.085, -0.01, 0.09)], [0.009, 0.006, 0.005], 10, smooth=3
    )


def hob(w: PartBuilder, part: str, *, glass: str, mark: str, width: float = 0.58, depth: float = 0.5) -> None:
    """Add a glass-ceramic hob about the z axis, with its zones marked by thin rings."""
    w[part, glass] += extrude(rounded_rectangle(width, depth, 0.012, 3), 0.006, 0.0015)
    for x, y, r in ((-0.15, -0.11, 0.09), (-0.15, 0.12, 0.075), (0.14, -0.11, 0.075), (0.14, 0.12, 0.1)):
        w[part, mark] += lathe(
            [
                (r - 0.0015, 0.0055),
                (r + 0.0015, 0.0055),
                (r + 0.0015, 0.0063),
                (r - 0.0015, 0.0063),
                (r - 0.0015, 0.0055),
            ],
            40,
        ).moved(x, y)


def oven(
    w: PartBuilder,
    part: str,
    *,
    steel: str,
    glass: str,
    knob: str,
    width: float = 0.594,
    height: float = 0.595,
    depth: float = 0.56,
) -> None:
    """Add the front of a built-in oven, at y = -``depth``: control panel with knobs, window, bar handle."""
    y = -depth
    w[part, steel] += [
        box((width, 0.03, 0.105), (0, y + 0.005, height - 0.105), 0.003, 2, grain=0),
        box((width, 0.035, height - 0.112), (0, y + 0.005, 0), 0.004, 2, grain=0),
    ]
    w[part, glass] += [
        box((width - 0.12, 0.006, height - 0.26), (0, y - 0.014, 0.06), 0.002),
        box((0.12, 0.004, 0.045), (0, y - 0.0105, height - 0.075), 0.001),
    ]
    for x in (-0.23, -0.16, 0.16, 0.23):
        w[part, knob] += (
            lathe(
                [
                    (0, 0),
                    (0.021, 0),
                    (0.021, 0.004),
                    (0.017, 0.007),
                    (0.016, 0.024),
                    (0.013, 0.026),
                    (0, 0.0262),
                ],
                24,
            )
            .turned("x", 90)
            .moved(x, y - 0.009, height - 0.052)
        )
    z = height - 0.155
    w[part, steel] += [
        tube([(-0.24, y - 0.05, z), (0.24, y - 0.05, z)], 0.009, 12),
        *[tube([(x, y - 0.01, z), (x, y - 0.05, z)], 0.006, 8) for x in (-0.21, 0.21)],
    ]


def fridge(
    w: PartBuilder,
    part: str,
    *,
    body: str,
    handle: str,
    width: float = 0.6,
    height: float = 1.86,
    depth: float = 0.64,
) -> None:
    """Add a fridge with a freezer drawer below."""
    w[part, body] += box((width, depth - 0.07, height), (0, -(depth - 0.07) / 2, 0.01), 0.006, 2)
    for low, high in ((0.04, 0.62), (0.63, height)):
        w[part, body] += soft_box((width, 0.062, high - low), (0, -depth + 0.031, low), 0.014, (0, 0, 0), 7)
        z = (high - 0.36, high - 0.08) if low < 0.3 else (low + 0.1, low + 0.5)
        x = -width / 2 + 0.05
        w[part, handle] += [
            tube([(x, -depth - 0.045, z[0]), (x, -depth - 0.045, z[1])], 0.009, 10),
            *[
                tube([(x, -depth + 0.004, z[0] + o), (x, -depth - 0.045, z[0] + o)], 0.006, 8)
                for o in (0.03, z[1] - z[0] - 0.03)
            ],
        ]


def wall_cupboard(
    w: PartBuilder,
    part: str,
    *,
    width: float,
    height: float,
    depth: float,
    columns: int,
    slot: str,
    handle: str,
) -> None:
    """Add a wall cupboard with its underside at z = 0."""
    w[part, slot] += box((width, depth - 0.022, height), (0, -(depth - 0.022) / 2, 0), 0.002, grain=0)
    each = width / columns
    for k in range(columns):
        x = -width / 2 + each * (k + 0.5)
        w[part, slot] += box(
            (each - 0.003, 0.02, height - 0.004), (x, -depth + 0.011, 0.002), 0.003, 2, grain=2
        )
        side = 1 if k % 2 == 0 else -1
        px = x + side * (each / 2 - 0.035)
        y = -depth + 0.001
        w[part, handle] += join(
            [
                tube([(px, y, 0.05), (px, y - 0.028, 0.05)], 0.005, 8),
                tube([(px, y - 0.028, 0.05), (px, y - 0.028, 0.2)], 0.006, 8),
                tube([(px, y - 0.028, 0.2), (px, y, 0.2)], 0.005, 8),
            ]
        )

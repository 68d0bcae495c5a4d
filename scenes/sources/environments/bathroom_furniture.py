# SPDX-License-Identifier: GPL-3.0-or-later
"""Bathroom furniture, added to a builder's part: back at y = 0, front towards -y, on z = 0; metres."""

from __future__ import annotations

import numpy as np

from scenes.sources.environments.kitchen_furniture import faces_up
from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Shape,
    box,
    cylinder,
    join,
    lathe,
    loft,
    rounded_ring,
    sheet,
    soft_box,
)


def bathtub(w: PartBuilder) -> None:
    """Add a built-in bath along x with a tiled apron."""
    length, width, height = 1.75, 0.75, 0.56

    def ring(sx: float, sy: float, z: float, corner: float) -> np.ndarray:
        return rounded_ring(sx, sy, corner, z, -width / 2, 6)

    rings = [ring(length, width, height - 0.03, 0.012), ring(length, width, height - 0.004, 0.012), ring(length - 0.01, width - 0.01, height, 0.012), ring(length - 0.13, width - 0.13, height, 0.10),
             ring(length - 0.155, width - 0.155, height - 0.012, 0.11), ring(length - 0.24, width - 0.2, height - 0.25, 0.16), ring(length - 0.36, width - 0.26, height - 0.39, 0.18),
             ring(length - 0.55, width - 0.4, height - 0.42, 0.15), ring(length - 1.2, width - 0.6, height - 0.424, 0.05)]  # fmt: skip
    shape = loft(rings, capped=False)
    shape = shape if faces_up(shape) else shape.flipped()
    centre = ring(length - 1.2, width - 0.6, height - 0.424, 0.05)
    lid = Shape(centre, [tuple(range(len(centre)))], centre[:, :2].copy())
    w["bathtub", "enamel"] += [shape, lid]
    w["bathtub", "tiles"] += _apron(length, width, height)
    w["bathtub", "chrome"] += [
        cylinder(0.03, 0.006, (length / 2 - 0.45, -width / 2, height - 0.425), 0.002),
        lathe([(0, 0), (0.032, 0), (0.034, 0.006), (0.028, 0.01), (0, 0.011)], 24).turned(
            "y", -90, (length / 2 - 0.105, -width / 2, height - 0.15)
        ),
    ]


def _apron(length: float, width: float, height: float) -> Shape:
    t = 0.02
    walls = [box((length - 0.004, t, height - 0.028), (0, -width + t / 2 + 0.002, 0), 0.001, grain=0)]
    for side in (-1, 1):
        at = (side * (length / 2 - t / 2 - 0.002), -width / 2 + 0.01, 0)
        walls.append(box((t, width - 0.03, height - 0.028), at, 0.001, grain=1))
    return join(walls)


def toilet(w: PartBuilder) -> None:
    """Add a close-coupled toilet with its lid down."""

    def ring(sx: float, sy: float, z: float, y: float) -> np.ndarray:
        angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
        front = np.where(np.sin(angle) < 0, 1.12, 0.88)
        return np.column_stack([sx / 2 * np.cos(angle), y + sy / 2 * np.sin(angle) * front, np.full(32, z)])

    w["toilet", "enamel"] += loft(
        [
            ring(0.21, 0.34, 0, -0.36),
            ring(0.22, 0.35, 0.02, -0.36),
            ring(0.2, 0.34, 0.12, -0.36),
            ring(0.28, 0.4, 0.27, -0.4),
            ring(0.36, 0.46, 0.38, -0.42),
            ring(0.365, 0.465, 0.395, -0.42),
        ]
    )
    w["toilet", "seat"] += loft(
        [
            ring(0.37, 0.47, 0.397, -0.42),
            ring(0.38, 0.48, 0.403, -0.42),
            ring(0.378, 0.478, 0.423, -0.42),
            ring(0.36, 0.46, 0.431, -0.42),
        ]
    )
    w["toilet", "enamel"] += [
        soft_box((0.38, 0.18, 0.36), (0, -0.095, 0.39), 0.025, (0, 0, 0), 7),
        soft_box((0.4, 0.2, 0.035), (0, -0.1, 0.752), 0.014, (0, 0, 0.003), 7),
    ]
    button = lathe([(0, 0), (0.022, 0), (0.024, 0.003), (0.02, 0.007), (0, 0.008)], 20)
    w["toilet", "chrome"] += button.moved(0, -0.1, 0.787)


def towel(w: PartBuilder) -> None:
    """Add a towel that hangs over a bar along x at the origin."""
    width, front, back = 0.46, 0.55, 0.4
    turn = np.linspace(0, np.pi, 9)
    y = np.concatenate([np.full(10, -0.016), -0.016 * np.cos(turn[1:-1]), np.full(10, 0.016)])
    z = np.concatenate([np.linspace(-front, 0, 10), 0.016 * np.sin(turn[1:-1]), np.linspace(0, -back, 10)])
    x = np.linspace(-width / 2, width / 2, 19)
    sag = 0.004 * np.sin(11 * x)[None, :] * np.clip(-z / front, 0, 1)[:, None]
    parts = np.broadcast_arrays(x[None], y[:, None] + sag * np.sign(y)[:, None], z[:, None])
    w["towel", "towels"] += sheet(np.stack(parts, axis=-1), 0.007)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures of kitchens and bathrooms as parts of a builder: back at y = 0, front towards -y; metres."""

from __future__ import annotations

import numpy as np

from scenes.sources.environments.storage import bent_bar
from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Shape,
    box,
    cylinder,
    face_normals,
    join,
    lathe,
    loft,
    rounded_ring,
    sheet,
    tube,
)


def basin_shape(width: float, length: float, depth: float) -> Shape:
    """Make an open basin, ``width`` along x and ``length`` along y, from z = 0 down to -``depth``."""
    wall = 0.004
    rings = []
    for scale, z, extra in ((1.0, -0.001, 0.014), (1.0, 0.0025, 0.012), (1.0, 0.0025, 0.0), (0.985, -0.012, 0.0), (0.9, -0.85 * depth, 0.0),
                            (0.85, -0.97 * depth, 0.0), (0.55, -depth, 0.0), (0.1, -depth - 0.002, 0.0)):  # fmt: skip
        corner = min(0.05 * max(scale, 0.5), 0.45 * length * scale)
        rings.append(rounded_ring(width * scale + 2 * extra, length * scale + 2 * extra, corner, z))
    inside = loft(np.array(rings)[::-1], capped=False)
    outer = [
        np.column_stack([ring[:, :2] * (1 + wall / max(width, length) * 2), ring[:, 2] - wall])
        for ring in rings[3:]
    ]
    outside = loft(np.array([rings[0], *outer])[::-1], capped=False)
    # the inside must face up, the outside down
    inside = inside if faces_up(inside) else inside.flipped()
    outside = outside.flipped() if faces_up(outside) else outside
    plug = ((0, -0.001), (0.024, -0.001), (0.03, 0.001), (0.03, 0.003), (0.02, 0.0015), (0, 0.001))
    return inside + outside + lathe([(r, -depth + z) for r, z in plug], 24)


def faces_up(shape: Shape) -> bool:
    return float(face_normals(shape.points, shape.faces)[:, 2].sum()) > 0


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


def wall_cupboard(w: PartBuilder, part: str, width: float, height: float, depth: float, columns: int) -> None:
    """Add a wall cupboard of ``columns`` doors with its underside at z = 0."""
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

# SPDX-License-Identifier: GPL-3.0-or-later
"""Seating and tables as parts of a builder: back at y = 0, front towards -y, on z = 0; metres."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Shape,
    box,
    extrude,
    lathe,
    pillow,
    rounded_rectangle,
    sheet,
    soft_box,
    tube,
)


def sofa(
    w: PartBuilder, part: str, *, width: float = 2.1, seats: int = 3, depth: float = 0.92, cover: str = "sofa", legs: str = "sofa_legs",
    cushions: tuple[str, ...] = (), seat_height: float = 0.43, seed: int = 0,
) -> None:  # fmt: skip
    """Add an upholstered sofa of ``seats`` (1: an armchair); ``cushions``: slots of the scatter cushions."""
    arm, back = 0.19, 0.22
    inner = width - 2 * arm
    size, at = (inner + 0.02, depth - back + 0.03, 0.17), (0, -(depth + back) / 2 + 0.03, 0.11)
    w[part, cover] += soft_box(size, at, 0.03, (0, 0.004, 0), 6)
    for side in (-1, 1):
        at = (side * (width - arm) / 2, -depth / 2, 0.11)
        w[part, cover] += soft_box((arm, depth, 0.50), at, 0.055, (0.012, 0.006, 0.012), 8)
    w[part, cover] += soft_box((inner + 0.01, back, 0.66), (0, -back / 2, 0.11), 0.06, (0, 0.012, 0.012), 8)
    each = inner / seats
    for k in range(seats):
        x = -inner / 2 + each * (k + 0.5)
        size, puff = (each - 0.008, depth - back - 0.005, 0.155), (0.004, 0.014, 0.028)
        at = (x, -(depth + back) / 2 - 0.008, seat_height - 0.155)
        w[part, cover] += soft_box(size, at, 0.045, puff, 10, 0.0022, seed + k)
        cushion = soft_box(
            (each - 0.02, 0.17, 0.44), (0, 0, 0), 0.07, (0.004, 0.034, 0.012), 9, 0.002, seed + 20 + k
        )
        w[part, cover] += cushion.turned("x", -11, (x, -back - 0.115, seat_height - 0.005))
    for side in (-1, 1):
        for y in (-0.07, -depth + 0.09):
            w[part, legs] += lathe([(0, 0), (0.017, 0), (0.02, 0.004), (0.026, 0.12), (0, 0.125)], 16).moved(
                side * (width / 2 - 0.09), y
            )
    for k, slot in enumerate(cushions):
        side = -1 if k % 2 == 0 else 1
        shape = (
            pillow((0.44, 0.44, 0.15), 10, seed=seed + 40 + k).turned("x", 66 - 4 * k).turned("z", side * -16)
        )
        low = shape.points[:, 2].min()
        w[part, slot] += shape.moved(
            side * (inner / 2 - 0.24 - 0.05 * (k // 2)), -back - 0.33, seat_height + 0.012 - low
        )


def table(
    w: PartBuilder, part: str, *, size: tuple[float, float], height: float, thick: float = 0.032, leg: float,
    shelf: float = 0.0, round_corner: float = 0.0,
) -> None:  # fmt: skip
    """Add a table about the z axis, in the slot named ``part``; ``shelf``: height of a shelf, 0 for none."""
    sx, sy = size
    pieces = w[part, part]
    if round_corner:
        plate = extrude(rounded_rectangle(sx, sy, round_corner, 6), thick, 0.006, 2)
        pieces += plate.moved(z=height - thick)
    else:
        pieces += box((sx, sy, thick), (0, 0, height - thick), 0.005, 2, grain=0)
    inset = leg / 2 + 0.03
    for x in (-sx / 2 + inset, sx / 2 - inset):
        for y in (-sy / 2 + inset, sy / 2 - inset):
            pieces += _leg(leg, height - thick).moved(x, y)
    drop = min(0.08, height * 0.15)
    under = height - thick - drop
    for y in (-sy / 2 + inset, sy / 2 - inset):
        pieces += box((sx - 2 * inset - leg, 0.02, drop), (0, y, under), 0.002, grain=0)
    for x in (-sx / 2 + inset, sx / 2 - inset):
        pieces += box((0.02, sy - 2 * inset - leg, drop), (x, 0, under), 0.002, grain=1)
    if shelf:
        size_below = (sx - 2 * inset - 0.01, sy - 2 * inset - 0.01, 0.02)
        pieces += box(size_below, (0, 0, shelf - 0.02), 0.003, grain=0)


def _leg(side: float, height: float) -> Shape:
    shape = box((side, side, height), bevel=0.004, grain=2)

    def narrow(p: np.ndarray) -> np.ndarray:
        q = p.copy()
        q[:, :2] *= (1 - 0.42 * np.clip(1 - p[:, 2] / height, 0, 1))[:, None]
        return q

    return shape.bent(narrow)


def chair(w: PartBuilder) -> None:
    """Add a dining chair about the z axis: turned legs, curved back with three slats, seat pad."""
    frame = w["chair", "chairs"]
    d, wd, h = 0.43, 0.44, 0.45
    for side in (-1, 1):
        x = side * (wd / 2 - 0.02)
        path = [(x, -d / 2 + 0.02, 0.003), (x, -d / 2 + 0.025, 0.25), (x * 0.97, -d / 2 + 0.03, h - 0.02)]
        frame += tube(path, [0.012, 0.017, 0.019], 10, smooth=3)
        frame += (tube([(x * 1.02, d / 2 + 0.03, 0.003), (x, d / 2 - 0.015, 0.3), (x, d / 2 - 0.015, 0.46), (x * 0.97, d / 2 + 0.035, 0.72), (x * 0.95, d / 2 + 0.085, 0.9)],
                                [0.012, 0.018, 0.019, 0.016, 0.013], 10, smooth=4))  # fmt: skip
        frame += box((0.018, d - 0.05, 0.045), (x * 0.98, 0, h - 0.065), 0.004, grain=1)
        frame += tube([(x, -d / 2 + 0.03, 0.2), (x, d / 2 - 0.012, 0.2)], 0.009, 8)
    for y in (-d / 2 + 0.025, d / 2 - 0.02):
        frame += box((wd - 0.05, 0.018, 0.045), (0, y, h - 0.065), 0.004, grain=0)
    for z, y in ((0.60, 0.014), (0.72, 0.036), (0.84, 0.066)):
        u, v = np.linspace(-1, 1, 13), np.linspace(-0.5, 0.5, 4)[:, None]
        bow = 0.032 * (1 - u**2)
        points = np.stack(
            [
                u * (wd / 2 - 0.028) + 0 * v,
                d / 2 + y + bow + 0.4 * 0.07 * v,
                z + 0.075 * v + 0.006 * (1 - u**2),
            ],
            axis=-1,
        )
        frame += sheet(points, 0.014)
    frame += extrude(rounded_rectangle(wd, d, 0.04, 4), 0.018, 0.004).moved(z=h - 0.022)
    w["chair", "chair_seats"] += soft_box(
        (wd - 0.03, d - 0.03, 0.04), (0, 0, h - 0.006), 0.019, (0, 0, 0.014), 9
    )

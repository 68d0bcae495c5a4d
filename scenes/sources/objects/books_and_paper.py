# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that model books, magazines, boxes and baskets."""

from __future__ import annotations

import numpy as np

from scenes.sources.environments import storage
from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Shape,
    box,
    grid,
    hoop,
    mirrored,
    panel,
    sheet,
    tube,
    vessel,
)


def lying_book(thick: float, length: float, deep: float) -> tuple[Shape, Shape]:
    """Make the cover and pages of a book that lies on z = 0, about the z axis, with its spine towards -y."""
    cover, pages = storage.book(thick, length, deep)
    place = [shape.turned("y", 90, (-length / 2, deep / 2, thick / 2)) for shape in (cover, pages)]
    return place[0], place[1]


def book_single(w: PartBuilder) -> None:
    cover, pages = lying_book(0.034, 0.22, 0.15)
    w["book", "cover"] += cover
    w["book", "pages"] += pages


def book_stack(w: PartBuilder) -> None:
    z = 0.0
    for slot, thick, length, deep, angle in (
        ("first", 0.036, 0.26, 0.19, 4),
        ("second", 0.028, 0.235, 0.165, -9),
        ("third", 0.041, 0.215, 0.15, 6),
        ("fourth", 0.02, 0.18, 0.12, -22),
    ):
        for name, shape in zip((slot, "pages"), lying_book(thick, length, deep), strict=True):
            w["books", name] += shape.turned("z", angle, (0.004 * angle / 9, 0, z))
        z += thick + 0.0003


def book_row(w: PartBuilder) -> None:
    covers = ("first", "second", "third", "fourth")
    storage.book_row(w, covers, (-0.12, 0.09, 0.0), width=0.225, height=0.28, seed=19)
    for side in (-1, 1):
        x = side * (0.122 if side < 0 else 0.126)
        w["ends", "iron"] += [
            box((0.003, 0.09, 0.15), (x, 0.0, 0), 0.001),
            box((0.05, 0.09, 0.0018), (x + side * 0.025, 0, 0), 0.0005),
        ]


def book_open(w: PartBuilder) -> None:
    t = np.linspace(0, 1, 14)
    for side in (-1, 1):
        x = side * 0.142 * t
        rise = 0.021 * np.sin(np.pi * np.minimum(t * 1.3 + 0.04, 1.0)) ** 0.7 * (1 - 0.45 * t) + 0.004
        top = np.stack([np.stack([x, np.full(14, y), rise], axis=-1) for y in (-0.105, 0.105)])
        if side < 0:
            top = top[:, ::-1]
        w["pages", "page"] += grid(top, unit_uv=True)
        outline = [(xx, zz) for xx, zz in zip(x, rise, strict=True)]
        for y, flip in ((-0.105, False), (0.105, True)):
            lower = np.stack([x, np.full(14, y), np.full(14, 0.003)], axis=-1)
            upper = np.array([(xx, y, zz) for xx, zz in outline])
            wall = grid(np.stack([lower, upper]))
            w["pages", "edge"] += wall.flipped() if flip != (side < 0) else wall
        wall = grid(np.array([[(x[-1], y, z) for y in (-0.105, 0.105)] for z in (0.003, rise[-1])]))
        w["pages", "edge"] += wall if side > 0 else wall.flipped()
    w["cover", "cover"] += box((0.295, 0.22, 0.003), bevel=0.001)


def magazines(w: PartBuilder) -> None:
    for k, (slot, angle) in enumerate((("second", 7.0), ("third", -12.0), ("second", 3.0))):
        w["magazines", slot] += _closed_magazine().turned(
            "z", angle, (0.004 * k, 0.003 * k, 0.0052 * k + 0.0026)
        )
    w["magazines", "third"] += _closed_magazine().turned("z", -5, (0, 0, 0.0052 * 3 + 0.0026))
    front = panel(0.208, 0.278).turned("x", -90, (0, -0.139, 0.0208 + 0.0026 - 0.0026 + 0.0004))
    w["magazines", "front"] += front.turned("z", -5)


def _closed_magazine() -> Shape:
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 8), np.linspace(-0.5, 0.5, 9))
    return sheet(np.stack([0.21 * u, 0.28 * v, 0 * u], axis=-1), 0.005)


# boxes -------------------------------------------------------------------------------------------------------
def box_cardboard(w: PartBuilder) -> None:
    t, x, y, h = 0.004, 0.3, 0.22, 0.2
    walls = [box((x, t, h), (0, s * (y / 2 - t / 2), 0), 0.0012, grain=0) for s in (-1, 1)] + [
        box((t, y - 2 * t, h), (s * (x / 2 - t / 2), 0, 0), 0.0012, grain=1) for s in (-1, 1)
    ]
    flat = [box((x - 0.004, y / 2 - 0.001, t), (0, s * y / 4, h), 0.0012, grain=0) for s in (-1, 1)]

    def ajar(p: np.ndarray) -> np.ndarray:
        """Raise the inner edge of a flap."""
        q = p.copy()
        q[:, 2] += 0.012 * np.clip(1 - np.abs(p[:, 1]) / (y / 2), 0, 1)
        return q

    flaps = [flat[0], flat[1].bent(ajar)]
    w["box", "board"] += [*walls, box((x - 0.002, y - 0.002, t), (0, 0, 0), 0.001), *flaps]
    w["tape", "tape"] += [
        box((x + 0.0008, 0.05, 0.0006), (0, -0.03, h + t), 0.0001),
        *[box((0.0006, 0.05, 0.06), (s * (x / 2 + 0.0002), -0.03, h + t - 0.06), 0.0001) for s in (-1, 1)],
    ]


def basket(w: PartBuilder) -> None:
    w["basket", "weave"] += vessel(
        [(0.12, 0.002), (0.135, 0.012), (0.15, 0.08), (0.158, 0.15)], 0.009, smooth=3
    )
    w["basket", "weave"] += hoop(0.155, 0.0085, 0.152, 40, 8)
    for side in (-1, 1):
        arch = [
            (side * 0.158, 0.045 * np.cos(a), 0.15 + 0.055 * np.sin(a)) for a in np.linspace(0, np.pi, 13)
        ]
        w["basket", "weave"] += tube(arch, 0.0065, 8)
    w["lining", "lining"] += vessel(
        [(0.112, 0.013), (0.127, 0.02), (0.139, 0.08), (0.1465, 0.148)], 0.003, smooth=3
    )


def bag_paper(w: PartBuilder) -> None:
    x, y, h, t = 0.11, 0.06, 0.3, 0.0012
    rings = []
    for k, z in enumerate(np.linspace(0, h, 9)):
        s = z / h
        pinch = 0.18 * s**2
        corners = [
            (-x, -y * (1 - pinch)),
            (0, -y * (1 - pinch) - 0.004 * np.sin(3 * s)),
            (x, -y * (1 - pinch)),
            (x * (1 - 0.14 * s**2), 0),
            (x, y * (1 - pinch)),
            (0, y * (1 - pinch) + 0.003),
            (-x, y * (1 - pinch)),
            (-x * (1 - 0.14 * s**2), 0),
        ]
        wobble = 0.0018 * np.sin(1.7 * k + np.arange(8) * 2.1) * s
        rings.append([(cx + wb, cy + wb, z) for (cx, cy), wb in zip(corners, wobble, strict=True)])
    lattice = np.array(rings)
    closed = np.concatenate([lattice, lattice[:, :1]], axis=1)
    w["bag", "paper"] += [sheet(closed, t), box((2 * x - 0.004, 2 * y - 0.004, t), bevel=0)]
    for side in (-1, 1):
        yy = side * y * 0.8
        left = [(-0.045, yy, h - 0.03), (-0.043, yy, h + 0.04), (-0.025, yy * 0.9, h + 0.075)]
        w["bag", "handle"] += tube(mirrored(left), 0.0028, 8, smooth=4)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Shelves, books and cabinets, added to a builder's part: back at y = 0, front towards -y, on z = 0; metres."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import Point, Shape, box, join, lathe, sheet, tube


def shelf_unit(
    w: PartBuilder, part: str, *, width: float, height: float, depth: float = 0.3, levels: tuple[float, ...], columns: int = 1,
    slot: str = "shelves", back: bool = True, board: float = 0.022,
) -> None:  # fmt: skip
    """Add an open bookcase; ``levels``: heights of the boards' upper sides."""
    for k in range(columns + 1):
        x = -width / 2 + board / 2 + k * (width - board) / columns
        w[part, slot] += box((board, depth, height), (x, -depth / 2, 0), 0.002, grain=2)
    bay = (width - board) / columns - board
    for k in range(columns):
        x = -width / 2 + board + bay / 2 + k * (bay + board)
        for z in (*levels, height):
            w[part, slot] += box(
                (bay + 0.001, depth - 0.008, board), (x, -depth / 2 + 0.002, z - board), 0.0015, grain=0
            )
    if back:
        w[part, slot] += box((width - 0.01, 0.008, height - 0.03), (0, -0.005, 0.015), 0, grain=2)
    w[part, slot] += box(
        (width - 2 * board, 0.016, max(levels[0] - board, 0.03)), (0, -depth + 0.03, 0), 0.001, grain=0
    )


def book(width: float, height: float, depth: float) -> tuple[Shape, Shape]:
    """The cover and pages of a standing book with its spine to the front, its lower back edge at the origin."""
    t = 0.0025
    cover = box((t, depth, height), (-width / 2 + t / 2, -depth / 2, 0), 0) + box(
        (t, depth, height), (width / 2 - t / 2, -depth / 2, 0), 0
    )
    angle = np.linspace(-np.pi / 2, np.pi / 2, 5)
    spine = np.stack([width / 2 * np.sin(angle), -depth - 0.005 * np.cos(angle), 0 * angle], axis=-1)
    lattice = np.stack([spine + np.array([0, t / 2, z]) for z in (0.0, height)])
    cover = cover + sheet(lattice, t)
    pages = box((width - 2 * t, depth - 0.004, height - 0.008), (0, -depth / 2, 0.004), 0)
    return cover, pages


def book_row(
    w: PartBuilder, part: str, covers: tuple[str, ...], pages: str, *, x: float, width: float, y: float, z: float, height: float, seed: int,
    depth: float = 0.19,
) -> None:  # fmt: skip
    """Add a row of books from ``x`` to ``x + width``, in front of ``y``; the last book leans."""
    rng = np.random.default_rng(seed)
    at = x
    while True:
        thick = float(rng.uniform(0.016, 0.042))
        tall = float(min(rng.uniform(0.185, 0.27), height - 0.015))
        deep = float(min(rng.uniform(0.72, 1.0) * depth, 0.74 * tall + 0.03))
        leans = at + thick + 0.075 > x + width
        if at + thick > x + width:
            return
        cover, block = book(thick, tall, deep)
        # align all spines with the shelf's front edge
        move = (at + thick / 2, y - (depth - deep) + float(rng.uniform(0, 0.008)), z)
        if leans:
            angle = -9.0
            c = np.cos(np.radians(angle))
            lift = thick / 2 * abs(np.sin(np.radians(angle)))
            move = (at + thick / 2 / c + 0.002, move[1], z + lift + 0.0003)
            cover, block = cover.turned("y", angle), block.turned("y", angle)
        slot = covers[int(rng.integers(len(covers)))]
        w[part, slot] += cover.moved(*move)
        w[part, pages] += block.moved(*move)
        if leans:
            return
        at += thick + 0.0012


def cabinet(
    w: PartBuilder, part: str, *, width: float, height: float, depth: float, columns: int, rows: tuple[float, ...] = (1.0,),
    slot: str = "cabinet", top: str = "", handle: str = "hardware", plinth: float = 0.08, overhang: float = 0.012,
    panel: bool = False, knobs: bool = False, top_thick: float = 0.025,
) -> None:  # fmt: skip
    """Add a chest, sideboard or kitchen base unit: carcass, plinth and fronts. ``rows``: relative heights of the
    rows of fronts, from the top.
    """
    top = top or slot
    body = height - top_thick
    w[part, slot] += box(
        (width, depth - 0.022, body - plinth),
        (0, -(depth - 0.022) / 2, plinth),
        0.002,
        grain=2 if height > width else 0,
    )
    if plinth:
        w[part, slot] += box(
            (width - 0.02, depth - 0.08, plinth), (0, -(depth - 0.08) / 2, 0), 0.001, grain=0
        )
    if top_thick:
        w[part, top] += box(
            (width + 2 * overhang, depth + overhang, top_thick),
            (0, -(depth + overhang) / 2, body),
            0.004,
            2,
            grain=0,
        )
    gap = 0.003
    fw = width / columns
    z_top = body - gap
    for share in rows:
        fh = (body - plinth - gap) * share / sum(rows)
        for k in range(columns):
            x = -width / 2 + fw * (k + 0.5)
            fz = z_top - fh + gap
            door = box(
                (fw - gap, 0.02, fh - gap), (x, -depth + 0.011, fz), 0.003, 2, grain=2 if fh > fw else 0
            )
            w[part, slot] += door
            if panel and fh > 0.2:
                rail = 0.06
                for dx in (-1, 1):
                    w[part, slot] += box(
                        (rail, 0.012, fh - gap),
                        (x + dx * (fw - gap - rail) / 2, -depth + 0.001 - 0.004, fz),
                        0.003,
                        grain=2,
                    )
                for dz in (0.0, fh - gap - rail):
                    w[part, slot] += box(
                        (fw - gap - 2 * rail, 0.012, rail),
                        (x, -depth + 0.001 - 0.004, fz + dz),
                        0.003,
                        grain=0,
                    )
            lift = -0.010 if panel and fh > 0.2 else 0.0
            side = 1 if k % 2 == 0 and columns > 1 else -1
            w[part, handle] += _pull((x, -depth + 0.001 + lift, fz), fw, fh, side, knobs)
        z_top -= fh


def _pull(at: Point, fw: float, fh: float, side: int, knobs: bool) -> Shape:
    """The handle or knob of a front ``fw`` wide and ``fh`` high with its lower middle ``at``; a door has it
    on the left (``side`` -1) or right (1)."""
    x, y, z = at
    is_drawer = fh < 0.34
    if knobs:
        px, pz = (x, z + fh / 2) if is_drawer else (x + (fw / 2 - 0.04) * side, z + fh * 0.55)
        knob = lathe(
            [(0, 0), (0.006, 0), (0.006, 0.012), (0.014, 0.018), (0.016, 0.025), (0.011, 0.031), (0, 0.032)],
            18,
        ).turned("x", 90)
        return knob.moved(px, y, pz)
    if is_drawer:
        length = min(0.6 * fw, 0.22)
        left, right, height = x - length / 2, x + length / 2, z + fh - min(0.05, fh / 2)
        path = [(left, y, height), (left, y - 0.028, height), (right, y - 0.028, height), (right, y, height)]
    else:
        px = x + side * (fw / 2 - 0.035)
        low = z + fh * 0.5 if fh < 1.0 else z + fh * 0.45
        path = [(px, y, low), (px, y - 0.028, low), (px, y - 0.028, low + 0.16), (px, y, low + 0.16)]
    return bent_bar(path)


def bent_bar(path: list[Point]) -> Shape:
    """A bar handle along the four points of ``path``, with thinner ends."""
    return join([tube(path[k : k + 2], radius, 8) for k, radius in enumerate((0.005, 0.006, 0.005))])

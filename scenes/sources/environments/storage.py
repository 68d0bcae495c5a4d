# SPDX-License-Identifier: GPL-3.0-or-later
"""Shelves, books and cabinets as parts of a builder: back at y = 0, front towards -y, on z = 0; metres."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import Point, Shape, box, join, lathe, sheet, tube

BOOKS = ("book_red", "book_blue", "book_green", "book_cream", "book_black", "book_ochre")
"""Slots of the covers of books in rooms."""


def shelf_unit(
    w: PartBuilder, part: str, size: Point, levels: tuple[float, ...], columns: int = 1,
    slot: str = "shelves", back: bool = True,
) -> None:  # fmt: skip
    """Add a bookcase of ``size`` (width, depth, height); ``levels``: heights of the boards' upper sides."""
    (width, depth, height), board = size, 0.022
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
    """Make the cover and pages of a standing book, with its back at y = 0 and its spine towards -y."""
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
    w: PartBuilder, covers: tuple[str, ...], start: Point, width: float, height: float, seed: int
) -> None:
    """Add a row of random books of ``width`` metres from ``start`` along x; the last book leans."""
    rng, depth = np.random.default_rng(seed), 0.19
    x, y, z = start
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
        w["books", slot] += cover.moved(*move)
        w["books", "pages"] += block.moved(*move)
        if leans:
            return
        at += thick + 0.0012


def cabinet(
    w: PartBuilder, part: str, size: Point, columns: int, rows: tuple[float, ...] = (1.0,), *,
    slot: str = "", top: str = "", handle: str = "hardware", plinth: float = 0.08, overhang: float = 0.012,
    panelled: bool = False, top_thick: float = 0.025,
) -> None:  # fmt: skip
    """Add a chest, sideboard or kitchen base unit of ``size`` (width, depth, height). ``rows``: relative
    heights of the rows of fronts, from the top; ``panelled`` adds frames and knobs; ``slot`` and ``top``, the
    slots of body and top, default to ``part`` and ``slot``.
    """
    width, depth, height = size
    slot = slot or part
    top = top or slot
    body = height - top_thick
    grain, carcass = 2 if height > width else 0, (width, depth - 0.022, body - plinth)
    w[part, slot] += box(carcass, (0, -(depth - 0.022) / 2, plinth), 0.002, grain=grain)
    if plinth:
        at = (0, -(depth - 0.08) / 2, 0)
        w[part, slot] += box((width - 0.02, depth - 0.08, plinth), at, 0.001, grain=0)
    if top_thick:
        plate = (width + 2 * overhang, depth + overhang, top_thick)
        w[part, top] += box(plate, (0, -(depth + overhang) / 2, body), 0.004, 2, grain=0)
    gap = 0.003
    fw = width / columns
    z_top = body - gap
    for share in rows:
        fh = (body - plinth - gap) * share / sum(rows)
        for k in range(columns):
            x = -width / 2 + fw * (k + 0.5)
            fz = z_top - fh + gap
            grain, y = 2 if fh > fw else 0, -depth + 0.001
            w[part, slot] += box((fw - gap, 0.02, fh - gap), (x, -depth + 0.011, fz), 0.003, 2, grain=grain)
            has_frame = panelled and fh > 0.2
            if has_frame:
                rail = 0.06
                for dx in (-1, 1):
                    at = (x + dx * (fw - gap - rail) / 2, y - 0.004, fz)
                    w[part, slot] += box((rail, 0.012, fh - gap), at, 0.003, grain=2)
                for dz in (0.0, fh - gap - rail):
                    size = (fw - gap - 2 * rail, 0.012, rail)
                    w[part, slot] += box(size, (x, y - 0.004, fz + dz), 0.003, grain=0)
            side = 1 if k % 2 == 0 and columns > 1 else -1
            w[part, handle] += _pull((x, y + (-0.010 if has_frame else 0.0), fz), fw, fh, side, panelled)
        z_top -= fh


def _pull(at: Point, fw: float, fh: float, side: int, knobs: bool) -> Shape:
    """Make the handle or knob of a front ``fw`` wide and ``fh`` high, whose bottom centre is ``at``; on a
    door, it is on the left (``side`` -1) or right (1)."""
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
    """Make a bar handle along the four points of ``path``."""
    return join([tube(path[k : k + 2], radius, 8) for k, radius in enumerate((0.005, 0.006, 0.005))])

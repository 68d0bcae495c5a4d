# SPDX-License-Identifier: MIT
"""Draws pictures for frames as PNG files: landscapes, abstract shapes, twigs, lines."""

from __future__ import annotations

import colorsys
import io
from itertools import product

import numpy as np
from PIL import Image

from datagen.foundation.random import Draws
from datagen.parametric.shapes import Floats

_WIDTH, _HEIGHT = 144, 144
_PAPER = np.array([0.93, 0.91, 0.86])


def print_image(draws: Draws) -> bytes:
    """Draw a small picture in a few similar colours or greys; return it as the bytes of a PNG file."""
    hue, spread = draws.unit(), draws.uniform(0.04, 0.2)
    saturation = 0.0 if draws.chance(0.25) else 1.0
    inks = []
    for _ in range(5):
        h, s = (hue + draws.uniform(-spread, spread)) % 1, saturation * draws.uniform(0.15, 0.65)
        inks.append(np.array(colorsys.hsv_to_rgb(h, s, draws.uniform(0.2, 0.9))))
    y, x = np.mgrid[0:_HEIGHT, 0:_WIDTH] / np.array([_HEIGHT, _WIDTH]).reshape(2, 1, 1)
    picture = np.broadcast_to(_PAPER, (_HEIGHT, _WIDTH, 3)).copy()
    draw = draws.choice((_bands, _blocks, _arcs, _washes, _hills, _twig, _strokes, _grid))
    draw(picture, x, y, inks, draws)
    pixels = np.round(255 * np.clip(picture, 0.02, 0.96)).astype(np.uint8)
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "PNG")
    return data.getvalue()


def _bands(picture: Floats, x: Floats, y: Floats, inks: list[Floats], draws: Draws) -> None:
    picture[:] = inks[0] * 0.3 + 0.7
    for k in range(1, 5):
        wave = 0.06 * np.sin(draws.uniform(3, 9) * x + draws.uniform(0, 6))
        picture[y > 0.2 * k + wave + 0.02 * np.sin(31 * x + k)] = inks[k]


def _blocks(picture: Floats, x: Floats, y: Floats, inks: list[Floats], draws: Draws) -> None:
    for ink in inks:
        x0, y0 = draws.uniform(0.05, 0.7), draws.uniform(0.05, 0.7)
        x1, y1 = x0 + draws.uniform(0.1, 0.4), y0 + draws.uniform(0.1, 0.5)
        picture[(x > x0) & (x < x1) & (y > y0) & (y < y1)] = ink


def _arcs(picture: Floats, x: Floats, y: Floats, inks: list[Floats], draws: Draws) -> None:
    r = np.hypot(x - draws.uniform(0.2, 0.8), y - draws.uniform(0.3, 1.1))
    for k, ink in enumerate(inks):
        inner = 0.1 + 0.16 * k
        picture[(r > inner) & (r < inner + draws.uniform(0.05, 0.14))] = ink


def _washes(picture: Floats, x: Floats, y: Floats, inks: list[Floats], draws: Draws) -> None:
    for ink in inks:
        dx, dy = (x - draws.uniform(0.1, 0.9)) / 0.22, (y - draws.uniform(0.1, 0.9)) / 0.22
        picture += 0.85 * np.exp(-(dx**2 + dy**2))[..., None] * (ink - picture)


def _hills(picture: Floats, x: Floats, y: Floats, inks: list[Floats], draws: Draws) -> None:
    """Draw ridges that darken towards the viewer, below a sky that brightens to the horizon."""
    sky, ground = 0.45 + 0.55 * inks[0], 0.5 * inks[1]
    picture[:] = sky + (0.95 - sky) * y[..., None]
    count = draws.integer(3, 6)
    for k in range(count):
        ridge = 0.35 + 0.5 * (k + draws.unit()) / count
        for octave in range(5):
            step = 2.0**octave
            ridge = ridge + 0.05 / step * np.sin(draws.uniform(4, 8) * step * x + draws.uniform(0, 6))
        near = (k + 1) / count
        picture[y > ridge] = (1 - near) * 0.8 * sky + near * ground


def _twig(picture: Floats, x: Floats, y: Floats, inks: list[Floats], draws: Draws) -> None:
    """Draw a stem with pairs of leaves."""
    lean, bend = draws.uniform(-0.15, 0.15), draws.uniform(-0.2, 0.2)
    length, width = draws.uniform(0.14, 0.28), draws.uniform(0.25, 0.5)

    def middle(t: Floats | float) -> Floats:
        return np.asarray(0.5 + lean * (t - 0.5) + bend * (t - 0.5) ** 2)

    picture[(np.abs(x - middle(y)) < 0.006) & (y > 0.15) & (y < 0.92)] = 0.5 * inks[0]
    for t, side in product(np.linspace(0.2, 0.75, draws.integer(4, 8)).tolist(), (-1, 1)):
        along = 0.8 * side * (x - middle(t)) - 0.6 * (y - t)
        across = 0.6 * side * (x - middle(t)) + 0.8 * (y - t)
        s = np.clip(along / length, 0, 1)
        inside = (along > 0) & (along < length) & (np.abs(across) < width * length * s * (1 - s) * 2)
        picture[inside] = inks[0] if side < 0 else inks[1]


def _strokes(picture: Floats, x: Floats, y: Floats, inks: list[Floats], draws: Draws) -> None:
    """Draw thin closed curves."""
    t = np.linspace(0, 2 * np.pi, 3000)
    for ink in inks[: draws.integer(1, 3)]:
        at = np.full((2, t.size), 0.5)
        for k, row in product(range(1, 5), at):
            row += 0.3 / k**1.3 * draws.uniform(-1, 1) * np.sin(k * t + draws.uniform(0, 6))
        columns, rows = np.clip(at * [[_WIDTH], [_HEIGHT]], 1, _WIDTH - 2).astype(np.int64)
        for shift in (0, 1):
            picture[rows + shift, columns] = picture[rows, columns + shift] = 0.4 * ink


def _grid(picture: Floats, x: Floats, y: Floats, inks: list[Floats], draws: Draws) -> None:
    """Draw a grid of discs or squares in random colours, some left out."""
    count, is_round = draws.integer(3, 7), draws.chance(0.5)
    u, v = (1.2 * count * (x - 0.5) + 0.5 * count) % 1, (1.2 * count * (y - 0.5) + 0.5 * count) % 1
    column = np.floor(1.2 * count * (x - 0.5) + 0.5 * count).astype(np.int64)
    row = np.floor(1.2 * count * (y - 0.5) + 0.5 * count).astype(np.int64)
    inside = (column >= 0) & (column < count) & (row >= 0) & (row < count)
    is_in = np.hypot(u - 0.5, v - 0.5) < 0.42 if is_round else (abs(u - 0.5) < 0.43) & (abs(v - 0.5) < 0.43)
    filled = (draws.units(count, count) * 6).astype(np.int64)
    which = filled[np.clip(row, 0, count - 1), np.clip(column, 0, count - 1)]
    for k, ink in enumerate(inks):
        picture[inside & is_in & (which == k)] = ink

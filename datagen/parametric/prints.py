# SPDX-License-Identifier: MIT
"""Prints for picture frames: bands of a landscape, blocks, arcs or washes, as PNG files."""

from __future__ import annotations

import colorsys
import io

import numpy as np
from PIL import Image

from datagen.foundation.random import Draws

_WIDTH, _HEIGHT = 144, 144


def print_image(draws: Draws) -> bytes:
    """A small picture in a few colours that go together."""
    hue, spread = draws.unit(), draws.uniform(0.04, 0.2)
    paper = np.array([0.93, 0.91, 0.86])
    inks = [
        np.array(
            colorsys.hsv_to_rgb(
                (hue + draws.uniform(-spread, spread)) % 1, draws.uniform(0.15, 0.65), draws.uniform(0.2, 0.9)
            )
        )
        for _ in range(5)
    ]
    y, x = np.mgrid[0:_HEIGHT, 0:_WIDTH] / np.array([_HEIGHT, _WIDTH]).reshape(2, 1, 1)
    picture = np.broadcast_to(paper, (_HEIGHT, _WIDTH, 3)).copy()
    kind = draws.choice(("bands", "blocks", "arcs", "washes"))
    if kind == "bands":
        picture[:] = inks[0] * 0.3 + 0.7
        for k in range(1, 5):
            line = (
                0.2 * k
                + 0.06 * np.sin(draws.uniform(3, 9) * x + draws.uniform(0, 6))
                + 0.02 * np.sin(31 * x + k)
            )
            picture[y > line] = inks[k]
    elif kind == "blocks":
        for ink in inks:
            x0, y0 = draws.uniform(0.05, 0.7), draws.uniform(0.05, 0.7)
            inside = (
                (x > x0) & (x < x0 + draws.uniform(0.1, 0.4)) & (y > y0) & (y < y0 + draws.uniform(0.1, 0.5))
            )
            picture[inside] = ink
    elif kind == "arcs":
        cx, cy = draws.uniform(0.2, 0.8), draws.uniform(0.3, 1.1)
        r = np.hypot(x - cx, y - cy)
        for k, ink in enumerate(inks):
            inner = 0.1 + 0.16 * k
            picture[(r > inner) & (r < inner + draws.uniform(0.05, 0.14))] = ink
    else:
        for ink in inks:
            blot = np.exp(
                -(((x - draws.uniform(0.1, 0.9)) / 0.22) ** 2 + ((y - draws.uniform(0.1, 0.9)) / 0.22) ** 2)
            )
            picture += 0.85 * blot[..., None] * (ink - picture)
    pixels = np.round(255 * np.clip(picture, 0.02, 0.96)).astype(np.uint8)
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "PNG")
    return data.getvalue()

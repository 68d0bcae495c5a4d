# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps, rugs, pictures, radiators and plants as parts of a builder; metres."""

from __future__ import annotations

import numpy as np

from scenes.sources.environments.room import Room
from scenes.sources.modelling import PartBuilder
from scenes.sources.parts import drum_shade, spider
from scenes.sources.shapes import Shape, box, frame, lathe, panel, sheet, tube


def rug(
    w: PartBuilder,
    part: str,
    slot: str,
    size: tuple[float, float],
    at: tuple[float, float],
    border: str = "",
    seed: int = 0,
) -> None:
    """Add a slightly uneven rug centred at ``at`` on the floor; ``border``: slot of its edging, if any."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 33), np.linspace(-0.5, 0.5, 25))
    wave = 0.0012 * np.sin(9 * u + rng.uniform(0, 6)) * np.sin(7 * v + rng.uniform(0, 6))
    edge = np.maximum(np.abs(u), np.abs(v)) * 2
    z = 0.006 + wave * (1 - edge) - 0.0005 * edge
    points = np.stack([at[0] + u * size[0], at[1] + v * size[1], z], axis=-1)
    w[part, slot] += sheet(points, 0.009)
    if border:
        sx, sy, b = size[0] / 2, size[1] / 2, 0.02
        w[part, border] += [*[box((2 * sx, b, 0.0125), (at[0], at[1] + s * sy, 0.0005), 0.004, grain=0) for s in (-1, 1)], *[box((b, 2 * sy, 0.0125), (at[0] + s * sx, at[1], 0.0005), 0.004, grain=1) for s in (-1, 1)]]  # fmt: skip


def floor_lamp(room: Room, x: float, y: float, height: float = 1.55) -> None:
    """Add a floor lamp with a round foot and a drum shade at (x, y), with its light slot."""
    w = room.builder
    foot = [(0, 0), (0.14, 0), (0.145, 0.006), (0.13, 0.018), (0.02, 0.024), (0.011, 0.04)]
    top = [(0.011, height - 0.2), (0.018, height - 0.18), (0, height - 0.17)]
    w["floor_lamp", "hardware"] += lathe([*foot, *top], 28)
    w["floor_lamp", "lamp_shade"] += drum_shade(0.16, 0.21, 0.27).moved(z=height - 0.27)
    w["floor_lamp", "hardware"] += spider(0.155, height - 0.03)
    w.place("floor_lamp", x, y)
    room.point_slot("floor lamp", (x, y, height - 0.12))


def pendant(
    room: Room, x: float, y: float, drop: float, radius: float, slot_m: float, metal: str = "hardware"
) -> None:
    """Add a dome lamp ``drop`` m below the ceiling at (x, y), with a square light slot ``slot_m`` wide."""
    w, ceiling = room.builder, room.height
    z = ceiling - drop
    rose = ((0, -0.03), (0.045, -0.03), (0.055, -0.02), (0.055, 0.002), (0, 0.002))
    w["pendant", metal] += lathe([(x, ceiling + dz) for x, dz in rose], 24)
    w["pendant", metal] += tube([(0, 0, ceiling - 0.02), (0, 0, z + 0.6 * radius)], 0.0035, 8)
    r, h, t = radius, 0.62 * radius, 0.003
    outer = ((1, 0), (0.97, 0.3), (0.82, 0.66), (0.5, 0.93), (0.16, 1.02), (0.1, 1.15), (0.0, 1.17))
    inner = ((0.0, 0.97), (0.16, 0.97), (0.48, 0.88), (0.8, 0.63), (0.955, 0.28))
    dome = [(x * r, y * h) for x, y in (*outer, *inner)]
    w["pendant", "lamp_shade"] += lathe([*dome, (r - t, 0), (r, 0)], 40).moved(z=z)
    w.place("pendant", x, y)
    room.area_slot("pendant", (x, y, z + 0.02), (slot_m, slot_m))


def ceiling_light(
    room: Room, x: float, y: float, radius: float, slot_m: float, metal: str = "hardware"
) -> None:
    """Add a flat round ceiling light at (x, y), and below it a square light slot of side ``slot_m``."""
    w, ceiling = room.builder, room.height
    w["ceiling_light", metal] += (lathe([(0, ceiling + 0.002), (radius, ceiling + 0.002), (radius + 0.006, ceiling - 0.004), (radius + 0.006, ceiling - 0.05), (radius, ceiling - 0.056), (radius - 0.012, ceiling - 0.05),
                              (radius - 0.012, ceiling - 0.03), (0, ceiling - 0.03)][::-1], 40))  # fmt: skip
    shade = ((0, 0.066), (0.6 * radius, 0.064), (radius - 0.014, 0.052), (radius - 0.016, 0.032), (0, 0.032))
    w["ceiling_light", "lamp_shade"] += lathe([(x, ceiling - dz) for x, dz in shade], 40)
    w.place("ceiling_light", x, y)
    room.area_slot("ceiling light", (x, y, ceiling - 0.066 - 0.004), (slot_m, slot_m))


def picture(w: PartBuilder, part: str, size: tuple[float, float], art: str) -> None:
    """Add a framed picture on y = 0, centred at the origin; ``size`` is that of its mount."""
    sx, sy = size
    b = 0.03
    at = (0, -0.012, -sy / 2 - b)
    w[part, "picture_frames"] += frame(sx + 2 * b, sy + 2 * b, b, 0.024, at, segments=2)
    w[part, "mounts"] += box((sx + 0.005, 0.006, sy + 0.005), (0, -0.006, -sy / 2), 0)
    w[part, art] += panel(sx * 0.72, sy * 0.76, (0, -0.0096, -sy * 0.37))


def blind(w: PartBuilder, y: float, low: float, high: float, height: float, radius: float) -> None:
    """Add a blind 1.46 m wide, ``height`` long, from a roll of ``radius`` at ``high`` down to ``low``."""
    w["blind", "blind"] += [
        box((1.46, 0.004, height), (0, y, low), 0.001, grain=2),
        tube([(-0.73, y, low), (0.73, y, low)], 0.011, 10),
        tube([(-0.74, y, high), (0.74, y, high)], radius, 16),
    ]


def radiator(room: Room, wall: str, s: float, width: float, height: float) -> None:
    """Add a column radiator at ``s`` along a wall, 10 cm above the floor."""
    pieces = room.builder["radiator", "radiator"]
    count = int(width / 0.05)
    for k in range(count):
        x = -width / 2 + width * (k + 0.5) / count
        for y in (-0.05, -0.1):
            pieces += tube([(x, y, 0.12), (x, y, 0.10 + height)], 0.013, 8)
    for z in (0.125, 0.095 + height):
        for y in (-0.05, -0.1):
            pieces += tube([(-width / 2, y, z), (width / 2, y, z)], 0.017, 10)
    for side in (-1, 1):
        x = side * width * 0.45
        pieces += tube([(x, -0.075, 0.125), (x, -0.075, 0.005)], 0.009, 8)
        pieces += box((0.03, 0.06, 0.03), (side * width * 0.35, -0.03, 0.05 + height), 0.004)
    room.place(wall, "radiator", s)


def plant(
    w: PartBuilder, height: float, seed: int, pot_radius: float, leaves: int,
    leaf: str = "leaves", stem: str = "stems",
) -> None:  # fmt: skip
    """Add a broad-leaved plant in a pot about the z axis."""
    rng = np.random.default_rng(seed)
    r, h = pot_radius, 1.8 * pot_radius
    outside = [(0, 0), (0.72 * r, 0), (0.74 * r, 0.004), (0.98 * r, 0.9 * h), (1.06 * r, 0.905 * h)]
    inside = [(1.07 * r, h), (0.99 * r, h), (0.93 * r, 0.85 * h), (0.9 * r, 0.8 * h), (0, 0.8 * h)]
    w["plant", "pot"] += lathe([*outside, *inside], 36)
    w["plant", "soil"] += lathe(
        [(0.92 * r, 0.82 * h), (0.7 * r, 0.85 * h), (0.3 * r, 0.84 * h), (0, 0.86 * h)], 24
    )
    for k in range(leaves):
        angle = 2.399963 * k + rng.uniform(-0.2, 0.2)
        rise = 0.35 + 0.65 * (k + 0.5) / leaves
        reach = (0.16 + 0.22 * np.sin(np.pi * min(rise, 0.8))) * height * 0.62 + rng.uniform(-0.02, 0.03)
        tip = np.array([reach * np.cos(angle), reach * np.sin(angle), h + (height - h) * rise])
        base = np.array([0.25 * r * np.cos(angle), 0.25 * r * np.sin(angle), 0.84 * h])
        middle = base * 0.35 + tip * 0.65 + [0, 0, 0.05 * height]
        middle[:2] *= 0.62
        w["plant", stem] += tube(
            [base, (base + middle) / 2 + [0, 0, 0.02], middle, tip],
            [0.005, 0.004, 0.0035, 0.002],
            5,
            smooth=2,
        )
        length = float(rng.uniform(0.75, 1.1)) * 0.2 * height**0.6
        w["plant", leaf] += (
            leaf_blade(length, 0.46 * length, float(rng.uniform(0.15, 0.45)))
            .turned("y", float(rng.uniform(-5, 35)))
            .turned("z", float(np.degrees(angle)), tip)
        )


def leaf_blade(length: float, width: float, droop: float, rows: int = 7) -> Shape:
    """Make a pointed leaf along +x, folded at its midrib, whose tip drops by ``droop`` times ``length``."""
    t = np.linspace(0, 1, rows)
    half = 0.5 * width * np.sin(np.pi * t**0.75) ** 0.8 * (1 - 0.25 * t) + 0.001
    across = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    x = length * t[None, :] + 0 * across[:, None]
    y = across[:, None] * half[None, :]
    z = -droop * length * t[None, :] ** 2 + 0.22 * np.abs(y)
    return sheet(np.stack([x, y, z], axis=-1), 0.0012)

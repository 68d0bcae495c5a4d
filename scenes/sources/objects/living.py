# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that model cushions and plants."""

from __future__ import annotations

import numpy as np

from scenes.sources.environments import decor
from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Shape,
    lathe,
    pillow,
    sheet,
    sphere,
    tube,
)  # fmt: skip


def cushion_square(w: PartBuilder) -> None:
    shape = pillow((0.45, 0.45, 0.16), 13, seed=3)
    w["cushion", "cover"] += shape
    w["cushion", "piping"] += _piping(0.45, 0.45, 0.064, 0.0035)


def _piping(sx: float, sy: float, z: float, radius: float, pinch: float = 0.07) -> Shape:
    t = np.linspace(-1, 1, 15)[:-1]
    sides = [(t, -np.ones(14)), (np.ones(14), t), (-t, np.ones(14)), (-np.ones(14), -t)]
    path = [
        np.stack(
            [sx / 2 * u * (1 - pinch * (1 - v**2)), sy / 2 * v * (1 - pinch * (1 - u**2)), np.full(14, z)],
            axis=-1,
        )
        for u, v in sides
    ]
    return tube(np.concatenate(path), radius, 6, closed=True)


def cushion_round(w: PartBuilder) -> None:
    lower = [(0, 0.012), (0.03, 0.002), (0.1, 0.0), (0.17, 0.012), (0.196, 0.045)]
    upper = [(0.19, 0.085), (0.15, 0.108), (0.08, 0.112), (0.03, 0.1), (0.012, 0.086), (0, 0.084)]
    body = lathe([*lower, *upper], 64, smooth=4)

    def pleats(p: np.ndarray) -> np.ndarray:
        q, a = p.copy(), np.arctan2(p[:, 1], p[:, 0])
        fade = np.clip((np.hypot(p[:, 0], p[:, 1]) - 0.015) / 0.03, 0, 1) * (p[:, 2] > 0.05)
        q[:, 2] += 0.0022 * fade * np.cos(18 * a)
        return q

    w["cushion", "cover"] += body.bent(pleats)
    w["cushion", "button"] += sphere(0.014, (0, 0, 0.09), 20, 0.55)


def cushion_bolster(w: PartBuilder) -> None:
    lower = [(0, 0), (0.05, 0.0), (0.082, 0.008), (0.09, 0.025), (0.092, 0.23)]
    upper = [(0.09, 0.435), (0.082, 0.452), (0.05, 0.46), (0, 0.46)]
    roll = lathe([*lower, *upper], 40)
    roll = roll.turned("y", 90, (-0.23, 0, 0.088))

    def resting(p: np.ndarray) -> np.ndarray:
        """Flatten the underside."""
        return np.column_stack([p[:, :2], np.maximum(p[:, 2], 0.006)])

    w["cushion", "cover"] += roll.bent(resting)
    rings = [
        tube(
            [(x, 0.0905 * np.cos(a), 0.088 + 0.0905 * np.sin(a)) for a in np.linspace(0, np.pi, 20)], 0.003, 6
        )
        for x in (-0.2, 0.2)
    ]
    w["cushion", "cover"] += rings


def plant_broad(w: PartBuilder) -> None:
    decor.plant(w, height=0.42, seed=11, pot_radius=0.075, leaves=20, leaf="leaf", stem="stem")


def plant_snake(w: PartBuilder) -> None:
    _pot(w, 0.08, 0.13)
    rng = np.random.default_rng(4)
    for k in range(11):
        angle, r = 2.4 * k, 0.045 * np.sqrt(k / 11)
        height, width = float(rng.uniform(0.24, 0.46)), float(rng.uniform(0.034, 0.05))
        t = np.linspace(0, 1, 9)[:, None]
        u = np.linspace(-1, 1, 5)[None, :]
        half = (
            0.5 * width * (0.55 + 0.45 * np.sin(np.pi * np.minimum(t * 1.15, 1.0) ** 0.8)) * (1 - t**6)
            + 0.0008
        )
        twist = 0.5 * t * (1 if k % 2 else -1)
        x, y = u * half, 0.35 * np.abs(u) * half + 0.05 * t**2 * (k % 3)
        points = np.stack(
            [
                x * np.cos(twist) - y * np.sin(twist),
                x * np.sin(twist) + y * np.cos(twist),
                np.broadcast_to(height * t, x.shape),
            ],
            axis=-1,
        )
        w["plant", "leaf"] += sheet(points, 0.003).turned(
            "z", float(np.degrees(angle)), (r * np.cos(angle), r * np.sin(angle), 0.108)
        )


def _pot(w: PartBuilder, r: float, h: float) -> None:
    outside = [(0, 0), (0.72 * r, 0), (0.75 * r, 0.003), (0.94 * r, 0.78 * h), (r, 0.785 * h)]
    rim = [(1.02 * r, 0.8 * h), (1.02 * r, 0.985 * h), (r, h), (0.93 * r, h)]
    inside = [(0.9 * r, 0.9 * h), (0.86 * r, 0.8 * h), (0, 0.8 * h)]
    w["pot", "pot"] += lathe([*outside, *rim, *inside], 36)
    w["pot", "soil"] += lathe([(0.885 * r, 0.84 * h), (0.5 * r, 0.87 * h), (0, 0.86 * h)], 24)


def cactus(w: PartBuilder) -> None:
    _pot(w, 0.05, 0.075)
    body = lathe(
        [(0, 0.055), (0.024, 0.056), (0.033, 0.085), (0.035, 0.12), (0.03, 0.15), (0.016, 0.172), (0, 0.178)],
        48,
        smooth=4,
    )

    def ribs(p: np.ndarray) -> np.ndarray:
        q, a = p.copy(), np.arctan2(p[:, 1], p[:, 0])
        q[:, :2] *= (1 + 0.12 * np.cos(12 * a))[:, None]
        return q

    w["cactus", "leaf"] += body.bent(ribs)
    for k in range(12):
        a = 2 * np.pi * k / 12
        for z, r in ((0.085, 0.036), (0.105, 0.0385), (0.125, 0.0385), (0.145, 0.034)):
            for lean in (-0.5, 0.5):
                start = np.array([r * np.cos(a), r * np.sin(a), z])
                tip = start + 0.008 * np.array([np.cos(a + lean), np.sin(a + lean), 0.4])
                w["cactus", "spine"] += tube([start, tip], [0.0005, 0.0003], 3)

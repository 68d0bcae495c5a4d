# SPDX-License-Identifier: GPL-3.0-or-later
"""Candles and statuettes."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    box,
    cylinder,
    lathe,
    loft,
    tube,
    vessel,
)  # fmt: skip


def candlestick(w: PartBuilder) -> None:
    w["stick", "metal"] += (lathe([(0, 0), (0.05, 0), (0.052, 0.004), (0.046, 0.01), (0.02, 0.018), (0.011, 0.03), (0.009, 0.05), (0.015, 0.06), (0.009, 0.07), (0.0085, 0.12), (0.014, 0.13), (0.01, 0.138),
                                   (0.024, 0.146), (0.026, 0.15), (0.0135, 0.15), (0.013, 0.168), (0.0115, 0.168), (0.0112, 0.15), (0, 0.15)], 36))  # fmt: skip
    w["candle", "wax"] += lathe(
        [(0, 0.151), (0.0108, 0.151), (0.0105, 0.34), (0.009, 0.345), (0.004, 0.343), (0, 0.343)], 24
    )
    w["candle", "wick"] += tube([(0, 0, 0.342), (0.0006, 0, 0.35), (0.003, 0, 0.357)], 0.0008, 5)


def candle_bowl(w: PartBuilder) -> None:
    w["bowl", "bowl"] += vessel([(0.03, 0.002), (0.038, 0.01), (0.047, 0.03), (0.048, 0.055)], 0.005)
    w["candle", "wax"] += lathe(
        [(0, 0.01), (0.034, 0.012), (0.0405, 0.03), (0.0418, 0.043), (0.03, 0.042), (0, 0.0405)], 32
    )
    w["candle", "wick"] += tube([(0, 0, 0.04), (0.001, 0, 0.052)], 0.001, 5)


def statuette_knot(w: PartBuilder) -> None:
    t = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    x, y, z = np.sin(t) + 2 * np.sin(2 * t), -np.sin(3 * t) * 0.9, np.cos(t) - 2 * np.cos(2 * t)
    knot = np.stack([x, y, z], axis=-1) * 0.03
    knot[:, 2] -= knot[:, 2].min() - 0.05
    w["knot", "body"] += tube(knot, 0.0165, 14, closed=True)
    w["plinth", "plinth"] += [
        box((0.09, 0.09, 0.036), bevel=0.003, segments=2),
        cylinder(0.012, 0.02, (0, 0, 0.034), 0.002, 16),
    ]


def statuette_bird(w: PartBuilder) -> None:
    x = np.array([-0.075, -0.05, -0.02, 0.012, 0.034, 0.047, 0.058, 0.064])
    z = np.array([0.047, 0.046, 0.044, 0.048, 0.064, 0.08, 0.084, 0.083])
    radius = np.array([0.004, 0.012, 0.03, 0.036, 0.028, 0.021, 0.016, 0.004])
    path = np.column_stack([x, np.zeros(8), z])
    bird = tube(path, radius, 24, smooth=5)
    w["bird", "body"] += bird.bent(
        lambda p: np.column_stack([p[:, 0], p[:, 1] * 0.86, np.maximum(p[:, 2], 0.0125)])
    )
    w["bird", "beak"] += tube([(0.07, 0, 0.084), (0.084, 0, 0.08)], [0.0045, 0.0008], 8)
    w["bird", "body"] += lathe([(0, 0), (0.026, 0), (0.028, 0.003), (0.024, 0.016), (0, 0.018)], 28)


def statuette_torso(w: PartBuilder) -> None:
    w["figure", "body"] += (lathe([(0, 0), (0.044, 0), (0.046, 0.004), (0.043, 0.014), (0.03, 0.022), (0.026, 0.05), (0.034, 0.09), (0.03, 0.13), (0.018, 0.155), (0.013, 0.168), (0.024, 0.176), (0.012, 0.184),
                                   (0.02, 0.196), (0.026, 0.214), (0.02, 0.235), (0, 0.242)], 44, smooth=3))  # fmt: skip


def obelisk(w: PartBuilder) -> None:
    def ring(s: float, z: float) -> list[tuple[float, float, float]]:
        return [(-s, -s, z), (s, -s, z), (s, s, z), (-s, s, z)]

    w["obelisk", "body"] += loft(
        [ring(0.0335, 0.05), ring(0.035, 0.052), ring(0.02, 0.26), ring(0.003, 0.295)]
    )
    w["obelisk", "foot"] += [
        box((0.1, 0.1, 0.028), bevel=0.003, segments=2),
        box((0.085, 0.085, 0.024), (0, 0, 0.027), 0.004, 2),
    ]

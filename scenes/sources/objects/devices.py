# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that model electronic devices."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    box,
    cylinder,
    extrude,
    hoop,
    lathe,
    panel,
    rounded_rectangle,
    soft_box,
    tube,
)


def headphones(w: PartBuilder) -> None:
    # modelled lying on their cups
    arch = [(0.083 * np.cos(a), 0.02 + 0.1 * np.sin(a), 0.0) for a in np.linspace(0.06, np.pi - 0.06, 15)]
    band = tube(arch, 0.006, 10).scaled(1, 1, 2.2)
    pad = tube(
        [(0.079 * np.cos(a), 0.021 + 0.093 * np.sin(a), 0.0) for a in np.linspace(0.9, np.pi - 0.9, 11)],
        0.0065,
        10,
    ).scaled(1, 1, 2.3)
    lowest = 0.034

    def leaning(p: np.ndarray) -> np.ndarray:
        """Tilt the band until its crown touches the table on which the cups rest."""
        q = p.copy()
        q[:, 2] -= (0.034 - 0.006 * 2.2 - lowest) * np.clip((p[:, 1] - 0.02) / 0.1, 0, None)
        return q

    for side in (-1, 1):
        cup = lathe([(0, 0.0), (0.03, 0.001), (0.037, 0.007), (0.038, 0.02), (0.034, 0.024), (0, 0.024)], 36)
        ring = hoop(0.026, 0.0125, 0.031, 32, 12)
        turn = 62 * side
        for slot, shape in (
            ("shell", cup),
            ("pads", ring),
            ("shell", lathe([(0, 0.024), (0.02, 0.025), (0.02, 0.027), (0, 0.027)], 24)),
        ):
            placed = shape.moved(z=-0.02).turned("y", -turn, (side * 0.082, 0.0, 0.034))
            lowest = min(lowest, float(placed.points[:, 2].min()))
            w["cups", slot] += placed
        path = [(side * 0.083, 0.03, 0.034), (side * 0.09, 0.012, 0.034), (side * 0.092, 0.0, 0.034)]
        w["cups", "steel"] += tube(path, 0.004, 8, smooth=3)
    w["band", "steel"] += band.moved(z=0.034).bent(leaning)
    w["band", "pads"] += pad.moved(z=0.034).bent(leaning)


def laptop(w: PartBuilder) -> None:
    w["base", "case"] += extrude(rounded_rectangle(0.32, 0.22, 0.012, 5), 0.013, 0.003, 2).moved(z=0.001)
    for row in range(5):
        count = 12
        for k in range(count):
            w["base", "keys"] += box(
                (0.0195, 0.0165, 0.0018), (-0.136 + k * 0.0247, 0.085 - row * 0.0205, 0.0137), 0.0006
            )
    w["base", "keys"] += [
        box((0.11, 0.0165, 0.0018), (0, 0.085 - 5 * 0.0205, 0.0137), 0.0006),
        box((0.1, 0.065, 0.0006), (0, -0.066, 0.0138), 0.0002),
    ]
    lid = extrude(rounded_rectangle(0.32, 0.21, 0.012, 5), 0.006, 0.002, 2).moved(0, 0.105, -0.003)
    lean = 72
    w["lid", "case"] += lid.turned("x", lean, (0, 0.108, 0.0155))
    glass = panel(0.306, 0.19, (0, 0, 0.01)).moved(0, -0.0003, 0)
    w["lid", "screen"] += glass.turned("x", lean - 90, (0, 0.108, 0.0155)).moved(
        0, -0.0032 * np.sin(np.radians(lean)), 0.0032 * np.cos(np.radians(lean))
    )
    w["base", "case"] += tube([(-0.13, 0.108, 0.0135), (0.13, 0.108, 0.0135)], 0.0045, 10)


def keyboard(w: PartBuilder) -> None:
    slope = np.tan(np.radians(5.0))

    def sloping(p: np.ndarray) -> np.ndarray:
        """Raise the upper side towards the back."""
        rise = np.where(p[:, 2] > 0.006, (p[:, 1] + 0.0675) * slope, 0)
        return np.column_stack([p[:, :2], p[:, 2] + rise])

    w["board", "case"] += box((0.36, 0.135, 0.016), bevel=0.004, segments=2).bent(sloping)
    for row in range(5):
        for k in range(14):
            x, y = -0.162 + 0.0192 * k + 0.0048 * ((row * 7) % 3), 0.048 - 0.0212 * row
            if x > 0.105 and row != 0 and k == 13:
                continue
            z = 0.0155 + (y + 0.0675) * slope
            slot = "dark" if k in (0, 12, 13) or (row == 0 and k % 5 == 0) else "keys"
            w["keys", slot] += box((0.0168, 0.0185, 0.0075), bevel=0.0022).moved(x, y, z)
    for k in range(3):
        for row in range(5):
            y = 0.048 - 0.0212 * row
            key = box((0.0168, 0.0185, 0.0075), bevel=0.0022)
            w["keys", "keys"] += key.moved(0.125 + 0.0192 * k, y, 0.0155 + (y + 0.0675) * slope)


def game_controller(w: PartBuilder) -> None:
    w["pad", "body"] += soft_box((0.145, 0.07, 0.03), (0, 0.01, 0.016), 0.014, (0, 0.002, 0.004), 8)
    for side in (-1, 1):
        path = [(side * 0.055, 0.012, 0.03), (side * 0.066, -0.02, 0.027), (side * 0.07, -0.052, 0.018)]
        w["pad", "body"] += tube(path, [0.0185, 0.0185, 0.0145], 18, smooth=4)
        cap = lathe([(0, 0), (0.012, 0), (0.0125, 0.003), (0.009, 0.004), (0, 0.0028)], 24)
        w["pad", "dark"] += cylinder(0.0085, 0.012, (side * 0.027, -0.012, 0.045), 0.001, 20)
        w["pad", "dark"] += cap.moved(side * 0.027, -0.012, 0.056)
        w["pad", "dark"] += soft_box((0.036, 0.016, 0.029), (side * 0.05, 0.044, 0.0035), 0.005, (0, 0, 0), 6)
    for dx, dy, slot in ((0, 0.012, "blue"), (0, -0.012, "blue"), (0.012, 0, "red"), (-0.012, 0, "red")):
        w["pad", slot] += cylinder(0.0048, 0.005, (0.053 + dx, 0.02 + dy, 0.047), 0.0012, 16)
    w["pad", "dark"] += [
        box((0.026, 0.0085, 0.006), (-0.053, 0.02, 0.0465), 0.001),
        box((0.0085, 0.026, 0.006), (-0.053, 0.02, 0.0465), 0.001),
    ]

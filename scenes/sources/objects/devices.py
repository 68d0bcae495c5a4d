# SPDX-License-Identifier: GPL-3.0-or-later
"""Electronics."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    box,
    cylinder,
    extrude,
    hoop,
    lathe,
    mirrored,
    panel,
    rounded_rectangle,
    soft_box,
    tube,
)


def radio(w: PartBuilder) -> None:
    w["radio", "case"] += soft_box((0.3, 0.13, 0.17), (0, 0, 0.008), 0.022, (0, 0, 0), 8)
    w["radio", "front"] += extrude(rounded_rectangle(0.272, 0.142, 0.014, 5), 0.006, 0.002).turned(
        "x", 90, (0, -0.0625, 0.093)
    )
    w["radio", "grille"] += panel(0.145, 0.115, (-0.052, -0.0688, 0.036))
    w["radio", "dial"] += extrude(rounded_rectangle(0.085, 0.036, 0.004, 3), 0.002, 0.0006).turned(
        "x", 90, (0.077, -0.068, 0.134)
    )
    for x in (0.052, 0.102):
        lower = [(0, 0), (0.016, 0), (0.0165, 0.003), (0.014, 0.005)]
        upper = [(0.0135, 0.016), (0.011, 0.018), (0, 0.0182)]
        w["radio", "knob"] += lathe([*lower, *upper], 28).turned("x", 90, (x, -0.0685, 0.075))
    for x in (-0.12, 0.12):
        for y in (-0.04, 0.04):
            w["radio", "front"] += cylinder(0.009, 0.01, (x, y, 0), 0.002, 16)
    handle = mirrored([(-0.1, 0, 0.176), (-0.1, 0, 0.2), (-0.085, 0, 0.212)])
    w["radio", "knob"] += tube(handle, 0.0045, 10, smooth=3)


def headphones(w: PartBuilder) -> None:
    # modelled in the pose in which they rest on the cups
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


def speaker(w: PartBuilder) -> None:
    w["speaker", "case"] += box((0.18, 0.22, 0.3), (0, 0, 0.006), 0.006, 2, grain=2)
    w["speaker", "cone"] += extrude(rounded_rectangle(0.168, 0.288, 0.008, 3), 0.003, 0.001).turned(
        "x", 90, (0, -0.1095, 0.156)
    )
    for z, r in ((0.105, 0.068), (0.235, 0.034)):
        rim = lathe(
            [(r - 0.008, 0), (r, 0), (r, 0.004), (r - 0.004, 0.006), (r - 0.008, 0.003), (r - 0.008, 0)], 44
        )
        w["speaker", "ring"] += rim.turned("x", 90, (0, -0.1115, z))
        front = [(0, -0.012), (0.3 * r, -0.008), (0.32 * r, -0.014), (0.72 * r, -0.002), (0.8 * r, 0.004)]
        cone = lathe([*front, (0.9 * r, 0.001), (0.92 * r, -0.004), (0, -0.02)], 40)
        w["speaker", "cone"] += cone.moved(z=0.004).turned("x", 90, (0, -0.1115, z))
    for x in (-0.07, 0.07):
        for y in (-0.09, 0.09):
            w["speaker", "cloth"] += cylinder(0.01, 0.007, (x, y, 0), 0.002, 14)


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


def phone(w: PartBuilder) -> None:
    w["phone", "case"] += extrude(rounded_rectangle(0.072, 0.148, 0.011, 6), 0.0078, 0.0024, 3)
    w["phone", "screen"] += panel(0.0655, 0.1405).turned("x", -90, (0, -0.07025, 0.00795))


def camera(w: PartBuilder) -> None:
    outline = rounded_rectangle(0.132, 0.036, 0.012, 5)
    w["camera", "skin"] += extrude(outline, 0.05, 0.002).moved(z=0.01)
    w["camera", "body"] += extrude(outline, 0.0105, 0.002)
    w["camera", "top"] += [
        extrude(outline, 0.018, 0.003, 2).moved(z=0.06),
        box((0.034, 0.034, 0.014), (-0.004, 0, 0.076), 0.005, 2),
    ]
    barrel = [(0, 0), (0.03, 0), (0.03, 0.008), (0.0275, 0.01), (0.0275, 0.022), (0.0295, 0.024)]
    rim = [(0.0295, 0.036), (0.027, 0.038), (0.024, 0.038), (0.0215, 0.032), (0, 0.031)]
    w["camera", "body"] += lathe([*barrel, *rim], 40).turned("x", 90, (-0.004, -0.016, 0.037))
    w["camera", "glass"] += lathe(
        [(0, 0.0365), (0.012, 0.0352), (0.021, 0.0318), (0.0213, 0.031), (0, 0.031)], 32
    ).turned("x", 90, (-0.004, -0.016, 0.037))
    w["camera", "top"] += [
        cylinder(0.0085, 0.008, (0.042, 0, 0.077), 0.001, 24),
        cylinder(0.0045, 0.006, (0.056, -0.004, 0.077), 0.001, 16),
        cylinder(0.0095, 0.007, (-0.045, 0, 0.077), 0.001, 24),
    ]
    w["camera", "glass"] += box((0.016, 0.002, 0.009), (-0.004, -0.0172, 0.078), 0.0006)


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

# SPDX-License-Identifier: GPL-3.0-or-later
"""Kitchenware."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    cylinder,
    extrude,
    join,
    lathe,
    rounded_rectangle,
    sphere,
    tube,
    vessel,
)


def saucepan(w: PartBuilder) -> None:
    w["pan", "steel"] += vessel(
        [(0.084, 0.002), (0.09, 0.006), (0.091, 0.05), (0.0915, 0.1), (0.0945, 0.104)], 0.0022, smooth=3
    )
    lower = [(0.0, 0.1035), (0.088, 0.1035), (0.0945, 0.106), (0.0935, 0.1085)]
    upper = [(0.085, 0.112), (0.04, 0.123), (0, 0.1255)]
    lid = lathe([*lower, *upper], 44)
    w["lid", "steel"] += lid
    grip_lower = [(0, 0.124), (0.008, 0.125), (0.008, 0.133), (0.019, 0.138)]
    grip_upper = [(0.02, 0.144), (0.014, 0.149), (0, 0.15)]
    w["lid", "grip"] += lathe([*grip_lower, *grip_upper], 24)
    w["pan", "steel"] += tube([(0.088, 0, 0.078), (0.115, 0, 0.084), (0.14, 0, 0.09)], 0.0055, 10, smooth=3)
    pan_path = [(0.13, 0, 0.088), (0.17, 0, 0.097), (0.23, 0, 0.106), (0.262, 0, 0.109)]
    w["pan", "grip"] += tube(pan_path, [0.0085, 0.0105, 0.0115, 0.009], 14, smooth=4).scaled(1, 1.25, 1)


def frying_pan(w: PartBuilder) -> None:
    w["pan", "iron"] += vessel(
        [(0.1, 0.002), (0.106, 0.006), (0.122, 0.036), (0.128, 0.045)], 0.004, smooth=3
    )
    path = [(0.12, 0, 0.036), (0.16, 0, 0.045), (0.22, 0, 0.054), (0.27, 0, 0.056)]
    w["pan", "iron"] += tube(path, [0.011, 0.0095, 0.011, 0.012], 12, smooth=4).scaled(1, 1.2, 1)


def knife_block(w: PartBuilder) -> None:
    side = [(-0.075, 0.0), (0.075, 0.0), (0.075, 0.13), (-0.02, 0.215), (-0.075, 0.155)]
    block = extrude(side, 0.1, 0.004, 2).turned("x", 90, (0, 0.05, 0)).turned("z", 90)
    w["block", "wood"] += block
    # the slanted face goes from (y, z) = (-0.02, 0.215) to (0.075, 0.13)
    normal, along = np.array([0.0, 0.667, 0.745]), np.array([0.0, 0.745, -0.667])
    start = np.array([0.0, -0.02, 0.215])
    for x, d, length, thick in (
        (-0.03, 0.03, 0.12, 0.011),
        (0.0, 0.03, 0.115, 0.011),
        (0.03, 0.03, 0.11, 0.01),
        (-0.024, 0.085, 0.1, 0.009),
        (0.006, 0.085, 0.095, 0.009),
        (0.033, 0.085, 0.08, 0.0075),
    ):
        foot = start + along * d + [x, 0, 0]
        w["knives", "steel"] += tube([foot - 0.01 * normal, foot + 0.012 * normal], thick * 0.8, 10)
        w["knives", "grip"] += tube(
            [
                foot + 0.012 * normal,
                foot + 0.35 * length * normal + 0.002 * along,
                foot + length * normal + 0.006 * along,
            ],
            [thick, thick * 0.9, thick * 1.05],
            12,
            smooth=3,
        )


def chopping_board(w: PartBuilder) -> None:
    outline = rounded_rectangle(0.36, 0.22, 0.02, 5)
    w["board", "wood"] += extrude(outline, 0.02, 0.003, 2)
    grip = [(x + 0.22, y) for x, y in rounded_rectangle(0.12, 0.05, 0.02, 5)]
    w["board", "wood"] += extrude(grip, 0.0199, 0.003, 2).moved(z=0.00005)


def kettle(w: PartBuilder) -> None:
    lower = [(0, 0.002), (0.088, 0.002), (0.098, 0.01), (0.102, 0.035)]
    upper = [(0.092, 0.085), (0.06, 0.125), (0.046, 0.132), (0, 0.132)]
    w["kettle", "body"] += lathe([*lower, *upper], 44)
    w["kettle", "steel"] += [
        lathe([(0, 0), (0.09, 0), (0.094, 0.003), (0.09, 0.006), (0, 0.006)], 44),
        lathe([(0, 0.131), (0.045, 0.131), (0.047, 0.135), (0.03, 0.143), (0, 0.146)], 36),
    ]
    w["kettle", "grip"] += sphere(0.013, (0, 0, 0.156), 18)
    body_path = [(-0.08, 0, 0.055), (-0.115, 0, 0.075), (-0.13, 0, 0.105), (-0.147, 0, 0.128)]
    w["kettle", "body"] += tube(body_path, [0.022, 0.017, 0.013, 0.0105], 16, smooth=4)
    w["kettle", "steel"] += [
        tube([(0.062, 0, 0.118), (0.078, 0, 0.16), (0.06, 0, 0.2)], 0.0045, 10, smooth=4),
        tube([(-0.062, 0, 0.118), (-0.078, 0, 0.16), (-0.06, 0, 0.2)], 0.0045, 10, smooth=4),
    ]
    grip_path = [(-0.066, 0, 0.193), (-0.035, 0, 0.215), (0.0, 0, 0.22), (0.035, 0, 0.215), (0.066, 0, 0.193)]
    w["kettle", "grip"] += tube(grip_path, [0.008, 0.011, 0.012, 0.011, 0.008], 12, smooth=4)


def utensil_jar(w: PartBuilder) -> None:
    w["jar", "jar"] += vessel(
        [(0.05, 0.002), (0.056, 0.008), (0.058, 0.08), (0.055, 0.13), (0.058, 0.14)], 0.005, smooth=3
    )
    for slot, angle, lean, head in (
        ("wood", 20, 12, "spoon"),
        ("dark", 140, 14, "spoon"),
        ("wood", 255, 15, "paddle"),
        ("steel", 80, 10, "ladle"),
        ("dark", 200, 9, "paddle"),
    ):
        stick = tube([(0, 0, 0), (0, 0, 0.14), (0, 0, 0.23)], [0.005, 0.0055, 0.005], 8)
        if head == "spoon":
            top = sphere(0.026, (0, 0, 0), 18).scaled(0.9, 0.32, 1.35).moved(0, 0, 0.255)
        elif head == "paddle":
            top = (
                extrude(rounded_rectangle(0.05, 0.08, 0.014, 4), 0.006, 0.002)
                .moved(0, 0, -0.003)
                .turned("x", 90, (0, 0, 0.26))
            )
        else:
            outside = [(0, 0), (0.02, 0.004), (0.034, 0.02), (0.037, 0.035)]
            inside = [(0.0355, 0.035), (0.0325, 0.021), (0.019, 0.006), (0, 0.002)]
            top = lathe([*outside, *inside], 28).turned("x", 60, (0, -0.02, 0.235))
        tool = join([stick, top]).turned("y", lean).turned("z", angle)
        out = 0.014
        w["tools", slot] += tool.moved(
            -out * np.cos(np.radians(angle)), -out * np.sin(np.radians(angle)), 0.0115
        )


def egg_cup(w: PartBuilder) -> None:
    w["cup", "cup"] += vessel(
        [(0.02, 0.001), (0.021, 0.004), (0.011, 0.014), (0.012, 0.022), (0.0225, 0.036), (0.0245, 0.048)],
        0.0025,
        smooth=4,
    )
    lower = [(0, 0.028), (0.013, 0.032), (0.0208, 0.046), (0.0205, 0.058)]
    w["egg", "egg"] += lathe([*lower, (0.014, 0.075), (0.006, 0.082), (0, 0.084)], 28, smooth=3)


def peppermill(w: PartBuilder) -> None:
    lower = [(0, 0), (0.028, 0), (0.03, 0.004), (0.029, 0.02), (0.02, 0.05)]
    upper = [(0.017, 0.08), (0.022, 0.115), (0.021, 0.13), (0.012, 0.1345), (0, 0.1345)]
    w["mill", "wood"] += lathe([*lower, *upper], 32).uv_turned()
    w["mill", "wood"] += lathe(
        [(0, 0.136), (0.018, 0.136), (0.0225, 0.142), (0.024, 0.155), (0.018, 0.17), (0, 0.176)], 32
    ).uv_turned()
    w["mill", "steel"] += [cylinder(0.0115, 0.003, (0, 0, 0.134), 0.0006), sphere(0.007, (0, 0, 0.179), 16)]

# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that model crockery, kitchenware, ornaments, tools and vases."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.parts import handle, plate
from scenes.sources.shapes import (
    Shape,
    box,
    cylinder,
    extrude,
    join,
    lathe,
    rounded_rectangle,
    sphere,
    tube,
    vessel,
)


def cup_and_saucer(w: PartBuilder) -> None:
    w["saucer", "glaze"] += plate(0.074)
    cup = vessel(
        [(0.021, 0.002), (0.024, 0.006), (0.036, 0.028), (0.041, 0.052), (0.0425, 0.06)], 0.0028, foot=0.003
    )
    ear = handle(0.02, 0.05, 0.033, 0.039, 0.022, 0.0034)
    w["cup", "glaze"] += (cup + ear).turned("z", -35, (0, 0, 0.0062))
    w["cup", "coffee"] += cylinder(0.0385, 0.004, (0, 0, 0.0505), 0.0008, 40)


def jug(w: PartBuilder) -> None:
    lower = [(0.044, 0.002), (0.05, 0.008), (0.062, 0.05), (0.058, 0.1)]
    upper = [(0.042, 0.15), (0.046, 0.185), (0.05, 0.195)]
    body = vessel([*lower, *upper], 0.004, foot=0.004)

    def lip(p: np.ndarray) -> np.ndarray:
        q = p.copy()
        weight = (
            np.clip((q[:, 2] - 0.15) / 0.045, 0, 1) ** 2 * np.exp(-((q[:, 1] / 0.02) ** 2)) * (q[:, 0] < 0)
        )
        q[:, 0] -= 0.022 * weight
        q[:, 2] += 0.006 * weight
        return q

    w["jug", "glaze"] += [body.bent(lip), handle(0.065, 0.178, 0.059, 0.044, 0.042, 0.007)]


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


def _lying(shape: Shape, z: float) -> Shape:
    """Rotate a tool that is modelled along z to the x axis, and move it up by ``z``."""
    return shape.turned("y", 90, (0, 0, z))


def screwdriver(w: PartBuilder) -> None:
    lower = [(0, 0), (0.009, 0.001), (0.0145, 0.008), (0.015, 0.03), (0.0125, 0.06)]
    upper = [(0.0145, 0.085), (0.013, 0.098), (0.008, 0.104), (0, 0.104)]
    grip = lathe([*lower, *upper], 48, smooth=2)
    flutes = grip.bent(
        lambda p: np.column_stack(
            [p[:, :2] * (1 + 0.06 * np.cos(6 * np.arctan2(p[:, 1], p[:, 0])))[:, None], p[:, 2]]
        )
    )
    w["driver", "grip"] += _lying(flutes, 0.0159).moved(x=-0.11)
    w["driver", "collar"] += _lying(
        lathe([(0, 0.1), (0.0105, 0.1), (0.0105, 0.108), (0.006, 0.112), (0, 0.112)], 24), 0.0159
    ).moved(x=-0.11)
    w["driver", "steel"] += [
        _lying(lathe([(0, 0.108), (0.003, 0.108), (0.003, 0.2), (0, 0.2)], 16), 0.0159).moved(x=-0.11),
        box((0.02, 0.0075, 0.0022), (0.092, 0, 0.0148), 0.0005),
    ]


def vase_ribbed(w: PartBuilder) -> None:
    outside = [(0.045, 0.002), (0.055, 0.02), (0.068, 0.1), (0.064, 0.18), (0.048, 0.23), (0.052, 0.25)]
    body = vessel(outside, 0.005, segments=84, smooth=3)

    def ribs(p: np.ndarray) -> np.ndarray:
        q, radius = p.copy(), np.hypot(p[:, 0], p[:, 1])
        angle = np.arctan2(p[:, 1], p[:, 0])
        fade = (
            np.clip((p[:, 2] - 0.008) / 0.03, 0, 1)
            * np.clip((0.225 - p[:, 2]) / 0.03, 0, 1)
            * (radius > 0.03)
        )
        factor = 1 + 0.05 * fade * np.cos(14 * angle)
        q[:, :2] *= factor[:, None]
        return q

    w["vase", "glaze"] += body.bent(ribs)


def vase_with_twigs(w: PartBuilder) -> None:
    w["vase", "glaze"] += vessel(
        [(0.04, 0.002), (0.052, 0.015), (0.06, 0.07), (0.042, 0.13), (0.026, 0.165), (0.03, 0.185)],
        0.0045,
        foot=0.003,
    )
    rng = np.random.default_rng(5)
    for i in range(9):
        angle, lean = 2 * np.pi * i / 9 + rng.uniform(-0.3, 0.3), rng.uniform(0.08, 0.22)
        out = np.array([np.cos(angle), np.sin(angle)])
        path = [(*(0.012 * -out), 0.02), (*(0.014 * out), 0.17)]
        for k in range(1, 4):
            path.append(
                (
                    *(out * lean * (k / 3) ** 1.4 + rng.uniform(-0.012, 0.012, 2)),
                    0.17 + 0.125 * k + rng.uniform(-0.02, 0.02),
                )
            )
        w["twigs", "twig"] += tube(path, [0.0026, 0.0024, 0.002, 0.0015, 0.0008], 5, smooth=3)
        for k in (2, 3):
            start = np.array(path[k])
            tip = start + np.array([*(rng.uniform(-0.05, 0.05, 2)), rng.uniform(0.06, 0.11)])
            twig_path = [start, (start + tip) / 2 + rng.uniform(-0.008, 0.008, 3), tip]
            w["twigs", "twig"] += tube(twig_path, [0.0013, 0.001, 0.0005], 5, smooth=2)

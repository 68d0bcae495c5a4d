# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps, frames and clocks."""

from __future__ import annotations

import numpy as np

from scenes.sources.environments import decor
from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Shape,
    box,
    cylinder,
    extrude,
    frame,
    lathe,
    mirrored,
    panel,
    sphere,
    tube,
)  # fmt: skip


def lamp_table(w: PartBuilder) -> None:
    lower = [(0, 0.012), (0.05, 0.012), (0.062, 0.03), (0.082, 0.08), (0.076, 0.13)]
    upper = [(0.045, 0.18), (0.022, 0.205), (0.02, 0.215), (0, 0.215)]
    w["base", "base"] += lathe([*lower, *upper], 40)
    w["base", "metal"] += [
        cylinder(0.058, 0.013, bevel=0.004, segments=40),
        cylinder(0.012, 0.075, (0, 0, 0.21), 0.002, 20),
    ]
    w["base", "metal"] += decor.spider(0.104, 0.44)
    w["shade", "shade"] += decor.drum_shade(0.105, 0.15, 0.19, 40).moved(z=0.255)


def lamp_desk(w: PartBuilder) -> None:
    w["base", "paint"] += lathe(
        [(0, 0), (0.085, 0), (0.09, 0.005), (0.086, 0.018), (0.03, 0.026), (0.018, 0.04), (0, 0.042)], 40
    )
    elbow, head = np.array([0.0, 0.09, 0.27]), np.array([0.0, -0.1, 0.42])
    for x in (-0.011, 0.011):
        w["arm", "steel"] += [
            tube([(x, 0.0, 0.03), (x, *elbow[1:])], 0.0042, 8),
            tube([(x, *elbow[1:]), (x, *head[1:])], 0.0042, 8),
        ]
    for at in ((0, 0, 0.038), tuple(elbow), tuple(head)):
        w["arm", "paint"] += cylinder(0.013, 0.036, (0, 0, -0.018), 0.003, 20).turned("y", 90, at)
    outer = [(0.0, 0.075), (0.022, 0.072), (0.03, 0.06), (0.034, 0.03), (0.05, 0.008), (0.076, -0.035)]
    shell = [
        *outer,
        (0.079, -0.04),
        (0.0775, -0.041),
        (0.074, -0.0355),
        (0.048, 0.007),
        (0.031, 0.028),
        (0, 0.03),
    ]
    lean = 28
    w["head", "paint"] += lathe(shell, 40).turned("x", -lean, head + np.array([0, -0.035, -0.045]))
    w["head", "inside"] += sphere(0.024, segments=20).turned("x", -lean, head + np.array([0, -0.028, -0.066]))


def lantern(w: PartBuilder) -> None:
    s, h = 0.075, 0.2
    w["frame", "iron"] += [
        box((0.165, 0.165, 0.014), (0, 0, 0.006), 0.004, 2),
        box((0.165, 0.165, 0.012), (0, 0, h + 0.015), 0.004, 2),
    ]
    for x in (-s, s):
        for y in (-s, s):
            w["frame", "iron"] += [
                box((0.009, 0.009, h), (x, y, 0.018), 0.002),
                cylinder(0.009, 0.008, (x * 0.9, y * 0.9, 0), 0.003, 16),
            ]
        w["frame", "iron"] += [
            tube([(x, -s, 0.12), (x, s, 0.12)], 0.0028, 8),
            tube([(-s, x, 0.12), (s, x, 0.12)], 0.0028, 8),
        ]
    w["frame", "iron"] += lathe(
        [(0.1, h + 0.026), (0.085, h + 0.045), (0.03, h + 0.08), (0.026, h + 0.1), (0, h + 0.104)], 4
    ).turned("z", 45)
    ring = mirrored([(-0.022, 0, h + 0.098), (-0.03, 0, h + 0.13), (0, 0, h + 0.152)])
    w["frame", "iron"] += tube(ring, 0.003, 8, smooth=5)
    outside = [(0, 0.02), (0.036, 0.02), (0.037, 0.03), (0.0365, 0.112), (0.033, 0.118)]
    inside = [(0.02, 0.114), (0, 0.112)]
    w["candle", "wax"] += lathe([*outside, *inside], 32)
    w["candle", "wick"] += tube([(0, 0, 0.11), (0.001, 0, 0.122), (0.004, 0, 0.13)], 0.0012, 6)


def _standing_frame(w: PartBuilder, width: float, height: float, rim: float) -> None:
    parts = frame(width, height, rim, 0.016, (0, 0, 0), 0.003, 2)
    back = box((width - rim, 0.004, height - rim), (0, 0.005, rim / 2), 0)
    picture = panel(width - 2 * rim, height - 2 * rim, (0, 0.0015, rim))
    lean = -12
    for part in parts:
        w["frame", "frame"] += part.turned("x", lean)
    w["frame", "backing"] += back.turned("x", lean)
    w["frame", "photo"] += picture.turned("x", lean)
    strut = box((0.05, 0.004, height * 0.72), (0, 0, 0), 0.001).turned("x", 20)
    top = 0.72 * height
    w["frame", "backing"] += strut.moved(
        0, np.sin(np.radians(12)) * top + np.sin(np.radians(20)) * top * 0.96 + 0.006, 0.0
    )


def frame_portrait(w: PartBuilder) -> None:
    _standing_frame(w, 0.16, 0.21, 0.02)


def frame_landscape(w: PartBuilder) -> None:
    _standing_frame(w, 0.22, 0.165, 0.014)


def mirror_stand(w: PartBuilder) -> None:
    lower = [(0, 0), (0.07, 0), (0.073, 0.004), (0.066, 0.011)]
    upper = [(0.014, 0.016), (0.008, 0.03), (0.008, 0.13), (0, 0.132)]
    w["stand", "frame"] += lathe([*lower, *upper], 36)
    outside = [(0, -0.006), (0.094, -0.006), (0.1, -0.002), (0.1, 0.005), (0.096, 0.008)]
    inside = [(0.092, 0.0055), (0, 0.0055)]
    disc = lathe([*outside, *inside], 48)
    w["head", "frame"] += disc.turned("x", 78, (0, 0, 0.225))
    glass = lathe([(0, 0.0058), (0.0915, 0.0058), (0.0915, 0.0056), (0, 0.0052)], 48)
    w["head", "mirror"] += glass.turned("x", 78, (0, 0, 0.225))


def _hands(w: PartBuilder, at: tuple[float, float, float], radius: float, hour: float, minute: float) -> None:
    for angle, length, width in ((30 * hour, 0.52, 0.055), (6 * minute, 0.8, 0.035)):
        hand = box((width * radius, 0.0012, length * radius), (0, 0, -0.1 * radius), 0.0003).turned(
            "y", angle
        )
        w["case", "hands"] += hand.moved(*at)
    w["case", "hands"] += cylinder(0.05 * radius, 0.003, segments=16, bevel=0.0005).turned(
        "x", 90, (at[0], at[1] + 0.001, at[2])
    )


def _face(radius: float) -> Shape:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.stack([np.cos(angle), np.zeros(40), np.sin(angle)], axis=-1)
    uv = np.stack([0.5 + 0.5 * np.cos(angle), 0.5 + 0.5 * np.sin(angle)], axis=-1)
    return Shape(ring * radius, [tuple(range(40))], uv, True)


def clock_alarm(w: PartBuilder) -> None:
    r = 0.05
    outside = [(0, 0), (r - 0.006, 0), (r, 0.006), (r, 0.036), (r + 0.003, 0.04), (r + 0.002, 0.046)]
    drum = lathe([*outside, (r - 0.003, 0.047), (r - 0.004, 0.041), (0, 0.041)], 44)
    z = 0.066
    w["case", "case"] += drum.turned("x", 90, (0, 0.022, z))
    w["case", "dial"] += _face(r - 0.0035).moved(0, -0.0192, z)
    _hands(w, (0, -0.0212, z), r, 10.2, 9)
    bell = lathe(
        [(0, 0.016), (0.012, 0.014), (0.0195, 0.006), (0.021, 0), (0.0195, 0), (0.011, 0.012), (0, 0.014)], 28
    )
    for side in (-1, 1):
        w["case", "bells"] += bell.moved(z=0.004).turned("y", 32 * side, (0.034 * side, 0, z + 0.046))
        w["case", "bells"] += tube([(0.027 * side, 0, z + 0.036), (0.036 * side, 0, z + 0.052)], 0.003, 8)
        w["case", "bells"] += tube(
            [(0.028 * side, 0, z - 0.04), (0.037 * side, -0.016, 0.003)], [0.0045, 0.0035], 10
        )
    w["case", "bells"] += tube([(0, 0.014, z - 0.045), (0, 0.03, 0.003)], [0.0045, 0.0035], 10)
    w["case", "bells"] += tube(
        [(-0.016, 0, z + 0.05), (-0.014, 0, z + 0.078), (0.014, 0, z + 0.078), (0.016, 0, z + 0.05)],
        0.002,
        8,
        smooth=4,
    )


def clock_mantel(w: PartBuilder) -> None:
    outline = [(-0.15, 0.03), (0.15, 0.03), (0.14, 0.06), (0.115, 0.085), (0.1, 0.13), (0.08, 0.165), (0.05, 0.186), (0.0, 0.194),
               (-0.05, 0.186), (-0.08, 0.165), (-0.1, 0.13), (-0.115, 0.085), (-0.14, 0.06)]  # fmt: skip
    w["case", "case"] += extrude(outline, 0.09, 0.006, 2).turned("x", 90, (0, 0.045, 0))
    w["case", "case"] += box((0.34, 0.12, 0.03), (0, 0, 0.008), 0.006, 2, grain=0)
    for x in (-0.14, 0.14):
        for y in (-0.04, 0.04):
            w["case", "brass"] += sphere(0.0115, (x, y, 0.0095), 16, 0.82)
    ring = lathe([(0.062, 0), (0.074, 0), (0.075, 0.006), (0.069, 0.01), (0.063, 0.006), (0.062, 0)], 48)
    w["case", "brass"] += ring.turned("x", 90, (0, -0.044, 0.115))
    w["case", "dial"] += _face(0.064).moved(0, -0.0465, 0.115)
    _hands(w, (0, -0.0488, 0.115), 0.064, 4.4, 24)


def hourglass_timer(w: PartBuilder) -> None:
    w["timer", "shell"] += lathe(
        [(0, 0), (0.03, 0), (0.034, 0.004), (0.037, 0.02), (0.033, 0.036), (0.03, 0.0375), (0, 0.0375)],
        36,
    )
    w["timer", "knob"] += [
        lathe([(0, 0.0378), (0.031, 0.0378), (0.032, 0.041), (0.03, 0.052), (0.02, 0.058), (0, 0.0595)], 36),
        box((0.008, 0.044, 0.012), (0, 0, 0.054), 0.003, 2),
    ]

# SPDX-License-Identifier: GPL-3.0-or-later
"""Crockery with walls of finite thickness, rolled rims and foot rings."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import Shape, cylinder, hoop, lathe, tube, vessel


def handle(
    z_low: float, z_high: float, r_low: float, r_high: float, reach: float, thick: float = 0.0055
) -> Shape:
    """A handle on the +x side with its ends inside the wall."""
    middle = (z_low + z_high) / 2
    path = [(r_high - 0.004, 0, z_high), (r_high + 0.55 * reach, 0, z_high + 0.004), (r_high + reach, 0, middle + 0.25 * (z_high - z_low)),
            (r_low + 0.9 * reach, 0, middle - 0.25 * (z_high - z_low)), (r_low + 0.35 * reach, 0, z_low), (r_low - 0.004, 0, z_low + 0.002)]  # fmt: skip
    bar = tube(path, [thick * 1.25, thick, thick * 0.95, thick * 0.95, thick, thick * 1.3], 10, smooth=5)
    return bar.scaled(1, 1.35, 1)


def mug(w: PartBuilder) -> None:
    w["mug", "glaze"] += vessel(
        [(0.036, 0.002), (0.0385, 0.007), (0.0405, 0.04), (0.0408, 0.07), (0.041, 0.094)],
        0.0042,
        foot=0.003,
    )
    w["mug", "glaze"] += handle(0.024, 0.077, 0.0385, 0.0395, 0.031)


def mug_two_tone(w: PartBuilder) -> None:
    w["mug", "enamel"] += vessel([(0.040, 0.001), (0.0425, 0.004), (0.043, 0.04), (0.0435, 0.08)], 0.0022)
    w["mug", "enamel"] += handle(0.02, 0.062, 0.042, 0.0425, 0.032, 0.004)
    w["mug", "rim"] += hoop(0.0425, 0.0021, 0.0812, 40, 8)


def bowl(w: PartBuilder) -> None:
    w["bowl", "glaze"] += vessel(
        [(0.034, 0.004), (0.036, 0.008), (0.055, 0.022), (0.074, 0.047), (0.081, 0.072)],
        0.0045,
        foot=0.005,
    )


def bowls_stacked(w: PartBuilder) -> None:
    for i, slot in enumerate(("first", "second", "third")):
        outside = [(0.033, 0.003), (0.036, 0.008), (0.058, 0.026), (0.072, 0.05), (0.076, 0.062)]
        shape = vessel(outside, 0.004, foot=0.004, segments=36)
        w["bowls", slot] += shape.moved(0.002 * i, -0.0015 * i, 0.0155 * i)


def plate(w: PartBuilder) -> None:
    w["plate", "glaze"] += _plate(0.132)


def _plate(radius: float) -> Shape:
    r = radius
    profile = [(0, 0.0025), (0.52 * r, 0.0025), (0.54 * r, 0), (0.58 * r, 0), (0.61 * r, 0.003), (0.70 * r, 0.0065), (0.76 * r, 0.013),
               (0.97 * r, 0.0215), (0.995 * r, 0.0235), (r, 0.0255), (0.99 * r, 0.0268), (0.965 * r, 0.0262), (0.77 * r, 0.0178),
               (0.72 * r, 0.0125), (0.66 * r, 0.0075), (0.3 * r, 0.0066), (0, 0.0064)]  # fmt: skip
    return lathe(profile, 48)


def plates_stacked(w: PartBuilder) -> None:
    for i in range(5):
        w["plates", "band" if i % 2 else "glaze"] += (
            _plate(0.105)
            .scaled(1, 1, 0.85)
            .turned("z", 31 * i, (0.0012 * (i % 3), 0.001 * (i % 2), 0.0078 * i))
        )


def cup_and_saucer(w: PartBuilder) -> None:
    w["saucer", "glaze"] += _plate(0.074)
    cup = vessel(
        [(0.021, 0.002), (0.024, 0.006), (0.036, 0.028), (0.041, 0.052), (0.0425, 0.06)], 0.0028, foot=0.003
    )
    ear = handle(0.02, 0.05, 0.033, 0.039, 0.022, 0.0034)
    w["cup", "glaze"] += (cup + ear).turned("z", -35, (0, 0, 0.0062))
    w["cup", "coffee"] += cylinder(0.0385, 0.004, (0, 0, 0.0505), 0.0008, 40)


def teapot(w: PartBuilder) -> None:
    w["pot", "glaze"] += vessel(
        [(0.043, 0.003), (0.05, 0.008), (0.078, 0.04), (0.08, 0.065), (0.062, 0.098), (0.043, 0.11)],
        0.004,
        foot=0.004,
    )
    lid = lathe([(0, 0.108), (0.041, 0.108), (0.0445, 0.1115), (0.041, 0.1155), (0.027, 0.122), (0.012, 0.1255), (0.008, 0.13), (0.0125, 0.138),
                 (0.0115, 0.1455), (0.005, 0.149), (0, 0.1495)], 40)  # fmt: skip
    w["lid", "glaze"] += lid
    path = [(-0.066, 0, 0.042), (-0.09, 0, 0.052), (-0.108, 0, 0.078), (-0.124, 0, 0.108)]
    spout = tube(path, [0.021, 0.017, 0.0115, 0.0085], 14, smooth=6)
    w["pot", "glaze"] += [spout, handle(0.035, 0.095, 0.074, 0.062, 0.05, 0.0065)]


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

# SPDX-License-Identifier: GPL-3.0-or-later
"""Vases and bottles with walls of finite thickness, rolled rims and foot rings."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import cylinder, lathe, tube, vessel


def vase_slim(w: PartBuilder) -> None:
    lower = [(0.038, 0.002), (0.05, 0.02), (0.066, 0.09), (0.05, 0.17)]
    upper = [(0.022, 0.23), (0.02, 0.27), (0.03, 0.3)]
    w["vase", "glaze"] += vessel([*lower, *upper], 0.0045, foot=0.004)


def vase_round(w: PartBuilder) -> None:
    lower = [(0.05, 0.002), (0.07, 0.014), (0.105, 0.07), (0.1, 0.13)]
    upper = [(0.06, 0.175), (0.034, 0.188), (0.036, 0.204)]
    w["vase", "clay"] += vessel([*lower, *upper], 0.006, foot=0.004)


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


def bottle_wine(w: PartBuilder) -> None:
    w["bottle", "glass"] += (lathe([(0, 0.006), (0.022, 0.004), (0.031, 0), (0.0355, 0.002), (0.0375, 0.008), (0.0375, 0.17), (0.0368, 0.19), (0.031, 0.212),
                                    (0.0195, 0.232), (0.0152, 0.25), (0.0142, 0.285), (0.0142, 0.3), (0, 0.3)], 40))  # fmt: skip
    lower = [(0.0148, 0.238), (0.0154, 0.2395), (0.015, 0.28), (0.0152, 0.2925)]
    upper = [(0.016, 0.295), (0.016, 0.302), (0.0148, 0.3035), (0, 0.3035)]
    w["foil", "foil"] += lathe([*lower, *upper], 32)
    w["label", "label"] += lathe([(0.0374, 0.05), (0.0378, 0.0502), (0.0378, 0.1398), (0.0374, 0.14)], 40)


def bottle_ceramic(w: PartBuilder) -> None:
    lower = [(0.036, 0.002), (0.041, 0.006), (0.043, 0.12), (0.038, 0.155)]
    upper = [(0.02, 0.185), (0.0155, 0.205), (0.0155, 0.225), (0.018, 0.232)]
    w["bottle", "glaze"] += vessel([*lower, *upper], 0.004)
    w["cap", "seal"] += cylinder(0.0145, 0.006, (0, 0, 0.231), 0.002)
    w["cap", "cap"] += lathe(
        [(0, 0.236), (0.0155, 0.236), (0.0165, 0.239), (0.015, 0.247), (0.009, 0.252), (0, 0.2535)], 28
    )
    for side in (-1, 1):
        y = 0.019 * side
        wire_path = [(0.002, y, 0.21), (-0.017, y, 0.216), (-0.019, y * 0.85, 0.235), (0, y * 0.9, 0.246)]
        w["wire", "wire"] += tube(wire_path, 0.0011, 6, smooth=4)
    w["wire", "wire"] += tube([(0.0, -0.0175, 0.2465), (0, 0, 0.247), (0, 0.0175, 0.2465)], 0.0011, 6)


def bottle_soap(w: PartBuilder) -> None:
    lower = [(0, 0), (0.03, 0), (0.034, 0.004), (0.034, 0.13)]
    upper = [(0.03, 0.142), (0.014, 0.15), (0.0135, 0.158), (0, 0.158)]
    w["body", "body"] += lathe([*lower, *upper], 36)
    w["label", "label"] += lathe([(0.0339, 0.04), (0.0343, 0.0402), (0.0343, 0.1), (0.0339, 0.1002)], 36)
    pump_lower = [(0, 0.152), (0.0165, 0.152), (0.017, 0.154), (0.017, 0.166)]
    pump_upper = [(0.0155, 0.168), (0.006, 0.169), (0.005, 0.19), (0, 0.19)]
    w["pump", "pump"] += lathe([*pump_lower, *pump_upper], 28)
    w["pump", "pump"] += [
        cylinder(0.011, 0.012, (0, 0, 0.188), 0.003),
        tube([(0, 0, 0.196), (0, -0.028, 0.197), (0, -0.044, 0.19)], [0.006, 0.0055, 0.004], 10, smooth=4),
    ]


def thermos(w: PartBuilder) -> None:
    lower = [(0, 0.001), (0.034, 0.001), (0.037, 0.005), (0.037, 0.2)]
    upper = [(0.034, 0.214), (0.029, 0.222), (0, 0.222)]
    w["flask", "steel"] += lathe([*lower, *upper], 40).uv_turned()
    w["flask", "band"] += cylinder(0.0385, 0.012, (0, 0, 0), 0.003, 40)
    w["lid", "lid"] += lathe(
        [(0, 0.219), (0.0295, 0.219), (0.0305, 0.222), (0.0295, 0.262), (0.026, 0.267), (0, 0.268)], 40
    )


def bottle_milk_painted(w: PartBuilder) -> None:
    lower = [(0.037, 0.001), (0.041, 0.006), (0.042, 0.1), (0.036, 0.14)]
    upper = [(0.021, 0.18), (0.019, 0.2), (0.022, 0.205), (0.022, 0.216)]
    w["bottle", "paint"] += vessel([*lower, *upper], 0.0032)

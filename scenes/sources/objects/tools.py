# SPDX-License-Identifier: GPL-3.0-or-later
"""Tools."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import Shape, box, cylinder, extrude, lathe, loft, mirrored, tube


def _lying(shape: Shape, z: float) -> Shape:
    """Rotate a tool that is modelled along z to the x axis, and move it up by ``z``."""
    return shape.turned("y", 90, (0, 0, z))


def hammer(w: PartBuilder) -> None:
    z = 0.0142
    lower = [(0, 0), (0.0125, 0.002), (0.0145, 0.02), (0.0138, 0.09)]
    upper = [(0.0105, 0.16), (0.0095, 0.24), (0.0105, 0.285), (0, 0.286)]
    handle = lathe([*lower, *upper], 20).scaled(1, 0.8, 1)
    w["hammer", "wood"] += _lying(handle, z).moved(x=-0.14).uv_turned()
    face = lathe(
        [(0, 0), (0.0125, 0), (0.0138, 0.002), (0.0138, 0.014), (0.0105, 0.02), (0.0115, 0.034), (0, 0.036)],
        28,
    ).turned("x", 90)
    w["hammer", "steel"] += [
        face.moved(0.13, 0.062, z),
        box((0.027, 0.034, 0.025), (0.13, 0.012, z - 0.0125), 0.004, 2),
    ]
    for side in (-1, 1):
        claw = ((0.005, 0.002, 0.0), (0.008, -0.03, 0.003), (0.009, -0.058, -0.005))
        path = [(0.13 + dx * side, y, z + dz) for dx, y, dz in claw]
        w["hammer", "steel"] += tube(path, [0.009, 0.006, 0.0025], 10, smooth=3)


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


def pliers(w: PartBuilder) -> None:
    for side in (-1, 1):
        jaw = ((0.0, 0.004), (0.03, 0.0095), (0.052, 0.0055), (0.072, 0.003))
        path = [(x, y * side, 0.009) for x, y in jaw]
        w["pliers", "steel"] += tube(path, [0.0085, 0.008, 0.0055, 0.0026], 12, smooth=4)
        handle = ((-0.02, -0.0085), (-0.05, -0.021), (-0.09, -0.025), (-0.13, -0.019))
        path = [(x, y * side, 0.0085) for x, y in handle]
        w["pliers", "grip"] += tube(path, [0.0065, 0.0078, 0.008, 0.007], 12, smooth=4)
    w["pliers", "steel"] += [
        cylinder(0.0155, 0.013, (0.002, 0, 0.0028), 0.002, 28),
        cylinder(0.005, 0.0165, (0.002, 0, 0.001), 0.001, 16),
    ]


def toolbox(w: PartBuilder) -> None:
    w["box", "paint"] += box((0.4, 0.2, 0.13), bevel=0.006, segments=2)
    lid = [(-0.1025, 0.0), (0.1025, 0.0), (0.1025, 0.03), (0.07, 0.062), (-0.07, 0.062), (-0.1025, 0.03)]
    w["box", "paint"] += extrude(lid, 0.406, 0.005, 2).turned("x", 90).turned("z", 90, (-0.203, 0, 0.1315))
    for x in (-0.12, 0.12):
        w["box", "latch"] += [
            box((0.034, 0.006, 0.05), (x, -0.1045, 0.105), 0.002, 2),
            box((0.022, 0.008, 0.016), (x, -0.106, 0.118), 0.003, 2),
        ]
        w["box", "latch"] += box((0.016, 0.03, 0.012), (x * 0.62, 0, 0.1925), 0.002)
    handle = mirrored([(-0.075, 0, 0.203), (-0.07, 0, 0.222), (-0.045, 0, 0.232)])
    w["box", "grip"] += tube(handle, 0.0085, 12, smooth=4)


def paint_brush(w: PartBuilder) -> None:
    def ring(hw: float, hd: float, x: float, z: float = 0.011) -> list[tuple[float, float, float]]:
        angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
        p = 2.6
        return [
            (
                x,
                hw * np.sign(np.cos(a)) * abs(np.cos(a)) ** (2 / p),
                z + hd * np.sign(np.sin(a)) * abs(np.sin(a)) ** (2 / p),
            )
            for a in angle
        ]

    handle = loft(
        [
            ring(0.006, 0.0045, -0.135),
            ring(0.0105, 0.007, -0.125),
            ring(0.0085, 0.0065, -0.08),
            ring(0.0105, 0.0075, -0.04),
            ring(0.022, 0.0085, -0.012),
            ring(0.0255, 0.0085, 0.003),
        ]
    )
    w["brush", "wood"] += handle
    w["brush", "ferrule"] += loft(
        [
            ring(0.0258, 0.0092, -0.002),
            ring(0.0262, 0.0095, 0.0),
            ring(0.0262, 0.0095, 0.036),
            ring(0.0256, 0.009, 0.038),
        ]
    )
    w["brush", "hair"] += loft(
        [
            ring(0.0248, 0.0085, 0.034),
            ring(0.0262, 0.0095, 0.06),
            ring(0.0255, 0.0065, 0.088),
            ring(0.0235, 0.002, 0.1, 0.0095),
        ]
    )


def tape_measure(w: PartBuilder) -> None:
    right, left = [(0.036, 0.0), (0.036, 0.02), (0.03, 0.046)], [(-0.014, 0.062), (-0.032, 0.045)]
    outline = [(-0.034, 0.0), *right, (0.012, 0.062), *left]
    w["tape", "case"] += extrude(outline, 0.034, 0.005, 3).turned("x", 90, (0, 0.017, 0))
    for side in (-1, 1):
        w["tape", "grip"] += lathe(
            [(0, 0), (0.021, 0), (0.022, 0.0012), (0.018, 0.0022), (0, 0.0022)], 32
        ).turned("x", 90 if side < 0 else -90, (-0.001, side * 0.0168, 0.032))
    w["tape", "blade"] += [
        box((0.016, 0.019, 0.0008), (0.042, 0, 0.006), 0.0002),
        box((0.0012, 0.019, 0.012), (0.0495, 0, 0.0005), 0.0003),
    ]

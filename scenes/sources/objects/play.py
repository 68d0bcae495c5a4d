# SPDX-License-Identifier: GPL-3.0-or-later
"""Toys."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import Slot, Workshop
from scenes.sources.objects.registry import cloth, fixed, painted, plastic, rubber, thing, wood_tone
from scenes.sources.shapes import Shape, box, cylinder, extrude, lathe, soft_box, sphere, tube

ON = "table, shelf, floor, seat, bed"


@thing(
    "toy_bear",
    "Teddy bear",
    "toy",
    supports=ON,
    yaw=90,
    fur=Slot(("fabric",), ("fabric",), "velvet_rust"),
    pale=cloth("c9a878"),
    eye=fixed("0c0a09", 0.1, "plastic"),
    bow=cloth("2f5a7c", 0.6),
)
def toy_bear(w: Workshop) -> None:
    def ball(
        radius: float, at: tuple[float, float, float], stretch: tuple[float, float, float] = (1, 1, 1)
    ) -> Shape:
        return sphere(radius, segments=20).scaled(*stretch).moved(*at)

    w.add(
        "bear",
        "fur",
        ball(0.062, (0, 0, 0.064), (1, 0.9, 1.03)),
        ball(0.053, (0, -0.006, 0.158), (1.06, 0.95, 0.95)),
    )
    for side in (-1, 1):
        w.add("bear", "fur", ball(0.02, (side * 0.043, 0.0, 0.2), (1, 0.55, 1)))
        w.add(
            "bear",
            "fur",
            tube(
                [(side * 0.045, -0.005, 0.105), (side * 0.075, -0.035, 0.085), (side * 0.078, -0.06, 0.07)],
                [0.021, 0.0215, 0.021],
                16,
                smooth=4,
            ),
        )
        w.add(
            "bear",
            "fur",
            tube(
                [(side * 0.035, -0.02, 0.031), (side * 0.06, -0.075, 0.028), (side * 0.066, -0.1, 0.03)],
                [0.027, 0.026, 0.028],
                18,
                smooth=4,
            ),
        )
        w.add("bear", "pale", ball(0.021, (side * 0.067, -0.118, 0.034), (1, 0.4, 1.1)))
        w.add("bear", "eye", ball(0.006, (side * 0.019, -0.054, 0.17)))
        w.add("bow", "bow", ball(0.02, (side * 0.02, -0.05, 0.112), (1, 0.45, 0.62)))
    w.add("bear", "pale", ball(0.024, (0, -0.05, 0.148), (1.1, 0.85, 0.85)))
    w.add("bear", "eye", ball(0.0075, (0, -0.072, 0.156), (1.2, 0.8, 0.8)))
    w.add("bow", "bow", ball(0.008, (0, -0.06, 0.112)))


@thing(
    "toy_car",
    "Toy car",
    "toy",
    supports="table, shelf, floor",
    paint=painted("a32a22", 0.12),
    glass=fixed("14181c", 0.08, "glass"),
    tyre=rubber(),
    hub=painted("d8d6cf", 0.25),
    chrome=Slot(("metal",), ("metal",), color=(0.55, 0.55, 0.56), roughness=0.12, metallic=1.0),
)
def toy_car(w: Workshop) -> None:
    body = soft_box((0.15, 0.066, 0.032), (0, 0, 0.014), 0.013, (0.004, 0.001, 0.004), 9)
    cabin = soft_box((0.084, 0.056, 0.03), (0.008, 0, 0.04), 0.012, (0.002, 0, 0.003), 8)

    def taper(p: np.ndarray) -> np.ndarray:
        q = p.copy()
        s = 1 - 0.25 * np.clip((p[:, 2] - 0.045) / 0.028, 0, 1)
        q[:, 0] = 0.008 + (p[:, 0] - 0.008) * s
        q[:, 1] *= 0.4 + 0.6 * s
        return q

    w.add("car", "paint", body)
    w.add("car", "glass", cabin.bent(taper))
    w.add("car", "paint", soft_box((0.06, 0.047, 0.006), (0.008, 0, 0.066), 0.0028, (0, 0, 0.0015), 6))
    for x in (-0.046, 0.046):
        for side in (-1, 1):
            wheel = lathe(
                [
                    (0, 0),
                    (0.012, 0),
                    (0.0165, 0.0015),
                    (0.0175, 0.004),
                    (0.0175, 0.0095),
                    (0.016, 0.012),
                    (0, 0.012),
                ],
                28,
            ).turned("x", -90 * side)
            w.add("wheels", "tyre", wheel.moved(x, side * 0.0255, 0.0175))
            w.add(
                "wheels",
                "hub",
                lathe([(0, 0), (0.0095, 0), (0.009, 0.0012), (0.004, 0.003), (0, 0.0032)], 24)
                .turned("x", 90 if side < 0 else -90)
                .moved(x, side * 0.0374, 0.0175),
            )
    for x, length in ((-0.079, 0.06), (0.079, 0.06)):
        w.add(
            "car",
            "chrome",
            tube([(x, -length / 2, 0.02), (x * 1.01, 0, 0.02), (x, length / 2, 0.02)], 0.0032, 8),
        )
    for side in (-1, 1):
        w.add(
            "car",
            "chrome",
            lathe([(0, 0), (0.006, 0), (0.0055, 0.003), (0, 0.004)], 18)
            .turned("y", -90)
            .moved(-0.0775, side * 0.022, 0.034),
        )


@thing(
    "toy_blocks",
    "Building blocks",
    "toy",
    supports=ON,
    red=painted("a8322a", 0.35, False),
    blue=painted("2d5585", 0.35, False),
    yellow=painted("d0a030", 0.35, False),
    bare=wood_tone("c9a06c", 0.5),
)
def toy_blocks(w: Workshop) -> None:
    s = 0.045
    cube = box((s, s, s), bevel=0.003, segments=2)
    for slot, x, y, z, angle in (
        ("red", -0.03, 0.0, 0, 8),
        ("yellow", 0.026, 0.008, 0, -14),
        ("blue", 0.0, 0.002, s, 22),
        ("bare", 0.075, -0.035, 0, 40),
    ):
        w.add("blocks", slot, cube.turned("z", angle).moved(x, y, z))
    roof = extrude([(-s / 2, 0), (s / 2, 0), (0, s * 0.55)], s, 0.0025, 2).turned("x", 90).moved(0, s / 2, 0)
    w.add("blocks", "red", roof.turned("z", 22).moved(0, 0.002, 2 * s))
    w.add(
        "blocks",
        "yellow",
        cylinder(s / 2, s * 1.5, bevel=0.003, segments=32)
        .turned("y", 90)
        .turned("z", 55)
        .moved(-0.055, -0.065, s / 2),
    )


@thing(
    "toy_duck",
    "Rubber duck",
    "toy",
    supports="table, shelf, sill, counter",
    yaw=None,
    body=Slot(("rubber",), ("rubber", "plastic"), color=(0.80, 0.52, 0.03), roughness=0.38),
    beak=rubber("c4541c", 0.4),
    eye=fixed("0c0c0c", 0.15, "plastic"),
)
def toy_duck(w: Workshop) -> None:
    body = sphere(0.04, segments=32).scaled(1.25, 1.0, 0.8).moved(0, 0, 0.029)

    def tail(p: np.ndarray) -> np.ndarray:
        q = p.copy()
        lift = np.clip((p[:, 0] - 0.012) / 0.04, 0, 1) ** 2
        q[:, 2] += 0.028 * lift
        q[:, 1] *= 1 - 0.55 * lift
        q[:, 2] = np.maximum(q[:, 2], 0.0)
        return q

    w.add("duck", "body", body.bent(tail), sphere(0.026, (-0.026, 0, 0.078), 28))
    w.add("duck", "beak", sphere(0.011, segments=20).scaled(1.2, 1.15, 0.4).moved(-0.054, 0, 0.073))
    for side in (-1, 1):
        w.add("duck", "eye", sphere(0.0036, (-0.045, side * 0.0135, 0.0865), 14))
        w.add(
            "duck",
            "body",
            sphere(0.02, segments=20)
            .scaled(1.25, 0.35, 0.7)
            .turned("y", -18)
            .moved(0.012, side * 0.036, 0.038),
        )


@thing(
    "toy_train",
    "Wooden train",
    "toy",
    supports="table, shelf, floor",
    green=painted("3f6a4a", 0.3, False),
    red=painted("9c3227", 0.3, False),
    bare=wood_tone("c7a06e", 0.5),
    black=painted("1d1d1f", 0.35, False),
)
def toy_train(w: Workshop) -> None:
    w.add(
        "engine",
        "green",
        box((0.13, 0.052, 0.014), (0, 0, 0.012), 0.003, 2),
        box((0.045, 0.05, 0.052), (0.04, 0, 0.025), 0.003, 2),
    )
    w.add(
        "engine",
        "red",
        cylinder(0.0225, 0.078, bevel=0.003, segments=32).turned("y", -90).moved(0.02, 0, 0.047),
        box((0.055, 0.062, 0.008), (0.04, 0, 0.0765), 0.003, 2),
    )
    w.add(
        "engine",
        "black",
        lathe([(0, 0), (0.0085, 0), (0.0085, 0.018), (0.0125, 0.026), (0.012, 0.029), (0, 0.029)], 24).moved(
            -0.038, 0, 0.066
        ),
        sphere(0.009, (-0.008, 0, 0.069), 18),
    )
    w.add("wagon", "bare", box((0.1, 0.052, 0.014), (0.135, 0, 0.012), 0.003, 2))
    for k, (slot, x) in enumerate((("red", 0.108), ("green", 0.135), ("red", 0.162))):
        w.add(
            "wagon",
            slot,
            cylinder(0.0165, 0.03, (x, 0, 0.0255), 0.003, 24)
            if k != 1
            else box((0.022, 0.04, 0.034), (x, 0, 0.0255), 0.003, 2),
        )
    for x in (-0.045, -0.012, 0.042, 0.105, 0.165):
        for side in (-1, 1):
            w.add(
                "wheels",
                "black",
                lathe(
                    [
                        (0, 0),
                        (0.0135, 0),
                        (0.015, 0.0015),
                        (0.015, 0.0075),
                        (0.0135, 0.009),
                        (0.005, 0.009),
                        (0.0045, 0.011),
                        (0, 0.0112),
                    ],
                    28,
                )
                .turned("x", 90 if side < 0 else -90)
                .moved(x, side * 0.0265, 0.015),
            )
    w.add("wagon", "bare", tube([(0.062, 0, 0.019), (0.088, 0, 0.019)], 0.0032, 8))


@thing(
    "spinning_top",
    "Stacking rings",
    "toy",
    supports=ON,
    bare=wood_tone("cfa873", 0.5),
    a=plastic("b23a2c", 0.3),
    b=plastic("d99a2b", 0.3),
    c=plastic("3f7a54", 0.3),
    d=plastic("305f95", 0.3),
)
def spinning_top(w: Workshop) -> None:
    w.add(
        "toy",
        "bare",
        lathe([(0, 0), (0.058, 0), (0.061, 0.004), (0.056, 0.014), (0, 0.016)], 40),
        cylinder(0.011, 0.135, (0, 0, 0.01), 0.003, 20),
    )
    z = 0.0165
    for slot, radius in (("d", 0.054), ("c", 0.046), ("b", 0.038), ("a", 0.031)):
        thick = 0.0135
        ring = [
            ((radius - thick) * np.cos(t), (radius - thick) * np.sin(t), z + thick)
            for t in np.linspace(0, 2 * np.pi, 40, endpoint=False)
        ]
        w.add("toy", slot, tube(ring, thick, 14, closed=True))
        z += 2 * thick
    w.add("toy", "a", sphere(0.019, (0, 0, z + 0.019), 24))

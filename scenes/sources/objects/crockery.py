# SPDX-License-Identifier: GPL-3.0-or-later
"""Crockery, vases and bottles: turned walls with thickness, rolled rims and a foot ring."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import Workshop
from scenes.sources.objects.registry import (
    clay,
    fixed,
    glaze,
    metal,
    painted,
    plastic,
    rubber,
    thing,
    wood_tone,
)
from scenes.sources.shapes import Shape, cylinder, lathe, smooth_curve, tube


def vessel(
    outside: list[tuple[float, float]], wall: float, *, foot: float = 0.0, smooth: int = 3, segments: int = 34
) -> Shape:
    """Turned hollow: ``outside`` runs from the edge of the base up to the rim; the inside follows at ``wall``."""
    curve = smooth_curve(outside, smooth) if smooth else np.array(outside, dtype=float)
    tangent = np.gradient(curve, axis=0)
    inward = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    inner = curve + wall * inward / np.linalg.norm(inward, axis=1, keepdims=True)
    base = curve[0, 0]
    inner = inner[inner[:, 1] > wall * 1.1]
    inner[:, 0] = np.maximum(inner[:, 0], 0.002)
    top = curve[-1]
    rim = [
        (top[0] - 0.5 * wall * (1 - np.cos(a)), top[1] + 0.5 * wall * np.sin(a))
        for a in np.radians([45, 90, 135])
    ]
    foot_ring = (
        [(0, foot), (base - 3 * wall, foot), (base - 2.2 * wall, 0.0), (base - 0.4 * wall, 0.0)]
        if foot
        else [(0, 0), (base - 0.4 * wall, 0)]
    )
    floor = [(max(base - wall, 0.004) * 0.6, wall + foot), (0, wall + foot)]
    profile = [*foot_ring, *curve.tolist(), *rim, *inner[::-1].tolist(), *floor]
    return lathe(profile, segments)


def handle(
    z_low: float, z_high: float, r_low: float, r_high: float, reach: float, thick: float = 0.0055
) -> Shape:
    """An ear on the +x side whose ends run into the wall."""
    middle = (z_low + z_high) / 2
    path = [(r_high - 0.004, 0, z_high), (r_high + 0.55 * reach, 0, z_high + 0.004), (r_high + reach, 0, middle + 0.25 * (z_high - z_low)),
            (r_low + 0.9 * reach, 0, middle - 0.25 * (z_high - z_low)), (r_low + 0.35 * reach, 0, z_low), (r_low - 0.004, 0, z_low + 0.002)]  # fmt: skip
    bar = tube(path, [thick * 1.25, thick, thick * 0.95, thick * 0.95, thick, thick * 1.3], 10, smooth=5)
    return bar.scaled(1, 1.35, 1)


@thing("mug", "Mug", "crockery", glaze=glaze("d8d2c4"))
def mug(w: Workshop) -> None:
    w.add(
        "mug",
        "glaze",
        vessel(
            [(0.036, 0.002), (0.0385, 0.007), (0.0405, 0.04), (0.0408, 0.07), (0.041, 0.094)],
            0.0042,
            foot=0.003,
        ),
    )
    w.add("mug", "glaze", handle(0.024, 0.077, 0.0385, 0.0395, 0.031))


@thing(
    "mug_two_tone", "Enamel mug", "crockery", enamel=glaze("27506b", 0.14), rim=fixed("14161a", 0.2, "glazed")
)
def mug_two_tone(w: Workshop) -> None:
    w.add("mug", "enamel", vessel([(0.040, 0.001), (0.0425, 0.004), (0.043, 0.04), (0.0435, 0.08)], 0.0022))
    w.add("mug", "enamel", handle(0.02, 0.062, 0.042, 0.0425, 0.032, 0.004))
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.stack([0.0425 * np.cos(angle), 0.0425 * np.sin(angle), np.full(40, 0.0812)], axis=-1)
    w.add("mug", "rim", tube(ring, 0.0021, 8, closed=True))


@thing("bowl", "Bowl", "crockery", glaze=glaze("cfc4ae", source="glaze_speckled"))
def bowl(w: Workshop) -> None:
    w.add(
        "bowl",
        "glaze",
        vessel(
            [(0.034, 0.004), (0.036, 0.008), (0.055, 0.022), (0.074, 0.047), (0.081, 0.072)],
            0.0045,
            foot=0.005,
        ),
    )


@thing(
    "bowls_stacked",
    "Stack of bowls",
    "crockery",
    first=glaze("b9c7c4"),
    second=glaze("e3ded2"),
    third=glaze("4a6a7c"),
)
def bowls_stacked(w: Workshop) -> None:
    for i, slot in enumerate(("first", "second", "third")):
        shape = vessel(
            [(0.033, 0.003), (0.036, 0.008), (0.058, 0.026), (0.072, 0.05), (0.076, 0.062)],
            0.004,
            foot=0.004,
            segments=36,
        )
        w.add("bowls", slot, shape.moved(0.002 * i, -0.0015 * i, 0.0155 * i))


@thing("plate", "Dinner plate", "crockery", glaze=glaze("e6e3da"))
def plate(w: Workshop) -> None:
    w.add("plate", "glaze", _plate(0.132))


def _plate(radius: float) -> Shape:
    r = radius
    profile = [(0, 0.0025), (0.52 * r, 0.0025), (0.54 * r, 0), (0.58 * r, 0), (0.61 * r, 0.003), (0.70 * r, 0.0065), (0.76 * r, 0.013),
               (0.97 * r, 0.0215), (0.995 * r, 0.0235), (r, 0.0255), (0.99 * r, 0.0268), (0.965 * r, 0.0262), (0.77 * r, 0.0178),
               (0.72 * r, 0.0125), (0.66 * r, 0.0075), (0.3 * r, 0.0066), (0, 0.0064)]  # fmt: skip
    return lathe(profile, 48)


@thing("plates_stacked", "Stack of plates", "crockery", glaze=glaze("e2ded3"), band=glaze("35566b"))
def plates_stacked(w: Workshop) -> None:
    for i in range(5):
        w.add(
            "plates",
            "band" if i % 2 else "glaze",
            _plate(0.105)
            .scaled(1, 1, 0.85)
            .turned("z", 31 * i)
            .moved(0.0012 * (i % 3), 0.001 * (i % 2), 0.0078 * i),
        )


@thing("cup_and_saucer", "Cup and saucer", "crockery", glaze=glaze("ece9e2"), coffee=fixed("1c0e07", 0.06))
def cup_and_saucer(w: Workshop) -> None:
    w.add("saucer", "glaze", _plate(0.074))
    cup = vessel(
        [(0.021, 0.002), (0.024, 0.006), (0.036, 0.028), (0.041, 0.052), (0.0425, 0.06)], 0.0028, foot=0.003
    )
    ear = handle(0.02, 0.05, 0.033, 0.039, 0.022, 0.0034)
    w.add("cup", "glaze", (cup + ear).turned("z", -35).moved(z=0.0062))
    w.add("cup", "coffee", cylinder(0.0385, 0.004, (0, 0, 0.0505), 0.0008, 40))


@thing("teapot", "Teapot", "crockery", glaze=glaze("a9c2ab", source="glaze_celadon"))
def teapot(w: Workshop) -> None:
    w.add(
        "pot",
        "glaze",
        vessel(
            [(0.043, 0.003), (0.05, 0.008), (0.078, 0.04), (0.08, 0.065), (0.062, 0.098), (0.043, 0.11)],
            0.004,
            foot=0.004,
        ),
    )
    lid = lathe([(0, 0.108), (0.041, 0.108), (0.0445, 0.1115), (0.041, 0.1155), (0.027, 0.122), (0.012, 0.1255), (0.008, 0.13), (0.0125, 0.138),
                 (0.0115, 0.1455), (0.005, 0.149), (0, 0.1495)], 40)  # fmt: skip
    w.add("lid", "glaze", lid)
    spout = tube(
        [(-0.066, 0, 0.042), (-0.09, 0, 0.052), (-0.108, 0, 0.078), (-0.124, 0, 0.108)],
        [0.021, 0.017, 0.0115, 0.0085],
        14,
        smooth=6,
    )
    w.add("pot", "glaze", spout, handle(0.035, 0.095, 0.074, 0.062, 0.05, 0.0065))


@thing("jug", "Jug", "crockery", glaze=glaze("5f7f95"))
def jug(w: Workshop) -> None:
    body = vessel(
        [
            (0.044, 0.002),
            (0.05, 0.008),
            (0.062, 0.05),
            (0.058, 0.1),
            (0.042, 0.15),
            (0.046, 0.185),
            (0.05, 0.195),
        ],
        0.004,
        foot=0.004,
    )

    def lip(p: np.ndarray) -> np.ndarray:
        q = p.copy()
        weight = (
            np.clip((q[:, 2] - 0.15) / 0.045, 0, 1) ** 2 * np.exp(-((q[:, 1] / 0.02) ** 2)) * (q[:, 0] < 0)
        )
        q[:, 0] -= 0.022 * weight
        q[:, 2] += 0.006 * weight
        return q

    w.add("jug", "glaze", body.bent(lip), handle(0.065, 0.178, 0.059, 0.044, 0.042, 0.007))


@thing("vase_slim", "Slim vase", "vase", glaze=glaze("1b3278", source="glaze_cobalt"))
def vase_slim(w: Workshop) -> None:
    w.add(
        "vase",
        "glaze",
        vessel(
            [
                (0.038, 0.002),
                (0.05, 0.02),
                (0.066, 0.09),
                (0.05, 0.17),
                (0.022, 0.23),
                (0.02, 0.27),
                (0.03, 0.3),
            ],
            0.0045,
            foot=0.004,
        ),
    )


@thing("vase_round", "Moon vase", "vase", clay=clay("c9bfae"))
def vase_round(w: Workshop) -> None:
    w.add(
        "vase",
        "clay",
        vessel(
            [
                (0.05, 0.002),
                (0.07, 0.014),
                (0.105, 0.07),
                (0.1, 0.13),
                (0.06, 0.175),
                (0.034, 0.188),
                (0.036, 0.204),
            ],
            0.006,
            foot=0.004,
        ),
    )


@thing("vase_ribbed", "Ribbed vase", "vase", glaze=glaze("37604f", 0.16))
def vase_ribbed(w: Workshop) -> None:
    body = vessel(
        [(0.045, 0.002), (0.055, 0.02), (0.068, 0.1), (0.064, 0.18), (0.048, 0.23), (0.052, 0.25)],
        0.005,
        segments=84,
        smooth=3,
    )

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

    w.add("vase", "glaze", body.bent(ribs))


@thing(
    "vase_with_twigs",
    "Vase with bare twigs",
    "vase",
    glaze=glaze("dcd8ce", source="glaze_dipped"),
    twig=wood_tone("3f2e20", 0.8),
)
def vase_with_twigs(w: Workshop) -> None:
    w.add(
        "vase",
        "glaze",
        vessel(
            [(0.04, 0.002), (0.052, 0.015), (0.06, 0.07), (0.042, 0.13), (0.026, 0.165), (0.03, 0.185)],
            0.0045,
            foot=0.003,
        ),
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
        w.add("twigs", "twig", tube(path, [0.0026, 0.0024, 0.002, 0.0015, 0.0008], 5, smooth=3))
        for k in (2, 3):
            start = np.array(path[k])
            tip = start + np.array([*(rng.uniform(-0.05, 0.05, 2)), rng.uniform(0.06, 0.11)])
            w.add(
                "twigs",
                "twig",
                tube(
                    [start, (start + tip) / 2 + rng.uniform(-0.008, 0.008, 3), tip],
                    [0.0013, 0.001, 0.0005],
                    5,
                    smooth=2,
                ),
            )


@thing(
    "bottle_wine",
    "Wine bottle",
    "bottle",
    glass=glaze("10180f", 0.08),
    label=fixed("d9d0b8", 0.75, "paper"),
    foil=metal((0.30, 0.05, 0.06), 0.35),
)
def bottle_wine(w: Workshop) -> None:
    w.add("bottle", "glass", lathe([(0, 0.006), (0.022, 0.004), (0.031, 0), (0.0355, 0.002), (0.0375, 0.008), (0.0375, 0.17), (0.0368, 0.19), (0.031, 0.212),
                                    (0.0195, 0.232), (0.0152, 0.25), (0.0142, 0.285), (0.0142, 0.3), (0, 0.3)], 40))  # fmt: skip
    w.add(
        "foil",
        "foil",
        lathe(
            [
                (0.0148, 0.238),
                (0.0154, 0.2395),
                (0.015, 0.28),
                (0.0152, 0.2925),
                (0.016, 0.295),
                (0.016, 0.302),
                (0.0148, 0.3035),
                (0, 0.3035),
            ],
            32,
        ),
    )
    w.add("label", "label", lathe([(0.0374, 0.05), (0.0378, 0.0502), (0.0378, 0.1398), (0.0374, 0.14)], 40))


@thing(
    "bottle_ceramic",
    "Swing-top bottle",
    "bottle",
    glaze=glaze("8d6a48", 0.2),
    cap=glaze("e4e0d6"),
    wire=metal(),
    seal=rubber("8c2a20"),
)
def bottle_ceramic(w: Workshop) -> None:
    w.add(
        "bottle",
        "glaze",
        vessel(
            [
                (0.036, 0.002),
                (0.041, 0.006),
                (0.043, 0.12),
                (0.038, 0.155),
                (0.02, 0.185),
                (0.0155, 0.205),
                (0.0155, 0.225),
                (0.018, 0.232),
            ],
            0.004,
        ),
    )
    w.add("cap", "seal", cylinder(0.0145, 0.006, (0, 0, 0.231), 0.002))
    w.add(
        "cap",
        "cap",
        lathe(
            [(0, 0.236), (0.0155, 0.236), (0.0165, 0.239), (0.015, 0.247), (0.009, 0.252), (0, 0.2535)], 28
        ),
    )
    for side in (-1, 1):
        y = 0.019 * side
        w.add(
            "wire",
            "wire",
            tube(
                [(0.002, y, 0.21), (-0.017, y, 0.216), (-0.019, y * 0.85, 0.235), (0, y * 0.9, 0.246)],
                0.0011,
                6,
                smooth=4,
            ),
        )
    w.add("wire", "wire", tube([(0.0, -0.0175, 0.2465), (0, 0, 0.247), (0, 0.0175, 0.2465)], 0.0011, 6))


@thing(
    "bottle_soap",
    "Soap dispenser",
    "bottle",
    body=plastic("c9c4b8", 0.3),
    pump=plastic("202224", 0.35),
    label=fixed("5b6a5e", 0.7, "paper"),
)
def bottle_soap(w: Workshop) -> None:
    w.add(
        "body",
        "body",
        lathe(
            [
                (0, 0),
                (0.03, 0),
                (0.034, 0.004),
                (0.034, 0.13),
                (0.03, 0.142),
                (0.014, 0.15),
                (0.0135, 0.158),
                (0, 0.158),
            ],
            36,
        ),
    )
    w.add("label", "label", lathe([(0.0339, 0.04), (0.0343, 0.0402), (0.0343, 0.1), (0.0339, 0.1002)], 36))
    w.add(
        "pump",
        "pump",
        lathe(
            [
                (0, 0.152),
                (0.0165, 0.152),
                (0.017, 0.154),
                (0.017, 0.166),
                (0.0155, 0.168),
                (0.006, 0.169),
                (0.005, 0.19),
                (0, 0.19),
            ],
            28,
        ),
    )
    w.add(
        "pump",
        "pump",
        cylinder(0.011, 0.012, (0, 0, 0.188), 0.003),
        tube([(0, 0, 0.196), (0, -0.028, 0.197), (0, -0.044, 0.19)], [0.006, 0.0055, 0.004], 10, smooth=4),
    )


@thing(
    "thermos",
    "Vacuum flask",
    "bottle",
    steel=metal(source="steel_brushed"),
    lid=plastic("26282b", 0.4),
    band=rubber(),
)
def thermos(w: Workshop) -> None:
    w.add(
        "flask",
        "steel",
        lathe(
            [
                (0, 0.001),
                (0.034, 0.001),
                (0.037, 0.005),
                (0.037, 0.2),
                (0.034, 0.214),
                (0.029, 0.222),
                (0, 0.222),
            ],
            40,
        ).uv_turned(),
    )
    w.add("flask", "band", cylinder(0.0385, 0.012, (0, 0, 0), 0.003, 40))
    w.add(
        "lid",
        "lid",
        lathe(
            [(0, 0.219), (0.0295, 0.219), (0.0305, 0.222), (0.0295, 0.262), (0.026, 0.267), (0, 0.268)], 40
        ),
    )


@thing("bottle_milk_painted", "Painted bottle", "bottle", paint=painted("b8c9c2", 0.3))
def bottle_milk_painted(w: Workshop) -> None:
    w.add(
        "bottle",
        "paint",
        vessel(
            [
                (0.037, 0.001),
                (0.041, 0.006),
                (0.042, 0.1),
                (0.036, 0.14),
                (0.021, 0.18),
                (0.019, 0.2),
                (0.022, 0.205),
                (0.022, 0.216),
            ],
            0.0032,
        ),
    )

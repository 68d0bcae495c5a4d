# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps, frames, clocks, cushions, plants, candles, statuettes."""

from __future__ import annotations

from functools import partial

import numpy as np

from scenes.sources.environments import furniture
from scenes.sources.materials import art
from scenes.sources.materials.graph import srgb
from scenes.sources.modelling import Slot, Workshop
from scenes.sources.objects.registry import (
    clay,
    cloth,
    fabric,
    fixed,
    glaze,
    leather,
    metal,
    organic,
    painted,
    plastic,
    stone,
    thing,
    wood,
    wood_tone,
)  # fmt: skip
from scenes.sources.shapes import (
    Shape,
    box,
    cylinder,
    extrude,
    lathe,
    loft,
    panel,
    pillow,
    sphere,
    tube,
)  # fmt: skip

SEAT = "seat, bed, floor"


def flat(shape: Shape) -> Shape:
    """A panel that faces -y laid down to face up."""
    return shape.turned("x", -90)


# lamps -----------------------------------------------------------------------------------------------------
@thing(
    "lamp_table",
    "Table lamp",
    "lamp",
    base=glaze("3d6a74", 0.12),
    metal=metal((0.91, 0.78, 0.42), 0.25),
    shade=Slot(("fabric",), ("fabric", "paper"), color=srgb("dcd2bd"), roughness=0.85),
)
def lamp_table(w: Workshop) -> None:
    w.add(
        "base",
        "base",
        lathe(
            [
                (0, 0.012),
                (0.05, 0.012),
                (0.062, 0.03),
                (0.082, 0.08),
                (0.076, 0.13),
                (0.045, 0.18),
                (0.022, 0.205),
                (0.02, 0.215),
                (0, 0.215),
            ],
            40,
            smooth=0,
        ),
    )
    w.add(
        "base",
        "metal",
        cylinder(0.058, 0.013, bevel=0.004, segments=40),
        cylinder(0.012, 0.075, (0, 0, 0.21), 0.002, 20),
    )
    w.add("base", "metal", furniture._spider(0.104, 0.44).scaled(1, 1, 1))
    w.add("shade", "shade", furniture.drum_shade(0.105, 0.15, 0.19, 40).moved(z=0.255))


@thing(
    "lamp_desk",
    "Desk lamp",
    "lamp",
    paint=painted("a8352a", 0.3),
    steel=metal(rough=0.2),
    inside=fixed("e8e6df", 0.35, "painted"),
)
def lamp_desk(w: Workshop) -> None:
    w.add(
        "base",
        "paint",
        lathe(
            [(0, 0), (0.085, 0), (0.09, 0.005), (0.086, 0.018), (0.03, 0.026), (0.018, 0.04), (0, 0.042)], 40
        ),
    )
    elbow, head = np.array([0.0, 0.09, 0.27]), np.array([0.0, -0.1, 0.42])
    for x in (-0.011, 0.011):
        w.add(
            "arm",
            "steel",
            tube([(x, 0.0, 0.03), (x, *elbow[1:])], 0.0042, 8),
            tube([(x, *elbow[1:]), (x, *head[1:])], 0.0042, 8),
        )
    for at in ((0, 0, 0.038), tuple(elbow), tuple(head)):
        w.add("arm", "paint", cylinder(0.013, 0.036, (0, 0, -0.018), 0.003, 20).turned("y", 90).moved(*at))
    outer = [
        (0.0, 0.075),
        (0.022, 0.072),
        (0.03, 0.06),
        (0.034, 0.03),
        (0.05, 0.008),
        (0.076, -0.035),
        (0.079, -0.04),
    ]
    shell = [*outer, (0.0775, -0.041), (0.074, -0.0355), (0.048, 0.007), (0.031, 0.028), (0, 0.03)]
    lean = 28
    w.add("head", "paint", lathe(shell, 40).turned("x", -lean).moved(*(head + np.array([0, -0.035, -0.045]))))
    w.add(
        "head",
        "inside",
        sphere(0.024, segments=20).turned("x", -lean).moved(*(head + np.array([0, -0.028, -0.066]))),
    )


@thing(
    "lantern",
    "Lantern",
    "lamp",
    iron=painted("1d1e20", 0.5),
    wax=organic("e6dcc2", 0.5),
    wick=fixed("1a1512", 0.9),
)
def lantern(w: Workshop) -> None:
    s, h = 0.075, 0.2
    w.add(
        "frame",
        "iron",
        box((0.165, 0.165, 0.014), (0, 0, 0.006), 0.004, 2),
        box((0.165, 0.165, 0.012), (0, 0, h + 0.015), 0.004, 2),
    )
    for x in (-s, s):
        for y in (-s, s):
            w.add(
                "frame",
                "iron",
                box((0.009, 0.009, h), (x, y, 0.018), 0.002),
                cylinder(0.009, 0.008, (x * 0.9, y * 0.9, 0), 0.003, 16),
            )
        w.add(
            "frame",
            "iron",
            tube([(x, -s, 0.12), (x, s, 0.12)], 0.0028, 8),
            tube([(-s, x, 0.12), (s, x, 0.12)], 0.0028, 8),
        )
    w.add(
        "frame",
        "iron",
        lathe(
            [(0.1, h + 0.026), (0.085, h + 0.045), (0.03, h + 0.08), (0.026, h + 0.1), (0, h + 0.104)], 4
        ).turned("z", 45),
    )
    w.add(
        "frame",
        "iron",
        tube(
            [
                (-0.022, 0, h + 0.098),
                (-0.03, 0, h + 0.13),
                (0, 0, h + 0.152),
                (0.03, 0, h + 0.13),
                (0.022, 0, h + 0.098),
            ],
            0.003,
            8,
            smooth=5,
        ),
    )
    w.add(
        "candle",
        "wax",
        lathe(
            [
                (0, 0.02),
                (0.036, 0.02),
                (0.037, 0.03),
                (0.0365, 0.112),
                (0.033, 0.118),
                (0.02, 0.114),
                (0, 0.112),
            ],
            32,
        ),
    )
    w.add("candle", "wick", tube([(0, 0, 0.11), (0.001, 0, 0.122), (0.004, 0, 0.13)], 0.0012, 6))


# frames ------------------------------------------------------------------------------------------------------
def _standing_frame(w: Workshop, width: float, height: float, rim: float, art_slot: str) -> None:
    parts = [box((width, 0.016, rim), (0, 0, z), 0.003, 2, grain=0) for z in (0, height - rim)]
    parts += [
        box((rim, 0.016, height - 2 * rim), (s * (width - rim) / 2, 0, rim), 0.003, 2, grain=2)
        for s in (-1, 1)
    ]
    back = box((width - rim, 0.004, height - rim), (0, 0.005, rim / 2), 0)
    picture = panel(width - 2 * rim, height - 2 * rim, (0, 0.0015, rim))
    lean = -12
    for part in parts:
        w.add("frame", "frame", part.turned("x", lean))
    w.add("frame", "backing", back.turned("x", lean))
    w.add("frame", art_slot, picture.turned("x", lean))
    strut = box((0.05, 0.004, height * 0.72), (0, 0, 0), 0.001).turned("x", 20)
    top = 0.72 * height
    w.add(
        "frame",
        "backing",
        strut.moved(0, np.sin(np.radians(12)) * top + np.sin(np.radians(20)) * top * 0.96 + 0.006, 0.0),
    )


_portrait = partial(art.portrait, ground=srgb("6a7f72"), skin=srgb("c99a78"), coat=srgb("31405a"))


@thing(
    "frame_portrait",
    "Photograph in a frame",
    "frame",
    yaw=40,
    frame=wood_tone("5a3a22", 0.35),
    backing=fixed("2b2622", 0.9, "paper"),
    photo=Slot(("paper",), (), graph=_portrait),
)
def frame_portrait(w: Workshop) -> None:
    _standing_frame(w, 0.16, 0.21, 0.02, "photo")


@thing(
    "frame_landscape",
    "Brass frame",
    "frame",
    yaw=40,
    frame=metal((0.86, 0.70, 0.38), 0.28),
    backing=fixed("1f1d1b", 0.9, "paper"),
    photo=Slot(
        ("paper",),
        (),
        graph=partial(
            art.landscape,
            sky=(srgb("7fa6c4"), srgb("e4d6bc")),
            hills=(srgb("7a8a78"), srgb("5a7050"), srgb("39482e")),
            seed=15.0,
            rough=0.3,
        ),
    ),
)
def frame_landscape(w: Workshop) -> None:
    _standing_frame(w, 0.22, 0.165, 0.014, "photo")


@thing(
    "mirror_stand",
    "Dressing mirror",
    "frame",
    yaw=50,
    frame=metal((0.56, 0.57, 0.58), 0.15),
    mirror=Slot(("metal",), (), color=(0.9, 0.9, 0.9), roughness=0.05, metallic=1.0),
)
def mirror_stand(w: Workshop) -> None:
    w.add(
        "stand",
        "frame",
        lathe(
            [
                (0, 0),
                (0.07, 0),
                (0.073, 0.004),
                (0.066, 0.011),
                (0.014, 0.016),
                (0.008, 0.03),
                (0.008, 0.13),
                (0, 0.132),
            ],
            36,
        ),
    )
    disc = lathe(
        [
            (0, -0.006),
            (0.094, -0.006),
            (0.1, -0.002),
            (0.1, 0.005),
            (0.096, 0.008),
            (0.092, 0.0055),
            (0, 0.0055),
        ],
        48,
    )
    w.add("head", "frame", disc.turned("x", 78).moved(z=0.225))
    glass = lathe([(0, 0.0058), (0.0915, 0.0058), (0.0915, 0.0056), (0, 0.0052)], 48)
    w.add("head", "mirror", glass.turned("x", 78).moved(z=0.225))


# clocks ------------------------------------------------------------------------------------------------------
def _hands(
    w: Workshop,
    part: str,
    slot: str,
    at: tuple[float, float, float],
    radius: float,
    hour: float,
    minute: float,
) -> None:
    for angle, length, width in ((30 * hour, 0.52, 0.055), (6 * minute, 0.8, 0.035)):
        hand = box((width * radius, 0.0012, length * radius), (0, 0, -0.1 * radius), 0.0003).turned(
            "y", angle
        )
        w.add(part, slot, hand.moved(*at))
    w.add(
        part,
        slot,
        cylinder(0.05 * radius, 0.003, segments=16, bevel=0.0005)
        .turned("x", 90)
        .moved(at[0], at[1] + 0.001, at[2]),
    )


_dial = Slot(("paper",), (), graph=partial(art.dial, ground=srgb("e9e4d6"), ink=srgb("16140f")))


def _face(radius: float) -> Shape:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.stack([np.cos(angle), np.zeros(40), np.sin(angle)], axis=-1)
    uv = np.stack([0.5 + 0.5 * np.cos(angle), 0.5 + 0.5 * np.sin(angle)], axis=-1)
    return Shape(ring * radius, [tuple(range(40))], uv, True)


@thing(
    "clock_alarm",
    "Alarm clock",
    "clock",
    yaw=60,
    case=painted("39715f", 0.25),
    bells=metal((0.86, 0.70, 0.38), 0.2),
    dial=_dial,
    hands=fixed("151413", 0.4),
)
def clock_alarm(w: Workshop) -> None:
    r = 0.05
    drum = lathe(
        [
            (0, 0),
            (r - 0.006, 0),
            (r, 0.006),
            (r, 0.036),
            (r + 0.003, 0.04),
            (r + 0.002, 0.046),
            (r - 0.003, 0.047),
            (r - 0.004, 0.041),
            (0, 0.041),
        ],
        44,
    )
    z = 0.066
    w.add("case", "case", drum.turned("x", 90).moved(0, 0.022, z))
    w.add("case", "dial", _face(r - 0.0035).moved(0, -0.0192, z))
    _hands(w, "case", "hands", (0, -0.0212, z), r, 10.2, 9)
    bell = lathe(
        [(0, 0.016), (0.012, 0.014), (0.0195, 0.006), (0.021, 0), (0.0195, 0), (0.011, 0.012), (0, 0.014)], 28
    )
    for side in (-1, 1):
        w.add("case", "bells", bell.moved(z=0.004).turned("y", 32 * side).moved(0.034 * side, 0, z + 0.046))
        w.add("case", "bells", tube([(0.027 * side, 0, z + 0.036), (0.036 * side, 0, z + 0.052)], 0.003, 8))
        w.add(
            "case",
            "bells",
            tube([(0.028 * side, 0, z - 0.04), (0.037 * side, 0.002, 0.003)], [0.0045, 0.0035], 10),
        )
    w.add(
        "case",
        "bells",
        tube(
            [(-0.016, 0, z + 0.05), (-0.014, 0, z + 0.078), (0.014, 0, z + 0.078), (0.016, 0, z + 0.05)],
            0.002,
            8,
            smooth=4,
        ),
    )


@thing(
    "clock_mantel",
    "Mantel clock",
    "clock",
    yaw=45,
    case=wood("cherry"),
    brass=metal((0.86, 0.70, 0.38), 0.22),
    dial=_dial,
    hands=fixed("151413", 0.4),
)
def clock_mantel(w: Workshop) -> None:
    outline = [(-0.15, 0.03), (0.15, 0.03), (0.14, 0.06), (0.115, 0.085), (0.1, 0.13), (0.08, 0.165), (0.05, 0.186), (0.0, 0.194),
               (-0.05, 0.186), (-0.08, 0.165), (-0.1, 0.13), (-0.115, 0.085), (-0.14, 0.06)]  # fmt: skip
    w.add("case", "case", extrude(outline, 0.09, 0.006, 2).turned("x", 90).moved(0, 0.045, 0))
    w.add("case", "case", box((0.34, 0.12, 0.03), (0, 0, 0.008), 0.006, 2, grain=0))
    for x in (-0.14, 0.14):
        for y in (-0.04, 0.04):
            w.add("case", "brass", sphere(0.0115, (x, y, 0.0095), 16, 0.82))
    ring = lathe([(0.062, 0), (0.074, 0), (0.075, 0.006), (0.069, 0.01), (0.063, 0.006), (0.062, 0)], 48)
    w.add("case", "brass", ring.turned("x", 90).moved(0, -0.044, 0.115))
    w.add("case", "dial", _face(0.064).moved(0, -0.0465, 0.115))
    _hands(w, "case", "hands", (0, -0.0488, 0.115), 0.064, 4.4, 24)


@thing(
    "hourglass_timer", "Kitchen timer", "clock", shell=plastic("d8d2c2", 0.3), knob=plastic("b5482f", 0.35)
)
def hourglass_timer(w: Workshop) -> None:
    w.add(
        "timer",
        "shell",
        lathe(
            [(0, 0), (0.03, 0), (0.034, 0.004), (0.037, 0.02), (0.033, 0.036), (0.03, 0.0375), (0, 0.0375)],
            36,
        ),
    )
    w.add(
        "timer",
        "knob",
        lathe([(0, 0.0378), (0.031, 0.0378), (0.032, 0.041), (0.03, 0.052), (0.02, 0.058), (0, 0.0595)], 36),
        box((0.008, 0.044, 0.012), (0, 0, 0.054), 0.003, 2),
    )


# cushions ------------------------------------------------------------------------------------------------------
@thing(
    "cushion_square", "Cushion", "cushion", supports=SEAT, cover=fabric("linen_blue"), piping=cloth("d9d0bc")
)
def cushion_square(w: Workshop) -> None:
    shape = pillow((0.45, 0.45, 0.16), 13, seed=3)
    w.add("cushion", "cover", shape)
    w.add("cushion", "piping", _piping(0.45, 0.45, 0.064, 0.0035))


def _piping(sx: float, sy: float, z: float, radius: float, pinch: float = 0.07) -> Shape:
    t = np.linspace(-1, 1, 15)[:-1]
    sides = [(t, -np.ones(14)), (np.ones(14), t), (-t, np.ones(14)), (-np.ones(14), -t)]
    path = [
        np.stack(
            [sx / 2 * u * (1 - pinch * (1 - v**2)), sy / 2 * v * (1 - pinch * (1 - u**2)), np.full(14, z)],
            axis=-1,
        )
        for u, v in sides
    ]
    return tube(np.concatenate(path), radius, 6, closed=True)


@thing("cushion_stripe", "Striped cushion", "cushion", supports=SEAT, cover=fabric("ticking_stripe"))
def cushion_stripe(w: Workshop) -> None:
    w.add("cushion", "cover", pillow((0.55, 0.36, 0.15), 13, seed=8))


@thing(
    "cushion_round",
    "Round cushion",
    "cushion",
    supports=SEAT,
    cover=Slot(("fabric",), ("fabric",), "velvet_rust"),
    button=cloth("6b2f18"),
)
def cushion_round(w: Workshop) -> None:
    body = lathe(
        [
            (0, 0.012),
            (0.03, 0.002),
            (0.1, 0.0),
            (0.17, 0.012),
            (0.196, 0.045),
            (0.19, 0.085),
            (0.15, 0.108),
            (0.08, 0.112),
            (0.03, 0.1),
            (0.012, 0.086),
            (0, 0.084),
        ],
        64,
        smooth=4,
    )

    def pleats(p: np.ndarray) -> np.ndarray:
        q, a = p.copy(), np.arctan2(p[:, 1], p[:, 0])
        fade = np.clip((np.hypot(p[:, 0], p[:, 1]) - 0.015) / 0.03, 0, 1) * (p[:, 2] > 0.05)
        q[:, 2] += 0.0022 * fade * np.cos(18 * a)
        return q

    w.add("cushion", "cover", body.bent(pleats))
    w.add("cushion", "button", sphere(0.014, (0, 0, 0.09), 20, 0.55))


@thing("cushion_bolster", "Bolster", "cushion", supports=SEAT, cover=leather("leather_tan"))
def cushion_bolster(w: Workshop) -> None:
    roll = lathe(
        [
            (0, 0),
            (0.05, 0.0),
            (0.082, 0.008),
            (0.09, 0.025),
            (0.092, 0.23),
            (0.09, 0.435),
            (0.082, 0.452),
            (0.05, 0.46),
            (0, 0.46),
        ],
        40,
    )
    roll = roll.turned("y", 90).moved(-0.23, 0, 0.088)
    w.add("cushion", "cover", roll)
    rings = [
        tube(
            [(x, 0.0905 * np.cos(a), 0.088 + 0.0905 * np.sin(a)) for a in np.linspace(0, np.pi, 20)], 0.003, 6
        )
        for x in (-0.2, 0.2)
    ]
    w.add("cushion", "cover", *rings)


# plants ------------------------------------------------------------------------------------------------------
@thing(
    "plant_broad",
    "Pot plant",
    "plant",
    supports="table, shelf, counter, sill, floor",
    pot=glaze("c8c2b4", 0.2),
    leaf=organic("3c6b2e", 0.42),
    stem=organic("56663a", 0.6),
    soil=fixed("22180f", 0.95, "organic"),
)
def plant_broad(w: Workshop) -> None:
    furniture.plant(
        w,
        "plant",
        height=0.42,
        pot="pot",
        leaf="leaf",
        stem="stem",
        soil="soil",
        seed=11,
        pot_radius=0.075,
        leaves=20,
    )


@thing(
    "plant_snake",
    "Snake plant",
    "plant",
    supports="table, shelf, counter, sill, floor",
    pot=clay("a8694a"),
    leaf=organic("3a5d3a", 0.4),
    soil=fixed("22180f", 0.95, "organic"),
)
def plant_snake(w: Workshop) -> None:
    _pot(w, 0.08, 0.13)
    rng = np.random.default_rng(4)
    for k in range(11):
        angle, r = 2.4 * k, 0.045 * np.sqrt(k / 11)
        height, width = float(rng.uniform(0.24, 0.46)), float(rng.uniform(0.034, 0.05))
        t = np.linspace(0, 1, 9)[:, None]
        u = np.linspace(-1, 1, 5)[None, :]
        half = (
            0.5 * width * (0.55 + 0.45 * np.sin(np.pi * np.minimum(t * 1.15, 1.0) ** 0.8)) * (1 - t**6)
            + 0.0008
        )
        twist = 0.5 * t * (1 if k % 2 else -1)
        x, y = u * half, 0.35 * np.abs(u) * half + 0.05 * t**2 * (k % 3)
        points = np.stack(
            [
                x * np.cos(twist) - y * np.sin(twist),
                x * np.sin(twist) + y * np.cos(twist),
                np.broadcast_to(height * t, x.shape),
            ],
            axis=-1,
        )
        from scenes.sources.shapes import sheet

        w.add(
            "plant",
            "leaf",
            sheet(points, 0.003)
            .turned("z", float(np.degrees(angle)))
            .moved(r * np.cos(angle), r * np.sin(angle), 0.108),
        )


def _pot(w: Workshop, r: float, h: float) -> None:
    w.add(
        "pot",
        "pot",
        lathe(
            [
                (0, 0),
                (0.72 * r, 0),
                (0.75 * r, 0.003),
                (0.94 * r, 0.78 * h),
                (r, 0.785 * h),
                (1.02 * r, 0.8 * h),
                (1.02 * r, 0.985 * h),
                (r, h),
                (0.93 * r, h),
                (0.9 * r, 0.9 * h),
                (0.86 * r, 0.8 * h),
                (0, 0.8 * h),
            ],
            36,
        ),
    )
    w.add("pot", "soil", lathe([(0.885 * r, 0.84 * h), (0.5 * r, 0.87 * h), (0, 0.86 * h)], 24))


@thing(
    "cactus",
    "Cactus",
    "plant",
    supports="table, shelf, counter, sill",
    pot=painted("c77d4a", 0.5),
    leaf=organic("4f7a4a", 0.6),
    spine=organic("d8c9a0", 0.6),
    soil=fixed("8a7a60", 0.95, "organic"),
)
def cactus(w: Workshop) -> None:
    _pot(w, 0.05, 0.075)
    body = lathe(
        [(0, 0.055), (0.024, 0.056), (0.033, 0.085), (0.035, 0.12), (0.03, 0.15), (0.016, 0.172), (0, 0.178)],
        48,
        smooth=4,
    )

    def ribs(p: np.ndarray) -> np.ndarray:
        q, a = p.copy(), np.arctan2(p[:, 1], p[:, 0])
        q[:, :2] *= (1 + 0.12 * np.cos(12 * a))[:, None]
        return q

    w.add("cactus", "leaf", body.bent(ribs))
    for k in range(12):
        a = 2 * np.pi * k / 12
        for z, r in ((0.085, 0.036), (0.105, 0.0385), (0.125, 0.0385), (0.145, 0.034)):
            for lean in (-0.5, 0.5):
                start = np.array([r * np.cos(a), r * np.sin(a), z])
                tip = start + 0.008 * np.array([np.cos(a + lean), np.sin(a + lean), 0.4])
                w.add("cactus", "spine", tube([start, tip], [0.0005, 0.0003], 3))


# candles, statuettes -----------------------------------------------------------------------------------------
@thing(
    "candlestick",
    "Candlestick",
    "candle",
    metal=metal((0.89, 0.74, 0.42), 0.22),
    wax=organic("e3d9bf", 0.45),
    wick=fixed("1a1512", 0.9),
)
def candlestick(w: Workshop) -> None:
    w.add("stick", "metal", lathe([(0, 0), (0.05, 0), (0.052, 0.004), (0.046, 0.01), (0.02, 0.018), (0.011, 0.03), (0.009, 0.05), (0.015, 0.06), (0.009, 0.07), (0.0085, 0.12), (0.014, 0.13), (0.01, 0.138),
                                   (0.024, 0.146), (0.026, 0.15), (0.0135, 0.15), (0.013, 0.168), (0.0115, 0.168), (0.0112, 0.15), (0, 0.15)], 36))  # fmt: skip
    w.add(
        "candle",
        "wax",
        lathe([(0, 0.151), (0.0108, 0.151), (0.0105, 0.34), (0.009, 0.345), (0.004, 0.343), (0, 0.343)], 24),
    )
    w.add("candle", "wick", tube([(0, 0, 0.342), (0.0006, 0, 0.35), (0.003, 0, 0.357)], 0.0008, 5))


@thing(
    "candle_bowl",
    "Candle in a bowl",
    "candle",
    bowl=clay("5d625f"),
    wax=organic("d9ccb0", 0.5),
    wick=fixed("1a1512", 0.9),
)
def candle_bowl(w: Workshop) -> None:
    from scenes.sources.objects.crockery import vessel

    w.add("bowl", "bowl", vessel([(0.03, 0.002), (0.038, 0.01), (0.047, 0.03), (0.048, 0.055)], 0.005))
    w.add(
        "candle",
        "wax",
        lathe([(0, 0.01), (0.034, 0.012), (0.0405, 0.03), (0.0418, 0.043), (0.03, 0.042), (0, 0.0405)], 32),
    )
    w.add("candle", "wick", tube([(0, 0, 0.04), (0.001, 0, 0.052)], 0.001, 5))


@thing("statuette_knot", "Knot", "statuette", body=stone("marble_black"), plinth=wood("ebony"))
def statuette_knot(w: Workshop) -> None:
    t = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    knot = (
        np.stack(
            [np.sin(t) + 2 * np.sin(2 * t), -np.sin(3 * t) * 0.9, np.cos(t) - 2 * np.cos(2 * t)], axis=-1
        )
        * 0.03
    )
    knot[:, 2] -= knot[:, 2].min() - 0.05
    w.add("knot", "body", tube(knot, 0.0165, 14, closed=True))
    w.add(
        "plinth",
        "plinth",
        box((0.09, 0.09, 0.036), bevel=0.003, segments=2),
        cylinder(0.012, 0.02, (0, 0, 0.034), 0.002, 16),
    )


@thing("statuette_bird", "Bird", "statuette", body=clay("e2ddd2", 0.55), beak=metal((0.86, 0.70, 0.38), 0.3))
def statuette_bird(w: Workshop) -> None:
    spine = np.array(
        [
            [-0.075, 0.047],
            [-0.05, 0.046],
            [-0.02, 0.044],
            [0.012, 0.048],
            [0.034, 0.064],
            [0.047, 0.08],
            [0.058, 0.084],
            [0.064, 0.083],
        ]
    )
    radius = np.array([0.004, 0.012, 0.03, 0.036, 0.028, 0.021, 0.016, 0.004])
    path = np.column_stack([spine[:, 0], np.zeros(8), spine[:, 1]])
    bird = tube(path, radius, 24, smooth=5)
    w.add(
        "bird",
        "body",
        bird.bent(lambda p: np.column_stack([p[:, 0], p[:, 1] * 0.86, np.maximum(p[:, 2], 0.0125)])),
    )
    w.add("bird", "beak", tube([(0.07, 0, 0.084), (0.084, 0, 0.08)], [0.0045, 0.0008], 8))
    w.add("bird", "body", lathe([(0, 0), (0.026, 0), (0.028, 0.003), (0.024, 0.016), (0, 0.018)], 28))


@thing("statuette_torso", "Turned figure", "statuette", body=stone("marble_white"))
def statuette_torso(w: Workshop) -> None:
    w.add("figure", "body", lathe([(0, 0), (0.044, 0), (0.046, 0.004), (0.043, 0.014), (0.03, 0.022), (0.026, 0.05), (0.034, 0.09), (0.03, 0.13), (0.018, 0.155), (0.013, 0.168), (0.024, 0.176), (0.012, 0.184),
                                   (0.02, 0.196), (0.026, 0.214), (0.02, 0.235), (0, 0.242)], 44, smooth=3))  # fmt: skip


@thing("obelisk", "Stone obelisk", "statuette", body=stone("granite_red"), foot=stone("marble_green"))
def obelisk(w: Workshop) -> None:
    def ring(s: float, z: float) -> list[tuple[float, float, float]]:
        return [(-s, -s, z), (s, -s, z), (s, s, z), (-s, s, z)]

    w.add(
        "obelisk",
        "body",
        loft(np.array([ring(0.0335, 0.05), ring(0.035, 0.052), ring(0.02, 0.26), ring(0.003, 0.295)])),
    )
    w.add(
        "obelisk",
        "foot",
        box((0.1, 0.1, 0.028), bevel=0.003, segments=2),
        box((0.085, 0.085, 0.024), (0, 0, 0.027), 0.004, 2),
    )

# SPDX-License-Identifier: GPL-3.0-or-later
"""Tools and shoes."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import Slot, Workshop
from scenes.sources.objects.registry import (
    cloth,
    fabric,
    leather,
    metal,
    painted,
    plastic,
    rubber,
    thing,
    wood_tone,
)
from scenes.sources.shapes import Shape, box, cylinder, extrude, join, lathe, loft, tube

BENCH = "table, counter, shelf, floor"


def _lying(shape: Shape, z: float) -> Shape:
    """A tool modelled upright along z, laid along x."""
    return shape.turned("y", 90).moved(z=z)


@thing(
    "hammer",
    "Hammer",
    "tool",
    supports=BENCH,
    steel=metal((0.42, 0.42, 0.43), 0.38),
    wood=wood_tone("a87842", 0.5),
)
def hammer(w: Workshop) -> None:
    z = 0.0142
    handle = lathe(
        [
            (0, 0),
            (0.0125, 0.002),
            (0.0145, 0.02),
            (0.0138, 0.09),
            (0.0105, 0.16),
            (0.0095, 0.24),
            (0.0105, 0.285),
            (0, 0.286),
        ],
        20,
    ).scaled(1, 0.8, 1)
    w.add("hammer", "wood", _lying(handle, z).moved(x=-0.14).uv_turned())
    face = lathe(
        [(0, 0), (0.0125, 0), (0.0138, 0.002), (0.0138, 0.014), (0.0105, 0.02), (0.0115, 0.034), (0, 0.036)],
        28,
    ).turned("x", 90)
    w.add(
        "hammer",
        "steel",
        face.moved(0.13, 0.062, z),
        box((0.027, 0.034, 0.025), (0.13, 0.012, z - 0.0125), 0.004, 2),
    )
    for side in (-1, 1):
        w.add(
            "hammer",
            "steel",
            tube(
                [
                    (0.13 + 0.005 * side, 0.002, z),
                    (0.13 + 0.008 * side, -0.03, z + 0.003),
                    (0.13 + 0.009 * side, -0.058, z - 0.005),
                ],
                [0.009, 0.006, 0.0025],
                10,
                smooth=3,
            ),
        )


@thing(
    "screwdriver",
    "Screwdriver",
    "tool",
    supports=BENCH,
    grip=plastic("b8351f", 0.2),
    steel=metal(rough=0.2),
    collar=rubber(),
)
def screwdriver(w: Workshop) -> None:
    grip = lathe(
        [
            (0, 0),
            (0.009, 0.001),
            (0.0145, 0.008),
            (0.015, 0.03),
            (0.0125, 0.06),
            (0.0145, 0.085),
            (0.013, 0.098),
            (0.008, 0.104),
            (0, 0.104),
        ],
        48,
        smooth=2,
    )
    flutes = grip.bent(
        lambda p: np.column_stack(
            [p[:, :2] * (1 + 0.06 * np.cos(6 * np.arctan2(p[:, 1], p[:, 0])))[:, None], p[:, 2]]
        )
    )
    w.add("driver", "grip", _lying(flutes, 0.0159).moved(x=-0.11))
    w.add(
        "driver",
        "collar",
        _lying(
            lathe([(0, 0.1), (0.0105, 0.1), (0.0105, 0.108), (0.006, 0.112), (0, 0.112)], 24), 0.0159
        ).moved(x=-0.11),
    )
    w.add(
        "driver",
        "steel",
        _lying(lathe([(0, 0.108), (0.003, 0.108), (0.003, 0.2), (0, 0.2)], 16), 0.0159).moved(x=-0.11),
        box((0.02, 0.0075, 0.0022), (0.092, 0, 0.0148), 0.0005),
    )


@thing(
    "pliers", "Pliers", "tool", supports=BENCH, steel=metal((0.5, 0.5, 0.5), 0.3), grip=rubber("2b4f86", 0.55)
)
def pliers(w: Workshop) -> None:
    for side in (-1, 1):
        w.add(
            "pliers",
            "steel",
            tube(
                [
                    (0.0, 0.004 * side, 0.009),
                    (0.03, 0.0095 * side, 0.009),
                    (0.052, 0.0055 * side, 0.009),
                    (0.072, 0.003 * side, 0.009),
                ],
                [0.0085, 0.008, 0.0055, 0.0026],
                12,
                smooth=4,
            ),
        )
        w.add(
            "pliers",
            "grip",
            tube(
                [
                    (-0.02, -0.0085 * side, 0.0085),
                    (-0.05, -0.021 * side, 0.0085),
                    (-0.09, -0.025 * side, 0.0085),
                    (-0.13, -0.019 * side, 0.0085),
                ],
                [0.0065, 0.0078, 0.008, 0.007],
                12,
                smooth=4,
            ),
        )
    w.add(
        "pliers",
        "steel",
        cylinder(0.0155, 0.013, (0.002, 0, 0.0028), 0.002, 28),
        cylinder(0.005, 0.0165, (0.002, 0, 0.001), 0.001, 16),
    )


@thing(
    "toolbox",
    "Toolbox",
    "tool",
    supports="floor, table, counter, shelf",
    paint=painted("a43a2a", 0.4),
    latch=metal(rough=0.3),
    grip=rubber("1b1b1b", 0.6),
)
def toolbox(w: Workshop) -> None:
    w.add("box", "paint", box((0.4, 0.2, 0.13), bevel=0.006, segments=2))
    lid = [(-0.1025, 0.0), (0.1025, 0.0), (0.1025, 0.03), (0.07, 0.062), (-0.07, 0.062), (-0.1025, 0.03)]
    w.add(
        "box", "paint", extrude(lid, 0.406, 0.005, 2).turned("x", 90).turned("z", 90).moved(-0.203, 0, 0.1315)
    )
    for x in (-0.12, 0.12):
        w.add(
            "box",
            "latch",
            box((0.034, 0.006, 0.05), (x, -0.1045, 0.105), 0.002, 2),
            box((0.022, 0.008, 0.016), (x, -0.106, 0.118), 0.003, 2),
        )
        w.add("box", "latch", box((0.016, 0.03, 0.012), (x * 0.62, 0, 0.1925), 0.002))
    w.add(
        "box",
        "grip",
        tube(
            [
                (-0.075, 0, 0.203),
                (-0.07, 0, 0.222),
                (-0.045, 0, 0.232),
                (0.045, 0, 0.232),
                (0.07, 0, 0.222),
                (0.075, 0, 0.203),
            ],
            0.0085,
            12,
            smooth=4,
        ),
    )


@thing(
    "paint_brush",
    "Paint brush",
    "tool",
    supports=BENCH,
    wood=wood_tone("b5853f", 0.25),
    ferrule=metal(rough=0.25),
    hair=cloth("2a211a", 0.85),
)
def paint_brush(w: Workshop) -> None:
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
        np.array(
            [
                ring(0.006, 0.0045, -0.135),
                ring(0.0105, 0.007, -0.125),
                ring(0.0085, 0.0065, -0.08),
                ring(0.0105, 0.0075, -0.04),
                ring(0.022, 0.0085, -0.012),
                ring(0.0255, 0.0085, 0.003),
            ]
        )
    )
    w.add("brush", "wood", handle)
    w.add(
        "brush",
        "ferrule",
        loft(
            np.array(
                [
                    ring(0.0258, 0.0092, -0.002),
                    ring(0.0262, 0.0095, 0.0),
                    ring(0.0262, 0.0095, 0.036),
                    ring(0.0256, 0.009, 0.038),
                ]
            )
        ),
    )
    w.add(
        "brush",
        "hair",
        loft(
            np.array(
                [
                    ring(0.0248, 0.0085, 0.034),
                    ring(0.0262, 0.0095, 0.06),
                    ring(0.0255, 0.0065, 0.088),
                    ring(0.0235, 0.002, 0.1, 0.0095),
                ]
            )
        ),
    )


@thing(
    "tape_measure",
    "Tape measure",
    "tool",
    supports=BENCH,
    case=plastic("d6a61f", 0.35),
    grip=rubber(),
    blade=Slot(("metal",), ("metal",), color=(0.8, 0.7, 0.2), roughness=0.3, metallic=1.0),
)
def tape_measure(w: Workshop) -> None:
    outline = [
        (-0.034, 0.0),
        (0.036, 0.0),
        (0.036, 0.02),
        (0.03, 0.046),
        (0.012, 0.062),
        (-0.014, 0.062),
        (-0.032, 0.045),
    ]
    w.add("tape", "case", extrude(outline, 0.034, 0.005, 3).turned("x", 90).moved(0, 0.017, 0))
    for side in (-1, 1):
        w.add(
            "tape",
            "grip",
            lathe([(0, 0), (0.021, 0), (0.022, 0.0012), (0.018, 0.0022), (0, 0.0022)], 32)
            .turned("x", 90 if side < 0 else -90)
            .moved(-0.001, side * 0.0168, 0.032),
        )
    w.add(
        "tape",
        "blade",
        box((0.016, 0.019, 0.0008), (0.042, 0, 0.006), 0.0002),
        box((0.0012, 0.019, 0.012), (0.0495, 0, 0.0005), 0.0003),
    )


# shoes -------------------------------------------------------------------------------------------------------
def _sole(length: float, width: float, scale: float = 1.0, count: int = 36) -> np.ndarray:
    """Outline of a right foot's sole about its middle, toe towards -y."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    y = -length / 2 * np.sin(angle)
    t = (y + length / 2) / length  # 0 at the toe
    half = (
        width
        / 2
        * (
            0.80
            + 0.20 * np.cos(2 * np.pi * np.clip((t - 0.28) / 1.25, -0.5, 0.5))
            - 0.16 * np.exp(-(((t - 0.62) / 0.16) ** 2))
        )
    )
    x = half * np.cos(angle) + 0.006 * np.sin(np.pi * t)
    return np.column_stack([x * scale, y * (1 - (1 - scale) * 0.4)])


def _upper(
    length: float, width: float, base: float, heights: tuple[float, float, float], opening: float
) -> list[np.ndarray]:
    """Rings from the sole to the collar; ``heights`` at toe, instep and heel."""
    rings = []
    outline = _sole(length, width)
    t = (outline[:, 1] + length / 2) / length
    top = np.interp(t, [0.0, 0.25, 0.5, 1.0], [heights[0] * 0.75, heights[0], heights[1], heights[2]])
    for s in (0.0, 0.2, 0.45, 0.7, 0.88, 1.0):
        lean = 1 - 0.62 * s**2.2 * np.interp(t, [0.0, 0.3, 0.55, 1.0], [0.55, 0.9, 0.35, 0.12])
        y_in = outline[:, 1] + (opening - outline[:, 1]) * s**3 * np.interp(
            t, [0, 0.45, 0.75, 1.0], [0.86, 0.55, 0.06, 0.05]
        )
        rings.append(np.column_stack([outline[:, 0] * lean, y_in, base + top * s]))
    return rings


def _shoe(
    w: Workshop,
    part: str,
    *,
    upper: str,
    sole: str,
    lining: str,
    length: float = 0.285,
    width: float = 0.102,
    heights: tuple[float, float, float] = (0.05, 0.085, 0.075),
    thick: float = 0.024,
    mirror: bool = False,
) -> list[tuple[str, Shape]]:
    flip = (lambda p: p * [-1, 1, 1]) if mirror else (lambda p: p)
    base = _sole(length, width)
    rim = [
        np.column_stack([base * s, np.full(len(base), z)])
        for s, z in ((0.95, 0.0), (1.0, 0.004), (1.02, thick * 0.7), (1.0, thick), (0.97, thick))
    ]
    pieces = [(sole, loft(np.array(rim)))]
    rings = _upper(length * 0.985, width * 0.97, thick - 0.002, heights, length * 0.2)
    centre = rings[-1].mean(axis=0)
    inner = [rings[-1] + [0, 0, 0.002]]
    inner += [
        np.column_stack(
            [
                centre[0] + (rings[-1][:, 0] - centre[0]) * s,
                centre[1] + (rings[-1][:, 1] - centre[1]) * s,
                rings[-1][:, 2] - d,
            ]
        )
        for s, d in ((0.95, 0.0), (0.93, 0.012))
    ]
    pieces.append((upper, loft(np.array([*rings, *inner[:2]]), capped=False)))
    floor = [
        np.column_stack(
            [
                centre[0] + (rings[-1][:, 0] - centre[0]) * s,
                centre[1] + (rings[-1][:, 1] - centre[1]) * s,
                np.full(len(rings[-1]), z),
            ]
        )
        for s, z in ((0.9, thick + 0.02), (0.5, thick + 0.006), (0.05, thick + 0.005))
    ]
    pieces.append((lining, loft(np.array([*inner[1:], *floor]), capped=False)))
    result = []
    for slot, shape in pieces:
        bent = shape.bent(flip)
        if mirror:
            bent = bent.flipped()
        result.append((slot, bent))
    return result


def _laces(length: float, thick: float, heights: tuple[float, float, float], width: float) -> Shape:
    rings = _upper(length * 0.985, width * 0.97, thick - 0.002, heights, length * 0.2)
    front = rings[-1][:, 1].min()
    bars = []
    for k in range(5):
        y = front - 0.008 - 0.0135 * k
        z = thick + heights[1] * (0.97 - 0.105 * k) + 0.001
        half = 0.017 + 0.002 * k
        bars.append(
            tube(
                [
                    (-half, y, z - 0.008),
                    (-half * 0.4, y - 0.002, z),
                    (half * 0.4, y + 0.002, z),
                    (half, y, z - 0.008),
                ],
                0.0022,
                6,
                smooth=2,
            )
        )
    return join(bars)


def _pair(w: Workshop, pieces: dict[bool, list[tuple[str, Shape]]], gap: float) -> None:
    for mirror, items in pieces.items():
        side = 1 if mirror else -1
        for slot, shape in items:
            w.add(
                "left" if mirror else "right",
                slot,
                shape.turned("z", 4.0 * side).moved(x=side * gap / 2, y=0.012 * side),
            )


SHOES = "floor"


@thing(
    "shoes_trainers",
    "Trainers",
    "shoe",
    supports=SHOES,
    upper=fabric("canvas_grey"),
    sole=rubber("dedbd2", 0.6),
    lining=cloth("2d2f33"),
    lace=cloth("e6e3da"),
)
def shoes_trainers(w: Workshop) -> None:
    pieces = {}
    for mirror in (False, True):
        items = _shoe(w, "shoe", upper="upper", sole="sole", lining="lining", thick=0.03, mirror=mirror)
        items.append(("lace", _laces(0.285, 0.03, (0.05, 0.085, 0.075), 0.102)))
        pieces[mirror] = items
    _pair(w, pieces, 0.13)


@thing(
    "shoes_leather",
    "Leather shoes",
    "shoe",
    supports=SHOES,
    upper=leather("leather_brown"),
    sole=leather("leather_black"),
    lining=cloth("a88a62", 0.7),
    lace=cloth("2a1c12"),
)
def shoes_leather(w: Workshop) -> None:
    heights = (0.042, 0.078, 0.066)
    pieces = {}
    for mirror in (False, True):
        items = _shoe(
            w,
            "shoe",
            upper="upper",
            sole="sole",
            lining="lining",
            length=0.295,
            width=0.096,
            heights=heights,
            thick=0.014,
            mirror=mirror,
        )
        items.append(("lace", _laces(0.295, 0.014, heights, 0.096)))
        pieces[mirror] = items
    _pair(w, pieces, 0.125)


@thing(
    "shoes_slippers",
    "Slippers",
    "shoe",
    supports=SHOES,
    upper=Slot(("fabric",), ("fabric", "leather"), "felt_grey"),
    sole=rubber("3b3632", 0.8),
    lining=cloth("c9b898"),
)
def shoes_slippers(w: Workshop) -> None:
    pieces = {
        mirror: _shoe(
            w,
            "shoe",
            upper="upper",
            sole="sole",
            lining="lining",
            length=0.27,
            width=0.105,
            heights=(0.052, 0.06, 0.036),
            thick=0.012,
            mirror=mirror,
        )
        for mirror in (False, True)
    }
    _pair(w, pieces, 0.13)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Furniture: every function adds one piece to a workshop part, back at y = 0, front towards -y, on z = 0."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import Workshop
from scenes.sources.shapes import (
    Shape,
    box,
    cylinder,
    extrude,
    join,
    lathe,
    pillow,
    rounded_rectangle,
    sheet,
    soft_box,
    tube,
)


def sofa(
    w: Workshop, part: str, *, width: float = 2.1, seats: int = 3, depth: float = 0.92, cover: str = "sofa", legs: str = "sofa_legs",
    cushions: tuple[str, ...] = (), seat_height: float = 0.43, seed: int = 0,
) -> None:  # fmt: skip
    """Upholstered sofa or armchair: base, arms, back, loose seat and back cushions, scatter cushions."""
    arm, back = 0.19, 0.22
    inner = width - 2 * arm
    w.add(
        part,
        cover,
        soft_box(
            (inner + 0.02, depth - back + 0.03, 0.17),
            (0, -(depth + back) / 2 + 0.03, 0.11),
            0.03,
            (0, 0.004, 0),
            6,
        ),
    )
    for side in (-1, 1):
        w.add(
            part,
            cover,
            soft_box(
                (arm, depth, 0.50),
                (side * (width - arm) / 2, -depth / 2, 0.11),
                0.055,
                (0.012, 0.006, 0.012),
                8,
            ),
        )
    w.add(part, cover, soft_box((inner + 0.01, back, 0.66), (0, -back / 2, 0.11), 0.06, (0, 0.012, 0.012), 8))
    each = inner / seats
    for k in range(seats):
        x = -inner / 2 + each * (k + 0.5)
        w.add(
            part,
            cover,
            soft_box(
                (each - 0.008, depth - back - 0.005, 0.155),
                (x, -(depth + back) / 2 - 0.008, seat_height - 0.155),
                0.045,
                (0.004, 0.014, 0.028),
                10,
                0.0022,
                seed + k,
            ),
        )
        cushion = soft_box(
            (each - 0.02, 0.17, 0.44), (0, 0, 0), 0.07, (0.004, 0.034, 0.012), 9, 0.002, seed + 20 + k
        )
        w.add(part, cover, cushion.turned("x", -11).moved(x, -back - 0.115, seat_height - 0.005))
    for side in (-1, 1):
        for y in (-0.07, -depth + 0.09):
            w.add(
                part,
                legs,
                lathe([(0, 0), (0.017, 0), (0.02, 0.004), (0.026, 0.12), (0, 0.125)], 16).moved(
                    side * (width / 2 - 0.09), y
                ),
            )
    for k, slot in enumerate(cushions):
        side = -1 if k % 2 == 0 else 1
        shape = (
            pillow((0.44, 0.44, 0.15), 10, seed=seed + 40 + k).turned("x", 66 - 4 * k).turned("z", side * -16)
        )
        low = shape.points[:, 2].min()
        w.add(
            part,
            slot,
            shape.moved(side * (inner / 2 - 0.24 - 0.05 * (k // 2)), -back - 0.33, seat_height + 0.012 - low),
        )


def table(
    w: Workshop, part: str, *, size: tuple[float, float], height: float, top: str = "table", legs: str = "table",
    thick: float = 0.032, leg: float = 0.06, shelf: float = 0.0, taper: bool = True, round_corner: float = 0.0,
) -> None:  # fmt: skip
    """Table centred on the origin: bevelled top, apron, tapered legs, optional lower shelf."""
    sx, sy = size
    if round_corner:
        w.add(
            part,
            top,
            extrude(rounded_rectangle(sx, sy, round_corner, 6), thick, 0.006, 2).moved(z=height - thick),
        )
    else:
        w.add(part, top, box((sx, sy, thick), (0, 0, height - thick), 0.005, 2, grain=0))
    inset = leg / 2 + 0.03
    for x in (-sx / 2 + inset, sx / 2 - inset):
        for y in (-sy / 2 + inset, sy / 2 - inset):
            w.add(part, legs, _leg(leg, height - thick, taper).moved(x, y))
    drop = min(0.08, height * 0.15)
    for y in (-sy / 2 + inset, sy / 2 - inset):
        w.add(
            part, legs, box((sx - 2 * inset - leg, 0.02, drop), (0, y, height - thick - drop), 0.002, grain=0)
        )
    for x in (-sx / 2 + inset, sx / 2 - inset):
        w.add(
            part, legs, box((0.02, sy - 2 * inset - leg, drop), (x, 0, height - thick - drop), 0.002, grain=1)
        )
    if shelf:
        w.add(
            part,
            top,
            box((sx - 2 * inset - 0.01, sy - 2 * inset - 0.01, 0.02), (0, 0, shelf - 0.02), 0.003, grain=0),
        )


def _leg(side: float, height: float, taper: bool) -> Shape:
    shape = box((side, side, height), bevel=0.004, grain=2)

    def narrow(p: np.ndarray) -> np.ndarray:
        q = p.copy()
        q[:, :2] *= (1 - 0.42 * np.clip(1 - p[:, 2] / height, 0, 1))[:, None]
        return q

    return shape.bent(narrow) if taper else shape


def chair(w: Workshop, part: str, *, frame: str = "chairs", seat: str = "chair_seats") -> None:
    """Dining chair, origin under the middle of its seat: turned legs, curved back with three slats, seat pad."""
    d, wd, h = 0.43, 0.44, 0.45
    for side in (-1, 1):
        x = side * (wd / 2 - 0.02)
        w.add(
            part,
            frame,
            tube(
                [(x, -d / 2 + 0.02, 0.003), (x, -d / 2 + 0.025, 0.25), (x * 0.97, -d / 2 + 0.03, h - 0.02)],
                [0.012, 0.017, 0.019],
                10,
                smooth=3,
            ),
        )
        w.add(part, frame, tube([(x * 1.02, d / 2 + 0.03, 0.003), (x, d / 2 - 0.015, 0.3), (x, d / 2 - 0.015, 0.46), (x * 0.97, d / 2 + 0.035, 0.72), (x * 0.95, d / 2 + 0.085, 0.9)],
                                [0.012, 0.018, 0.019, 0.016, 0.013], 10, smooth=4))  # fmt: skip
        w.add(part, frame, box((0.018, d - 0.05, 0.045), (x * 0.98, 0, h - 0.065), 0.004, grain=1))
        w.add(part, frame, tube([(x, -d / 2 + 0.03, 0.2), (x, d / 2 - 0.012, 0.2)], 0.009, 8))
    for y in (-d / 2 + 0.025, d / 2 - 0.02):
        w.add(part, frame, box((wd - 0.05, 0.018, 0.045), (0, y, h - 0.065), 0.004, grain=0))
    for z, y in ((0.60, 0.014), (0.72, 0.036), (0.84, 0.066)):
        u, v = np.linspace(-1, 1, 13), np.linspace(-0.5, 0.5, 4)[:, None]
        bow = 0.032 * (1 - u**2)
        points = np.stack(
            [
                u * (wd / 2 - 0.028) + 0 * v,
                d / 2 + y + bow + 0.4 * 0.07 * v,
                z + 0.075 * v + 0.006 * (1 - u**2),
            ],
            axis=-1,
        )
        w.add(part, frame, sheet(points, 0.014))
    w.add(part, frame, extrude(rounded_rectangle(wd, d, 0.04, 4), 0.018, 0.004).moved(z=h - 0.022))
    w.add(part, seat, soft_box((wd - 0.03, d - 0.03, 0.04), (0, 0, h - 0.006), 0.019, (0, 0, 0.014), 9))


def shelf_unit(
    w: Workshop, part: str, *, width: float, height: float, depth: float = 0.3, levels: tuple[float, ...], columns: int = 1,
    slot: str = "shelves", back: bool = True, board: float = 0.022,
) -> None:  # fmt: skip
    """Open bookcase; ``levels`` are the upper sides of its boards."""
    for k in range(columns + 1):
        x = -width / 2 + board / 2 + k * (width - board) / columns
        w.add(part, slot, box((board, depth, height), (x, -depth / 2, 0), 0.002, grain=2))
    bay = (width - board) / columns - board
    for k in range(columns):
        x = -width / 2 + board + bay / 2 + k * (bay + board)
        for z in (*levels, height):
            w.add(
                part,
                slot,
                box((bay + 0.001, depth - 0.008, board), (x, -depth / 2 + 0.002, z - board), 0.0015, grain=0),
            )
    if back:
        w.add(part, slot, box((width - 0.01, 0.008, height - 0.03), (0, -0.005, 0.015), 0, grain=2))
    w.add(
        part,
        slot,
        box((width - 2 * board, 0.016, max(levels[0] - board, 0.03)), (0, -depth + 0.03, 0), 0.001, grain=0),
    )


def book(width: float, height: float, depth: float) -> tuple[Shape, Shape]:
    """(cover, pages) of a book standing with its spine to the front, its left lower back corner region at 0."""
    t = 0.0025
    cover = box((t, depth, height), (-width / 2 + t / 2, -depth / 2, 0), 0) + box(
        (t, depth, height), (width / 2 - t / 2, -depth / 2, 0), 0
    )
    angle = np.linspace(-np.pi / 2, np.pi / 2, 5)
    spine = np.stack([width / 2 * np.sin(angle), -depth - 0.005 * np.cos(angle), 0 * angle], axis=-1)
    lattice = np.stack([spine + np.array([0, t / 2, z]) for z in (0.0, height)])
    cover = cover + sheet(lattice, t)
    pages = box((width - 2 * t, depth - 0.004, height - 0.008), (0, -depth / 2 + 0.0, 0.004), 0)
    return cover, pages


def book_row(
    w: Workshop, part: str, covers: tuple[str, ...], pages: str, *, x: float, width: float, y: float, z: float, height: float, seed: int,
    depth: float = 0.19,
) -> None:  # fmt: skip
    """Books side by side from ``x`` over ``width``, backs at ``y``; the last one leans."""
    rng = np.random.default_rng(seed)
    at = x
    while True:
        thick = float(rng.uniform(0.016, 0.042))
        tall = float(min(rng.uniform(0.185, 0.27), height - 0.015))
        deep = float(min(rng.uniform(0.72, 1.0) * depth, 0.74 * tall + 0.03))
        leans = at + thick + 0.075 > x + width
        if at + thick > x + width:
            return
        cover, block = book(thick, tall, deep)
        # all spines near the shelf's front edge
        move = (at + thick / 2, y - (depth - deep) + float(rng.uniform(0, 0.008)), z)
        if leans:
            angle = -9.0
            c = np.cos(np.radians(angle))
            lift = thick / 2 * abs(np.sin(np.radians(angle)))
            move = (at + thick / 2 / c + 0.002 + tall * 0.0, move[1], z + lift + 0.0003)
            cover, block = cover.turned("y", angle), block.turned("y", angle)
        slot = covers[int(rng.integers(len(covers)))]
        w.add(part, slot, cover.moved(*move))
        w.add(part, pages, block.moved(*move))
        if leans:
            return
        at += thick + 0.0012


def cabinet(
    w: Workshop, part: str, *, width: float, height: float, depth: float, columns: int, rows: tuple[float, ...] = (1.0,),
    slot: str = "cabinet", front: str = "", top: str = "", handle: str = "hardware", plinth: float = 0.08, overhang: float = 0.012,
    panel: bool = False, knobs: bool = False, top_thick: float = 0.025,
) -> None:  # fmt: skip
    """Chest, sideboard or kitchen base: carcass, plinth, fronts in ``rows`` shares of the height (top first)."""
    front, top = front or slot, top or slot
    body = height - (top_thick if top_thick else 0.0)
    w.add(
        part,
        slot,
        box(
            (width, depth - 0.022, body - plinth),
            (0, -(depth - 0.022) / 2, plinth),
            0.002,
            grain=2 if height > width else 0,
        ),
    )
    if plinth:
        w.add(
            part, slot, box((width - 0.02, depth - 0.08, plinth), (0, -(depth - 0.08) / 2, 0), 0.001, grain=0)
        )
    if top_thick:
        w.add(
            part,
            top,
            box(
                (width + 2 * overhang, depth + overhang, top_thick),
                (0, -(depth + overhang) / 2, body),
                0.004,
                2,
                grain=0,
            ),
        )
    gap = 0.003
    fw = width / columns
    z_top = body - gap
    for share in rows:
        fh = (body - plinth - gap) * share / sum(rows)
        for k in range(columns):
            x = -width / 2 + fw * (k + 0.5)
            fz = z_top - fh + gap
            door = box(
                (fw - gap, 0.02, fh - gap), (x, -depth + 0.011, fz), 0.003, 2, grain=2 if fh > fw else 0
            )
            w.add(part, front, door)
            if panel and fh > 0.2:
                rail = 0.06
                for dx in (-1, 1):
                    w.add(
                        part,
                        front,
                        box(
                            (rail, 0.012, fh - gap),
                            (x + dx * (fw - gap - rail) / 2, -depth + 0.001 - 0.004, fz),
                            0.003,
                            grain=2,
                        ),
                    )
                for dz in (0.0, fh - gap - rail):
                    w.add(
                        part,
                        front,
                        box(
                            (fw - gap - 2 * rail, 0.012, rail),
                            (x, -depth + 0.001 - 0.004, fz + dz),
                            0.003,
                            grain=0,
                        ),
                    )
            lift = -0.010 if panel and fh > 0.2 else 0.0
            _pull(w, part, handle, x, -depth + 0.001 + lift, fz, fw, fh, k, columns, knobs)
        z_top -= fh


def _pull(
    w: Workshop,
    part: str,
    slot: str,
    x: float,
    y: float,
    z: float,
    fw: float,
    fh: float,
    k: int,
    columns: int,
    knobs: bool,
) -> None:
    is_drawer = fh < 0.34
    if knobs:
        at = (
            (x, z + fh / 2)
            if is_drawer
            else (x + (fw / 2 - 0.04) * (1 if k % 2 == 0 and columns > 1 else -1), z + fh * 0.55)
        )
        knob = lathe(
            [(0, 0), (0.006, 0), (0.006, 0.012), (0.014, 0.018), (0.016, 0.025), (0.011, 0.031), (0, 0.032)],
            18,
        ).turned("x", 90)
        w.add(part, slot, knob.moved(at[0], y, at[1]))
        return
    if is_drawer:
        length = min(0.6 * fw, 0.22)
        a, b, height = (x - length / 2, 0.0), (x + length / 2, 0.0), z + fh - min(0.05, fh / 2)
        path = [(a[0], y, height), (a[0], y - 0.028, height), (b[0], y - 0.028, height), (b[0], y, height)]
    else:
        side = 1 if (k % 2 == 0 and columns > 1) else -1
        px = x + side * (fw / 2 - 0.035)
        low = z + fh * 0.5 if fh < 1.0 else z + fh * 0.45
        path = [(px, y, low), (px, y - 0.028, low), (px, y - 0.028, low + 0.16), (px, y, low + 0.16)]
    w.add(
        part,
        slot,
        join(
            [
                tube([path[0], path[1]], 0.005, 8),
                tube([path[1], path[2]], 0.006, 8),
                tube([path[2], path[3]], 0.005, 8),
            ]
        ),
    )


def rug(
    w: Workshop,
    part: str,
    slot: str,
    size: tuple[float, float],
    at: tuple[float, float],
    border: str = "",
    seed: int = 0,
) -> None:
    """A thick rug, its edges rolled, lying a little unevenly."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 33), np.linspace(-0.5, 0.5, 25))
    wave = 0.0012 * np.sin(9 * u + rng.uniform(0, 6)) * np.sin(7 * v + rng.uniform(0, 6))
    edge = np.maximum(np.abs(u), np.abs(v)) * 2
    z = 0.006 + wave * (1 - edge) - 0.0005 * edge
    points = np.stack([at[0] + u * size[0], at[1] + v * size[1], z], axis=-1)
    w.add(part, slot, sheet(points, 0.009))
    if border:
        sx, sy, b = size[0] / 2, size[1] / 2, 0.02
        w.add(part, border, *[box((2 * sx, b, 0.0125), (at[0], at[1] + s * sy, 0.0005), 0.004, grain=0) for s in (-1, 1)],
              *[box((b, 2 * sy, 0.0125), (at[0] + s * sx, at[1], 0.0005), 0.004, grain=1) for s in (-1, 1)])  # fmt: skip


def floor_lamp(
    w: Workshop, part: str, *, metal: str = "hardware", shade: str = "lamp_shade", height: float = 1.55
) -> float:
    """Standing lamp on a round foot with a drum shade; returns the height for its light."""
    w.add(
        part,
        metal,
        lathe(
            [
                (0, 0),
                (0.14, 0),
                (0.145, 0.006),
                (0.13, 0.018),
                (0.02, 0.024),
                (0.011, 0.04),
                (0.011, height - 0.2),
                (0.018, height - 0.18),
                (0, height - 0.17),
            ],
            28,
        ),
    )
    w.add(part, shade, drum_shade(0.16, 0.21, 0.27).moved(z=height - 0.27))
    w.add(part, metal, _spider(0.155, height - 0.03))
    return height - 0.12


def drum_shade(top: float, bottom: float, height: float, segments: int = 36) -> Shape:
    """An open conical shade with thickness."""
    t = 0.003
    return lathe(
        [
            (bottom, 0.0),
            (bottom + t / 2, 0.002),
            (top + t / 2, height - 0.002),
            (top, height),
            (top - t / 2, height - 0.002),
            (bottom - t / 2, 0.002),
            (bottom, 0.0),
        ],
        segments,
    )


def _spider(radius: float, z: float) -> Shape:
    arms = [
        tube([(0, 0, z), (radius * np.cos(a), radius * np.sin(a), z)], 0.0018, 6) for a in (0.3, 2.4, 4.5)
    ]
    return join([*arms, cylinder(0.012, 0.16, (0, 0, z - 0.15), 0.002, 12)])


def pendant(
    w: Workshop,
    part: str,
    *,
    ceiling: float,
    drop: float,
    metal: str = "hardware",
    shade: str = "lamp_shade",
    radius: float = 0.22,
) -> float:
    """Pendant with a dome shade about the origin; returns the height of its open underside."""
    z = ceiling - drop
    w.add(
        part,
        metal,
        lathe(
            [
                (0, ceiling - 0.03),
                (0.045, ceiling - 0.03),
                (0.055, ceiling - 0.02),
                (0.055, ceiling + 0.002),
                (0, ceiling + 0.002),
            ],
            24,
        ),
    )
    w.add(part, metal, tube([(0, 0, ceiling - 0.02), (0, 0, z + 0.6 * radius)], 0.0035, 8))
    r, h, t = radius, 0.62 * radius, 0.003
    outer = [
        (r, 0),
        (0.97 * r, 0.3 * h),
        (0.82 * r, 0.66 * h),
        (0.5 * r, 0.93 * h),
        (0.16 * r, 1.02 * h),
        (0.1 * r, 1.15 * h),
        (0.0, 1.17 * h),
    ]
    inner = [
        (0.0, 0.97 * h),
        (0.16 * r, 0.97 * h),
        (0.48 * r, 0.88 * h),
        (0.8 * r, 0.63 * h),
        (0.955 * r, 0.28 * h),
        (r - t, 0),
    ]
    w.add(part, shade, lathe([*outer, *inner, (r, 0)], 40).moved(z=z))
    return z


def ceiling_light(
    w: Workshop,
    part: str,
    *,
    ceiling: float,
    radius: float = 0.2,
    metal: str = "hardware",
    shade: str = "lamp_shade",
) -> float:
    """Flat round fitting; returns the height of its underside."""
    w.add(part, metal, lathe([(0, ceiling + 0.002), (radius, ceiling + 0.002), (radius + 0.006, ceiling - 0.004), (radius + 0.006, ceiling - 0.05), (radius, ceiling - 0.056), (radius - 0.012, ceiling - 0.05),
                              (radius - 0.012, ceiling - 0.03), (0, ceiling - 0.03)][::-1], 40))  # fmt: skip
    w.add(
        part,
        shade,
        lathe(
            [
                (0, ceiling - 0.066),
                (0.6 * radius, ceiling - 0.064),
                (radius - 0.014, ceiling - 0.052),
                (radius - 0.016, ceiling - 0.032),
                (0, ceiling - 0.032),
            ],
            40,
        ),
    )
    return ceiling - 0.066


def picture(w: Workshop, part: str, *, size: tuple[float, float], frame: str, mount: str, art: str) -> None:
    """Framed picture hanging on y = 0, its middle at the origin."""
    sx, sy = size
    b = 0.03
    w.add(part, frame, *[box((sx + 2 * b, 0.024, b), (0, -0.012, s * (sy / 2 + b / 2) - b / 2), 0.004, 2, grain=0) for s in (-1, 1)],
          *[box((b, 0.024, sy), (s * (sx / 2 + b / 2), -0.012, -sy / 2), 0.004, 2, grain=2) for s in (-1, 1)])  # fmt: skip
    w.add(part, mount, box((sx + 0.005, 0.006, sy + 0.005), (0, -0.006, -sy / 2), 0))
    from scenes.sources.shapes import panel

    w.add(part, art, panel(sx * 0.72, sy * 0.76, (0, -0.0096, -sy * 0.37)))


def radiator(
    w: Workshop, part: str, *, width: float = 0.9, height: float = 0.55, slot: str = "radiator"
) -> None:
    """Column radiator, back at y = 0, hung 10 cm above the floor."""
    count = int(width / 0.05)
    for k in range(count):
        x = -width / 2 + width * (k + 0.5) / count
        for y in (-0.05, -0.1):
            w.add(part, slot, tube([(x, y, 0.12), (x, y, 0.10 + height)], 0.013, 8))
    for z in (0.125, 0.095 + height):
        for y in (-0.05, -0.1):
            w.add(part, slot, tube([(-width / 2, y, z), (width / 2, y, z)], 0.017, 10))
    for side in (-1, 1):
        w.add(
            part,
            slot,
            tube([(side * width * 0.45, -0.075, 0.125), (side * width * 0.45, -0.075, 0.005)], 0.009, 8),
        )
        w.add(part, slot, box((0.03, 0.06, 0.03), (side * width * 0.35, -0.03, 0.05 + height), 0.004))


def plant(
    w: Workshop,
    part: str,
    *,
    height: float,
    pot: str,
    leaf: str,
    stem: str,
    soil: str,
    seed: int = 0,
    pot_radius: float = 0.15,
    leaves: int = 26,
) -> None:
    """Broad-leaved plant in a pot, centred on the origin."""
    rng = np.random.default_rng(seed)
    r, h = pot_radius, 1.8 * pot_radius
    w.add(
        part,
        pot,
        lathe(
            [
                (0, 0),
                (0.72 * r, 0),
                (0.74 * r, 0.004),
                (0.98 * r, 0.9 * h),
                (1.06 * r, 0.905 * h),
                (1.07 * r, h),
                (0.99 * r, h),
                (0.93 * r, 0.85 * h),
                (0.9 * r, 0.8 * h),
                (0, 0.8 * h),
            ],
            36,
        ),
    )
    w.add(
        part, soil, lathe([(0.92 * r, 0.82 * h), (0.7 * r, 0.85 * h), (0.3 * r, 0.84 * h), (0, 0.86 * h)], 24)
    )
    for k in range(leaves):
        angle = 2.399963 * k + rng.uniform(-0.2, 0.2)
        rise = 0.35 + 0.65 * (k + 0.5) / leaves
        reach = (0.16 + 0.22 * np.sin(np.pi * min(rise, 0.8))) * height * 0.62 + rng.uniform(-0.02, 0.03)
        tip = np.array([reach * np.cos(angle), reach * np.sin(angle), h + (height - h) * rise])
        base = np.array([0.25 * r * np.cos(angle), 0.25 * r * np.sin(angle), 0.84 * h])
        middle = base * 0.35 + tip * 0.65 + [0, 0, 0.05 * height]
        middle[:2] *= 0.62
        w.add(
            part,
            stem,
            tube(
                [base, (base + middle) / 2 + [0, 0, 0.02], middle, tip],
                [0.005, 0.004, 0.0035, 0.002],
                5,
                smooth=2,
            ),
        )
        length = float(rng.uniform(0.75, 1.1)) * 0.2 * height**0.6
        w.add(
            part,
            leaf,
            leaf_blade(length, 0.46 * length, float(rng.uniform(0.15, 0.45)))
            .turned("y", float(rng.uniform(-5, 35)))
            .turned("z", float(np.degrees(angle)))
            .moved(*tip),
        )


def leaf_blade(length: float, width: float, droop: float, rows: int = 7) -> Shape:
    """A pointed leaf from the origin along +x with a folded midrib."""
    t = np.linspace(0, 1, rows)
    half = 0.5 * width * np.sin(np.pi * t**0.75) ** 0.8 * (1 - 0.25 * t) + 0.001
    across = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    x = length * t[None, :] + 0 * across[:, None]
    y = across[:, None] * half[None, :]
    z = -droop * length * t[None, :] ** 2 + 0.22 * np.abs(y)
    return sheet(np.stack([x, y, z], axis=-1), 0.0012)

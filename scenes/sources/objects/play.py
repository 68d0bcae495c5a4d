# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that model toys."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Shape,
    box,
    cylinder,
    extrude,
    lathe,
    loft,
    smooth_curve,
    soft_box,
    sphere,
    tube,
)


def toy_bear(w: PartBuilder) -> None:
    def ball(
        radius: float, at: tuple[float, float, float], stretch: tuple[float, float, float] = (1, 1, 1)
    ) -> Shape:
        return sphere(radius, segments=20).scaled(*stretch).moved(*at)

    w["bear", "fur"] += [
        ball(0.062, (0, 0, 0.064), (1, 0.9, 1.03)),
        ball(0.053, (0, -0.006, 0.158), (1.06, 0.95, 0.95)),
    ]
    for side in (-1, 1):
        w["bear", "fur"] += ball(0.02, (side * 0.043, 0.0, 0.2), (1, 0.55, 1))
        path = [(side * 0.045, -0.005, 0.105), (side * 0.075, -0.035, 0.085), (side * 0.078, -0.06, 0.07)]
        w["bear", "fur"] += tube(path, [0.021, 0.0215, 0.021], 16, smooth=4)
        fur_path = [(side * 0.035, -0.02, 0.031), (side * 0.06, -0.075, 0.028), (side * 0.066, -0.1, 0.03)]
        w["bear", "fur"] += tube(fur_path, [0.027, 0.026, 0.028], 18, smooth=4)
        w["bear", "pale"] += ball(0.021, (side * 0.067, -0.118, 0.034), (1, 0.4, 1.1))
        w["bear", "eye"] += ball(0.006, (side * 0.019, -0.054, 0.17))
        w["bow", "bow"] += ball(0.02, (side * 0.02, -0.05, 0.112), (1, 0.45, 0.62))
    w["bear", "pale"] += ball(0.024, (0, -0.05, 0.148), (1.1, 0.85, 0.85))
    w["bear", "eye"] += ball(0.0075, (0, -0.072, 0.156), (1.2, 0.8, 0.8))
    w["bow", "bow"] += ball(0.008, (0, -0.06, 0.112))


def _hull(stations: np.ndarray, tumblehome: float, sharpness: float, segments: int = 28) -> Shape:
    """Make a car's body through cross-sections ``stations`` (k, 4): x, half width, bottom, top. They are
    superellipses of exponent ``sharpness``, narrowed by the share ``tumblehome`` at the top."""
    rows = smooth_curve(stations, 3)
    angle = 2 * np.pi * (np.arange(segments) + 0.5) / segments
    c, s = np.cos(angle), np.sin(angle)
    across = np.sign(c) * np.abs(c) ** (2 / sharpness)
    upward = np.sign(s) * np.abs(s) ** (2 / sharpness)
    lean = 1 - tumblehome * np.clip(upward, 0, 1)
    rings = np.empty((len(rows), segments, 3))
    rings[..., 0] = rows[:, :1]
    rings[..., 1] = rows[:, 1:2] * across * lean
    rings[..., 2] = 0.5 * (rows[:, 2:3] + rows[:, 3:]) + 0.5 * (rows[:, 3:] - rows[:, 2:3]) * upward
    return loft(rings)


def _half_ring(radius: float, x: float, y: float, z: float, degrees: tuple[float, float]) -> np.ndarray:
    angle = np.radians(np.linspace(*degrees, 15))
    return np.column_stack([x + radius * np.cos(angle), np.full(15, y), z + radius * np.sin(angle)])


def toy_car(w: PartBuilder) -> None:
    """Add a die-cast saloon car 15 cm long: body, glass with pillars, arches, bumpers, lamps, door seams."""
    body = [
        (-0.0745, 0.0235, 0.0205, 0.034), (-0.0715, 0.029, 0.0165, 0.0395), (-0.061, 0.0325, 0.0135, 0.0435),
        (-0.036, 0.0336, 0.0125, 0.0465), (-0.02, 0.034, 0.0125, 0.0482), (0.02, 0.0342, 0.0125, 0.049),
        (0.046, 0.034, 0.0125, 0.0485), (0.062, 0.033, 0.0135, 0.046), (0.0715, 0.03, 0.0165, 0.0415),
        (0.0745, 0.025, 0.021, 0.0365),
    ]  # fmt: skip
    w["car", "paint"] += _hull(np.array(body), 0.09, 4.2)
    cabin = [
        (-0.0315, 0.0288, 0.044, 0.0492), (-0.0275, 0.0288, 0.044, 0.0535), (-0.013, 0.0286, 0.044, 0.0692),
        (-0.0075, 0.0284, 0.044, 0.0714), (0.011, 0.0284, 0.044, 0.0724), (0.029, 0.0284, 0.044, 0.0714),
        (0.0345, 0.0286, 0.044, 0.0692), (0.0495, 0.0288, 0.044, 0.0535), (0.0535, 0.0288, 0.044, 0.0492),
    ]  # fmt: skip
    w["car", "glass"] += _hull(np.array(cabin), 0.2, 5.5)
    roof = [
        (-0.0165, 0.0222, 0.067, 0.0694), (-0.013, 0.0236, 0.0674, 0.0712), (-0.0055, 0.0242, 0.0682, 0.073),
        (0.011, 0.0244, 0.0688, 0.0738), (0.027, 0.0242, 0.0682, 0.073), (0.0345, 0.0236, 0.0674, 0.0712),
        (0.038, 0.0222, 0.067, 0.0694),
    ]  # fmt: skip
    w["car", "paint"] += _hull(np.array(roof), 0.12, 3.2)
    for side in (-1, 1):
        for bottom, top in ((-0.0298, -0.0135), (0.0518, 0.0355)):
            ends = [(bottom, side * 0.0277, 0.0478), (top, side * 0.0225, 0.0686)]
            w["car", "paint"] += tube(ends, 0.0013, 8)
        middle = ((0.0478, 0.0277), (0.052, 0.0283), (0.059, 0.0281), (0.064, 0.0261), (0.0685, 0.0237))
        w["car", "paint"] += tube([(0.01, side * y, z) for z, y in middle], 0.0011, 8, smooth=2)
        for x in (-0.046, 0.046):
            arch = _half_ring(0.0208, 0, 0, 0, (-10, 190))[:, [0, 2]]
            plate = extrude(arch, 0.01, 0.0003).turned("x", 90)  # extends from y = 0 to -0.01
            w["car", "dark"] += plate.moved(x, 0.0343 if side > 0 else -0.0243, 0.0175)
            w["car", "paint"] += tube(_half_ring(0.0214, x, side * 0.0338, 0.0175, (-8, 188)), 0.0013, 8)
            _wheel(w, x, side)
        seam = [(-0.023, 0.0466), (-0.0225, 0.02), (-0.019, 0.0158), (0.0195, 0.0158), (0.0228, 0.0195),
                (0.0228, 0.0466)]  # fmt: skip
        w["car", "dark"] += tube([(x, side * _side_of_body(z), z) for x, z in seam], 0.00045, 6, smooth=3)
        handle = [
            (0.0125, side * 0.0342, 0.0405),
            (0.0155, side * 0.0353, 0.0406),
            (0.0185, side * 0.0342, 0.0405),
        ]
        w["car", "chrome"] += tube(handle, 0.0008, 6, smooth=2)
        rim = lathe([(0, 0), (0.0056, 0), (0.0062, 0.0008), (0.0058, 0.0022), (0.0048, 0.0024), (0.0047, 0.0014),
                     (0, 0.0014)], 24).turned("y", -90)  # fmt: skip
        lens = lathe([(0, 0.001), (0.0047, 0.0012), (0.0035, 0.0024), (0, 0.0029)], 20).turned("y", -90)
        for slot, shape in (("chrome", rim), ("lens", lens)):
            w["car", slot] += shape.moved(-0.0728, side * 0.0205, 0.0318)
        w["car", "lamp"] += soft_box(
            (0.003, 0.009, 0.0065), (0.0735, side * 0.0205, 0.0285), 0.0012, (0, 0, 0), 5
        )
    w["car", "dark"] += soft_box((0.003, 0.026, 0.0075), (-0.0738, 0, 0.0275), 0.001, (0, 0, 0), 5)
    for z in (0.0292, 0.0313, 0.0334):
        w["car", "chrome"] += tube([(-0.0756, -0.0115, z), (-0.0756, 0.0115, z)], 0.0005, 6)
    w["car", "dark"] += soft_box((0.118, 0.05, 0.005), (0, 0, 0.0098), 0.0015, (0, 0, 0), 6)
    for end in (-1, 1):
        path = [(end * x, y, 0.0222) for x, y in ((0.066, -0.0335), (0.0725, -0.0305), (0.0768, -0.022),
                (0.0775, 0.0), (0.0768, 0.022), (0.0725, 0.0305), (0.066, 0.0335))]  # fmt: skip
        w["car", "chrome"] += tube(path, 0.0021, 8, smooth=3)


def _side_of_body(z: float) -> float:
    """Half width of the car's body at mid-length and height ``z`` [m]."""
    upward = np.clip((z - 0.03075) / 0.01825, -0.999, 0.999)
    s = abs(upward) ** (4.2 / 2)
    across = (1 - s**2) ** (1 / 4.2)
    return float(0.0341 * across * (1 - 0.09 * max(upward, 0.0)))


def _wheel(w: PartBuilder, x: float, side: int) -> None:
    """Add a wheel of tyre, hub and cap; its outer face is 36 mm from the car's mid-plane."""
    tyre = [(0, 0), (0.0135, 0), (0.0166, 0.0012), (0.0175, 0.0034), (0.0175, 0.0056), (0.0169, 0.006),
            (0.0169, 0.0066), (0.0175, 0.007), (0.0175, 0.0092), (0.0166, 0.0114), (0.0135, 0.0124),
            (0.0118, 0.0116), (0, 0.0116)]  # fmt: skip
    hub = [(0, 0), (0.0116, 0), (0.0118, 0.0014), (0.0108, 0.0016), (0.0098, 0.0006), (0.0062, 0.0002),
           (0.0052, 0.0012), (0, 0.0012)]  # fmt: skip
    cap = [(0, 0), (0.0042, 0), (0.0038, 0.0011), (0.002, 0.0017), (0, 0.0019)]
    for slot, profile, y, segments in (
        ("tyre", tyre, 0.0236, 26),
        ("hub", hub, 0.0352, 22),
        ("chrome", cap, 0.0364, 14),
    ):
        shape = lathe(profile, segments).turned("x", -90 * side)
        w["wheels", slot] += shape.moved(x, side * y, 0.0175)


def toy_blocks(w: PartBuilder) -> None:
    s = 0.045
    cube = box((s, s, s), bevel=0.003, segments=2)
    for slot, x, y, z, angle in (
        ("red", -0.03, 0.0, 0, 8),
        ("yellow", 0.026, 0.008, 0, -14),
        ("blue", 0.0, 0.002, s, 22),
        ("bare", 0.075, -0.035, 0, 40),
    ):
        w["blocks", slot] += cube.turned("z", angle, (x, y, z))
    roof = extrude([(-s / 2, 0), (s / 2, 0), (0, s * 0.55)], s, 0.0025, 2).turned("x", 90, (0, s / 2, 0))
    w["blocks", "red"] += roof.turned("z", 22, (0, 0.002, 2 * s))
    w["blocks", "yellow"] += (
        cylinder(s / 2, s * 1.5, bevel=0.003, segments=32)
        .turned("y", 90)
        .turned("z", 55, (-0.055, -0.065, s / 2))
    )


def toy_duck(w: PartBuilder) -> None:
    body = sphere(0.04, segments=32).scaled(1.25, 1.0, 0.8).moved(0, 0, 0.029)

    def tail(p: np.ndarray) -> np.ndarray:
        q = p.copy()
        lift = np.clip((p[:, 0] - 0.012) / 0.04, 0, 1) ** 2
        q[:, 2] += 0.028 * lift
        q[:, 1] *= 1 - 0.55 * lift
        q[:, 2] = np.maximum(q[:, 2], 0.0)
        return q

    w["duck", "body"] += [body.bent(tail), sphere(0.026, (-0.026, 0, 0.078), 28)]
    w["duck", "beak"] += sphere(0.011, segments=20).scaled(1.2, 1.15, 0.4).moved(-0.054, 0, 0.073)
    for side in (-1, 1):
        w["duck", "eye"] += sphere(0.0036, (-0.045, side * 0.0135, 0.0865), 14)
        w["duck", "body"] += (
            sphere(0.02, segments=20).scaled(1.25, 0.35, 0.7).turned("y", -18, (0.012, side * 0.036, 0.038))
        )


def toy_train(w: PartBuilder) -> None:
    w["engine", "green"] += [
        box((0.13, 0.052, 0.014), (0, 0, 0.012), 0.003, 2),
        box((0.045, 0.05, 0.052), (0.04, 0, 0.025), 0.003, 2),
    ]
    w["engine", "red"] += [
        cylinder(0.0225, 0.078, bevel=0.003, segments=32).turned("y", -90, (0.02, 0, 0.047)),
        box((0.055, 0.062, 0.008), (0.04, 0, 0.0765), 0.003, 2),
    ]
    w["engine", "black"] += [
        lathe([(0, 0), (0.0085, 0), (0.0085, 0.018), (0.0125, 0.026), (0.012, 0.029), (0, 0.029)], 24).moved(
            -0.038, 0, 0.066
        ),
        sphere(0.009, (-0.008, 0, 0.069), 18),
    ]
    w["wagon", "bare"] += box((0.1, 0.052, 0.014), (0.135, 0, 0.012), 0.003, 2)
    for k, (slot, x) in enumerate((("red", 0.108), ("green", 0.135), ("red", 0.162))):
        w["wagon", slot] += (
            cylinder(0.0165, 0.03, (x, 0, 0.0255), 0.003, 24)
            if k != 1
            else box((0.022, 0.04, 0.034), (x, 0, 0.0255), 0.003, 2)
        )
    for x in (-0.045, -0.012, 0.042, 0.105, 0.165):
        for side in (-1, 1):
            lower = [(0, 0), (0.0135, 0), (0.015, 0.0015), (0.015, 0.0075)]
            upper = [(0.0135, 0.009), (0.005, 0.009), (0.0045, 0.011), (0, 0.0112)]
            w["wheels", "black"] += lathe([*lower, *upper], 28).turned(
                "x", 90 if side < 0 else -90, (x, side * 0.0265, 0.015)
            )
    w["wagon", "bare"] += tube([(0.062, 0, 0.019), (0.088, 0, 0.019)], 0.0032, 8)

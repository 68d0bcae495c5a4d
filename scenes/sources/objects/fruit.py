# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that model fruit."""

from __future__ import annotations

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import (
    Shape,
    grid,
    lathe,
    outward,
    smooth_curve,
    soft_box,
    sphere,
    tube,
    vessel,
    without_degenerate,
)


def unit(shape: Shape) -> Shape:
    """Return the shape with UVs scaled to [0, 1], for a texture that covers the fruit exactly once."""
    low, high = shape.uvs.min(axis=0), shape.uvs.max(axis=0)
    return Shape(shape.points, shape.faces, (shape.uvs - low) / (high - low), True)


def apple_shapes(size: float = 0.037) -> tuple[Shape, Shape]:
    """The fruit and stalk of an apple on z = 0."""
    lower = [(0, 0.22), (0.2, 0.06), (0.42, 0.0), (0.66, 0.14), (0.92, 0.6), (1.0, 1.05)]
    upper = [(0.9, 1.5), (0.6, 1.76), (0.32, 1.74), (0.12, 1.55), (0, 1.45)]
    body = lathe(np.array([*lower, *upper]) * size, 32, smooth=3)

    def lumpy(p: np.ndarray) -> np.ndarray:
        wave = np.cos(5 * np.arctan2(p[:, 1], p[:, 0]))
        return p * (1 + 0.025 * wave * np.clip(p[:, 2] / size, 0.2, 1))[:, None]

    lumps = body.bent(lumpy)
    lumps = lumps.moved(z=-lumps.points[:, 2].min())
    stalk_path = [(0, 0, 1.4 * size), (0.004, 0, 1.75 * size), (0.012, 0.002, 2.05 * size)]
    stalk = tube(stalk_path, [0.0012, 0.001, 0.0016], 6, smooth=2)
    return unit(lumps), stalk


def apple(w: PartBuilder) -> None:
    fruit, stalk = apple_shapes()
    w["apple", "skin"] += fruit
    w["apple", "stalk"] += stalk


def pear_shape(segments: int) -> Shape:
    """A straight pear on z = 0, about the z axis."""
    lower = [(0, 0.004), (0.012, 0.0), (0.024, 0.005), (0.0345, 0.025), (0.033, 0.045)]
    upper = [(0.024, 0.066), (0.0175, 0.084), (0.012, 0.094), (0, 0.096)]
    return lathe([*lower, *upper], segments, smooth=3)


def pear(w: PartBuilder) -> None:
    w["pear", "skin"] += pear_shape(32).bent(
        lambda p: p + np.column_stack([0.005 * (p[:, 2] / 0.1) ** 2, 0 * p[:, 2], 0 * p[:, 2]])
    )
    path = [(0.004, 0, 0.093), (0.007, 0, 0.105), (0.014, 0.002, 0.115)]
    w["pear", "stalk"] += tube(path, [0.0014, 0.0012, 0.0018], 6, smooth=2)


def lemons(w: PartBuilder) -> None:
    for angle, x, y in ((15, 0.0, 0.0), (105, 0.062, 0.018), (-40, -0.012, 0.066)):
        lower = [(0, -0.046), (0.005, -0.0435), (0.009, -0.037), (0.021, -0.027), (0.0285, -0.01)]
        upper = [(0.0285, 0.01), (0.022, 0.026), (0.011, 0.035), (0.007, 0.041), (0, 0.044)]
        body = lathe([*lower, *upper], 28, smooth=3)
        body = body.turned("y", 90).turned("z", angle)
        w["lemons", "skin"] += body.moved(x, y, -body.points[:, 2].min())


def banana(length: float = 0.19, bend_degrees: float = 78.0) -> Shape:
    """A banana with five soft ridges that starts at the origin along +x and bends towards -z."""
    stations = np.array([0, 0.03, 0.1, 0.17, 0.26, 0.38, 0.52, 0.68, 0.8, 0.89, 0.945, 0.965, 0.985, 1.0])
    radii = np.array([8.0, 6.6, 6.2, 7.2, 11.2, 16.2, 17.8, 17.4, 15.2, 11.0, 6.4, 4.6, 4.4, 3.2]) * 1e-3
    curve = smooth_curve(np.column_stack([stations, radii]), 3)
    t, radius = curve[:, 0], np.maximum(curve[:, 1], 0.003)
    # nearly straight at the stalk, bent along the body
    turn = np.radians(bend_degrees) * (t - 0.12 * np.sin(2 * np.pi * t) / (2 * np.pi) * 4) * 0.9
    heading = np.column_stack([np.cos(turn), 0 * t, -np.sin(turn)])
    steps = 0.5 * (heading[1:] + heading[:-1]) * (np.diff(t) * length)[:, None]
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    up = np.column_stack([np.sin(turn), 0 * t, np.cos(turn)])
    around = 2 * np.pi * np.arange(30) / 30
    ridges = 0.055 * np.clip((radius - 0.005) / 0.01, 0, 1)
    swell = 1 + ridges[:, None] * (np.cos(5 * around) - 0.15 * np.cos(10 * around))
    ring = radius[:, None] * swell
    points = path[:, None] + ring[..., None] * (
        np.cos(around)[:, None] * up[:, None] + np.sin(around)[:, None] * np.array([0.0, 1.0, 0.0])
    )
    ends = [np.broadcast_to(points[k].mean(axis=0), points[k].shape) for k in (0, -1)]
    lattice = np.concatenate([ends[0][None], points, ends[1][None]])
    return unit(outward(without_degenerate(grid(lattice, closed_u=True, unit_uv=True))))


def bananas(w: PartBuilder) -> None:
    """Add a hand of four bananas that rests on its blossom ends and its crown."""
    height = 0.0115  # height of the stalks above the table at the crown
    for k, (yaw, bend, length) in enumerate(
        ((-29, 84, 0.178), (-10, 77, 0.19), (9, 76, 0.192), (28, 83, 0.181))
    ):
        fruit = banana(length, bend).turned("x", (-9, -3, 3, 9)[k])
        low, high = -20.0, 60.0  # bounds of the pitch at which the blossom end touches the table
        for _ in range(40):
            pitch = 0.5 * (low + high)
            lowest = fruit.turned("y", -pitch).points[:, 2].min() + height
            low, high = (pitch, high) if lowest < 0 else (low, pitch)
        fruit = fruit.turned("y", -high).turned("z", yaw)
        w["bananas", "skin"] += fruit.moved(0.002, 0.0085 * (k - 1.5), height)
    crown = soft_box((0.022, 0.044, 0.02), (-0.004, 0, 0), 0.008, (0.001, 0.002, 0.001), 8)
    w["bananas", "crown"] += crown


def fruit_bowl(w: PartBuilder) -> None:
    w["bowl", "bowl"] += vessel(
        [(0.05, 0.004), (0.053, 0.009), (0.09, 0.03), (0.125, 0.06), (0.137, 0.08)], 0.005, foot=0.005
    )
    orange = unit(sphere(0.037, segments=28, squash=0.95))
    fruit, stalk = apple_shapes(0.036)
    for x, y, z in ((0.058, 0.01, 0.062), (-0.03, 0.055, 0.062), (0.002, 0.002, 0.108)):
        w["fruit", "orange"] += orange.turned("x", 40 * x * 20, (x, y, z))
    for x, y, z, lean in ((-0.042, -0.034, 0.026, 14), (0.025, -0.066, 0.03, -18)):
        for slot, shape in (("apple", fruit), ("stalk", stalk)):
            w["fruit", slot] += shape.turned("y", lean, (x, y, z))
    w["fruit", "pear"] += pear_shape(28).turned("x", 74).turned("z", 30, (0.055, 0.062, 0.064))

# SPDX-License-Identifier: GPL-3.0-or-later
"""Fruit."""

from __future__ import annotations

import bpy
import numpy as np

from scenes.sources.materials.graph import Graph, srgb
from scenes.sources.modelling import Slot, Workshop
from scenes.sources.objects.crockery import vessel
from scenes.sources.objects.registry import (
    glaze,
    organic,
    thing,
)
from scenes.sources.shapes import (
    Shape,
    lathe,
    sphere,
    tube,
)


def _apple_skin(g: Graph) -> bpy.types.Material:

    streak = g.noise(18, 1.5, detail=3, seed=2.0, spread=0.3)
    blush = g.fit(g.add(g.mul(g.noise(2, detail=2, seed=4.0), 0.7), g.mul(streak, 0.4)), 0.25, 0.8)
    dots = g.fit(g.voronoi(30, seed=3.0).outputs["Distance"], 0.06, 0.14, 1.0, 0.0)
    color = g.mix(g.mul(dots, 0.4), g.mix(blush, srgb("c7a53c"), srgb("8e1f1a")), srgb("dcc48a"))
    return g.finish(color, g.line(streak, 0, 1, 0.26, 0.36), ior=1.42)


def _orange_skin(g: Graph) -> bpy.types.Material:
    pore = g.fit(g.voronoi(34, seed=5.0).outputs["Distance"], 0.05, 0.4)
    return g.finish(
        g.shade(srgb("d9781a"), g.line(pore, 0, 1, 0.7, 1.08)), g.line(pore, 0, 1, 0.55, 0.36), ior=1.45
    )


APPLE = Slot(("organic",), (), graph=_apple_skin)


ORANGE = Slot(("organic",), (), graph=_orange_skin)


def unit(shape: Shape) -> Shape:
    """The same shape with its UVs fitted into [0, 1]: skins are laid out once around a fruit."""
    low, high = shape.uvs.min(axis=0), shape.uvs.max(axis=0)
    return Shape(shape.points, shape.faces, (shape.uvs - low) / (high - low), True)


def apple(size: float = 0.037) -> tuple[Shape, Shape]:
    """(fruit, stalk) standing on z = 0."""
    profile = [
        (0, 0.22),
        (0.2, 0.06),
        (0.42, 0.0),
        (0.66, 0.14),
        (0.92, 0.6),
        (1.0, 1.05),
        (0.9, 1.5),
        (0.6, 1.76),
        (0.32, 1.74),
        (0.12, 1.55),
        (0, 1.45),
    ]
    body = lathe(np.array(profile) * size, 32, smooth=3)
    lumps = body.bent(
        lambda p: (
            p
            * (1 + 0.025 * np.cos(5 * np.arctan2(p[:, 1], p[:, 0])) * np.clip(p[:, 2] / size, 0.2, 1))[
                :, None
            ]
        )
    )
    lumps = lumps.moved(z=-lumps.points[:, 2].min())
    stalk = tube(
        [(0, 0, 1.4 * size), (0.004, 0, 1.75 * size), (0.012, 0.002, 2.05 * size)],
        [0.0012, 0.001, 0.0016],
        6,
        smooth=2,
    )
    return unit(lumps), stalk


@thing("apple", "Apple", "fruit", skin=APPLE, stalk=organic("4a3521", 0.8))
def apple_alone(w: Workshop) -> None:
    fruit, stalk = apple()
    w.add("apple", "skin", fruit)
    w.add("apple", "stalk", stalk)


@thing("pear", "Pear", "fruit", skin=organic("9aa03c", 0.42), stalk=organic("4a3521", 0.8))
def pear(w: Workshop) -> None:
    body = lathe(
        [
            (0, 0.004),
            (0.012, 0.0),
            (0.024, 0.005),
            (0.0345, 0.025),
            (0.033, 0.045),
            (0.024, 0.066),
            (0.0175, 0.084),
            (0.012, 0.094),
            (0, 0.096),
        ],
        32,
        smooth=3,
    )
    w.add(
        "pear",
        "skin",
        body.bent(lambda p: p + np.column_stack([0.005 * (p[:, 2] / 0.1) ** 2, 0 * p[:, 2], 0 * p[:, 2]])),
    )
    w.add(
        "pear",
        "stalk",
        tube(
            [(0.004, 0, 0.093), (0.007, 0, 0.105), (0.014, 0.002, 0.115)],
            [0.0014, 0.0012, 0.0018],
            6,
            smooth=2,
        ),
    )


@thing("lemons", "Lemons", "fruit", skin=organic("d9b823", 0.4))
def lemons(w: Workshop) -> None:
    for angle, x, y in ((15, 0.0, 0.0), (105, 0.062, 0.018), (-40, -0.012, 0.066)):
        body = lathe(
            [
                (0, -0.046),
                (0.005, -0.0435),
                (0.009, -0.037),
                (0.021, -0.027),
                (0.0285, -0.01),
                (0.0285, 0.01),
                (0.022, 0.026),
                (0.011, 0.035),
                (0.007, 0.041),
                (0, 0.044),
            ],
            28,
            smooth=3,
        )
        body = body.turned("y", 90).turned("z", angle)
        w.add("lemons", "skin", body.moved(x, y, -body.points[:, 2].min()))


@thing("bananas", "Bananas", "fruit", skin=organic("d8b43a", 0.5), tip=organic("4a3a1c", 0.8))
def bananas(w: Workshop) -> None:
    for k, spread in enumerate((-20, 2, 24)):
        t = np.linspace(0, 1, 9)
        x = 0.19 * t - 0.02
        arch = 0.062 * np.sin(np.pi * (0.12 + 0.8 * t))
        path = np.column_stack([x, 0 * t, arch])
        radius = 0.0175 * np.array([0.35, 0.55, 0.86, 1.0, 1.03, 1.0, 0.9, 0.6, 0.28])
        fruit = tube(path, radius, 5, smooth=3)
        # five soft edges: turn the section so that an edge looks out
        fruit = fruit.turned("x", 62 - 10 * k).turned("z", spread)
        low = fruit.points[:, 2].min()
        w.add("bananas", "skin", fruit.moved(0, 0.012 * k, -low))
    w.add("bananas", "tip", sphere(0.011, (-0.018, 0.012, 0.012), 12, 1.0))


@thing(
    "fruit_bowl",
    "Bowl of fruit",
    "fruit",
    bowl=glaze("36566b", 0.15),
    apple=APPLE,
    orange=ORANGE,
    pear=organic("a2a545", 0.42),
    stalk=organic("4a3521", 0.8),
)
def fruit_bowl(w: Workshop) -> None:
    w.add(
        "bowl",
        "bowl",
        vessel(
            [(0.05, 0.004), (0.053, 0.009), (0.09, 0.03), (0.125, 0.06), (0.137, 0.08)], 0.005, foot=0.005
        ),
    )
    orange = unit(sphere(0.037, segments=28, squash=0.95))
    fruit, stalk = apple(0.036)
    for x, y, z in ((0.058, 0.01, 0.062), (-0.03, 0.055, 0.062), (0.002, 0.002, 0.108)):
        w.add("fruit", "orange", orange.turned("x", 40 * x * 20).moved(x, y, z))
    for x, y, z, lean in ((-0.042, -0.034, 0.026, 14), (0.025, -0.066, 0.03, -18)):
        for slot, shape in (("apple", fruit), ("stalk", stalk)):
            w.add("fruit", slot, shape.turned("y", lean).moved(x, y, z))
    pear_body = lathe(
        [
            (0, 0.004),
            (0.012, 0.0),
            (0.024, 0.005),
            (0.0345, 0.025),
            (0.033, 0.045),
            (0.024, 0.066),
            (0.0175, 0.084),
            (0.012, 0.094),
            (0, 0.096),
        ],
        28,
        smooth=3,
    )
    w.add("fruit", "pear", pear_body.turned("x", 74).turned("z", 30).moved(0.055, 0.062, 0.064))

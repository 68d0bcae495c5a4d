# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials with a picture on the UV unit square, for frames, book covers and clock dials."""

from __future__ import annotations

from bpy.types import Material

from scenes.sources.materials.graph import Color, Graph, Output, Value, srgb


def landscape(
    g: Graph, sky: tuple[Color, Color], hills: tuple[Color, ...], seed: float = 1.0, rough: float = 0.55
) -> Material:
    """A painting of layered hills under a sky with a pale sun, in brush strokes."""
    u, v = g.uv()
    stroke = g.noise(14, 60, detail=3, seed=seed, spread=0.3)
    color: Value | Color = g.mix(v + (stroke - 0.5) * 0.25, sky[1], sky[0])
    sun = g.math("SQRT", (u - 0.68) ** 2.0 + (v - 0.72) ** 2.0)
    color = g.mix(g.line(sun, 0.08, 0.085, 0.9, 0.0), color, srgb("f3e3c0"))
    for k, hill in enumerate(hills):
        ridge = g.noise(1.5 + k, 0.01, detail=3, seed=seed + 3 * k)
        edge = g.math("MULTIPLY_ADD", ridge, 0.22, 0.52 - 0.17 * k)
        inside = g.line(edge - v, 0.0, 0.006)
        tone = g.line(g.noise(30, 12, detail=3, seed=seed + k, spread=0.3), 0, 1, 0.8, 1.2)
        color = g.mix(inside, color, g.shade(hill, tone))
    return g.finish(color, g.line(stroke, 0, 1, rough - 0.1, rough + 0.12))


def blocks(
    g: Graph, ground: Color, colors: tuple[Color, ...], seed: float = 1.0, grid: tuple[int, int] = (3, 4)
) -> Material:
    """A geometric print: quarter discs and squares in a grid."""
    cell = g.cells(*grid)
    pick = g.random(cell.number, seed)
    corner = g.random(cell.number, seed + 1)
    x = abs(cell.x - (corner > 0.5))
    y = abs(cell.y - (g.random(cell.number, seed + 2) > 0.5))
    disc = g.line(g.length((x, y)), 0.97, 0.99, 1.0, 0.0)
    inked = disc * (g.random(cell.number, seed + 3) > 0.15)
    color: Value | Color = colors[0]
    for k, other in enumerate(colors[1:], 1):
        color = g.mix(pick > k / len(colors), color, other)
    paper = g.shade(ground, g.line(g.noise(30, detail=4, seed=seed), 0, 1, 0.97, 1.02))
    return g.finish(g.mix(inked, paper, color), g.line(inked, 0, 1, 0.85, 0.6))


def cover(g: Graph, ground: Color, ink: Color, seed: float = 1.0, rough: float = 0.4) -> Material:
    """The cover of a book or magazine: title bars and a picture field."""
    u, v = g.uv()
    rows = g.cells(1, 16)
    row = g.math("FLOOR", v * 16.0)
    width = g.line(g.random(row, seed), 0, 1, 0.35, 0.8)
    is_title = (v > 0.70) * (v < 0.94)
    bar = (abs(u - 0.5) < width * 0.5) * (rows.y > 0.45)
    letters = g.noise(60, 34, detail=0, seed=seed, spread=0.3) > 0.3
    ink_mask = is_title * bar * letters
    field = (abs(u - 0.5) < 0.36) * (abs(v - 0.36) < 0.26)
    picture = g.mix(g.noise(4, detail=5, seed=seed + 3), g.shade(ink, 0.5), g.shade(ground, 1.3))
    color = g.mix(field, g.mix(ink_mask, ground, ink), picture)
    return g.finish(color, g.line(g.noise(6, detail=4, seed=seed + 8), 0, 1, rough - 0.08, rough + 0.12))


def portrait(g: Graph, ground: Color, skin: Color, coat: Color, seed: float = 1.0) -> Material:
    """A portrait photograph: head, shoulders and a blurred background, as a semi-gloss print."""
    u, v = g.uv()

    def ellipse(cx: float, cy: float, rx: float, ry: float) -> Output:
        dx = (u - cx) * (1 / rx)
        dy = (v - cy) * (1 / ry)
        return g.fit(g.length((dx, dy)), 0.94, 1.04, 1.0, 0.0)

    color: Value | Color = g.mix(
        g.noise(2.5, detail=3, seed=seed), g.shade(ground, 0.6), g.shade(ground, 1.4)
    )
    color = g.mix(ellipse(0.5, 0.02, 0.36, 0.34), color, coat)
    color = g.mix(ellipse(0.5, 0.63, 0.185, 0.24), color, g.shade(coat, 0.3))
    color = g.mix(ellipse(0.5, 0.40, 0.075, 0.14), color, g.shade(skin, 0.8))
    color = g.mix(ellipse(0.5, 0.58, 0.15, 0.2), color, skin)
    return g.finish(color, 0.3)


def dial(g: Graph, ground: Color, ink: Color) -> Material:
    """The face of a clock: twelve long and sixty short marks around the centre of the UV square."""
    u, v = g.uv()
    x, y = u - 0.5, v - 0.5
    radius = g.length((x, y))
    angle = g.math("ARCTAN2", y, x) * 0.15915494
    color: Value | Color = ground
    for count, low, high, half in ((60.0, 0.435, 0.455, 0.06), (12.0, 0.375, 0.455, 0.045)):
        turn = abs(g.math("FRACT", g.math("MULTIPLY_ADD", angle, count, 0.5)) - 0.5)
        mark = turn * radius < half * 0.455 * (12 / count if count > 12 else 1.0) * (5 if count > 12 else 1)
        ring = (radius > low) * (radius < high)
        color = g.mix(mark * ring, color, ink)
    return g.finish(color, 0.45)

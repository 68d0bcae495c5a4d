# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that build man-made materials: metal, plastic, rubber, ceramic, tiles, paint, plaster."""

from __future__ import annotations

from bpy.types import Material

from scenes.sources.materials.graph import Color, Graph, Value, srgb


def brushed_metal(
    g: Graph, color: Color, *, rough: float = 0.28, spread: float = 0.14, prints: bool = False, seed: float = 1.0
) -> Material:  # fmt: skip
    """Metal brushed along u: strokes and, with ``prints``, fingerprints vary its roughness."""
    stroke = g.noise(3, 210, detail=2, seed=seed, spread=0.3)
    value: Value = g.line(stroke, 0, 1, rough - spread / 2, rough + spread / 2)
    value += g.scratches(seed + 3, 0.35) * 0.15
    if prints:
        value += g.fingerprints(8, 0.08, int(seed) + 3) * 0.2
    return g.finish(color, value, 1.0)


def worn_metal(
    g: Graph, color: Color, *, rough: float = 0.3, grime: Color | None = None, amount: float = 0.4,
    scale: float = 4.0, seed: float = 1.0, dent: float = 0.0,
) -> Material:  # fmt: skip
    """Metal with cloudy wear, scratches and, with ``grime``, non-metallic rust or patina."""
    cloud = g.noise(scale, detail=5, seed=seed)
    value: Value = g.line(cloud, 0, 1, rough - 0.08, rough + 0.16)
    value += g.scratches(seed, 0.6) * 0.18
    if dent:
        value += g.voronoi(12, feature="SMOOTH_F1", seed=seed)["Distance"] * dent
    if grime is None:
        return g.finish(color, value, 1.0)
    edge = (
        g.noise(scale * 0.8, detail=6, seed=seed + 9, roughness=0.62) * 0.8
        + g.noise(40, detail=2, seed=seed + 4) * 0.2
    )
    mask = g.fit(edge, 0.86 - amount * 0.7, 1.02 - amount * 0.7)
    tint = g.shade(grime, g.line(g.noise(18, detail=4, seed=seed + 13), 0, 1, 0.55, 1.4))
    return g.finish(g.mix(mask, color, tint), g.math("MAXIMUM", value, mask * 0.86), 1.0 - mask)


def galvanised(g: Graph, color: Color, *, seed: float = 1.0) -> Material:
    """Galvanised zinc whose brightness and roughness vary by crystal."""
    node = g.voronoi(9, seed=seed, warp=g.noise(6, detail=3, seed=seed) * 0.8)
    pick = g.components(node["Color"])
    return g.finish(g.shade(color, g.line(pick[0], 0, 1, 0.82, 1.08)), g.line(pick[1], 0, 1, 0.3, 0.5), 1.0)


def moulded(
    g: Graph, color: Color, *, rough: float = 0.4, grain: float = 0.1, scratched: float = 0.0, cells: float = 60.0,
    ior: float = 1.5, tint: float = 0.0, seed: float = 1.0, prints: bool = False,
) -> Material:  # fmt: skip
    """Plastic, rubber, enamel or glaze of one colour; grain, scratches and fingerprints vary its roughness,
    and ``tint`` > 0 its colour.
    """
    value: Value = g.line(
        g.noise(cells, detail=2, seed=seed, spread=0.3), 0, 1, rough - grain / 2, rough + grain / 2
    )
    if scratched:
        value += g.scratches(seed, 0.4 + scratched) * (0.3 * scratched + 0.1)
    if prints:
        value += g.fingerprints(8, 0.08, int(seed) + 11) * 0.24
        value += g.fit(g.noise(3, detail=3, seed=seed + 8), 0.5, 1) * 0.07
    shaded: Value | Color = color
    if tint:
        shaded = g.shade(color, g.line(g.noise(cells / 6, detail=5, seed=seed + 2), 0, 1, 1 - tint, 1 + tint))
    return g.finish(shaded, value, ior=ior)


def studs(g: Graph, color: Color, *, count: int = 10, rough: float = 0.7, seed: float = 1.0) -> Material:
    """Rubber flooring with round studs, whose tops are smoother and greyer from wear."""
    cell = g.cells(count, count)
    away = g.length(part - 0.5 for part in (cell.x, cell.y))
    top = g.line(away, 0.30, 0.34, 1.0, 0.0)
    rim = g.line(away, 0.34, 0.38, 1, 0) * (1.0 - top)
    dust = g.noise(7, detail=5, seed=seed)
    tone = g.line(top, 0, 1, 0.85, 1.25) + rim * -0.35
    return g.finish(
        g.shade(color, tone * g.line(dust, 0, 1, 0.85, 1.35)), g.line(top, 0, 1, rough + 0.12, rough - 0.08)
    )


def speckled(
    g: Graph, color: Color, speck: Color, *, rough: float = 0.14, amount: float = 0.5, ior: float = 1.55,
    bare: Color | None = None, seed: float = 1.0,
) -> Material:  # fmt: skip
    """Glaze with specks and uneven tone; ``bare``: colour of unglazed patches, if any."""
    dots = g.fit(g.voronoi(36, seed=seed)["Distance"], 0.10, 0.22 + 0.1 * amount, 1.0, 0.0)
    some = g.noise(30, detail=0, seed=seed + 6) > 0.75 - 0.35 * amount
    pool = g.noise(3, detail=4, seed=seed + 2)
    mask = dots * some
    shaded = g.mix(mask, g.shade(color, g.line(pool, 0, 1, 0.85, 1.1)), speck)
    value: Value = g.line(pool, 0, 1, rough + 0.05, rough - 0.04) + mask * 0.2
    if bare is not None:
        clay = g.fit(g.noise(2.5, detail=5, seed=seed + 9), 0.62, 0.66)
        shaded, value = g.mix(clay, shaded, bare), g.math("MAXIMUM", value, clay * 0.72)
    return g.finish(shaded, value, ior=ior)


def crackle(
    g: Graph, color: Color, crack: Color, *, rough: float = 0.1, cells: float = 12.0, seed: float = 1.0
) -> Material:
    """Glaze with a net of stained cracks."""
    warp = g.noise(8, detail=3, seed=seed) * 0.5
    edge = g.voronoi(cells, feature="DISTANCE_TO_EDGE", seed=seed, warp=warp)["Distance"]
    line = g.fit(edge, 0.0, 0.035, 0.8, 0.0)
    pool = g.noise(3, detail=4, seed=seed + 2)
    return g.finish(
        g.mix(line, g.shade(color, g.line(pool, 0, 1, 0.88, 1.06)), crack), line * 0.3 + rough, ior=1.55
    )


def tiles(
    g: Graph, glaze: Color, grout: Color, *, grid: tuple[int, int] = (5, 5), shift: str = "none", joint: float = 0.006,
    rough: float = 0.1, vary: float = 0.08, second: Color | None = None, checker: bool = False, seed: float = 1.0,
    cloud: float = 0.05, ior: float = 1.55,
) -> Material:  # fmt: skip
    """Glazed or stone tiles with matt grout; tone and gloss vary by tile. ``joint``: width of the joints as a
    share of the texture's side; ``second``: a second glaze, at random or, with ``checker``, chequered.
    """
    cell = g.cells(*grid, shift=shift, jitter_seed=seed)
    tone = g.random(cell.number, seed)
    color: Value | Color = glaze
    if second is not None:
        if checker:
            row = g.math("FLOOR", cell.number * (1 / grid[0]))
            column = cell.number - row * float(grid[0])
            pick = (row + column) % 2.0
        else:
            pick = g.random(cell.number, seed + 5)
        color = g.mix(pick, glaze, second)
    pool = g.noise(9, detail=4, seed=seed + 2)
    color = g.shade(color, g.line(tone, 0, 1, 1 - vary, 1 + vary) * g.line(pool, 0, 1, 1 - cloud, 1 + cloud))
    border = g.line(cell.edge, joint * 0.38, joint * 0.5, 1.0, 0.0)
    rim = g.line(cell.edge, joint * 0.5, joint * 1.4, 1.0, 0.0) * 0.10
    sand = g.noise(90, detail=2, seed=seed + 4)
    value: Value = g.line(g.random(cell.number, seed + 8), 0, 1, rough - 0.02, rough + 0.06) + rim
    value += g.fit(g.noise(4, detail=4, seed=seed + 6), 0.5, 1.0) * 0.05
    color = g.mix(border, color, g.shade(grout, g.line(sand, 0, 1, 0.8, 1.12)))
    return g.finish(color, g.math("MAXIMUM", value, border * 0.88), ior=ior)


def paint(
    g: Graph, color: Color, *, rough: float = 0.5, stipple: float = 0.1, chips: float = 0.0, under: Color = (0.3, 0.3, 0.3),
    under_metal: float = 0.0, prints: bool = False, cells: float = 50.0, seed: float = 1.0,
) -> Material:  # fmt: skip
    """Paint; roller stipple and, with ``prints``, fingerprints vary its roughness. ``chips``: amount of
    flaked patches, which expose the colour ``under``.
    """
    value: Value = g.line(
        g.noise(cells, detail=3, seed=seed, spread=0.28), 0, 1, rough - stipple / 2, rough + stipple / 2
    )
    if prints:
        value += g.fingerprints(9, 0.07, int(seed) + 5) * 0.25
    if not chips:
        return g.finish(color, value)
    edge = (
        g.noise(5, detail=6, seed=seed + 9, roughness=0.62) * 0.85
        + g.noise(36, detail=2, seed=seed + 3) * 0.15
    )
    mask = g.fit(edge, 0.93 - 0.5 * chips, 0.96 - 0.5 * chips)
    fade = g.line(g.noise(4, detail=3, seed=seed + 17), 0, 1, 0.9, 1.08)
    bottom = g.shade(under, g.line(g.noise(12, 60, detail=3, seed=seed + 21), 0, 1, 0.8, 1.15))
    return g.finish(g.mix(mask, g.shade(color, fade), bottom), value + mask * 0.2, mask * under_metal)


def plaster(
    g: Graph,
    color: Color,
    *,
    rough: float = 0.88,
    trowel: float = 0.08,
    polish: float = 0.0,
    seed: float = 1.0,
) -> Material:
    """Plaster or stucco with clouds of relative amplitude ``trowel``; ``polish`` lowers the roughness."""
    arc = g.noise(3, detail=5, seed=seed, roughness=0.6)
    sweep = g.noise(4, 11, detail=4, seed=seed + 4)
    body = arc * 0.6 + sweep * 0.4
    tone = g.line(body, 0, 1, 1 - trowel, 1 + trowel) + g.line(
        g.noise(70, detail=2, seed=seed + 2), 0, 1, -trowel / 3, trowel / 3
    )
    low = rough - 0.5 * polish
    return g.finish(g.shade(color, tone), g.line(body, 0, 1, low + 0.06 + 0.12 * polish, low - 0.06))


def brick(
    g: Graph, clay: Color, second: Color, mortar: Color, *, grid: tuple[int, int] = (4, 12), seed: float = 1.0
) -> Material:
    """Brickwork in stretcher bond."""
    cell = g.cells(*grid, shift="half")
    ragged = (g.noise(40, detail=3, seed=seed) - 0.5) * 0.003
    border = g.line(cell.edge + ragged, 0.0035, 0.0055, 1.0, 0.0)
    body = g.noise(16, detail=5, seed=seed + 2, roughness=0.6)
    color = g.shade(g.mix(g.random(cell.number, seed), clay, second), g.line(body, 0, 1, 0.78, 1.2))
    color = g.mix(border, color, g.shade(mortar, g.line(body, 0, 1, 0.85, 1.1)))
    return g.finish(color, g.line(body, 0, 1, 0.95, 0.82))


def screen(g: Graph, seed: float = 1.0) -> Material:
    """A switched-off screen with smears."""
    return g.finish(srgb("0a0b0d"), 0.07 + g.fit(g.noise(4, detail=3, seed=seed), 0.5, 1.0) * 0.12)


def grille(g: Graph, count: int = 24, color: Color = srgb("26282a")) -> Material:
    """A panel with ``count`` x ``count`` round holes."""
    cell = g.cells(count, count, shift="half")
    away = g.length(part - 0.5 for part in (cell.x, cell.y))
    hole = g.line(away, 0.27, 0.33, 1.0, 0.0)
    return g.finish(g.mix(hole, color, srgb("050505")), g.line(hole, 0, 1, 0.4, 0.9))

# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that build natural materials: wood, stone, leather, fabric, paper, cork, fruit skin."""

from __future__ import annotations

from bpy.types import Material

from scenes.sources.materials.graph import Color, Graph, Value, srgb


def wood(
    g: Graph, dark: Color, light: Color, *, planks: tuple[int, int] | None = None, rings: int = 5,
    contrast: float = 1.0, gloss: float = 0.42, prints: bool = False, seed: float = 1.0, wear: float = 0.0,
    gap: float = 0.0012,
) -> Material:  # fmt: skip
    """Sawn wood with its grain along u. ``planks``: columns and rows of boards; ``prints`` adds fingerprints
    to the varnish; ``wear``: how far it is worn off in patches, from 0 (intact)."""
    shift: Value = seed
    tone: Value = 0.5
    if planks:
        boards = g.cells(*planks, shift="random", jitter_seed=seed)
        shift = g.math("MULTIPLY_ADD", g.random(boards.number, seed), 37.0, seed)
        tone = g.random(boards.number, seed + 4)
    warp = g.noise(1.6, 5, detail=2, seed=shift, spread=0.3)
    figure = g.wave(0, rings * (planks[1] if planks else 1), warp, 9.0 if planks else 6.5 * contrast)
    fibre = g.noise(9, 190, detail=2, seed=shift, spread=0.3)
    cathedral = figure * (0.45 * contrast) + g.noise(2.5, 22, 3, seed=g.math("ADD", shift, 8.0)) * 0.55
    amount = cathedral * 0.75 + fibre * 0.25
    pores = g.fit(g.noise(26, 260, detail=1, seed=g.math("ADD", shift, 3.0), spread=0.3), 0.70, 0.86)
    color = g.mix(amount, dark, light)
    color = g.shade(color, g.line(tone, 0, 1, 0.82, 1.14))
    color = g.shade(color, g.line(pores, 0, 1, 1.0, 0.62))
    rough: Value = g.line(amount, 0, 1, gloss + 0.07, gloss - 0.03) + pores * 0.16
    if wear > 0:
        bare = g.fit(g.noise(3, 5, detail=5, seed=seed + 20), 0.92 - wear, 1.15 - wear)
        color = g.mix(bare * 0.7, color, g.shade(light, 0.9))
        rough += bare * 0.30
    if prints:
        rough += g.fingerprints(9, 0.055, int(seed)) * 0.22
        rough += g.fit(g.noise(4, 4, 3, seed=seed + 30), 0.55, 1.0) * 0.06
    if planks:
        joint = g.line(boards.edge, gap * 0.4, gap, 1.0, 0.0)
        color = g.mix(joint, color, g.shade(dark, 0.16))
        rough = g.math("MAXIMUM", rough, joint * 0.8)
    return g.finish(color, rough)


def marble(
    g: Graph, ground: Color, veins: Color, *, gloss: float = 0.12, scale: float = 2.0, sharp: float = 0.06,
    seed: float = 1.0, clouds: float = 0.25,
) -> Material:  # fmt: skip
    """Polished marble with thin warped veins of two sizes over clouds; veins are slightly rougher."""
    warp = g.noise(scale, detail=5, seed=seed, spread=0.25)
    big = abs(g.wave(1, 2, warp, 11.0) - 0.5)
    small = abs(g.wave(-3, 2, g.noise(2 * scale, detail=6, seed=seed + 7), 9.0) - 0.5)
    fade = g.noise(scale + 1, detail=3, seed=seed + 3)
    vein = g.math("MAXIMUM", g.fit(big, 0.0, sharp * 2.2, 1, 0) * fade,
                  g.fit(small, 0.0, sharp, 0.7, 0) * (1.0 - fade))  # fmt: skip
    cloud = g.noise(scale * 1.5, detail=4, seed=seed + 11)
    color = g.mix(cloud * clouds, ground, g.shade(veins, 1.3))
    color = g.mix(vein, color, veins)
    rough = vein * 0.10 + g.line(g.noise(5, detail=3, seed=seed + 15), 0, 1, gloss - 0.03, gloss + 0.05)
    return g.finish(color, rough, ior=1.52)


def granite(
    g: Graph, *colors: Color, gloss: float = 0.15, cells: float = 22.0, seed: float = 1.0
) -> Material:
    """Polished granite with grains of feldspar, quartz and mica; mica is glossier."""
    grain = g.voronoi(cells, seed=seed, warp=g.noise(9, detail=3, seed=seed) * 0.6)["Color"]
    pick = g.components(grain)
    fine = g.noise(3 * cells, detail=2, seed=seed + 4)
    amount = pick[0] * 0.75 + fine * 0.25
    color = g.ramp(amount, (0.18, colors[0]), (0.46, colors[1]), (0.8, colors[2]))
    return g.finish(color, g.line(amount, 0.1, 0.9, gloss - 0.05, gloss + 0.09), ior=1.53)


def terrazzo(
    g: Graph, binder: Color, *chips: Color, gloss: float = 0.22, cells: float = 9.0, seed: float = 1.0
) -> Material:
    """Terrazzo: stone chips in cement, ground flat."""
    node = g.voronoi(cells, seed=seed)
    pick = g.components(node["Color"])
    inside = g.fit(node["Distance"], 0.40, 0.44, 1.0, 0.0)
    chosen = g.ramp(pick[1], *[(i / len(chips) + 0.1, chip) for i, chip in enumerate(chips)])
    speck = g.fit(g.noise(70, detail=1, seed=seed + 3), 0.7, 0.8)
    ground = g.mix(speck * 0.5, binder, chips[0])
    return g.finish(g.mix(inside, ground, chosen), g.line(inside, 0, 1, gloss + 0.18, gloss))


def rock(
    g: Graph, dark: Color, light: Color, *, rough: float = 0.75, bands: int = 0, pits: float = 0.3,
    scale: float = 4.0, seed: float = 1.0,
) -> Material:  # fmt: skip
    """Unpolished stone such as slate, sandstone, concrete or travertine, with ``bands`` layers per tile."""
    body = g.noise(scale, detail=6, seed=seed, roughness=0.6)
    if bands:
        body = body * 0.4 + g.wave(0, bands, g.noise(2, 6, 4, seed=seed + 1), 7.0) * 0.6
    hole = g.fit(g.noise(scale * 9, detail=2, seed=seed + 2), 0.95 - 0.35 * pits, 1.05 - 0.35 * pits)
    color = g.shade(g.mix(body, dark, light), g.line(hole, 0, 1, 1.0, 0.55))
    return g.finish(color, g.line(body, 0, 1, rough + 0.06, rough - 0.10) + hole * 0.12)


def leather(
    g: Graph, color: Color, *, gloss: float = 0.42, pebble: float = 40.0, wear: float = 0.25, seed: float = 1.0
) -> Material:  # fmt: skip
    """Grained leather with darker, rougher creases and lighter, smoother worn parts."""
    warp = g.noise(pebble / 3, detail=2, seed=seed) * 0.7
    crease = g.fit(
        g.voronoi(pebble, feature="DISTANCE_TO_EDGE", seed=seed, warp=warp)["Distance"], 0.02, 0.22, 1, 0
    )
    folds = g.fit(abs(g.noise(4, detail=4, seed=seed + 2) - 0.5), 0, 0.05, 0.6, 0)
    lines = g.math("MAXIMUM", crease, folds)
    rubbed = g.noise(3, detail=4, seed=seed + 5)
    tone = g.line(rubbed, 0, 1, 1 - wear, 1 + 0.9 * wear) * g.line(lines, 0, 1, 1.0, 0.62)
    rough = g.line(rubbed, 0, 1, gloss + 0.08, gloss - 0.06) + lines * 0.20
    return g.finish(g.shade(color, tone), rough, ior=1.48)


def suede(g: Graph, color: Color, *, seed: float = 1.0) -> Material:
    """Brushed hide: matt, with lighter and darker strokes."""
    nap = g.noise(5, 8, detail=4, seed=seed)
    fine = g.noise(120, detail=1, seed=seed + 2)
    return g.finish(g.shade(color, g.line(nap, 0, 1, 0.78, 1.18) + g.line(fine, 0, 1, -0.1, 0.1)),
                    g.line(nap, 0, 1, 0.93, 0.84), ior=1.4)  # fmt: skip


def weave(
    g: Graph, warp_color: Color, weft_color: Color, *, threads: int = 24, twill: int = 1, rough: float = 0.82,
    fuzz: float = 0.3, seed: float = 1.0, warp_stripe: tuple[int, Color] | None = None,
    weft_stripe: tuple[int, Color] | None = None,
) -> Material:  # fmt: skip
    """Woven cloth of ``threads`` per tile; warp threads pass over ``twill`` weft threads (1: plain weave).

    A stripe (count, colour) recolours every other group of ``count`` threads; two stripes make a check.
    """
    u, v = g.uv()
    x, y = u * threads, v * threads
    column, row = g.math("FLOOR", x), g.math("FLOOR", y)
    period = twill + 1
    turn = g.math("WRAP", column + row, float(period), 0.0)
    is_warp = turn > 0.5
    across = g.mix(is_warp, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))  # 1 where the warp is on top
    warp_round = g.math("SINE", g.math("FRACT", x) * 3.14159265)
    weft_round = g.math("SINE", g.math("FRACT", y) * 3.14159265)
    height = g.mix(across, _grey(g, weft_round), _grey(g, warp_round))
    warp_c: Value | Color = warp_color
    weft_c: Value | Color = weft_color
    if warp_stripe:
        group = g.math("FLOOR", column * (1 / warp_stripe[0])) % 2.0 < 0.5
        warp_c = g.mix(group, warp_color, warp_stripe[1])
    if weft_stripe:
        group = g.math("FLOOR", row * (1 / weft_stripe[0])) % 2.0 < 0.5
        weft_c = g.mix(group, weft_color, weft_stripe[1])
    color = g.mix(across, weft_c, warp_c)
    hair = g.noise(threads * 2.5, detail=2, seed=seed, spread=0.3)
    slub = g.noise(5, threads * 0.8, detail=1, seed=seed + 3)
    tone = g.line(height, 0, 1, 0.5, 1.08) * g.line(hair, 0, 1, 1 - fuzz, 1 + fuzz)
    tone *= g.line(slub, 0, 1, 0.9, 1.1)
    return g.finish(g.shade(color, tone), g.line(height, 0, 1, rough + 0.12, rough - 0.06), ior=1.45)


def _grey(g: Graph, value: Value) -> Value:
    node = g.node("ShaderNodeCombineXYZ")
    for target in node.inputs:
        g.feed(target, value)
    return g.out(node)


def pile(
    g: Graph, color: Color, second: Color, *, tufts: float = 60.0, seed: float = 1.0, rows: int = 0
) -> Material:
    """Velvet, felt, wool or carpet pile, or corduroy with ``rows`` ribs per tile."""
    clump = g.noise(6, detail=4, seed=seed)
    tuft = g.noise(tufts, detail=2, seed=seed + 3, spread=0.3)
    tone: Value = g.line(clump, 0, 1, 0.86, 1.12) * g.line(tuft, 0, 1, 0.68, 1.25)
    if rows:
        rib = g.wave(0, rows)
        tone *= g.line(rib, 0, 0.8, 0.45, 1.05)
    rough = g.line(tuft, 0, 1, 0.97, 0.86)
    return g.finish(g.shade(g.mix(tuft * 0.6, color, second), tone), rough, ior=1.4)


def knit(g: Graph, color: Color, *, loops: int = 14, seed: float = 1.0) -> Material:
    """Stocking stitch: columns of V-shaped loops."""
    stitch = g.cells(loops, loops)
    side = abs(stitch.x - 0.5)
    vee = g.math("FRACT", stitch.y + side * 1.1)
    body = g.math("SINE", vee * 3.14159265) * g.math("SINE", g.math("FRACT", stitch.x * 2.0) * 3.14159265)
    hair = g.noise(90, detail=2, seed=seed, spread=0.3)
    tone = g.line(body, 0, 0.8, 0.32, 1.08) * g.line(hair, 0, 1, 0.75, 1.2)
    return g.finish(g.shade(color, tone), g.line(body, 0, 1, 0.98, 0.86), ior=1.4)


def paper(
    g: Graph, color: Color, *, fibre: float = 0.06, rough: float = 0.88, seed: float = 1.0, flute: int = 0
) -> Material:
    """Uncoated paper, or board with ``flute`` visible corrugations per tile."""
    flock = g.noise(14, detail=5, seed=seed)
    strand = g.noise(40, 90, detail=2, seed=seed + 2)
    tone: Value = g.line(flock, 0, 1, 1 - fibre, 1 + fibre) + g.line(strand, 0, 1, -fibre, fibre)
    if flute:
        tone *= g.line(g.wave(0, flute), 0, 1, 0.94, 1.03)
    return g.finish(g.shade(color, tone), g.line(flock, 0, 1, rough + 0.05, rough - 0.05), ior=1.45)


def print_lines(
    g: Graph, ground: Color, ink: Color, *, rows: int = 26, gloss: float = 0.6, seed: float = 1.0
) -> Material:
    """Two columns of printed text with ``rows`` lines of random words; the ink is glossier than the paper."""
    column = g.cells(2, 1)
    margin = g.math("MINIMUM", column.x, 1.0 - column.x) > 0.07
    letters = g.cells(150, rows)
    word = g.cells(24, rows, shift="random", jitter_seed=seed)
    body = (letters.y > 0.28) * (letters.y < 0.80)
    blank = word.x < g.line(g.random(word.number, seed), 0, 1, 0.10, 0.26)
    glyph = g.noise(190, rows * 7, detail=0, seed=seed, spread=0.3) > 0.36
    inked = body * margin * (1.0 - blank) * glyph
    paragraph = g.random(g.math("FLOOR", letters.number * (1 / 150)), seed + 2) > 0.10
    inked *= paragraph
    tone = g.line(g.noise(10, detail=4, seed=seed + 5), 0, 1, 0.95, 1.03)
    return g.finish(
        g.mix(inked, g.shade(ground, tone), ink), g.line(inked, 0, 1, gloss + 0.25, gloss), ior=1.45
    )


def wallpaper(
    g: Graph, ground: Color, figure: Color, *, repeats: int = 4, kind: str = "leaf", gloss: float = 0.55,
    seed: float = 1.0,
) -> Material:  # fmt: skip
    """Printed wallpaper of a ``kind``: ``leaf`` (staggered ovals with a midrib), ``stripe`` or ``dot``."""
    cell = g.cells(repeats, repeats, shift="none" if kind == "stripe" else "half")
    x, y = cell.x - 0.5, cell.y - 0.5
    if kind == "stripe":
        mask = g.line(abs(x), 0.235, 0.25, 1.0, 0.0)
        mask = g.math("MAXIMUM", mask, g.line(abs(abs(x) - 0.33), 0.012, 0.02, 1, 0))
    else:
        stretch = 2.3 if kind == "leaf" else 1.0
        pinch = abs(y) ** 2.0
        radius = g.math("SQRT", (x * stretch) ** 2.0 + pinch)
        mask = g.line(radius, 0.36, 0.39, 1.0, 0.0)
        if kind == "leaf":
            rib = g.math("MINIMUM", abs(x),
                         abs(g.math("FRACT", y * 7.0 + abs(x) * 5.0) - 0.5))  # fmt: skip
            mask *= g.line(rib, 0.008, 0.02, 0.0, 1.0)
        else:
            mask *= g.line(radius, 0.18, 0.21, 0.35, 1.0)
    flock = g.noise(40, detail=3, seed=seed)
    color = g.shade(g.mix(mask, ground, figure), g.line(flock, 0, 1, 0.96, 1.04))
    return g.finish(color, g.line(mask, 0, 1, gloss + 0.28, gloss), ior=1.45)


def cork(g: Graph, color: Color, dark: Color, *, seed: float = 1.0) -> Material:
    """Pressed cork granules."""
    node = g.voronoi(26, seed=seed, warp=g.noise(14, detail=3, seed=seed) * 0.8)
    pick = g.components(node["Color"])
    tone = g.line(pick[0], 0, 1, 0.6, 1.2) * g.line(node["Distance"], 0.2, 0.9, 1.08, 0.75)
    spot = g.fit(pick[1], 0.86, 0.9)
    return g.finish(g.mix(spot, g.shade(color, tone), dark), g.line(tone, 0.5, 1.2, 0.9, 0.72))


def wicker(g: Graph, color: Color, dark: Color, *, strands: int = 8, seed: float = 1.0) -> Material:
    """A basket weave of round strands whose visible pieces are three times as wide as high."""
    cell = g.cells(strands, strands * 3, shift="half")
    bulge = g.math("SINE", cell.x * 3.14159265) * g.math("SINE", cell.y * 3.14159265)
    fibre = g.noise(20, 220, detail=2, seed=seed, spread=0.3)
    tone = g.line(fibre, 0, 1, 0.8, 1.15) * g.line(g.random(cell.number, seed), 0, 1, 0.8, 1.1)
    color_out = g.mix(g.line(bulge, 0.02, 0.45), dark, g.shade(color, tone))
    return g.finish(color_out, g.line(bulge, 0, 0.6, 0.85, 0.5))


def soil(g: Graph, dark: Color, light: Color, *, seed: float = 1.0) -> Material:
    """Potting soil with crumbs and bits of bark."""
    crumb = g.noise(26, detail=6, seed=seed, roughness=0.65)
    bark = g.fit(g.voronoi(34, seed=seed)["Distance"], 0.15, 0.3, 1, 0)
    color = g.mix(bark * 0.5, g.mix(crumb, dark, light), g.shade(light, 1.4))
    return g.finish(color, g.line(crumb, 0, 1, 0.98, 0.88))


def apple_skin(g: Graph) -> Material:
    """Skin of an apple: streaks of red on yellow, with pale dots."""
    streak = g.noise(18, 1.5, detail=3, seed=2.0, spread=0.3)
    blush = g.fit(g.noise(2, detail=2, seed=4.0) * 0.7 + streak * 0.4, 0.25, 0.8)
    dots = g.fit(g.voronoi(30, seed=3.0)["Distance"], 0.06, 0.14, 1.0, 0.0)
    color = g.mix(dots * 0.4, g.mix(blush, srgb("c7a53c"), srgb("8e1f1a")), srgb("dcc48a"))
    return g.finish(color, g.line(streak, 0, 1, 0.26, 0.36), ior=1.42)


def orange_skin(g: Graph) -> Material:
    """Skin of an orange, with pores."""
    pore = g.fit(g.voronoi(34, seed=5.0)["Distance"], 0.05, 0.4)
    return g.finish(
        g.shade(srgb("d9781a"), g.line(pore, 0, 1, 0.7, 1.08)), g.line(pore, 0, 1, 0.55, 0.36), ior=1.45
    )


def banana_skin(g: Graph) -> Material:
    """Banana skin: v is 0 at the stalk and 1 at the blossom end; ridges are at multiples of 1/5 in u."""
    _, v = g.uv()
    along = v + g.noise(5, 4, detail=2, seed=3.0) * 0.03
    ripe = g.ramp(
        along,
        (0.0, srgb("5d4a22")),
        (0.05, srgb("857a35")),
        (0.16, srgb("a8a23a")),
        (0.3, srgb("d8b737")),
        (0.86, srgb("d9b334")),
        (0.95, srgb("93832f")),
        (0.985, srgb("33271a")),
    )
    specks = g.fit(g.voronoi(13, 26, seed=2.0)["Distance"], 0.1, 0.2, 1.0, 0.0)
    bruise = g.fit(g.noise(4, 7, detail=4, seed=9.0), 0.72, 0.95)
    ridge = g.fit(g.wave(5, 0, g.noise(6, 8, seed=5.0), 0.5), 0.965, 1.0)
    marks = specks * g.fit(g.noise(5, 6, seed=6.0), 0.45, 0.8, 0.0, 0.7) + ridge * 0.45
    color = g.mix(g.math("MAXIMUM", marks, bruise * 0.6), ripe, srgb("6a4a1f"))
    return g.finish(color, g.line(g.noise(12, 20, seed=7.0), 0, 1, 0.4, 0.52), ior=1.42)

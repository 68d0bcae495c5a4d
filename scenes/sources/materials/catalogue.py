# SPDX-License-Identifier: GPL-3.0-or-later
"""The library's materials, each with title, classes, building function, its arguments, and tile size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import bpy

from scenes.sources.materials import made, natural
from scenes.sources.materials.graph import Graph, srgb

Build = Callable[[Graph], bpy.types.Material]


@dataclass(frozen=True)
class MaterialSource:
    """The source of a material. ``tile_size_m``: length of a UV unit; ``max_px``: maximum side of a texture."""

    title: str
    classes: tuple[str, ...]
    tile_size_m: float
    max_px: int
    build: Build


MATERIALS: dict[str, MaterialSource] = {}


def _add(
    name: str, title: str, classes: str, family: Callable[..., bpy.types.Material], *arguments: object,
    tile: float = 1.0, px: int = 256, **options: object,
) -> None:  # fmt: skip
    MATERIALS[name] = MaterialSource(
        title, tuple(classes.split()), tile, px, lambda graph: family(graph, *arguments, **options)
    )


c = srgb
# fmt: off

# wood ------------------------------------------------------------------------------------------------------
_add("oak_planks", "Oak floorboards", "wood", natural.wood, c("8a6238"), c("c49a66"), planks=(2, 12), rings=2,
     gloss=0.38, tile=2.0, px=512, seed=3.0)
_add("walnut_planks", "Walnut floorboards", "wood", natural.wood, c("3b2416"), c("7a5334"), planks=(2, 14), rings=2,
     gloss=0.33, tile=2.0, px=512, seed=8.0)
_add("grey_oak_planks", "Limed oak floorboards", "wood", natural.wood, c("8d8375"), c("bdb3a3"), planks=(2, 10), rings=2,
     gloss=0.55, tile=2.0, px=512, seed=13.0)
_add("worn_pine_planks", "Old pine floorboards, varnish worn", "wood", natural.wood, c("8c5a2c"), c("cf9f60"),
     planks=(1, 8), rings=3, gloss=0.36, wear=0.35, tile=1.6, px=512, seed=21.0, gap=0.002)
_add("parquet_mahogany", "Mahogany parquet", "wood", natural.wood, c("4a1c10"), c("8a4a2c"), planks=(6, 18), rings=1,
     gloss=0.26, tile=1.5, px=512, seed=34.0)
_add("oak", "Oak", "wood", natural.wood, c("91693c"), c("c8a06c"), rings=6, gloss=0.44, tile=0.8, px=512, seed=1.0)
_add("walnut_lacquered", "Lacquered walnut with fingerprints", "wood", natural.wood, c("38200f"), c("75492a"), rings=6,
     gloss=0.2, prints=True, tile=0.8, px=512, seed=2.0)
_add("pine", "Pine", "wood", natural.wood, c("bd8a4e"), c("e0bd88"), rings=5, contrast=0.8, gloss=0.5, tile=0.8, seed=4.0)
_add("beech", "Beech", "wood", natural.wood, c("bb8a60"), c("d9b48c"), rings=4, contrast=0.5, gloss=0.45, tile=0.8, seed=5.0)
_add("maple", "Maple", "wood", natural.wood, c("c9a478"), c("e6cba4"), rings=3, contrast=0.4, gloss=0.35, tile=0.8, seed=6.0)
_add("cherry", "Cherry", "wood", natural.wood, c("7d3c1f"), c("b06a3e"), rings=5, contrast=0.7, gloss=0.3, tile=0.8, seed=7.0)
_add("teak_oiled", "Oiled teak", "wood", natural.wood, c("6e4522"), c("a5743f"), rings=7, gloss=0.55, tile=0.8, seed=9.0)
_add("ebony", "Ebony", "wood", natural.wood, c("120c09"), c("2e221b"), rings=8, contrast=0.6, gloss=0.24, tile=0.6, seed=10.0)
_add("driftwood", "Weathered wood", "wood", natural.wood, c("59534b"), c("a79f93"), rings=7, gloss=0.78, tile=0.8, seed=11.0)
# metal -----------------------------------------------------------------------------------------------------
_add("steel_brushed", "Brushed steel", "metal", made.brushed_metal, (0.56, 0.57, 0.58), tile=0.4, px=256)
_add("steel_prints", "Brushed steel with fingerprints", "metal", made.brushed_metal, (0.56, 0.57, 0.58), rough=0.24,
     prints=True, tile=0.4, px=512, seed=5.0)
_add("aluminium_brushed", "Brushed aluminium", "metal", made.brushed_metal, (0.91, 0.92, 0.92), rough=0.38, tile=0.4, seed=7.0)
_add("brass_brushed", "Brushed brass", "metal", made.brushed_metal, (0.89, 0.72, 0.40), rough=0.3, tile=0.4, seed=9.0)
_add("chrome", "Chromium plate", "metal", made.plain, (0.55, 0.556, 0.554), 0.05, metal=1.0)
_add("gold", "Gold", "metal", made.plain, (1.0, 0.766, 0.336), 0.18, metal=1.0)
_add("aluminium_anodised", "Anodised aluminium, black", "metal", made.plain, (0.10, 0.10, 0.11), 0.42, metal=1.0)
_add("steel_worn", "Worn steel", "metal", made.worn_metal, (0.53, 0.52, 0.50), rough=0.3, tile=0.5, seed=3.0)
_add("brass_worn", "Old brass", "metal", made.worn_metal, (0.78, 0.60, 0.32), rough=0.32, grime=c("4a3a20"), amount=0.28,
     tile=0.4, seed=6.0)
_add("copper_patina", "Copper with verdigris", "metal", made.worn_metal, (0.92, 0.60, 0.48), rough=0.28, grime=c("4f8f7a"),
     amount=0.42, tile=0.5, seed=12.0)
_add("iron_rusty", "Rusty iron", "metal", made.worn_metal, (0.42, 0.40, 0.38), rough=0.45, grime=c("7a3d1b"), amount=0.6,
     tile=0.5, seed=15.0)
_add("copper_hammered", "Hammered copper", "metal", made.worn_metal, (0.95, 0.64, 0.54), rough=0.16, dent=0.18, tile=0.3, seed=18.0)
_add("zinc_galvanised", "Galvanised sheet", "metal", made.galvanised, (0.66, 0.67, 0.69), tile=0.4, seed=2.0)
_add("iron_cast", "Cast iron", "metal", made.moulded, (0.035, 0.035, 0.037), rough=0.55, grain=0.25, tile=0.3, ior=2.0, tint=0.25)
# plastic and rubber ------------------------------------------------------------------------------------------
_add("plastic_white", "White plastic", "plastic", made.plain, c("e4e4e0"), 0.3)
_add("plastic_black", "Black plastic, eroded", "plastic", made.moulded, c("1b1b1d"), rough=0.48, grain=0.12, tile=0.12)
_add("plastic_red", "Red plastic, glossy", "plastic", made.plain, c("b3201a"), 0.16)
_add("plastic_yellow", "Yellow plastic", "plastic", made.plain, c("dfa818"), 0.24)
_add("plastic_blue_scratched", "Blue plastic, scratched", "plastic", made.moulded, c("2452a0"), rough=0.26, grain=0.05,
     scratched=0.6, tile=0.4, px=512, seed=4.0)
_add("plastic_grey", "Grey plastic", "plastic", made.moulded, c("8b8d90"), rough=0.42, grain=0.1, tile=0.15, seed=6.0)
_add("plastic_piano_black", "Piano-black plastic with fingerprints", "plastic", made.moulded, c("0b0b0d"), rough=0.1,
     grain=0.02, prints=True, tile=0.5, px=512, seed=8.0)
_add("plastic_green", "Green plastic", "plastic", made.plain, c("3d7d3a"), 0.35)
_add("bakelite", "Marbled bakelite", "plastic", made.moulded, c("4a2313"), rough=0.22, grain=0.06, tint=0.45, cells=24.0,
     tile=0.3, seed=10.0)
_add("rubber_black", "Black rubber", "rubber", made.moulded, c("1d1d1d"), rough=0.74, grain=0.12, tint=0.12, tile=0.25, ior=1.52)
_add("rubber_studs", "Studded rubber flooring", "rubber", made.studs, c("3a3d40"), tile=0.4, px=512)
_add("rubber_red", "Red rubber", "rubber", made.moulded, c("9a2f26"), rough=0.66, grain=0.1, tint=0.06, tile=0.25, seed=3.0)
_add("rubber_grey", "Worn grey rubber", "rubber", made.moulded, c("6b6b69"), rough=0.62, grain=0.12, scratched=0.4, tint=0.14,
     tile=0.4, seed=5.0)
# leather -----------------------------------------------------------------------------------------------------
_add("leather_brown", "Brown leather", "leather", natural.leather, c("5c3420"), tile=0.25, px=512, seed=1.0)
_add("leather_black", "Black leather", "leather", natural.leather, c("1a1817"), gloss=0.36, wear=0.15, tile=0.25, seed=3.0)
_add("leather_tan", "Tan saddle leather", "leather", natural.leather, c("a8693a"), gloss=0.38, wear=0.3, tile=0.25, seed=5.0)
_add("leather_red", "Oxblood leather", "leather", natural.leather, c("55141a"), gloss=0.3, wear=0.35, tile=0.25, seed=7.0)
_add("leather_cream", "Cream leather", "leather", natural.leather, c("cfc1a6"), gloss=0.46, wear=0.08, tile=0.25, seed=9.0)
_add("leather_cracked", "Old cracked leather", "leather", natural.leather, c("4a3022"), gloss=0.5, pebble=18.0, wear=0.45,
     tile=0.25, px=512, seed=11.0)
_add("suede_sand", "Sand suede", "leather", natural.suede, c("a98c68"), tile=0.3)
_add("suede_navy", "Navy suede", "leather", natural.suede, c("26324a"), tile=0.3, seed=4.0)
# fabric ------------------------------------------------------------------------------------------------------
_add("linen_natural", "Natural linen", "fabric", natural.weave, c("b5a78c"), c("c9bca2"), threads=32, tile=0.08)
_add("linen_blue", "Blue linen", "fabric", natural.weave, c("4e6784"), c("6d86a3"), threads=32, tile=0.08, seed=2.0)
_add("canvas_grey", "Grey canvas upholstery", "fabric", natural.weave, c("686a6c"), c("8a8c8d"), threads=20, tile=0.08, seed=3.0)
_add("denim", "Denim", "fabric", natural.weave, c("2d3f5f"), c("8d9bb0"), threads=36, twill=2, tile=0.06, seed=4.0)
_add("tweed", "Tweed", "fabric", natural.weave, c("5a4a36"), c("9a8a6c"), threads=28, twill=3, fuzz=0.45, tile=0.1, seed=5.0)
_add("tartan", "Tartan blanket", "fabric", natural.weave, c("7a1f1f"), c("7a1f1f"), threads=64, twill=1, tile=0.24, px=512,
     warp_stripe=(8, c("1f3a2c")), weft_stripe=(8, c("1f3a2c")), seed=6.0)
_add("ticking_stripe", "Striped ticking", "fabric", natural.weave, c("d8d0bf"), c("e2dccd"), threads=48, tile=0.2, px=512,
     warp_stripe=(6, c("3e5878")), seed=7.0)
_add("gingham", "Gingham", "fabric", natural.weave, c("e6e2d8"), c("e6e2d8"), threads=48, tile=0.12, px=512,
     warp_stripe=(6, c("2f6f5f")), weft_stripe=(6, c("2f6f5f")), seed=8.0)
_add("velvet_green", "Green velvet", "fabric", natural.pile, c("1f4434"), c("3a6a52"), tufts=80.0, tile=0.3)
_add("velvet_rust", "Rust velvet", "fabric", natural.pile, c("8a3d1e"), c("b8663c"), tufts=80.0, tile=0.3, seed=2.0)
_add("felt_grey", "Grey felt", "fabric", natural.pile, c("6d6d70"), c("8b8b8c"), tufts=40.0, tile=0.3, seed=3.0)
_add("wool_carpet_cream", "Cream wool carpet", "fabric", natural.pile, c("b3a58d"), c("d6cab4"), tufts=70.0, tile=0.5, px=512, seed=4.0)
_add("carpet_blue", "Blue carpet", "fabric", natural.pile, c("2f4560"), c("4f6884"), tufts=70.0, tile=0.5, seed=5.0)
_add("corduroy", "Ochre corduroy", "fabric", natural.pile, c("8f6a2a"), c("b08a48"), tufts=60.0, rows=24, tile=0.15, seed=6.0)
_add("knit_cream", "Cream knit", "fabric", natural.knit, c("d6cab2"), tile=0.12)
_add("knit_charcoal", "Charcoal knit", "fabric", natural.knit, c("3d3f42"), tile=0.12, seed=3.0)
_add("cotton_white", "White cotton", "fabric", natural.weave, c("d9d6cf"), c("e4e2dc"), threads=36, fuzz=0.12, tile=0.06, seed=9.0)
# ceramic, glazed -----------------------------------------------------------------------------------------------
_add("terracotta", "Terracotta", "ceramic", natural.rock, c("94502f"), c("c07a50"), rough=0.86, pits=0.1, scale=5.0, tile=0.4)
_add("bisque_white", "Unglazed porcelain", "ceramic", made.moulded, c("ddd6ca"), rough=0.62, grain=0.1, tint=0.04, tile=0.3)
_add("stoneware_grey", "Grey stoneware", "ceramic", made.speckled, c("8d8880"), c("3a342e"), rough=0.5, amount=0.9, tile=0.25, seed=4.0)
_add("clay_dark", "Black clay", "ceramic", natural.rock, c("24211f"), c("3b3633"), rough=0.7, pits=0.0, scale=6.0, tile=0.4, seed=5.0)
_add("porcelain", "Glazed porcelain", "glazed ceramic", made.plain, c("e9e7e1"), 0.08, ior=1.55)
_add("glaze_celadon", "Celadon crackle glaze", "glazed ceramic", made.crackle, c("a9c2ab"), c("5d5a42"), tile=0.25, px=512)
_add("glaze_cobalt", "Cobalt glaze", "glazed ceramic", made.moulded, c("1b3278"), rough=0.1, grain=0.03, tint=0.3, cells=18.0,
     ior=1.55, tile=0.3, seed=3.0)
_add("glaze_speckled", "Speckled oatmeal glaze", "glazed ceramic", made.speckled, c("cfc4ae"), c("5a4028"), tile=0.25, px=512, seed=5.0)
_add("glaze_dipped", "White glaze over bare clay", "glazed ceramic", made.speckled, c("dcd8ce"), c("86705a"), bare=c("a06a48"),
     tile=0.3, px=512, seed=7.0)
_add("glaze_tenmoku", "Tenmoku glaze", "glazed ceramic", made.moulded, c("2a1710"), rough=0.12, grain=0.05, tint=0.5, cells=20.0,
     ior=1.58, tile=0.3, seed=9.0)
_add("tiles_white", "White glazed tiles", "glazed ceramic", made.tiles, c("e2e2dd"), c("9a968c"), grid=(6, 6), tile=0.9, px=512)
_add("tiles_metro_green", "Green metro tiles", "glazed ceramic", made.tiles, c("2f5b4c"), c("b8b2a4"), grid=(4, 8), shift="half",
     vary=0.16, tile=0.8, px=512, seed=3.0)
_add("tiles_mosaic_blue", "Blue mosaic", "glazed ceramic", made.tiles, c("2a5f8a"), c("c9c6bd"), grid=(16, 16), joint=0.007,
     second=c("7fb0c4"), vary=0.15, tile=0.5, px=512, seed=5.0)
_add("tiles_zellige", "Zellige tiles", "glazed ceramic", made.tiles, c("cfc9b4"), c("8d8573"), grid=(8, 8), joint=0.003,
     second=c("b9b092"), vary=0.18, rough=0.08, cloud=0.12, tile=0.8, px=512, seed=7.0)
_add("tiles_checker", "Black and white floor tiles", "glazed stone", made.tiles, c("1d1d1f"), c("6d6a64"), grid=(6, 6), joint=0.004,
     second=c("d8d4ca"), checker=True, rough=0.16, tile=1.8, px=512, seed=9.0)
# stone ---------------------------------------------------------------------------------------------------------
_add("marble_white", "White marble", "stone", natural.marble, c("dedbd5"), c("77767a"), tile=1.2, px=512, seed=1.0)
_add("marble_black", "Black marble", "stone", natural.marble, c("141416"), c("b9b2a4"), gloss=0.1, clouds=0.05, sharp=0.03,
     tile=1.0, px=512, seed=4.0)
_add("marble_green", "Green marble", "stone", natural.marble, c("1e3a2c"), c("9db8a2"), gloss=0.12, clouds=0.2, tile=1.0, seed=9.0)
_add("granite_grey", "Grey granite", "stone", natural.granite, c("2b2a2a"), c("8a8682"), c("cfcac2"), tile=0.5, px=512)
_add("granite_red", "Red granite", "stone", natural.granite, c("2a2221"), c("84493a"), c("b98a78"), tile=0.5, seed=4.0)
_add("terrazzo", "Terrazzo", "stone", natural.terrazzo, c("c9c4b8"), c("5d5a55"), c("a8785a"), c("8d938c"), c("e4dfd2"),
     tile=0.6, px=512, seed=2.0)
_add("slate", "Slate", "stone", natural.rock, c("2b2f33"), c("4c5257"), rough=0.6, pits=0.05, scale=4.0, tile=0.8, seed=6.0)
_add("sandstone", "Sandstone", "stone", natural.rock, c("a5804f"), c("cdb083"), rough=0.88, bands=6, pits=0.1, tile=0.8, seed=8.0)
_add("travertine", "Travertine", "stone", natural.rock, c("b29b78"), c("d9c9ac"), rough=0.42, bands=9, pits=0.45, tile=0.8, seed=10.0)
_add("concrete", "Concrete", "stone", natural.rock, c("77756f"), c("a3a099"), rough=0.8, pits=0.35, scale=3.0, tile=1.2, seed=12.0)
_add("slate_tiles", "Slate floor tiles", "stone", made.tiles, c("3c4246"), c("787268"), grid=(3, 3), joint=0.006, rough=0.5,
     vary=0.22, cloud=0.22, ior=1.5, tile=1.2, px=512, seed=14.0)
_add("brick_red", "Brickwork", "stone", made.brick, c("8a4630"), c("a8644a"), c("b5aea2"), tile=0.9, px=512)
# paper ---------------------------------------------------------------------------------------------------------
_add("paper_white", "White paper", "paper", natural.paper, c("dcdad4"), fibre=0.025, tile=0.3)
_add("paper_kraft", "Kraft paper", "paper", natural.paper, c("a37d52"), fibre=0.1, tile=0.3, seed=3.0)
_add("cardboard", "Corrugated cardboard", "paper", natural.paper, c("a9865c"), fibre=0.08, flute=40, tile=0.3, seed=5.0)
_add("paper_printed", "Printed page", "paper", natural.print_lines, c("d8d3c4"), c("22211f"), tile=0.25, px=512)
_add("paper_newsprint", "Newsprint", "paper", natural.print_lines, c("b9b3a2"), c("33322f"), rows=40, gloss=0.75, tile=0.3, px=512, seed=4.0)
_add("wallpaper_leaf", "Leaf wallpaper", "paper", natural.wallpaper, c("d5cdb8"), c("7d9078"), tile=0.6, px=512)
_add("wallpaper_stripe", "Striped wallpaper", "paper", natural.wallpaper, c("cfc7b4"), c("a2a69c"), kind="stripe", repeats=6,
     tile=0.6, seed=3.0)
_add("wallpaper_dot", "Navy wallpaper with gilt dots", "paper", natural.wallpaper, c("2a3448"), c("b9995c"), kind="dot", repeats=8,
     gloss=0.4, tile=0.6, px=512, seed=5.0)
# painted ---------------------------------------------------------------------------------------------------------
_add("paint_white", "White emulsion", "painted", made.paint, c("dddbd4"), rough=0.78, stipple=0.08, tile=0.5)
_add("paint_sage", "Sage emulsion", "painted", made.paint, c("9aa58c"), rough=0.74, stipple=0.08, tile=0.5, seed=2.0)
_add("paint_terracotta", "Terracotta emulsion", "painted", made.plain, c("b0714f"), 0.8)
_add("paint_blue_grey", "Blue-grey emulsion", "painted", made.plain, c("74858f"), 0.76)
_add("paint_ochre", "Ochre emulsion", "painted", made.plain, c("c9a052"), 0.78)
_add("lacquer_white", "White gloss lacquer with fingerprints", "painted", made.paint, c("dedfdc"), rough=0.16, stipple=0.03,
     prints=True, tile=0.8, px=512, seed=4.0)
_add("lacquer_black", "Black gloss lacquer with fingerprints", "painted", made.paint, c("101012"), rough=0.1, stipple=0.03,
     prints=True, tile=0.8, px=512, seed=6.0)
_add("lacquer_red", "Red lacquer", "painted", made.plain, c("7c1713"), 0.12)
_add("paint_satin_green", "Green satin paint", "painted", made.paint, c("3f5b4c"), rough=0.34, stipple=0.08, tile=0.5, seed=8.0)
_add("paint_chipped_blue", "Chipped blue paint on wood", "painted", made.paint, c("51798c"), rough=0.45, chips=0.42,
     under=c("8a6848"), tile=0.6, px=512, seed=10.0)
_add("enamel_chipped", "Chipped enamel on steel", "painted", made.paint, c("cfc9b6"), rough=0.14, stipple=0.03, chips=0.2,
     under=(0.35, 0.33, 0.31), under_metal=1.0, tile=0.5, seed=12.0)
_add("powder_coat_black", "Black powder coat", "painted", made.moulded, c("1f2022"), rough=0.5, grain=0.2, tile=0.15, seed=2.0)
# plaster ---------------------------------------------------------------------------------------------------------
_add("plaster_white", "White plaster", "plaster", made.plaster, c("d8d4ca"), tile=1.5)
_add("plaster_clay", "Clay plaster", "plaster", made.plaster, c("b08e6a"), trowel=0.14, tile=1.5, seed=3.0)
_add("stucco_grey", "Grey stucco", "plaster", made.plaster, c("a09d97"), trowel=0.16, tile=1.5, seed=5.0)
_add("stucco_venetian", "Venetian stucco", "plaster", made.plaster, c("a55d43"), trowel=0.14, polish=0.8, tile=1.5, px=512, seed=7.0)
# organic ---------------------------------------------------------------------------------------------------------
_add("cork", "Cork", "organic", natural.cork, c("a87a4e"), c("4a3018"), tile=0.3, px=512)
_add("wicker", "Wicker", "organic", natural.wicker, c("ad8350"), c("3c2812"), tile=0.24, px=512)
_add("seagrass", "Seagrass matting", "organic", natural.wicker, c("9a9060"), c("4a4426"), strands=12, tile=0.3, seed=4.0)
_add("soil", "Potting soil", "organic", natural.soil, c("1d140d"), c("3f2d1e"), tile=0.3)
_add("rattan_white", "White painted rattan", "organic", natural.wicker, c("c4bfb2"), c("5d584e"), strands=10, tile=0.3, seed=6.0)
# fmt: on

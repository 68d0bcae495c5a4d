# SPDX-License-Identifier: GPL-3.0-or-later
"""Kinds of surface to which library materials are assigned; unlisted materials are assigned by class."""

from __future__ import annotations

_BOARDS = "furniture tabletop worktop legs joinery frame utensil gadget small"
_FINE_WOOD = "furniture tabletop legs joinery frame gadget utensil small"
_CLOTH = "upholstery curtain cover small"
_POTTERY = "vessel utensil legs small"
_PLASTIC = "gadget utensil vessel legs small"
_TILES = "tiles floor"

SURFACES: dict[str, str] = {
    # wood
    "oak_planks": "floor", "walnut_planks": "floor", "grey_oak_planks": "floor", "worn_pine_planks": "floor",
    "parquet_mahogany": "floor",
    "oak": _BOARDS, "pine": _BOARDS, "beech": _BOARDS, "maple": _BOARDS, "cherry": _FINE_WOOD,
    "teak_oiled": _BOARDS, "walnut_lacquered": _FINE_WOOD, "ebony": "legs frame utensil small",
    "driftwood": "frame small",
    # metal
    "steel_brushed": "appliance worktop sanitary furniture tabletop legs fitting frame shade utensil gadget vessel small",
    "steel_prints": "appliance worktop utensil vessel",
    "aluminium_brushed": "appliance furniture legs fitting frame shade gadget utensil small",
    "brass_brushed": "fitting legs frame shade vessel small", "chrome": "fitting legs frame utensil small",
    "gold": "small", "aluminium_anodised": "fitting legs frame shade radiator gadget small",
    "steel_worn": "utensil small", "brass_worn": "vessel small", "copper_hammered": "utensil vessel small",
    "copper_patina": "small", "iron_cast": "utensil fitting radiator vessel small", "iron_rusty": "small",
    "zinc_galvanised": "furniture vessel utensil small",
    # paint and plaster
    "paint_white": "wall ceiling joinery furniture radiator frame small", "paint_sage": "wall furniture small",
    "paint_blue_grey": "wall furniture small", "paint_ochre": "wall small", "paint_terracotta": "wall small",
    "paint_satin_green": "furniture joinery utensil vessel small", "paint_chipped_blue": "small",
    "lacquer_black": "furniture tabletop legs appliance frame shade gadget utensil vessel small",
    "lacquer_red": "utensil vessel gadget small",
    "lacquer_white": "joinery radiator furniture tabletop legs appliance frame shade gadget utensil vessel tiles small",
    "powder_coat_black": "legs joinery radiator furniture frame shade gadget utensil small",
    "enamel_chipped": "utensil vessel small",
    "plaster_clay": "wall", "plaster_white": "wall ceiling", "stucco_grey": "wall", "stucco_venetian": "wall",
    # stone
    "brick_red": "wall", "concrete": "floor worktop small", "granite_grey": "worktop floor", "granite_red": "worktop",
    "marble_black": "worktop tabletop floor tiles small", "marble_green": "tabletop tiles small",
    "marble_white": "worktop tabletop floor tiles joinery utensil small", "sandstone": "floor small",
    "slate": "worktop tabletop joinery utensil small", "slate_tiles": "floor tiles", "terrazzo": "floor worktop small",
    "travertine": "floor tiles tabletop joinery small",
    # ceramic
    "bisque_white": _POTTERY + " sanitary", "clay_dark": _POTTERY, "stoneware_grey": _POTTERY, "terracotta": _POTTERY,
    "glaze_celadon": _POTTERY, "glaze_cobalt": _POTTERY, "glaze_dipped": _POTTERY, "glaze_speckled": _POTTERY,
    "glaze_tenmoku": _POTTERY, "porcelain": "sanitary vessel utensil small", "tiles_checker": "floor",
    "tiles_metro_green": "tiles", "tiles_mosaic_blue": _TILES, "tiles_white": _TILES, "tiles_zellige": "tiles",
    # textiles and leather
    "canvas_grey": _CLOTH + " gadget", "carpet_blue": "rug floor", "corduroy": "upholstery small", "cotton_white": _CLOTH + " towel shade",
    "denim": "upholstery small", "felt_grey": "upholstery rug cover gadget small", "gingham": "curtain towel small",
    "knit_charcoal": "upholstery small", "knit_cream": "upholstery small", "linen_blue": _CLOTH,
    "linen_natural": _CLOTH + " towel shade", "tartan": "upholstery small", "ticking_stripe": "upholstery curtain towel small",
    "tweed": "upholstery small", "velvet_green": "upholstery curtain small", "velvet_rust": "upholstery curtain small",
    "wool_carpet_cream": "rug floor",
    "leather_cracked": "cover small", "suede_navy": "upholstery small", "suede_sand": "upholstery small",
    # plastic, rubber
    "bakelite": "gadget utensil small", "plastic_black": _PLASTIC, "plastic_blue_scratched": "utensil small",
    "plastic_green": _PLASTIC, "plastic_grey": _PLASTIC, "plastic_piano_black": "gadget small",
    "plastic_red": _PLASTIC, "plastic_white": _PLASTIC, "plastic_yellow": _PLASTIC, "rubber_studs": "floor small",
    # paper and organic materials
    "cardboard": "small", "paper_kraft": "cover small", "paper_newsprint": "small", "paper_printed": "small",
    "paper_white": "shade curtain cover small", "wallpaper_dot": "wall", "wallpaper_leaf": "wall",
    "wallpaper_stripe": "wall", "cork": "furniture small", "rattan_white": "towel small", "seagrass": "rug curtain towel small",
    "wicker": "towel small", "soil": "small",
}  # fmt: skip

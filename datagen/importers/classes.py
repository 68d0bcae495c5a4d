# SPDX-License-Identifier: MIT
"""Guesses of material classes and object categories from names (see docs/importing.md).

The first name with a known word is used; within a name, later words take precedence over earlier ones
(``WoodFloor`` is wood, ``marble_table`` stone, ``FloorTiles`` ceramic).
"""

from __future__ import annotations

import re

from datagen.formats.asset import MaterialClass, SupportKind

_CLASS_WORDS: dict[MaterialClass, str] = {
    "wood": "wood wooden oak pine walnut cherry rosewood veneer parquet plank planks bamboo mahogany "
    "floorboards laminate skirt frame door",
    "metal": "metal metallic steel stainless chrome gold silver brass copper bronze aluminium aluminum iron "
    "alu metall tin nickel zinc hinge handle knob rod mirror",
    "plastic": "plastic acrylic vinyl pvc nylon polymer",
    "rubber": "rubber silicone tyre tire latex",
    "leather": "leather suede hide",
    "fabric": "fabric cloth textile tissue denim upholstery "
    "cotton linen wool velvet felt carpet rug curtain curtains towel sofa "
    "cushion lampshade seat bedding blanket pillow mat doormat foam fringe",
    "ceramic": "ceramic ceramics porcelain tile tiles terracotta clay brick bathtube bathtub sink basin "
    "toilet tea teacup cup saucer vase",
    "stone": "stone marble granite rock slate concrete cement pebble sandstone travertine",
    "paper": "paper cardboard book books label poster painting picture artwork landscape map wallpaper "
    "blinds",
    "glazed": "glazed glaze enamel lacquer lacquered",
    "painted": "paint painted trims trim",
    "plaster": "wall walls ceiling plaster stucco",
    "glass": "glass bulb window pane crystal",
    "organic": "leaf leaves leave grass plant bark moss flower fruit food soil stems skin bone candle "
    "candles wax",
}
_WORD_CLASS = {word: name for name, words in _CLASS_WORDS.items() for word in words.split()}
_FINISHES = {"paint", "painted", "lacquer", "lacquered", "glazed", "wallpaper"}  # hide the material below

_CATEGORY_WORDS = {
    "seat": "sofa couch chair stool armchair bench ottoman seat recliner puff pouf pouffe futon stroller "
    "wheelchair",
    "table": "table desk nightstand commode workbench island",
    "cabinet": "cabinet cupboard wardrobe dresser sideboard vanity locker chest safe",
    "shelf": "shelf bookshelf bookcase rack shelves shelving",
    "bed": "bed crib mattress hammock tatami",
    "sanitary": "toilet toilets washbasin lavatory bidet bath bathtub urinal shower sink jacuzzi",
    "white_goods": "fridge refrigerator freezer oven stove washer dryer washing dishwasher cooker hood "
    "boiler heater radiator furnace fireplace chimney cooktop cooler",
    "instrument": "piano guitar drum violin",
    "vehicle": "car truck bus motorbike bicycle bike scooter tricycle wheelbarrow rowboat mower",
    "railing": "railing fence column",
    "rug": "carpet rug doormat bathmat",
    "appliance": "appliance maker espresso fan mixer toaster blender microwave brewer fryer "
    "squeezer scale grill sandwich",
    "crockery": "cup plate saucer bowl teapot tea mug dish pitcher jug creamer sugar glass",
    "kitchenware": "pan pot kettle cutlery fork knife spoon board pepper salt shaker utensils",
    "bottle": "bottle flask jar flacon",
    "vase": "vase pottery",
    "book": "book books magazine newspaper",
    "lamp": "lamp light lantern chandelier flashlight",
    "candle": "candle candlestick",
    "plant": "plant tree flower flowers cactus bamboo bonsai ficus orchids tulips lily yucca spathiphyllum "
    "bush hedge palm",
    "cushion": "cushion pillow bolster",
    "textile": "curtain blanket towel clothes dress shirt jacket skirt trousers suit",
    "electronics": "tv television radio phone laptop monitor computer keyboard speaker camera stereo printer "
    "tablet projector dvd player telephone electronics headphones amplifier",
    "toy": "toy ball sphere doll puzzle game",
    "box": "box crate basket carton trunk trunck can bin dustbin trashcan barrel",
    "frame": "frame picture painting mirror",
    "clock": "clock watch",
    "statuette": "statue bust sculpture figure deer",
    "fruit": "fruit fruits apple apples banana bananas lemon lemons pear",
    "food": "food bread cake butter steak hamburger",
    "tool": "tool hammer saw drill screwdriver pliers shovel grinder scissors broom",
    "stationery": "pencil pen ruler stapler marker calendar penbox tray",
    "bag": "bag handbag briefcase backpack suitcase",
    "electrical": "plug socket switch dimmer intercom detector",
    "shoe": "shoe shoes sneakers slippers bootie mocassin",
}
_WORD_CATEGORY = {word: name for name, words in _CATEGORY_WORDS.items() for word in words.split()}
_FLOOR_CATEGORIES = {
    "seat", "table", "cabinet", "shelf", "bed", "sanitary", "white_goods", "instrument", "vehicle",
    "railing", "rug", "stairs", "door", "person",
}  # fmt: skip
_TALL_ON_FURNITURE = {
    "lamp", "plant", "vase", "bottle", "statuette", "electronics", "appliance", "frame", "candle", "clock",
}  # fmt: skip

REPLACEABLE: dict[MaterialClass, tuple[MaterialClass, ...]] = {
    "wood": ("wood", "painted"),
    "metal": ("metal", "painted"),
    "plastic": ("plastic", "painted", "rubber"),
    "rubber": ("rubber", "plastic"),
    "leather": ("leather", "fabric"),
    "fabric": ("fabric", "leather"),
    "ceramic": ("ceramic", "glazed", "stone"),
    "stone": ("stone", "ceramic"),
    "paper": ("paper",),
    "glazed": ("glazed", "ceramic"),
    "painted": ("painted", "plaster"),
    "plaster": ("plaster", "painted"),
    "glass": (),
    "organic": (),
    "other": (),
}
"""Classes of materials that may replace a slot's material, by the class of the latter."""


def words_of(name: str) -> list[str]:
    """Return the lower-case words of a name in CamelCase, in snake_case or with other separators."""
    return [w.lower() for w in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def guess_class(*names: str, fallback: MaterialClass = "other") -> MaterialClass:
    """Return the material class implied by the first of ``names`` with a known word.

    Of several known words, the first finish is used, else the last that is not plaster, paper or fabric.
    """
    for name in names:
        words = words_of(name)
        for word in words:
            if word in _FINISHES:
                return _WORD_CLASS[word]
        hits = [_WORD_CLASS[word] for word in words if word in _WORD_CLASS]
        if hits:
            materials = [h for h in hits if h not in ("plaster", "paper", "fabric")]
            return materials[-1] if materials else hits[-1]
    return fallback


def guess_category(*names: str) -> str:
    """Return the object category implied by the first name with a known word; '' if there is none.

    Words after ``with`` are ignored (``chair with cushion`` is a seat); of several known words, the last is
    used (``table lamp``).
    """
    for name in names:
        words = words_of(name)
        if "with" in words[1:]:
            words = words[: words.index("with", 1)]
        hits = [_WORD_CATEGORY[word] for word in words if word in _WORD_CATEGORY]
        if hits:
            return hits[-1]
    return ""


def guess_supports(category: str, height_m: float, width_m: float) -> tuple[SupportKind, ...]:
    """Return the kinds of surface that support an object: the floor for furniture and large objects.

    Small objects stand on furniture; those over 40 cm on the floor and, if usual (a vase), also on tables.
    """
    if category in _FLOOR_CATEGORIES or height_m > 0.6 or width_m > 0.8:
        return ("floor",)
    if max(height_m, width_m) > 0.4:
        return ("floor", "table", "counter") if category in _TALL_ON_FURNITURE else ("floor",)
    return ("table", "shelf", "counter", "sill")

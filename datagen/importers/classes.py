# SPDX-License-Identifier: MIT
"""Guesses of material classes and object categories from names (see docs/importing.md).

The first name with a known word is used; within a name, later words take precedence over earlier ones
(``WoodFloor`` is wood, ``marble_table`` stone, ``FloorTiles`` ceramic).
"""

from __future__ import annotations

import re
from typing import Any

from datagen.formats.asset import MaterialClass, SupportKind
from datagen.foundation.tables import read_table

_TABLES = read_table(__file__, "classes.yaml", dict[str, Any])


def _by_word(table: str) -> dict[str, Any]:
    return {word: name for name, words in _TABLES[table].items() for word in words.split()}


_WORD_CLASS: dict[str, MaterialClass] = _by_word("class_words")
_FINISHES = {"paint", "painted", "lacquer", "lacquered", "glazed", "wallpaper"}  # these cover the material
_WORD_CATEGORY: dict[str, str] = _by_word("category_words")
ROLE_OF_WORD: dict[str, str] = _by_word("map_words")
"""Role of an image in a material, such as ``roughness``, by the last word or two of its name."""
_FLOOR_CATEGORIES = set(_TABLES["floor_categories"].split())
_TALL_ON_FURNITURE = set(_TABLES["tall_on_furniture"].split())

REPLACEABLE: dict[MaterialClass, tuple[MaterialClass, ...]] = {
    name: tuple(others) for name, others in _TABLES["replaceable"].items()
}
"""Classes whose materials may replace a slot's material, by the class of the slot's material."""


def words_of(name: str) -> list[str]:
    """Return the lower-case words of a name in CamelCase, in snake_case or with other separators."""
    return [w.lower() for w in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def guess_class(*names: str, fallback: MaterialClass = "other") -> MaterialClass:
    """Return the material class implied by the first of ``names`` with a known word, else ``fallback``.

    Of several known words, the first coating (paint, lacquer) is used, else the last that is not plaster,
    paper or fabric, else the last.
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

    Other objects over 40 cm stand on the floor and, if usual (a vase), on tables; smaller ones on furniture.
    """
    if category in _FLOOR_CATEGORIES or height_m > 0.6 or width_m > 0.8:
        return ("floor",)
    if max(height_m, width_m) > 0.4:
        return ("floor", "table", "counter") if category in _TALL_ON_FURNITURE else ("floor",)
    return ("table", "shelf", "counter", "sill")

# SPDX-License-Identifier: MIT
"""Determines the kind of surface (wall, worktop, curtain ...) of slots.

The declared ``surface`` of a slot takes precedence. A room's other slots are classified by the words in the
slot's name, in the name of the material that it was baked from and in the names of its parts, then by the
position of its triangles (a low, level slot is a floor), finally by its main class. An object's other slots
are classified by the slot's name and the object's category.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from datagen.assembly.geometry import AssetGeometry
from datagen.formats.asset import EnvironmentAsset, MaterialClass, Surface
from datagen.foundation.tables import read_table

_TABLES = read_table(__file__, "surfaces.yaml", dict[str, Any])
_SURFACE_OF_WORD: dict[str, Surface] = {
    w: surface for surface, words in _TABLES["words"] for w in words.split()
}
_RANK: dict[Surface, int] = {name: rank for rank, (name, _) in reversed(list(enumerate(_TABLES["words"])))}
_OF_CATEGORY: dict[str, Surface] = _TABLES["of_category"]
_OF_CLASS: dict[MaterialClass, Surface] = _TABLES["of_class"]
_MIN_SHELL_SHARE = 0.04  # smallest share of a room's surface area for a floor, ceiling or wall
_LEVEL = 0.7  # |z| of a unit normal above which a triangle counts as horizontal


def surface_of_words(text: str) -> Surface | None:
    """Return the kind of surface that the words of a name imply, or None.

    If words imply several kinds, the first in surfaces.yaml is returned. Words are separated by characters
    other than letters and by changes from lower to upper case.
    """
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text)
    words = [word.lower() for word in re.split(r"[^A-Za-z]+", spaced) if word]
    words.append("".join(words))
    known = [_SURFACE_OF_WORD[word] for word in words if word in _SURFACE_OF_WORD]
    return min(known, key=lambda surface: _RANK[surface], default=None)


def _of_names(names: Iterable[str]) -> Surface | None:
    return next((found for name in names if (found := surface_of_words(name)) is not None), None)


def surfaces_of(geometry: AssetGeometry) -> dict[str, Surface]:
    """Map every slot of an asset to its kind of surface."""
    asset = geometry.asset
    parts: dict[str, list[str]] = {slot: [] for slot in asset.materials}
    for part in asset.parts:
        parts[part.material].append(part.name)
    is_room = isinstance(asset, EnvironmentAsset)
    shell = _shell(geometry) if is_room else {}
    found: dict[str, Surface] = {}
    for slot, material in asset.materials.items():
        own = (slot, *([material.baked_from] if material.baked_from else []))
        if material.surface is not None:
            found[slot] = material.surface
        elif is_room:
            of_class = _OF_CLASS.get(material.classes[0], "small")
            found[slot] = _of_names(own) or _of_names(parts[slot]) or shell.get(slot) or of_class
        else:
            category = getattr(asset, "category", "")
            of_thing = _OF_CATEGORY.get(category) or surface_of_words(category)
            word = surface_of_words(slot)
            found[slot] = (word if word in ("shade", "vessel", "legs") else None) or of_thing or "small"
    return found


def _shell(geometry: AssetGeometry) -> dict[str, Surface]:
    """Find floor, ceiling and walls among a room's large slots, by orientation and height."""
    rays = geometry.rays
    total = float(rays.areas.sum())
    if not total > 0:
        return {}
    slot_of_part = [part.material for part in geometry.asset.parts]
    height = rays.corners[:, :, 2].mean(axis=1)
    order = np.argsort(height)
    along = np.cumsum(rays.areas[order])
    low, high = (float(height[order[np.searchsorted(along, q * total)]]) for q in (0.02, 0.98))
    found: dict[str, Surface] = {}
    for slot in geometry.asset.materials:
        parts = [k for k, name in enumerate(slot_of_part) if name == slot]
        faces = np.flatnonzero(np.isin(geometry.part_of_face, parts))
        area = rays.areas[faces]
        if area.sum() < _MIN_SHELL_SHARE * total:
            continue
        level = np.abs(rays.normals[faces, 2]) > _LEVEL
        share = float(area[level].sum() / area.sum())
        middle = float((height[faces] * area).sum() / area.sum())
        if share > 0.6 and middle < low + 0.25 * (high - low):
            found[slot] = "floor"
        elif share > 0.6 and middle > low + 0.75 * (high - low):
            found[slot] = "ceiling"
        elif share < 0.4:
            found[slot] = "wall"
    return found

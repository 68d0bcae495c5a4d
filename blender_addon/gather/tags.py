# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the custom properties that tag objects, collections and materials; docs/blender.md lists them."""

from __future__ import annotations

import math
import re
from typing import Any

import bpy

from ..problems import ERROR, ProblemList
from .transliteration import transliterated

ROLES = (
    "environment", "object", "support_surface", "light_slot", "opening", "camera_region", "ignore",
)  # fmt: skip
MARKER_ROLES = ("support_surface", "light_slot", "opening", "camera_region")
MATERIAL_CLASSES = (
    "wood", "metal", "plastic", "rubber", "leather", "fabric", "ceramic", "stone", "paper", "glazed",
    "painted", "plaster", "glass", "organic", "other",
)  # fmt: skip
SURFACES = (
    "ceiling", "wall", "tiles", "floor", "rug", "joinery", "radiator", "furniture", "tabletop", "worktop",
    "legs", "upholstery", "curtain", "towel", "shade", "appliance", "sanitary", "fitting", "frame", "cover",
    "vessel", "utensil", "gadget", "small",
)  # fmt: skip
SUPPORT_KINDS = ("floor", "table", "shelf", "seat", "bed", "sill", "counter")
USAGES = ("any", "evaluation_only")


def role_of(block: bpy.types.ID) -> str:
    """The tag ``sm_role`` of an object or collection, or ""."""
    return str(block.get("sm_role", ""))


def words(value: Any) -> tuple[str, ...]:
    """The words of a tag: a string such as ``"wood, metal"``, or a sequence of strings."""
    if value is None:
        return ()
    parts = value.split(",") if isinstance(value, str) else [str(part) for part in value]
    return tuple(part.strip() for part in parts if part.strip())


def numbers(value: Any) -> tuple[float, ...]:
    """The numbers of a tag: an array property, a number, or a string such as ``"0.9, 1.1"``; else ()."""
    if isinstance(value, str):
        value = value.split(",")
    try:
        found = tuple(float(part) for part in (value if hasattr(value, "__len__") else (value,)))
    except (TypeError, ValueError):
        return ()
    return found if all(math.isfinite(number) for number in found) else ()


def positive(block: bpy.types.ID, tag: str, problems: ProblemList, **place: str) -> float | None:
    """The positive number of a tag, or None without the tag; other values are an error."""
    if (value := block.get(tag)) is None:
        return None
    found = numbers(value)
    if len(found) == 1 and found[0] > 0:
        return found[0]
    problems.add(ERROR, f"{tag} = {value!r}", "give a positive number", **place)
    return None


def slug(name: str) -> str:
    """Convert a name to an identifier of a-z, 0-9, ``_``, ``-``, ``.``; other letters are transliterated."""
    text = re.sub(r"[^a-z0-9_.-]+", "_", transliterated(name).lower()).strip("._-")
    return re.sub(r"\.{2,}", ".", text) or "unnamed"


def check_words(
    values: tuple[str, ...], allowed: tuple[str, ...], tag: str, problems: ProblemList, **place: str
) -> tuple[str, ...]:
    """Return the values that are allowed, and add an error for each other value of the tag."""
    for value in values:
        if value not in allowed:
            problems.add(ERROR, f"{tag} = {value!r}", f"use one of {', '.join(allowed)}", **place)
    return tuple(value for value in values if value in allowed)


def material_classes(material: bpy.types.Material, problems: ProblemList) -> tuple[str, ...]:
    """The tag ``sm_class`` of a material: its classes, the main class first; by default ``other``."""
    found = check_words(
        words(material.get("sm_class")), MATERIAL_CLASSES, "sm_class", problems, material=material.name
    )
    return found or ("other",)


def replaceable_by(material: bpy.types.Material, problems: ProblemList) -> tuple[str, ...]:
    """The tag ``sm_replaceable_by`` of a material: classes that may replace it."""
    tag = "sm_replaceable_by"
    return check_words(words(material.get(tag)), MATERIAL_CLASSES, tag, problems, material=material.name)


def tile_size_m(material: bpy.types.Material, problems: ProblemList) -> float | None:
    """The tag ``sm_tile_size_m`` of a material, metres per UV unit, or None."""
    return positive(material, "sm_tile_size_m", problems, material=material.name)


def surfaces(material: bpy.types.Material, tag: str, problems: ProblemList) -> tuple[str, ...]:
    """The tag ``sm_surface`` or ``sm_surfaces`` of a material: kinds of surface that it usually covers."""
    return check_words(words(material.get(tag)), SURFACES, tag, problems, material=material.name)


def provenance(block: bpy.types.ID, fallback: dict[str, str], problems: ProblemList) -> dict[str, str]:
    """Licence, author, source and usage from tags or ``fallback``; a missing licence is an error."""
    result = {}
    for key in ("license", "author", "source", "usage"):
        value = str(block.get(f"sm_{key}", "") or fallback.get(key, ""))
        if value:
            result[key] = value
    if "license" not in result:
        remedy = "set sm_license (an SPDX identifier such as CC0-1.0) or the export's licence"
        problems.add(ERROR, f"{block.name!r} has no licence", remedy)
    if result.get("usage", "any") not in USAGES:
        problems.add(ERROR, f"sm_usage = {result['usage']!r}", f"use one of {', '.join(USAGES)}")
    return result

# SPDX-License-Identifier: GPL-3.0-or-later
"""The library's materials and the slots of objects and rooms, read from YAML tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import yaml

from scenes.sources.materials import art, made, natural
from scenes.sources.materials.graph import Color, Graph, srgb

Build = Callable[[Graph], bpy.types.Material]
SOURCES = Path(__file__).parents[1]


@dataclass(frozen=True)
class MaterialSource:
    """The source of a material. ``surfaces``: kinds of surface on which it is common, empty if only its class
    matters; ``tile_size_m``: length of a UV unit; ``max_px``: maximum side of a baked texture.
    """

    title: str
    classes: tuple[str, ...]
    surfaces: tuple[str, ...]
    tile_size_m: float
    max_px: int
    build: Build


@dataclass(frozen=True)
class Slot:
    """Default material of a slot, its classes, and the classes that may replace it.

    ``source`` names a library material. Without it, the function ``graph`` builds the material with a
    :class:`Graph`, for a unique UV layout. With neither, the material is constant: ``color`` (linear
    Rec.709), ``roughness`` (R), ``metallic``, ``ior``.
    """

    classes: tuple[str, ...]
    replaceable_by: tuple[str, ...]
    source: str = ""
    color: Color = (0.5, 0.5, 0.5)
    roughness: float = 0.5
    metallic: float = 0.0
    ior: float = 1.5
    graph: Build | None = None


def table(name: str) -> dict[str, Any]:
    """Read the YAML file ``name``; convert sRGB codes ``"#rrggbb"`` to linear colours, lists to tuples."""
    return _converted(yaml.safe_load((SOURCES / name).read_text(encoding="utf-8")))


def _converted(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _converted(item) for key, item in value.items()}
    if isinstance(value, list):
        return tuple(map(_converted, value))
    return srgb(value[1:]) if isinstance(value, str) and value.startswith("#") else value


def _builder(build: tuple[Any, ...], options: dict[str, Any]) -> Build:
    name, *arguments = build
    family = next(getattr(module, name) for module in (made, natural, art, Graph) if hasattr(module, name))
    return lambda graph: family(graph, *arguments, **options)


def _source(
    title: str, classes: str, build: tuple[Any, ...], surfaces: str = "", tile_size_m: float = 1.0,
    max_px: int = 256, **options: Any,
) -> MaterialSource:  # fmt: skip
    kinds = tuple(classes.split()), tuple(surfaces.split())
    return MaterialSource(title, *kinds, tile_size_m, max_px, _builder(build, options))


def _slot(
    classes: str, replaceable_by: str = "", build: tuple[Any, ...] | None = None, **options: Any
) -> Slot:
    fields = options if build is None else {"graph": _builder(build, options)}
    return Slot(tuple(classes.split()), tuple(replaceable_by.split()), **fields)


def slots_of(rows: dict[str, dict[str, Any]]) -> dict[str, Slot]:
    """Make the slots of an object or room by name, from the rows of its table."""
    return {name: _slot(**row) for name, row in rows.items()}


MATERIALS = {name: _source(**row) for name, row in table("materials/catalogue.yaml").items()}

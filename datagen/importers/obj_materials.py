# SPDX-License-Identifier: MIT
"""Reader of material libraries of Wavefront OBJ files (.mtl)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from datagen.foundation.errors import input_error

_COLORS = {"kd": "diffuse", "ks": "specular", "ke": "emission"}


@dataclass
class PhongMaterial:
    """A material of an MTL file; ``maps``: arguments of its map statements by lower-case keyword."""

    diffuse: tuple[float, float, float] = (0.8, 0.8, 0.8)
    specular: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    exponent: float = 0.0
    opacity: float = 1.0
    illumination: int = 2
    maps: dict[str, str] = field(default_factory=dict)


def read_mtl(data: bytes, where: str | Path) -> dict[str, PhongMaterial]:
    """Parse an MTL file to materials by name. Raises :class:`InputError` for invalid numbers."""
    found: dict[str, PhongMaterial] = {}
    current = PhongMaterial()
    for raw in data.decode("utf-8", "replace").splitlines():
        keyword, _, rest = raw.strip().replace("\t", " ").partition(" ")
        keyword, rest = keyword.lower(), rest.strip()
        try:
            if keyword == "newmtl":
                current = found.setdefault(rest, PhongMaterial())
            elif keyword in _COLORS:
                setattr(current, _COLORS[keyword], _rgb(rest))
            elif keyword == "ns":
                current.exponent = _finite(rest)
            elif keyword == "d":
                current.opacity = _finite(rest.split()[-1])
            elif keyword == "tr":
                current.opacity = 1 - _finite(rest)
            elif keyword == "illum":
                current.illumination = int(rest.split()[0])
            elif keyword.startswith(("map_", "bump", "refl", "disp", "norm")):
                current.maps[keyword] = rest
        except (ValueError, IndexError):
            raise input_error(where, keyword, repr(rest), "numbers", "correct the MTL file") from None
    return found


def _finite(text: str) -> float:
    value = float(text.split()[0])
    if not np.isfinite(value):
        raise ValueError(text)
    return value


def _rgb(text: str) -> tuple[float, float, float]:
    numbers = [_finite(word) for word in text.split()[:3]]
    red, green, blue = numbers if len(numbers) == 3 else numbers * 3
    return red, green, blue

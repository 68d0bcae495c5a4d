# SPDX-License-Identifier: MIT
"""Checks of material parameters when a material is created: range, NaN, and whether textures need UVs.

A NaN would spread through sums over paths and the denoiser to whole tiles of an image; it is rejected here,
where file and texel can be named.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mitsuba as mi
import numpy as np

from datagen.foundation.errors import Problem, Problems, raise_problems

TOLERANCE = 1e-4
"""Maximum distance outside [0, 1] at which a value is attributed to rounding or resampling and clamped."""
UV_TEXTURES = ("BitmapTexture", "Checkerboard")
"""Prefixes of the class names of textures that depend on UVs."""


class _Collector(mi.TraversalCallback):
    """Traversal callback that collects, by name, the values and child objects of ``parent``."""

    def __init__(self, parent: Any) -> None:
        super().__init__()
        self.parent = parent
        self.values: dict[str, Any] = {}
        self.objects: dict[str, Any] = {}

    def put(self, name: str, value: Any, flags: int, cpp_type: Any = None) -> None:
        """Collect a value or child object; called by ``traverse``."""
        if isinstance(value, mi.Object):
            self.objects[name] = value
        else:  # C++ objects expose addresses of their fields
            self.values[name] = mi.get_property(value, cpp_type, self.parent) if cpp_type else value


def exposed(obj: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a Mitsuba object's children and values by name, as exposed to ``mi.traverse``; not recursive."""
    collector = _Collector(obj)
    obj.traverse(collector)
    return collector.objects, collector.values


def needs_uv(obj: Any) -> bool:
    """Return whether a BSDF or texture, or anything nested in it, uses UVs."""
    if obj.class_name().startswith(UV_TEXTURES):
        return True
    return any(needs_uv(child) for child in exposed(obj)[0].values())


def _file_of(texture: Any) -> str:
    """Return the suffix " in FILE" for a texture that was read from a file, else ""."""
    found = re.search(r'^  name = "(.+)",$', str(texture), re.MULTILINE)
    return f" in {found.group(1)}" if found else ""


def parameter_problems(material: str, name: str, texture: Any) -> list[Problem]:
    """List faults of a material's parameter ``name``: values of ``texture`` that are NaN or not in [0, 1]."""
    problems = Problems(material)
    file = _file_of(texture)
    objects, values = exposed(texture)
    for key, value in values.items():
        if key not in ("value", "data", "color0", "color1"):
            continue
        stored = np.asarray(value)
        if stored.dtype == np.uint8:
            continue  # 8-bit texels stay encoded in memory: they are never NaN and always within [0, 1]
        data = stored.astype(np.float32)
        field = name if key == "value" else f"{name}.{key}"
        is_bad = ~np.isfinite(data)
        if is_bad.any():
            num_bad = np.count_nonzero(is_bad)
            got = f"{num_bad} of {data.size} values NaN or Inf{file} (first at {_first(is_bad)})"
            problems.add(field, got, "finite values in [0, 1]", "repair the texture")
            continue
        low, high = float(data.min(initial=0.0)), float(data.max(initial=0.0))
        if low < -TOLERANCE or high > 1.0 + TOLERANCE:
            got = f"{low:g} ... {high:g}{file}" if data.size > 1 else f"{(low if low < 0 else high):g}"
            problems.add(field, got, "values in [0, 1]", "rescale the parameter or its texture")
    for key, child in objects.items():
        problems += parameter_problems(material, f"{name}.{key}", child)
    return problems


# Problems collected within gathering_problems(), else None. No lock, although Mitsuba creates plugins on
# several threads, since extending a list is atomic.
_gathered: list[Problem] | None = None


def check_parameter(material: str, name: str, texture: Any) -> None:
    """Check a material parameter's texture with :func:`parameter_problems`.

    Raises :class:`InputError` with all faults, immediately or at the end of an enclosing
    :func:`gathering_problems`.
    """
    problems = parameter_problems(material, name, texture)
    if _gathered is None:
        raise_problems(problems)
    else:
        _gathered.extend(problems)


@contextmanager
def gathering_problems() -> Iterator[None]:
    """Context manager that raises the faults of all parameters checked in it as one :class:`InputError`."""
    global _gathered
    problems: list[Problem] = []
    _gathered = problems
    try:
        yield
    finally:
        _gathered = None
    raise_problems(sorted(problems, key=str))  # threads finish in any order


def _first(mask: np.ndarray) -> str:
    return str(tuple(int(i) for i in np.argwhere(mask)[0])) if mask.ndim > 1 else "0"

# SPDX-License-Identifier: MIT
"""Resource limits for untrusted files: all readers of an import charge one budget.

A small file can expand to a large amount of data: references that fan out, a mesh placed a million times,
compressed zeros. Limits apply to the expanded data; the limits of triangles, pairs, pixels and bytes grow
with the files, so that large files are not refused for being large. The defaults keep the cost of a small
file below 10 s and 1 GB. Users who trust a file can raise a limit:

    SCENE_MATERIALS_LIMITS=instances=50000,triangles=8000000 datagen import forest.gltf --library my-library
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

from datagen.foundation.errors import InputError, Problem, input_error, raise_problems

LIMITS_VARIABLE = "SCENE_MATERIALS_LIMITS"
"""Environment variable with limits, ``NAME=NUMBER`` separated by commas."""
LimitName = Literal[
    "nodes", "depth", "references", "instances", "triangles", "pairs", "pixels", "bytes", "values",
    "frames",
]  # fmt: skip
_MAX_DEPTH = 2000  # each level takes up to four stack frames of the interpreter, whose stack is limited
_CALLS_PER_LEVEL = 4
_USUAL_CALLS = 1000
_PER_BYTE: dict[LimitName, float] = {"triangles": 1 / 8, "pairs": 20.0, "pixels": 8.0, "bytes": 20.0}
"""Increase of a limit per byte of the input files: no format stores more triangles per byte, and images and
archives rarely store more pixels or bytes."""
_NOUNS: dict[LimitName, str] = {
    "nodes": "elements or nodes, counted once per reference",
    "depth": "nested levels of elements, nodes or references",
    "references": "references followed",
    "instances": "meshes placed",
    "triangles": "triangles placed",
    "pairs": "pairs of triangles at a vertex, or of corners of a polygon",
    "pixels": "pixels decoded",
    "bytes": "bytes unpacked or substituted",
    "values": "values in a document",
    "frames": "cameras or photographs",
}


@dataclass(frozen=True)
class Limits:
    """Upper limits of the amounts used by one import. Raises :class:`InputError` for invalid limits.

    A mesh is charged as many triangles as it has faces or, if that is more, as a third of its vertices.
    """

    nodes: int = 200_000
    depth: int = 128
    references: int = 20_000
    instances: int = 3_000
    triangles: int = 750_000
    pairs: int = 50_000_000
    pixels: int = 32_000_000
    bytes: int = 32 << 20
    values: int = 2_000_000
    frames: int = 10_000

    def __post_init__(self) -> None:
        problems = [
            Problem(LIMITS_VARIABLE, item.name, str(getattr(self, item.name)), expected, "correct it")
            for item in fields(self)
            for expected in [f"at most {_MAX_DEPTH}" if item.name == "depth" else "a number above 0"]
            if getattr(self, item.name) < 1 or (item.name == "depth" and self.depth > _MAX_DEPTH)
        ]
        raise_problems(problems)

    @classmethod
    def from_environment(cls) -> Limits:
        """Return the limits of ``LIMITS_VARIABLE``, else defaults. Raises :class:`InputError` if invalid."""
        changes: dict[str, int] = {}
        names = [item.name for item in fields(cls)]
        for entry in filter(None, os.environ.get(LIMITS_VARIABLE, "").split(",")):
            name, _, value = (part.strip() for part in entry.partition("="))
            if name not in names or not value.isascii() or not value.isdigit():
                expected = f"NAME=NUMBER with one of {', '.join(names)}"
                raise input_error(LIMITS_VARIABLE, "", repr(entry[:80]), expected, "correct the variable")
            changes[name] = int(value)
        return replace(cls(), **changes)


class Budget:
    """Amounts used by the import of the file ``where``, and their limits.

    Readers add the size of their input by :meth:`hold`, and charge output by :meth:`spend` before allocation.
    """

    def __init__(self, where: str | Path, limits: Limits | None = None):
        self.where = where
        self.limits = Limits.from_environment() if limits is None else limits
        self._spent: dict[LimitName, int] = {}
        self._held = 0
        self._files: set[Path] = set()
        if self.limits.depth > Limits.depth:  # readers of nested data are recursive
            calls = _USUAL_CALLS + _CALLS_PER_LEVEL * self.limits.depth
            sys.setrecursionlimit(max(sys.getrecursionlimit(), calls))

    def hold(self, num_bytes: int) -> None:
        """Add ``num_bytes`` of input, which raises the limits that depend on the input's size."""
        self._held += num_bytes

    def hold_file(self, path: Path) -> None:
        """Add the size of an existing file as input; repeated calls count the file once."""
        real = path.resolve()
        if real not in self._files:
            self._files.add(real)
            self.hold(real.stat().st_size)

    def read_file(self, path: Path, expected: str = "a readable file") -> bytes:
        """Read a file and add its size as input. Raises :class:`InputError` if it cannot be read."""
        try:
            self.hold_file(path)
            return path.read_bytes()
        except OSError as error:
            raise input_error(path, got=error.strerror or error, expected=expected) from None

    def allowed(self, what: LimitName) -> int:
        """Return the limit of ``what``, including its allowance for the size of the input."""
        return int(getattr(self.limits, what) + _PER_BYTE.get(what, 0.0) * self._held)

    def spend(self, what: LimitName, amount: int = 1, at: str = "") -> None:
        """Charge ``amount`` of ``what``, at position ``at``. Raises :class:`InputError` beyond the limit."""
        total = self._spent.get(what, 0) + amount
        self._spent[what] = total
        if total > self.allowed(what):
            raise self.exceeded(what, total, at)

    def check_depth(self, depth: int, at: str = "") -> None:
        """Raise :class:`InputError` if ``depth`` levels, at position ``at``, exceed the nesting limit."""
        if depth > self.limits.depth:
            raise self.exceeded("depth", depth, at)

    def exceeded(self, what: LimitName, amount: int, at: str = "") -> InputError:
        """Return the error for exceeding a limit; ``amount`` is a lower bound of the actual amount."""
        base, limit = getattr(self.limits, what), self.allowed(what)
        # half as much again, since counting stopped at the limit and the file may need more
        needed = amount + amount // 2 - (limit - base)
        share = f" ({base} plus an allowance for the size of the files)" if limit > base else ""
        remedy = f"if you trust the file, raise the limit: {LIMITS_VARIABLE}={what}={needed}"
        if what == "depth" and amount > _MAX_DEPTH:
            remedy = (
                f"the limit can be raised by {LIMITS_VARIABLE}=depth={_MAX_DEPTH} at most: correct the file"
            )
        field = f"{at}: {what}" if at else what
        expected = f"at most {limit} {_NOUNS[what]}{share}"
        return input_error(self.where, field, f"{amount} or more", expected, remedy)

# SPDX-License-Identifier: MIT
"""The exception for bad input, whose message states position, value found, value expected and remedy."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Error numbers of a full disk or an exhausted quota."""
_MAX_CHARACTERS, _MAX_LISTED = 500, 100  # a small file can have a million faults of any length


@dataclass(frozen=True)
class Problem:
    """One fault in one input.

    ``where`` is a file or an argument, ``field`` the position inside it (``materials[3].roughness``), ``got``
    the value found, ``expected`` the valid values, ``remedy`` the next step.
    """

    where: str | Path
    field: str = ""
    got: str = ""
    expected: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        texts = [text for text in (self.field, self.got) if text]
        found = " = ".join(t if len(t) <= _MAX_CHARACTERS else f"{t[:_MAX_CHARACTERS]} ..." for t in texts)
        expected = self.expected and f"expected {self.expected}"
        return "; ".join([f"{self.where}: {found}", *filter(None, (expected, self.remedy))])


def _reworded_if_empty(problem: Problem) -> Problem:
    """Return ``problem``, reworded if its file is empty, which parsers report as a syntax error."""
    if isinstance(problem, str):  # torch rebuilds a worker's error from its text
        return problem
    with suppress(OSError, ValueError):
        where = problem.where
        if isinstance(where, Path) and not problem.field and where.is_file() and where.stat().st_size == 0:
            remedy = problem.remedy or "copy or export it again"
            return replace(problem, got="an empty file", remedy=remedy)
    return problem


class InputError(ValueError):
    """Exception for bad input that lists every problem, so that a user can fix all at once."""

    def __init__(self, *problems: Problem):
        if not problems:
            raise TypeError("InputError needs at least one Problem")
        # equal problems are listed once
        problems = tuple(dict.fromkeys(map(_reworded_if_empty, problems)))
        self.problems = problems
        lines = [str(problem) for problem in problems[:_MAX_LISTED]]
        if len(problems) > _MAX_LISTED:
            lines.append(f"... and {len(problems) - _MAX_LISTED} more problems")
        super().__init__("\n".join(lines))


def input_error(
    where: str | Path, field: str = "", got: object = "", expected: str = "", remedy: str = ""
) -> InputError:
    """Return an :class:`InputError` with a single :class:`Problem` of these fields."""
    return InputError(Problem(where, field, str(got), expected, remedy))


class Problems(list[Problem]):
    """List of the problems of one source, ``where``, which are raised together."""

    def __init__(self, where: str | Path):
        super().__init__()
        self.where = where

    def add(self, field: str = "", got: object = "", expected: str = "", remedy: str = "") -> None:
        self.append(Problem(self.where, field, str(got), expected, remedy))


def raise_problems(problems: Sequence[Problem]) -> None:
    """Raise an :class:`InputError` with all ``problems`` unless there are none."""
    if problems:
        raise InputError(*problems)

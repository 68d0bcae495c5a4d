# SPDX-License-Identifier: MIT
"""The one error that bad input raises: what, where, got, expected, remedy."""

from __future__ import annotations

import errno
from dataclasses import dataclass, replace
from pathlib import Path

DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Error numbers of a full disk or an exhausted quota."""
_MAX_CHARACTERS, _MAX_LISTED = 500, 100  # a small file can hold a million faults of any length


def _shortened(text: str) -> str:
    return text if len(text) <= _MAX_CHARACTERS else f"{text[:_MAX_CHARACTERS]} ..."


@dataclass(frozen=True)
class Problem:
    """One fault in one input.

    ``where`` is a file or an argument, ``field`` the place inside it (``materials[3].roughness``),
    ``got`` what stands there, ``expected`` what would have been right, ``remedy`` what to do next.
    """

    where: str | Path
    field: str = ""
    got: str = ""
    expected: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        text = f"{self.where}: "
        field, got = _shortened(self.field), _shortened(self.got)
        if field and got:
            text += f"{field} = {got}"
        else:
            text += field or got
        if self.expected:
            text += f"; expected {self.expected}"
        if self.remedy:
            text += f"; {self.remedy}"
        return text


def _said_of_empty(problem: Problem) -> Problem:
    """Parsers report an empty file as a syntax error; this message says that it is empty."""
    if isinstance(problem, str):  # torch passes an error of a loader's process on as its text
        return problem
    try:
        is_empty = (
            isinstance(problem.where, Path)
            and not problem.field
            and problem.where.is_file()
            and problem.where.stat().st_size == 0
        )
    except (OSError, ValueError):
        return problem
    remedy = problem.remedy or "copy or export it again"
    return replace(problem, got="an empty file", remedy=remedy) if is_empty else problem


class InputError(ValueError):
    """Bad input. Carries every problem that was found, so that a user mends all of them in one go."""

    def __init__(self, *problems: Problem):
        if not problems:
            raise TypeError("InputError needs at least one Problem")
        problems = tuple(dict.fromkeys(map(_said_of_empty, problems)))  # what many share is said once
        self.problems = problems
        lines = [str(problem) for problem in problems[:_MAX_LISTED]]
        if len(problems) > _MAX_LISTED:
            lines.append(f"... and {len(problems) - _MAX_LISTED} more problems")
        super().__init__("\n".join(lines))


def input_error(
    where: str | Path, field: str = "", got: object = "", expected: str = "", remedy: str = ""
) -> InputError:
    """Shorthand for an :class:`InputError` with a single problem."""
    return InputError(Problem(where, field, str(got), expected, remedy))


def raise_problems(problems: list[Problem]) -> None:
    """Raise an :class:`InputError` with all problems, each once."""
    if problems:
        raise InputError(*problems)

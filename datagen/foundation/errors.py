# SPDX-License-Identifier: MIT
"""The one error that bad input raises: what, where, got, expected, remedy."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from pathlib import Path

DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
"""What the system says where there is no room, or no more for this user."""
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


class InputError(ValueError):
    """Bad input. Carries every problem that was found, so that a user mends all of them in one go."""

    def __init__(self, *problems: Problem):
        if not problems:
            raise TypeError("InputError needs at least one Problem")
        problems = tuple(dict.fromkeys(problems))  # what many things have in common is said once
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

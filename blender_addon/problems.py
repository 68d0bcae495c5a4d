# SPDX-License-Identifier: GPL-3.0-or-later
"""Problems of an export (errors, approximations, notes), each with its location and a remedy."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

ERROR, APPROXIMATION, NOTE = "error", "approximation", "note"


@dataclass(frozen=True)
class Problem:
    """One entry of the problem list.

    ``severity``: ``error`` stops the export; ``approximation`` is exported differently from Blender's
    rendering; ``note`` changes nothing. ``message`` states the finding and, for an approximation, the size of
    the error; ``remedy`` is an instruction that avoids the problem.
    """

    severity: str
    message: str
    remedy: str = ""
    object: str = ""
    material: str = ""
    node: str = ""

    @property
    def place(self) -> str:
        """Location as text: ``object 'Cup', material 'Glaze', node 'Glass BSDF'``."""
        parts = [("object", self.object), ("material", self.material), ("node", self.node)]
        return ", ".join(f"{label} {name!r}" for label, name in parts if name)

    def __str__(self) -> str:
        text = f"{self.severity}: {self.place + ': ' if self.place else ''}{self.message}"
        return f"{text}; {self.remedy}" if self.remedy else text


class ProblemList:
    """List of distinct problems, in the order in which they were added."""

    def __init__(self) -> None:
        self._entries: dict[Problem, None] = {}

    def add(self, severity: str, message: str, remedy: str = "", **place: str) -> None:
        """Append one problem; ``place`` may name ``object``, ``material`` and ``node``."""
        self._entries.setdefault(Problem(severity, message, remedy, **place))

    def extend(self, problems: Iterable[Problem]) -> None:
        """Append several problems, without duplicates."""
        for problem in problems:
            self._entries.setdefault(problem)

    def __iter__(self) -> Iterator[Problem]:
        return iter(self._entries)

    def refuse_errors(self) -> None:
        """Raise :class:`ExportRefused` if a problem stops the export."""
        if self.errors:
            raise ExportRefused(self)

    @property
    def errors(self) -> list[Problem]:
        """Problems that stop an export."""
        return [problem for problem in self._entries if problem.severity == ERROR]


class ExportRefused(Exception):
    """Raised if errors stop an export; ``problems`` lists all problems."""

    def __init__(self, problems: Iterable[Problem]):
        self.problems = list(problems)
        errors = [problem for problem in self.problems if problem.severity == ERROR]
        super().__init__("\n".join(str(problem) for problem in errors) or "nothing to export")

# SPDX-License-Identifier: MIT
"""Remarks collected while foreign files are read."""

from __future__ import annotations


class Findings:
    """Collects approximations and notes during an import; each sentence once, in order."""

    def __init__(self) -> None:
        self._approximations: dict[str, None] = {}
        self._notes: dict[str, None] = {}

    def approximate(self, sentence: str) -> str:
        """Add a sentence about content that is converted only roughly, and return it."""
        self._approximations[sentence] = None
        return sentence

    def note(self, sentence: str) -> None:
        """Add a sentence about a decision of the importer."""
        self._notes[sentence] = None

    @property
    def approximations(self) -> tuple[str, ...]:
        return tuple(self._approximations)

    @property
    def notes(self) -> tuple[str, ...]:
        return tuple(self._notes)

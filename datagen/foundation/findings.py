# SPDX-License-Identifier: MIT
"""Remarks on files of other programs, collected by their importers."""

from __future__ import annotations


class Findings:
    """Approximations and notes of an import: distinct sentences, in order of addition."""

    def __init__(self) -> None:
        self._approximations: dict[str, None] = {}
        self._notes: dict[str, None] = {}

    def approximate(self, sentence: str) -> str:
        """Add a sentence about content that is approximated or left out, and return it."""
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

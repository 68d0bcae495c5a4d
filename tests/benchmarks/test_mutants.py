# SPDX-License-Identifier: MIT
"""Mutants of a small module: each is one change, with a key that is independent of changes elsewhere."""

from __future__ import annotations

import ast
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from benchmarks.mutation import warm
from benchmarks.mutation.__main__ import Copy
from benchmarks.mutation.mutants import Mutant, find_mutants

SOURCE = textwrap.dedent(
    '''
    """Words: 3 < 4."""
    from typing import TYPE_CHECKING

    if TYPE_CHECKING:
        import numpy as np

    LIMIT, GUARD = 2.0, 1e-9

    def grow(values: list[int], factor: int = 3) -> float:
        """Doc 1."""
        total = 0
        for value in values:
            if value < LIMIT and not value == 7:
                continue
            total += value * factor
        if total > 9:
            raise ValueError(f"ä {total + 1}: more than 9")
        return max(total, 1) + values.sum(axis=0)
    '''
)


def changes(source: str = SOURCE) -> dict[tuple[str, str, str], Mutant]:
    return {(found.function, found.text, found.new): found for found in find_mutants("m.py", source)}


def test_each_mutant_is_one_change_that_compiles() -> None:
    found = changes()
    for mutant in found.values():
        mutated = mutant.apply(SOURCE)
        ast.parse(mutated)
        assert mutated != SOURCE and mutated.count("\n") == SOURCE.count("\n")
        assert SOURCE[mutant.start : mutant.end] == mutant.text
    assert len({mutant.key for mutant in found.values()}) == len(found)


def test_operators_constants_statements_and_axes_are_mutated() -> None:
    found = changes()
    for function, text, new in (
        ("", "2.0", "4.0"),
        ("", "1e-9", "0.0"),
        ("", "3", "4"),  # a default belongs to the defining scope
        ("grow", "<", ">="),
        ("grow", "<", "<="),
        ("grow", "and", "or"),
        ("grow", "not value == 7", "(value == 7)"),
        ("grow", "==", "!="),
        ("grow", "continue", "break"),
        ("grow", "*", "/"),
        ("grow", "total += value * factor", "pass"),
        ("grow", "max", "min"),
        ("grow", "sum", "mean"),
        ("grow", "0", "-1"),  # the axis
        ("grow", "9", "10"),
    ):
        assert (function, text, new) in found, (text, new)
    removed = found["grow", SOURCE[SOURCE.index("raise") : SOURCE.index("    return")].rstrip(), "pass"]
    assert removed.kind == "removal" and removed.first_line == removed.last_line


def test_text_types_and_imports_are_not_mutated() -> None:
    lines = SOURCE.splitlines()
    for mutant in changes().values():
        line = lines[mutant.first_line - 1]
        assert "Words" not in line and "Doc" not in line and "import" not in line and "TYPE" not in line
        assert mutant.text not in ("1", "more than 9") or "return" in line
        assert "list[int]" not in mutant.text


def test_a_mutant_is_recognised_after_changes_elsewhere() -> None:
    before = {mutant.key: mutant.first_line for mutant in find_mutants("folder/m.py", SOURCE)}
    moved = SOURCE.replace("LIMIT, GUARD", "OTHER = 5\n\n\nLIMIT, GUARD")
    after = {mutant.key: mutant.first_line for mutant in find_mutants("other/m.py", moved)}
    assert set(before) < set(after)
    assert all(after[key] - before[key] in (0, 3) for key in before)
    assert not set(before) & {m.key for m in find_mutants("m.py", "LIMIT = 3.0\n")}


@pytest.mark.parametrize(
    ("code", "timeout_s", "ended"),
    [
        ("raise SystemExit(3)", 30.0, 3),
        ("while True: pass", 0.2, -9),
        ("import time; time.sleep(99)", 0.2, -9),
    ],
)
def test_endless_tests_are_stopped(code: str, timeout_s: float, ended: int) -> None:
    """The limit applies to the processor time of computing tests and to the wall time of sleeping ones."""
    process = subprocess.Popen([sys.executable, "-S", "-c", code], start_new_session=True)
    assert warm.outcome_of(process.pid, timeout_s) == ended
    process.returncode = ended  # outcome_of has waited for it


def test_a_folder_that_is_no_copy_is_not_removed(tmp_path: Path) -> None:
    kept = tmp_path / "project" / "thesis.txt"
    kept.parent.mkdir()
    kept.write_text("mine")
    with pytest.raises(SystemExit, match="--work"):
        Copy(tmp_path)
    assert kept.read_text() == "mine"

# SPDX-License-Identifier: MIT
"""Sets of modules to mutate, each with the fewest test files that cover it, from targets.yaml."""

from __future__ import annotations

from dataclasses import dataclass

from datagen.foundation.tables import read_table


@dataclass(frozen=True)
class Target:
    """Modules to mutate, test files that should detect the mutants, and the number of mutants to try."""

    modules: tuple[str, ...]
    tests: tuple[str, ...]
    number: int = 25


TARGETS = read_table(__file__, "targets.yaml", dict[str, Target])

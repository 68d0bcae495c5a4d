# SPDX-License-Identifier: MIT
"""Modules to mutate, each with the smallest set of test files that covers it, from targets.yaml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import yaml
from pydantic import TypeAdapter


@dataclass(frozen=True)
class Target:
    """Modules to mutate, test files that should detect the mutants, and the number of mutants to try."""

    modules: tuple[str, ...]
    tests: tuple[str, ...]
    number: int = 25


TARGETS = TypeAdapter(dict[str, Target]).validate_python(
    yaml.safe_load(Path(__file__).with_name("targets.yaml").read_text("utf-8"))
)

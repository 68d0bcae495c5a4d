# SPDX-License-Identifier: MIT
"""Kinds of faults found by verification, and the report that collects faults."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Severity = Literal["error", "warning"]

CHECKS = {
    "index": "the index exists, is complete, and lists the files on disk",
    "hash": "shards and images have the recorded hashes",
    "member": "every view has a readable image and record; other members do not exist",
    "buffer": "every buffer exists and has the camera's size",
    "finite": "no NaN, no Inf",
    "range": "albedos, roughness, radiance and depth are in range",
    "normal": "normals are unit vectors on surfaces",
    "firefly": "no isolated pixels far brighter than their neighbours",
    "exposure": "no black, flat or overexposed frames",
    "roughness": "roughness varies where its material has a texture",
    "statistics": "min <= median <= max, and counts are possible",
    "reprojection": "depth and cameras of different views agree",
    "split": "splits share no assets, if the recipe sets splits.disjoint",
    "recheck": "recorded errors and brightness agree with plain paths (--recheck)",
}
"""Assertion of each check, in the order of the report."""


@dataclass(frozen=True)
class Fault:
    """A fault: failed check (a key of :data:`CHECKS`), file or view, value found and value expected."""

    check: str
    where: str
    got: str
    expected: str
    severity: Severity = "error"

    def __str__(self) -> str:
        return f"{self.severity}: {self.check}: {self.where}: {self.got}; expected {self.expected}"


@dataclass
class Report:
    """Scope and findings of a verification; ``notes`` are sentences about skipped checks, with reasons."""

    path: str
    num_shards: int = 0
    num_views: int = 0
    faults: list[Fault] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    applied: Counter[str] = field(default_factory=Counter)
    """Number of shards or views to which each check was applied."""
    rechecked: list[dict[str, Any]] = field(default_factory=list)
    """Results by view of :mod:`datagen.inspection.recheck`."""

    @property
    def num_errors(self) -> int:
        return sum(fault.severity == "error" for fault in self.faults)

    def counts(self) -> list[tuple[str, str, int, int, int]]:
        """Each check with its assertion and numbers of applications, errors and warnings, in order."""
        found = Counter((fault.check, fault.severity) for fault in self.faults)
        return [
            (check, asserts, self.applied[check], found[check, "error"], found[check, "warning"])
            for check, asserts in CHECKS.items()
        ]

    def exit_code(self, strict: bool = False) -> int:
        """The exit code: 1 if there are errors (or, with ``strict``, warnings), else 0."""
        return int(bool(self.faults) if strict else self.num_errors > 0)

    def to_json(self) -> str:
        """The whole report as JSON."""
        data = {
            "path": self.path,
            "num_shards": self.num_shards,
            "num_views": self.num_views,
            "num_errors": self.num_errors,
            "num_warnings": len(self.faults) - self.num_errors,
            "applied": {check: self.applied[check] for check in CHECKS},
            "faults": [asdict(fault) for fault in self.faults],
            "notes": self.notes,
            "rechecked": self.rechecked,
        }
        return json.dumps(data, indent=2)

    def merge(self, other: Report) -> None:
        """Add the contents of another report."""
        self.num_shards += other.num_shards
        self.num_views += other.num_views
        self.faults += other.faults
        self.notes += [note for note in other.notes if note not in self.notes]
        self.applied.update(other.applied)
        self.rechecked += other.rechecked

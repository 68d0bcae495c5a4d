# SPDX-License-Identifier: MIT
"""Kinds of faults found by verification, and the report that collects them."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Severity = Literal["error", "warning"]

CHECKS = {
    "index": "the index is there, complete, and lists what is on disk",
    "hash": "shards and images have the hashes that vouch for them",
    "member": "every view has its image and record, readable, nothing else",
    "buffer": "every buffer is there, in the camera's size",
    "finite": "no NaN, no Inf",
    "range": "albedos, roughness, radiance and depth are in range",
    "normal": "normals are unit vectors on surfaces",
    "firefly": "no isolated pixels far brighter than what is around them",
    "exposure": "no black, flat or burnt frames",
    "roughness": "roughness varies where its material has a texture",
    "statistics": "min <= median <= max, and counts fit the pixels",
    "reprojection": "depth and cameras of different views agree",
    "split": "no asset of the test split appears in training, if asked for",
    "recheck": "recorded errors and brightness hold against plain paths, if asked for",
}
"""Checks with their assertions, in the order of the report."""


@dataclass(frozen=True)
class Fault:
    """One fault: ``check`` is a key of :data:`CHECKS`, ``where`` a file or view."""

    check: str
    where: str
    got: str
    expected: str
    severity: Severity = "error"

    def __str__(self) -> str:
        return f"{self.severity}: {self.check}: {self.where}: {self.got}; expected {self.expected}"


@dataclass
class Report:
    """Scope and findings of a verification. ``notes`` name skipped checks with the reasons."""

    path: str
    num_shards: int = 0
    num_views: int = 0
    faults: list[Fault] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    applied: Counter[str] = field(default_factory=Counter)
    """Check to the number of shards or views to which it was applied."""
    rechecked: list[dict[str, Any]] = field(default_factory=list)
    """Figures of the views that were rendered again (:mod:`datagen.inspection.recheck`)."""

    @property
    def num_errors(self) -> int:
        return sum(fault.severity == "error" for fault in self.faults)

    def exit_code(self, strict: bool = False) -> int:
        """The exit code: 0 if sound, 1 with errors (or warnings, if ``strict``)."""
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

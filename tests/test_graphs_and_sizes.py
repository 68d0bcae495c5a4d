# SPDX-License-Identifier: MIT
"""Every reader returns an object or raises InputError for random graphs and sizes, within 10 s and 1 GB.

The slow tests (``-m slow``) read 5,000 inputs per reader; ``HOSTILE_EXAMPLES`` sets the number of the others.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.datagen.hostile_graphs import CASES as IMPORTERS
from tests.hostile import EXAMPLES, attack
from tests.oversized import MAX_BYTES

READERS = [("tests.datagen.hostile_graphs", name) for name in IMPORTERS] + [
    ("tests.model.hostile_graphs", name)
    for name in (
        "transforms",
        "openmvg",
        "colmap",
        "colmap_binary",
        "bundler",
        "metashape",
        "realitycapture",
        "mitsuba_sensors",
        "mesh_gltf",
        "mesh_file",
    )
]


@pytest.mark.parametrize(("module", "name"), READERS)
def test_graphs_and_sizes_are_read_or_refused(module: str, name: str, tmp_path: Path) -> None:
    attack(module, name, tmp_path / "case", EXAMPLES, MAX_BYTES)


@pytest.mark.slow
@pytest.mark.parametrize(("module", "name"), READERS)
def test_five_thousand_graphs_and_sizes_are_read_or_refused(module: str, name: str, tmp_path: Path) -> None:
    attack(module, name, tmp_path / "case", 5000, MAX_BYTES)

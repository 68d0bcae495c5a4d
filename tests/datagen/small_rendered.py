# SPDX-License-Identifier: MIT
"""A small dataset that is really rendered, made once a test run: two rooms seen by five cameras each."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen.farm.collect import collect
from datagen.farm.local import LocalOptions, run_local
from tests.datagen.small_plan import plan_small

_MADE: list[Path] = []


def rendered_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset's folder; tests must not change it."""
    if _MADE:
        return _MADE[0]
    root = tmp_path_factory.mktemp("rendered")
    folder = plan_small(root / "dataset", root / "library", num_units=2, num_views=5)
    summary = run_local(folder.root, LocalOptions(workers=1))
    assert len(summary.done) == 2 and not summary.set_aside
    collect(folder.root)
    _MADE.append(folder.root)
    return folder.root

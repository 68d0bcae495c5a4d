# SPDX-License-Identifier: MIT
"""A small rendered dataset, made once per test run: two rooms with five cameras each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.farm.collect import collect
from datagen.farm.local import LocalOptions, run_local
from datagen.formats.shard import Dataset
from datagen.foundation.exr import encode_view
from tests.datagen.small_plan import plan_small
from tests.once import once


def rendered_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the dataset, which tests must not change."""
    return once("rendered-dataset", lambda: _rendered(tmp_path_factory.mktemp("rendered")))


def _rendered(root: Path) -> Path:
    folder = plan_small(root / "dataset", root / "library", num_units=2, num_views=5)
    summary = run_local(folder.root, LocalOptions(workers=1))
    assert len(summary.done) == 2 and not summary.failures
    collect(folder.root)
    return folder.root


def predict(dataset: Path, out: Path, seed: int) -> Path:
    """Write noisy ground truth, as predictions, to ``out/<configuration>/<view>.exr``; return ``out``."""
    rng = np.random.default_rng(seed)
    for view in Dataset(dataset).views():
        maps = {}
        for name in ("diffuse_albedo", "specular_albedo", "roughness"):
            truth = view.buffers[name].astype(np.float32)
            noise = rng.normal(0, 0.05 * (1 + seed), truth.shape).astype(np.float32)
            maps[name] = np.clip(truth + noise, 0, 1)
        folder = out / view.record.configuration
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{view.record.name}.exr").write_bytes(encode_view(maps))
    return out

# SPDX-License-Identifier: MIT
"""The command ``datagen`` as a person uses it: from a recipe to verified shards, and what it prints."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.formats.shard import Dataset
from tests.conftest import REPOSITORY
from tests.datagen.small_library import write_small_library

RECIPE = """
format: scene-materials/recipe
version: 1
name: small
seed: 3
configurations: 2
views: 3
resolution: [96, 64]
objects: {count: [2, 3]}
cameras: {min_content: 2}
render: {path_samples: 4, auxiliary_samples: 8}
"""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("command")
    write_small_library(root / "library")
    (root / "small.yaml").write_text(RECIPE)
    return root


def _datagen(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "datagen", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY)


def test_from_a_recipe_to_verified_shards(inputs: Path) -> None:
    out = inputs / "out"
    run = ("run", inputs / "small.yaml", "--library", inputs / "library", "--out", out, "--workers", 2)
    first = _datagen(*run)
    assert first.returncode == 0, first.stderr
    assert "2 shards, 6 views" in first.stdout
    index = json.loads((out / "index.json").read_text())
    assert index["is_complete"] and index["num_views"] == 6 and index["splits"] == {"train": 2}
    assert all(asset["license"] == "CC0-1.0" for asset in index["assets"].values())
    assert len(list((out / "sheets").glob("*.png"))) == 2
    views = list(Dataset(out).views("train"))
    assert len(views) == 6 and all(view.buffers["beauty"].shape == (64, 96, 3) for view in views)
    verified = _datagen("verify", out)
    assert verified.returncode == 0, verified.stdout
    status = _datagen("farm", "status", out)
    assert "2 done" in status.stdout
    again = _datagen(*run)
    assert again.returncode == 0 and "(0 new)" in again.stdout


def test_estimate_predicts_before_anything_large_starts(inputs: Path) -> None:
    recipe = inputs / "split.yaml"
    recipe.write_text(RECIPE + "splits: {train: 0.5, validation: 0.5, test: 0.0}\n")
    result = _datagen("estimate", recipe, "--library", inputs / "library", "--json")
    assert result.returncode == 0, result.stderr
    estimate = json.loads(result.stdout)
    assert estimate["num_views"] == 6
    actual = json.loads((inputs / "out" / "index.json").read_text())["num_bytes"]
    assert 0.5 * actual < estimate["total_bytes"] < 2 * actual
    assert 200 < estimate["peak_memory_mb"] < 4000
    assert estimate["total_seconds"] > 0


def test_dry_run_prints_the_resolved_recipe_and_writes_nothing(inputs: Path, tmp_path: Path) -> None:
    result = _datagen("run", inputs / "small.yaml", "--out", tmp_path / "x", "--views", 5, "--dry-run")
    assert result.returncode == 0 and "views: 5" in result.stdout and "max_depth: 8" in result.stdout
    assert not (tmp_path / "x").exists()


def test_doctor_says_what_will_be_used() -> None:
    result = _datagen("doctor")
    assert result.returncode == 0, result.stdout
    assert "rendering" in result.stdout and "works" in result.stdout

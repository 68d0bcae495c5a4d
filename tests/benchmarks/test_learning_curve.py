# SPDX-License-Identifier: MIT
"""The learning-curve benchmark at minimal size, and the recipes of additional training data."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import bench_learning, bench_learning_curve
from datagen.assembly.splits import pools_of_split
from datagen.formats.base import read_yaml
from datagen.formats.configuration import Split
from datagen.formats.recipe import Recipe
from datagen.formats.shard import Dataset
from datagen.foundation.bundled import bundled_library
from datagen.library import Library
from model.checkpoint import CheckpointCard, save_checkpoint
from model.networks import MaterialNetwork, NetworkConfig
from tests.conftest import REPOSITORY
from tests.model.training_data import make_dataset


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("curve")
    good: dict[str, tuple[Split, int]] = {"a": ("train", 2), "b": ("train", 2), "c": ("validation", 2)}
    cheap: dict[str, tuple[Split, int]] = {
        "z": ("test", 1),
        "a": ("train", 2),
        "b": ("train", 2),
        "d": ("train", 2),
    }  # "z" shifts the seeds, so that "a" and "b" differ from those above
    return make_dataset(root / "good", good), make_dataset(root / "cheap", cheap)


def test_points_of_two_datasets(
    datasets: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = [*map(str, datasets), "--out", str(tmp_path), "--counts", "1", "2", "--steps", "2"]
    monkeypatch.setattr(sys, "argv", ["bench", *arguments, "--preset", "smoke", "--threads", "1"])
    bench_learning_curve.main()
    report = json.loads((tmp_path / "results.json").read_text())
    points = {"good 1", "good 2", "cheap 1", "cheap 2"}
    assert set(report["results"]) == {bench_learning_curve.CONSTANT, *points}
    errors = [report["results"][point]["diffuse_albedo_mse"] for point in sorted(points)]
    assert len(set(errors)) == 4 and all(0 < error < 1 for error in errors)
    assert (tmp_path / "curve.png").stat().st_size > 1000
    times = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("final.safetensors")}
    assert len(times) == 4
    bench_learning_curve.main()  # finished trainings are not repeated
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("final.safetensors")} == times
    assert json.loads((tmp_path / "results.json").read_text())["results"] == report["results"]


def test_a_dataset_without_validation_views_uses_those_of_another(
    datasets: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good, cheap = datasets
    arguments = [str(cheap), "--judge", str(good), "--out", str(tmp_path), "--counts", "1", "--steps", "1"]
    monkeypatch.setattr(sys, "argv", ["bench", *arguments, "--preset", "smoke", "--threads", "1"])
    bench_learning_curve.main()
    report = json.loads((tmp_path / "results.json").read_text())
    assert set(report["results"]) == {bench_learning_curve.CONSTANT, "cheap 1"}
    monkeypatch.setattr(sys, "argv", ["bench", str(cheap), *arguments])
    with pytest.raises(SystemExit):  # the same name twice is refused
        bench_learning_curve.main()
    validation = Dataset(tmp_path / "cheap-1" / "data").index.splits["validation"]
    assert validation == Dataset(good).index.splits["validation"]

    checkpoint = tmp_path / "cheap-1" / "run" / "final.safetensors"
    compare = [str(cheap), str(good), "--out", str(tmp_path / "compare"), "--compare", str(checkpoint)]
    monkeypatch.setattr(sys, "argv", ["bench", *compare, "--preset", "smoke", "--judge", str(good)])
    bench_learning.main()
    rows = json.loads((tmp_path / "compare" / "results.json").read_text())["results"]
    assert rows["final"]["diffuse_albedo_mse"] == pytest.approx(
        report["results"]["cheap 1"]["diffuse_albedo_mse"], rel=1e-4
    )
    monkeypatch.setattr(sys, "argv", ["bench", *compare, "--preset", "smoke", "--judge", str(cheap)])
    with pytest.raises(SystemExit, match="no validation views"):
        bench_learning.main()


def test_checkpoints_with_and_without_light_are_compared(
    datasets: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lit = make_dataset(tmp_path / "lit", {"a": ("train", 2), "c": ("validation", 2)}, has_light=True)
    paths = []
    for name, config in (
        ("dark", NetworkConfig(base_channels=2, global_channels=4)),
        (
            "lit",
            NetworkConfig(base_channels=2, global_channels=4, light_inputs=("known_share", "reflectance")),
        ),
    ):
        paths.append(tmp_path / f"{name}.safetensors")
        card = CheckpointCard(network=config, loss="none", phase="joint", step=0)
        save_checkpoint(paths[-1], card, MaterialNetwork(config))
    arguments = [str(lit), "--out", str(tmp_path / "out"), "--compare", *map(str, paths), "--preset", "smoke"]
    monkeypatch.setattr(sys, "argv", ["bench", *arguments])
    bench_learning.main()
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["results"]
    assert {"dark", "lit"} < set(rows)
    with Image.open(tmp_path / "out" / "lit.jpg") as picture:
        shown = np.asarray(picture, np.float64).reshape(4, 48, 2, 3, 64, 3)
    best, worst = shown[1:, :, :, 2].mean(axis=(0, 1, 3, 4))  # the column of errors of each view
    assert best < worst
    errors = []
    for view in Dataset(lit).views(
        split="validation", names=["reflectance", "diffuse_albedo", "surface_mask"]
    ):
        b = view.buffers
        error = np.clip(b["reflectance"], 0, 1).astype(float) - b["diffuse_albedo"]
        errors.append(error[b["surface_mask"][..., 0] > 0.5] ** 2)
    found = rows["recorded reflectance as diffuse albedo"]["diffuse_albedo_mse"]
    assert found == pytest.approx(np.concatenate(errors).mean(), rel=0.02)


def test_a_part_has_the_requested_shards(datasets: tuple[Path, Path], tmp_path: Path) -> None:
    good, cheap = datasets
    part = bench_learning_curve.part_of(cheap, 2, good, tmp_path / "part")
    index = Dataset(part).index
    assert index.splits == {"train": 2, "validation": 1}
    mine = {s.sha256 for s in index.shards if s.split == "train"}
    assert mine < {s.sha256 for s in Dataset(cheap).index.shards}
    judged = [s.sha256 for s in index.shards if s.split == "validation"]
    assert judged == [s.sha256 for s in Dataset(good).index.shards if s.split == "validation"]
    assert index.num_views == sum(s.num_views for s in index.shards) == 6
    with pytest.raises(SystemExit, match="expected at least 9"):
        bench_learning_curve.part_of(cheap, 9, good, tmp_path / "more")


def test_added_training_data_excludes_validation_assets() -> None:
    """`checkpoint.yaml` and `pale.yaml` exclude the rooms, objects and materials of `learning.yaml`'s
    validation split; `pale_validation.yaml` uses no others."""
    recipes = {
        name: read_yaml(Recipe, REPOSITORY / "scenes" / "recipes" / f"{name}.yaml")
        for name in ("learning", "checkpoint", "pale", "pale_validation")
    }
    with Library([bundled_library()]) as library:
        pools = {name: pools_of_split(recipes[name], library, "train") for name in ("checkpoint", "pale")}
        pools |= {
            name: pools_of_split(recipes[name], library, "validation")
            for name in ("learning", "pale_validation")
        }
    for kind in ("environments", "objects", "materials"):
        ids = {name: {p.id for p in getattr(pool, kind)} for name, pool in pools.items()}
        assert all(ids.values()), kind
        assert not ids["learning"] & (ids["checkpoint"] | ids["pale"]), kind
        assert ids["pale_validation"] <= ids["learning"], kind
    assert recipes["checkpoint"].splits.train == recipes["pale"].splits.train == 1.0
    assert recipes["pale_validation"].splits.train == 0.0

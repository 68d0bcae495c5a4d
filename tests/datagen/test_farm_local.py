# SPDX-License-Identifier: MIT
"""The local engine neither loses nor repeats finished work, and kills or restarts do not change the bytes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
import yaml

from datagen.farm.collect import collect
from datagen.farm.folder import DatasetFolder
from datagen.farm.local import LocalOptions, run_local
from datagen.farm.status import array_spec, forget_failures, read_status
from datagen.farm.worker import EXIT_INTERRUPTED
from datagen.formats.base import read_json
from datagen.formats.recipe import Recipe
from datagen.formats.shard import Dataset, DatasetIndex
from datagen.foundation.errors import InputError
from tests.datagen.small_plan import plan_small


@pytest.fixture(scope="module")
def library_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("farm") / "library"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, library_root: Path) -> DatasetFolder:
    """A dataset made by one worker without interruption."""
    folder = plan_small(tmp_path_factory.mktemp("one") / "dataset", library_root)
    summary = run_local(folder.root, LocalOptions(workers=1))
    assert len(summary.done) == 3 and not summary.failures
    collect(folder.root)
    return folder


def _hashes(folder: DatasetFolder) -> dict[str, str]:
    return {shard.configuration: shard.sha256 for shard in collect(folder.root, deep=True).shards}


def _start(folder: DatasetFolder, stage: str) -> subprocess.Popen:
    code = "from datagen.cli import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", code, "run", str(folder.root), "--only", stage],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_dataset_is_readable(finished: DatasetFolder) -> None:
    views = list(Dataset(finished.root).views(names=["beauty", "roughness", "color_median"]))
    assert len(views) == 9
    assert all(view.buffers["beauty"].shape == (48, 64, 3) for view in views)
    assert not (finished.root / "work" / "small-00000").exists()
    assert list((finished.root / "work").iterdir()) == []


def test_the_index_has_names_of_library_folders(tmp_path: Path, library_root: Path) -> None:
    folder = plan_small(tmp_path / "dataset", library_root)
    changes = {"library": (str(library_root),), "objects": {"library_weights": {str(library_root): 2}}}
    recipe = Recipe.model_validate({**folder.read_recipe().model_dump(), **changes})
    folder.recipe_path.write_text(yaml.safe_dump(recipe.model_dump(mode="json")))
    collect(folder.root)
    found = read_json(DatasetIndex, folder.index_path).recipe
    assert found.library == ("library",) and found.objects.library_weights == {"library": 2}


def test_three_workers_make_the_same_bytes(
    finished: DatasetFolder, tmp_path: Path, library_root: Path
) -> None:
    other = plan_small(tmp_path / "a path with spaces and ä", library_root)
    run_local(other.root, LocalOptions(workers=3))
    assert _hashes(other) == _hashes(finished)


def test_a_rerun_does_nothing(finished: DatasetFolder) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.shards_path.iterdir()}
    summary = run_local(finished.root, LocalOptions(workers=2))
    assert summary.already_done == 3 and not summary.done
    assert {path: path.stat().st_mtime_ns for path in finished.shards_path.iterdir()} == before


def test_a_killed_worker_loses_its_unit_only_and_no_finished_views(
    finished: DatasetFolder, tmp_path: Path, library_root: Path
) -> None:
    folder = plan_small(tmp_path / "killed", library_root)
    kills = []
    kept: dict[Path, int] = {}

    def kill_once_a_unit(event: tuple) -> None:
        kind, unit, stage, done, _ = event
        if kind == "progress" and stage == "render" and done == 2 and unit not in kills:
            kills.append(unit)
            kept.update({p: p.stat().st_mtime_ns for p in folder.root.glob(f"work/{unit}-*/rendered/*.exr")})
            for child in psutil.Process().children():
                with suppress(psutil.Error):  # a child of another test may be ending
                    if "spawn_main" in " ".join(child.cmdline()):
                        child.kill()
        if kind == "progress" and stage == "stats" and done == 0:
            for path, modified in kept.items():
                if unit in str(path):
                    assert path.stat().st_mtime_ns == modified, "a finished view was rendered again"

    summary = run_local(folder.root, LocalOptions(workers=1), kill_once_a_unit)
    assert len(kills) == 3 and len(kept) >= 6 and sorted(summary.done) == sorted(kills)
    assert _hashes(folder) == _hashes(finished)


def test_interrupt_and_continue_by_the_same_command(
    finished: DatasetFolder, tmp_path: Path, library_root: Path
) -> None:
    folder = plan_small(tmp_path / "interrupted", library_root)
    process = _start(folder, "render")
    while not list(folder.root.glob("work/*/rendered/*.json")):
        assert process.poll() is None, process.communicate()
        os.sched_yield()
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == EXIT_INTERRUPTED, error
    assert "the same command continues" in error
    assert not list(folder.root.glob("**/*.partial"))
    for stage in ("render", "stats", "pack"):
        assert _start(folder, stage).wait(timeout=120) == 0
    assert _hashes(folder) == _hashes(finished)


def test_parallel_runs_make_no_duplicates(
    finished: DatasetFolder, tmp_path: Path, library_root: Path
) -> None:
    folder = plan_small(tmp_path / "twice", library_root)
    both = [
        subprocess.Popen(
            [
                sys.executable,
                "-m",
                "datagen",
                "run",
                str(folder.root),
                "--unit",
                str(index),
                "--attempts",
                "0",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for index in (0, 0, 1)
    ]
    for process in both:
        _, error = process.communicate(timeout=120)
        assert process.returncode == 0, error
    run_local(folder.root, LocalOptions(workers=1))
    assert len(list(folder.shards_path.glob("*.tar"))) == 3
    assert _hashes(folder) == _hashes(finished)


def test_failing_unit_is_recorded_with_log_and_command(tmp_path: Path, library_root: Path) -> None:
    folder = plan_small(tmp_path / "failing", library_root, num_units=2)
    path = folder.configuration_path("small-00001")
    data = json.loads(path.read_text())
    data["assets"] = {"room-0": "f" * 64}
    path.write_text(json.dumps(data))
    summary = run_local(folder.root, LocalOptions(workers=1, attempts=2))
    assert summary.done == ["small-00000"] and [f.id for f in summary.failures] == ["small-00001"]
    failure = folder.read_failure("small-00001")
    assert failure.attempts == 2 and "not what was planned" in failure.reason
    assert failure.command.endswith("failing --unit 1 --attempts 0")
    assert "not what was planned" in (folder.root / failure.log).read_text()
    status = read_status(folder.root)
    assert (status.done, len(status.failed), status.array_spec) == (1, 1, "1")
    assert collect(folder.root).missing == ("small-00001",)
    assert forget_failures(folder.root) == ["small-00001"]
    assert read_status(folder.root).waiting == 1


def test_damage_is_found_and_repaired(finished: DatasetFolder, tmp_path: Path) -> None:
    root = tmp_path / "damaged"
    shutil.copytree(finished.root, root)
    folder = DatasetFolder(root)
    want = _hashes(finished)
    shards = sorted(folder.shards_path.glob("*.tar"))
    flipped = bytearray(shards[0].read_bytes())
    flipped[len(flipped) // 2] ^= 1
    shards[0].write_bytes(flipped)
    with pytest.raises(InputError, match=shards[0].name):
        collect(root, deep=True)
    shards[0].unlink()
    shards[1].write_bytes(shards[1].read_bytes()[:1000])
    folder.manifest_path(folder.read_plan().units[2]).write_text("{")
    assert read_status(root).done <= 2
    summary = run_local(root, LocalOptions(workers=1))
    assert len(summary.done) == 3
    assert _hashes(folder) == want


def test_another_recipe_is_refused_in_the_same_folder(finished: DatasetFolder, library_root: Path) -> None:
    with pytest.raises(InputError, match="recipe: configurations = 2"):
        plan_small(finished.root, library_root, num_units=2)
    assert len(_hashes(finished)) == 3


@pytest.mark.parametrize(
    ("indices", "text"), [([], ""), ([5], "5"), ([0, 1, 2, 3], "0-3"), ([9, 0, 1, 7], "0-1,7,9")]
)
def test_array_spec(indices: list[int], text: str) -> None:
    assert array_spec(indices) == text

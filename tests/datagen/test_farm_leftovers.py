# SPDX-License-Identifier: MIT
"""Leftovers of killed or duplicate attempts and of full disks, and no other files, are found and removed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

import datagen.farm.work_unit as work_unit
from datagen.farm.collect import collect, find_leftovers
from datagen.farm.commands import farm
from datagen.farm.folder import DatasetFolder
from datagen.farm.job_options import SlurmOptions
from datagen.farm.local import LocalOptions, run_local
from datagen.farm.space import check_space, needed_space
from datagen.farm.submission import submit
from datagen.farm.work_unit import UnitRun, run_unit
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import OutputRecipe
from datagen.foundation.buffers import LIGHT_BUFFERS, RENDERED_BUFFERS, VIEW_BUFFERS, get_buffer
from datagen.foundation.errors import InputError
from datagen.foundation.exr import encode_view
from datagen.inspection.verify import verify_dataset
from datagen.library import Library
from tests.datagen.small_plan import plan_small
from tests.small_disk import small_disk


@pytest.fixture(scope="module")
def library_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("leftovers") / "library"


@pytest.fixture(scope="module")
def half_done(tmp_path_factory: pytest.TempPathFactory, library_root: Path) -> DatasetFolder:
    """A dataset of two units: the first is done, the second is rendered and has statistics but no shard."""
    folder = plan_small(tmp_path_factory.mktemp("half") / "dataset", library_root, num_units=2)
    run_local(folder.root, LocalOptions(only=(0,)))
    run_local(folder.root, LocalOptions(stages=("render", "stats"), only=(1,)))
    return folder


@pytest.fixture
def folder(half_done: DatasetFolder, tmp_path: Path) -> DatasetFolder:
    shutil.copytree(half_done.root, tmp_path / "set")
    return DatasetFolder(tmp_path / "set")


def _attempt(folder: DatasetFolder, index: int) -> UnitRun:
    plan, recipe = folder.read_plan(), folder.read_recipe()
    library = Library([Path(path) for path in folder.read_record().library_paths])
    return UnitRun(folder, plan.units[index], recipe, library, plan.versions, plan.variant)


def _all(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if not path.name.startswith(".clock")}


def _touch(root: Path, names: Iterable[str]) -> set[str]:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"half")
    return set(names)


def test_a_crash_between_the_shard_and_its_marker_leaves_a_leftover(
    folder: DatasetFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tar that no unit's manifest names is reported by ``verify`` and removed when the index is written."""

    def crash(run: UnitRun, manifest: object) -> None:
        raise SystemExit("killed")

    with monkeypatch.context() as context:
        context.setattr(work_unit, "commit_manifest", crash)
        with pytest.raises(SystemExit):
            run_unit(_attempt(folder, 1), ("pack",))
    (orphan,) = [path for path in folder.shards_path.iterdir() if "small-00001" in path.name]
    assert find_leftovers(folder.root) == [orphan]
    removed: list[Path] = []
    orphan_bytes = orphan.read_bytes()
    index = collect(folder.root, on_removed=removed.append)
    assert removed == [orphan] and not orphan.exists() and index.missing == ("small-00001",)
    orphan.write_bytes(orphan_bytes)
    faults = [fault for fault in verify_dataset(folder.root).faults if orphan.name in fault.got]
    assert len(faults) == 1 and "`datagen run --only index` removes it" in faults[0].got
    assert run_unit(_attempt(folder, 1), ("pack",))
    assert collect(folder.root).is_complete and orphan.read_bytes() == orphan_bytes


def test_only_unreferenced_files_are_removed(folder: DatasetFolder) -> None:
    done, undone = folder.read_plan().units
    kept = _all(folder.root)
    kept |= _touch(
        folder.root,
        [
            "shards/mine.tar",
            "shards/other-00000-0123456789abcdef.tar",
            "shards/.mine.partial",
            "units/mine.json",
            "work/mine/file",
            f"{folder.work_path(undone).relative_to(folder.root)}/rendered/view-009.exr",
        ],
    ) | {"work/mine"}
    gone = _touch(
        folder.root,
        [
            f"shards/{done.id}-0123456789abcdef.tar",
            f"shards/{undone.id}-0123456789abcdef.tar",
            f"shards/.{done.id}.0123456789ab.partial",
            f"shards/.{undone.id}.0123456789ab.partial",
            f"units/.{undone.key}.json.0123456789ab.partial",
            f"units/..{done.key}.json.0123456789ab.partial.77.partial",
            f"{folder.work_path(done).relative_to(folder.root)}/rendered/view-000.exr",
        ],
    )
    top = {
        str(folder.work_path(done).relative_to(folder.root)) if name.startswith("work/") else name
        for name in gone
    }
    assert {str(path.relative_to(folder.root)) for path in find_leftovers(folder.root)} == top
    collect(folder.root)
    assert _all(folder.root) == kept | {"index.json"}
    assert find_leftovers(folder.root) == []


def test_files_of_running_attempts_are_kept(folder: DatasetFolder) -> None:
    """Files without a manifest are kept while the attempt's heartbeat is less than ten minutes old."""
    undone = folder.read_plan().units[1]
    _touch(
        folder.root, [f"shards/{undone.id}-0123456789abcdef.tar", f"shards/.{undone.id}.0123456789ab.partial"]
    )
    heartbeat = folder.work_path(undone) / "running"
    heartbeat.touch()
    assert find_leftovers(folder.root) == []
    os.utime(heartbeat, (1, 1))
    assert len(find_leftovers(folder.root)) == 2


def test_a_second_process_on_a_unit_leaves_nothing(
    folder: DatasetFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first attempt commits and cleans up while the second is between two views."""
    first, second = _attempt(folder, 1), _attempt(folder, 1)

    def overtaken(run: UnitRun, configuration: Configuration) -> None:
        assert run_unit(first, ("pack",))
        run.rendered_path.mkdir(parents=True)
        (run.rendered_path / "view-000.exr").write_bytes(b"late")
        run.progress("render", 1, 3)
        (run.complete_path / "view-000.exr").write_bytes(b"the folder is gone")

    monkeypatch.setitem(work_unit.STAGES, "render", overtaken)
    assert not run_unit(second, ("render",))
    assert list((folder.root / "work").iterdir()) == []
    assert collect(folder.root).is_complete


def _logs(folder: DatasetFolder) -> list[str]:
    return sorted(path.name for path in folder.logs_path.glob("*.log"))


def test_a_full_disk_stops_the_run_at_the_first_error(tmp_path: Path, library_root: Path) -> None:
    """The run makes one attempt at one unit and records no failure; a second run completes the dataset."""
    with small_disk(tmp_path / "disk", 16) as disk:
        folder = plan_small(disk.root / "set", library_root)
        disk.fill(leave=400_000)  # enough for a view or two
        command = [sys.executable, "-m", "datagen", "run", str(folder.root), "--only", "render"]
        command.append("--no-space-check")
        result = subprocess.run(command, capture_output=True, text=True)
        text = " ".join(result.stderr.split())
        assert result.returncode == 1 and "Traceback" not in text, text
        assert text.count("no space left on device") == 1 and "free space" in text and ".partial" not in text
        assert len(_logs(folder)) == 1 and not folder.failed_path.exists()
        assert list(folder.root.glob("work/*/rendered/*.json")), "what had room was kept"
        disk.make_room()
        summary = run_local(folder.root, LocalOptions())
        assert len(summary.done) == 3 and collect(folder.root).is_complete


def test_a_disk_too_small_for_the_estimate_is_reported_before_work(
    folder: DatasetFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    need = needed_space(folder, workers=2)
    manifest = folder.read_manifest(folder.read_plan().units[0])
    assert manifest is not None
    assert need.num_units == 1 and need.shard_bytes == manifest.num_bytes, "from the shard that is there"
    assert need.working_bytes == 3 * 64 * 48 * 120
    usage = shutil.disk_usage(folder.root)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=int(need.total_bytes) + 1))
    check_space(folder, workers=2)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=int(need.total_bytes) - 1))
    with pytest.raises(InputError, match=r"free disk = .* MB; expected about .* for 1 units.*--no-space"):
        check_space(folder, workers=2)


def test_jobs_are_not_submitted_to_a_disk_too_small(
    tmp_path: Path, library_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The estimate assumes as many concurrent units as the throttle permits, or one without a throttle."""
    root = plan_small(tmp_path / "set", library_root, num_units=3).root
    usage, three = shutil.disk_usage(root), needed_space(DatasetFolder(root), workers=3).total_bytes
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=int(three) - 1))
    with pytest.raises(InputError, match=r"free disk = .* for 3 units.*--no-space-check"):
        submit(root, SlurmOptions(throttle=3), "shell")
    assert not (root / "jobs").exists()
    assert submit(root, SlurmOptions(throttle=2), "shell").num_units == 3
    assert submit(root, SlurmOptions(), "shell").num_units == 3
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=0))
    assert submit(root, SlurmOptions(), dry_run=True).num_units == 3
    result = CliRunner().invoke(farm, ["submit", str(root), "--engine", "shell"])
    assert isinstance(result.exception, InputError)
    result = CliRunner().invoke(farm, ["submit", str(root), "--engine", "shell", "--no-space-check"])
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("keep_noisy", [False, True])
@pytest.mark.parametrize("light", [False, True])
def test_views_in_progress_need_no_more_than_estimated(
    keep_noisy: bool, light: bool, tmp_path: Path, library_root: Path
) -> None:
    """Without compression, the estimate covers both copies of a view: as rendered and with statistics."""
    folder = plan_small(tmp_path / "set", library_root, num_units=1, light=light)
    recipe = folder.read_recipe()
    render = recipe.render.model_copy(update={"keep_noisy": keep_noisy})
    recipe = recipe.model_copy(update={"render": render, "output": OutputRecipe(compression="none")})
    folder.recipe_path.write_text(yaml.safe_dump(recipe.model_dump(mode="json")))
    noisy, lit = ("beauty_noisy",) * keep_noisy, LIGHT_BUFFERS * light
    rendered, complete = (
        len(encode_view({name: np.zeros((48, 64, get_buffer(name).num_channels)) for name in names}, "none"))
        for names in ((*RENDERED_BUFFERS, *noisy), (*VIEW_BUFFERS, *noisy, *lit))
    )
    need = needed_space(folder, workers=1)
    assert need.shard_bytes == pytest.approx(3 * complete, rel=0.02)
    assert 3 * (rendered + complete) <= need.working_bytes < 4.5 * (rendered + complete)


def test_the_estimate_without_shards_is_close(tmp_path: Path, library_root: Path) -> None:
    """The estimate is within a factor of two of the shards' size."""
    folder = plan_small(tmp_path / "set", library_root, num_units=1)
    need = needed_space(folder, workers=1)
    run_local(folder.root, LocalOptions())
    taken = collect(folder.root).num_bytes
    assert taken / 2 < need.shard_bytes < taken * 2
    assert needed_space(folder, workers=1).total_bytes == 0

# SPDX-License-Identifier: MIT
"""Units of work and plan status, tested in process: stages, files, races and counts."""

from __future__ import annotations

import json
import os
import resource
import shutil
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from datagen.farm import work_unit
from datagen.farm.collect import collect
from datagen.farm.folder import DatasetFolder, FailureRecord, UnitManifest
from datagen.farm.status import RUNNING_AGE_S, last_lines, print_status, read_status
from datagen.farm.work_unit import Interrupted, UnitRun, run_unit
from datagen.formats.base import canonical_json, read_json, sha256_file, write_bytes_atomically
from datagen.formats.shard import ShardReader
from datagen.formats.view import ViewRecord
from datagen.foundation.errors import InputError
from datagen.library import Library
from tests.datagen.small_plan import plan_small

pytestmark = pytest.mark.usefixtures("mitsuba_variant")

Event = tuple[str, int, int]
VIEWS = ["view-000", "view-001"]


@dataclass
class Made:
    """A finished unit, copies of its dataset folder after each stage, and the progress that it reported."""

    folder: DatasetFolder
    after: dict[str, DatasetFolder]
    events: list[Event]
    library: Library

    def attempt(self, folder: DatasetFolder, **more: Any) -> UnitRun:
        """Return a new attempt at the unit of ``folder``."""
        plan = folder.read_plan()
        recipe = folder.read_recipe()
        return UnitRun(folder, plan.units[0], recipe, self.library, plan.versions, plan.variant, **more)

    def copy(self, stage: str, root: Path) -> DatasetFolder:
        """Copy the folder as it was after ``stage`` to ``root``."""
        shutil.copytree(self.after[stage].root, root)
        return DatasetFolder(root)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> Made:
    root = tmp_path_factory.mktemp("unit")
    folder = plan_small(root / "dataset", root / "library", num_units=1, num_views=2)
    found = Made(folder, {}, [], Library([root / "library"]))
    run = found.attempt(folder, report=lambda *event: found.events.append(event))
    for stage in ("render", "stats", "pack"):
        assert run_unit(run, [stage]) is True
        copied = DatasetFolder(root / f"after {stage}")
        shutil.copytree(folder.root, copied.root)
        found.after[stage] = copied
    return found


def manifest_of(folder: DatasetFolder) -> UnitManifest:
    manifest = folder.read_manifest(folder.read_plan().units[0])
    assert manifest is not None
    return manifest


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_stages_leave_their_files_and_report_progress(made: Made) -> None:
    unit = made.folder.read_plan().units[0]
    rendered = made.after["render"].work_path(unit)
    assert names(rendered) == ["rendered"]  # no heartbeat file
    assert names(rendered / "rendered") == [f"{v}.{s}" for v in VIEWS for s in ("exr", "json", "timing")]
    complete = made.after["stats"].work_path(unit)
    assert names(complete / "complete") == [f"{v}.{s}" for v in VIEWS for s in ("exr", "json")]
    assert not made.folder.work_path(unit).exists()
    counts = [0, 1, 2]
    assert made.events == [(stage, done, 2) for stage in ("render", "stats") for done in counts]
    assert names(made.folder.shards_path) == [Path(manifest_of(made.folder).shard).name]
    assert names(made.folder.units_path) == [f"{unit.key}.json"]


def test_the_manifest_describes_the_shard(made: Made) -> None:
    folder = made.folder
    unit, manifest = folder.read_plan().units[0], manifest_of(folder)
    shard = folder.root / manifest.shard
    assert (manifest.id, manifest.key, manifest.num_views) == (unit.id, unit.key, 2)
    assert manifest.sha256 == sha256_file(shard) and manifest.num_bytes == shard.stat().st_size
    assert shard.name == f"{unit.id}-{manifest.sha256[:16]}.tar" and shard.parent == folder.shards_path
    assert manifest.host == socket.gethostname() and len(manifest.attempt) == 12
    assert [timing.view for timing in manifest.views] == VIEWS
    assert all(timing.seconds and min(timing.seconds.values()) >= 0 for timing in manifest.views)
    assert set(manifest.seconds) == {"render", "stats", "pack"}
    assert all(0 <= seconds < 1000 for seconds in manifest.seconds.values())
    assert 50 < manifest.peak_memory_mb < 20_000
    assert folder.is_done(unit) and run_unit(made.attempt(folder)) is False
    records = list(ShardReader(shard).records())
    assert [record.name for record in records] == VIEWS
    assert all(record.statistics is not None and record.statistics.num_views == 2 for record in records)
    assert all(record.exposure > 0 and "color_median" in record.buffers for record in records)


def test_memory_is_reported_in_megabytes(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The operating system reports memory in units of 1024 bytes."""
    folder = made.copy("stats", tmp_path / "a")
    usage = SimpleNamespace(ru_maxrss=3000 * 1024)
    monkeypatch.setattr(resource, "getrusage", lambda who: usage)
    assert run_unit(made.attempt(folder), ["pack"]) is True
    assert manifest_of(folder).peak_memory_mb == 3000.0


def test_a_stage_without_the_previous_one_names_it(made: Made, tmp_path: Path) -> None:
    folder = made.copy("render", tmp_path / "a")
    with pytest.raises(InputError, match=r"view-000\.exr.*datagen run .* --only stats"):
        run_unit(made.attempt(folder), ["pack"])
    shutil.rmtree(folder.work_path(folder.read_plan().units[0]))
    with pytest.raises(InputError, match=r"view-000\.exr.*datagen run .* --only render"):
        run_unit(made.attempt(folder), ["stats"])
    assert not folder.shards_path.exists() and not folder.units_path.exists()


def test_finished_views_are_kept_and_damaged_ones_are_not(made: Made, tmp_path: Path) -> None:
    """Views finished before a stop request are kept; the next attempt renders missing and damaged ones."""
    folder = made.copy("render", tmp_path / "a")
    run = made.attempt(folder)
    first, second = (run.rendered_path / f"{name}.exr" for name in VIEWS)
    whole = second.read_bytes()
    second.write_bytes(whole[:-1])
    first_written = first.stat().st_mtime_ns
    assert run.read_record(run.rendered_path, VIEWS[1]) is None
    with pytest.raises(Interrupted):
        run_unit(made.attempt(folder, should_stop=lambda: True), ["render"])
    assert second.read_bytes() == whole[:-1]  # the stop was requested before the view began
    stopping = iter([False, True])
    events: list[Event] = []
    again = made.attempt(folder, should_stop=lambda: next(stopping), report=lambda *e: events.append(e))
    with pytest.raises(Interrupted):
        run_unit(again, ["render"])
    assert second.read_bytes() == whole and first.stat().st_mtime_ns == first_written
    assert events == [("render", 1, 2), ("render", 2, 2)]
    assert not run.heartbeat_path.exists()
    events.clear()
    last = made.attempt(folder, should_stop=lambda: True, report=lambda *e: events.append(e))
    assert run_unit(last, ["render"]) and events == [("render", 2, 2)]  # no view is left to render


def test_lost_timings_fail_no_unit(made: Made, tmp_path: Path) -> None:
    folder = made.copy("stats", tmp_path / "a")
    run = made.attempt(folder)
    (run.rendered_path / f"{VIEWS[0]}.timing").unlink()
    assert run_unit(run, ["pack"])
    first, second = manifest_of(folder).views
    assert (first.view, first.seconds) == (VIEWS[0], {}) and second.seconds
    assert manifest_of(folder).sha256 == manifest_of(made.folder).sha256


def test_changed_versions_and_configurations_are_refused(made: Made, tmp_path: Path) -> None:
    folder = made.copy("render", tmp_path / "a")
    run = made.attempt(folder)
    run.versions = {**run.versions, "mitsuba": "0.0.1"}
    with pytest.raises(InputError, match=r"mitsuba 0\.0\.1 as planned"):
        run_unit(run)
    path = folder.configuration_path(run.unit.id)
    path.write_text(json.dumps({**json.loads(path.read_text()), "seed": 999}))
    with pytest.raises(InputError, match="not what was planned"):
        run_unit(made.attempt(folder))


Change = Callable[[DatasetFolder, UnitManifest], UnitManifest | None]


def as_it_is(folder: DatasetFolder, manifest: UnitManifest) -> UnitManifest:
    return manifest


def of_another_shard(folder: DatasetFolder, manifest: UnitManifest) -> UnitManifest:
    other = folder.root / "shards" / "other.tar"
    other.write_bytes((folder.root / manifest.shard).read_bytes())
    return manifest.model_copy(update={"shard": "shards/other.tar", "attempt": "before"})


def without_its_shard(folder: DatasetFolder, manifest: UnitManifest) -> UnitManifest:
    return manifest.model_copy(update={"shard": "shards/lost.tar", "attempt": "before"})


def of_another_hash(folder: DatasetFolder, manifest: UnitManifest) -> UnitManifest:
    return manifest.model_copy(update={"sha256": "0" * 64, "attempt": "before"})


@pytest.mark.parametrize(
    ("there", "wins"),
    [(of_another_shard, False), (without_its_shard, True), (of_another_hash, True), (None, True)],
    ids=["whole", "shard lost", "other hash", "damaged"],
)
def test_the_first_marker_wins_unless_it_is_invalid(
    made: Made, tmp_path: Path, there: Change | None, wins: bool
) -> None:
    """An attempt that ends after another keeps the other's manifest if valid, and replaces it otherwise."""
    folder = made.copy("pack", tmp_path / "a")
    manifest = manifest_of(folder)
    path = folder.manifest_path(folder.read_plan().units[0])
    before = there(folder, manifest) if there else None
    path.write_bytes(b"{" if before is None else canonical_json(before))
    work_unit.commit_manifest(made.attempt(folder), manifest)
    assert manifest_of(folder) == (manifest if wins else before)
    assert (folder.root / manifest.shard).exists() == wins  # an unreferenced shard is removed
    assert names(folder.units_path) == [path.name]
    assert folder.is_done(folder.read_plan().units[0])


def test_a_unit_committed_by_another_attempt_is_no_failure(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = made.copy("stats", tmp_path / "a")

    def committed_by_another(run: UnitRun, configuration: Any) -> None:
        for part in ("shards", "units"):
            shutil.copytree(made.folder.root / part, folder.root / part)
        raise FileNotFoundError("its work folder went")

    def broken(run: UnitRun, configuration: Any) -> None:
        raise OSError("disk")

    monkeypatch.setitem(work_unit.STAGES, "pack", broken)
    with pytest.raises(OSError, match="disk"):
        run_unit(made.attempt(folder), ["pack"])
    monkeypatch.setitem(work_unit.STAGES, "pack", committed_by_another)
    assert run_unit(made.attempt(folder), ["pack"]) is False


def test_a_failed_pack_leaves_no_part_of_a_shard(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = made.copy("stats", tmp_path / "a")

    def full_disk(file: Any, *_: Any) -> None:
        file.write(b"part")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(work_unit, "write_shard", full_disk)
    with pytest.raises(OSError, match="No space"):
        run_unit(made.attempt(folder), ["pack"])
    assert names(folder.shards_path) == []


def test_the_index_lists_done_and_missing_units(made: Made, tmp_path: Path) -> None:
    folder = made.copy("pack", tmp_path / "a")
    unit, manifest = folder.read_plan().units[0], manifest_of(folder)
    recipe = folder.recipe_path.read_text()
    folder.recipe_path.write_text(recipe.replace("bundled", "/home/someone/rooms"))
    index = collect(folder.root)
    assert index.is_complete and index.missing == () and index.splits == {unit.split: 1}
    assert (index.num_configurations, index.num_views, index.num_bytes) == (1, 2, manifest.num_bytes)
    (shard,) = index.shards
    assert (shard.file, shard.sha256, shard.seed) == (manifest.shard, manifest.sha256, unit.seed)
    assert shard.configuration == unit.id and shard.assets == unit.assets == tuple(index.assets)
    first = next(iter(ShardReader(folder.root / manifest.shard).records()))
    assert index.buffers == first.buffers and index.recipe.library == ("rooms",)
    assert read_json(type(index), folder.index_path) == index
    damaged = (folder.root / manifest.shard).read_bytes()
    (folder.root / manifest.shard).write_bytes(damaged[:-1] + b"x")
    assert collect(folder.root).is_complete  # of the same size: only hashing detects it
    with pytest.raises(InputError, match=f"run again.*|{manifest.sha256}"):
        collect(folder.root, deep=True)
    folder.manifest_path(unit).unlink()
    index = collect(folder.root)
    assert not index.is_complete and index.missing == (unit.id,) and index.shards == ()
    assert (index.num_views, index.num_bytes, index.buffers, index.assets) == (0, 0, (), {})


# ---- status of synthetic manifests -------------------------------------------------------------------------


def finish(folder: DatasetFolder, index: int, ago_s: float, now: float, *seconds: float) -> None:
    """Write a unit's shard and a manifest with stage times ``seconds``, dated ``ago_s`` before ``now``."""
    unit = folder.read_plan().units[index]
    shard = folder.shards_path / f"{unit.id}.tar"
    for path in (folder.shards_path, folder.units_path):
        path.mkdir(exist_ok=True)
    shard.write_bytes(b"x" * 1000 * (index + 1))
    manifest = UnitManifest(
        key=unit.key,
        id=unit.id,
        shard=f"shards/{shard.name}",
        sha256="0" * 64,
        num_bytes=1000 * (index + 1),
        num_views=2,
        attempt="a",
        host="h",
        seconds=dict(zip(("render", "stats"), seconds, strict=True)),
        views=(),
        peak_memory_mb=1.0,
    )
    write_bytes_atomically(folder.manifest_path(unit), canonical_json(manifest))
    os.utime(folder.manifest_path(unit), (now - ago_s, now - ago_s))


@pytest.fixture
def seven(tmp_path: Path) -> DatasetFolder:
    """A plan in which units 0 to 2 are done, 3 is running, 4 was attempted, 5 failed and 6 is waiting."""
    folder = plan_small(tmp_path / "seven", tmp_path / "library", num_units=7, num_views=2)
    now = folder.plan_path.stat().st_mtime
    finish(folder, 0, 7200, now, 100.0, 20.0)
    finish(folder, 1, 1800, now, 200.0, 40.0)
    finish(folder, 2, 600, now, 50.0, 10.0)
    units = folder.read_plan().units
    for index, ago_s in ((3, RUNNING_AGE_S - 60), (4, RUNNING_AGE_S + 60)):
        heartbeat = folder.work_path(units[index]) / "running"
        heartbeat.parent.mkdir(parents=True)
        heartbeat.touch()
        os.utime(heartbeat, (now - ago_s, now - ago_s))
    folder.logs_path.mkdir()
    (folder.logs_path / "unit.log").write_text("".join(f"line {k}\n" for k in range(2000)))
    failure = FailureRecord(
        id=units[5].id,
        index=5,
        attempts=3,
        reason="no light",
        log="logs/unit.log",
        command="datagen run x --unit 5 --attempts 0",
    )
    for unit in (units[5], units[0]):  # the failure record of a done unit is ignored
        path = folder.failed_path / f"{unit.id}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(canonical_json(failure.model_copy(update={"id": unit.id})))
    return folder


def test_status_counts_units_views_and_time(seven: DatasetFolder) -> None:
    status = read_status(seven.root)
    assert (status.total, status.done, status.waiting) == (7, 3, 2)
    assert status.running == ("small-00003",)
    assert [failure.id for failure in status.failed] == ["small-00005"]
    assert (status.views_done, status.views_total, status.num_bytes) == (6, 14, 6000)
    assert status.unit_seconds == 420.0 and status.median_unit_s == 120.0
    assert status.array_spec == "3-6"
    # two units in the last hour, the first of them half an hour ago
    assert status.units_per_hour == pytest.approx(4.0, rel=0.05)
    assert status.seconds_left == pytest.approx(3600.0, rel=0.05)
    assert not list(seven.root.glob(".clock*"))


def test_one_unit_gives_no_rate_and_a_finished_plan_no_time_left(seven: DatasetFolder) -> None:
    now = seven.plan_path.stat().st_mtime
    finish(seven, 1, 7200, now, 1.0, 1.0)
    status = read_status(seven.root)
    assert status.units_per_hour is None and status.seconds_left is None
    for index in range(7):
        finish(seven, index, 7200, now, 1.0, 1.0)
    status = read_status(seven.root)
    assert (status.done, status.waiting, status.array_spec) == (7, 0, "")
    assert status.seconds_left == 0.0 and status.failed == ()


def test_a_damaged_marker_or_one_without_its_shard_is_ignored(seven: DatasetFolder) -> None:
    units = seven.read_plan().units
    (seven.shards_path / f"{units[0].id}.tar").unlink()
    seven.manifest_path(units[1]).write_text("{")
    status = read_status(seven.root)
    assert status.done == 1 and status.array_spec == "0-1,3-6"
    assert [failure.id for failure in status.failed] == ["small-00000", "small-00005"]


def test_status_is_printed(seven: DatasetFolder, capsys: pytest.CaptureFixture[str]) -> None:
    print_status(seven.root, cost_per_hour=6.0)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split(maxsplit=1)[1] == "3 done, 1 running, 1 failed, 2 waiting, 7 in all"
    assert lines[1].split(maxsplit=1)[1] == "6 of 14; 0.00 GB"
    assert lines[2].split(maxsplit=1)[1] == "0.12 h of finished units, median 120 s per unit, cost 0.70"
    assert lines[3].startswith("rate     4 units per hour, about ") and lines[3].endswith(" min left")
    assert lines[4] == "failed   small-00005 after 3 attempts: no light"
    assert lines[5].strip() == "reproduce: datagen run x --unit 5 --attempts 0"
    assert [line.strip() for line in lines[6:11]] == [f"| line {k}" for k in range(1995, 2000)]
    assert lines[11:] == ["not done --array=3-6"]


def test_last_lines_are_read_from_the_end(seven: DatasetFolder) -> None:
    assert last_lines(seven.root, "logs/unit.log", 2) == ["line 1998", "line 1999"]
    (seven.logs_path / "short.log").write_text("a\nb\n")
    assert last_lines(seven.root, "logs/short.log") == ["a", "b"]
    assert last_lines(seven.root, "") == []
    (message,) = last_lines(seven.root, "logs/none.log")
    assert message.startswith("(no log: ")
    (message,) = last_lines(seven.root, "../outside.log")
    assert message.startswith("(no log: ")


def test_a_record_of_a_view_contains_the_hash_of_its_image(made: Made) -> None:
    run = made.attempt(made.after["stats"])
    record = run.read_record(run.complete_path, VIEWS[0])
    assert isinstance(record, ViewRecord) and record.exr_sha256 == sha256_file(
        run.complete_path / "view-000.exr"
    )
    assert record.buffers == tuple(sorted(record.buffers)) and "color_max" in record.buffers
    before = run.read_record(run.rendered_path, VIEWS[0])
    assert before is not None and before.statistics is None and "color_max" not in before.buffers
    assert run.read_record(run.rendered_path, "view-007") is None

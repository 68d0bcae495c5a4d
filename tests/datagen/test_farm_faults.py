# SPDX-License-Identifier: MIT
"""Fault injection: kills at random and chosen moments, full and read-only disks, damaged files, concurrent
runs, a changed clock.

After each fault one more run completes the dataset with the same bytes. A unit's marker is the manifest by
which it counts as done.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from datagen.farm.collect import collect
from datagen.farm.folder import DatasetFolder
from datagen.farm.local import LocalOptions, run_local
from datagen.farm.status import read_status
from datagen.foundation.errors import InputError
from tests.datagen.small_plan import plan_small
from tests.small_disk import small_disk

RUN = """
import sys
from pathlib import Path
from datagen.farm.local import LocalOptions, run_local
if __name__ == "__main__":
    summary = run_local(Path(sys.argv[1]), LocalOptions(workers=2, attempts=1000))
    sys.exit(1 if summary.failures else 0)
"""


@pytest.fixture(scope="module")
def library_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("faults") / "library"


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, library_root: Path) -> DatasetFolder:
    """A finished dataset, made without faults; tests use copies of it."""
    folder = plan_small(tmp_path_factory.mktemp("undisturbed") / "dataset", library_root)
    run_local(folder.root, LocalOptions(workers=1))
    return folder


@pytest.fixture(scope="module")
def expected(undisturbed: DatasetFolder) -> dict[str, str]:
    return _hashes(undisturbed)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory, library_root: Path) -> DatasetFolder:
    """A dataset of rendered views without statistics; tests use copies of it."""
    folder = plan_small(tmp_path_factory.mktemp("rendered") / "dataset", library_root)
    run_local(folder.root, LocalOptions(stages=("render",)))
    return folder


def _copy(folder: DatasetFolder, root: Path, without: tuple[int, ...] = ()) -> DatasetFolder:
    """Copy a dataset to ``root``; in the copy, units with the indices ``without`` are unfinished."""
    shutil.copytree(folder.root, root)
    copied = DatasetFolder(root)
    for unit in copied.read_plan().units:
        if unit.index in without:
            manifest = copied.read_manifest(unit)
            assert manifest is not None
            (root / manifest.shard).unlink()
            copied.manifest_path(unit).unlink()
    return copied


def _hashes(folder: DatasetFolder) -> dict[str, str]:
    index = collect(folder.root, deep=True)
    assert index.is_complete
    return {shard.configuration: shard.sha256 for shard in index.shards}


def _start(folder: DatasetFolder, script: Path, **arguments: object) -> subprocess.Popen:
    script.write_text(RUN)
    return subprocess.Popen(
        [sys.executable, str(script), str(folder.root)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])},
        **arguments,  # type: ignore[call-overload]
    )


def _workers(process: subprocess.Popen) -> list[psutil.Process]:
    try:
        children = psutil.Process(process.pid).children()
        return [c for c in children if "spawn_main" in " ".join(c.cmdline())]
    except psutil.Error:
        return []  # the run has ended


def _end(process: subprocess.Popen) -> None:
    """Kill the remaining processes of a run, as a power cut would."""
    with suppress(ProcessLookupError):  # no process is left
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert process.stderr is not None
    process.stderr.close()


MOMENTS = {"any": "", "view": "work/*/*/.*.partial", "tar": "shards/.*.partial", "commit": "units/.*.partial"}
"""Patterns of temporary files whose appearance triggers a kill, by moment; '' for a random time."""


def _is_seen(folder: DatasetFolder, pattern: str) -> bool:
    with suppress(FileNotFoundError):  # a work folder was removed during listing
        return any(folder.root.glob(pattern))
    return False


def _comes(folder: DatasetFolder, process: subprocess.Popen, moment: str, rng: random.Random) -> bool:
    """Wait for ``moment``, a key of ``MOMENTS``; return False if the run ends first."""
    if moment == "any":
        try:
            process.wait(timeout=rng.uniform(0.2, 1.5))
        except subprocess.TimeoutExpired:
            return True
        return False
    while process.poll() is None:
        if _is_seen(folder, MOMENTS[moment]):
            return True
        os.sched_yield()
    return False


def _kill_at_random(
    folder: DatasetFolder, script: Path, kills: int, seed: int, moments: tuple[str, ...] = ("any",)
) -> Counter[str]:
    """Kill a worker, or the parent and all workers, ``kills`` times; return counts by moment and victim."""
    rng = random.Random(seed)
    hits: Counter[str] = Counter()
    while hits.total() < kills:
        process = _start(folder, script)
        try:
            while hits.total() < kills and process.poll() is None:
                moment = rng.choice(moments)
                if not _comes(folder, process, moment, rng):
                    break
                workers = _workers(process)
                if not workers:
                    continue
                if rng.random() < 0.3:
                    hits[f"{moment}/parent"] += 1
                    break
                with suppress(psutil.Error):  # the worker may have ended
                    rng.choice(workers).kill()
                    hits[f"{moment}/worker"] += 1
        finally:
            finished = process.poll() == 0
            _end(process)
        if finished:
            break
    return hits


def _check_completes(folder: DatasetFolder, expected: dict[str, str]) -> None:
    summary = run_local(folder.root, LocalOptions(workers=1))
    assert not summary.failures
    assert _hashes(folder) == expected
    assert len(list(folder.shards_path.glob("*.tar"))) == len(expected)


def test_ten_random_kills(expected: dict[str, str], tmp_path: Path, library_root: Path) -> None:
    hits: Counter[str] = Counter()
    for seed in range(20):
        folder = plan_small(tmp_path / f"set-{seed}", library_root)
        hits += _kill_at_random(folder, tmp_path / "run.py", 10 - hits.total(), seed)
        _check_completes(folder, expected)
        if hits.total() >= 10:
            return
    pytest.fail(f"only {hits} hit a running process")


@pytest.mark.slow
def test_fifty_kills_on_each_of_two_datasets(tmp_path: Path, library_root: Path) -> None:
    """Kill workers and parents at random moments and while a view, tar or marker is written; print counts."""
    undisturbed = plan_small(tmp_path / "undisturbed", library_root, num_units=60)
    run_local(undisturbed.root, LocalOptions(workers=2))
    expected = _hashes(undisturbed)
    hits: Counter[str] = Counter()
    for seed in range(2):
        folder = plan_small(tmp_path / f"set-{seed}", library_root, num_units=60)
        found = _kill_at_random(
            folder, tmp_path / "run.py", 50, seed, ("any", "any", "view", "tar", "commit")
        )
        assert found.total() == 50, "the set was finished before the last kill"
        hits += found
        _check_completes(folder, expected)
    print(dict(sorted(hits.items())))
    assert all(any(hit.startswith(moment) for hit in hits) for moment in MOMENTS)


@pytest.mark.parametrize(
    "moment",
    [
        pytest.param("work/*/rendered/.*.partial", marks=pytest.mark.slow),
        pytest.param("work/*/complete/*.exr", marks=pytest.mark.slow),
        "shards/.*.partial",
        pytest.param("units/*.json", marks=pytest.mark.slow),
    ],
)
def test_kill_at_a_chosen_moment(
    moment: str, expected: dict[str, str], tmp_path: Path, library_root: Path
) -> None:
    """Kill the run while a view is written, between stages, while the tar is written, or after a commit."""
    folder = plan_small(tmp_path / "chosen", library_root)
    process = _start(folder, tmp_path / "run.py")
    try:
        while not _is_seen(folder, moment):
            assert process.poll() is None, f"the run ended before {moment} was seen"
            os.sched_yield()
    finally:
        _end(process)
    _check_completes(folder, expected)


def test_full_disk_keeps_finished_views(
    expected: dict[str, str], tmp_path: Path, rendered: DatasetFolder
) -> None:
    """A file-size limit makes writing the shard fail as on a full disk; the views are kept."""
    folder = _copy(rendered, tmp_path / "full")
    run_local(folder.root, LocalOptions(stages=("stats",), only=(0,)))
    limit = 60_000  # smaller than the shard

    def limit_files() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    command = [sys.executable, "-m", "datagen", "run", str(folder.root), "--unit", "0", "--attempts", "0"]
    result = subprocess.run(command, preexec_fn=limit_files, capture_output=True, text=True)
    assert result.returncode == 1 and "File too large" in result.stderr
    assert not list(folder.root.glob("**/*.partial"))
    assert len(list(folder.root.glob("work/*/complete/*.json"))) == 3
    _check_completes(folder, expected)


def test_after_a_full_disk_no_unit_has_failed_and_a_rerun_completes(
    expected: dict[str, str], tmp_path: Path, library_root: Path
) -> None:
    with small_disk(tmp_path / "disk", 16) as disk:
        folder = plan_small(disk.root / "set", library_root)
        disk.fill(leave=400_000)  # enough for a view or two
        summary = run_local(folder.root, LocalOptions(workers=1))
        assert not summary.done and not summary.failures and not summary.interrupted
        assert "no space left" in summary.disk_full
        assert not list(folder.root.glob("**/*.partial"))
        views = list(folder.root.glob("work/*/rendered/*.json"))
        assert views, "what had room was kept"
        assert read_status(folder.root).done == 0
        disk.make_room()
        _check_completes(folder, expected)


def test_a_read_only_folder_is_reported_and_unchanged(
    expected: dict[str, str], tmp_path: Path, undisturbed: DatasetFolder
) -> None:
    with small_disk(tmp_path / "disk", 16) as disk:
        folder = _copy(undisturbed, disk.root / "set", without=(1, 2))
        disk.remount("ro")
        with pytest.raises(InputError, match="read-only file system"):
            run_local(folder.root, LocalOptions())
        root = str(folder.root)
        for words in (
            ["run", root, "--unit", "1", "--attempts", "0"],
            ["farm", "submit", root],
            ["run", root, "--only", "index"],
        ):
            command = [sys.executable, "-m", "datagen", *words]
            result = subprocess.run(command, capture_output=True, text=True)
            assert result.returncode == 2 and "read-only file system" in result.stderr.lower(), result.stderr
            assert "Traceback" not in result.stderr
        assert read_status(folder.root).done == 1, "it can still be looked at"
        disk.remount("rw")
        _check_completes(folder, expected)


@pytest.mark.slow
def test_two_whole_runs_at_once(expected: dict[str, str], tmp_path: Path, library_root: Path) -> None:
    folder = plan_small(tmp_path / "twice", library_root)
    both = [_start(folder, tmp_path / "run.py") for _ in range(2)]
    try:
        assert [process.wait() for process in both] == [0, 0]
    finally:
        for process in both:
            _end(process)
    assert not list(folder.root.glob("**/*.partial"))
    _check_completes(folder, expected)


def test_damaged_markers_are_found_and_repaired(
    expected: dict[str, str], tmp_path: Path, undisturbed: DatasetFolder
) -> None:
    """Truncated and symlinked markers are ignored; a wrong shard hash is detected by hashing the shard."""
    folder = _copy(undisturbed, tmp_path / "markers")
    cut, lying, linked = (folder.manifest_path(unit) for unit in folder.read_plan().units)
    cut.write_bytes(cut.read_bytes()[:50])
    manifest = json.loads(lying.read_text())
    manifest["sha256"] = manifest["sha256"][::-1]
    lying.write_text(json.dumps(manifest))
    linked.rename(tmp_path / "elsewhere.json")
    linked.symlink_to(tmp_path / "elsewhere.json")
    assert read_status(folder.root).done == 1
    with pytest.raises(InputError, match=r"small-00001.*sha256.*remove shards/small-00001"):
        collect(folder.root, deep=True)
    (folder.root / manifest["shard"]).unlink()
    linked.unlink()
    _check_completes(folder, expected)


def test_changed_configurations_are_refused(tmp_path: Path, undisturbed: DatasetFolder) -> None:
    """A configuration with a changed digit is not rendered, since it is not what was planned."""
    folder = _copy(undisturbed, tmp_path / "flipped", without=(1,))
    path = folder.configuration_path("small-00001")
    path.write_text(path.read_text().replace('"seed": 11', '"seed": 10'))
    summary = run_local(folder.root, LocalOptions(attempts=1))
    assert not summary.done and "not what was planned" in summary.failures[0].reason


def test_damaged_views_and_leftovers_are_replaced(
    expected: dict[str, str], tmp_path: Path, rendered: DatasetFolder
) -> None:
    folder = _copy(rendered, tmp_path / "damaged")
    views = sorted(folder.root.glob("work/*/rendered/*.exr"))
    views[0].write_bytes(views[0].read_bytes()[:100])
    flipped = bytearray(views[1].read_bytes())
    flipped[-50] ^= 0xFF
    views[1].write_bytes(flipped)
    views[2].with_suffix(".json").write_text('{"format": ')
    views[3].unlink()
    (views[4].parent / ".view-000.exr.999.partial").write_bytes(b"half")
    _check_completes(folder, expected)


def test_clock_set_back_changes_nothing(
    expected: dict[str, str], tmp_path: Path, rendered: DatasetFolder
) -> None:
    folder = _copy(rendered, tmp_path / "clock")
    for path in folder.root.rglob("*"):
        os.utime(path, (4102444800, 4102444800))  # dated 2100
    heartbeat = next(folder.root.glob("work/*")) / "running"
    heartbeat.touch()
    os.utime(heartbeat, (4102444800, 4102444800))
    assert read_status(folder.root).running == ()
    _check_completes(folder, expected)


def test_damaged_plan_is_refused(tmp_path: Path, library_root: Path) -> None:
    folder = plan_small(tmp_path / "plan", library_root)
    folder.plan_path.write_text(folder.plan_path.read_text()[:-20])
    with pytest.raises(InputError, match=r"plan\.json.*valid JSON"):
        run_local(folder.root, LocalOptions())

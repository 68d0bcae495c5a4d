# SPDX-License-Identifier: MIT
"""Faults put in on purpose: kills at random and at chosen moments, a full disk, damaged files, another clock.

After each, one more run completes the set with the same bytes.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from datagen.errors import InputError
from datagen.farm.collect import collect
from datagen.farm.folder import DatasetFolder
from datagen.farm.local import LocalOptions, run_local
from tests.datagen.small_plan import plan_small

RUN = """
import sys
from pathlib import Path
from datagen.farm.local import LocalOptions, run_local
if __name__ == "__main__":
    summary = run_local(Path(sys.argv[1]), LocalOptions(workers=2, attempts=1000))
    sys.exit(1 if summary.set_aside else 0)
"""


@pytest.fixture(scope="module")
def library_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("faults") / "library"


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory, library_root: Path) -> dict[str, str]:
    folder = plan_small(tmp_path_factory.mktemp("undisturbed") / "dataset", library_root)
    run_local(folder.root, LocalOptions(workers=1))
    return _hashes(folder)


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
        return []  # it ended meanwhile


def _end(process: subprocess.Popen) -> None:
    """Kill what is left of a run, as a machine that loses power would."""
    with suppress(ProcessLookupError):  # nothing may be left
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert process.stderr is not None
    process.stderr.close()


def _kill_at_random(folder: DatasetFolder, script: Path, kills: int, seed: int) -> int:
    """Kill a worker or the parent at random moments; returns how many kills hit a running process."""
    rng = random.Random(seed)
    hits = 0
    while hits < kills:
        process = _start(folder, script)
        try:
            while hits < kills and process.poll() is None:
                try:
                    process.wait(timeout=rng.uniform(0.3, 2.5))
                    break
                except subprocess.TimeoutExpired:
                    workers = _workers(process)
                    if not workers:
                        continue
                    hits += 1
                    if rng.random() < 0.3:
                        break  # the parent and all its workers
                    try:
                        rng.choice(workers).kill()
                    except psutil.Error:
                        hits -= 1  # it ended meanwhile
        finally:
            finished = process.poll() == 0
            _end(process)
        if finished:
            return hits
    return hits


def _check_completes(folder: DatasetFolder, expected: dict[str, str]) -> None:
    summary = run_local(folder.root, LocalOptions(workers=2))
    assert not summary.set_aside
    assert _hashes(folder) == expected
    assert len(list(folder.shards_path.glob("*.tar"))) == len(expected)


def test_ten_random_kills(expected: dict[str, str], tmp_path: Path, library_root: Path) -> None:
    hits = 0
    for seed in range(20):
        folder = plan_small(tmp_path / f"set-{seed}", library_root)
        hits += _kill_at_random(folder, tmp_path / "run.py", 10 - hits, seed)
        _check_completes(folder, expected)
        if hits >= 10:
            return
    pytest.fail(f"only {hits} kills hit a running process")


@pytest.mark.slow
def test_a_hundred_random_kills(expected: dict[str, str], tmp_path: Path, library_root: Path) -> None:
    hits = 0
    for seed in range(100, 200):
        folder = plan_small(tmp_path / f"set-{seed}", library_root)
        hits += _kill_at_random(folder, tmp_path / "run.py", min(10, 100 - hits), seed)
        _check_completes(folder, expected)
        if hits >= 100:
            return
    pytest.fail(f"only {hits} kills hit a running process")


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
    """While a view is written, between stages, while the tar is written, right after the first commit."""
    folder = plan_small(tmp_path / "chosen", library_root)
    process = _start(folder, tmp_path / "run.py")
    try:
        while not any(folder.root.glob(moment)):
            assert process.poll() is None, f"the run ended before {moment} was seen"
            os.sched_yield()
    finally:
        _end(process)
    _check_completes(folder, expected)


def test_full_disk_keeps_what_is_finished(
    expected: dict[str, str], tmp_path: Path, library_root: Path
) -> None:
    """A file-size limit makes writing the shard fail as a full disk does; the views stay."""
    folder = plan_small(tmp_path / "full", library_root)
    run_local(folder.root, LocalOptions(stages=("render", "stats"), only=(0,)))
    limit = 60_000  # less than the shard

    def limit_files() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    command = [sys.executable, "-m", "datagen", "unit", str(folder.root), "0"]
    result = subprocess.run(command, preexec_fn=limit_files, capture_output=True, text=True)
    assert result.returncode == 1 and "File too large" in result.stderr
    assert not list(folder.root.glob("**/*.partial"))
    assert len(list(folder.root.glob("work/*/complete/*.json"))) == 3
    _check_completes(folder, expected)


def test_leftovers_and_damaged_views_are_made_again(
    expected: dict[str, str], tmp_path: Path, library_root: Path
) -> None:
    folder = plan_small(tmp_path / "damaged", library_root)
    run_local(folder.root, LocalOptions(stages=("render",)))
    views = sorted(folder.root.glob("work/*/rendered/*.exr"))
    views[0].write_bytes(views[0].read_bytes()[:100])
    flipped = bytearray(views[1].read_bytes())
    flipped[-50] ^= 0xFF
    views[1].write_bytes(flipped)
    views[2].with_suffix(".json").write_text('{"format": ')
    views[3].unlink()
    (views[4].parent / ".view-000.exr.999.partial").write_bytes(b"half")
    _check_completes(folder, expected)


def test_clock_set_back_changes_nothing(expected: dict[str, str], tmp_path: Path, library_root: Path) -> None:
    folder = plan_small(tmp_path / "clock", library_root)
    run_local(folder.root, LocalOptions(stages=("render",)))
    for path in folder.root.rglob("*"):
        os.utime(path, (4102444800, 4102444800))  # written in 2100, as the clock has it now
    _check_completes(folder, expected)


def test_damaged_plan_is_refused(tmp_path: Path, library_root: Path) -> None:
    folder = plan_small(tmp_path / "plan", library_root)
    folder.plan_path.write_text(folder.plan_path.read_text()[:-20])
    with pytest.raises(InputError, match=r"plan\.json.*valid JSON"):
        run_local(folder.root, LocalOptions())

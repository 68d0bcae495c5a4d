# SPDX-License-Identifier: MIT
"""Workers are replaced after a number of units or memory growth, and a dead worker loses only its unit."""

from __future__ import annotations

import itertools
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from datagen.farm.folder import DatasetFolder
from datagen.farm.local import LocalOptions, run_local
from tests.conftest import REPOSITORY
from tests.datagen.small_plan import plan_small

# Workers import the script as their main module, so `run_unit` is replaced in them, too.
SCRIPT = """
import json, os, signal, sys
from pathlib import Path
import datagen.farm.work_unit as work_unit
from datagen.farm.local import LocalOptions, run_local

folder, fault, options = Path(sys.argv[1]), sys.argv[2], json.loads(sys.argv[3])
real, kept = work_unit.run_unit, []

def run_unit(run, stages):
    with (folder / "attempts.txt").open("a") as file:
        print(run.unit.id, os.getpid(), file=file)
    if fault == "grow":
        kept.append(os.urandom(60 << 20))
    elif run.unit.index == 1 and fault == "die":
        os.abort()
    elif run.unit.index == 2 and fault == "die":
        os.kill(os.getpid(), signal.SIGKILL)  # as the kernel does when memory runs out
    elif run.unit.index == 1 and fault == "exhaust":
        raise MemoryError("std::bad_alloc")
    elif fault == "stop":  # all three are signalled; one is done, one fails and one is killed
        while (folder / "attempts.txt").read_text().count("\\n") < 3:
            os.sched_yield()
        if run.unit.index == 0:
            os.kill(os.getppid(), signal.SIGINT)
        while not run.should_stop():
            os.sched_yield()
        if run.unit.index == 1:
            raise ValueError("no camera")
        if run.unit.index == 2:
            os.kill(os.getpid(), signal.SIGKILL)
    return real(run, stages)

work_unit.run_unit = run_unit
if __name__ == "__main__":
    summary = run_local(folder, LocalOptions(**options))
    print(json.dumps({"done": summary.done, "failures": [f.model_dump() for f in summary.failures]}))
"""


@pytest.fixture(scope="module")
def library_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("workers") / "library"


def _run(folder: DatasetFolder, fault: str, **options: Any) -> tuple[dict, list[tuple[str, int]]]:
    """Run a folder with a fault; return the summary and (unit, process id) of each attempt, in order."""
    script = folder.root.parent / "run.py"
    script.write_text(SCRIPT)
    result = subprocess.run(
        [sys.executable, str(script), str(folder.root), fault, json.dumps(options)],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    attempts = [line.split() for line in (folder.root / "attempts.txt").read_text().splitlines()]
    return json.loads(result.stdout), [(unit, int(process)) for unit, process in attempts]


def _units_a_process(attempts: list[tuple[str, int]]) -> list[int]:
    return [len(list(group)) for _, group in itertools.groupby(attempts, key=lambda a: a[1])]


def test_workers_are_replaced_after_a_number_of_units(tmp_path: Path, library_root: Path) -> None:
    folder = plan_small(tmp_path / "set", library_root, num_units=5, num_views=1)
    summary, attempts = _run(folder, "none", max_units_per_worker=2, stages=[])
    assert len(summary["done"]) == 5 and _units_a_process(attempts) == [2, 2, 1]


def test_workers_are_replaced_when_their_memory_has_grown(tmp_path: Path, library_root: Path) -> None:
    """A worker that grows by 60 MB per unit is replaced after its third unit if the limit is 100 MB."""
    folder = plan_small(tmp_path / "set", library_root, num_units=5, num_views=1)
    summary, attempts = _run(folder, "grow", max_growth_mb=100, stages=[])
    assert len(summary["done"]) == 5 and _units_a_process(attempts) == [3, 2]
    steady, attempts = _run(
        plan_small(tmp_path / "steady", library_root, num_units=5, num_views=1), "none", max_growth_mb=100,
        stages=[],
    )  # fmt: skip
    assert len(steady["done"]) == 5 and _units_a_process(attempts) == [5]


Deaths = tuple[DatasetFolder, dict, list[tuple[str, int]]]


@pytest.fixture(scope="module")
def deaths(tmp_path_factory: pytest.TempPathFactory, library_root: Path) -> dict[str, Deaths]:
    """Folder, summary and attempts of a run with each fault: workers die, or a unit exhausts the memory."""
    found = {}
    for fault, num_units in (("die", 4), ("exhaust", 3)):
        root = tmp_path_factory.mktemp(fault) / "a set"
        folder = plan_small(root, library_root, num_units=num_units, num_views=1)
        found[fault] = folder, *_run(folder, fault, attempts=2)
    return found


@pytest.mark.parametrize(
    ("fault", "index", "reason"),
    [
        ("die", 1, "the worker process was ended by SIGABRT"),
        ("die", 2, "the worker process was ended by SIGKILL (out of memory?)"),
        ("exhaust", 1, "MemoryError: std::bad_alloc"),
    ],
)
def test_a_worker_that_dies_loses_its_unit_only(
    fault: str, index: int, reason: str, deaths: dict[str, Deaths]
) -> None:
    """The unit is retried in a new process, then recorded as failed with log and command."""
    folder, summary, attempts = deaths[fault]
    unit, last = f"small-{index:05d}", len(folder.read_plan().units) - 1
    assert sorted(summary["done"]) == ["small-00000", f"small-{last:05d}"]
    assert len(summary["failures"]) == last - 1
    (failure,) = [failure for failure in summary["failures"] if failure["id"] == unit]
    assert (failure["attempts"], failure["reason"]) == (2, reason)
    assert folder.read_failure(unit).model_dump() == failure
    tries = [process for tried, process in attempts if tried == unit]
    assert len(tries) == len(set(tries)) == 2, "in a fresh process each"
    assert (folder.root / failure["log"]).is_file()
    command = [sys.executable, "-m", *shlex.split(failure["command"])]
    assert subprocess.run(command, cwd=REPOSITORY, capture_output=True).returncode == 0, (
        "nothing kills it here"
    )
    assert run_local(folder.root, LocalOptions(only=(0, index, last))).already_done == 3


def test_outcomes_during_a_stop_count(tmp_path: Path, library_root: Path) -> None:
    """Units that finish or fail during a stop are recorded as such, the unit of a dead worker is not."""
    folder = plan_small(tmp_path / "set", library_root, num_views=1)
    summary, _ = _run(folder, "stop", workers=3, attempts=1, stages=[])
    assert summary["done"] == ["small-00000"]
    assert [(f["id"], f["reason"]) for f in summary["failures"]] == [("small-00001", "ValueError: no camera")]
    assert folder.read_failure("small-00001").model_dump() == summary["failures"][0]

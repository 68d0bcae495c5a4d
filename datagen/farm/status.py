# SPDX-License-Identifier: MIT
"""Reads the state of a plan's units from the dataset folder, in which manifests are authoritative."""

from __future__ import annotations

import os
import statistics
import time
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from datagen.farm.folder import DatasetFolder, FailureRecord, PlannedUnit, UnitManifest
from datagen.foundation.errors import InputError
from datagen.foundation.paths import inside

RUNNING_AGE_S = 600.0
"""Age in seconds below which the heartbeat of a unit indicates that it is running."""


@dataclass(frozen=True)
class FarmStatus:
    """Progress of a plan: numbers of units and views, ids of running units, times and rates.

    ``unit_seconds`` is the total wall-clock time of finished units; ``array_spec`` lists the unfinished units
    in the syntax of Slurm's ``--array``.
    """

    total: int
    done: int
    running: tuple[str, ...]
    failed: tuple[FailureRecord, ...]
    waiting: int
    views_done: int
    views_total: int
    num_bytes: int
    unit_seconds: float
    median_unit_s: float | None
    units_per_hour: float | None
    seconds_left: float | None
    array_spec: str


def runs(numbers: list[int]) -> list[tuple[int, int]]:
    """Return the first and the last number of each run of consecutive ``numbers``."""
    groups = groupby(enumerate(sorted(numbers)), lambda entry: entry[1] - entry[0])
    listed = [[number for _, number in group] for _, group in groups]
    return [(run[0], run[-1]) for run in listed]


def array_spec(indices: list[int]) -> str:
    """Format indices in the syntax of Slurm's ``--array``: ``0-3,7,9-12``."""
    return ",".join(f"{first}-{last}" if last > first else f"{first}" for first, last in runs(indices))


def names_in(folder: Path) -> set[str]:
    """Names of the entries of ``folder``; empty if it is not a folder."""
    try:
        return {entry.name for entry in os.scandir(folder)}
    except (FileNotFoundError, NotADirectoryError):
        return set()


def read_status(root: Path) -> FarmStatus:
    """Read the progress of a dataset folder. Raises :class:`InputError` if there is no plan."""
    folder = DatasetFolder(root)
    plan = folder.read_plan()
    markers = names_in(folder.units_path)
    shards = {f"shards/{name}" for name in names_in(folder.shards_path)}
    now = file_system_now(folder)
    done: list[UnitManifest] = []
    finish_times: list[float] = []
    undone: list[PlannedUnit] = []
    for unit in plan.units:
        manifest = None
        if f"{unit.key}.json" in markers:
            with suppress(InputError):  # damaged, so the unit is run again
                manifest = folder.read_manifest(unit)
        if manifest is None or manifest.shard not in shards:
            undone.append(unit)
            continue
        done.append(manifest)
        finish_times.append(folder.manifest_path(unit).stat().st_mtime)
    running = tuple(unit.id for unit in undone if age_of_attempt(folder.work_path(unit), now) < RUNNING_AGE_S)
    failed: list[FailureRecord] = []
    failures = names_in(folder.failed_path)
    for unit in undone:
        if f"{unit.id}.json" in failures:
            with suppress(InputError):  # may be incomplete
                failed.append(folder.read_failure(unit.id))
    seconds = [sum(manifest.seconds.values()) for manifest in done]
    rate = _rate_per_hour(finish_times, now)
    return FarmStatus(
        total=len(plan.units),
        done=len(done),
        running=running,
        failed=tuple(failed),
        waiting=len(undone) - len(running) - sum(f.id not in running for f in failed),
        views_done=sum(manifest.num_views for manifest in done),
        views_total=sum(unit.num_views for unit in plan.units),
        num_bytes=sum(manifest.num_bytes for manifest in done),
        unit_seconds=sum(seconds),
        median_unit_s=statistics.median(seconds) if seconds else None,
        units_per_hour=rate,
        seconds_left=len(undone) / rate * 3600 if rate and undone else (0.0 if not undone else None),
        array_spec=array_spec([unit.index for unit in undone]),
    )


def file_system_now(folder: DatasetFolder) -> float:
    """Current time in seconds by the file system's clock, which is common to all hosts."""
    probe = folder.root / f".clock.{os.getpid()}"
    try:
        probe.touch()
        return probe.stat().st_mtime
    except OSError:
        return time.time()  # status also works on a read-only folder
    finally:
        with suppress(OSError):  # the folder is read-only
            probe.unlink(missing_ok=True)


def age_of_attempt(work: Path, now: float) -> float:
    """Seconds between the last heartbeat in the folder ``work`` and ``now``; infinite if there is none."""
    try:
        return abs(now - (work / "running").stat().st_mtime)  # abs: the clock may have been set back
    except OSError:
        return float("inf")


def _rate_per_hour(times: list[float], now: float) -> float | None:
    """Units per hour since the first of the finish ``times`` in the last hour; None for fewer than two."""
    recent = [t for t in times if now - t <= 3600]
    if len(recent) < 2:
        return None
    span = max(now - min(recent), 1.0)
    return len(recent) / span * 3600


def forget_failures(root: Path) -> list[str]:
    """Remove the records of failed units, and return the units' ids."""
    folder = DatasetFolder(root)
    forgotten = []
    for unit in folder.read_plan().units:
        path = folder.failed_path / f"{unit.id}.json"
        if path.exists():
            path.unlink()
            forgotten.append(unit.id)
    return forgotten


def last_lines(root: Path, log: str, count: int = 5) -> list[str]:
    """Last ``count`` lines of a log in the folder; empty if ``log`` is '', a note if it is unreadable."""
    if not log:
        return []
    try:
        with inside(root, root / log).open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - 8192))
            return file.read().decode(errors="replace").splitlines()[-count:]
    except (OSError, InputError) as error:
        return [f"(no log: {error})"]


def print_status(root: Path, cost_per_hour: float = 0.0) -> FarmStatus:
    """Print and return a dataset folder's status; ``cost_per_hour`` is the hourly price of a unit."""
    status = read_status(root)
    hours = status.unit_seconds / 3600
    counts = f"{status.done} done, {len(status.running)} running, {len(status.failed)} failed"
    print(f"units    {counts}, {status.waiting} waiting, {status.total} in all")
    print(f"views    {status.views_done} of {status.views_total}; {status.num_bytes / 1e9:.2f} GB")
    if status.median_unit_s is not None:
        cost = f", cost {hours * cost_per_hour:.2f}" if cost_per_hour else ""
        print(f"time     {hours:.2f} h of finished units, median {status.median_unit_s:.0f} s per unit{cost}")
    if status.units_per_hour:
        left = f", about {status.seconds_left / 60:.0f} min left" if status.seconds_left else ""
        print(f"rate     {status.units_per_hour:.0f} units per hour{left}")
    for failure in status.failed:
        print(f"failed   {failure.id} after {failure.attempts} attempts: {failure.reason}")
        print(f"         reproduce: {failure.command}")
        for line in last_lines(root, failure.log):
            print(f"         | {line}")
    if status.array_spec:
        print(f"not done --array={status.array_spec}")
    return status

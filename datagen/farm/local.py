# SPDX-License-Identifier: MIT
"""Runs units on this machine, in worker processes that may crash without affecting each other.

The parent sends unit indices over pipes and never imports mitsuba. If a worker dies, its unit is tried again
in a new process; after the last attempt, it is recorded as failed, with its log and the command that
reproduces the failure. Workers are replaced after a number of units or when their memory has grown.
"""

from __future__ import annotations

import shlex
import signal
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from datagen.farm.folder import DatasetFolder, FailureRecord, PlannedUnit
from datagen.farm.worker import STOP_SIGNALS, check_writable, planned_unit, worker_main
from datagen.formats.base import canonical_json, write_bytes_atomically
from datagen.foundation.peak_memory import num_threads
from mitsuba_plugins.variant import check_variant

GRACE_S = 20.0  # time for workers to stop before they are killed


@dataclass(frozen=True)
class LocalOptions:
    """Options of a local run.

    A worker is replaced after ``max_units_per_worker`` units, or if its memory has grown by more than
    ``max_growth_mb`` since its first unit.
    """

    workers: int = 1
    attempts: int = 3
    max_units_per_worker: int = 20
    max_growth_mb: float = 1000.0
    stages: tuple[str, ...] = ("render", "stats", "pack")
    only: tuple[int, ...] | None = None
    """Indices of the units to run; None runs all."""


@dataclass
class RunSummary:
    """Outcome of a run, with the ids of ``done`` units and the number ``already_done`` before the run."""

    done: list[str] = field(default_factory=list)
    already_done: int = 0
    failures: list[FailureRecord] = field(default_factory=list)
    interrupted: bool = False
    disk_full: str = ""
    """Message about a full disk that stopped the run, or ''; affected units do not count as failed."""


Event = tuple[str, str, str, int, int]
"""(kind, unit id, stage, done, total), with kind "progress" or "done", or (kind, unit id, reason, attempts,
maximum number of attempts), with kind "retry" or "set_aside" (recorded as failed).
"""


class _Worker:
    """Handle of a worker process, with its pipe, current unit and number of finished units."""

    def __init__(self, root: Path, threads: int, stages: tuple[str, ...]):
        context = get_context("spawn")
        self.connection, child_end = context.Pipe()
        self.process: BaseProcess = context.Process(
            target=worker_main, args=(child_end, str(root), threads, stages), daemon=True
        )
        self.process.start()
        child_end.close()
        self.unit: PlannedUnit | None = None
        self.log: Path | None = None
        self.num_units = 0
        self.first_memory_mb = 0.0

    def assign(self, unit: PlannedUnit, log: Path) -> None:
        self.unit, self.log = unit, log
        with suppress(OSError):  # the process may have died, which the sentinel reports
            self.connection.send((unit.index, str(log)))

    def is_spent(self, memory_mb: float, options: LocalOptions) -> bool:
        """Return whether the worker has run its maximum number of units or its memory has grown too much."""
        if self.num_units == 1:
            self.first_memory_mb = memory_mb
        grown = memory_mb - self.first_memory_mb
        return self.num_units >= options.max_units_per_worker or grown > options.max_growth_mb

    def dismiss(self) -> None:
        """Tell an idle worker process to end, and wait for its end."""
        with suppress(OSError):  # the process may already have ended
            self.connection.send(None)
        self.process.join(GRACE_S)
        self.kill()

    def kill(self) -> None:
        if self.process.is_alive():
            self.process.kill()
        self.process.join()
        self.connection.close()


def run_local(
    root: Path, options: LocalOptions, on_event: Callable[[Event], None] = lambda event: None
) -> RunSummary:
    """Run every unfinished unit of the plan, or of ``options.only``, and return the outcome.

    After SIGINT, SIGTERM or SIGUSR1, the run stops once views in progress are finished, at most 20 s later; a
    full disk stops it immediately. Units that failed ``attempts`` times are listed in ``failures`` and
    recorded in ``failed/``. Raises :class:`InputError` without a plan, its Mitsuba variant or write access.
    """
    folder = DatasetFolder(root)
    plan = folder.read_plan()
    units = (
        plan.units if options.only is None else [planned_unit(plan, root, index) for index in options.only]
    )
    todo = deque(unit for unit in units if not folder.is_done(unit))
    run = _LocalRun(folder, options, on_event, todo)
    run.summary.already_done = len(units) - len(todo)
    if todo:
        check_writable(root)
        check_variant(plan.variant)
        run.finish()
    return run.summary


@dataclass
class _LocalRun:
    """A run in progress, with its queue of units, its workers and its outcome so far."""

    folder: DatasetFolder
    options: LocalOptions
    on_event: Callable[[Event], None]
    todo: deque[PlannedUnit]
    summary: RunSummary = field(default_factory=RunSummary)
    attempts: Counter[str] = field(default_factory=Counter)
    workers: list[_Worker] = field(default_factory=list)

    def finish(self) -> None:
        """Run the queued units until all are done, a signal arrives or the disk is full."""
        signals: list[int] = []
        previous = {n: signal.signal(n, lambda number, _: signals.append(number)) for n in STOP_SIGNALS}
        num_workers = max(1, min(self.options.workers, len(self.todo)))
        threads = max(1, num_threads() // num_workers)
        try:
            while not signals and not self.summary.disk_full:
                num_busy = sum(worker.unit is not None for worker in self.workers)
                if not self.todo and not num_busy:
                    break
                self._assign_units(min(num_workers, len(self.todo) + num_busy), threads)
                for worker in _ready(self.workers):
                    self._handle(worker)
            self.summary.interrupted = bool(signals)
            if self.summary.interrupted or self.summary.disk_full:
                self._stop()
        finally:
            for worker in self.workers:
                worker.kill()
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _assign_units(self, num_workers: int, threads: int) -> None:
        while len(self.workers) < num_workers:
            self.workers.append(_Worker(self.folder.root, threads, self.options.stages))
        for worker in self.workers:
            if worker.unit is None and self.todo:
                unit = self.todo.popleft()
                self.attempts[unit.id] += 1
                worker.assign(unit, self.folder.logs_path / f"{unit.id}.{self.attempts[unit.id]}.log")

    def _stop(self) -> None:
        """Signal every worker to stop after its view, and handle their outcomes for up to ``GRACE_S``."""
        for worker in self.workers:
            if worker.process.is_alive():
                worker.process.terminate()
        deadline = time.monotonic() + GRACE_S
        while busy := [worker for worker in self.workers if worker.unit is not None]:
            if time.monotonic() >= deadline:
                break
            for worker in _ready(busy):
                self._handle(worker, is_stopping=True)

    def _handle(self, worker: _Worker, is_stopping: bool = False) -> None:
        """Handle a worker's message, or the end of its process, which is no failure if ``is_stopping``."""
        unit = worker.unit
        try:
            message = worker.connection.recv() if worker.connection.poll() else None
        except (EOFError, OSError):
            message = None
        if message is None:
            worker.process.join(1.0)
            if worker.process.exitcode is None:
                return
            self.workers.remove(worker)
            worker.kill()
            if unit is not None and not is_stopping:
                self._fail(unit, f"the worker process {_end_of(worker.process.exitcode)}", worker.log)
            return
        assert unit is not None
        if message[0] == "progress":
            self.on_event(("progress", unit.id, *message[1:]))
            return
        _, outcome, reason, memory_mb = message
        worker.unit = None
        worker.num_units += 1
        if outcome in ("done", "already"):
            self.summary.done.append(unit.id)
            (self.folder.failed_path / f"{unit.id}.json").unlink(missing_ok=True)
            if worker.log is not None and worker.log.exists() and worker.log.stat().st_size == 0:
                worker.log.unlink()
            self.on_event(("done", unit.id, "", 0, 0))
        elif outcome == "full":
            self.summary.disk_full = self.summary.disk_full or reason
        elif outcome == "failed":
            self._fail(unit, reason, worker.log)
        else:  # the worker was stopped from outside, so the attempt does not count
            self.attempts[unit.id] -= 1
            self.todo.append(unit)
        if outcome == "failed" or worker.is_spent(memory_mb, self.options):
            self.workers.remove(worker)
            worker.dismiss()

    def _fail(self, unit: PlannedUnit, reason: str, log: Path | None) -> None:
        """Queue the unit again or, after its last attempt, record it as failed."""
        root, used = self.folder.root, self.attempts[unit.id]
        if used < self.options.attempts:
            self.todo.append(unit)
            self.on_event(("retry", unit.id, reason, used, self.options.attempts))
            return
        record = FailureRecord(
            id=unit.id,
            index=unit.index,
            attempts=used,
            reason=reason,
            log=str(log.relative_to(root)) if log else "",
            command=f"datagen run {shlex.quote(str(root.resolve()))} --unit {unit.index} --attempts 0",
        )
        self.summary.failures.append(record)
        # the summary contains the record even if a full disk prevents writing it
        with suppress(OSError):
            path = self.folder.failed_path / f"{unit.id}.json"
            write_bytes_atomically(path, canonical_json(record), parents=True)
        self.on_event(("set_aside", unit.id, reason, used, self.options.attempts))


def _ready(workers: list[_Worker]) -> list[_Worker]:
    """Wait for workers that sent a message or ended, at most 1 s so that signals are handled; return them."""
    handles = {
        handle: worker for worker in workers for handle in (worker.connection, worker.process.sentinel)
    }
    ready = wait(list(handles), timeout=1.0)
    return list(dict.fromkeys(handles[handle] for handle in ready))  # type: ignore[index]


def _end_of(exit_code: int) -> str:
    if exit_code >= 0:
        return f"ended with exit code {exit_code}"
    try:
        name = signal.Signals(-exit_code).name
    except ValueError:
        name = f"signal {-exit_code}"
    return f"was ended by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")

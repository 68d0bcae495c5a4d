# SPDX-License-Identifier: MIT
"""Runs units that a parent process sends over a pipe, or one unit in this process.

A signal to stop takes effect after the current view; finished views are kept.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

import psutil

from datagen.farm.folder import DatasetFolder, Plan, PlannedUnit
from datagen.foundation.errors import DISK_FULL, InputError, Problem, input_error
from datagen.foundation.peak_memory import num_threads
from datagen.library import Library
from mitsuba_plugins.variant import check_variant, select_variant

EXIT_INTERRUPTED = 75
"""Exit code (EX_TEMPFAIL) of a unit that a signal stopped and that must be run again."""
STOP_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR1") if hasattr(signal, name)
)  # missing on Windows


def check_writable(root: Path) -> None:
    """Raise :class:`InputError` if nothing can be written below ``root``."""
    probe = root / f".writable.{os.getpid()}"
    try:
        probe.touch()
        probe.unlink()
    except OSError as error:
        remedy = "make it writable, free space, or choose another folder"
        got = (error.strerror or str(error)).lower()
        raise input_error(root, "", got, "a writable folder", remedy) from None


def planned_unit(plan: Plan, root: Path, index: int) -> PlannedUnit:
    """Return unit ``index`` of the plan of ``root``. Raises :class:`InputError` if there is none."""
    if not 0 <= index < len(plan.units):
        raise input_error(root, "unit", index, f"0 to {len(plan.units) - 1}", "correct the index")
    return plan.units[index]


def worker_main(connection: Connection, root: str, threads: int, stages: tuple[str, ...]) -> None:
    """Main function of a worker process: receive unit indices, run the units, and send the outcomes."""
    signals: list[int] = []
    parent = os.getppid()
    for number in STOP_SIGNALS:  # Ctrl-C and queues signal all processes; the parent stops its workers
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: signals.append(number))
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, str(threads))
    folder = DatasetFolder(Path(root))
    context = _WorkerContext(folder, threads)
    while True:
        try:
            message = connection.recv()
        except (EOFError, OSError):
            return  # the parent has ended
        if message is None:
            return
        index, log = message
        try:
            with _redirected_output(Path(log)):
                outcome = _run_one(
                    context,
                    index,
                    stages,
                    report=lambda *progress: connection.send(("progress", *progress)),
                    should_stop=lambda: bool(signals) or os.getppid() != parent,
                )
        except OSError as error:  # no space for a log
            outcome = _outcome_of(error, folder.root)
        memory = psutil.Process().memory_info().rss / 2**20
        try:
            connection.send(("outcome", *outcome, memory))
        except OSError:
            return


def _outcome_of(error: Exception, root: Path) -> tuple[str, str]:
    """Return the outcome of a unit that raised ``error``, "full" (the disk) or "failed", and the reason."""
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        return "full", str(Problem(error.filename or root, "", (error.strerror or str(error)).lower()))
    return "failed", f"{type(error).__name__}: {error}"


@contextmanager
def _redirected_output(log: Path) -> Iterator[None]:
    """Append the process's stdout and stderr, even of native code, to a log file."""
    log.parent.mkdir(parents=True, exist_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    outputs = {number: os.dup(number) for number in (1, 2)}
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(file, 1)
    os.dup2(file, 2)
    os.close(file)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for number, saved in outputs.items():
            os.dup2(saved, number)
            os.close(saved)


class _WorkerContext:
    """Plan, recipe and library of a process, and its number of ``threads``."""

    def __init__(self, folder: DatasetFolder, threads: int):
        self.folder = folder
        self.plan = folder.read_plan()
        self.recipe = folder.read_recipe()
        self.library = Library(folder.library_paths())
        self.threads = threads


def _run_one(
    context: _WorkerContext,
    index: int,
    stages: tuple[str, ...],
    report: Callable[[str, int, int], None],
    should_stop: Callable[[], bool],
) -> tuple[str, str]:
    """Run a unit; return "done", "already", "interrupted", "failed" or "full" (the disk), and the reason."""
    from datagen.farm.work_unit import Interrupted, UnitRun, run_unit

    try:
        select_variant(context.plan.variant)
        import drjit as dr

        dr.set_thread_count(context.threads)
        run = UnitRun(
            folder=context.folder,
            unit=context.plan.units[index],
            recipe=context.recipe,
            library=context.library,
            versions=context.plan.versions,
            variant=context.plan.variant,
            report=report,
            should_stop=should_stop,
        )
        return ("done" if run_unit(run, stages) else "already"), ""
    except Interrupted:
        return "interrupted", ""
    except InputError as error:
        print(error, file=sys.stderr)
        return "failed", str(error)
    except Exception as error:  # a worker must survive any exception of a unit; the trace is in its log
        outcome, reason = _outcome_of(error, context.folder.root)
        if outcome == "full":
            print(reason, file=sys.stderr)
        else:
            traceback.print_exc()
        return outcome, reason


def run_unit_here(
    root: Path, index: int, stages: tuple[str, ...], report: Callable[[str, int, int], None]
) -> int:
    """Run one unit in this process, for job scripts and to reproduce failures.

    Returns the exit code: 0 if done, 75 if stopped by SIGTERM, SIGINT or SIGUSR1 (run it again), 1 if failed.
    """
    signals: list[int] = []
    for number in STOP_SIGNALS:
        signal.signal(number, lambda number, _: signals.append(number))
    context = _WorkerContext(DatasetFolder(root), num_threads())
    unit = planned_unit(context.plan, root, index)
    if context.folder.is_done(unit):
        return 0  # before importing the renderer, which takes most of the time of a task without work
    check_writable(root)
    check_variant(context.plan.variant)
    outcome, _ = _run_one(context, index, stages, report, lambda: bool(signals))
    return {"done": 0, "already": 0, "interrupted": EXIT_INTERRUPTED}.get(outcome, 1)

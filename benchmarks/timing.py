# SPDX-License-Identifier: MIT
"""Times the benchmarks (warm-up, interleaved repeats, medians, quartiles) and writes their reports."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from datagen.formats.recipe import Recipe

Action = Callable[[], Any]
REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = REPOSITORY / "benchmarks" / "results"


class Seconds(NamedTuple):
    """Seconds of wall time, and of processor time of all threads, which other processes hardly affect."""

    wall: float
    cpu: float


def timed(action: Action) -> Seconds:
    """Time of one call of ``action``, which must return only when its device has finished."""
    wall, cpu = time.perf_counter(), time.process_time()
    action()
    return Seconds(time.perf_counter() - wall, time.process_time() - cpu)


def interleaved(actions: Mapping[str, Action], repeats: int, warm_up: int = 1) -> dict[str, list[Seconds]]:
    """Times of ``repeats`` calls of each action, by name, after ``warm_up`` calls that are not measured.

    Actions run in turn, in reversed order every other time, so drift of the machine affects all of them
    equally; entries with the same index belong to one turn.
    """
    names = list(actions)
    found: dict[str, list[Seconds]] = {name: [] for name in names}
    for turn in range(warm_up + repeats):
        for name in names if turn % 2 else reversed(names):
            seconds = timed(actions[name])
            if turn >= warm_up:
                found[name].append(seconds)
    return found


def median_seconds(action: Action, repeats: int, clock: str = "wall") -> float:
    """Median seconds of ``action`` over ``repeats`` calls; ``clock``: ``wall`` or ``cpu``."""
    times = interleaved({"": action}, repeats)[""]
    return float(np.median([getattr(seconds, clock) for seconds in times]))


def summary(values: list[float], digits: int = 6) -> dict[str, Any]:
    """Median, interquartile range and number of ``values``."""
    low, median, high = (round(float(v), digits) for v in np.percentile(values, [25, 50, 75]))
    return {"median": median, "iqr": [low, high], "repeats": len(values)}


class Stopwatch:
    """Stopwatch for the stages of work that cannot be called separately."""

    def __init__(self) -> None:
        self.wall: dict[str, list[float]] = {}
        self.cpu: dict[str, list[float]] = {}

    @contextmanager
    def stage(self, name: str, share: int = 1) -> Iterator[None]:
        """Time a block of ``share`` equal parts, and record the time of one part."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.wall.setdefault(name, []).append((time.perf_counter() - wall) / share)
        self.cpu.setdefault(name, []).append((time.process_time() - cpu) / share)

    def result(self) -> dict[str, Any]:
        """Medians and interquartile ranges by stage."""
        return {
            name: {"wall_s": summary(self.wall[name], 4), "cpu_s": summary(self.cpu[name], 4)}
            for name in self.wall
        }


def machine() -> dict[str, Any]:
    """Name of the processor, number of cores, and version of Python, by name."""
    model = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.is_file():
        lines = information.read_text(encoding="utf-8").splitlines()
        model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), model)
    return {"processor": model, "cores": os.cpu_count(), "python": platform.python_version()}


def markdown(head: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Markdown table with the columns ``head``, without a final newline."""
    lines = ["| " + " | ".join(map(str, row)) + " |" for row in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def planned_folder(folder: Path, recipe: Recipe, path: Path, stdout: int | None = None) -> Path:
    """Plan ``recipe``, written to ``path``, unless ``folder`` contains its plan; returns ``folder``."""
    from datagen.formats.base import canonical_json

    if not (folder / "plan.json").is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(canonical_json(recipe))  # JSON is YAML
        command = [sys.executable, "-m", "datagen", "plan", str(path), "--out", str(folder)]
        subprocess.run(command, check=True, cwd=REPOSITORY, stdout=stdout)
    return folder


def launch(
    *command: str, log: Path, is_module: bool = True, environment: Mapping[str, str] | None = None
) -> None:
    """Run a command or Python module with its output in ``log``; ``RuntimeError`` if it fails."""
    start, variables = [sys.executable, "-m"] if is_module else [], {**os.environ, **(environment or {})}
    with log.open("ab") as out:
        done = subprocess.run(
            [*start, *command], cwd=REPOSITORY, stdout=out, stderr=subprocess.STDOUT, env=variables
        )
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}; see {log}")


def write_report(
    report: Any, out: Path | None, *, is_printed: bool = True, indent: int = 1, sort_keys: bool = False
) -> None:
    """Print a report as JSON if ``is_printed``, and write it to ``out`` if given."""
    text = json.dumps(report, indent=indent, sort_keys=sort_keys)
    if is_printed:
        print(text)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text + "\n", encoding="utf-8")

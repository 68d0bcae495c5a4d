# SPDX-License-Identifier: MIT
"""The timing harness: order of calls, warm-up, summaries and reports."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.timing import Seconds, Stopwatch, interleaved, median_seconds, summary, timed, write_report


def test_actions_alternate_and_warm_ups_are_not_counted() -> None:
    calls: list[str] = []
    found = interleaved({name: lambda n=name: calls.append(n) for name in "ab"}, 3, 1)  # type: ignore[misc]
    assert calls == ["b", "a", "a", "b", "b", "a", "a", "b"]
    assert {name: len(times) for name, times in found.items()} == {"a": 3, "b": 3}


@pytest.fixture
def wait(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Action that advances patched clocks: wall time by 3 s and processor time by 1 s.

    Real processor time would include threads that earlier tests left running.
    """
    now = {"perf_counter": 5.0, "process_time": 7.0}
    for clock in now:
        monkeypatch.setattr(time, clock, lambda clock=clock: now[clock])

    def waits() -> None:
        now["perf_counter"] += 3.0
        now["process_time"] += 1.0

    return waits


def test_wall_and_processor_time_are_told_apart(wait: Callable[[], None]) -> None:
    assert timed(wait) == Seconds(wall=3.0, cpu=1.0)
    assert median_seconds(wait, 3) == 3.0
    assert median_seconds(wait, 3, "cpu") == 1.0


def test_summary_has_median_and_quartiles() -> None:
    assert summary([1.0, 2.0, 3.0, 4.0, 100.0]) == {"median": 3.0, "iqr": [2.0, 4.0], "repeats": 5}


def test_time_is_divided_into_stages(wait: Callable[[], None]) -> None:
    watch = Stopwatch()
    with watch.stage("wait", share=2):
        wait()
    assert (watch.wall, watch.cpu) == ({"wait": [1.5]}, {"wait": [0.5]})
    found = watch.result()["wait"]
    assert (found["wall_s"]["median"], found["cpu_s"]["median"]) == (1.5, 0.5)


def test_report_is_printed_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_report({"a": 1}, tmp_path / "new" / "report.json")
    text = (tmp_path / "new" / "report.json").read_text()
    assert json.loads(text) == {"a": 1} and capsys.readouterr().out == text
    write_report({"a": 2}, None, is_printed=False)
    assert not capsys.readouterr().out

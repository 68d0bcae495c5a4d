# SPDX-License-Identifier: MIT
"""The timing harness: order of calls, warm-up, summaries and reports."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from benchmarks.timing import Stopwatch, interleaved, median_seconds, summary, timed, write_report


def test_actions_alternate_and_warm_ups_are_not_counted() -> None:
    calls: list[str] = []
    found = interleaved({name: lambda n=name: calls.append(n) for name in "ab"}, 3, 1)  # type: ignore[misc]
    assert calls == ["b", "a", "a", "b", "b", "a", "a", "b"]
    assert {name: len(times) for name, times in found.items()} == {"a": 3, "b": 3}


def test_waiting_takes_wall_time_and_no_processor_time() -> None:
    seconds = timed(lambda: time.sleep(0.05))
    assert seconds.wall >= 0.05 and seconds.cpu < 0.04
    assert median_seconds(lambda: time.sleep(0.02), 3) >= 0.02
    assert median_seconds(lambda: time.sleep(0.05), 3, "cpu") < 0.04


def test_summary_has_median_and_quartiles() -> None:
    assert summary([1.0, 2.0, 3.0, 4.0, 100.0]) == {"median": 3.0, "iqr": [2.0, 4.0], "repeats": 5}


def test_time_is_divided_into_stages() -> None:
    watch = Stopwatch()
    with watch.stage("sleep", share=2):
        time.sleep(0.04)
    assert watch.result()["sleep"]["wall_s"]["median"] == pytest.approx(watch.wall["sleep"][0], abs=1e-4)
    assert watch.wall["sleep"][0] >= 0.02


def test_report_is_printed_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_report({"a": 1}, tmp_path / "new" / "report.json")
    text = (tmp_path / "new" / "report.json").read_text()
    assert json.loads(text) == {"a": 1} and capsys.readouterr().out == text
    write_report({"a": 2}, None, is_printed=False)
    assert not capsys.readouterr().out

# SPDX-License-Identifier: MIT
"""Progress is shown by bars on a terminal and otherwise by lines at intervals and at stage changes."""

from __future__ import annotations

import pytest
from rich.console import Console

from datagen.foundation import progress
from datagen.foundation.progress import Bars, duration


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [1000.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def _lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Return the printed lines without the time of day."""
    return [line.split(" ", 1)[1] for line in capsys.readouterr().err.splitlines()]


def test_a_long_stage_prints_its_progress(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    with Bars("views") as bars:
        for done in range(10):  # 12 seconds per view
            bars.tell("room: render", done, 90)
            clock[0] += 12.0
        bars.tell("room: unwrap", 0, 1)
        bars.tell("room: unwrap", 1, 1, "done")
    rendered = [f"room: render: {done} of 90 views, 300/h" for done in (3, 6, 9)]
    assert _lines(capsys) == [*rendered, "room: unwrap: 0 of 1 views", "room: unwrap: 1 of 1 views, done"]


def test_a_short_stage_prints_one_line(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    with Bars() as bars:
        for done in range(3):
            bars.tell("plan", done, 2)
    assert _lines(capsys) == ["plan: 2 of 2"]


def test_an_error_ends_it_without_a_line(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError), Bars() as bars:
        bars.tell("plan", 0, 2)
        raise ValueError
    with Bars(is_quiet=True) as bars:
        bars.tell("plan", 2, 2)
        bars.say("nothing")
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_bars(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Every stage has a bar; with ``is_transient``, an error removes the bar of the unfinished stage."""
    monkeypatch.setattr(
        "rich.console.Console", lambda **_: Console(force_terminal=True, stderr=True, width=99)
    )
    with Bars("views") as bars:
        bars.tell("trace", 4, 4)
        bars.tell("merge", 1, 2, "kitchen")
        bars.say("a line [above]")
    shown = capsys.readouterr().err
    for text in ("trace", "4/4", "merge", "1/2", "views", "kitchen", "a line [above]"):
        assert text in shown
    with pytest.raises(ValueError), Bars(is_transient=True) as bars:
        bars.tell("trace", 1, 4)
        bars.tell("merge", 1, 2)
        capsys.readouterr()
        raise ValueError
    assert "merge" not in capsys.readouterr().err.rsplit("\x1b[2K", 1)[-1]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (119.0, "119 s"), (120.0, "2 min"), (7199.0, "120 min"), (7200.0, "2.0 h")],
)
def test_durations_as_text(seconds: float, text: str) -> None:
    assert duration(seconds) == text

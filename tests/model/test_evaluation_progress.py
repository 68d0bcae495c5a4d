# SPDX-License-Identifier: MIT
"""Where output is no terminal, a long stage says every half a minute where it is."""

from __future__ import annotations

import pytest

from model.evaluation import commands


def test_a_long_stage_is_not_silent(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    now = [1000.0]
    monkeypatch.setattr(commands.time, "monotonic", lambda: now[0])
    with commands._Stages() as stages:
        for done in range(10):  # a view in 12 seconds
            stages.tell("room: render", done, 90)
            now[0] += 12.0
        stages.tell("room: unwrap", 0, 1)
    said = [line.split(" ", 1)[1] for line in capsys.readouterr().err.splitlines() if "room" in line]
    shown = [f"room: render ({done} of 90)" for done in (0, 3, 6, 9)]
    assert said == [*shown, "room: unwrap (0 of 1)"]

# SPDX-License-Identifier: GPL-3.0-or-later
"""The export command: version, and progress by a bar on terminals, otherwise by a line per half minute."""

from __future__ import annotations

import sys

import pytest

from blender_addon import command
from blender_addon.assembly import Progress
from datagen.foundation.versions import DISTRIBUTION, pixel_versions


def test_the_command_prints_its_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        command.build_parser().parse_args(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"scene_materials {pixel_versions()[DISTRIBUTION]}\n"


@pytest.mark.parametrize("is_terminal", [False, True])
def test_an_export_prints_its_progress(
    is_terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [100.0]
    monkeypatch.setattr(command.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
    show = command.ProgressLine()
    for step in range(6):
        now[0] += 12.0
        show(Progress(step / 8, f"baking wood {step}"))
    show.end()
    output = capsys.readouterr().err
    if is_terminal:
        assert output.count("\r") == 7 and output.endswith("\r\033[K") and "62%" in output and "#" in output
    else:
        assert [line.split(" ", 1)[1].split() for line in output.splitlines()] == [
            ["25%", "108", "s", "left", "baking", "wood", "2"],
            ["62%", "43", "s", "left", "baking", "wood", "5"],
        ]

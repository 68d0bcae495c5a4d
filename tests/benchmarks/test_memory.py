# SPDX-License-Identifier: MIT
"""The memory benchmark needs at least one configuration for the warm-up and one more for the growth."""

from __future__ import annotations

import sys

import pytest

from benchmarks import bench_memory


@pytest.mark.parametrize("warm_up", ["0", "3"])
def test_a_warm_up_without_growth_is_refused(
    warm_up: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["bench_memory", "--configurations", "3", "--warm-up", warm_up])
    monkeypatch.setattr(bench_memory, "measure", lambda count, *_: pytest.fail(f"measured {count}"))
    with pytest.raises(SystemExit):
        bench_memory.main()
    assert "--warm-up: expected 1 to 2" in capsys.readouterr().err

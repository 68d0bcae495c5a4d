# SPDX-License-Identifier: GPL-3.0-or-later
"""The user's file is unchanged after an export, however it ends."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from blender_addon.command import REFUSED

pytestmark = pytest.mark.bpy


@pytest.fixture(scope="module")
def outcome(graphs_folder: Path, run_module: Callable[..., Any]) -> dict[str, Any]:
    return run_module("tests.blender_addon.untouched", str(graphs_folder))


def test_comparison_is_stable_and_detects_changes(outcome: dict[str, Any]) -> None:
    assert outcome["num_blocks"] > 30
    assert outcome["nothing"] == []
    assert any("changed" in line for line in outcome["twin"])
    assert any("location" in line for line in outcome["twin"])


@pytest.mark.parametrize("ending", ["success", "environment", "check", "report", "refused", "disk full"])
def test_file_is_unchanged(outcome: dict[str, Any], ending: str) -> None:
    assert outcome[ending] == []


def test_file_is_unchanged_after_cancelling_anywhere(outcome: dict[str, Any]) -> None:
    cancelled = {name: lines for name, lines in outcome.items() if name.startswith("cancelled")}
    assert len(cancelled) >= 5
    assert not any(cancelled.values()), cancelled


def test_a_full_disk_ends_the_command_with_a_message(outcome: dict[str, Any]) -> None:
    code, message = outcome["full disk in a command"]
    assert code == REFUSED
    assert message.splitlines()[-1].startswith("error: ") and "No space left on device" in message


def test_no_partial_package_is_left(outcome: dict[str, Any]) -> None:
    assert outcome["partial files"] == []

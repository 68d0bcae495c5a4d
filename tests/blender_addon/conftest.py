# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures that run Blender in separate processes: one per open file, and never together with Mitsuba."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import REPOSITORY
from tests.once import once


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests that need bpy if it is not installed."""
    if importlib.util.find_spec("bpy") is not None:
        return
    for item in items:
        if item.get_closest_marker("bpy") is not None:
            item.add_marker(pytest.mark.skip(reason="needs bpy: pip install '.[blender]' on Python 3.11"))


@pytest.fixture(scope="session")
def run_module() -> Callable[..., Any]:
    """Function that runs ``python -m MODULE ARGUMENTS`` and returns its last line of JSON, or None."""

    def run(module: str, *arguments: str, timeout: float = 300) -> Any:
        done = subprocess.run(
            [sys.executable, "-m", module, *arguments],
            cwd=REPOSITORY,
            capture_output=True,
            text=True,
            timeout=timeout,
        )
        assert done.returncode == 0, (done.stdout[-2000:] + done.stderr[-4000:]).strip()
        lines = [line for line in done.stdout.splitlines() if line.startswith(("{", "["))]
        return json.loads(lines[-1]) if lines else None

    return run


@pytest.fixture(scope="session")
def graphs_folder(tmp_path_factory: pytest.TempPathFactory, run_module: Callable[..., Any]) -> Path:
    """Folder with ``graphs.blend``, its images, and all its graphs exported under ``packages``."""

    def make() -> Path:
        folder = tmp_path_factory.mktemp("graphs")
        run_module("tests.blender_addon.graphs", str(folder))
        return folder

    return once("blender-graphs", make)

# SPDX-License-Identifier: MIT
"""Shared fixtures. Real scenes in ``../shared/data`` (or ``SCENE_DATA``) are optional."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from oracles import VARIANT
from tests.once import keep_in

REPOSITORY = Path(__file__).resolve().parents[1]
LONGEST = (
    "model/test_evaluation_small.py",
    "slurm/test_slurm.py",
    "datagen/test_farm_faults.py",
    "docs/test_commands.py",
    "model/test_reconstruction_infer.py",
    "model/test_light_network_scale.py",
)
"""Test files of over 90 s. They start first, so that none runs alone at the end. Only one of the first three
runs a reconstruction, because concurrent processes would each compile the same Numba loops."""
SHARED_DATA = Path(os.environ.get("SCENE_DATA", REPOSITORY.parent / "shared" / "data"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real scenes, furniture and textures; skips the test where it is absent."""
    if not (SHARED_DATA / "MANIFEST.md").is_file():
        pytest.skip(f"real test data not found at {SHARED_DATA} (set SCENE_DATA to its folder)")
    return SHARED_DATA


@pytest.fixture(scope="session", autouse=True)
def kept_results(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Share the results of :func:`tests.once.once` among the processes of the test run."""
    folder = tmp_path_factory.getbasetemp()
    keep_in((folder.parent if hasattr(request.config, "workerinput") else folder) / "once")


@pytest.fixture(scope="session")
def mitsuba_variant() -> str:
    """Select Mitsuba's variant before a test imports mitsuba."""
    from mitsuba_plugins.variant import select_variant

    return select_variant(VARIANT)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the tests of :data:`LONGEST` first."""
    order = {REPOSITORY / "tests" / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path, len(order)))

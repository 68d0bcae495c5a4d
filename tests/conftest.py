# SPDX-License-Identifier: MIT
"""Shared fixtures. Real scenes in ``../shared/data`` (or ``SCENE_DATA``) are optional."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from oracles import VARIANT

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED_DATA = Path(os.environ.get("SCENE_DATA", REPOSITORY.parent / "shared" / "data"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real scenes, furniture and textures; skips the test where it is absent."""
    if not (SHARED_DATA / "MANIFEST.md").is_file():
        pytest.skip(f"real test data not found at {SHARED_DATA} (set SCENE_DATA to its folder)")
    return SHARED_DATA


@pytest.fixture(scope="session")
def mitsuba_variant() -> str:
    """Select Mitsuba's variant before a test imports mitsuba."""
    from mitsuba_plugins.variant import select_variant

    return select_variant(VARIANT)

# SPDX-License-Identifier: MIT
"""Renders of imported scenes from their cameras against their authors' reference images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies.compare_references import compare_scene, table
from oracles.imported_renders import agreement

MIN_CORRELATION = 0.95
MAX_RATIO_ERROR = 0.10


def assert_agrees(result: dict) -> None:
    for pair in ("original", "converted"):
        assert result[pair]["correlation"] >= MIN_CORRELATION, table([result])
        assert abs(result[pair]["median_ratio"] - 1) <= MAX_RATIO_ERROR, table([result])


def test_agreement_depends_on_brightness_colour_and_shifts() -> None:
    rng = np.random.default_rng(2)
    v, u = np.meshgrid(np.linspace(0, 6, 72), np.linspace(0, 9, 128), indexing="ij")
    image = np.stack([1.2 + np.sin(u) * np.cos(v)] * 3, axis=-1).astype(np.float32)
    noisy = image * rng.gamma(16.0, 1 / 16, image.shape[:2])[..., None]
    same = agreement(noisy, image)
    assert same.correlation > 0.99
    assert same.median_ratio == pytest.approx(1, abs=0.02)
    assert agreement(noisy * 1.12, image).median_ratio == pytest.approx(1.12, abs=0.03)
    assert agreement(np.roll(image, 12, axis=1), image).correlation < MIN_CORRELATION
    small = image.repeat(2, axis=0).repeat(2, axis=1)
    assert agreement(image, small).rel_l1 < 1e-3


def test_a_hall_agrees_with_its_reference_at_low_resolution(
    tmp_path: Path, shared_data: Path, mitsuba_variant: str
) -> None:
    result = compare_scene(shared_data / "scenes" / "staircase2", tmp_path, width_px=72, num_samples=64)
    assert_agrees(result)
    assert result["conversion"]["correlation"] > 0.98
    assert abs(result["conversion"]["median_ratio"] - 1) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", ["staircase", "staircase2", "veach-ajar"])
def test_scenes_agree_with_their_references(
    tmp_path: Path, shared_data: Path, mitsuba_variant: str, name: str
) -> None:
    assert_agrees(compare_scene(shared_data / "scenes" / name, tmp_path, width_px=240, num_samples=512))

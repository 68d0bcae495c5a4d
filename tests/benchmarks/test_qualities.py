# SPDX-License-Identifier: MIT
"""Cost of the qualities relative to fixed sample counts of equal error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.bench_qualities import excesses
from datagen.tradeoff.selection import points_of
from datagen.tradeoff.sweep import Sweep
from tests.datagen.small_plan import plan_small
from tests.datagen.test_tradeoff import OPTIONS, point


def test_excess_of_qualities_is_compared_with_fixed_counts() -> None:
    fixed = [replace(point(k, 0.1 / k, path_samples=k), path_samples=float(k)) for k in (2, 8, 32)]
    clever = replace(point(6.0, 0.1 / 8, quality="standard"), path_samples=4.0)
    assert excesses([*fixed, clever]) == {
        "standard": {"path_samples": pytest.approx(0.5), "cpu_s": pytest.approx(0.75)}
    }


@pytest.mark.slow
def test_qualities_are_on_the_front_of_two_different_rooms(tmp_path: Path) -> None:
    """Cost is counted in light paths, because at this size kernel launches dominate a view's time."""
    folder = plan_small(tmp_path / "plan", tmp_path / "library", num_units=2, num_views=3).root
    options = replace(
        OPTIONS,
        configurations=(0, 1),
        size=(64, 48),
        reference_samples=1024,
        sweeps=("path_samples=2,4,8,16,32,64,128", "quality=draft,standard"),
    )
    found = excesses(points_of(Sweep(folder, tmp_path / "out", options).run()))
    assert set(found) == {"draft", "standard"}
    # the rooms are similar; each pass doubles the samples, so up to twice the necessary number is taken
    assert all(quality["path_samples"] < 2.0 for quality in found.values()), found

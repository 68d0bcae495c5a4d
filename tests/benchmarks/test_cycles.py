# SPDX-License-Identifier: MIT
"""Arithmetic of the comparison with Cycles at equal error, and one run on a tiny configuration."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from benchmarks.bench_cycles import agrees, extrapolated, interpolated, rank
from benchmarks.studies.cycles_scene import sky_image
from datagen.formats.lights import SkyLight
from datagen.library import Library
from tests.conftest import REPOSITORY


def test_interpolation_finds_the_sample_count_of_a_power_law() -> None:
    curve = {samples: 0.5 * samples**-0.7 for samples in (4, 8, 16, 32)}
    assert interpolated(curve, 0.5 * 21**-0.7) in (21, 22)  # 21, or 22 by rounding up
    assert interpolated(curve, curve[32]) == 32
    assert interpolated({4: 0.1}, 0.2) == 4
    assert interpolated({4: 0.1, 8: 0.1}, 0.1) == 8  # a flat curve is ambiguous: the larger count


def test_total_is_the_fixed_part_and_the_median_of_a_view() -> None:
    run = {"start_s": 2.0, "views_s": [5.0, 3.0, 3.0, 30.0], "wall_s": 44.0, "cpu_s": 88.0}
    result = extrapolated(run, 40)
    assert result["fixed_wall_s"] == 2.0 + (5.0 - 3.0) + 1.0  # start, the first view's excess, shutdown
    assert result["total_wall_s"] == 5.0 + 40 * 3.0
    assert result["total_cpu_s"] == 2 * 125.0
    assert result["is_extrapolated"]
    complete = extrapolated(run, 4)
    assert (complete["total_wall_s"], complete["is_extrapolated"]) == (44.0, False)


def test_renders_of_different_rooms_are_not_compared() -> None:
    same = {"ratio_of_means": [0.96, 1.1], "correlation": [0.95, 0.99]}
    assert agrees(same)
    assert not agrees({**same, "ratio_of_means": [0.96, 0.12]})
    assert not agrees({**same, "correlation": [0.99, 0.6]})


def test_the_baseline_is_the_fastest_at_the_error_or_the_nearest() -> None:
    fast, slow = ({"reached": True, "total_cpu_s": seconds, "rel_mse": 0.01} for seconds in (10.0, 20.0))
    near, far = ({"reached": False, "total_cpu_s": 1.0 / error, "rel_mse": error} for error in (0.02, 0.1))
    assert sorted([far, slow, near, fast], key=rank) == [fast, slow, near, far]


def test_cycles_gets_the_rendered_sky(tmp_path: Path, mitsuba_variant: str) -> None:
    light = SkyLight(name="sky", sun_direction=(0.5, -0.7, 0.5), turbidity=5.0, sky_scale=3.0, sun_scale=1.0)
    image = sky_image(light, Library([]))
    with OpenEXR.File({}, {"RGB": image}) as file:
        file.write(str(tmp_path / "sky.exr"))
    with OpenEXR.File(str(tmp_path / "sky.exr")) as file:
        read = file.channels()["RGB"].pixels
    assert np.array_equal(read, image)  # OpenEXR ignores strides, so the image must be contiguous
    above, horizon = image[: len(image) // 4].mean(axis=(0, 1)), image[len(image) // 2 - 2].mean(axis=0)
    assert above[2] > above[0] and horizon.sum() > above.sum()


@pytest.mark.slow
@pytest.mark.bpy
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="needs bpy: pip install '.[blender]'")
def test_both_renderers_on_a_tiny_configuration(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.bench_cycles", "--out", str(tmp_path), "--size", "96", "64"]
    command += ["--views", "4", "--quality", "draft", "--error-views", "2", "--reference-samples", "64"]
    command += ["--cycles-views", "3", "--max-cycles-samples", "16"]
    command += ["--qualities", "draft", "standard"]
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True)
    (result,) = json.loads((tmp_path / "bench_cycles.json").read_text())
    # room and light are equal; only material models and Blender's clamp differ
    assert all(0.8 < ratio < 1.2 for ratio in result["agreement"]["ratio_of_means"])
    assert min(result["agreement"]["correlation"]) > 0.9
    curve = [result["cycles"]["curve"][key] for key in sorted(result["cycles"]["curve"], key=int)]
    assert curve[-1] < 0.8 * curve[0]  # fireflies in tiny views may raise the error at a single doubling
    assert 0 < result["ours"]["rel_mse"] < 0.1
    assert result["cycles"]["total_wall_s"] > result["cycles"]["a_view_wall_s"] * 4
    text = (tmp_path / "bench_cycles.md").read_text()
    draft, standard = (result["qualities"][name] for name in ("draft", "standard"))
    assert standard["rel_mse"] < draft["rel_mse"] < 2 * result["ours"]["rel_mse"]
    assert min(draft["images_an_hour"], *result["cycles"]["images_an_hour"].values()) > 10
    assert (tmp_path / "bench_cycles.png").stat().st_size > 10_000
    assert text.count("| ours") == 2 and "| Cycles" in text and "4 views of 96x64" in text

    steps = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json") if path.parent != tmp_path}
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True)
    assert {path: path.stat().st_mtime_ns for path in steps} == steps  # finished views are not rendered again

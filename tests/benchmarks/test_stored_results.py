# SPDX-License-Identifier: MIT
"""Benchmarks reuse stored results only for equal options."""

from __future__ import annotations

import json
import subprocess
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest

from benchmarks import bench_cycles, bench_qualities
from benchmarks.bench_memory import draw_configuration
from benchmarks.bench_recorded_error import reference_paths
from benchmarks.studies import colmap_end_to_end
from datagen.formats.base import canonical_json
from datagen.library import Library


def test_other_error_views_are_rendered_by_cycles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stub replaces Cycles and records the requested views."""
    rendered: list[tuple[str, ...]] = []

    def note(_module: str, _command: str, _blend: str, out: str, *views: str, **_: Any) -> dict[str, float]:
        rendered.append(views[: views.index("--samples")])
        Path(out).mkdir(exist_ok=True)
        times = {"loaded": 1.0, "finished": [2.0 + k for k in range(len(rendered[-1]))], "blender": "4.5"}
        (Path(out) / "times.json").write_text(json.dumps(times))
        return {"began": 0.0, "wall_s": 3.0, "cpu_s": 3.0}

    monkeypatch.setattr(bench_cycles, "timed", note)
    monkeypatch.setattr(bench_cycles.Comparison, "cycles_error", lambda *_: 0.01)
    values = {"views": 4, "size": (96, 64), "quality": "draft", "max_cycles_samples": 4}
    for count in (1, 2, 1):
        arguments = Namespace(out=tmp_path, error_views=count, cycles_views=3, **values)
        bench_cycles.Comparison(arguments, seed=1).cycles_at(0.1, {}, "fixed")
    assert rendered == [("2",), ("0", "1", "2"), ("0", "2"), ("0", "1", "2")]


def test_another_number_of_configurations_is_planned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stub replaces the planner and records the number of configurations."""
    planned: list[int] = []

    def plan(command: list[str], **_: Any) -> None:
        planned.append(json.loads(Path(command[4]).read_text())["configurations"])
        Path(command[6]).mkdir()
        (Path(command[6]) / "plan.json").touch()

    monkeypatch.setattr(subprocess, "run", plan)
    folders = [bench_qualities.planned_rooms(tmp_path, count) for count in (2, 1, 2)]
    assert planned == [2, 1]
    assert folders[0] == folders[2] != folders[1]


def test_other_cameras_are_photographed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stub replaces the planner."""

    def plan(*command: str, log: Path) -> None:
        folder = Path(command[-1]) / "configurations"
        folder.mkdir(parents=True)
        configuration = draw_configuration(Library([]), 0, 1, (96, 64))
        (folder / "0.json").write_bytes(canonical_json(configuration))

    monkeypatch.setattr(colmap_end_to_end, "launch", plan)
    for views, size in ((3, (48, 32)), (2, (48, 40))):
        steps = colmap_end_to_end.EndToEnd(tmp_path, views, size, 0, 0, "true", "512")
        cameras = steps.configuration().cameras
        assert [(camera.width_px, camera.height_px) for camera in cameras] == [size] * views


def test_references_of_other_views_and_sizes_have_other_paths(tmp_path: Path) -> None:
    chosen = ((2, (96, 64), 64), (2, (96, 48), 64), (3, (96, 64), 64), (2, (96, 64), 32))
    paths = [
        reference_paths(draw_configuration(Library([]), 0, views, size), "study", 0, samples, tmp_path)
        for views, size, samples in chosen
    ]
    assert len({path for found in paths for path in found}) == sum(map(len, paths))

# SPDX-License-Identifier: MIT
"""Stages of ``materials infer``: their results, unchanged inputs, and the release of memory."""

from __future__ import annotations

import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.foundation.errors import InputError
from datagen.foundation.images import read_image
from datagen.geometry.views import TracedCapture
from model.reconstruction import infer as infer_module
from model.reconstruction.albedo_level import leveled
from model.reconstruction.infer import InferOptions, infer, map_stages
from model.reconstruction.light.map_stage import lit
from model.reconstruction.predict.sources import TRUTH, CheckpointMaps, GivenMaps
from model.reconstruction.stages import Estimate, Maps, Run
from oracles.textured_room import MapSource, room_capture
from tests.model.test_light_infer import untrained

OPTIONS = InferOptions(atlas=64, has_exr=False, is_checked=False)
PREDICTED = replace(TRUTH, identity="as if predicted", is_predicted=True)


def _diffuse(out: Path) -> NDArray:
    return read_image(out / "atlas" / "diffuse_albedo.png")


def test_only_predictions_are_corrected() -> None:
    source = CheckpointMaps(Path("weights.safetensors"))
    assert map_stages(source, OPTIONS) == [leveled, lit]
    assert map_stages(source, replace(OPTIONS, materials="network")) == [leveled]
    assert map_stages(source, replace(OPTIONS, is_leveled=False)) == [lit]
    assert map_stages(TRUTH, OPTIONS) == []


def test_a_stage_runs_between_prediction_and_merge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stage gets the traced capture and the maps; its result is merged, and its inputs are unchanged."""
    capture = room_capture(2, (32, 24))
    given: list[Maps] = []

    def darker(traced: TracedCapture, estimate: Estimate, run: Run) -> Estimate:
        assert [view.name for view in traced.views] == [view.name for view in capture.views]
        assert run.report.name == capture.name and traced.geometry.scene is not None
        given.extend(estimate.maps)
        dark = [{**m, "diffuse_albedo": m["diffuse_albedo"] * np.float32(0)} for m in estimate.maps]
        return replace(estimate, maps=dark)

    infer(capture, tmp_path / "plain", TRUTH, OPTIONS)
    monkeypatch.setattr(infer_module, "map_stages", lambda source, options: [darker])
    infer(capture, tmp_path / "darker", PREDICTED, OPTIONS)
    assert _diffuse(tmp_path / "plain").max() > 100 and _diffuse(tmp_path / "darker").max() == 0
    truth = [view.source.read_maps(("diffuse_albedo",))["diffuse_albedo"] for view in capture.views]
    for maps, expected in zip(given, truth, strict=True):
        np.testing.assert_array_equal(maps["diffuse_albedo"], np.clip(expected, 0, 1))


def test_traced_views_and_maps_are_freed_before_the_merge(tmp_path: Path) -> None:
    """A stage's views and maps are freed when it returns, although no list of them is cleared explicitly."""
    held: dict[str, list[weakref.ref]] = {"traced": [], "maps": []}
    alive: list[str] = []
    told: set[tuple[str, int]] = set()

    def read(traced: TracedCapture) -> list[Maps]:
        maps = TRUTH.read(traced)
        held["traced"] = [weakref.ref(view.geometry.normal_world) for view in traced.views]
        held["maps"] = [weakref.ref(m["specular_albedo"]) for m in maps]
        return maps

    def tell(stage: str, done: int, total: int) -> None:
        told.add((stage, total))
        if stage == "merge":
            alive.extend(name for name, refs in held.items() if any(ref() is not None for ref in refs))

    infer(room_capture(2, (32, 24)), tmp_path, GivenMaps("kept", read), OPTIONS, tell)
    assert len(held["traced"]) == len(held["maps"]) == 2 and alive == []
    assert {("unwrap", 1), ("pack", 1), ("fill", 400), ("images", 4)} <= told


def test_memory_of_a_killed_run_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(infer_module, "MEMORY_ATLAS", 32)
    (tmp_path / ".atlas-killed").mkdir()
    (tmp_path / ".atlas-killed" / "map").write_bytes(b"large")
    infer(room_capture(2, (32, 24)), tmp_path, TRUTH, OPTIONS)
    assert not list(tmp_path.glob(".atlas-*"))


def test_an_interrupted_run_leaves_no_report_of_an_earlier_one(tmp_path: Path) -> None:
    def stop(stage: str, done: int, total: int) -> None:
        if stage == "images":
            raise KeyboardInterrupt

    infer(room_capture(2, (32, 24)), tmp_path, TRUTH, OPTIONS)
    assert (tmp_path / "report.json").is_file()
    with pytest.raises(KeyboardInterrupt):
        infer(room_capture(2, (32, 24)), tmp_path, TRUTH, replace(OPTIONS, atlas=96), stop)
    assert not (tmp_path / "report.json").exists()


def test_maps_are_not_reused_for_other_photographs_or_statistics(tmp_path: Path) -> None:
    """Stored maps depend on the photographs' values and on the visibility test of their statistics."""
    source = untrained(tmp_path, 3)
    options = replace(OPTIONS, materials="network", is_leveled=False)
    capture = room_capture(2, (32, 24))
    infer(capture, tmp_path / "out", source, options)
    infer(capture, tmp_path / "out", source, replace(options, weights="none"))
    first, second = capture.views
    maps = second.source.read_maps(("diffuse_albedo",))
    darker = replace(second, source=MapSource({"diffuse_albedo": 0.5 * maps["diffuse_albedo"]}))
    for other, changed in (
        (replace(capture, views=(first, darker)), options),
        (capture, replace(options, visibility="trace")),
    ):
        with pytest.raises(InputError, match="other work"):
            infer(other, tmp_path / "out", source, changed)

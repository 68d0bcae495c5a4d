# SPDX-License-Identifier: MIT
"""Rechecks of views by plain path tracing find injected errors and biases and no others."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.formats.shard import Dataset, View
from datagen.formats.view import ViewRecord
from datagen.foundation.errors import InputError
from datagen.inspection import verify
from datagen.inspection.findings import Report
from datagen.inspection.recheck import Rechecked, compared, recheck
from datagen.inspection.verify import verify_command
from datagen.library import Library
from tests.datagen.small_rendered import rendered_dataset

SIZE = (96, 128)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> Path:
    return rendered_dataset(tmp_path_factory)


@pytest.fixture(scope="module")
def record(dataset: Path) -> ViewRecord:
    view = next(iter(Dataset(dataset).views()))
    return view.record.model_copy(
        update={"render": view.record.render.model_copy(update={"estimated_rel_mse": 0.004})}
    )


def against(record: ViewRecord, image: NDArray, noise: float = 0.1) -> Rechecked:
    """Recheck ``image`` against four images of radiance 1 with relative noise ``noise``."""
    return compared(View(record, {"beauty": image}), noisy_parts(np.random.default_rng(4), noise))


def noisy_parts(rng: np.random.Generator, noise: float) -> list[NDArray[np.float64]]:
    return [np.repeat(1.0 + rng.normal(0.0, noise, (*SIZE, 1)), 3, axis=-1) for _ in range(4)]


def image_with(noise: float, level: float = 1.0) -> NDArray[np.float64]:
    return level * (1.0 + np.random.default_rng(5).normal(0.0, noise, (*SIZE, 3)))


def test_the_noise_of_plain_paths_adds_nothing(record: ViewRecord) -> None:
    perfect = against(record, image_with(0.0), noise=0.3)
    assert abs(perfect.rel_mse) < 3 * perfect.rel_mse_error < 0.01
    assert abs(perfect.bias) < 3 * perfect.bias_error < 0.01
    known = against(record, image_with(0.08))
    assert known.rel_mse == pytest.approx(0.0064, rel=0.1)


def test_stated_standard_errors_match_repetitions(record: ViewRecord) -> None:
    image, rng, found = image_with(0.1), np.random.default_rng(8), []
    for _ in range(40):
        found.append(compared(View(record, {"beauty": image}), noisy_parts(rng, 0.3)))
    for figure in ("rel_mse", "bias"):
        spread = np.std([getattr(one, figure) for one in found], ddof=1)
        assert spread == pytest.approx(np.mean([getattr(one, f"{figure}_error") for one in found]), rel=0.5)


@pytest.mark.parametrize(
    ("noise", "level", "expected"),
    [
        (0.05, 1.0, []),
        (0.1, 1.0, []),  # 2.5 times the recorded error
        (0.16, 1.0, ["relMSE"]),  # 6 times the recorded error
        (0.05, 0.96, []),
        (0.05, 1.07, ["% from plain paths"]),
    ],
)
def test_faults_are_named_and_no_others(
    record: ViewRecord, noise: float, level: float, expected: list[str]
) -> None:
    faults = list(against(record, image_with(noise, level)).faults())
    assert len(faults) == len(expected) and all(e in f.got for e, f in zip(expected, faults, strict=True))
    assert all(fault.check == "recheck" and fault.severity == "warning" for fault in faults)


def test_views_of_a_dataset_agree_with_plain_paths(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert verify_command(dataset, recheck=3, recheck_samples=64, as_json=True) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["applied"]["recheck"] == len(report["rechecked"]) == 3
    views = {(v["configuration"], v["view"]) for v in report["rechecked"]}
    assert len(views) == 3
    for view in report["rechecked"]:
        # truncation after 8 segments loses 3 % of the light in this bright, closed room
        assert -0.05 < view["bias"] < -0.01 and 0.0 < view["bias_error"] < 0.003
        assert 0.5 * view["recorded"] < view["rel_mse"] < 4 * view["recorded"]
    assert verify_command(dataset, recheck=1, recheck_samples=8) == 0
    table = capsys.readouterr().out
    assert "against 8 plain paths per pixel" in table and "true relMSE" in table


def test_unsupported_rechecks_are_reported_before_the_dataset_is_verified(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verify, "verify_dataset", lambda *_: pytest.fail("it has been verified"))
    with pytest.raises(InputError, match="recheck-samples = 6; expected a multiple of 4"):
        verify_command(dataset, recheck=1, recheck_samples=6)
    shard = Dataset(dataset).shard_paths()[0]
    with pytest.raises(InputError, match="expected a dataset folder"):
        verify_command(shard, recheck=1)
    shutil.copytree(dataset, tmp_path / "copy", ignore=shutil.ignore_patterns("dataset.json"))
    with pytest.raises(InputError, match="name it with --library"):
        verify_command(tmp_path / "copy", recheck=1)
    (tmp_path / "empty").mkdir()
    nothing = Report("")
    assert recheck(dataset, Library([tmp_path / "empty"]), 2, 4, nothing) == []
    assert "is missing or has changed" in nothing.notes[0] and nothing.applied["recheck"] == 0


@pytest.mark.parametrize("damaged", ["index.json", "shards"])
def test_faults_are_reported_if_a_damaged_dataset_is_rechecked(
    dataset: Path, damaged: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(dataset, copy)
    for path in [copy / damaged] if damaged != "shards" else sorted((copy / damaged).iterdir()):
        path.write_bytes(path.read_bytes()[:2000])
    library = [dataset.parent / "library"]
    assert verify_command(copy, library, recheck=4, recheck_samples=4, as_json=True) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["num_errors"] and any("rendered again" in note for note in report["notes"])

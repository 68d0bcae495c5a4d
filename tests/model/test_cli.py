# SPDX-License-Identifier: MIT
"""The command ``materials``: help without heavy imports, dry run, training, and messages for bad input."""

from __future__ import annotations

import subprocess
import sys

import pytest
from typer.testing import CliRunner

from datagen.foundation.errors import InputError
from model.cli import app
from tests.conftest import REPOSITORY
from tests.model.training_data import make_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    splits = {"room-0": ("train", 4), "room-1": ("validation", 1)}
    return make_dataset(tmp_path_factory.mktemp("data") / "set", splits)


def _loaded(module: str, names: set[str]) -> set[str]:
    """Subset of ``names`` that a new interpreter has loaded after importing ``module``."""
    code = f"import sys, {module}; print(*sorted(sys.modules))"
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True, text=True)
    return names & set(result.stdout.split())


def test_help_imports_nothing_heavy():
    assert _loaded("model.cli", {"torch", "mitsuba", "numpy", "bpy"}) == set()
    result = CliRunner().invoke(app, ["--help"])
    assert result.exit_code == 0
    assert "train" in result.output and "infer" in result.output


def test_training_reads_neither_mitsuba_nor_bpy():
    assert _loaded("model.training.dry_run", {"mitsuba", "bpy", "torch"}) == {"torch"}


def test_dry_run_prints_sizes_memory_and_time_and_writes_nothing(dataset, tmp_path):
    out = tmp_path / "run"
    arguments = ["train", str(dataset), "--out", str(out), "--preset", "smoke", "--dry-run"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    counts = "4 training and 1 validation views, 64 x 48"
    for text in ("batch_size: 2", counts, "diffuse track: ", "GiB", "in all about"):
        assert text in result.output
    assert not out.exists()


def test_train_and_bad_input(dataset, tmp_path):
    arguments = ["train", str(dataset), "--out", str(tmp_path / "run"), "--preset", "smoke"]
    arguments += ["--quiet", "--device", "cpu"]
    short = ["--set", "phases=[{name: diffuse, steps: 1}]", "--set", "validation.num_views=0"]
    result = CliRunner().invoke(app, arguments + short)
    assert result.exit_code == 0, result.output
    assert result.output.strip().endswith("final.safetensors")
    result = CliRunner().invoke(app, [*arguments, "--set", "batch_size=0"])
    assert isinstance(result.exception, InputError) and "batch_size" in str(result.exception)
    result = CliRunner().invoke(
        app, ["train", str(tmp_path), "--out", str(tmp_path / "b"), "--preset", "smoke"]
    )
    assert isinstance(result.exception, InputError) and "index.json" in str(result.exception)


def test_training_without_validation_views_prints_a_note(tmp_path):
    """A note is printed unless validation is off."""
    data = make_dataset(tmp_path / "set", {"room-0": ("train", 4)})
    arguments = ["train", str(data), "--out", str(tmp_path / "run"), "--preset", "smoke", "--quiet"]
    arguments += ["--device", "cpu", "--set", "phases=[{name: diffuse, steps: 1}]"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert result.output.count("no validation: the data has no views of the split `validation`") == 1
    assert "splits: {train: 0.9, validation: 0.1}" in result.output
    assert "no validation:" in CliRunner().invoke(app, [*arguments, "--dry-run"]).output
    off = CliRunner().invoke(app, [*arguments, "--set", "validation.num_views=0", "--dry-run"])
    assert off.exit_code == 0 and "no validation:" not in off.output


def test_training_with_validation_views_prints_no_note(dataset, tmp_path):
    arguments = ["train", str(dataset), "--out", str(tmp_path / "run"), "--preset", "smoke", "--dry-run"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0 and "no validation:" not in result.output


@pytest.mark.parametrize(
    ("capture", "options"),
    [
        ("a.tar", "--unit 0.01 --up y --mesh-up y --mesh a.ply --images . --encoding srgb --exposure common"),
        ("capture.json", "--unit 0.01 --up y --mesh-up y --encoding srgb --library ."),
        ("asset.zip", "--unit 0.01 --up y --mesh-up y --mesh a.ply --library ."),
        ("transforms.json", "--library ."),
    ],
)
def test_options_without_meaning_for_a_capture_are_refused(tmp_path, capture, options):
    """Regression: such options were ignored."""
    (tmp_path / capture).write_text("")
    with pytest.raises(InputError, match="no such option for") as caught:
        CliRunner().invoke(app, ["check", str(tmp_path / capture), *options.split()], catch_exceptions=False)
    found = {problem.field for problem in caught.value.problems}
    assert found == {word for word in options.split() if word.startswith("--")}


@pytest.mark.parametrize("option", ["--checkpoint a", "--materials light", "--no-filter", "--no-level"])
def test_options_without_meaning_for_ground_truth_are_refused(tmp_path, option):
    """Regression: all of these options except ``--checkpoint`` were ignored."""
    command = ["infer", str(tmp_path / "a.tar"), "--out", str(tmp_path), "--truth", *option.split()]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2 and "has no effect with --truth" in result.output
    assert option.split()[0] in result.output

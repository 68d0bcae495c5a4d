# SPDX-License-Identifier: MIT
"""The command ``datagen``, from a recipe to verified shards, and its messages."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.formats.shard import Dataset
from datagen.inspection import doctor
from tests.conftest import REPOSITORY
from tests.datagen.small_library import write_small_library
from tests.small_disk import small_disk

RECIPE = """
format: scene-materials/recipe
version: 1
name: small
seed: 3
configurations: 2
views: 3
resolution: [96, 64]
objects: {count: [2, 3]}
cameras: {min_content: 2}
render: {path_samples: 4, auxiliary_samples: 8}
"""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("command")
    write_small_library(root / "library")
    (root / "small.yaml").write_text(RECIPE)
    return root


def _datagen(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "datagen", *map(str, arguments)]
    env = {**os.environ, **environment}
    return subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, env=env)


def test_from_a_recipe_to_verified_shards(inputs: Path) -> None:
    out = inputs / "out"
    run = ("run", inputs / "small.yaml", "--library", inputs / "library", "--out", out, "--workers", 2)
    first = _datagen(*run)
    assert first.returncode == 0, first.stderr
    assert "2 shards, 6 views" in first.stdout
    index = json.loads((out / "index.json").read_text())
    assert index["is_complete"] and index["num_views"] == 6 and index["splits"] == {"train": 2}
    assert all(asset["license"] == "CC0-1.0" for asset in index["assets"].values())
    assert len(list((out / "sheets").glob("*.png"))) == 2
    views = list(Dataset(out).views("train"))
    assert len(views) == 6 and all(view.buffers["beauty"].shape == (64, 96, 3) for view in views)
    verified = _datagen("verify", out)
    assert verified.returncode == 0, verified.stdout
    status = _datagen("farm", "status", out)
    assert "2 done" in status.stdout
    again = _datagen(*run)
    assert again.returncode == 0 and "(0 new)" in again.stdout


@pytest.mark.parametrize("views", [3, pytest.param(5, marks=pytest.mark.slow)], ids=["one", "two samples"])
def test_estimate_predicts_before_anything_large_starts(inputs: Path, views: int) -> None:
    recipe = inputs / "split.yaml"
    text = RECIPE.replace("views: 3", f"views: {views}")
    recipe.write_text(text + "splits: {train: 0.5, validation: 0.5, test: 0.0}\n")
    result = _datagen("estimate", recipe, "--library", inputs / "library", "--json")
    assert result.returncode == 0, result.stderr
    estimate = json.loads(result.stdout)
    assert estimate["num_views"] == 2 * views
    actual = json.loads((inputs / "out" / "index.json").read_text())["num_bytes"] * views / 3
    assert 0.5 * actual < estimate["total_bytes"] < 2 * actual
    assert 200 < estimate["peak_memory_mb"] < 4000
    assert estimate["total_seconds"] > 0


def test_dry_run_prints_the_resolved_recipe_and_writes_nothing(inputs: Path, tmp_path: Path) -> None:
    result = _datagen("run", inputs / "small.yaml", "--out", tmp_path / "x", "--views", 5, "--dry-run")
    assert result.returncode == 0 and "views: 5" in result.stdout and "max_depth: 8" in result.stdout
    assert not (tmp_path / "x").exists()


def test_doctor_prints_the_environment() -> None:
    result = _datagen("doctor")
    assert result.returncode == 0, result.stdout
    assert "rendering" in result.stdout and "works" in result.stdout


@pytest.mark.parametrize("has_weights", [True, False])
def test_doctor_reports_a_gpu_without_denoiser(monkeypatch: pytest.MonkeyPatch, has_weights: bool) -> None:
    listed = subprocess.CompletedProcess([], 0, stdout="NVIDIA H200, 143771 MiB\n")
    monkeypatch.setattr(doctor, "has_cuda", lambda: True)
    monkeypatch.setattr(doctor, "uses_optix", lambda variant: has_weights)
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: listed)
    finding = doctor.gpu_finding()
    assert finding.value.startswith("NVIDIA H200, 143771 MiB") and finding.is_fine == has_weights
    assert ("NVIDIA_DRIVER_CAPABILITIES" in finding.remedy) != has_weights


def test_doctor_survives_programs_that_do_not_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "blender"
    broken.write_text("an incomplete download")
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))  # without nvidia-smi, like containers without "utility"
    monkeypatch.setattr(doctor, "has_cuda", lambda: True)
    monkeypatch.setattr(doctor, "uses_optix", lambda variant: True)
    assert doctor.gpu_finding() == doctor.Finding("GPU", "NVIDIA driver found", True, False)
    finding = doctor.program_finding("Blender", *doctor.PROGRAMS["Blender"])
    assert not finding.is_fine and str(broken) in finding.value and "blender.org" in finding.remedy


@pytest.mark.parametrize("module", ["datagen", "model.cli"])
def test_the_commands_print_their_version(module: str) -> None:
    command = [sys.executable, "-m", module, "--version"]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert re.fullmatch(r"scene-materials (\d+\.\d+\.\d+.*|absent)\n", output)


NO_LLVM = {"DRJIT_LIBLLVM_PATH": "/nothing/libLLVM.so", "SCENE_MATERIALS_VARIANT": "llvm_ad_rgb"}


@pytest.mark.parametrize("verb", ["plan", "run", "dry run", "estimate"])
def test_without_llvm_one_message_appears_before_work_starts(inputs: Path, tmp_path: Path, verb: str) -> None:
    out = tmp_path / "out"
    words = {"dry run": ["run", "--out", out, "--dry-run"], "estimate": ["estimate"]}
    verb, *options = words.get(verb, [verb, "--out", out])
    result = _datagen(verb, inputs / "small.yaml", "--library", inputs / "library", *options, **NO_LLVM)
    assert result.returncode == 2 and not result.stdout
    (sentence,) = [line for line in result.stderr.splitlines() if line and "time samples" not in line]
    assert sentence.startswith("LLVM: DRJIT_LIBLLVM_PATH = /nothing/libLLVM.so, no loadable LLVM")
    assert sentence.endswith("its libLLVM shared library") and not out.exists()


def test_doctor_reports_a_missing_llvm() -> None:
    listed = " ".join(_datagen("doctor", COLUMNS="400", **NO_LLVM).stdout.split())
    assert "/nothing/libLLVM.so, no loadable LLVM of 16 or later; expected LLVM 19 or later" in listed
    assert "apt-get install libllvm19" in listed


def test_without_llvm_a_planned_folder_is_unchanged(inputs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    recipe = ("--library", inputs / "library", "--configurations", 1, "--out", out)
    assert _datagen("plan", inputs / "small.yaml", *recipe).returncode == 0
    before = sorted(out.rglob("*"))
    for verb in (["--only", "render"], ["--unit", 0, "--attempts", 0], ["--unit", 0]):
        result = _datagen("run", out, *verb, **NO_LLVM)
        assert result.returncode in (1, 2) and "Traceback" not in result.stderr
        assert result.stderr.count("apt-get install libllvm19") == 1, result.stderr
        assert [p for p in sorted(out.rglob("*")) if p.parts[-2:] != ("out", "work")] == before


@pytest.mark.parametrize("verb", ["plan", "run"])
def test_a_dry_run_checks_the_libraries(inputs: Path, tmp_path: Path, verb: str) -> None:
    options = ("--out", tmp_path / "out", "--dry-run")
    result = _datagen(verb, inputs / "small.yaml", "--library", inputs / "library", *options)
    assert result.returncode == 0 and "configurations: 2" in result.stdout, result.stderr
    result = _datagen(verb, inputs / "small.yaml", "--library", tmp_path / "nope", *options)
    assert result.returncode == 2 and "nope: no such folder" in result.stderr
    (tmp_path / "wrong.yaml").write_text(RECIPE.replace("count: [2, 3]", "count: [2, 3], categories: [ship]"))
    result = _datagen(verb, tmp_path / "wrong.yaml", "--library", inputs / "library", *options)
    assert result.returncode == 2 and "ship" in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_small_disk_is_reported_before_anything_is_rendered(inputs: Path, tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 2) as disk:
        out = disk.root / "out"
        words = ["run", inputs / "small.yaml", "--library", inputs / "library", "--views", 3, "--out", out]
        refused = _datagen(*words)
        assert refused.returncode == 2 and "--no-space-check" in refused.stderr, refused.stderr
        assert "MB; expected about" in refused.stderr and not (out / "work").exists()
        disk.fill(leave=150_000)
        begun = _datagen(*words, "--no-space-check")
        assert begun.returncode == 1 and "no space left on device" in begun.stderr, begun.stderr
        assert "Traceback" not in begun.stderr

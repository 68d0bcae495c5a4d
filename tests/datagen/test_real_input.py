# SPDX-License-Identifier: MIT
"""The recipe ``real``, which recombines an imported scene, scanned furniture and photographed materials."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import yaml

from datagen.formats.shard import Dataset
from tests.conftest import REPOSITORY


def _datagen(*arguments: object) -> str:
    command = [sys.executable, "-m", "datagen", *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_imported_assets_are_recombined_rendered_and_verified(shared_data: Path, tmp_path: Path) -> None:
    library = tmp_path / "library"
    furniture = shared_data / "furniture" / "living_room_polyhaven" / "assets"
    output = _datagen(
        "import", shared_data / "scenes" / "staircase2", "--library", library, "--dielectric", "replace"
    )
    assert "CC-BY-3.0" in output and "approximated:" in output
    _datagen("import", furniture / "painted_wooden_stool_1k.gltf", "--library", library)
    for name in ("rock", "marble"):
        shutil.copytree(shared_data / "textures" / "ambientcg" / name, tmp_path / "textures" / name)
    _datagen("import", tmp_path / "textures", "--library", library)

    recipe = yaml.safe_load((REPOSITORY / "scenes" / "recipes" / "real.yaml").read_text())
    recipe.update(
        configurations=1,
        views=3,
        resolution=[128, 80],
        objects={"count": [1, 3]},
        render={"path_samples": 4, "auxiliary_samples": 16},
    )
    path = tmp_path / "real.yaml"
    path.write_text(yaml.safe_dump(recipe))
    out = tmp_path / "out"
    _datagen("run", path, "--library", library, "--out", out)
    views = list(Dataset(out).views(names=["beauty", "diffuse_albedo", "observation_count", "surface_mask"]))
    assert len(views) == 3
    for view in views:
        is_surface = view.buffers["surface_mask"][..., 0] > 0.5
        assert is_surface.mean() > 0.5
        assert view.buffers["observation_count"][is_surface].min() >= 1
    used = Dataset(out).index.assets
    assert used["staircase2"].license == "CC-BY-3.0"
    assert any(asset.kind == "object" for asset in used.values())
    _datagen("verify", out)

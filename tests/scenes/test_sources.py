# SPDX-License-Identifier: MIT
"""The library's sources rebuild the bundled assets to the byte, and tiled textures have no seams."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from datagen.formats.asset import MaterialAsset
from datagen.foundation.bundled import bundled_library
from datagen.foundation.images import read_image
from datagen.library import Library
from tests.conftest import REPOSITORY

needs_bpy = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None, reason="needs bpy: pip install '.[blender]' on Python 3.11"
)


def run_sources(*arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "scenes.sources", *arguments],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=1500,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@needs_bpy
@pytest.mark.bpy
def test_rebuilding_gives_the_same_bytes(tmp_path: Path) -> None:
    names = {"beech": "materials", "chrome": "materials", "mug": "objects", "frame_portrait": "objects"}
    run_sources("build", "--out", str(tmp_path), *(word for name in names for word in ("--only", name)))
    for name, kind in names.items():
        assert content(tmp_path / kind / name) == content(bundled_library() / kind / name), name


@needs_bpy
@pytest.mark.bpy
@pytest.mark.slow
def test_rebuilding_everything_gives_the_same_bytes(tmp_path: Path) -> None:
    run_sources("build", "--out", str(tmp_path))
    built, bundled = content(tmp_path), content(bundled_library())
    assert sorted(built) == sorted(name for name in bundled if not name.startswith("panoramas/"))
    assert [name for name in built if built[name] != bundled[name]] == []


@needs_bpy
@pytest.mark.bpy
def test_reducing_maps_again_gives_the_same_panoramas(shared_data: Path, tmp_path: Path) -> None:
    """Poly Haven's maps yield equal bytes; those that Blender includes differ between its versions."""
    bpy = importlib.util.find_spec("bpy")
    assert bpy is not None and bpy.origin is not None
    (blender,) = Path(bpy.origin).parent.glob("*/datafiles/studiolights/world")
    maps = ("--maps", str(shared_data / "hdri"), "--blender-maps", str(blender))
    run_sources("panoramas", *maps, "--out", str(tmp_path))
    made, bundled = content(tmp_path / "panoramas"), content(bundled_library() / "panoramas")
    assert sorted(made) == sorted(bundled)
    with Library([bundled_library()]) as library:
        sources = {p.id: p.asset.provenance.source for p in library.select("panorama")}
    of_blender = {name for name, source in sources.items() if source.startswith("Blender")}
    assert 0 < len(of_blender) < len(sources) / 2
    differing = {name.partition("/")[0] for name in made if made[name] != bundled[name]}
    assert differing <= of_blender


@needs_bpy
@pytest.mark.bpy
def test_every_source_is_bundled_and_vice_versa() -> None:
    listed = [line.split() for line in run_sources("list").splitlines()]
    with Library([bundled_library()]) as library:
        bundled = {(package.asset.kind, package.id) for package in library}
    assert {(kind, name) for kind, name in listed} == bundled


def seam(pixels: np.ndarray) -> float:
    """Ratio of the step across the texture's border to the largest inner step, for the worse axis.

    A step is the mean absolute difference of two adjacent rows or columns of texels.
    """
    worst = 0.0
    for axis in (0, 1):
        if pixels.shape[axis] < 8:
            continue
        steps = np.abs(pixels - np.roll(pixels, 1, axis=axis)).mean(axis=(1 - axis, 2))
        worst = max(worst, float(steps[0] / max(steps[1:].max(), 2 / 255)))
    return worst


def tiled_textures() -> list[tuple[str, np.ndarray]]:
    found = []
    with Library([bundled_library()]) as library:
        for package in library:
            if isinstance(package.asset, MaterialAsset):
                for texture in package.asset.material.textures():
                    path = package.local_file(texture.texture)
                    pixels = np.asarray(read_image(path), dtype=np.float64)
                    pixels = pixels if pixels.ndim == 3 else pixels[..., None]
                    found.append((f"{package.id}/{path.name}", pixels))
    return found


def test_tiled_textures_have_no_seam() -> None:
    textures = tiled_textures()
    assert len(textures) > 120
    seams = {name: round(seam(pixels), 2) for name, pixels in textures}
    assert {name: value for name, value in seams.items() if value > 1.35} == {}


def test_a_seam_is_detected() -> None:
    """Injected fault: with 5 % of each texture cut off, over a quarter of the textures have a seam."""
    textures = tiled_textures()
    large = [p for _, p in textures if min(p.shape[:2]) >= 32]
    cut = [seam(p[: int(0.95 * len(p)), : int(0.95 * p.shape[1])]) for p in large]
    assert np.mean(np.array(cut) > 1.35) > 0.25

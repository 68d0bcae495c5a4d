# SPDX-License-Identifier: GPL-3.0-or-later
"""Exported lights in Mitsuba agree with Cycles, and exported cameras with Blender's projection."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.asset_check import check_package
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.package import open_package
from datagen.foundation.cameras import Camera
from tests.blender_addon.lights_and_cameras import CAMERAS, CLIP, LIGHTS

pytestmark = pytest.mark.bpy
TOLERANCE = {"world_image_turned": 0.02, "world_graph": 0.02}
MITSUBA_SAMPLES = 128


@pytest.fixture(scope="module")
def cycles(tmp_path_factory: pytest.TempPathFactory, run_module: Callable[..., Any]) -> tuple[Path, Any]:
    folder = tmp_path_factory.mktemp("lights")
    return folder, run_module("tests.blender_addon.lights_and_cameras", str(folder))


@pytest.fixture(scope="module")
def rendered(cycles: tuple[Path, Any], run_module: Callable[..., Any]) -> Path:
    folder, _ = cycles
    run_module(
        "tests.blender_addon.render_packages",
        str(folder / "packages"),
        str(folder / "mitsuba"),
        str(MITSUBA_SAMPLES),
        *LIGHTS,
        CLIP,
    )
    return folder


def _ratio(folder: Path, name: str) -> tuple[np.ndarray, float]:
    """Return ratios of mean radiance, Mitsuba / Cycles, of channels with light, and the relative error."""
    ours, theirs = np.load(folder / "mitsuba" / f"{name}.npy"), np.load(folder / "cycles" / f"{name}.npy")
    lit = theirs.mean(axis=(0, 1)) > 0
    ratio = ours.mean(axis=(0, 1))[lit] / theirs.mean(axis=(0, 1))[lit]
    return ratio, float(np.abs(ours - theirs).mean() / theirs.mean())


@pytest.mark.parametrize("name", LIGHTS)
def test_light_matches_cycles(rendered: Path, name: str) -> None:
    assert not check_package(open_package(rendered / "packages" / name)).errors
    ratio, difference = _ratio(rendered, name)
    assert np.abs(ratio - 1).max() < TOLERANCE.get(name, 0.01), ratio
    assert difference < 0.08, f"the images differ by {difference:.1%} where their means agree"


def test_light_five_percent_off_is_detected(rendered: Path) -> None:
    ratio, _ = _ratio(rendered, "area_square")
    assert np.abs(ratio * 1.05 - 1).max() > 0.01


def test_camera_clips_like_cycles(rendered: Path) -> None:
    (camera,) = open_package(rendered / "packages" / CLIP).asset.cameras
    assert camera.clip_m == pytest.approx((1.0, 3.2))
    ours, theirs = np.load(rendered / "mitsuba" / f"{CLIP}.npy"), np.load(rendered / "cycles" / f"{CLIP}.npy")
    assert min(ours.min(), theirs.min()) > 0.03, "neither card nor wall: they are black"
    sky = np.isclose(theirs, (0.3, 0.4, 0.6), rtol=1e-3).all(axis=-1)
    assert 0.1 < sky.mean() < 0.9, "the floor ends at the far limit"
    assert np.abs(ours[sky] - theirs[sky]).mean() < 0.01
    assert np.abs(ours.mean(axis=(0, 1)) / theirs.mean(axis=(0, 1)) - 1).max() < 0.01


@pytest.mark.parametrize("name", CAMERAS)
def test_camera_projects_like_blender(cycles: tuple[Path, Any], name: str) -> None:
    folder, projections = cycles
    asset = open_package(folder / "packages" / f"camera_{name}").asset
    assert isinstance(asset, EnvironmentAsset)
    (entry,) = asset.cameras
    camera = Camera(
        entry.width_px,
        entry.height_px,
        entry.fx_px,
        entry.fy_px,
        entry.cx_px,
        entry.cy_px,
        np.array(entry.asset_from_camera),
    )
    points = np.array([sample["point"] for sample in projections[name]])
    wanted = np.array([sample["pixel"] for sample in projections[name]])
    got, depth = camera.project(points)
    assert (depth > 0).all()
    error = np.abs(got - wanted).max()
    assert error < 0.1, f"{error:.3f} px"
    moved = Camera(
        *(getattr(camera, k) for k in ("width_px", "height_px")),
        camera.fx_px * 1.05,
        camera.fy_px,
        camera.cx_px,
        camera.cy_px,
        camera.world_from_camera,
    )
    assert np.abs(moved.project(points)[0] - wanted).max() > 0.1

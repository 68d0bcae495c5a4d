# SPDX-License-Identifier: GPL-3.0-or-later
"""Refusals name node and remedy, normals bake to textures, and the fidelity report compares renderings."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.formats.asset import MaterialAsset, ObjectAsset, Texture
from datagen.formats.package import open_package
from datagen.foundation.images import read_image
from tests.blender_addon.policies import REFUSED, normal_image

pytestmark = pytest.mark.bpy


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory, run_module: Callable[..., Any]) -> tuple[Path, Any]:
    folder = tmp_path_factory.mktemp("policies")
    return folder, run_module("tests.blender_addon.policies", str(folder))


@pytest.mark.parametrize("name", REFUSED)
def test_refused_by_name(outcome: tuple[Path, Any], name: str) -> None:
    fragment, _ = REFUSED[name]
    errors = outcome[1]["refused"][name]
    matching = [e for e in errors if fragment in e["message"]]
    if name == "script" and not matching:
        assert any("changes with the camera" in e["message"] for e in errors)
        return
    assert matching, errors
    assert all(e["remedy"] for e in matching)
    assert any(name in (e["material"], e["object"]) or repr(name) in e["message"] for e in matching)


def _normals(folder: Path, name: str) -> np.ndarray:
    package = open_package(folder / "normals" / name)
    assert isinstance(package.asset, ObjectAsset)
    (material,) = package.asset.materials.values()
    assert isinstance(material.normal, Texture)
    return read_image(package.path / material.normal.texture).astype(float) / 255


def test_normal_map_passes_through(outcome: tuple[Path, Any]) -> None:
    (texture,) = (outcome[0] / "normals" / "normal_map" / "textures").iterdir()
    originals = [path.read_bytes() for path in (outcome[0] / "images").iterdir()]
    assert texture.read_bytes() in originals
    assert np.array_equal(_normals(outcome[0], "normal_map"), normal_image())


def test_weakened_normal_map_bakes_at_the_size_of_its_image(outcome: tuple[Path, Any]) -> None:
    baked = _normals(outcome[0], "weak_normal_map")
    vectors = 2 * normal_image() - 1
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    vectors = 0.5 * vectors + [0, 0, 0.5]
    wanted = (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True) + 1) / 2
    step = wanted.shape[0] // baked.shape[0], wanted.shape[1] // baked.shape[1]
    assert min(step) >= 1
    coarse = wanted.reshape(baked.shape[0], step[0], baked.shape[1], step[1], 3).mean(axis=(1, 3))
    assert np.abs(baked - coarse).mean() < 2 / 255


def test_bump_has_the_slope_of_its_height(outcome: tuple[Path, Any]) -> None:
    """h = 0.05 sin(2 pi x): nx / nz = -dh/dx = -0.314 cos(2 pi x)."""
    baked = _normals(outcome[0], "bump")
    vectors = baked * 2 - 1
    slope = vectors[..., 0] / vectors[..., 2]
    border = 1 / 32  # margin of the UV layout
    x = ((np.arange(baked.shape[1]) + 0.5) / baked.shape[1] - border) / (1 - 2 * border)
    inside = (x > 0.02) & (x < 0.98)
    wanted = -0.05 * 2 * np.pi * np.cos(2 * np.pi * x)
    assert np.abs(slope - wanted[None, :])[:, inside].mean() < 0.02
    assert np.abs(slope - 1.3 * wanted[None, :])[:, inside].mean() > 0.02


def test_bump_of_a_material_package_has_its_slope_in_any_unit(outcome: tuple[Path, Any]) -> None:
    package = open_package(outcome[0] / "materials" / "bump")
    assert isinstance(package.asset, MaterialAsset)
    assert isinstance(package.asset.material.normal, Texture)
    vectors = read_image(package.path / package.asset.material.normal.texture).astype(float) / 255 * 2 - 1
    x = (np.arange(vectors.shape[1]) + 0.5) / vectors.shape[1]
    wanted = -0.05 * 2 * np.pi * np.cos(2 * np.pi * x)
    inside = (x > 0.02) & (x < 0.98)
    assert np.abs(vectors[..., 0] / vectors[..., 2] - wanted)[:, inside].mean() < 0.02


def test_report_compares_materials_lights_and_cameras(outcome: tuple[Path, Any]) -> None:
    text = Path(outcome[1]["report"]).read_text()
    assert "not rendered a second time" not in text, re.findall(r"</h1>\s*<p>(.*?)</p>", text, re.S)
    errors = dict(re.findall(r"<b>(.*?)</b>.*?<td class=\"number(?: over)?\">([\d.]+)%", text, re.S))
    assert errors.keys() == {"plain", "gradient", "lamp"}
    assert all(float(value) < 10 for value in errors.values()), errors
    assert float(errors["lamp"]) < 3
    assert text.count("data:image/png;base64,") == 3
    assert re.search(r"eye</td><td class=\"number\">0\.0\d+ px", text)
    assert outcome[1]["left"] == ["Scene", "gradient", "plain"]


def test_report_without_mitsuba_names_the_time_limit(outcome: tuple[Path, Any]) -> None:
    assert "slow_python took longer than" in outcome[1]["slow"]


def test_cameras_of_a_thousand_materials_are_sorted_by_name(outcome: tuple[Path, Any]) -> None:
    assert outcome[1]["camera names"] == sorted(outcome[1]["camera names"])

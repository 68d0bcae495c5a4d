# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights, world, cameras, markers and tags survive an import into Blender and another export."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datagen.formats.asset import EnvironmentAsset
from datagen.formats.package import open_package
from tests.blender_addon.places import ENVIRONMENT, LAMP

pytestmark = pytest.mark.bpy
RELATIVE, ABSOLUTE = 2e-5, 2e-6  # Blender stores positions, rotations and powers as float32


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, run_module: Callable[..., Any]) -> tuple[Path, Any]:
    folder = tmp_path_factory.mktemp("places")
    return folder, run_module("tests.blender_addon.places", str(folder))


def _differences(wanted: Any, got: Any, where: str = "") -> list[str]:
    """Return the differences of two JSON values, except those of numbers within float32 rounding."""
    if isinstance(wanted, dict) and isinstance(got, dict):
        keys = sorted(set(wanted) | set(got))
        return [d for k in keys for d in _differences(wanted.get(k), got.get(k), f"{where}.{k}")]
    if isinstance(wanted, list) and isinstance(got, list) and len(wanted) == len(got):
        pairs = enumerate(zip(wanted, got, strict=True))
        return [d for i, (a, b) in pairs for d in _differences(a, b, f"{where}[{i}]")]
    is_number = all(isinstance(v, int | float) and not isinstance(v, bool) for v in (wanted, got))
    if is_number and math.isclose(wanted, got, rel_tol=RELATIVE, abs_tol=ABSOLUTE):
        return []
    return [] if wanted == got else [f"{where}: {wanted!r} became {got!r}"]


def _descriptions(folder: Path, which: str, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    first, again = (
        json.loads((folder / stage / name / "asset.json").read_text()) for stage in ("first", which)
    )
    return first, again


@pytest.mark.parametrize("which", ["again", "in_centimetres"])
@pytest.mark.parametrize("name", [ENVIRONMENT, LAMP, "paint"])
def test_package_is_the_same_after_import_and_export(
    exported: tuple[Path, Any], which: str, name: str
) -> None:
    folder, found = exported
    assert found["remarks"][which] == []
    first, again = _descriptions(folder, which, name)
    assert _differences(first, again) == []


def test_the_first_export_is_complete(exported: tuple[Path, Any]) -> None:
    asset = open_package(exported[0] / "first" / ENVIRONMENT).asset
    assert isinstance(asset, EnvironmentAsset)
    assert {light.type for light in asset.lights} == {
        "point", "sphere", "spot", "directional", "area", "environment",
    }  # fmt: skip
    assert len(asset.support_surfaces) == len(asset.openings) == 1
    assert {slot.kind for slot in asset.light_slots} == {"area", "point"}
    assert len(asset.camera_regions) == len(asset.cameras) == 2
    assert asset.provenance.usage == "evaluation_only"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("incomplete", "KeyError: 'maximum_m'"),
        ("damaged.zip", "damaged.zip: not readable as a zip"),
        ("text.zip", "text.zip: not readable as a zip"),
    ],
)
def test_an_invalid_package_is_refused_and_leaves_nothing(
    exported: tuple[Path, Any], name: str, message: str
) -> None:
    error, changes = exported[1]["invalid"][name]
    assert message in error
    assert changes == []


def test_sample_of_a_material_is_as_wide_as_its_tile(exported: tuple[Path, Any]) -> None:
    assert exported[1]["sample_m"] == pytest.approx(0.5)


def test_image_of_the_world_keeps_its_bytes(exported: tuple[Path, Any]) -> None:
    folder, _ = exported
    first, _ = _descriptions(folder, "again", ENVIRONMENT)
    (path,) = (light["image"] for light in first["lights"] if light["type"] == "environment")
    stored = [(folder / which / ENVIRONMENT / path).read_bytes() for which in ("first", "again")]
    assert stored[0] == stored[1]


def test_a_one_per_cent_error_or_a_loss_is_detected(exported: tuple[Path, Any]) -> None:
    first, again = _descriptions(exported[0], "again", ENVIRONMENT)
    again["cameras"][0]["fx_px"] *= 1.01
    assert len(_differences(first, again)) == 1
    del again["lights"][0]
    assert len(_differences(first, again)) == 2

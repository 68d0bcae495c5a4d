# SPDX-License-Identifier: GPL-3.0-or-later
"""Every node graph of :mod:`tests.blender_addon.graphs`, as exported, agrees with its closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.asset_check import check_package
from datagen.formats.asset import ObjectAsset, Texture
from datagen.formats.package import Package, open_package
from datagen.foundation.images import read_image
from datagen.foundation.meshes.ply import decode_ply
from tests.blender_addon.graphs import CASES, Case
from tests.blender_addon.surface import channel_at, surface_samples

pytestmark = pytest.mark.bpy
TOLERANCE = 1 / 255


def _errors(package: Package, case: Case, name: str, seed: int) -> np.ndarray:
    """Return the absolute errors of a channel at random points of all parts where no NaN is expected."""
    asset = package.asset
    assert isinstance(asset, ObjectAsset)
    errors = []
    for index, part in enumerate(asset.parts):
        mesh = decode_ply((package.path / part.mesh).read_bytes(), part.mesh)
        points, uv = surface_samples(mesh, seed + index)
        matrix = np.array(part.asset_from_part)
        points = points @ matrix[:3, :3].T + matrix[:3, 3]
        got = channel_at(package, asset.materials[part.material], name, uv)
        wanted = case.expected[name]
        wanted = wanted(points) if callable(wanted) else np.broadcast_to(wanted, got.shape)
        difference = np.abs(got - wanted)
        errors.append(difference[np.isfinite(wanted)])
    return np.concatenate(errors)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_channels_match_closed_form(graphs_folder: Path, case: Case) -> None:
    package = open_package(graphs_folder / "packages" / case.name)
    report = check_package(package)
    assert not report.errors
    for name in case.expected:
        errors = _errors(package, case, name, seed=7)
        assert errors.mean() < TOLERANCE, f"{name}: mean error {errors.mean() * 255:.2f}/255"


@pytest.mark.parametrize("case", [c for c in CASES if c.kinds], ids=lambda case: case.name)
def test_constants_and_images_are_not_baked(graphs_folder: Path, case: Case) -> None:
    package = open_package(graphs_folder / "packages" / case.name)
    assert isinstance(package.asset, ObjectAsset)
    (material,) = package.asset.materials.values()
    for name, kind in case.kinds.items():
        value = getattr(material, name)
        if kind == "constant":
            assert not isinstance(value, Texture)
        else:
            assert isinstance(value, Texture)
            stored = (package.path / value.texture).read_bytes()
            originals = [path.read_bytes() for path in (graphs_folder / "images").iterdir()]
            assert stored in originals, "the image was resampled or encoded again"


def test_images_on_one_map_bake_once_at_their_own_size(graphs_folder: Path) -> None:
    package = open_package(graphs_folder / "packages" / "one_map_by_name_and_without")
    assert isinstance(package.asset, ObjectAsset)
    assert len(package.asset.parts) == 2
    (material,) = package.asset.materials.values()
    for channel in (material.diffuse_albedo, material.roughness):
        assert isinstance(channel, Texture)
        shape = read_image(package.path / channel.texture).shape
        assert max(shape[:2]) <= 64, "finer than the images"


def test_there_are_forty_graphs() -> None:
    assert len(CASES) >= 40


def test_a_wrong_closed_form_is_detected(graphs_folder: Path) -> None:
    """Injected fault: an expectation that is 5 % too large is detected."""
    case = next(c for c in CASES if c.name == "uv_as_colour")
    wrong = Case(
        case.name, case.build, {"diffuse_albedo": lambda p: case.expected["diffuse_albedo"](p) * 1.05}
    )
    errors = _errors(open_package(graphs_folder / "packages" / case.name), wrong, "diffuse_albedo", seed=7)
    assert errors.mean() > TOLERANCE


@pytest.mark.parametrize("name", ["generated_coordinates_of_a_box", "object_coordinates_under_modifiers"])
def test_smooth_values_on_charts_need_few_texels(graphs_folder: Path, name: str) -> None:
    """Only covered texels determine the resolution, so gaps between charts do not raise it."""
    package = open_package(graphs_folder / "packages" / name)
    assert isinstance(package.asset, ObjectAsset)
    (material,) = package.asset.materials.values()
    assert isinstance(material.diffuse_albedo, Texture)
    assert max(read_image(package.path / material.diffuse_albedo.texture).shape[:2]) <= 256

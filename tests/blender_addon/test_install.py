# SPDX-License-Identifier: GPL-3.0-or-later
"""The distributed extension is built, validated, installed and enabled; packages survive a round trip."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from blender_addon.command import REFUSED
from datagen.formats.asset import ObjectAsset
from datagen.formats.package import Package, open_package
from datagen.foundation.meshes.ply import decode_ply
from tests.blender_addon.install import MODULE, ROUND_TRIP
from tests.blender_addon.surface import channel_at, surface_samples

pytestmark = pytest.mark.bpy
CHANNELS = ("diffuse_albedo", "specular_albedo", "roughness", "opacity")


@pytest.fixture(scope="module")
def installed(
    tmp_path_factory: pytest.TempPathFactory, graphs_folder: Path, run_module: Callable[..., Any]
) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("extension")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BLENDER_USER_RESOURCES", str(folder / "user"))
        return folder, run_module("tests.blender_addon.install", str(folder), str(graphs_folder / "packages"))


def test_extension_validates_installs_and_enables(installed: tuple[Path, dict[str, Any]]) -> None:
    folder, outcome = installed
    assert "Success" in outcome["tool"]
    assert str(folder) in outcome["file"], "the repository's copy ran instead of the installed one"
    assert MODULE.rsplit(".", 1)[1] in outcome["file"]
    assert outcome["has_operators"]
    assert len(outcome["tagged"]) == 1
    assert outcome["disabled"]
    assert outcome["export"] == ["FINISHED"], outcome["problems"]


def test_command_of_blender_exports_like_the_operator(installed: tuple[Path, dict[str, Any]]) -> None:
    folder, outcome = installed
    assert outcome["is_command_registered"]
    assert outcome["is_command_unregistered"], "disabling the extension takes its command along"
    assert outcome["command"] == 0
    assert outcome["refused_command"] == REFUSED
    assert not any((folder / "refused").iterdir())
    wanted, got = (
        {str(path.relative_to(folder / which)): path.read_bytes() for path in (folder / which).rglob("*.*")}
        for which in ("again", "by_command")
    )
    assert wanted == got
    assert len(wanted) >= 2 * len(ROUND_TRIP)


def _values(package: Package, channel: str) -> list[np.ndarray]:
    """Return the values of a channel at random points of each part; equal meshes have equal points."""
    assert isinstance(package.asset, ObjectAsset)
    found = []
    for index, part in enumerate(package.asset.parts):
        mesh = decode_ply((package.path / part.mesh).read_bytes(), part.mesh)
        _, uv = surface_samples(mesh, seed=index)
        found.append(channel_at(package, package.asset.materials[part.material], channel, uv))
    return found


@pytest.mark.parametrize("name", ROUND_TRIP)
def test_package_survives_import_and_export(
    installed: tuple[Path, dict[str, Any]], graphs_folder: Path, name: str
) -> None:
    before = open_package(graphs_folder / "packages" / name)
    after = open_package(installed[0] / "again" / name)
    assert isinstance(before.asset, ObjectAsset)
    assert isinstance(after.asset, ObjectAsset)
    size = np.subtract(before.asset.maximum_m, before.asset.minimum_m)  # the import moves the origin
    assert np.allclose(size, np.subtract(after.asset.maximum_m, after.asset.minimum_m), atol=1e-5)
    assert [p.uv_per_m for p in before.asset.parts] == pytest.approx([p.uv_per_m for p in after.asset.parts])
    for channel in CHANNELS:
        for wanted, got in zip(_values(before, channel), _values(after, channel), strict=True):
            assert np.abs(wanted - got).mean() < 1 / 255, channel

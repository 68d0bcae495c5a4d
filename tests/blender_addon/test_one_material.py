# SPDX-License-Identifier: GPL-3.0-or-later
"""A Blender material that is baked for each mesh is still replaced and varied as one material."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datagen.assembly.materials import MeanMaterials, assign_materials, slots_by_material
from datagen.formats.asset import EnvironmentAsset, MaterialAsset
from datagen.formats.configuration import MaterialAssignment
from datagen.formats.package import Package, open_package
from datagen.formats.recipe import MaterialRecipe
from datagen.foundation.random import Draws
from datagen.library import Library
from tests.blender_addon.one_material import ROOM
from tests.datagen.small_library import write_small_library

pytestmark = pytest.mark.bpy


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, run_module: Callable[..., Any]) -> Path:
    folder = tmp_path_factory.mktemp("one_material")
    run_module("tests.blender_addon.one_material", str(folder))
    return folder


@pytest.fixture(scope="module")
def palette(tmp_path_factory: pytest.TempPathFactory) -> list[Package]:
    return Library([write_small_library(tmp_path_factory.mktemp("library"))]).select("material")


def room_of(folder: Path, stage: str) -> tuple[Package, EnvironmentAsset]:
    package = open_package(folder / stage / ROOM)
    assert isinstance(package.asset, EnvironmentAsset)
    return package, package.asset


@pytest.mark.parametrize("stage", ["first", "again"])
def test_bakes_record_their_origin(folder: Path, stage: str) -> None:
    _, room = room_of(folder, stage)
    origins = {slot: material.baked_from for slot, material in room.materials.items()}
    assert sorted(o for o in origins.values() if o) == ["oak"] * 2 + ["plaster"] * 3
    assert origins["paint"] is None
    textures = {str(m.diffuse_albedo) for m in room.materials.values() if m.baked_from}
    assert len(textures) == 5, "each mesh has its own bake"


@pytest.mark.parametrize("stage", ["first", "again"])
def test_surfaces_are_exported(folder: Path, stage: str) -> None:
    assert {s: m.surface for s, m in room_of(folder, stage)[1].materials.items() if m.surface} == {
        "paint": "furniture"
    }
    lacquer = open_package(folder / stage / "lacquer").asset
    assert isinstance(lacquer, MaterialAsset)
    assert lacquer.surfaces == ("legs", "frame")


def test_bakes_of_one_material_are_varied_and_replaced_together(folder: Path, palette: list[Package]) -> None:
    package, room = room_of(folder, "first")
    groups = slots_by_material(room)
    assert sorted(len(slots) for slots in groups) == [1, 2, 3]
    recipe, means = MaterialRecipe(replace_probability=0.5, vary_probability=1.0), MeanMaterials()
    seen: set[tuple[str, str | None]] = set()
    for seed in range(30):
        assigned = assign_materials(package, palette, recipe, means, Draws(seed))
        for slots in groups:
            (one,) = {assigned.get(slot, MaterialAssignment()).model_dump_json() for slot in slots}
            seen.add((slots[0], MaterialAssignment.model_validate_json(one).asset))
    assert len({asset for slot, asset in seen if "oak" in slot}) > 1, "never replaced or always"


def test_a_material_must_fit_every_bake(folder: Path, palette: list[Package]) -> None:
    package, room = room_of(folder, "first")
    stools = next(slots for slots in slots_by_material(room) if len(slots) == 2)
    fixed = room.materials[stools[1]].model_copy(update={"replaceable_by": ()})
    changed = room.model_copy(update={"materials": {**room.materials, stools[1]: fixed}})
    always = MaterialRecipe(replace_probability=1.0, vary_probability=0.0)
    package.asset = changed
    assert not set(stools) & set(assign_materials(package, palette, always, MeanMaterials(), Draws(1)))

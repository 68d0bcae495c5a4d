# SPDX-License-Identifier: MIT
"""Generated rooms are planned, stored in the dataset folder and rendered; old recipes are unaffected."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from datagen.assembly.generated import example_rooms, generated_room, room_of
from datagen.assembly.notes import unplaceable
from datagen.assembly.plan import NUM_TRIES, assemble
from datagen.assembly.splits import check_recipe
from datagen.farm.collect import collect
from datagen.farm.folder import DatasetFolder, library_of
from datagen.farm.local import LocalOptions, run_local
from datagen.farm.planning import create_plan
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.base import canonical_json, read_yaml
from datagen.formats.recipe import (
    CameraRecipe,
    EnvironmentRecipe,
    LightRecipe,
    MaterialRecipe,
    ObjectRecipe,
    ParametricRecipe,
    Recipe,
    RenderRecipe,
    SplitRecipe,
    Variation,
)
from datagen.formats.shard import Dataset
from datagen.foundation.bundled import bundled_library
from datagen.foundation.errors import InputError
from datagen.library import Library
from model.evaluation.drawn_room import draw_room
from model.reconstruction.captures.rendered import library_of as library_of_shard
from tests.conftest import REPOSITORY
from tests.datagen.small_library import write_small_library


def _recipe(**changes) -> Recipe:
    parametric = ParametricRecipe(kinds=("laundry", "hallway"))
    fields = {
        "name": "rooms",
        "seed": 3,
        "configurations": 2,
        "views": 1,
        "resolution": (48, 32),
        "environments": EnvironmentRecipe(parametric=parametric),
        "objects": ObjectRecipe(count=(0, 2)),
        "materials": MaterialRecipe(variation=Variation(likely=1.0)),
        "lights": LightRecipe(native_probability=1.0, area_probability=0.0, daylight_probability=0.0),
        "render": RenderRecipe(variant="llvm_ad_rgb", path_samples=2, auxiliary_samples=2),
    }
    return Recipe(**{**fields, **changes})


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    root = tmp_path_factory.mktemp("rooms") / "library"
    write_small_library(root)
    return Library([root])


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory, library: Library) -> DatasetFolder:
    root = tmp_path_factory.mktemp("planned") / "dataset"
    create_plan(_recipe(), library, root)
    return DatasetFolder(root)


def _files(folder: DatasetFolder) -> dict[str, bytes]:
    paths = [folder.plan_path, *folder.root.glob("configurations/*"), *folder.root.glob("rooms/*")]
    return {str(p.relative_to(folder.root)): p.read_bytes() for p in paths}


def test_recipes_without_generated_rooms_keep_their_bytes() -> None:
    text = canonical_json(Recipe(name="old", configurations=1, views=1)).decode()
    assert '"environments":{"exclude":[],"include":null}' in "".join(text.split())
    assert "parametric" not in text


def test_each_configuration_has_a_different_room(planned: DatasetFolder, library: Library) -> None:
    plan = planned.read_plan()
    rooms = [planned.read_configuration(unit).environment.asset for unit in plan.units]
    assert len(set(rooms)) == 2
    assert {p.stem for p in planned.rooms_path.iterdir()} == set(rooms)
    assert all(plan.assets[room].license == "CC0-1.0" for room in rooms)
    assert set(rooms) <= {package.id for package in Library(library_of(planned.root) or [])}


def test_bytes_do_not_depend_on_workers(planned: DatasetFolder, library: Library, tmp_path: Path) -> None:
    create_plan(_recipe(), library, tmp_path / "two", workers=2)
    assert _files(DatasetFolder(tmp_path / "two")) == _files(planned)


def test_assembly_is_a_pure_function(planned: DatasetFolder, library: Library) -> None:
    for index in (1, 0):
        configuration = assemble(_recipe(), index, library)
        assert canonical_json(configuration) == planned.configuration_path(configuration.id).read_bytes()


def test_a_lost_room_is_generated_again(planned: DatasetFolder, library: Library, tmp_path: Path) -> None:
    root = tmp_path / "copy"
    shutil.copytree(planned.root, root)
    before = _files(DatasetFolder(root))
    (root / "plan.json").unlink()
    next((root / "rooms").iterdir()).unlink()
    create_plan(_recipe(), library, root)
    assert _files(DatasetFolder(root)) == before


def test_a_folder_of_an_older_plan_revision_is_refused(
    planned: DatasetFolder, library: Library, tmp_path: Path
) -> None:
    root = tmp_path / "older"
    shutil.copytree(planned.root, root)
    record = json.loads((root / "dataset.json").read_bytes())
    record["versions"]["plan_revision"] = "0"
    (root / "dataset.json").write_text(json.dumps(record))
    with pytest.raises(
        InputError, match=r"version of plan_revision = \d+; expected 0, as when the run started"
    ):
        create_plan(_recipe(), library, root)


def test_plain_slots_get_materials(planned: DatasetFolder, library: Library) -> None:
    """Slots of constant colour are assigned a material wherever the library has a suitable one."""
    recipe = _recipe()
    for unit in planned.read_plan().units:
        configuration = planned.read_configuration(unit)
        room = room_of(recipe, configuration, NUM_TRIES)
        assert room is not None and isinstance(room.package.asset, EnvironmentAsset)
        materials = configuration.environment.materials
        assert {slot for _, slot in room.bare_slots} >= {"floor", "ceiling"}
        assigned = [materials[slot].asset for _, slot in room.bare_slots if slot in materials]
        assert assigned and all(asset is not None for asset in assigned)
        fixed = {slot for slot, m in room.package.asset.materials.items() if not m.replaceable_by}
        assert all(materials[slot].asset is None for slot in fixed & materials.keys())


def test_a_moved_dataset_renders(planned: DatasetFolder, tmp_path: Path) -> None:
    """The folder contains its rooms, so it can be moved."""
    root = tmp_path / "elsewhere"
    shutil.copytree(planned.root, root)
    summary = run_local(root, LocalOptions(workers=1))
    assert len(summary.done) == 2 and not summary.failures
    collect(root)
    views = list(Dataset(root).views(names=["beauty", "diffuse_albedo"]))
    assert len(views) == 2
    for view in views:
        assert np.isfinite(view.buffers["beauty"]).all() and view.buffers["beauty"].mean() > 0.01
    shard = next((root / "shards").glob("*.tar"))
    with library_of_shard(shard, ()) as found:
        assert any(package.id.startswith("room-") for package in found)


def test_share_mixes_generated_rooms_with_the_library(library: Library) -> None:
    recipe = _recipe(
        configurations=200,
        environments=EnvironmentRecipe(parametric=ParametricRecipe(share=0.25, kinds=("laundry",))),
    )
    drawn = [generated_room(recipe, index) is not None for index in range(40)]
    assert 3 <= sum(drawn) <= 20
    index = drawn.index(False)
    assert assemble(recipe, index, library).environment.asset in library


def test_disjoint_splits_need_library_rooms_only_where_they_are_used(library: Library) -> None:
    splits = SplitRecipe(train=0.5, validation=0.5, disjoint=True)
    nowhere = EnvironmentRecipe(include=(), parametric=ParametricRecipe())
    check_recipe(_recipe(splits=splits, objects=ObjectRecipe(count=(0, 0)), environments=nowhere), library)
    partly = nowhere.model_copy(update={"parametric": ParametricRecipe(share=0.5)})
    with pytest.raises(InputError, match="environments"):
        check_recipe(_recipe(environments=partly), library)


def test_rooms_of_a_dataset_are_a_library_for_others(planned: DatasetFolder, library: Library) -> None:
    rooms = Library([*library.paths, planned.rooms_path])
    made = sorted(package.id for package in rooms if package.id.startswith("room-"))
    recipe = _recipe(environments=EnvironmentRecipe(include=tuple(made[:1])))
    assert assemble(recipe, 0, rooms).environment.asset == made[0]


def test_suites_refuse_recipes_of_generated_rooms(library: Library, tmp_path: Path) -> None:
    source = tmp_path / "recipe.yaml"
    source.write_bytes(canonical_json(_recipe()))  # JSON is valid YAML
    with pytest.raises(InputError, match=r"environments\.parametric"):
        draw_room(source, 0, library, CameraRecipe(), (48, 32), 1, 1)


def test_unknown_kinds_are_refused() -> None:
    with pytest.raises(ValueError, match="kinds"):
        ParametricRecipe(kinds=("igloo",))  # type: ignore[arg-type]


def test_objects_of_the_library_fit_into_generated_rooms(library: Library) -> None:
    recipe = _recipe(environments=EnvironmentRecipe(include=(), parametric=ParametricRecipe(kinds=("cafe",))))
    assert next(example_rooms(recipe)).id.startswith("room-cafe-")
    assert len(unplaceable(recipe, library)) < len(library.select("object"))


def test_the_recipe_of_160_rooms_is_valid() -> None:
    recipe = read_yaml(Recipe, REPOSITORY / "scenes" / "recipes" / "rooms.yaml")
    assert recipe.configurations == 160 and not recipe.environments.needs_library
    with Library([bundled_library()]) as bundled:
        check_recipe(recipe, bundled)

# SPDX-License-Identifier: MIT
"""Test scenes: plausible cameras, ground truth with every photograph, no repeated work, and no checkpoint
trained on the scene."""

from __future__ import annotations

import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.assembly.free_space import FreeSpace
from datagen.assembly.geometry import WorldScene, load_geometry
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.lights import AreaLight
from datagen.formats.package import open_package
from datagen.formats.recipe import CameraRecipe
from datagen.formats.shard import ShardReader
from datagen.foundation.errors import InputError
from datagen.importers.common import ImportOptions
from datagen.importers.mitsuba_xml import import_mitsuba_scene
from datagen.library import Library
from model.checkpoint import CheckpointCard, DataRecord, bundled_checkpoint, read_card
from model.evaluation.photographer import choose_cameras
from model.evaluation.room import (
    PreparedScene,
    TestScene,
    assert_not_trained_on,
    plan_scene,
    prepare_scene,
)
from model.evaluation.suite import read_suite
from model.networks import NetworkConfig
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from tests.conftest import REPOSITORY

ROOM = REPOSITORY / "scenes" / "suites" / "small_room"
HEIGHTS = (1.1, 1.7)


def small_scene(**changes: object) -> TestScene:
    fields = {
        "name": "small-room",
        "source": ROOM / "room.xml",
        "views": 4,
        "novel_views": 2,
        "resolution": (48, 32),
        "render": {"path_samples": 2, "auxiliary_samples": 2},
        "cameras": {"height_m": HEIGHTS},
    }
    return TestScene.model_validate({**fields, **changes})


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> PreparedScene:
    return prepare_scene(small_scene(), tmp_path_factory.mktemp("scenes"))


def card(**assets: str) -> CheckpointCard:
    record = DataRecord(name="data", index_sha256="0", num_views=10, assets=assets)
    return CheckpointCard(network=NetworkConfig(), loss="l1", phase="joint", step=1, data=(record,))


def test_photographs_contain_the_ground_truth(prepared: PreparedScene) -> None:
    capture = read_capture(prepared.capture, CaptureOptions(library=prepared.library))
    names = [view.name for view in capture.views]
    assert names == [*prepared.input_names, *prepared.novel_names]
    assert prepared.input_names == ("view-000", "view-001", "view-002", "view-003")
    assert prepared.novel_names == ("path-000", "path-001")
    room = open_package(prepared.package).asset
    assert isinstance(room, EnvironmentAsset)
    (lamp,) = room.lights  # visible, and therefore part of the geometry
    assert isinstance(lamp, AreaLight) and capture.lights == ()
    part = capture.geometry.parts[-1]
    assert (part.name, part.emission) == (f"lights/{lamp.name}", lamp.radiance)
    copper = np.array(room.materials["copper"].specular_albedo, dtype=float)
    seen = np.zeros((0, 3))
    for view in capture.views:
        maps = view.source.read_maps(("specular_albedo", "roughness", "surface_mask", "beauty"))
        surface = maps["surface_mask"][..., 0] > 0.5
        assert surface.mean() > 0.5
        assert np.isfinite(maps["beauty"]).all() and maps["beauty"][surface].mean() > 0
        seen = np.concatenate([seen, maps["specular_albedo"][surface].astype(float)])
    assert np.abs(seen - copper).max(axis=1).min() < 0.01  # the scene's metal is in the truth


def test_a_finished_scene_is_not_prepared_again(prepared: PreparedScene) -> None:
    cache = prepared.library[0].parents[1]
    files = {path: path.stat().st_mtime_ns for path in cache.rglob("*") if path.is_file()}
    stages: list[str] = []
    again = prepare_scene(small_scene(), cache, lambda stage, done, total: stages.append(stage))
    assert again == prepared
    assert stages == []
    index = prepared.capture.parents[1] / "index.json"  # rewritten by every run
    kept = {p: t for p, t in files.items() if p.name not in ("index.json", "dataset.json", "recipe.yaml")}
    assert index.is_file() and kept
    assert {p: p.stat().st_mtime_ns for p in kept} == kept


def test_other_settings_have_another_folder(prepared: PreparedScene, tmp_path: Path) -> None:
    """The folder's name depends on all that determines pixels: the source's content, but not its path."""
    cache = prepared.library[0].parents[1]
    moved = tmp_path / "elsewhere"
    shutil.copytree(ROOM, moved)
    same = prepare_scene(small_scene(source=moved / "room.xml", judged={"path_samples": 8}), cache)
    assert replace(same, recipe=prepared.recipe) == prepared
    other = moved / "room.xml"
    other.write_text(other.read_text().replace('value="0.62 0.60 0.54"', 'value="0.60 0.60 0.54"'))
    changed = prepare_scene(small_scene(source=other, views=2, novel_views=0), tmp_path / "cache")
    assert changed.library[0].parent.name != prepared.library[0].parent.name
    assert changed.asset_sha256["small-room"] != prepared.asset_sha256["small-room"]
    assert changed.novel_names == ()


def test_a_package_can_be_a_source(prepared: PreparedScene, tmp_path: Path) -> None:
    found = prepare_scene(small_scene(source=prepared.package, views=2, novel_views=0), tmp_path)
    assert found.package == prepared.package
    assert found.asset_sha256 == prepared.asset_sha256
    assert len(read_capture(found.capture, CaptureOptions(library=found.library)).views) == 2


@pytest.mark.parametrize("unit_m", [1.0, 2.0])
def test_cameras_are_at_plausible_positions(unit_m: float, tmp_path: Path) -> None:
    """Cameras are at hand-held height above the floor in any unit, outside of objects; novel views are on a
    path through free space, and none is at the position of a photograph."""
    options = ImportOptions(unit_scale=unit_m, asset_id="room")
    import_mitsuba_scene(ROOM / "room.xml", tmp_path, options)
    recipe = CameraRecipe(height_m=HEIGHTS, min_distance_m=0.3)
    with Library([tmp_path]) as library:
        package = library.package("room")
        cameras = choose_cameras(library, package, recipe, (96, 64), 12, 5, seed=3)
        geometry = load_geometry(package)
    assert [c.name for c in cameras] == [f"view-{k:03d}" for k in range(12)] + [
        f"path-{k:03d}" for k in range(5)
    ]
    assert isinstance(geometry.asset, EnvironmentAsset)
    space = FreeSpace(geometry.asset, WorldScene(geometry, []).rays, HEIGHTS)
    places = np.array([c.camera().position_m for c in cameras])
    assert (places[:, 2] >= HEIGHTS[0] - 1e-6).all() and (places[:, 2] <= HEIGHTS[1] + 1e-6).all()
    assert [space.fault(place, 0.1) for place in places] == [""] * len(places)
    for camera in (c.camera() for c in cameras):
        hits = space.rays.cast(camera.position_m, camera.ray_directions().reshape(-1, 3))
        assert (hits.distance_m < 0.3).mean() < 0.1  # not facing a near wall
        assert np.median(hits.distance_m) > 0.8 * unit_m
    steps = np.diff(places[12:], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    assert lengths == pytest.approx([lengths[0]] * 4, abs=1e-6)  # one path of even steps
    assert not space.rays.occluded(places[12:-1], steps / lengths[:, None], lengths).any()
    assert np.linalg.norm(places[12:, None] - places[None, :12], axis=2).min() > 0.02 * unit_m  # novel
    moved = Counter(tuple(np.round(place, 3)) for place in places)
    assert max(moved.values()) == 1


def test_other_seeds_give_other_cameras(prepared: PreparedScene) -> None:
    with Library(prepared.library) as library:
        package = library.package("small-room")
        first, again, other = (
            choose_cameras(library, package, CameraRecipe(), (48, 32), 3, 0, seed=seed) for seed in (1, 1, 2)
        )
    assert first == again
    assert first != other


def test_a_checkpoint_trained_on_the_scene_is_refused(prepared: PreparedScene) -> None:
    sha = prepared.asset_sha256
    texture = next(name for name in sha if name.endswith((".png", ".jpg", ".exr")))
    assert_not_trained_on(prepared, card(chair="1" * 64))
    assert_not_trained_on(prepared, card(**{"small-room": "2" * 64}))  # another room of the same name
    for name, assets in {
        "small-room": {"another-name": sha["small-room"]},  # the package
        texture: {"oak": sha[texture]},  # one of its images
    }.items():
        with pytest.raises(InputError) as caught:
            assert_not_trained_on(prepared, card(**assets))
        assert "trained on" in str(caught.value), name
    with pytest.raises(InputError, match="no hashes of assets"):
        assert_not_trained_on(prepared, card())


def test_the_bundled_checkpoint_is_trained_on_no_test_scene(prepared: PreparedScene) -> None:
    shipped = read_card(bundled_checkpoint())
    assert shipped.data and all(record.assets for record in shipped.data)
    assert_not_trained_on(prepared, shipped)
    assert not {"veach-ajar", "dining-room"} & {asset for record in shipped.data for asset in record.assets}


DRAWN = """
format: scene-materials/recipe
version: 1
name: drawn
seed: 5
configurations: 2
views: 1
library: [bundled]
objects: {count: [3, 4]}
materials: {replace_probability: 1.0, any_class_probability: 1.0, include: [maple, gold]}
"""


def test_a_recipe_defines_a_scene(tmp_path: Path) -> None:
    """The recipe determines furniture, materials and lights; the scene determines the cameras, and whether
    checkpoints trained on any of its assets are refused or only those trained on its materials."""
    recipe = tmp_path / "drawn.yaml"
    recipe.write_text(DRAWN)
    scene = small_scene(name="drawn", source=recipe, configuration=1, may_know_shapes=True)
    found = prepare_scene(scene, tmp_path / "cache")
    assert (len(found.input_names), len(found.novel_names)) == (4, 2)
    configuration = ShardReader(found.capture).configuration()
    assert configuration.split == "test" and 3 <= len(configuration.objects) <= 4
    heights = [camera.camera().position_m[2] for camera in configuration.cameras]
    assert min(heights) >= HEIGHTS[0] - 1e-6 and max(heights) <= HEIGHTS[1] + 1e-6
    placed = (configuration.environment, *configuration.objects)
    assigned = {a.asset for thing in placed for a in thing.materials.values() if a.asset is not None}
    assert assigned and assigned <= {"maple", "gold"} == {n for n in found.asset_sha256 if "/" not in n}
    with pytest.raises(InputError, match="trained on oak"):
        assert_not_trained_on(found, card(oak=found.asset_sha256["maple"]))
    things = plan_scene(scene.model_copy(update={"may_know_shapes": False}), tmp_path / "cache").asset_sha256
    assert set(found.asset_sha256) < set(things) and configuration.objects[0].asset in things
    with pytest.raises(InputError, match="below 2"):
        plan_scene(scene.model_copy(update={"configuration": 2}), tmp_path / "cache")


def test_a_scene_can_provide_assets(tmp_path: Path, shared_data: Path) -> None:
    """The living room of Poly Haven is furnished with objects that are imported with it."""
    suite = read_suite(REPOSITORY / "scenes" / "suites" / "development.yaml")
    room = next(scene for scene in suite.scenes if scene.name == "living-room")
    planned = plan_scene(room.model_copy(update={"views": 4, "novel_views": 0}), tmp_path)
    configuration = planned.folder.read_configuration(planned.plan.units[0])
    assert configuration.environment.asset == "living_room"
    assert len({thing.asset for thing in configuration.objects}) >= 3
    assert all(thing.materials == {} for thing in configuration.objects)  # they keep their materials


def test_wrong_sources_are_refused(prepared: PreparedScene, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        prepare_scene(small_scene(source=tmp_path / "absent.xml"), tmp_path)
    with pytest.raises(InputError, match="free path"):
        single = small_scene(source=prepared.package, views=1, novel_views=3)
        prepare_scene(single, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "unit_m"), [("veach-ajar", 0.75), ("dining-room", 0.34)])
def test_scenes_of_the_paper(name: str, unit_m: float, shared_data: Path, tmp_path: Path) -> None:
    """Scenes of the paper are marked for evaluation only and can be photographed."""
    scene = small_scene(
        name=name, source=shared_data / "scenes" / name, unit_m=unit_m, views=6, novel_views=2
    )
    found = prepare_scene(scene, tmp_path)
    assert open_package(found.package).asset.provenance.usage == "evaluation_only"
    with Library(found.library) as library:
        assert library.select("environment") == []  # not available to recipes
    assert_not_trained_on(found, read_card(bundled_checkpoint()))
    capture = read_capture(found.capture, CaptureOptions(library=found.library))
    luminance = [float(np.median(view.source.read_maps(("beauty",))["beauty"])) for view in capture.views]
    assert min(luminance) > 0.01 * max(luminance)  # none is in the dark or in a wall

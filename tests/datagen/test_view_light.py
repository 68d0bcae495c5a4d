# SPDX-License-Identifier: MIT
"""Recorded light of views: in a closed box of known walls, in dataset shards, and as network input."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.farm.folder import DatasetFolder
from datagen.farm.work_unit import UnitRun, run_unit
from datagen.formats.recipe import StatisticsRecipe
from datagen.formats.shard import ShardReader
from datagen.foundation.buffers import LIGHT_BUFFERS
from datagen.foundation.errors import InputError
from datagen.foundation.versions import LIGHT_REVISION
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView, trace_capture
from datagen.library import Library
from datagen.light.view_light import ViewLight
from datagen.multiview.statistics import compute_statistics
from tests.datagen.small_plan import plan_small
from tests.model.lit_box import ALBEDOS, box_geometry, photographed_box

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
TOLERANCE = 0.04
"""Relative tolerance of a wall's reflectance, given the noise of 64 rays per surfel and of photographs."""


@lru_cache(maxsize=1)
def _medians() -> list[NDArray[np.float32]]:
    """Return the median colours (H, W, 3) of each view of the box."""
    return [s["color_median"] for s in compute_statistics([v.statistics for v in photographed_box()])]


def _light(views: tuple[TracedView, ...]) -> ViewLight:
    geometry = box_geometry()
    return ViewLight(views, TracedGeometry(geometry), geometry.emitter_mask())


@pytest.fixture(scope="module")
def box_light(mitsuba_variant: str) -> ViewLight:
    return _light(photographed_box())


def _by_wall(light: ViewLight, name: str, gain: float = 1.0) -> NDArray[np.float64]:
    """Return medians (6, C) of a buffer over the inner pixels of each wall; ``gain`` scales the colours."""
    found: list[list[NDArray]] = [[] for _ in range(6)]
    for index, view in enumerate(photographed_box()):
        values = light.buffers(index, gain * _medians()[index])[name]
        wall = view.geometry.face // 2
        inner = np.zeros(wall.shape, bool)
        inner[1:-1, 1:-1] = True
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            inner &= np.roll(wall, step, axis) == wall
        for k in range(6):
            found[k].append(values[inner & (wall == k)])
    return np.array([np.median(np.concatenate(parts), axis=0) for parts in found], np.float64)


def test_reflectance_is_the_albedo_of_diffuse_walls(box_light: ViewLight) -> None:
    error = np.abs(_by_wall(box_light, "reflectance") / ALBEDOS - 1)
    assert error.max() < TOLERANCE, error


def test_five_percent_too_bright_is_detected(box_light: ViewLight) -> None:
    """Injected fault: colours 5 % too bright are detected."""
    error = np.abs(_by_wall(box_light, "reflectance", gain=1.05) / ALBEDOS - 1)
    assert error.max() > TOLERANCE


def test_all_light_of_a_closed_box_is_known(box_light: ViewLight) -> None:
    known = _by_wall(box_light, "known_share")
    assert known.min() > 0.9 and known.max() <= 1 + 1e-6


def test_mirror_images_show_the_mirrored_wall(box_light: ViewLight) -> None:
    """The sharp mirror image has the radiance of the wall that the mirrored ray hits."""
    import mitsuba as mi

    from mitsuba_plugins.arrays import vectors_from_rows

    scene = TracedGeometry(box_geometry()).scene
    views, ratios = photographed_box(), []
    for index, view in enumerate(views):
        image = box_light.buffers(index, _medians()[index])["mirror_sharp"].reshape(-1, 3)
        way = view.camera.ray_directions().reshape(-1, 3)
        normal = view.geometry.normal_world.reshape(-1, 3)
        cosine = -(way * normal).sum(axis=1)
        depth = view.geometry.depth_z_m.ravel() / (way @ view.camera.forward)
        place = view.camera.position_m + way * depth[:, None] + 1e-3 * normal
        mirrored = way + 2 * cosine[:, None] * normal
        ray = mi.Ray3f(mi.Point3f(vectors_from_rows(place)), vectors_from_rows(mirrored))
        hit = np.asarray(scene.ray_intersect(ray).prim_index.numpy()).astype(np.int64) // 2
        used = (view.geometry.face.ravel() // 2 < 6) & (cosine > 0.6) & (hit < 6) & (hit != 5)
        ratios.append(image[used] / _wall_radiance()[np.minimum(hit[used], 5)])
    ratio = np.concatenate(ratios)
    assert np.all(np.abs(np.median(ratio, axis=0) - 1) < 0.1), np.median(ratio, axis=0)
    spread = np.percentile(ratio, [25, 75], axis=0)
    assert spread[0].min() > 0.6 and spread[1].max() < 1.6  # walls are not uniformly lit


@lru_cache(maxsize=1)
def _wall_radiance() -> NDArray[np.float64]:
    """Return the median radiance (6, 3) of the walls."""
    walls = [view.geometry.face.ravel() // 2 for view in photographed_box()]
    colors = [view.color.reshape(-1, 3) for view in photographed_box()]
    wall, color = np.concatenate(walls), np.concatenate(colors)
    return np.array([np.median(color[wall == k], axis=0) for k in range(6)], np.float64)


def test_the_order_of_views_changes_nothing(box_light: ViewLight) -> None:
    views = photographed_box()
    reversed_light = _light(views[::-1])
    for index in (0, 5):
        expected = box_light.buffers(index, _medians()[index])
        got = reversed_light.buffers(len(views) - 1 - index, _medians()[index])
        for name in LIGHT_BUFFERS:
            np.testing.assert_array_equal(got[name], expected[name])


def test_without_light_reflectance_is_zero() -> None:
    dark = tuple(replace(view, color=np.zeros_like(view.color)) for view in photographed_box())
    found = _light(dark).buffers(0, np.zeros_like(dark[0].color))
    assert all(np.isfinite(values).all() for values in found.values())
    assert not found["reflectance"].any()


# --- shards -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lit_shard(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> Path:
    """Render a shard by a recipe with ``statistics: {light: true}``; return its path."""
    root = tmp_path_factory.mktemp("lit")
    folder = plan_small(root / "dataset", root / "library", num_units=1, num_views=4, light=True)
    plan = folder.read_plan()
    library = Library([root / "library"])
    run = UnitRun(folder, plan.units[0], folder.read_recipe(), library, plan.versions, plan.variant)
    assert run_unit(run)
    manifest = folder.read_manifest(plan.units[0])
    assert manifest is not None
    return folder.root / manifest.shard


def test_shards_contain_the_buffers_of_a_reconstruction(lit_shard: Path) -> None:
    """Light computed from the shard as a capture equals the stored buffers up to half-float rounding."""
    from model.reconstruction.captures.read import read_capture

    views = list(ShardReader(lit_shard))
    assert all(set(LIGHT_BUFFERS) <= set(view.record.buffers) for view in views)
    assert all(view.record.statistics is not None and view.record.statistics.light for view in views)
    traced = trace_capture(read_capture(lit_shard))
    light = ViewLight(traced.views, traced.geometry, traced.capture.geometry.emitter_mask())
    for index, view in enumerate(views):
        got = light.buffers(index, view.buffers["color_median"].astype(np.float32))
        for name in LIGHT_BUFFERS:
            assert view.buffers[name].any(), name
            np.testing.assert_allclose(got[name], view.buffers[name], rtol=2e-3, atol=2e-6, err_msg=name)


def test_recorded_light_has_a_separate_revision(lit_shard: Path, tmp_path: Path) -> None:
    """A new revision of recorded light does not invalidate datasets without it."""
    with_light = DatasetFolder(lit_shard.parent.parent).read_plan().versions
    without = plan_small(tmp_path / "dataset", tmp_path / "library").read_plan().versions
    assert with_light == {**without, "light_revision": str(LIGHT_REVISION)}


def test_a_network_gets_the_inputs_of_its_training(lit_shard: Path, tmp_path: Path) -> None:
    """A network that returns its inputs gives the stored buffers, except at edges where statistics differ."""
    from model.checkpoint import CheckpointCard, save_checkpoint
    from model.networks import MAX_REFLECTANCE, NetworkConfig
    from model.own_network import make_network
    from model.reconstruction.captures.read import read_capture
    from model.reconstruction.infer_options import InferOptions, InferReport
    from model.reconstruction.predict.view_maps import predicted_maps
    from model.reconstruction.stages import Run

    config = NetworkConfig(factory="tests.model.toy_network:Echo")
    card = CheckpointCard(network=config, loss="none", phase="joint", step=0)
    save_checkpoint(tmp_path / "echo.safetensors", card, make_network(config))
    (tmp_path / "views").mkdir()
    traced = trace_capture(read_capture(lit_shard))
    run = Run(tmp_path, InferOptions(precision="float32"), InferReport(), lambda *progress: None)
    maps = predicted_maps(traced, tmp_path / "echo.safetensors", run)
    for view, found in zip(ShardReader(lit_shard), maps, strict=True):
        stored = np.minimum(view.buffers["reflectance"].astype(np.float32) / MAX_REFLECTANCE, 1)
        off = np.abs(found["diffuse_albedo"].astype(np.float32) - stored)
        assert np.quantile(off, 0.95) < 2e-3 and stored.max() > 0.1
        share = view.buffers["known_share"].astype(np.float32)
        np.testing.assert_allclose(found["roughness"].astype(np.float32), share, atol=2e-3)


def test_recipes_without_light_are_unchanged() -> None:
    dumped = StatisticsRecipe().model_dump(mode="json")
    assert dumped == {"best_views": 12, "visibility": "depth", "include_self": True}
    assert StatisticsRecipe(light=True).model_dump(mode="json") == {**dumped, "light": True}


def test_views_without_any_surface_are_refused(tmp_path: Path) -> None:
    from datagen.farm.work_unit import light_of_views
    from datagen.multiview.statistics import StatisticsView

    folder: DatasetFolder = plan_small(tmp_path / "dataset", tmp_path / "library", num_units=1, num_views=1)
    plan = folder.read_plan()
    library = Library([tmp_path / "library"])
    run = UnitRun(folder, plan.units[0], folder.read_recipe(), library, plan.versions, plan.variant)
    configuration = folder.read_configuration(plan.units[0])
    camera = configuration.cameras[0].camera()
    pose = camera.world_from_camera.copy()
    pose[:3, 3] += 1e4
    away = replace(camera, world_from_camera=pose)
    shape = (camera.height_px, camera.width_px)
    view = StatisticsView(away, np.ones((*shape, 3)), *(np.zeros((*shape, k)) for k in (1, 3, 1)))
    with pytest.raises(InputError, match=r"no view shows the mesh.*leave statistics.light out"):
        light_of_views(run, configuration, [view])

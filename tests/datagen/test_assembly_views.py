# SPDX-License-Identifier: MIT
"""Cameras are in free space, show objects and overlap, checked at a higher resolution than in planning."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.assembly import plan
from datagen.assembly.coverage import preview_of
from datagen.assembly.geometry import RayScene, WorldScene
from datagen.assembly.views import Candidate, Subject, ViewFinder, choose_views, overlap_matrix
from datagen.formats.asset import AssetCamera, Box
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import Recipe
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.errors import InputError
from datagen.foundation.random import Draws
from datagen.library import Library
from tests.datagen.small_library import write_objects, write_room, write_small_library

LIGHTS = {"daylight_probability": 0}  # without a sky, the tests need no renderer


def recipe(**fields: Any) -> Recipe:
    base: dict[str, Any] = {
        "name": "views",
        "configurations": 9,
        "views": 12,
        "resolution": (160, 96),
        "lights": LIGHTS,
    }
    return Recipe.model_validate({**base, **fields})


def assembled(library: Library, index: int, wanted: Recipe) -> tuple[Configuration, WorldScene]:
    """Assemble the configuration of an index; return it with its ray-tracing scene."""
    kept: list[WorldScene] = []

    class Spy(ViewFinder):
        def find(self, count: int) -> list[Camera]:
            kept.append(self.scene)
            return super().find(count)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "ViewFinder", Spy)
        configuration = plan.assemble(wanted, index, library)
    return configuration, kept[0]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return Library([write_small_library(tmp_path_factory.mktemp("library"), num_rooms=2)])


@pytest.fixture(scope="module")
def rooms(library: Library) -> list[tuple[Configuration, WorldScene]]:
    return [assembled(library, index, recipe()) for index in range(3)]


def cameras_of(configuration: Configuration) -> list[Camera]:
    return [view.camera() for view in configuration.cameras]


def test_cameras_follow_the_recipe(rooms: list[tuple[Configuration, WorldScene]], library: Library) -> None:
    for configuration, _ in rooms:
        assert [view.name for view in configuration.cameras] == [f"view-{k:03d}" for k in range(12)]
        (region,) = library.package(configuration.environment.asset).asset.camera_regions  # type: ignore[union-attr]
        for camera in cameras_of(configuration):
            assert (camera.width_px, camera.height_px) == (160, 96)
            assert math.radians(50) - 1e-6 <= camera.fov_x_rad <= math.radians(75) + 1e-6
            assert 0.8 - 1e-6 <= camera.position_m[2] <= 1.9 + 1e-6
            assert (camera.position_m >= np.array(region.minimum_m) - 1e-6).all()
            assert (camera.position_m <= np.array(region.maximum_m) + 1e-6).all()
            np.testing.assert_allclose(
                camera.world_from_camera[:3, :3].T @ camera.world_from_camera[:3, :3], np.eye(3), atol=1e-8
            )
            assert abs(camera.world_from_camera[2, 0]) < math.sin(math.radians(3.5))  # level
            assert camera.world_from_camera[2, 1] < 0  # upright


def seen(camera: Camera, rays: RayScene) -> tuple[NDArray, NDArray]:
    directions = camera.ray_directions().reshape(-1, 3)
    hits = rays.cast(camera.position_m, directions)
    return hits.distance_m, hits.face


def test_views_show_content_from_a_distance(rooms: list[tuple[Configuration, WorldScene]]) -> None:
    for configuration, scene in rooms:
        for camera in cameras_of(configuration):
            distance, face = seen(camera, scene.rays)
            assert (distance < 0.3).mean() < 0.03
            assert (distance < 0.6).mean() < 0.40
            assert np.isinf(distance).mean() < 0.45
            instances, counts = np.unique(scene.instance_of_face[face[face >= 0]], return_counts=True)
            assert len(instances) >= 3
            things = counts[(instances >= scene.num_environment_parts) | np.isin(instances, [3, 4])].sum()
            assert things > 0.02 * len(face)  # objects, the table or the shelf


def exact_overlap(one: Camera, other: Camera, rays: RayScene) -> float:
    """Return the share of points visible from ``one`` that are visible from ``other``, by ray tracing."""
    small = one.scaled(40, 24)
    directions = small.ray_directions().reshape(-1, 3)
    hits = rays.cast(one.position_m, directions)
    points = one.position_m + hits.distance_m[hits.hit_mask, None] * directions[hits.hit_mask]
    pixels, depth = other.project(points)
    inside = (
        (depth > 0) & (pixels >= 0).all(axis=1) & (pixels <= [other.width_px, other.height_px]).all(axis=1)
    )
    towards = points[inside] - other.position_m
    distance = np.linalg.norm(towards, axis=1)
    blocked = rays.occluded(other.position_m, towards / distance[:, None], distance - 1e-3)
    return float((~blocked).sum() / len(points))


def test_every_view_shares_enough_with_another(rooms: list[tuple[Configuration, WorldScene]]) -> None:
    for configuration, scene in rooms:
        cameras = cameras_of(configuration)
        for k, one in enumerate(cameras):
            best = max(exact_overlap(one, other, scene.rays) for j, other in enumerate(cameras) if j != k)
            assert best >= 0.3 - 0.03  # the planner uses fewer points


def test_overlap_of_few_points_is_close(rooms: list[tuple[Configuration, WorldScene]]) -> None:
    configuration, scene = rooms[0]
    cameras = cameras_of(configuration)
    pool = [candidate(camera, scene.rays) for camera in cameras]
    overlap = overlap_matrix(pool, scene.rays)
    errors = [
        overlap[i, j] - exact_overlap(cameras[i], cameras[j], scene.rays)
        for i in range(len(cameras))
        for j in range(len(cameras))
        if i != j
    ]
    assert abs(np.mean(errors)) < 0.005
    assert np.abs(errors).max() < 0.05
    known = overlap_matrix(pool[:5], scene.rays)
    np.testing.assert_array_equal(overlap_matrix(pool, scene.rays, known), overlap)


def candidate(camera: Camera, rays: RayScene) -> Candidate:
    preview = preview_of(camera)
    directions = preview.ray_directions().reshape(-1, 3)
    hits = rays.cast(camera.position_m, directions)
    points = camera.position_m + hits.distance_m[hits.hit_mask, None] * directions[hits.hit_mask]
    shape = (preview.height_px, preview.width_px)
    return Candidate(camera, preview, hits.distance_m.reshape(shape), points[::6])


def test_no_view_is_of_a_bare_wall(rooms: list[tuple[Configuration, WorldScene]]) -> None:
    for configuration, scene in rooms:
        for camera in cameras_of(configuration):
            _, face = seen(camera, scene.rays)
            normals, points = scene.rays.normals[face], scene.rays.corners[face, 0]
            walls = [(0, 0.0), (0, 5.0), (0, 5.5), (1, 0.0), (1, 4.0), (1, 4.3), (2, 0.0), (2, 2.7)]
            for axis, at in walls:
                on_wall = (np.abs(normals[:, axis]) > 0.99) & (np.abs(points[:, axis] - at) < 0.01)
                assert on_wall.mean() < 0.78


def test_subjects_are_objects_not_walls(rooms: list[tuple[Configuration, WorldScene]]) -> None:
    configuration, scene = rooms[0]
    subject = Subject.of(scene)
    assert len(subject.object_centers) == len(configuration.objects)
    assert subject.content_mask[:5].tolist() == [False, False, False, True, True]  # table and shelf
    assert subject.content_mask[5:].all()
    for k, placed in enumerate(configuration.objects):
        offset = subject.object_centers[k][:2] - np.array(placed.world_from_asset)[:2, 3]
        assert np.linalg.norm(offset) < 0.03
    assert {int(i) for f in subject.furniture_faces for i in np.unique(scene.instance_of_face[f])} == {3, 4}


def test_views_differ(rooms: list[tuple[Configuration, WorldScene]]) -> None:
    for configuration, _ in rooms:
        cameras = cameras_of(configuration)
        heights = [c.position_m[2] for c in cameras]
        assert max(heights) - min(heights) > 0.5
        azimuths = np.array([math.atan2(c.forward[1], c.forward[0]) for c in cameras])
        assert np.hypot(np.cos(azimuths).mean(), np.sin(azimuths).mean()) < 0.8  # not all in one direction
        for k, one in enumerate(cameras):
            for other in cameras[:k]:
                apart = np.linalg.norm(one.position_m - other.position_m)
                assert apart > 0.1 or one.forward @ other.forward < math.cos(math.radians(5))


def test_views_without_overlap_are_not_joined() -> None:
    wall = np.array(
        [[0, 5, 0], [9, 5, 0], [9, 5, 3], [0, 5, 3], [0, -5, 0], [9, -5, 0], [9, -5, 3], [0, -5, 3]], float
    )
    rays = RayScene(wall, np.array([[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]]))

    def view(x: float, y: float) -> Candidate:
        pose = look_at((x, 0, 1.5), (x, y, 1.5))
        return candidate(Camera(64, 40, 60, 60, 32, 20, pose), rays)

    pool = [view(2.0, 5), view(2.5, 5), view(3.0, 5), view(3.0, -5), view(7.5, -5)]
    overlap = overlap_matrix(pool, rays)
    chosen, lonely = choose_views(pool, overlap, 3, 0.3, Draws(1))
    assert sorted(chosen) == [0, 1, 2] and lonely == 0
    chosen, lonely = choose_views(pool, overlap, 4, 0.3, Draws(1))
    assert sorted(chosen) == [0, 1, 2] and lonely == 2
    assert choose_views(pool[3:], overlap[3:, 3:], 2, 0.3, Draws(1)) == ([], 2)
    assert choose_views(pool[:1], overlap[:1, :1], 1, 0.9, Draws(1)) == ([0], 0)


def with_room(tmp_path: Path, **changes: Any) -> Library:
    write_room(tmp_path, "room", **changes)
    write_objects(tmp_path)
    return Library([tmp_path])


def test_a_camera_region_inside_a_wall_is_reported(tmp_path: Path) -> None:
    thick = Box(minimum_m=(0.5, 0.5, -3.0), maximum_m=(4.5, 3.5, -0.05))  # below the floor
    library = with_room(
        tmp_path, camera_regions=(Box(minimum_m=(-0.08, 0.5, 0), maximum_m=(-0.02, 3.5, 2.5)),)
    )
    with pytest.raises(
        InputError,
        match=r"environment room: camera_regions = no free.*inside_solid \d+.*correct camera_regions",
    ):
        plan.assemble(recipe(views=2), 0, library)
    outside = with_room(tmp_path / "outside", camera_regions=(thick,))
    with pytest.raises(InputError, match=r"environment room: .*(outside|inside_solid) \d+"):
        plan.assemble(recipe(views=2), 0, outside)
    pose = ((1, 0, 0, 99), (0, 0, 1, 2), (0, -1, 0, 1.5), (0, 0, 0, 1))
    far = AssetCamera(
        name="far", width_px=64, height_px=48, fx_px=50, fy_px=50, cx_px=32, cy_px=24, asset_from_camera=pose
    )
    lost = with_room(tmp_path / "lost", camera_regions=(), cameras=(far,))
    with pytest.raises(InputError, match=r"cameras = no free.*no_floor \d+.*correct cameras, which"):
        plan.assemble(recipe(views=2), 0, lost)


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ({"min_distance_m": 4.0}, r"too_close \d+.*lower cameras.min_distance_m"),
        ({"min_content": 60}, r"too_little_content \d+.*lower cameras.min_content"),
        ({"min_overlap": 0.999}, r"too_little_overlap \d+.*lower cameras.min_overlap"),
        ({"min_luminance": 30.0}, r"too_dark \d+.*lower cameras.min_luminance"),
        ({"height_m": (5.0, 6.0)}, r"camera_regions = 0 to 2.5 m.*lower cameras.height_m"),
    ],
)
def test_a_shortfall_is_an_error_with_counts(library: Library, cameras: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        plan.assemble(recipe(views=6, cameras={**cameras, "max_attempts": 8}), 0, library)
    text = str(caught.value)
    assert "height_m" in cameras or ("expected 6 cameras" in text and "candidates (" in text)


def test_rejections_are_counted_by_reason(rooms: list[tuple[Configuration, WorldScene]]) -> None:
    for configuration, _ in rooms:
        reasons = configuration.rejections
        assert all(count > 0 for count in reasons.values())
        assert {name.split(".")[0] for name in reasons} <= {"camera", "placement", "light", "probe"}
        assert any(name.startswith("camera.") for name in reasons)


def test_rooms_without_regions_use_their_cameras(tmp_path: Path) -> None:
    pose = tuple(tuple(row) for row in look_at((1.0, 3.0, 1.4), (2.0, 1.4, 0.9)).tolist())
    own = AssetCamera(
        name="c", width_px=64, height_px=40, fx_px=60, fy_px=60, cx_px=32, cy_px=20, asset_from_camera=pose
    )  # type: ignore[arg-type]
    library = with_room(tmp_path, camera_regions=(), cameras=(own,))
    configuration, _ = assembled(library, 0, recipe(views=8))
    positions = np.array([camera.position_m for camera in cameras_of(configuration)])
    assert (positions > 0).all() and (positions < [5.0, 4.0, 2.7]).all()
    assert positions.std(axis=0)[:2].min() > 0.2
    nowhere = with_room(tmp_path / "nowhere", camera_regions=())
    with pytest.raises(InputError, match=r"camera_regions = none, and no cameras; expected a camera region"):
        plan.assemble(recipe(), 0, nowhere)

# SPDX-License-Identifier: MIT
"""Coverage of views is measured correctly, and room views show enough of their rooms."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from datagen.assembly.coverage import Shell, measure, preview_of, visible_mask
from datagen.assembly.geometry import WorldScene, load_geometry
from datagen.assembly.materials import MeanMaterial
from datagen.assembly.plan import assemble
from datagen.assembly.surfaces import surfaces_of
from datagen.farm.planning import create_plan
from datagen.formats.base import read_json
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import CameraRecipe, ObjectRecipe, Recipe
from datagen.foundation.cameras import Camera, look_at
from datagen.inspection.report.summary import plan_summary
from datagen.library import Library
from tests.datagen.small_library import write_small_library


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return Library([write_small_library(tmp_path_factory.mktemp("library"))])


@pytest.fixture(scope="module")
def room(library: Library) -> tuple[WorldScene, Shell]:
    geometry = load_geometry(library.package("room-0"))
    scene = WorldScene(geometry, [])
    return scene, Shell(scene, surfaces_of(geometry))


def camera(
    position: tuple[float, float, float], target: tuple[float, float, float], fov: float = 70
) -> Camera:
    focal = 0.5 * 160 / math.tan(math.radians(0.5 * fov))
    pose = look_at(np.array(position), np.array(target))
    return Camera(160, 96, focal, focal, 80, 48, pose)


def shows_room(room: tuple[WorldScene, Shell], one: Camera) -> bool:
    scene, shell = room
    directions = preview_of(one).ray_directions().reshape(-1, 3)
    hits = scene.rays.cast(one.position_m, directions)
    return shell.is_room(hits.face[hits.hit_mask], len(directions))


def test_a_room_is_two_walls_or_a_wall_and_the_ceiling(room: tuple[WorldScene, Shell]) -> None:
    assert shows_room(room, camera((0.6, 0.6, 1.6), (4.5, 3.5, 1.4)))  # a corner
    assert shows_room(room, camera((2.5, 3.6, 1.5), (2.5, 0.0, 2.3), 50))  # a wall and the ceiling
    assert not shows_room(room, camera((2.5, 2.0, 1.6), (2.55, 2.0, 0.0)))  # the floor
    assert not shows_room(room, camera((2.5, 1.2, 1.5), (2.5, 0.0, 1.5), 50))  # one wall


def test_observations_and_shares_are_counted(room: tuple[WorldScene, Shell]) -> None:
    scene, shell = room
    one = camera((0.6, 0.6, 1.6), (4.5, 3.5, 1.4))
    away = camera((2.5, 1.2, 1.5), (2.5, 0.0, 1.5), 50)
    plain = MeanMaterial((0.5, 0.5, 0.5), (0.04, 0.04, 0.04), 0.6)
    steel = MeanMaterial((0.0, 0.0, 0.0), (0.6, 0.6, 0.6), 0.2)
    slots = scene.geometries[0].asset.materials
    assigned = (dict.fromkeys(slots, plain),)
    same = measure(scene, shell, assigned, [one, one, one])
    assert (same.median_observations, same.thin_share, same.room_share) == (3.0, 0.0, 1.0)
    assert same.metal_share == same.gloss_share == 0.0
    apart = measure(scene, shell, assigned, [one, away])
    assert apart.thin_share == 1.0 and apart.room_share == 0.5
    walls = measure(scene, shell, ({**assigned[0], "walls": steel},), [away])
    assert walls.metal_share == walls.gloss_share > 0.95
    polished = MeanMaterial(plain.diffuse_albedo, plain.specular_albedo, 0.25)
    floor = measure(scene, shell, ({**assigned[0], "walls": polished},), [away])
    assert floor.metal_share == 0.0 and floor.gloss_share > 0.95


def test_hidden_points_are_not_seen(room: tuple[WorldScene, Shell]) -> None:
    scene, _ = room
    one = camera((0.6, 1.4, 0.3), (4.5, 1.4, 0.3))
    on_table, behind, beside, shown = (2.0, 1.4, 0.7501), (0.1, 1.4, 0.3), (0.9, 3.5, 0.3), (3.5, 1.4, 0.3)
    points = np.array([on_table, behind, beside, shown])
    assert visible_mask(one, points, scene.rays).tolist() == [False, False, False, True]


def recipe(subject: str, views: int) -> Recipe:
    cameras = CameraRecipe(subject=subject, height_m=(1.3, 1.75), fov_x_deg=(62, 78))  # type: ignore[arg-type]
    return Recipe(
        name="views", seed=5, configurations=3, views=views, resolution=(160, 96), cameras=cameras,
        objects=ObjectRecipe(count=(3, 6)),
    )  # fmt: skip


def test_views_of_rooms_show_rooms_and_share_them(library: Library) -> None:
    for index in range(3):
        made = assemble(recipe("room", 10), index, library)
        assert made.coverage is not None
        assert made.coverage.room_share >= 0.5 and made.coverage.median_observations >= 4
        for view in made.cameras:
            forward = view.camera().forward
            assert abs(math.degrees(math.asin(forward[2]))) < 20
            assert 1.3 - 1e-6 <= view.camera().position_m[2] <= 1.75 + 1e-6
        assert made == assemble(recipe("room", 10), index, library)
    many = assemble(recipe("room", 40), 0, library).coverage
    assert many is not None and many.median_observations >= 8


def test_views_of_rooms_overlap_more_than_views_of_objects(library: Library) -> None:
    rooms, things = (
        np.mean([c.coverage.median_observations for i in range(3) if (c := assemble(r, i, library)).coverage])
        for r in (recipe("room", 10), recipe("things", 10))
    )
    assert rooms > 1.3 * things


def test_few_views_of_rooms_are_of_windows(library: Library) -> None:
    """Distances beyond the window at +Y must not count as room depth, or most views would face the window."""
    made = assemble(recipe("room", 10), 0, library)
    towards = [view.camera().forward[1] > 0.8 for view in made.cameras]
    assert sum(towards) <= 4


def test_plan_states_coverage(library: Library, tmp_path: Path) -> None:
    asked = recipe("room", 4)
    create_plan(asked, library, tmp_path / "made")
    paths = sorted((tmp_path / "made" / "configurations").glob("*.json"))
    made = [read_json(Configuration, path) for path in paths]
    text = plan_summary(made)
    medians = sorted(c.coverage.median_observations for c in made if c.coverage)
    assert f"{medians[1]:g} views" in text and "two walls" in text and "S > 0.3" in text
    assert plan_summary([made[0].model_copy(update={"coverage": None})]) == ""


def test_training_views_without_metal_or_gloss_are_reported(library: Library) -> None:
    """Shares of pixels are averaged over all views of the training split; other splits are ignored."""
    one = assemble(recipe("room", 4), 0, library)
    assert one.coverage is not None

    def summary(*shares: tuple[str, float, float]) -> str:
        return plan_summary(
            one.model_copy(
                update={
                    "split": split,
                    "coverage": one.coverage.model_copy(update={"metal_share": metal, "gloss_share": gloss}),  # type: ignore[union-attr]
                }
            )
            for split, metal, gloss in shares
        )

    assert "note" not in summary(("train", 0.06, 0.15))
    assert "note" not in summary(("train", 0.02, 0.1), ("train", 0.12, 0.3))
    assert "note" not in summary(("validation", 0.0, 0.0)) and "note" not in summary(("test", 0.0, 0.0))
    (note,) = summary(("train", 0.016, 0.22), ("validation", 1.0, 1.0)).splitlines()[3:]
    assert note.startswith("note: ") and "S > 0.3 in 1.6% of them (at least 6%)" in note
    assert "R < 0.3" not in note and "materials.class_weights" in note
    assert "R < 0.3 in 14.0% of them (at least 15%)" in summary(("train", 0.1, 0.14))

# SPDX-License-Identifier: MIT
"""Independent slow checks confirm that placed objects are at rest, stable, disjoint and within limits."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.assembly.geometry import load_geometry
from datagen.assembly.placement import Placer, is_enclosed, place_things
from datagen.assembly.things import PlacedThing, Room, Thing, convex_hull_2d, margin_inside
from datagen.formats.asset import ObjectAsset, SupportSurface
from datagen.formats.recipe import ObjectRecipe
from datagen.foundation.errors import InputError
from datagen.foundation.random import Draws
from datagen.library import Library
from tests.datagen.small_library import box, write_object, write_room, write_small_library

NUM_SEEDS = 6


def triangles_cross(one: NDArray, other: NDArray) -> bool:
    """Return whether an edge of ``one`` (M, 3, 3) pierces a triangle of ``other`` (K, 3, 3) or vice versa."""
    return bool(_pierces(one, other) or _pierces(other, one))


def _pierces(edges_of: NDArray, triangles: NDArray) -> bool:
    if len(edges_of) == 0 or len(triangles) == 0:
        return False
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    near = ((edges_of.max(axis=1) >= low) & (edges_of.min(axis=1) <= high)).all(axis=1)
    corners = edges_of[near]
    if len(corners) == 0:
        return False
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    triangles = triangles[((triangles.max(axis=1) >= low) & (triangles.min(axis=1) <= high)).all(axis=1)]
    starts = corners.reshape(-1, 3)
    spans = np.roll(corners, -1, axis=1).reshape(-1, 3) - starts
    for a, b, c in triangles:  # Moeller-Trumbore test of a triangle against all edges
        e1, e2 = b - a, c - a
        p = np.cross(spans, e2)
        det = p @ e1
        usable = np.abs(det) > 1e-14
        safe = np.where(usable, det, 1.0)
        s = starts - a
        u = (s * p).sum(axis=1) / safe
        q = np.cross(s, e1)
        v = (spans * q).sum(axis=1) / safe
        t = q @ e2 / safe
        if (usable & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)).any():
            return True
    return False


def world_triangles(placed: PlacedThing, lift_m: float = 0.0) -> NDArray:
    matrix = placed.world_from_asset
    points = placed.thing.geometry.vertices @ matrix[:3, :3].T + matrix[:3, 3] + [0, 0, lift_m]
    return points[placed.thing.geometry.faces]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return Library([write_small_library(tmp_path_factory.mktemp("library"))])


@pytest.fixture(scope="module")
def room(library: Library) -> Room:
    return Room(load_geometry(library.package("room-0")))


def things_of(library: Library, *names: str) -> list[Thing]:
    packages = [library.package(n) for n in names] if names else library.select("object")
    return [Thing(p.asset, load_geometry(p)) for p in packages if isinstance(p.asset, ObjectAsset)]


@pytest.fixture(scope="module")
def scenes(library: Library, room: Room) -> list[list[PlacedThing]]:
    recipe = ObjectRecipe(count=(12, 22))
    return [place_things(room, things_of(library), recipe, (9, k), Counter()) for k in range(NUM_SEEDS)]


def test_objects_do_not_intersect(scenes: list[list[PlacedThing]], room: Room) -> None:
    ground = room.geometry.vertices[room.geometry.faces]
    for placed in scenes:
        for k, one in enumerate(placed):
            assert not triangles_cross(world_triangles(one, 6e-4), ground), one.thing.asset.id
            for other in placed[:k]:
                assert not triangles_cross(world_triangles(one), world_triangles(other))


def test_the_slow_check_detects_an_intersection(scenes: list[list[PlacedThing]], room: Room) -> None:
    ground = room.geometry.vertices[room.geometry.faces]
    for one in scenes[0]:
        assert triangles_cross(
            world_triangles(one, -0.002), ground
        )  # 2 mm lower, it would intersect the surface, so it does not hover
    one = scenes[0][0]
    assert triangles_cross(world_triangles(one), world_triangles(one) + [0.01, 0.013, 0.005])  # noqa: RUF005


def test_objects_rest_on_their_surface(scenes: list[list[PlacedThing]]) -> None:
    for placed in scenes:
        for one in placed:
            lowest = float(world_triangles(one)[..., 2].min())
            assert lowest == pytest.approx(one.support.origin_m[2], abs=1e-5)
            points = world_triangles(one).reshape(-1, 3)
            contact = points[points[:, 2] < lowest + 1e-3][:, :2]
            matrix = one.world_from_asset
            center = matrix[:3, :3] @ one.thing.geometry.center_of_mass_m + matrix[:3, 3]
            assert margin_inside(convex_hull_2d(contact), center[:2]) > 0


def test_objects_stay_within_their_limits(scenes: list[list[PlacedThing]]) -> None:
    for placed in scenes:
        for one in placed:
            asset, surface = one.thing.asset, one.support
            assert surface.kind in asset.supports
            assert asset.scale_range[0] <= one.scale <= asset.scale_range[1]
            assert asset.yaw_range_rad[0] - 1e-6 <= one.yaw_rad <= asset.yaw_range_rad[1] + 1e-6
            points = world_triangles(one).reshape(-1, 3)
            assert points[:, 2].max() <= surface.origin_m[2] + surface.clearance_m + 1e-6
            for edge in (surface.edge_u_m, surface.edge_v_m):
                along = (points - np.array(surface.origin_m)) @ np.array(edge) / np.dot(edge, edge)
                assert along.min() >= -1e-6 and along.max() <= 1 + 1e-6


def test_gaps_between_objects_are_kept(scenes: list[list[PlacedThing]]) -> None:
    for placed in scenes[:2]:
        for k, one in enumerate(placed):
            for other in placed[:k]:
                if np.linalg.norm(one.position_m - other.position_m) > 0.5:
                    continue
                a = trimesh.sample.sample_surface(_mesh(one), 3000, seed=1)[0]
                b = trimesh.sample.sample_surface(_mesh(other), 3000, seed=2)[0]
                assert cKDTree(a).query(b)[0].min() >= 0.005 - 1e-6


def _mesh(placed: PlacedThing) -> trimesh.Trimesh:
    corners = world_triangles(placed)
    return trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)


def test_category_weights_determine_the_shares(library: Library, room: Room) -> None:
    weights = {
        "tin": 5.0,
        "book": 1.0,
        "box": 0.0,
        "toy": 0.0,
        "bottle": 0.0,
        "cup": 0.0,
        "chair": 0.0,
        "cabinet": 0.0,
    }
    recipe = ObjectRecipe(count=(8, 8), category_weights=weights)
    seen: Counter[str] = Counter()
    for seed in range(12):
        seen.update(
            t.thing.asset.category for t in place_things(room, things_of(library), recipe, (seed,), Counter())
        )
    assert set(seen) == {"tin", "book"}
    assert 0.7 < seen["tin"] / seen.total() < 0.95


def placed_on(
    tmp_path: Path, shapes: dict[str, trimesh.Trimesh], room: Room, **fields: object
) -> Counter[str]:
    """Try to place one object of these shapes; return counts by reason of rejection, or of "placed"."""
    write_object(tmp_path, "thing", "thing", shapes, **fields)
    thing = things_of(Library([tmp_path]))[0]
    rejections: Counter[str] = Counter()
    placer = Placer(room, ObjectRecipe(max_attempts=20), rejections)
    if placer.place(thing, Draws(4)) is not None:
        rejections["placed"] += 1
    return rejections


def test_unstable_objects_are_refused(tmp_path: Path, room: Room) -> None:
    leaning = {
        "foot": box([-0.02, -0.02, 0], [0.02, 0.02, 0.05]),
        "head": box([0.03, -0.1, 0.05], [0.3, 0.1, 0.1]),
    }
    rejections = placed_on(tmp_path, leaning, room, supports=("table",))
    assert rejections["placement.unstable"] > 0 and not rejections["placed"]
    (thing,) = things_of(Library([tmp_path]))
    assert not thing.can_stand(0.002)
    with pytest.raises(InputError, match="a surface on which an object of positive weight"):
        place_things(room, [thing], ObjectRecipe(), (1,), Counter())


def test_unplaceable_objects_are_not_drawn(tmp_path: Path, library: Library, room: Room) -> None:
    leaning = {
        "foot": box([-0.02, -0.02, 0], [0.02, 0.02, 0.05]),
        "head": box([0.03, -0.1, 0.05], [0.3, 0.1, 0.1]),
    }
    write_object(tmp_path, "leaning", "leaning", leaning, supports=("table",))
    things = [*things_of(library), *things_of(Library([tmp_path]))]
    assert [t.asset.id for t in things if not t.can_stand(0.002)] == ["leaning"]
    rejections: Counter[str] = Counter()
    placed = place_things(room, things, ObjectRecipe(count=(15, 15)), (2,), rejections)
    assert "leaning" not in {p.thing.asset.id for p in placed}
    assert rejections["placement.cannot_stand"] == 1


def test_objects_that_fit_only_when_scaled_down_are_refused(tmp_path: Path, room: Room) -> None:
    tall = {"body": box([-0.05, -0.05, 0], [0.05, 0.05, 0.5])}
    rejections = placed_on(tmp_path, tall, room, supports=("shelf",))
    assert rejections["placement.no_surface"] == 1


def room_with(tmp_path: Path, surface: SupportSurface) -> Room:
    write_room(tmp_path, "room", support_surfaces=(surface,))
    return Room(load_geometry(Library([tmp_path]).package("room")))


@pytest.mark.parametrize(
    ("height", "reason"),
    [(1.2, "placement.no_support"), (0.68, "placement.no_support"), (0.80, "placement.off_surface")],
)
def test_a_declared_surface_off_the_mesh_is_detected(tmp_path: Path, height: float, reason: str) -> None:
    surface = SupportSurface(
        name="air",
        kind="table",
        origin_m=(1.2, 1.0, height),
        edge_u_m=(1.4, 0, 0),
        edge_v_m=(0, 0.8, 0),
        clearance_m=1.0,
    )
    cube = {"body": box([-0.05, -0.05, 0], [0.05, 0.05, 0.1])}
    rejections = placed_on(
        tmp_path / "object", cube, room_with(tmp_path / "room", surface), supports=("table",)
    )
    assert not rejections["placed"]
    assert rejections[reason] > 0


def test_a_surface_one_centimetre_off_is_corrected(tmp_path: Path) -> None:
    surface = SupportSurface(
        name="cloth",
        kind="table",
        origin_m=(1.2, 1.0, 0.76),
        edge_u_m=(1.4, 0, 0),
        edge_v_m=(0, 0.8, 0),
        clearance_m=1.0,
    )
    room = room_with(tmp_path / "room", surface)
    write_object(
        tmp_path / "o",
        "cube",
        "cube",
        {"body": box([-0.05, -0.05, 0], [0.05, 0.05, 0.1])},
        supports=("table",),
    )
    placer = Placer(room, ObjectRecipe(), Counter())
    placed = placer.place(things_of(Library([tmp_path / "o"]))[0], Draws(1))
    assert placed is not None
    assert placed.position_m[2] == pytest.approx(0.75, abs=1e-6)


def test_surfaces_of_equal_names_have_their_own_triangles(room: Room) -> None:
    everywhere = np.array([[-np.inf] * 3, [np.inf] * 3])
    surfaces = [s.model_copy(update={"name": "support"}) for s in room.asset.support_surfaces]
    shared, separate = Room(room.geometry), [Room(room.geometry) for _ in surfaces]
    for surface, alone in zip(surfaces, separate, strict=True):
        expected = alone.triangles_in(everywhere, surface)
        np.testing.assert_array_equal(shared.triangles_in(everywhere, surface), expected)


def test_a_surface_inside_a_wall_supports_nothing(tmp_path: Path, library: Library) -> None:
    surface = SupportSurface(
        name="in-wall",
        kind="table",
        origin_m=(-0.09, 1.0, 0.5),
        edge_u_m=(0.08, 0, 0),
        edge_v_m=(0, 2, 0),
        clearance_m=1.0,
    )
    recipe = ObjectRecipe(count=(1, 1), max_attempts=10)
    with pytest.raises(InputError, match=r"0 placed.*expected at least 1 \(objects.count\)"):
        place_things(room_with(tmp_path, surface), things_of(library, "can"), recipe, (1,), Counter())


def test_an_object_inside_a_closed_box_is_detected(library: Library, tmp_path: Path, room: Room) -> None:
    write_object(
        tmp_path, "crate", "crate", {"body": box([-0.3, -0.3, 0], [0.3, 0.3, 0.5])}, supports=("floor",)
    )
    crate = things_of(Library([tmp_path]))[0]
    floor = room.asset.support_surfaces[0]

    def at(thing: Thing, x: float, z: float) -> PlacedThing:
        low, high = thing.geometry.minimum_m, thing.geometry.maximum_m
        offset = np.array([x, 2.0, z])
        return PlacedThing(thing, floor, 1.0, 0.0, offset, np.stack([low + offset, high + offset]))

    can, chair = things_of(library, "can", "chair")
    assert is_enclosed(at(can, 2.0, 0.1), at(crate, 2.0, 0.0))
    assert not is_enclosed(at(can, 3.0, 0.1), at(crate, 2.0, 0.0))
    assert not is_enclosed(at(can, 2.0, 0.0), at(chair, 2.0, 0.0))  # below the seat is not inside


def test_too_many_objects_are_reported_with_counts(library: Library, room: Room) -> None:
    recipe = ObjectRecipe(count=(60, 60), max_attempts=5)
    with pytest.raises(
        InputError, match=r"environment room-0: objects = \d+ placed \(.*hits_object \d+"
    ) as caught:
        place_things(room, things_of(library, "cabinet"), recipe, (1,), Counter())
    assert "lower objects.count" in str(caught.value)


def test_objects_that_fit_nowhere_are_reported(tmp_path: Path, room: Room) -> None:
    write_object(tmp_path, "bed", "bed", {"body": box([-1, -1, 0], [1, 1, 0.5])}, supports=("counter",))
    with pytest.raises(InputError, match="the objects stand on counter"):
        place_things(room, things_of(Library([tmp_path])), ObjectRecipe(), (1,), Counter())


def test_tall_objects_are_often_placed_at_walls(library: Library, room: Room) -> None:
    recipe = ObjectRecipe(count=(1, 1))
    at_wall = 0
    for seed in range(40):
        one = place_things(room, things_of(library, "cabinet"), recipe, (seed,), Counter())[0]
        gap = min(one.bounds_m[0][0], one.bounds_m[0][1], 5.0 - one.bounds_m[1][0], 4.0 - one.bounds_m[1][1])
        turned = abs(math.remainder(one.yaw_rad, math.pi / 2)) < 0.05
        at_wall += gap < 0.15 and turned
    assert 15 < at_wall < 38


def test_hull_and_margin() -> None:
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5], [0.5, 0.0]])
    hull = convex_hull_2d(square)
    assert len(hull) == 4
    assert margin_inside(hull, np.array([0.5, 0.25])) == pytest.approx(0.25)
    assert margin_inside(hull, np.array([1.2, 0.5])) == pytest.approx(-0.2)
    many = np.random.default_rng(1).normal(size=(5000, 2))
    few = convex_hull_2d(many)
    assert all(margin_inside(few, point) > -1e-8 for point in many[::50])
    np.testing.assert_allclose(few, convex_hull_2d(few))
    assert len(convex_hull_2d(np.column_stack([np.linspace(0, 1, 3000), np.zeros(3000)]))) == 2
    assert margin_inside(convex_hull_2d(square[:2]), np.array([0.5, 0.0])) == -math.inf

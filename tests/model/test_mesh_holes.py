# SPDX-License-Identifier: MIT
"""Holes of meshes: the boundary cycles that count, their triangulation, and evidence from photographs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from datagen.formats.capture import Capture, CaptureView
from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.mesh import Mesh, area_vectors
from datagen.geometry.traced import TracedGeometry
from model.reconstruction.mesh import holes
from model.reconstruction.mesh.holes import PART, filled, find_holes, triangulated
from oracles.textured_room import MapSource, geometry_of, room_capture, room_mesh

CENTRE, RADIUS_M = np.array([3.0, 0.8, 0.0]), 0.3
"""Centre and radius of the hole in the room's floor."""


def fine(mesh: Mesh) -> Mesh:
    """The mesh with edges of at most 0.15 m, without UVs."""
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.positions, mesh.faces, 0.15, max_iter=20)
    return Mesh(np.asarray(vertices, np.float32), np.asarray(faces, np.int32))


def without(mesh: Mesh, centre: NDArray, radius_m: float) -> Mesh:
    """The mesh without the triangles whose centres are within ``radius_m`` of ``centre``."""
    distance = np.linalg.norm(mesh.triangles().mean(axis=1) - centre, axis=1)
    return replace(mesh, faces=mesh.faces[distance > radius_m])


def num_holes(mesh: Mesh, is_ignored: NDArray[np.bool_] | None = None) -> int:
    return len(find_holes(mesh, np.zeros(len(mesh.faces), bool) if is_ignored is None else is_ignored))


def test_a_hole_is_found_with_its_edges() -> None:
    mesh = without(fine(room_mesh()), CENTRE, RADIUS_M)
    (hole,) = find_holes(mesh, np.zeros(len(mesh.faces), bool))
    triangles = mesh.triangles()[hole.around]
    assert len(hole.around) == len(hole.loop) > 8
    assert np.linalg.norm(triangles.mean(axis=1) - CENTRE, axis=1).max() < RADIUS_M + 0.15


def test_outlines_rims_and_large_openings_are_no_holes() -> None:
    room = fine(room_mesh())
    assert num_holes(room) == 0
    assert num_holes(without(room, CENTRE, 0.6)) == 0  # larger than MAX_SIZE
    plane = fine(Mesh(*(np.asarray(a) for a in (room_mesh().positions[:4], room_mesh().faces[:2]))))
    assert num_holes(plane) == 0
    cup = fine(room_mesh())
    low = cup.positions[cup.faces][..., 2].max(axis=1) < 0.4
    small = np.vstack([cup.positions, [[90, 0, 0], [90, 1, 0], [90, 0, 1]]]).astype(np.float32)
    faces = np.vstack([cup.faces[low], [np.arange(3) + len(cup.positions)]]).astype(np.int32)
    assert num_holes(Mesh(small, faces)) == 0  # the rim of a room cut at 0.4 m, in a larger scene


def test_a_lampshade_has_no_holes() -> None:
    """Normals at its openings are 17 degrees off the horizontal; a far triangle enlarges the scene."""
    angle = 2 * np.pi * np.arange(24) / 24
    rings = [
        np.stack([r * np.cos(angle), r * np.sin(angle), np.full(24, z)], axis=1)
        for r, z in ((0.3, 0), (0.2, 0.33))
    ]
    low, high = np.arange(24), np.arange(24) + 24
    after = np.roll(low, -1)
    sides = np.concatenate([np.stack([low, after, high], 1), np.stack([after, after + 24, high], 1)])
    far = [[9, 0, 0], [9, 1, 0], [9, 0, 1]]
    mesh = Mesh(
        np.concatenate([*rings, far]).astype(np.float32),
        np.concatenate([sides, [[48, 49, 50]]]).astype(np.int32),
    )
    assert (area_vectors(mesh.triangles())[:-1, 2] > 0).all() and num_holes(mesh) == 0


def test_holes_that_touch_are_separate() -> None:
    """Two squares of a grid that share a corner."""
    shape = trimesh.creation.box((1, 1, 0.001))
    vertices, faces = trimesh.remesh.subdivide(*trimesh.remesh.subdivide(shape.vertices, shape.faces))
    vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    mesh = Mesh(np.asarray(8 * vertices, np.float32), np.asarray(faces, np.int32))
    centre = mesh.triangles().mean(axis=1)
    top = area_vectors(mesh.triangles())[:, 2] > 0
    cell = np.floor(centre[:, :2])
    gone = top & ((cell == [0, 0]).all(axis=1) | (cell == [1, 1]).all(axis=1))
    assert gone.sum() == 4
    found = find_holes(replace(mesh, faces=mesh.faces[~gone]), np.zeros((~gone).sum(), bool))
    assert sorted(len(hole.loop) for hole in found) == [4, 4]
    both = np.zeros(len(mesh.faces), bool)
    both[np.flatnonzero(top & (cell == [1, 1]).all(axis=1))] = True
    assert num_holes(mesh, both) == 1  # the other is around an ignored part


@pytest.mark.parametrize(
    "outline",
    [
        [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]],
        [[0, 0], [4, 0], [4, 3], [3, 3], [3, 1], [2, 1], [2, 3], [1, 3], [1, 1], [0.5, 3], [0, 3]],
        [
            [np.cos(a) * r, np.sin(a) * r]
            for a, r in zip(np.arange(10) * np.pi / 5, [1, 0.4] * 5, strict=True)
        ],
    ],
    ids=["L", "comb", "star"],
)
def test_triangles_cover_a_polygon_once(outline: list[list[float]]) -> None:
    flat = np.array(outline, float)
    area = 0.5 * np.cross(flat, np.roll(flat, -1, axis=0)).sum()
    axes = np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    points = flat @ axes + [3, 1, -2]
    vectors = area_vectors(points[triangulated(points)])
    normal = np.cross(*axes)
    assert len(vectors) == len(flat) - 2 and (vectors @ normal > 0).all()
    assert 0.5 * np.linalg.norm(vectors, axis=1).sum() == pytest.approx(area)


def holed_capture(
    paint: Callable[[Camera, NDArray, NDArray], NDArray], num_views: int = 10, radius_m: float = RADIUS_M
) -> Capture:
    """The room with a hole in its floor; ``paint`` gets the camera, the photograph and the pixels' points,
    and returns the photograph inside of the hole."""
    geometry = geometry_of(without(fine(room_mesh()), CENTRE, radius_m))
    true, holed = TracedGeometry(geometry_of(room_mesh())), TracedGeometry(geometry)
    views = []
    for view in room_capture(num_views).views:
        color, depth = view.read().color, true.trace_view(view.camera).depth_z_m[..., 0]
        points = view.camera.unproject(view.camera.pixel_centers(), depth)
        inside = holed.trace_view(view.camera).face < 0
        painted = np.where(inside[..., None], paint(view.camera, color, points), color)
        views.append(CaptureView(view.name, view.camera, MapSource({"diffuse_albedo": painted})))
    return Capture("room", tuple(views), geometry)


def behind(camera: Camera, color: NDArray, points: NDArray) -> NDArray:
    """Paint a striped floor 3 m below the hole, with the floor's mean radiance."""
    ways = points - camera.position_m
    far = camera.position_m + ways * ((-3 - camera.position_m[2]) / np.minimum(ways[..., 2:], -1e-6))
    return color * np.where(np.floor(far[..., :1] * 10) % 2 == 0, 1.4, 0.6)


def floor(camera: Camera, color: NDArray, points: NDArray) -> NDArray:
    """Paint the floor that the mesh lacks."""
    return color


@pytest.mark.usefixtures("mitsuba_variant")
@pytest.mark.parametrize(
    ("paint", "num_views", "num"),
    [
        (floor, 10, 1),
        (floor, 1, 0),
        (lambda camera, color, points: 8 * color, 10, 0),
        (lambda camera, color, points: color / 8, 10, 0),
    ],
    ids=["floor", "one view", "daylight", "night"],
)
def test_a_hole_is_filled_if_photographs_show_its_floor(
    paint: Callable[[Camera, NDArray, NDArray], NDArray],
    num_views: int,
    num: int,
) -> None:
    capture = holed_capture(paint, num_views)
    found, num_filled = filled(capture)
    assert num_filled == num
    if num == 0:
        assert found is capture
        return
    part = found.geometry.parts[-1]
    assert part.name == PART and part.emission is None and found.geometry.mesh.uv is None
    mesh = found.geometry.mesh
    added = mesh.triangles()[part.first_face :]
    assert np.abs(added[..., 2]).max() < 1e-6
    assert (area_vectors(added)[:, 2] >= 0).all()  # into the room
    missing = fine(room_mesh()).areas().sum() - capture.geometry.mesh.areas().sum()
    assert mesh.areas()[part.first_face :].sum() == pytest.approx(missing, rel=1e-3)
    before = capture.geometry.mesh
    np.testing.assert_array_equal(mesh.triangles()[: len(before.faces)], before.triangles())


@pytest.mark.usefixtures("mitsuba_variant")
def test_small_holes_in_no_photograph_are_filled() -> None:
    """A hole of radius 0.1 m is missing data; one of radius 0.3 m may be a window."""
    assert [filled(holed_capture(floor, 1, radius_m))[1] for radius_m in (0.1, RADIUS_M)] == [1, 0]


@pytest.mark.usefixtures("mitsuba_variant")
def test_the_largest_holes_are_filled(monkeypatch: pytest.MonkeyPatch) -> None:
    capture, other = holed_capture(floor), CENTRE - np.array([0.8, 0.1, 0.0])
    both = replace(capture, geometry=geometry_of(without(capture.geometry.mesh, other, 0.12)))
    assert filled(both)[1] == 2
    monkeypatch.setattr(holes, "MAX_HOLES", 1)
    found, num_filled = filled(both)
    added = found.geometry.mesh.triangles()[found.geometry.parts[-1].first_face :]
    assert num_filled == 1 and np.linalg.norm(added.mean(axis=(0, 1)) - CENTRE) < 0.15


@pytest.mark.usefixtures("mitsuba_variant")
def test_only_disagreement_reveals_another_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """The median radiance in the hole is that of its surroundings."""
    capture = holed_capture(behind)
    assert filled(capture)[1] == 0
    monkeypatch.setattr(holes, "MAX_SPREAD", 10.0)
    assert filled(capture)[1] == 1

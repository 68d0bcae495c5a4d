# SPDX-License-Identifier: MIT
"""A mesh's valid unwrap is kept; new unwraps are valid and of equal texel density."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import face_normals
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.unwrap import uv as uv_module
from model.reconstruction.unwrap.charts import uv_areas
from model.reconstruction.unwrap.planar import PlanarCharts
from model.reconstruction.unwrap.uv import own_uv_fault, unwrapped
from oracles.textured_room import room_mesh
from tests.datagen.small_library import room_shapes, with_uv

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def tiled_room() -> Mesh:
    """A furnished room with repeating UVs, which are not a valid unwrap."""
    return with_uv(trimesh.util.concatenate(list(room_shapes(5, 4, 2.7).values())))


def overlap(mesh: Mesh, size: int = 512) -> float:
    highest, is_several = TexelSurface(mesh, face_normals(mesh), size).overlaps((0.513, 0.487))
    return is_several.sum() / (highest >= 0).sum()


def corner_positions(mesh: Mesh) -> np.ndarray:
    return mesh.positions[mesh.faces]


def test_a_valid_unwrap_is_kept() -> None:
    mesh = room_mesh()
    assert own_uv_fault(mesh) == ""
    kept, report = unwrapped(mesh)
    assert kept is mesh
    assert report.source == "mesh" and report.rejected == ""
    assert report.coverage == pytest.approx(0.88**2, rel=1e-5)


def test_invalid_unwraps_are_named() -> None:
    mesh = room_mesh()
    assert mesh.uv is not None
    outside = Mesh(mesh.positions, mesh.faces, mesh.normals, mesh.uv * 1.2)
    assert "outside [0, 1]" in own_uv_fault(outside)
    moved = mesh.uv.copy()
    moved[:4] = moved[4:8]  # two walls overlap
    assert "9.1% of the layout overlaps itself" in own_uv_fault(Mesh(mesh.positions, mesh.faces, None, moved))
    flat = mesh.uv.copy()
    flat[:4] = 0.5
    assert "UVs without area" in own_uv_fault(Mesh(mesh.positions, mesh.faces, None, flat))


def test_new_unwraps_are_valid_and_keep_triangles_and_density() -> None:
    mesh = tiled_room()
    made, report = unwrapped(mesh)
    assert report.source == "planar" and "outside" in report.rejected
    np.testing.assert_array_equal(corner_positions(made), corner_positions(mesh))
    assert made.normals is not None and mesh.normals is not None
    np.testing.assert_array_equal(made.normals[made.faces], mesh.normals[mesh.faces])
    assert own_uv_fault(made) == ""
    assert report.stretch < 1.3
    assert report.coverage > 0.6
    assert report.padding_texels is not None and report.padding_texels >= 1
    assert report.notes == [f"the mesh's own UVs are not used: {report.rejected}"]
    again, _ = unwrapped(mesh)
    assert made.uv is not None and again.uv is not None
    np.testing.assert_array_equal(made.uv, again.uv)


@pytest.mark.parametrize("has_room", [True, False])
def test_tiny_triangles_are_unwrapped(has_room: bool) -> None:
    """A knob of 2 mm with 5,120 triangles, alone and in a room."""
    knob = trimesh.creation.icosphere(subdivisions=4, radius=1e-3)
    shape = trimesh.util.concatenate([knob, trimesh.creation.box((4, 3, 2.5))]) if has_room else knob
    mesh = Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32))
    made, report = unwrapped(mesh)
    assert own_uv_fault(made) == ""
    np.testing.assert_allclose(corner_positions(made), corner_positions(mesh))
    assert report.stretch < 1.6
    assert report.num_charts < 30


def test_noisy_meshes_have_few_charts() -> None:
    """A bumpy floor, as from photogrammetry, is one chart except for its steepest triangles."""
    x, y = np.meshgrid(np.linspace(0, 4, 81), np.linspace(0, 4, 81))
    floor = np.stack([x, y, np.zeros_like(x)], axis=-1)
    floor += np.random.default_rng(1).normal(0, 0.01, floor.shape)
    corner = np.arange(81 * 81).reshape(81, 81)
    a, b, c, d = (q.ravel() for q in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    made, report = unwrapped(Mesh(floor.reshape(-1, 3).astype(np.float32), faces.astype(np.int32)))
    assert own_uv_fault(made) == ""
    assert report.num_charts < 0.03 * len(faces)
    assert report.coverage > 0.8


def test_a_ramp_over_itself_is_cut() -> None:
    """A spiral ramp of three turns faces up everywhere: it is one planar chart, which overlaps itself."""
    angle = np.linspace(0, 6 * np.pi, 200)
    rim = [np.column_stack([r * np.cos(angle), r * np.sin(angle), 0.1 * angle]) for r in (0.5, 1.5)]
    k = np.arange(len(angle) - 1)
    faces = np.concatenate([np.column_stack([k, k + 200, k + 1]), np.column_stack([k + 1, k + 200, k + 201])])
    mesh = Mesh(np.concatenate(rim).astype(np.float32), faces.astype(np.int32))
    assert len(np.unique(PlanarCharts(mesh).chart)) == 1
    made, report = unwrapped(mesh)
    assert own_uv_fault(made) == ""
    assert overlap(made) < 1e-3
    assert 3 <= report.num_charts < len(faces) / 4


def test_broken_triangles_are_unwrapped() -> None:
    """Triangles without area, duplicates, and edges shared by three triangles."""
    mesh = tiled_room()
    flat = np.repeat(mesh.faces[:5, :1], 3, axis=1)
    line = np.column_stack([mesh.faces[:5, 0], mesh.faces[:5, 1], mesh.faces[:5, 0]])
    fin = np.column_stack([mesh.faces[:5, 0], mesh.faces[:5, 1], mesh.faces[5:10, 2]])
    faces = np.concatenate([flat, mesh.faces, line, fin, mesh.faces[:3]]).astype(np.int32)
    made, _ = unwrapped(Mesh(mesh.positions, faces, mesh.normals))
    assert own_uv_fault(made) == ""
    np.testing.assert_array_equal(corner_positions(made), mesh.positions[faces])


def test_charts_preserve_area() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    mesh = Mesh(np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces, np.int32))
    charts = PlanarCharts(mesh)
    flat = charts.projected()
    for of_chart in (charts.chart == k for k in np.unique(charts.chart)):
        np.testing.assert_allclose(uv_areas(flat)[of_chart].sum(), mesh.areas()[of_chart].sum(), rtol=1e-4)


def test_padding_is_measured() -> None:
    """Two squares in the atlas, 4 texels apart, then touching."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    for gap in (4, 0):
        uv = np.concatenate([square * 0.25, square * 0.25 + [0.25 + gap / 1024, 0]]).astype(np.float32)
        positions = np.concatenate([np.pad(square, ((0, 0), (0, 1))), np.pad(square, ((0, 0), (0, 1))) + 3])
        faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
        assert uv_module.padding_texels(Mesh(positions.astype(np.float32), faces, None, uv)) == gap

# SPDX-License-Identifier: MIT
"""A mesh's valid unwrap is kept; new unwraps are valid and of one density."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import face_normals
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.unwrap import uv as uv_module
from model.reconstruction.unwrap.uv import own_uv_fault, shelf_packed, triangle_sheet, unwrapped
from oracles.textured_room import room_mesh
from tests.datagen.small_library import room_shapes, with_uv

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def tiled_room() -> Mesh:
    """A furnished room with repeating UVs, which are no unwrap."""
    return with_uv(trimesh.util.concatenate(list(room_shapes(5, 4, 2.7).values())))


def overlap(mesh: Mesh, size: int = 512) -> float:
    covered, several = TexelSurface(mesh, face_normals(mesh), size).overlap_mask((0.513, 0.487))
    return several.sum() / covered.sum()


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


def test_xatlas_gives_a_valid_unwrap_that_keeps_triangles_and_density() -> None:
    mesh = tiled_room()
    made, report = unwrapped(mesh)
    assert report.source == "xatlas" and "outside" in report.rejected
    assert report.num_fallback_faces == 0
    np.testing.assert_array_equal(corner_positions(made), corner_positions(mesh))
    assert made.normals is not None and mesh.normals is not None
    np.testing.assert_array_equal(made.normals[made.faces], mesh.normals[mesh.faces])
    assert own_uv_fault(made) == ""
    assert report.stretch < 1.3
    assert report.coverage > 0.4
    assert report.padding_texels is not None and report.padding_texels >= 1
    assert report.notes == [f"the mesh's own UVs are not used: {report.rejected}"]


@pytest.mark.parametrize("has_room", [True, False])
def test_triangles_too_small_for_xatlas_are_unwrapped(has_room: bool) -> None:
    """A knob of 2 mm with 5,120 triangles, alone and in a room: xatlas omits such short edges; where it omits
    a whole piece, the piece's size is NaN."""
    knob = trimesh.creation.icosphere(subdivisions=4, radius=1e-3)
    shape = trimesh.util.concatenate([knob, trimesh.creation.box((4, 3, 2.5))]) if has_room else knob
    mesh = Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32))
    made, report = unwrapped(mesh)
    assert report.source == "xatlas" and report.num_fallback_faces == report.num_blender_faces == 0
    assert made.uv is not None and np.isfinite(made.uv).all()
    np.testing.assert_allclose(corner_positions(made), corner_positions(mesh))
    assert report.stretch < 1.6


def test_an_unplaced_piece_is_laid_out_by_triangles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(uv_module, "XATLAS_PROCESS", "tests.model.places_nothing")
    monkeypatch.setattr(uv_module, "find_spec", lambda name: None)
    mesh = tiled_room()
    made, report = unwrapped(mesh)
    assert report.num_fallback_faces == len(mesh.faces)
    assert made.uv is not None and np.isfinite(made.uv).all()


def test_pieces_share_one_density_also_after_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small pieces share one density; pieces where xatlas crashes are laid out triangle by triangle."""
    mesh = tiled_room()
    monkeypatch.setattr(uv_module, "PIECE_FACES", 70)
    made, report = unwrapped(mesh)
    assert own_uv_fault(made) == "" and report.stretch < 1.3
    monkeypatch.setattr(uv_module, "PIECE_TIMEOUT_S", 0.01)
    made, report = unwrapped(mesh)
    assert report.num_fallback_faces == len(mesh.faces)
    assert own_uv_fault(made) == ""
    assert report.stretch == pytest.approx(1, abs=0.01)
    assert report.coverage > 0.2  # half of each triangle's box stays empty


@pytest.mark.bpy
def test_blender_replaces_a_failed_xatlas(monkeypatch: pytest.MonkeyPatch) -> None:
    """If xatlas fails, Blender's layout is valid and of one density, and the report names it."""
    pytest.importorskip("bpy", reason="Blender's Python module is not installed")
    mesh = tiled_room()
    monkeypatch.setattr(uv_module, "XATLAS_PROCESS", "model.reconstruction.no_such_process")
    made, report = unwrapped(mesh)
    assert report.num_blender_faces + report.num_fallback_faces == len(mesh.faces)
    assert report.num_fallback_faces < 0.02 * len(mesh.faces)
    assert own_uv_fault(made) == ""
    np.testing.assert_array_equal(corner_positions(made), corner_positions(mesh))
    assert report.stretch < 1.6 and report.coverage > 0.2
    assert any("Blender unwrapped them" in note for note in report.notes)


def test_padding_is_measured() -> None:
    """Two squares in the atlas, 4 texels apart, then touching."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    for gap in (4, 0):
        uv = np.concatenate([square * 0.25, square * 0.25 + [0.25 + gap / 1024, 0]]).astype(np.float32)
        positions = np.concatenate([np.pad(square, ((0, 0), (0, 1))), np.pad(square, ((0, 0), (0, 1))) + 3])
        faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
        assert uv_module.padding_texels(Mesh(positions.astype(np.float32), faces, None, uv)) == gap


def test_triangle_sheet_is_isometric() -> None:
    mesh = trimesh.creation.icosphere(2)
    corners, size = triangle_sheet(mesh.vertices, mesh.faces)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        flat = np.linalg.norm(corners[:, a] - corners[:, b], axis=1)
        solid = np.linalg.norm(mesh.vertices[mesh.faces[:, a]] - mesh.vertices[mesh.faces[:, b]], axis=1)
        np.testing.assert_allclose(flat, solid, rtol=1e-6)
    assert (corners >= 0).all() and (corners <= size).all()


def test_shelves_do_not_overlap() -> None:
    boxes = np.random.default_rng(0).uniform(0.05, 1, (60, 2))
    places, side = shelf_packed(boxes)
    ends = places + boxes
    assert (places >= 0).all() and ends.max() <= side * (1 + 1e-9)
    apart = (places[:, None] >= ends[None] - 1e-9) | (ends[:, None] <= places[None] + 1e-9)
    assert (apart.any(axis=-1) | np.eye(60, dtype=bool)).all()
    assert boxes.prod(axis=1).sum() / side**2 > 0.6

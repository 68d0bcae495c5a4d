# SPDX-License-Identifier: MIT
"""Removal of noise from meshes: accuracy of normals and positions, edges, curvature, unchanged parts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from datagen.formats.capture import Capture, CaptureGeometry, GeometryPart
from datagen.foundation.meshes.mesh import Mesh, area_vectors
from model.evaluation.mesh_errors import GeometryError, with_errors
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.infer_options import InferReport
from model.reconstruction.mesh.smoothing import mended_mesh, noise_deg, smoothed
from model.reconstruction.predict.sources import TRUTH
from model.reconstruction.stages import Run
from oracles.textured_room import room_capture

HALF_M, NOISE_M = 0.5, 0.006
OPTIONS = InferOptions(atlas=64, has_exr=False, is_checked=False)


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32))


def cube() -> Mesh:
    """A cube with sides of 1 m, of triangles with edges of about 6 cm."""
    shape = trimesh.creation.box((2 * HALF_M,) * 3)
    return mesh_of(trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(shape.vertices, shape.faces, 0.09)))


def noisy(mesh: Mesh, noise_m: float = NOISE_M) -> Mesh:
    offset = np.random.default_rng(3).normal(0, noise_m, mesh.positions.shape)
    return replace(mesh, positions=(mesh.positions + offset).astype(np.float32))


def free(mesh: Mesh) -> NDArray[np.bool_]:
    return np.zeros(len(mesh.faces), np.bool_)


def normals(mesh: Mesh) -> NDArray[np.float64]:
    vectors = area_vectors(mesh.triangles())
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def turned_deg(mesh: Mesh, true: Mesh) -> NDArray[np.float64]:
    """Angles (M,) in degrees between the normals of corresponding triangles."""
    return np.degrees(np.arccos(np.clip((normals(mesh) * normals(true)).sum(axis=1), -1, 1)))


def run_in(folder: Path, options: InferOptions = OPTIONS) -> Run:
    return Run(folder, options, InferReport("room"), lambda *_: None)


def test_sides_become_flat_and_edges_stay_sharp() -> None:
    true = cube()
    found = smoothed(noisy(true), free(true))
    assert np.median(turned_deg(noisy(true), true)) > 8
    angle = turned_deg(found, true)
    assert np.median(angle) < 0.7 and np.percentile(angle, 95) < 4
    height = np.abs(np.abs(found.positions).max(axis=1) - HALF_M)
    assert height.mean() < 0.3 * NOISE_M
    corner = np.abs(np.abs(found.positions[np.abs(true.positions).min(axis=1) > 0.49]) - HALF_M)
    assert len(corner) == 8 and corner.max() < 2.5 * NOISE_M


def test_a_sphere_keeps_its_radius() -> None:
    true = mesh_of(trimesh.creation.icosphere(4, 0.6))
    found = smoothed(noisy(true), free(true))
    radius = np.linalg.norm(found.positions, axis=1)
    assert abs(radius.mean() - 0.6) < 0.002 and radius.std() < 0.5 * NOISE_M
    assert np.median(turned_deg(found, true)) < 0.35 * np.median(turned_deg(noisy(true), true))


def test_noise_is_zero_on_modelled_surfaces_only() -> None:
    assert noise_deg(cube()) == pytest.approx(0, abs=0.05)
    assert noise_deg(mesh_of(trimesh.creation.cylinder(0.3, 1.0, sections=8))) == pytest.approx(0, abs=0.05)
    assert noise_deg(mesh_of(trimesh.creation.icosphere(5, 0.6))) < 2
    assert 3 < noise_deg(noisy(cube())) < 10
    assert noise_deg(noisy(cube(), 0.0003)) < 1
    apart = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    assert noise_deg(apart) == 0


def test_vertices_split_at_seams_stay_together() -> None:
    """The result does not depend on how vertices are split for texture coordinates."""
    rough = noisy(cube())
    uv = np.random.default_rng(0).random((3 * len(rough.faces), 2)).astype(np.float32)
    split = Mesh(
        rough.positions[rough.faces.ravel()],
        np.arange(3 * len(rough.faces), dtype=np.int32).reshape(-1, 3),
        np.zeros((3 * len(rough.faces), 3), np.float32),
        uv,
    )
    found = smoothed(split, free(split))
    assert found.normals is None and found.uv is uv
    np.testing.assert_array_equal(found.triangles(), smoothed(rough, free(rough)).triangles())


def test_fixed_triangles_and_collapsed_ones_are_harmless() -> None:
    rough = noisy(cube())
    collapsed = replace(rough, faces=np.vstack([rough.faces, [[0, 0, 1], [2, 2, 2]]]).astype(np.int32))
    is_fixed = free(collapsed)
    is_fixed[:40] = True
    found = smoothed(collapsed, is_fixed)
    assert np.isfinite(found.positions).all()
    np.testing.assert_array_equal(found.triangles()[:40], collapsed.triangles()[:40])
    assert not np.array_equal(found.positions, collapsed.positions)


def noisy_capture() -> Capture:
    capture = room_capture(2, (32, 24))
    error = GeometryError(edge_m=0.2, noise_m=0.02)
    rough = with_errors(capture.geometry, error).mesh
    lamp = Mesh(*(np.asarray(a) for a in ([[1, 1, 1], [1.2, 1, 1], [1, 1.2, 1.1]], [[0, 1, 2]])))
    positions = np.concatenate([rough.positions, lamp.positions.astype(np.float32)])
    faces = np.concatenate([rough.faces, lamp.faces + len(rough.positions)]).astype(np.int32)
    parts = (GeometryPart("room", 0, len(rough.faces)), GeometryPart("lamp", len(rough.faces), 1, (5, 5, 5)))
    return replace(capture, geometry=CaptureGeometry(Mesh(positions, faces), parts))


def test_only_noisy_meshes_change(tmp_path: Path) -> None:
    clean, run = room_capture(2, (32, 24)), run_in(tmp_path)
    assert mended_mesh(clean, run) is clean and run.report.notes == []
    assert run.report.mesh == {"noise_deg": 0.0}
    capture, run = noisy_capture(), run_in(tmp_path)
    found = mended_mesh(capture, run)
    assert found.geometry.parts == capture.geometry.parts and found.views is capture.views
    np.testing.assert_array_equal(found.geometry.mesh.faces, capture.geometry.mesh.faces)
    np.testing.assert_array_equal(found.geometry.mesh.positions[-3:], capture.geometry.mesh.positions[-3:])
    report = run.report.mesh
    assert report["noise_deg"] > 4 > 1 > report["left_deg"] and 5 < report["moved_mm_50"] < 40
    assert report["moved_mm_50"] < report["moved_mm_95"] and "--no-mend-mesh" in run.report.notes[0]


@pytest.mark.usefixtures("mitsuba_variant")
def test_the_asset_has_the_smoothed_mesh_unless_refused(tmp_path: Path) -> None:
    noise = {}
    for name, is_mended in (("smooth", True), ("given", False)):
        report = infer(noisy_capture(), tmp_path / name, TRUTH, replace(OPTIONS, mends_mesh=is_mended))
        shape = trimesh.load(tmp_path / name / f"{report.name}.glb", force="mesh")
        noise[name] = noise_deg(mesh_of(shape))
        assert bool(report.mesh) == is_mended and any("mended" in n for n in report.notes) == is_mended
    assert noise["smooth"] < 0.2 * noise["given"]

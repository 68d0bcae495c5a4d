# SPDX-License-Identifier: MIT
"""The check before inference passes consistent captures, and reports errors with their amount."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import srgb_from_linear
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png, read_image
from datagen.foundation.meshes.ply import encode_ply
from datagen.geometry.traced import TracedGeometry
from model.reconstruction.captures.photographs import PhotographSource
from model.reconstruction.check.capture_check import check_capture
from model.reconstruction.check.edges import EdgeMatch, edge_field, match_edges, mesh_edges, photograph_field
from model.reconstruction.check.judgement import common_error
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.predict.sources import TRUTH
from tests.model.photographed_room import (
    Photograph,
    photographed_room,
    turned,
    with_color,
    with_mesh,
    with_view,
)

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def test_a_consistent_capture_passes_and_pictures_are_written(tmp_path: Path) -> None:
    capture = photographed_room()
    report = check_capture(capture, tmp_path)
    assert report.all_warnings == []
    assert report.fit > 5 and report.offset_m is None
    assert all(view.coverage == 1 and view.back_share == 0 for view in report.views)
    stored = json.loads((tmp_path / "check.json").read_text())
    assert [view["name"] for view in stored["views"]] == [view.name for view in capture.views]
    sheet = read_image(tmp_path / "sheet-01.png")
    green = (sheet[..., 1] > 200) & (sheet[..., 0] < 150) & (sheet[..., 2] < 150)
    assert green.sum() > 10 * 300  # ten views, and their edge images


@pytest.mark.parametrize("axis", [(1.0, 0, 0), (0, 1.0, 0)])
def test_a_camera_off_by_a_degree_is_named(axis: tuple[float, float, float]) -> None:
    capture = turned(photographed_room(), 3, 1.0, axis)
    report = check_capture(capture)
    (warning,) = report.all_warnings
    assert warning.startswith("view_03: its edges are") and "correct its pose" in warning
    off = report.views[3].off_deg
    assert off is not None and 0.6 < off < 1.4
    # counterpart: a fifth of a degree is negligible
    assert check_capture(turned(photographed_room(), 3, 0.2, axis)).all_warnings == []


@pytest.mark.parametrize("degrees", [2.0, -2.0])
def test_a_rolled_camera_is_named(degrees: float) -> None:
    """With a pose rolled clockwise the photograph's edges are rotated clockwise relative to the mesh's."""
    report = check_capture(turned(photographed_room(), 5, degrees, (0, 0, 1.0)))
    (warning,) = report.all_warnings
    way = "clockwise" if degrees > 0 else "anticlockwise"
    assert warning.startswith("view_05: its edges are turned by") and f"degrees {way} against" in warning
    warp = report.views[5].warp
    assert warp is not None and np.degrees(warp.roll_rad) == pytest.approx(degrees, abs=0.5)
    # counterpart: a third of a degree is negligible
    assert check_capture(turned(photographed_room(), 5, degrees / 6, (0, 0, 1.0))).all_warnings == []


@pytest.mark.parametrize(
    ("metres", "expected"), [(0.12, "large in it; the camera is about"), (-0.12, "small in")]
)
def test_a_camera_moved_along_its_axis_is_named(metres: float, expected: str) -> None:
    capture = photographed_room()
    camera = capture.views[1].camera
    pose = camera.world_from_camera.copy()
    pose[:3, 3] += metres * camera.forward
    report = check_capture(with_view(capture, 1, camera=replace(camera, world_from_camera=pose)))
    (warning,) = report.all_warnings
    assert warning.startswith("view_01: the mesh looks") and expected in warning
    warp = report.views[1].warp
    assert warp is not None
    assert (1 - warp.zoom) * report.views[1].zoom_depth_m == pytest.approx(metres, abs=0.05)


@pytest.mark.parametrize(
    ("offset", "scale"), [((0.02, -0.01, 0.015), 1.02), ((0, 0, 0), 0.98), ((0.02, 0, 0), 1)]
)
def test_offset_and_scale_of_a_mesh_are_separated(offset: tuple[float, float, float], scale: float) -> None:
    """Shifts of points 3 m ahead, with 0.1 px of noise and two outliers, determine offset and scale."""
    rng = np.random.default_rng(0)
    cameras = []
    for _ in range(14):
        eye = rng.uniform(-1.5, 1.5, 3)
        cameras.append(
            Camera(320, 220, 200, 205, 160, 110, look_at(eye, eye + rng.normal(size=3) * [1, 1, 0.3]))
        )
    middle = np.mean([c.position_m for c in cameras], axis=0)
    views = []
    for index, camera in enumerate(cameras):
        point = camera.position_m + 3 * camera.forward
        wrong = point + offset + (scale - 1) * (point - middle)
        shift = camera.project(point[None])[0][0] - camera.project(wrong[None])[0][0]
        shift = shift + rng.normal(0, 0.1, 2) + (20 if index in (3, 8) else 0)
        match = EdgeMatch((float(shift[0]), float(shift[1])), (0.3, 0.0, 0.3), 0.0, 0.0, 0)
        views.append((camera, 3.0, match))
    found = common_error(views)
    assert found is not None
    assert found.scale == pytest.approx(scale, abs=0.002)
    measured = np.zeros(3) if found.offset_m is None else found.offset_m
    np.testing.assert_allclose(measured, offset, atol=0.003)
    assert (found.offset_m is None) == (not any(offset))
    left = np.linalg.norm(found.left_px, axis=1)
    assert left[[3, 8]].min() > 15 and np.delete(left, [3, 8]).max() < 1
    still = [(*view, replace(match, peak_px=(0.2, -0.1))) for *view, match in views]
    assert common_error(still) is None


def test_a_wrong_focal_length_is_reported_once() -> None:
    capture = photographed_room()
    for index, view in enumerate(capture.views):
        longer = replace(view.camera, fx_px=1.04 * view.camera.fx_px, fy_px=1.04 * view.camera.fy_px)
        capture = with_view(capture, index, camera=longer)
    report = check_capture(capture)
    (warning,) = report.all_warnings
    assert warning.startswith("the mesh looks too large by a factor of 1.0")
    assert "in most views; the focal" in warning


def test_a_mesh_off_by_two_centimetres_is_measured() -> None:
    capture = photographed_room()
    offset = np.array([0.012, -0.012, 0.0106], np.float32)
    mesh = capture.geometry.mesh
    report = check_capture(with_mesh(capture, replace(mesh, positions=mesh.positions + offset)))
    assert report.offset_m is not None
    assert np.linalg.norm(np.array(report.offset_m) - offset) < 0.006
    assert "the mesh seems to be moved by" in report.warnings[0] and "view_01" in report.warnings[0]


def test_a_photograph_of_another_room_is_named() -> None:
    """One photograph has unrelated edges; the rest of the capture fits."""
    capture = photographed_room()
    source = capture.views[6].source
    assert isinstance(source, Photograph)
    other = np.zeros_like(source.color)
    rng = np.random.default_rng(1)
    for _ in range(60):
        x, y = rng.integers(0, 300), rng.integers(0, 200)
        cv2.rectangle(other, (x, y), (x + int(rng.integers(10, 90)), y + int(rng.integers(10, 90))),
                      rng.uniform(0, 0.9, 3).tolist(), -1)  # fmt: skip
    (warning,) = check_capture(with_color(capture, 6, other)).all_warnings
    assert warning.startswith("view_06: its edges do not match the mesh's; it shows another scene")


def test_useless_views_are_named() -> None:
    capture = photographed_room()
    source = capture.views[0].source
    assert isinstance(source, Photograph)
    size = source.color.shape
    capture = with_color(capture, 0, np.zeros(size))
    white = np.where(np.arange(size[1])[None, :, None] < 0.7 * size[1], 1.0, capture.views[2].source.color)
    capture = with_color(capture, 2, white)
    camera = capture.views[4].camera
    outside = look_at([12, 1.5, 1.2], [20, 1.5, 1.2])
    capture = with_view(capture, 4, camera=replace(camera, world_from_camera=outside))
    behind = look_at([6.0, 1.5, 1.2], [2, 1.5, 1.2])  # from behind a wall into the room
    capture = with_view(capture, 6, camera=replace(camera, world_from_camera=behind))
    near = look_at([3.98, 1.5, 1.2], [5, 1.5, 1.2])  # 2 cm in front of a wall
    capture = with_view(capture, 8, camera=replace(camera, world_from_camera=near))
    warnings = check_capture(capture).all_warnings
    expected = {
        "view_00": "is black; leave it out",
        "view_02": "over half of it is at the sensor's limit",
        "view_04": "shows nothing of the mesh",
        "view_06": "shows mostly the back of the mesh",
        "view_08": "nearer than 5 cm",
    }
    assert len(warnings) == len(expected)
    for name, text in expected.items():
        assert any(w.startswith(f"{name}: ") and text in w for w in warnings), (name, warnings)


def test_clipped_photographs_of_any_exposure_are_named(tmp_path: Path) -> None:
    """Photographs are scaled to a common exposure, and their limit with them."""
    capture = photographed_room()
    for index, scale, bright in ((0, 0.4, 0.7), (2, 3.0, 0.7), (4, 0.4, 0.4), (6, 3.0, 0.4)):
        view = capture.views[index]
        encoded = srgb_from_linear(np.clip(view.read().color / scale, 0, 0.9)) * 255
        encoded[:, : int(bright * encoded.shape[1])] = 255
        path = tmp_path / f"{index}.png"
        path.write_bytes(encode_png(encoded.astype(np.uint8)))
        capture = with_view(capture, index, source=PhotographSource(path, view.camera, None, "auto", scale))
    clipped = [
        w for w in check_capture(capture).all_warnings if "over half of it is at the sensor's limit" in w
    ]
    assert [warning.split(":")[0] for warning in clipped] == ["view_00", "view_02"]


def test_a_better_up_axis_is_found_and_inference_refuses(tmp_path: Path) -> None:
    """A Y-up mesh is read as Z-up."""
    capture = photographed_room()
    mesh = capture.geometry.mesh
    x, y, z = mesh.positions.T
    wrong = with_mesh(capture, replace(mesh, positions=np.stack([x, z, -y], axis=1), normals=None))
    report = check_capture(wrong)
    assert report.better == "--mesh-up y"
    assert "with --mesh-up y they do" in report.warnings[-1]
    options = InferOptions(atlas=32)
    with pytest.raises(InputError, match=r"--mesh-up y.*--no-check"):
        infer(wrong, tmp_path, TRUTH, options)
    assert not (tmp_path / "report.json").exists()


def test_a_better_unit_is_found() -> None:
    """A mesh in centimetres and cameras in metres, away from the origin, where both units would agree."""
    capture = photographed_room()
    shift = np.array([1.3, -0.7, 0.4])
    for index, view in enumerate(capture.views):
        pose = view.camera.world_from_camera.copy()
        pose[:3, 3] += shift
        capture = with_view(capture, index, camera=replace(view.camera, world_from_camera=pose))
    mesh = capture.geometry.mesh
    positions = (100 * (mesh.positions + shift)).astype(np.float32)
    report = check_capture(with_mesh(capture, replace(mesh, positions=positions, normals=None)))
    assert report.better == "a mesh unit 0.01 times as long"


def test_shifts_are_measured_exactly() -> None:
    """The best match of the mesh's edges with a shifted copy is at the shift."""
    capture = photographed_room()
    view = capture.views[1]
    geometry = TracedGeometry(capture.geometry).trace_view(view.camera)
    edges = mesh_edges(geometry, view.camera)
    assert 0.01 < edges.mean() < 0.2
    for dx, dy in ((0, 0), (4, -3), (-7, 2)):
        moved = np.roll(edges, (dy, dx), axis=(0, 1))
        found = match_edges(edges, edge_field(moved), 12)
        assert found is not None
        np.testing.assert_allclose(found.peak_px, (dx, dy), atol=0.1)
        assert found.at_peak > 8
    flat = photograph_field(np.full((*edges.shape, 3), 0.5, np.float32), np.ones(edges.shape, bool))
    assert np.abs(flat).max() == 0
    assert match_edges(np.zeros_like(edges), flat, 12) is None


def test_edges_are_creases_and_jumps_only() -> None:
    """A view of a bare wall with a corner has one line, where the planes meet."""
    capture = photographed_room()
    camera = Camera(200, 150, 160.0, 160.0, 100.0, 75.0, look_at([2, 1.5, 1.5], [0, 3, 1.5]))
    geometry = TracedGeometry(capture.geometry).trace_view(camera)
    edges = mesh_edges(geometry, camera)
    corner, _ = camera.project(np.array([[0.0, 3.0, 1.5]]))
    columns = np.flatnonzero(edges[75])
    assert set(columns) == {99, 100} and corner[0, 0] == pytest.approx(100)


def test_command_returns_codes(tmp_path: Path) -> None:
    """Photographs on disk with transforms.json: exit code 0, then 1 with a wrong camera."""
    from model.cli import app

    capture = photographed_room()
    (tmp_path / "room.ply").write_bytes(encode_ply(capture.geometry.mesh))
    frames = []
    for view in capture.views:
        pixels = np.round(srgb_from_linear(view.source.color) * 255).astype(np.uint8)  # type: ignore[attr-defined]
        (tmp_path / f"{view.name}.png").write_bytes(encode_png(pixels))
        c = view.camera
        frames.append(
            {"file_path": f"{view.name}.png", "w": c.width_px, "h": c.height_px, "fl_x": c.fx_px,
             "fl_y": c.fy_px, "cx": c.cx_px, "cy": c.cy_px,
             "transform_matrix": (c.world_from_camera @ np.diag([1, -1, -1, 1])).tolist()}
        )  # fmt: skip
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    result = CliRunner().invoke(app, ["check", str(tmp_path), "--out", str(tmp_path / "check"), "--quiet"])
    assert result.exit_code == 0, result.output
    assert "10 views, " in result.output and "0 warnings" in result.output and "up: z" in result.output
    assert (tmp_path / "check" / "sheet-01.png").is_file()
    wrong = turned(capture, 5, 1.5, (0, 1.0, 0)).views[5].camera.world_from_camera
    frames[5]["transform_matrix"] = (wrong @ np.diag([1, -1, -1, 1])).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    result = CliRunner().invoke(app, ["check", str(tmp_path), "--quiet"])
    assert result.exit_code == 1 and "warning: view_05: its edges are" in result.output

# SPDX-License-Identifier: MIT
"""Captures: COLMAP, transforms.json, Mitsuba sensors; lens distortion, encodings, orientation; faults."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image, ImageOps

from datagen.formats.base import canonical_json
from datagen.formats.capture import CaptureFile, Distortion, MeshRecord, PhotographRecord
from datagen.formats.configuration import ViewCamera
from datagen.foundation.budget import Budget
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import linear_from_srgb, srgb_from_linear
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.ply import encode_ply
from model.reconstruction.captures.colmap import MODELS
from model.reconstruction.captures.colmap import read as read_colmap
from model.reconstruction.captures.options import CaptureOptions, Exposure
from model.reconstruction.captures.photographs import (
    PhotographSource,
    fit_orientation,
    lens_pixels,
    linearized,
    undistorted,
    upright,
)
from model.reconstruction.captures.read import read_capture
from tests.datagen.small_library import box, with_uv

SIZE = (64, 40)


def make_cameras(num: int = 3) -> list[Camera]:
    """Cameras around the origin with unusual intrinsics."""
    poses = [look_at([2.0 * np.cos(a), 2.0 * np.sin(a), 1.0 + 0.1 * a], [0, 0, 0.3]) for a in range(num)]
    return [Camera(*SIZE, 55.0, 57.0, 31.0, 21.5, pose) for pose in poses]


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """Quaternion (w, x, y, z) from the eigenvector of Bar-Itzhack's matrix, unlike the reader's formula."""
    m = rotation
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], 0, 0, 0],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], 0, 0],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], 0],
            [m[1, 0] - m[0, 1], m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    return np.linalg.eigh(k)[1][:, -1]


def write_images(folder: Path, num: int, suffix: str = ".png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(num):
        pixels = np.random.default_rng(index).integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
        (folder / f"img{index}{suffix}").write_bytes(encode_png(pixels))


def write_mesh(folder: Path) -> Path:
    path = folder / "room.ply"
    path.write_bytes(encode_ply(with_uv(box([-1, -1, 0], [1, 1, 1]))))
    return path


def write_colmap(folder: Path, cameras: list[Camera], form: str, model: str, parameters: list[float]) -> None:
    """Write a COLMAP model of one lens, text or binary, following the format's description."""
    folder.mkdir(parents=True)
    rows = []
    for index, camera in enumerate(cameras):
        view = camera.camera_from_world
        rows.append((index + 1, *quaternion_of(view[:3, :3]), *view[:3, 3], 7, f"img{index}.png"))
    numbers = " ".join(repr(float(p)) for p in parameters)
    if form == "text":
        (folder / "cameras.txt").write_text(f"# head\n7 {model} {SIZE[0]} {SIZE[1]} {numbers}\n")
        lines = [" ".join(map(str, row)) + "\n1.5 2.5 -1\n" if row[0] == 1 else
                 " ".join(map(str, row)) + "\n\n" for row in rows]  # fmt: skip
        (folder / "images.txt").write_text("# head\n" + "".join(lines))
        return
    names = [name for name, _ in MODELS]
    head = struct.pack("<QiiQQ", 1, 7, names.index(model), *SIZE)
    (folder / "cameras.bin").write_bytes(head + struct.pack(f"<{len(parameters)}d", *parameters))
    data = struct.pack("<Q", len(rows))
    for row in rows:
        data += struct.pack("<i7di", *row[:9]) + row[9].encode() + b"\0"
        data += struct.pack("<Q", 2) + bytes(48)
    (folder / "images.bin").write_bytes(data)


@pytest.mark.parametrize("form", ["text", "binary"])
def test_colmap_poses_and_lens(tmp_path: Path, form: str) -> None:
    cameras = make_cameras()
    lens = [55.0, 57.0, 31.0, 21.5, -0.12, 0.03, 0.001, -0.002]
    write_colmap(tmp_path / "m", cameras, form, "OPENCV", lens)
    posed = read_colmap(tmp_path / "m", None, Budget("x")).images
    assert [p.file for p in posed] == ["img0.png", "img1.png", "img2.png"]
    for expected, got in zip(cameras, posed, strict=True):
        np.testing.assert_allclose(got.camera.world_from_camera, expected.world_from_camera, atol=1e-9)
        assert (got.camera.fx_px, got.camera.fy_px) == (55.0, 57.0)
        assert got.distortion == Distortion(model="brown", coefficients=tuple(lens[4:]))


@pytest.mark.parametrize(
    ("model", "parameters", "expected"),
    [
        ("SIMPLE_PINHOLE", [50, 32, 20], None),
        ("PINHOLE", [50, 51, 32, 20], None),
        ("SIMPLE_RADIAL", [50, 32, 20, 0.1], ("brown", (0.1, 0, 0, 0))),
        ("RADIAL", [50, 32, 20, 0.1, 0.2], ("brown", (0.1, 0.2, 0, 0))),
        ("OPENCV_FISHEYE", [50, 50, 32, 20, 1e-1, 1e-2, 1e-3, 1e-4], ("fisheye", (1e-1, 1e-2, 1e-3, 1e-4))),
        ("SIMPLE_RADIAL_FISHEYE", [50, 32, 20, 0.1], ("fisheye", (0.1,))),
    ],
)
def test_colmap_models(tmp_path: Path, model: str, parameters: list[float], expected: tuple | None) -> None:
    write_colmap(tmp_path / "m", make_cameras(1), "binary", model, parameters)
    (posed,) = read_colmap(tmp_path / "m", None, Budget("x")).images
    assert posed.camera.cx_px == 32 and posed.camera.cy_px == 20 and posed.camera.fx_px == 50
    got = posed.distortion
    assert (None if got is None else (got.model, got.coefficients)) == expected


def test_colmap_faults_are_named(tmp_path: Path) -> None:
    write_colmap(tmp_path / "fov", make_cameras(1), "text", "FOV", [50, 50, 32, 20, 0.5])
    with pytest.raises(InputError, match=r"FOV.*expected PINHOLE"):
        read_colmap(tmp_path / "fov", None, Budget("x"))
    write_colmap(tmp_path / "cut", make_cameras(2), "binary", "PINHOLE", [50, 51, 32, 20])
    images = tmp_path / "cut" / "images.bin"
    for keep in (0, 30, 100, len(images.read_bytes()) - 1):
        images.write_bytes(images.read_bytes()[:keep])
        with pytest.raises(InputError, match=r"ends early|an empty file"):
            read_colmap(tmp_path / "cut", None, Budget("x"))
        images.write_bytes(b"")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no known format"):
        read_capture(tmp_path / "empty")
    write_colmap(tmp_path / "zero", make_cameras(1), "binary", "PINHOLE", [50, 51, 32, 20])
    file = tmp_path / "zero" / "cameras.bin"
    file.write_bytes(file.read_bytes()[:16] + struct.pack("<QQ", 0, 0) + file.read_bytes()[32:])
    write_images(tmp_path / "zero" / "images", 1)
    write_mesh(tmp_path / "zero")
    with pytest.raises(InputError, match="width_px"):
        read_capture(tmp_path / "zero")


def test_text_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    """Editors on Windows write one."""
    write_colmap(tmp_path / "m", make_cameras(2), "text", "PINHOLE", [50, 51, 32, 20])
    for name in ("cameras.txt", "images.txt"):
        path = tmp_path / "m" / name
        path.write_text("\ufeff" + path.read_text().replace("\n", "\r\n"), newline="")
    assert len(read_colmap(tmp_path / "m", None, Budget("x")).images) == 2


@pytest.mark.parametrize("form", ["text", "binary"])
def test_an_unsupported_lens_is_reported_once(tmp_path: Path, form: str) -> None:
    """Regression: the message named ``images``, once per photograph."""
    write_colmap(tmp_path / "m", make_cameras(5), form, "FOV", [50, 50, 32, 20, 0.5])
    with pytest.raises(InputError) as caught:
        read_colmap(tmp_path / "m", None, Budget("x"))
    cameras = tmp_path / "m" / ("cameras.txt" if form == "text" else "cameras.bin")
    assert len(caught.value.problems) == 1
    assert str(caught.value).startswith(f"{cameras}: camera 7 model = FOV; expected PINHOLE")
    assert "colmap image_undistorter" in str(caught.value)


def test_an_unknown_lens_is_reported(tmp_path: Path) -> None:
    write_colmap(tmp_path / "m", make_cameras(3), "text", "RAD_TAN_THIN_PRISM_FISHEYE", [50.0] * 16)
    with pytest.raises(InputError, match=r"cameras\.txt: camera 7 model = RAD_TAN\w+; .*PINHOLE"):
        read_colmap(tmp_path / "m", None, Budget("x"))
    write_colmap(tmp_path / "n", make_cameras(3), "text", "PINHOLE", [50, -50, 32, 20])
    with pytest.raises(InputError) as caught:
        read_colmap(tmp_path / "n", None, Budget("x"))
    assert len(caught.value.problems) == 1 and "cameras.txt: camera 7 parameters" in str(caught.value)


def test_one_fault_of_all_frames_is_reported_once(tmp_path: Path) -> None:
    write_images(tmp_path / "images", 3)
    frames = [{"file_path": f"images/img{k}.png", "transform_matrix": np.eye(4).tolist()} for k in range(3)]
    data = {"fl_x": 55.0, "w": SIZE[0], "h": SIZE[1], "camera_model": "EQUIRECTANGULAR", "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    write_mesh(tmp_path)
    with pytest.raises(InputError) as caught:
        read_capture(tmp_path)
    assert len(caught.value.problems) == 1 and "camera_model = EQUIRECTANGULAR" in str(caught.value)


def test_colmap_capture_is_opened_and_round_trips(tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse" / "0", make_cameras(), "binary", "PINHOLE", [55, 57, 31, 21.5])
    write_images(tmp_path / "images", 3)
    write_mesh(tmp_path)
    capture = read_capture(tmp_path)
    assert [view.name for view in capture.views] == ["img0", "img1", "img2"]
    assert len(capture.geometry.mesh.faces) == 12
    assert capture.notes[0] == "3 cameras in sparse/0 (COLMAP)"
    image = capture.views[1].read()
    stored = np.random.default_rng(1).integers(0, 256, (SIZE[1], SIZE[0], 3)) / 255
    np.testing.assert_allclose(image.color, linear_from_srgb(stored), atol=1e-6)
    assert image.valid_mask.all()
    photographs = [
        PhotographRecord(camera=ViewCamera.from_camera(v.name, v.camera), image=f"images/{v.name}.png")
        for v in capture.views
    ]
    record = CaptureFile(name="room", photographs=tuple(photographs), mesh=MeshRecord(file="room.ply"))
    (tmp_path / "capture.json").write_bytes(canonical_json(record))
    again = read_capture(tmp_path / "capture.json")
    for a, b in zip(capture.views, again.views, strict=True):
        np.testing.assert_array_equal(a.camera.world_from_camera, b.camera.world_from_camera)
        np.testing.assert_array_equal(a.read().color, b.read().color)


def test_frames_up_and_unit_apply_to_cameras_and_mesh(tmp_path: Path) -> None:
    """With Y up and centimetres mesh points keep their pixels; world positions are in metres with Z up."""
    write_colmap(tmp_path / "sparse", make_cameras(), "text", "PINHOLE", [55, 57, 31, 21.5])
    write_images(tmp_path / "images", 3)
    write_mesh(tmp_path)
    plain = read_capture(tmp_path)
    turned = read_capture(tmp_path, CaptureOptions(up="y", unit_m=0.01))
    p, q = plain.geometry.mesh.positions[5], turned.geometry.mesh.positions[5]
    np.testing.assert_allclose(q, 0.01 * np.array([p[0], -p[2], p[1]]), atol=1e-7)
    for a, b in zip(plain.views, turned.views, strict=True):
        np.testing.assert_allclose(a.camera.project(p)[0], b.camera.project(q)[0], atol=1e-4)


def test_transforms_json(tmp_path: Path) -> None:
    write_images(tmp_path / "images", 3)
    write_mesh(tmp_path)
    cameras = make_cameras()
    frames = [
        {
            "file_path": f"./images/img{k}" + ("" if k else ".png"),
            "transform_matrix": (c.world_from_camera @ np.diag([1, -1, -1, 1])).tolist(),
        }
        for k, c in enumerate(cameras)
    ]
    data = {"fl_x": 55.0, "fl_y": 57.0, "cx": 31.0, "cy": 21.5, "w": SIZE[0], "h": SIZE[1], "frames": frames}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(data))
    for expected, view in zip(cameras, read_capture(tmp_path).views, strict=True):
        np.testing.assert_allclose(view.camera.world_from_camera, expected.world_from_camera, atol=1e-12)
        assert (view.camera.fx_px, view.camera.cy_px) == (55.0, 21.5)
    path.write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    view = read_capture(path).views[0]
    assert view.camera.fov_x_rad == pytest.approx(1.0)
    frames[1]["transform_matrix"] = np.ones((4, 4)).tolist()
    frames[2]["file_path"] = "nowhere"
    path.write_text(json.dumps({**data, "frames": frames}))
    with pytest.raises(InputError) as caught:
        read_capture(path)
    text = str(caught.value)
    assert "frames[1].transform_matrix" in text and "nowhere = not found" in text


def test_mitsuba_sensors_project_as_mitsuba_does(tmp_path: Path) -> None:
    write_images(tmp_path, 1)
    write_mesh(tmp_path)
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><sensor type="perspective" id="img0"><float name="fov" value="60"/>'
        '<transform name="to_world"><lookat origin="2,1,1.5" target="0,0,0.3" up="0,0,1"/></transform>'
        f'<film type="hdrfilm"><integer name="width" value="{SIZE[0]}"/>'
        f'<integer name="height" value="{SIZE[1]}"/></film></sensor></scene>'
    )
    (view,) = read_capture(tmp_path / "scene.xml").views
    expected = look_at([2, 1, 1.5], [0, 0, 0.3])
    np.testing.assert_allclose(view.camera.world_from_camera, expected, atol=1e-9)
    assert view.camera.fov_x_rad == pytest.approx(np.radians(60), abs=1e-6)


def _pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack([0.5 + 0.3 * np.sin(3 * x), 0.5 + 0.3 * np.cos(2 * y), 0.5 + 0.2 * x * y], axis=-1)


@pytest.mark.parametrize(
    "distortion",
    [
        None,
        Distortion(model="brown", coefficients=(-0.18, 0.04, 0.003, -0.002, 0.01)),
        Distortion(model="fisheye", coefficients=(0.05, -0.01, 0.002)),
    ],
)
def test_distortion_is_undone(distortion: Distortion | None) -> None:
    """A smooth pattern on the plane z = 1, distorted by the lens, is restored to the pinhole's image."""
    lens = Camera(160, 100, 140.0, 143.0, 79.0, 52.0, np.eye(4))
    pinhole = Camera(160, 100, 150.0, 150.0, 80.0, 50.0, np.eye(4))
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    pixels = lens.pixel_centers().reshape(-1, 1, 2)
    if distortion is None:
        ideal = cv2.undistortPoints(pixels, matrix, np.zeros(5))
    elif distortion.model == "brown":
        ideal = cv2.undistortPointsIter(
            pixels, matrix, np.array(distortion.coefficients), None, None,
            (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10),
        )  # fmt: skip
    else:
        ideal = cv2.fisheye.undistortPoints(pixels, matrix, np.array([*distortion.coefficients, 0.0]))
    seen = _pattern(ideal[:, 0, 0], ideal[:, 0, 1]).reshape(100, 160, 3).astype(np.float32)
    image = undistorted(seen, lens, distortion, pinhole)
    x, y = np.moveaxis(pinhole.unproject(pinhole.pixel_centers(), np.ones((100, 160)))[..., :2], -1, 0)
    error = np.abs(image.color - _pattern(x, y))[image.valid_mask]
    # Bilinear interpolation errs by at most h^2/8 times the second derivative, 2.7 + 1.2, with h = 1/140, and
    # remap's rounding to 1/32 pixel by 1/64 pixel times a gradient of 0.9/140 per pixel in x and y.
    limit = 3.9 / 8 / 140**2 + 2 * 0.9 / 140 / 64
    assert image.valid_mask.mean() > 0.8
    assert np.quantile(error, 0.99) < limit
    shifted = Camera(160, 100, 150.0, 150.0, 80.5, 50.0, np.eye(4))  # an error of half a pixel is detected
    wrong = undistorted(seen, lens, distortion, shifted)
    assert np.quantile(np.abs(wrong.color - _pattern(x, y))[wrong.valid_mask], 0.5) > 0.1 * limit
    assert np.quantile(np.abs(wrong.color - _pattern(x, y))[wrong.valid_mask], 0.99) > 2 * limit


@pytest.mark.parametrize(
    ("model", "fold"),
    [
        ("brown", 1 / np.sqrt(3 * 0.3)),  # d/dr r (1 - 0.3 r^2) = 0
        ("fisheye", np.tan(1 / np.sqrt(3 * 0.5))),  # d/dt t (1 - 0.5 t^2) = 0, t = atan r
    ],
)
def test_strong_barrel_distortion_shows_nothing_twice(
    model: Literal["brown", "fisheye"], fold: float
) -> None:
    lens = Camera(80, 80, 30.0, 30.0, 40.0, 40.0, np.eye(4))
    distortion = Distortion(model=model, coefficients=(-0.3 if model == "brown" else -0.5,))
    image = undistorted(np.ones((80, 80, 3), np.float32), lens, distortion, lens)
    r = np.hypot(*(lens.pixel_centers() - 40.0).transpose(2, 0, 1)) / 30
    assert not image.valid_mask[r > fold + 0.05].any()
    assert image.valid_mask[r < fold - 0.05].all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_agrees_with_pillow(tmp_path: Path, orientation: int) -> None:
    pixels = np.random.default_rng(3).integers(0, 255, (6, 9, 3)).astype(np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "photo.png"
    Image.fromarray(pixels).save(path, exif=exif)
    expected = np.asarray(ImageOps.exif_transpose(Image.open(path)))
    np.testing.assert_array_equal(upright(pixels, orientation), expected)
    tall = Camera(6, 9, 5.0, 5.0, 3.0, 4.5, np.eye(4))
    if orientation >= 5:
        np.testing.assert_array_equal(fit_orientation(pixels, path, tall), expected)
    else:
        with pytest.raises(InputError, match="size = 9x6"):
            fit_orientation(pixels, path, tall)


@pytest.mark.parametrize("up", ["auto", "cameras"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_up_is_estimated_from_photographs_held_upright(
    tmp_path: Path, orientation: int, up: Literal["auto", "cameras"]
) -> None:
    """Cameras calibrated on stored pixels, which EXIF turns. The world has z up."""
    cameras = make_cameras(5)
    stored = []
    for index, camera in enumerate(cameras):
        right, down, forward = camera.world_from_camera[:3, :3].T
        axes = {1: (right, down), 3: (-right, -down), 6: (down, -right), 8: (-down, right)}[orientation]
        pose = camera.world_from_camera.copy()
        pose[:3, :3] = np.stack([*axes, forward], axis=1)
        stored.append(replace(camera, world_from_camera=pose))
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.new("RGB", SIZE, (90, 90, 90)).save(tmp_path / f"img{index}.png", exif=exif)
    write_colmap(tmp_path / "sparse", stored, "text", "PINHOLE", [55, 57, 31, 21.5])
    write_mesh(tmp_path)
    capture = read_capture(tmp_path, CaptureOptions(images=tmp_path, up=up))
    for view, camera in zip(capture.views, cameras, strict=True):
        assert view.camera.forward[2] == pytest.approx(camera.forward[2], abs=1e-6)
        assert view.camera.position_m[2] == pytest.approx(camera.position_m[2], abs=1e-6)


def test_encodings(tmp_path: Path) -> None:
    linear = np.linspace(0, 1, 24, dtype=np.float32).reshape(2, 4, 3)
    for dtype in (np.uint8, np.uint16):
        top = np.iinfo(dtype).max
        stored = np.round(srgb_from_linear(linear) * top).astype(dtype)
        np.testing.assert_allclose(linearized(stored, "auto"), linear, atol=1.2 / top * 2)
        gamma = np.round(linear ** (1 / 2.2) * top).astype(dtype)
        np.testing.assert_allclose(linearized(gamma, "gamma22"), linear, atol=1.2 / top * 2)
    np.testing.assert_array_equal(linearized(linear * 7, "auto"), linear * 7)
    grey = linearized(np.full((2, 2, 1), 255, np.uint8), "srgb")
    np.testing.assert_array_equal(grey, np.ones((2, 2, 3), np.float32))


def test_exr_and_wide_views(tmp_path: Path) -> None:
    """A wide linear EXR is reduced by averaging, with its camera."""
    write_mesh(tmp_path)
    pixels = np.random.default_rng(0).random((40, 64, 3)).astype(np.float32)
    with OpenEXR.File({}, {"RGB": pixels}) as file:
        file.write(str(tmp_path / "a.exr"))
    matrix = np.diag([1.0, -1, -1, 1]).tolist()
    frames = [{"file_path": "a.exr", "transform_matrix": matrix, "fl_x": 50.0, "w": 64, "h": 40}]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    (view,) = read_capture(tmp_path, CaptureOptions(max_width_px=32)).views
    assert (view.camera.width_px, view.camera.height_px, view.camera.fx_px) == (32, 20, 25.0)
    expected = pixels.reshape(20, 2, 32, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(view.read().color, expected, atol=1e-6)


def test_exif_exposures_are_equalised(tmp_path: Path) -> None:
    write_mesh(tmp_path)
    frames = []
    for index, time_s in enumerate((0.01, 0.02, 0.04)):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: time_s, 0x829D: 4.0, 0x8827: 200})
        Image.new("RGB", SIZE, (100, 100, 100)).save(tmp_path / f"{index}.jpg", exif=exif)
        pose = np.eye(4)
        pose[0, 3] = 0.01 * index  # different positions: no bracket
        frames.append({"file_path": f"{index}.jpg", "transform_matrix": pose.tolist(), "fl_x": 50.0})
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))

    def levels(exposure: Exposure) -> list[float]:
        opened = read_capture(tmp_path, CaptureOptions(exposure=exposure))
        return [float(view.read().color.mean()) for view in opened.views]

    base = float(linear_from_srgb(np.array(100 / 255)))
    np.testing.assert_allclose(levels("exif"), [2 * base, base, base / 2], rtol=1e-4)
    np.testing.assert_allclose(levels("auto"), [2 * base, base, base / 2], rtol=1e-4)
    np.testing.assert_allclose(levels("common"), [base] * 3, rtol=1e-4)
    Image.new("RGB", SIZE, (100, 100, 100)).save(tmp_path / "1.jpg")
    np.testing.assert_allclose(levels("auto"), [base] * 3, rtol=1e-4)
    with pytest.raises(InputError, match=r"1\.jpg: EXIF"):
        levels("exif")


@pytest.mark.parametrize("exposure_scale", [1.0, 0.5])
def test_clipped_pixels_are_marked(tmp_path: Path, exposure_scale: float) -> None:
    """A value of 255 clips its channel of the pixel, also at half resolution; 245 does not."""
    pixels = np.full((6, 8, 3), 128, np.uint8)
    pixels[2, 4, 1] = 255
    pixels[0, 0, 0] = 245
    path = tmp_path / "photograph.png"
    path.write_bytes(encode_png(pixels))
    camera = Camera(8, 6, 8.0, 8.0, 4.0, 3.0, np.eye(4))
    source = PhotographSource(path, camera, None, "auto", exposure_scale)
    for lens, place in ((camera, (2, 4, 1)), (camera.scaled(4, 3), (1, 2, 1))):
        image = source.read(lens)
        assert image.clipped_mask is not None and image.limit == exposure_scale
        assert [tuple(at) for at in np.argwhere(image.clipped_mask)] == [place]


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("encoding", ["auto", "gamma22"])
def test_sixteen_bits_from_files(tmp_path: Path, suffix: str, encoding: Literal["auto", "gamma22"]) -> None:
    """A ramp finer than 8 bits is read as linear within a 16-bit step."""
    write_mesh(tmp_path)
    linear = np.linspace(0.05, 0.9, SIZE[0] * SIZE[1] * 3).reshape(SIZE[1], SIZE[0], 3)
    stored = srgb_from_linear(linear) if encoding == "auto" else linear ** (1 / 2.2)
    pixels = np.round(stored * 65535).astype(np.uint16)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), pixels[..., ::-1])
    frames = [{"file_path": f"a{suffix}", "transform_matrix": np.eye(4).tolist(), "fl_x": 50.0,
               "w": SIZE[0], "h": SIZE[1]}]  # fmt: skip
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    (view,) = read_capture(tmp_path, CaptureOptions(encoding=encoding)).views
    np.testing.assert_allclose(view.read().color, linear, atol=3e-5)


def test_photographs_of_several_shapes_may_be_rotated(tmp_path: Path) -> None:
    """A JPEG with an EXIF rotation of 90 degrees and a landscape one are read upright in one capture."""
    write_mesh(tmp_path)
    ramp = np.tile(np.linspace(40, 220, 60).astype(np.uint8)[:, None, None], (1, 90, 3))  # dark at the top
    exif = Image.Exif()
    exif[0x0112] = 6  # stored rotated: displayed after a clockwise rotation
    lying = np.ascontiguousarray(np.rot90(ramp.transpose(1, 0, 2)[:, ::-1], 0))
    upright_ramp = np.rot90(lying, -1)
    Image.fromarray(lying).save(tmp_path / "a.jpg", exif=exif, quality=100, subsampling=0)
    Image.fromarray(ramp).save(tmp_path / "b.jpg", quality=100, subsampling=0)
    frames = [
        {"file_path": "a.jpg", "transform_matrix": np.eye(4).tolist(), "fl_x": 50.0, "w": 90, "h": 60},
        {"file_path": "b.jpg", "transform_matrix": np.eye(4).tolist(), "fl_x": 50.0, "w": 90, "h": 60},
        {"file_path": "b.jpg", "transform_matrix": np.eye(4).tolist(), "fl_x": 25.0, "w": 45, "h": 30},
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    turned, wide, small = read_capture(tmp_path).views
    expected = linear_from_srgb(upright_ramp / 255)
    assert turned.read().color.shape == (60, 90, 3)
    np.testing.assert_allclose(turned.read().color, expected, atol=0.02)
    np.testing.assert_allclose(wide.read().color, linear_from_srgb(ramp / 255), atol=0.02)
    assert small.read().color.shape == (30, 45, 3)
    assert len({turned.name, wide.name, small.name}) == 3


def test_polynomial_lens_is_undone() -> None:
    """Distortion with a term k4 r^8, as in RealityCapture and Metashape, is undone to the pinhole's image."""
    lens = Camera(160, 100, 140.0, 143.0, 79.0, 52.0, np.eye(4))
    pinhole = Camera(160, 100, 150.0, 150.0, 80.0, 50.0, np.eye(4))
    distortion = Distortion(model="polynomial", coefficients=(-0.1, 0.05, 0.003, -0.004, -0.02, 0.3))
    rays = pinhole.unproject(pinhole.pixel_centers(), np.ones((100, 160)))[..., :2]
    where = lens_pixels(lens, distortion, rays)
    x, y = np.meshgrid(np.arange(160) + 0.5, np.arange(100) + 0.5)
    stored = np.stack([x / 160, y / 100, x * y / 16000], axis=-1).astype(np.float32)  # pixel positions
    image = undistorted(stored, lens, distortion, pinhole)
    found = image.color[..., :2] * [160, 100]
    error = np.abs(found - where)[image.valid_mask]
    assert image.valid_mask.mean() > 0.8 and np.quantile(error, 0.99) < 0.05  # remap's table is 1/32 pixel

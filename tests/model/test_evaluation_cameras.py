# SPDX-License-Identifier: MIT
"""Simulated camera faults: each has the stated size and changes nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from datagen.formats.capture import Capture, CaptureGeometry, CaptureView, ColorImage, GeometryPart
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import srgb_from_linear
from datagen.foundation.errors import InputError
from datagen.foundation.meshes.mesh import Mesh
from model.evaluation.camera_faults import PRESETS, CameraFaults, as_taken, photographed
from model.evaluation.suite import describe_suite, read_suite
from tests.conftest import REPOSITORY

SMALL = REPOSITORY / "scenes" / "suites" / "small.yaml"
CAMERA = Camera(96, 64, 80.0, 80.0, 48.0, 32.0, look_at(np.zeros(3), np.array([1.0, 0.2, 0.1])))


class _Image:
    def __init__(self, color: NDArray):
        self.color = color

    def read(self, camera: Camera) -> ColorImage:
        np.testing.assert_array_equal(camera.world_from_camera, CAMERA.world_from_camera)  # the true position
        return ColorImage(self.color.astype(np.float32), np.ones(self.color.shape[:2], bool))

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        return {name: np.zeros((64, 96, 1)) for name in names}


def _capture(num_views: int = 40) -> Capture:
    """A capture with radiances from 0.02 to 0.8, and a lamp of 40 on 2 % of every image."""
    random = np.random.default_rng(3)
    images = random.uniform(0.02, 0.8, (num_views, 64, 96, 3))
    images.reshape(num_views, -1, 3)[:, : 64 * 96 // 50] = 40.0
    views = tuple(CaptureView(f"view-{k:03d}", CAMERA, _Image(image)) for k, image in enumerate(images))
    mesh = Mesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32))
    return Capture("room", views, CaptureGeometry(mesh, (GeometryPart("wall", 0, 1),)))


def _taken(capture: Capture, **fields: object) -> list[NDArray]:
    faults = CameraFaults.model_validate({"name": "own", **fields})
    return [view.read().color for view in as_taken(capture, faults).views]


def test_a_camera_without_faults_changes_nothing() -> None:
    capture = _capture(3)
    for view, color in zip(capture.views, _taken(capture), strict=True):
        np.testing.assert_allclose(color, view.read().color, rtol=1e-4)


def test_the_given_share_of_pixels_is_clipped_lamps_first() -> None:
    capture = _capture(10)
    limit = max(float(color.max()) for color in _taken(capture, clipped_share=0.3))
    true = np.concatenate([view.read().color.max(axis=2).ravel() for view in capture.views])
    assert (true > limit * 1.0001).mean() == pytest.approx(0.3, abs=0.01)
    assert limit < 0.8  # below all lamp pixels


def test_every_image_has_its_own_exposure() -> None:
    capture = _capture()
    stops = [
        np.log2(np.median(color / view.read().color))
        for view, color in zip(capture.views, _taken(capture, exposure_stops=0.5), strict=True)
    ]
    assert np.std(stops) == pytest.approx(0.5, rel=0.35) and abs(np.mean(stops)) < 0.3


def test_bit_depth_quantises() -> None:
    ramp = np.broadcast_to(np.linspace(0, 1, 96)[None, :, None], (64, 96, 3))
    eight = photographed(ramp, CAMERA, CameraFaults(name="x", bits=8))
    steps = srgb_from_linear(eight) * 255
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-4)
    fourteen = photographed(ramp, CAMERA, CameraFaults(name="x", bits=14))
    assert np.abs(fourteen - ramp).max() <= 0.5 / (2**14 - 1) + 1e-12
    squeezed = photographed(ramp, CAMERA, CameraFaults(name="x", bits=8, jpeg=30))
    assert 1e-4 < np.abs(squeezed - eight).mean() < 0.05


def test_the_curve_is_steeper_in_the_middle_with_fixed_ends() -> None:
    levels = np.broadcast_to(np.array([0.0, 0.05, 0.214, 0.6, 1.0]).repeat(20)[None, :96, None], (64, 96, 3))
    curved = photographed(levels, CAMERA, CameraFaults(name="x", contrast=0.1))[0, ::20, 0]
    assert curved[0] == pytest.approx(0, abs=1e-6) and curved[4] == pytest.approx(1, abs=1e-6)
    assert curved[1] < 0.05 and curved[2] == pytest.approx(0.214, abs=0.01) and curved[3] > 0.6
    assert (np.diff(curved) > 0).all()


def test_noise_has_photon_and_read_parts() -> None:
    flat = np.full((64, 96, 3), 0.25)
    faults = CameraFaults(name="x", white_electrons=400.0, read_electrons=6.0)
    noisy = photographed(flat, CAMERA, faults)
    assert noisy.mean() == pytest.approx(0.25, abs=0.005)
    assert noisy.std() == pytest.approx(np.sqrt(0.25 * 400 + 36) / 400, rel=0.05)


def test_vignetting_and_distortion_are_applied() -> None:
    flat = np.full((64, 96, 3), 0.5)
    dark = photographed(flat, CAMERA, CameraFaults(name="x", vignetting_stops=1.0))[..., 0]
    assert dark[32, 48] == pytest.approx(0.5, rel=0.01) and dark[0, 0] == pytest.approx(0.25, rel=0.05)
    stripe = np.zeros((64, 96, 3))
    stripe[:, 80:83] = 1.0  # at x = 0.419, which k1 = -0.1 moves to 0.419 (1 - 0.1 r^2)
    bent = photographed(stripe, CAMERA, CameraFaults(name="x", distortion=-0.1))[..., 0]
    middle, edge = ((bent[row] * np.arange(96)).sum() / bent[row].sum() for row in (32, 2))
    assert middle == pytest.approx(48 + 80 * 0.419 * (1 - 0.1 * 0.419**2) - 0.5, abs=0.2)
    assert edge < middle - 0.2


def test_distortion_without_an_inverse_is_refused() -> None:
    capture = _capture(2)
    assert len(_taken(capture, distortion=-0.2)) == 2
    wide = replace(CAMERA, fx_px=40.0, fy_px=40.0)  # corners at r = 1.44, but r - 0.2 r^3 is at most 0.86
    views = (capture.views[0], replace(capture.views[1], camera=wide))
    with pytest.raises(InputError, match=r"distortion = -0.2; expected at least -0.071"):
        as_taken(replace(capture, views=views), CameraFaults(name="x", distortion=-0.2))
    as_taken(replace(capture, views=views), CameraFaults(name="x", distortion=-0.071))


def test_pose_errors_have_their_size_and_pixels_are_unchanged() -> None:
    capture = _capture()
    moved = as_taken(capture, CameraFaults(name="x", pose_mm=5.0, pose_deg=0.2))
    shifts = np.array([view.camera.position_m - CAMERA.position_m for view in moved.views])
    assert shifts.std() == pytest.approx(0.005, rel=0.2)
    turns = [
        view.camera.world_from_camera[:3, :3] @ CAMERA.world_from_camera[:3, :3].T for view in moved.views
    ]
    angles = np.degrees([np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) for turn in turns])
    assert np.sqrt((angles**2).mean()) == pytest.approx(0.2, rel=0.35)
    np.testing.assert_allclose(moved.views[3].read().color, capture.views[3].read().color, rtol=1e-4)


def test_equal_seeds_give_equal_photographs() -> None:
    capture = _capture(2)
    fields = PRESETS["phone"].model_dump(exclude={"name", "seed"})
    first, again, other = (_taken(capture, seed=seed, **fields) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(np.array(first) - np.array(other)).max() > 0
    assert np.abs(first[0] - first[1]).max() > 0


def test_a_suite_may_name_faults_and_bundles(tmp_path: Path) -> None:
    def suite(camera: str) -> Path:
        path = tmp_path / "suite.yaml"
        text = SMALL.read_text().replace("small_room/room.xml", str(SMALL.parent / "small_room/room.xml"))
        path.write_text(text + f"\ncamera: {camera}\n")
        return path

    found = read_suite(suite("[each, raw-camera, phone, phone-and-mesh]"))
    names = [camera.name for camera in found.cameras]
    assert names == list(PRESETS) and names[-3:] == ["raw-camera", "phone", "phone-and-mesh"]
    assert PRESETS["phone-and-mesh"].geometry is not None and PRESETS["phone"].geometry is None
    assert "phone-and-mesh" in describe_suite(found)
    own = read_suite(suite("[{name: dim, exposure_stops: 1}]"))
    assert own.cameras == (CameraFaults(name="dim", exposure_stops=1.0),)
    assert read_suite(SMALL).cameras == ()
    for camera, expected in {
        "[fisheye]": "expected each, bits-8",
        "[phone, phone]": "its own name",
        "[{name: x, jpeg: 90}]": "bits: 8 with jpeg",
    }.items():
        with pytest.raises(InputError, match=expected):
            read_suite(suite(camera))
    with pytest.raises(ValidationError, match="linear"):
        CameraFaults(name="x", bits=14, contrast=0.1)

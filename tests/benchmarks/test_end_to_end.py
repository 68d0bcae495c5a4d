# SPDX-License-Identifier: MIT
"""Reconstruction from rendered noisy JPEGs, with true cameras or cameras found by COLMAP.

The full pipeline, with Cycles: `python -m benchmarks.studies.colmap_end_to_end` (docs/measurements.md).
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies.colmap_end_to_end import EndToEnd, developed, jpeg, walk
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.bundled import bundled_library
from datagen.foundation.cameras import Camera
from datagen.foundation.color import exposure_for, srgb_from_linear
from datagen.foundation.exr import decode_view
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import encode_ply
from datagen.library import Library
from datagen.rendering.renderer import SceneRenderer
from model.checkpoint import bundled_checkpoint
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.predict.sources import CheckpointMaps
from tests.model.rendered_capture import make_shard

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def test_development_of_a_photograph() -> None:
    """Grey keeps its mean sRGB value; noise grows as the square root of the light; white is clipped."""
    levels = np.array([0.0, 0.02, 0.2, 0.8, 3.0], np.float32)
    patches = np.repeat(np.repeat(levels[None, :, None], 400, 0), 3, 2).repeat(20, 1)
    pixels = developed(patches / 2, 2.0, seed=1).reshape(400, 5, 20, 3)
    mean = pixels.mean(axis=(0, 2, 3))
    np.testing.assert_allclose(mean[1:], 255 * np.clip(srgb_from_linear(levels[1:]), 0, 1), atol=0.4)
    assert mean[0] < 3 and pixels[:, 4].min() == 255
    linear = ((pixels / 255 + 0.055) / 1.055) ** 2.4
    noise = linear[:, 1:4].std(axis=(0, 2, 3))
    np.testing.assert_allclose(noise / np.sqrt(levels[1:4]), 1 / np.sqrt(12000), rtol=0.25)


def test_photographs_with_their_cameras_become_a_plausible_atlas(tmp_path: Path) -> None:
    """From eight noisy 96 x 64 JPEGs, a mesh without UVs or normals and the bundled checkpoint, over 30 % of
    the atlas is seen, and the error (MSE) of predicted D is below 0.75 times that of the exposed images."""
    shard, _, library = make_shard(tmp_path / "rendered")
    truth = read_capture(shard)
    folder = tmp_path / "photographs"
    folder.mkdir()
    colors = [view.read().color for view in truth.views]
    exposure = exposure_for(np.stack(colors))
    frames = []
    for number, (view, color) in enumerate(zip(truth.views, colors, strict=True)):
        camera = view.camera
        (folder / f"{view.name}.jpg").write_bytes(jpeg(developed(color, exposure, number), camera))
        pose = camera.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"{view.name}.jpg", "w": camera.width_px, "h": camera.height_px,
                       "fl_x": camera.fx_px, "fl_y": camera.fy_px, "cx": camera.cx_px, "cy": camera.cy_px,
                       "transform_matrix": pose.tolist()})  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    mesh = truth.geometry.mesh
    (folder / "room.ply").write_bytes(encode_ply(Mesh(mesh.positions, mesh.faces)))
    capture = read_capture(folder)
    report = infer(capture, tmp_path / "out", CheckpointMaps(bundled_checkpoint()), InferOptions(atlas=256))
    assert report.seen_share > 0.3
    ours, brightness = [], []
    for view, color in zip(truth.views, colors, strict=True):
        path = tmp_path / "out" / "views" / f"{view.name}.exr"
        found = decode_view(path, ("diffuse_albedo",))["diffuse_albedo"].astype(np.float32)
        true = view.source.read_maps(("diffuse_albedo",))["diffuse_albedo"].astype(np.float32)
        ours.append(np.mean((found - true) ** 2))
        brightness.append(np.mean((np.clip(color * exposure, 0, 1) - true) ** 2))
    library.close()
    print(np.mean(ours), np.mean(brightness))
    assert np.mean(ours) < 0.75 * np.mean(brightness), (np.mean(ours), np.mean(brightness))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("colmap") is None, reason="needs COLMAP: apt-get install colmap")
def test_colmap_finds_the_cameras_of_jpegs(tmp_path: Path) -> None:
    """COLMAP registers 24 small Mitsuba renderings of the study; its binary model is read and aligned.
    Measured: all 24 cameras, with median errors of 19 mm and 1.5 degrees and a focal length 1.1 % too short,
    limited by four samples per pixel; a misread convention would rotate cameras by tens of degrees."""
    steps = EndToEnd(tmp_path, 24, (480, 320), 0, 0, "colmap", "512")
    configuration = steps.configuration()
    assert [camera.name for camera in configuration.cameras] == [c.name for c in walk(24, (480, 320))]
    recipe = RenderRecipe(path_samples=4, auxiliary_samples=16, denoise=True)
    renderer = SceneRenderer(configuration, Library([bundled_library()]), recipe)
    steps.images.mkdir()
    exposure = 0.0
    for view in renderer.render_views(range(24)):
        color = view.buffers["beauty"].astype(np.float32)
        exposure = exposure or exposure_for(color)
        camera: Camera = configuration.cameras[view.index].camera()
        name = configuration.cameras[view.index].name
        (steps.images / f"{name}.jpg").write_bytes(jpeg(developed(color, exposure, view.index), camera))
    renderer.close()
    steps.calibrate()
    (steps.out / "retopology.ply").write_bytes(
        encode_ply(Mesh(np.eye(3, dtype=np.float32) * 3, np.array([[0, 1, 2]], np.int32)))
    )
    capture = read_capture(steps.capture, CaptureOptions(mesh=steps.out / "retopology.ply"))
    assert any("up: z" in note for note in capture.notes)
    found = steps.pose_errors()
    print(found)
    assert found["registered"] >= 20
    assert found["center_mm_median"] < 50 and found["turn_deg_median"] < 3
    assert abs(found["focal_percent"]) < 3

# SPDX-License-Identifier: MIT
"""`materials photos`: from a folder of photographs to an asset, with a stub of COLMAP."""

from __future__ import annotations

import json
import shutil
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from datagen.formats.base import write_bytes_atomically
from datagen.formats.capture import Capture
from datagen.foundation.color import srgb_from_linear
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.ply import encode_ply, read_ply
from datagen.geometry.traced import TracedGeometry
from model.cli import app
from model.reconstruction.photos import pipeline
from model.reconstruction.photos.colmap_run import ColmapRun, lists_by_size
from model.reconstruction.photos.options import PhotosOptions
from tests.model.lit_box import SIDES, SIZE, box_capture
from tests.model.test_light_infer import untrained

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
NUM_POINTS = 600
_PROGRAM = """#!{python}
import pathlib, shutil, sys
truth = pathlib.Path({truth!r})
names = (truth / "options").read_text()
if sys.argv[2:] == ["-h"]:
    sys.exit("\\n".join(name + " arg (=1)" for name in names.split()))
verb, options = sys.argv[1], dict(zip(sys.argv[2::2], sys.argv[3::2]))
for name in options:
    if name.startswith(("--Sift", "--Feature")) and name not in names.split():
        sys.exit("unrecognised option " + name)
with (truth / "calls").open("a") as calls:
    calls.write(verb + "\\n")
if (truth / ("fail-" + verb)).exists():
    sys.exit("no luck with " + verb)
if verb == "patch_match_stereo":
    sys.exit("no CUDA")
if verb == "mapper":
    shutil.copytree(truth / "model", pathlib.Path(options["--output_path"]) / "0")
"""
_OPTIONS = """--SiftExtraction.use_gpu --SiftExtraction.max_image_size --SiftExtraction.peak_threshold
--SiftMatching.use_gpu --SiftMatching.guided_matching"""
_OPTIONS_SINCE_3_13 = """--FeatureExtraction.use_gpu --SiftExtraction.max_image_size
--SiftExtraction.peak_threshold --FeatureMatching.use_gpu --FeatureMatching.guided_matching"""


def points_of(capture: Capture) -> bytes:
    """Points on the mesh's triangles in COLMAP's binary form, each with the views that show it."""
    rng = np.random.default_rng(6)
    triangles = capture.geometry.mesh.triangles().astype(np.float64)
    area = np.linalg.norm(np.cross(*np.moveaxis(np.diff(triangles, axis=1), 1, 0)), axis=1)
    shares = rng.dirichlet([1, 1, 1], NUM_POINTS)[..., None]
    points = (triangles[rng.choice(len(area), NUM_POINTS, p=area / area.sum())] * shares).sum(axis=1)
    traced = TracedGeometry(capture.geometry)
    seen = []
    for view in capture.views:
        depth, camera = traced.trace_view(view.camera).depth_z_m[..., 0], view.camera
        at, z = camera.project(points)
        at = np.nan_to_num(at, nan=-1.0)
        column, row = (np.clip(at[:, k].astype(int), 0, SIZE[k] - 1) for k in (0, 1))
        is_inside = (at >= 0).all(axis=1) & (at < SIZE).all(axis=1) & (z > 0)
        seen.append(is_inside & (np.abs(depth[row, column] - z) < 0.03 * z))
    packed = struct.pack("<Q", NUM_POINTS)
    for number, (point, views) in enumerate(zip(points, np.array(seen).T, strict=True)):
        shown_in = np.flatnonzero(views) + 1
        packed += struct.pack("<Q3d3BdQ", number, *point, 9, 9, 9, 0.5, len(shown_in))
        packed += b"".join(struct.pack("<2i", image_id, 0) for image_id in shown_in)
    return packed


def photographed(folder: Path) -> tuple[Path, Path, Path]:
    """Write photographs of the lit box, and a stub of COLMAP beside its output; return the three paths."""
    images, truth = folder / "kitchen", folder / "truth"
    images.mkdir()
    (truth / "model").mkdir(parents=True)
    capture = box_capture()
    shown = struct.pack("<Q", len(capture.views))
    for number, view in enumerate(capture.views):
        encoded = srgb_from_linear(np.clip(view.read().color, 0, 1))
        (images / f"{view.name}.png").write_bytes(encode_png((encoded * 255 + 0.5).astype(np.uint8)))
        pose = view.camera.camera_from_world
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        shown += struct.pack("<i7di", number + 1, w, x, y, z, *pose[:3, 3], 1)
        shown += f"{view.name}.png".encode() + b"\0" + struct.pack("<Q", 0)
    camera = capture.views[0].camera
    lens = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    (truth / "model" / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, *SIZE, *lens))
    (truth / "model" / "images.bin").write_bytes(shown)
    (truth / "model" / "points3D.bin").write_bytes(points_of(capture))
    (truth / "options").write_text(_OPTIONS)
    program = folder / "colmap"
    program.write_text(_PROGRAM.format(python=sys.executable, truth=str(truth)))
    program.chmod(0o755)
    return images, program, truth


def test_from_photographs_to_a_turntable_in_one_command(tmp_path: Path) -> None:
    """A failed step is named with the program's output; the same command continues there, and repeats no
    finished step."""
    images, program, truth = photographed(tmp_path)
    out = tmp_path / "asset"
    checkpoint = tmp_path / "random-3.safetensors"
    untrained(tmp_path, 3)
    words = ["photos", str(images), "--out", str(out), "--colmap", str(program), "--atlas", "64", "--up", "z"]
    words += ["--checkpoint", str(checkpoint), "--frames", "2", "--samples", "4", "--no-check", "--quiet"]
    (truth / "fail-mapper").touch()
    failed = CliRunner().invoke(app, words)
    text = str(failed.exception) + failed.output
    assert failed.exit_code != 0 and "no luck with mapper" in text and "overlapping photographs" in text
    (truth / "fail-mapper").unlink()
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    calls = (truth / "calls").read_text().split()
    assert [call for call in calls if call not in ("image_undistorter", "patch_match_stereo")] == [
        "feature_extractor",
        "exhaustive_matcher",
        "mapper",
        "mapper",
    ]
    mesh = read_ply(out / "colmap" / "mesh.ply")
    extent = np.ptp(box_capture().geometry.mesh.positions, axis=0)
    np.testing.assert_allclose(np.ptp(mesh.positions, axis=0), extent, rtol=0.1)
    report = json.loads((out / "report.json").read_text())
    assert report["num_views"] == 12 and report["radiometry"]["clipped_share"] > 0.01
    assert report["mesh"] == {}  # a surface through sparse points is not mended
    with Image.open(out / "turntable.gif") as gif:
        assert gif.n_frames == 2 and np.asarray(gif.convert("L")).mean() > 20
    made = {path: path.stat().st_mtime_ns for path in (out / "report.json", out / "turntable.gif")}
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 0 and (truth / "calls").read_text().split() == calls
    assert made == {path: path.stat().st_mtime_ns for path in made}
    image = cv2.imread(str(images / "view-000.png"))
    cv2.imwrite(str(images / "view-900.png"), image)
    other = CliRunner().invoke(app, words)
    assert other.exit_code != 0 and "other work" in str(other.exception) + other.output


def test_without_the_program_the_commands_are_printed(tmp_path: Path) -> None:
    images, _, _ = photographed(tmp_path)
    words = ["photos", str(images), "--out", str(tmp_path / "out"), "--colmap", "no-such-colmap"]
    words += ["--unit", "0.5", "--quiet"]
    refused = CliRunner().invoke(app, words)
    assert refused.exit_code != 0
    for text in (
        "apt-get install colmap",
        "feature_extractor",
        "mapper",
        "# then run the same command again",
    ):
        assert text in refused.output
    assert "materials photos" not in refused.output  # it would lack the options
    assert not (tmp_path / "out").exists()
    refused = CliRunner().invoke(app, ["photos", str(tmp_path / "truth"), "--out", str(tmp_path / "out")])
    assert refused.exit_code != 0 and "photographs = 0" in str(refused.exception) + refused.output


def test_given_cameras_need_no_program(tmp_path: Path) -> None:
    """A model from the printed commands is used unchanged; points without a surface are an error."""
    images, _, truth = photographed(tmp_path)
    steps: list[str] = []
    run = ColmapRun("no-such-colmap", images, [], tmp_path / "work", steps.append)
    assert not run.has_cameras
    shutil.copytree(truth / "model", run.model)
    assert run.cameras() == run.model and steps == []
    made = run.mesh()
    np.testing.assert_allclose(np.ptp(read_ply(made).positions, axis=0), SIDES, rtol=0.1)
    made.unlink()
    assert run.mesh() == made and steps == ["mesh"] and not made.exists()  # done once
    (run.work / "mesh.done").unlink()
    (run.model / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    with pytest.raises(InputError, match="no surface"):
        run.mesh()


def test_options_have_the_names_of_the_installed_version(tmp_path: Path) -> None:
    images, program, truth = photographed(tmp_path)
    (truth / "options").write_text(_OPTIONS_SINCE_3_13)
    run = ColmapRun(str(program), images, [], tmp_path / "work", lambda step: None)
    assert run.cameras() == run.model and run.has_cameras
    assert "mapper" in (truth / "calls").read_text()


def test_photographs_of_each_size_share_a_camera(tmp_path: Path) -> None:
    images, program, truth = photographed(tmp_path)
    files = sorted(images.iterdir())
    assert lists_by_size(files, tmp_path) == {}
    with Image.open(files[1]) as image:
        image.transpose(Image.Transpose.ROTATE_90).save(files[1])
    lists = lists_by_size(files, tmp_path / "work")
    assert sorted(map(len, lists.values())) == [1, len(files) - 1]
    run = ColmapRun(str(program), images, files, tmp_path / "work", lambda step: None)
    assert run.cameras() == run.model
    assert (truth / "calls").read_text().split().count("feature_extractor") == 2
    assert [path.read_text().split() for path in lists] == list(lists.values())


@pytest.mark.skipif(shutil.which("colmap") is None, reason="no COLMAP: apt-get install colmap")
def test_colmap_finds_features_of_upright_photographs_too(tmp_path: Path) -> None:
    """Run the commands that are printed where COLMAP is missing, in a folder whose name has a space."""
    images, work = tmp_path / "my room", tmp_path / "the work"
    images.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (12, 16, 3)).astype(np.uint8)
    files = [images / name for name in ("a b.png", "upright.png", "c.png")]
    for file in files:
        shown = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(file), shown.transpose(1, 0, 2) if file.stem == "upright" else shown)
    text = ColmapRun("colmap", images, files, work, lambda step: None).commands()
    commands = text.partition("colmap exhaustive_matcher")[0].splitlines()[1:]
    subprocess.run(["bash", "-euc", "\n".join(commands)], check=True, capture_output=True)
    with closing(sqlite3.connect(work / "database.db")) as database:
        cameras = dict(database.execute("SELECT name, camera_id FROM images"))
    assert set(cameras) == {file.name for file in files}
    assert cameras["a b.png"] == cameras["c.png"] != cameras["upright.png"]


def test_a_changed_capture_is_inferred_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras, mesh and photographs may change in place; an unchanged capture is not inferred again."""
    images, _, truth = photographed(tmp_path)
    capture, out = truth / "model", tmp_path / "out"
    images.rename(capture / "images")
    (capture / "room.ply").write_bytes(encode_ply(box_capture().geometry.mesh))
    made: list[str] = []

    def made_by(name: str, file: str) -> Callable[..., None]:
        return lambda *_: made.append(name) or write_bytes_atomically(out / file, b"")  # type: ignore[func-returns-value]

    monkeypatch.setattr(pipeline, "infer", made_by("report", "report.json"))
    monkeypatch.setattr(pipeline, "write_turntable", made_by("turntable", "turntable.gif"))
    source, options = untrained(tmp_path, 3), PhotosOptions()

    def make() -> None:
        pipeline.make_asset(capture, out, source, options, lambda *_: None, made.append)

    make()
    make()
    assert made == ["report", "turntable"]
    mesh = box_capture().geometry.mesh
    (capture / "room.ply").write_bytes(encode_ply(replace(mesh, positions=mesh.positions * np.float32(1.01))))
    make()
    assert made == ["report", "turntable"] * 2
    (capture / "images" / "view-000.png").write_bytes((capture / "images" / "view-001.png").read_bytes())
    make()
    assert made == ["report", "turntable"] * 3

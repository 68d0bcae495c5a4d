# SPDX-License-Identifier: MIT
"""`materials photos`: a folder of photographs to an asset, with a stand-in for COLMAP's program."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from datagen.foundation.color import srgb_from_linear
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.ply import encode_ply
from model.cli import app
from tests.model.lit_box import SIZE, box_capture
from tests.model.test_light_infer import untrained

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
_PROGRAM = """#!{python}
import pathlib, shutil, sys
truth = pathlib.Path({truth!r})
verb, options = sys.argv[1], dict(zip(sys.argv[2::2], sys.argv[3::2]))
with (truth / "calls").open("a") as calls:
    calls.write(verb + "\\n")
if (truth / ("fail-" + verb)).exists():
    sys.exit("no luck with " + verb)
if verb == "patch_match_stereo":
    sys.exit("no CUDA")
if verb == "mapper":
    shutil.copytree(truth / "model", pathlib.Path(options["--output_path"]) / "0")
if verb == "delaunay_mesher":
    assert (pathlib.Path(options["--input_path"]) / "images.txt").is_file()
    shutil.copy(truth / "mesh.ply", options["--output_path"])
"""


def photographed(folder: Path) -> tuple[Path, Path, Path]:
    """Photographs of the lit box, a program that knows its cameras and mesh, and what the program keeps."""
    images, truth = folder / "kitchen", folder / "truth"
    images.mkdir()
    (truth / "model").mkdir(parents=True)
    capture = box_capture()
    lines = []
    for number, view in enumerate(capture.views):
        shown = srgb_from_linear(np.clip(view.read().color, 0, 1))
        (images / f"{view.name}.png").write_bytes(encode_png((shown * 255 + 0.5).astype(np.uint8)))
        pose = view.camera.camera_from_world
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        words = (number + 1, w, x, y, z, *pose[:3, 3], 1, f"{view.name}.png")
        lines.append(" ".join(map(str, words)) + "\n\n")
    camera = capture.views[0].camera
    lens = f"{camera.fx_px} {camera.fy_px} {camera.cx_px} {camera.cy_px}"
    (truth / "model" / "cameras.txt").write_text(f"1 PINHOLE {SIZE[0]} {SIZE[1]} {lens}\n")
    (truth / "model" / "images.txt").write_text("".join(lines))
    (truth / "mesh.ply").write_bytes(encode_ply(capture.geometry.mesh))
    program = folder / "colmap"
    program.write_text(_PROGRAM.format(python=sys.executable, truth=str(truth)))
    program.chmod(0o755)
    return images, program, truth


def test_from_photographs_to_a_turntable_in_one_command(tmp_path: Path) -> None:
    """A step that fails is named, with what the program said; the same command goes on from there, and once
    all is done it does nothing more."""
    images, program, truth = photographed(tmp_path)
    out = tmp_path / "asset"
    checkpoint = tmp_path / "random-3.safetensors"
    untrained(tmp_path, 3)
    words = ["photos", str(images), "--out", str(out), "--colmap", str(program), "--atlas", "64", "--up", "z"]
    words += ["--checkpoint", str(checkpoint), "--frames", "2", "--samples", "4", "--no-check", "--quiet"]
    (truth / "fail-mapper").touch()
    failed = CliRunner().invoke(app, words)
    said = str(failed.exception) + failed.output
    assert failed.exit_code != 0 and "no luck with mapper" in said and "photographs that overlap" in said
    (truth / "fail-mapper").unlink()
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    calls = (truth / "calls").read_text().split()
    assert [call for call in calls if call not in ("image_undistorter", "patch_match_stereo")] == [
        "feature_extractor",
        "exhaustive_matcher",
        "mapper",
        "mapper",
        "delaunay_mesher",
    ]
    report = json.loads((out / "report.json").read_text())
    assert report["num_views"] == 12 and report["radiometry"]["clipped_share"] > 0.01
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
    words = ["photos", str(images), "--out", str(tmp_path / "out"), "--colmap", "no-such-colmap", "--quiet"]
    refused = CliRunner().invoke(app, words)
    assert refused.exit_code != 0
    for text in (
        "apt-get install colmap",
        "feature_extractor",
        "mapper",
        "delaunay_mesher",
        "materials photos",
    ):
        assert text in refused.output
    assert not (tmp_path / "out").exists()
    refused = CliRunner().invoke(app, ["photos", str(tmp_path / "truth"), "--out", str(tmp_path / "out")])
    assert refused.exit_code != 0 and "photographs = 0" in str(refused.exception) + refused.output

# SPDX-License-Identifier: MIT
"""Faulty captures cause warnings that name the views or a clear refusal; interrupted runs lose nothing and
continue."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.formats.capture import Capture
from datagen.foundation.errors import InputError
from datagen.foundation.images import read_image
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import encode_ply
from datagen.geometry.views import trace_capture
from datagen.light.surfels import build_surfels
from model.checkpoint import CheckpointCard, save_checkpoint
from model.confidence import ConfidenceNets
from model.networks import MaterialNetwork, NetworkConfig
from model.reconstruction.captures.mesh_file import load_mesh, sound_mesh
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.predict.sources import TRUTH, CheckpointMaps
from oracles.textured_room import materials_at, room_capture, room_mesh
from tests.model.photographed_room import (
    Photograph,
    photographed_room,
    turned,
    with_color,
    with_mesh,
    with_view,
)

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
ATLAS = 96
OPTIONS = InferOptions(atlas=ATLAS, has_exr=True, keeps_uvs=True)  # the true maps are functions of UV
ROOT = Path(__file__).resolve().parents[2]


def errors(out: Path) -> np.ndarray:
    """Absolute errors of the diffuse albedo at seen texels, against the room's."""
    found = read_image(out / "atlas" / "diffuse_albedo.exr")
    seen = read_image(out / "atlas" / "mask.png")[..., 0] == 255
    center = (np.arange(ATLAS) + 0.5) / ATLAS
    u, v = np.meshgrid(center, 1 - center)
    truth = materials_at(np.stack([u, v], axis=-1))["diffuse_albedo"]
    assert seen.mean() > 0.2
    return np.abs(found - truth)[seen]


def fine_room() -> Mesh:
    """The room, subdivided to 384 triangles."""
    mesh = room_mesh()
    for _ in range(2):
        mesh = subdivided(mesh)
    return mesh


def subdivided(mesh: Mesh) -> Mesh:
    """The mesh with each triangle split into four; vertices are not shared."""

    def split(values: np.ndarray) -> np.ndarray:
        a, b, c = np.moveaxis(values[mesh.faces], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        corners = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1)
        return corners.reshape(-1, values.shape[1]).astype(np.float32)

    assert mesh.normals is not None and mesh.uv is not None
    positions = split(mesh.positions)
    faces = np.arange(len(positions), dtype=np.int32).reshape(-1, 3)
    return Mesh(positions, faces, split(mesh.normals), split(mesh.uv))


def holed(mesh: Mesh) -> Mesh:
    """The mesh without a tenth of its triangles."""
    keep = np.random.default_rng(0).random(len(mesh.faces)) > 0.1
    return replace(mesh, faces=mesh.faces[keep])


def flipped(mesh: Mesh) -> Mesh:
    """The mesh with a third of its triangles wound in reverse, normals flipped."""
    turn = np.random.default_rng(1).random(len(mesh.faces)) < 1 / 3
    faces = np.where(turn[:, None], mesh.faces[:, [0, 2, 1]], mesh.faces).astype(np.int32)
    assert mesh.normals is not None
    normals = mesh.normals.copy()
    normals[mesh.faces[turn]] *= -1
    return replace(mesh, faces=faces, normals=normals)


def doubled(mesh: Mesh) -> Mesh:
    """The mesh with a quarter of its triangles duplicated, half of the copies wound in reverse."""
    again = mesh.faces[: len(mesh.faces) // 4].copy()
    again[::2] = again[::2, [0, 2, 1]]
    return replace(mesh, faces=np.concatenate([mesh.faces, again]))


def collapsed(mesh: Mesh) -> Mesh:
    """The mesh with additional triangles of two or one distinct corners."""
    extra = mesh.faces[:40].copy()
    extra[:, 2] = extra[:, 1]
    extra[::2, 1] = extra[::2, 0]
    return replace(mesh, faces=np.concatenate([extra, mesh.faces]))


@pytest.mark.parametrize("fault", [holed, flipped, doubled, collapsed])
def test_faults_of_the_mesh(tmp_path: Path, fault: Callable[[Mesh], Mesh]) -> None:
    """The atlas is as accurate as the intact mesh's, except where triangles are missing."""
    path = tmp_path / "room.ply"
    path.write_bytes(encode_ply(fault(fine_room())))
    mesh, notes = sound_mesh(load_mesh(path), np.eye(4), path)
    report = infer(with_mesh(room_capture(8), mesh), tmp_path / "out", TRUTH, OPTIONS)
    assert report.unwrap["source"] == "mesh"
    found = errors(tmp_path / "out")
    assert np.median(found) < 0.01 and np.quantile(found, 0.95) < 0.06
    expected = {"doubled": "96 repeated triangles", "collapsed": "40 triangles of zero area",
            "flipped": "edges join triangles of opposite winding"}  # fmt: skip
    if fault.__name__ in expected:
        assert any(expected[fault.__name__] in note for note in notes), notes
    assert len(mesh.faces) == (384 if fault is not holed else len(holed(fine_room()).faces))


def test_wrong_views_are_named_in_the_result(tmp_path: Path) -> None:
    """With views that are black, clipped, of another room, or rotated by 1.2 degrees, there is a result."""
    capture = photographed_room()
    shape = capture.views[0].source.color.shape  # type: ignore[attr-defined]
    capture = with_color(capture, 0, np.zeros(shape))
    capture = with_color(capture, 2, np.ones(shape))
    rng = np.random.default_rng(2)
    other = np.kron(rng.uniform(0, 0.9, (22, 32, 3)), np.ones((10, 10, 1)))
    capture = with_color(capture, 4, other)
    capture = turned(capture, 6, 1.2, (0, 1.0, 0))
    report = infer(capture, tmp_path, TRUTH, OPTIONS)
    assert {w.split(":")[0] for w in report.warnings} == {"view_00", "view_02", "view_04", "view_06"}
    assert json.loads((tmp_path / "report.json").read_text())["warnings"] == report.warnings
    assert (tmp_path / "check" / "sheet-01.png").is_file()
    assert (tmp_path / "asset" / "asset.json").is_file()


@pytest.mark.parametrize(("level", "expected"), [(0.0, "is black"), (1.0, "at the sensor's limit")])
def test_black_or_white_photographs_give_finite_maps(tmp_path: Path, level: float, expected: str) -> None:
    """Every view is named, and the maps are finite."""
    capture = room_capture(3, (64, 48))
    for index, view in enumerate(capture.views):
        shape = (view.camera.height_px, view.camera.width_px, 3)
        blank = Photograph(np.full(shape, level, np.float32), view.source.maps)  # type: ignore[attr-defined]
        capture = with_view(capture, index, source=blank)
    torch.manual_seed(3)
    network = NetworkConfig(base_channels=4, global_channels=8)
    card = CheckpointCard(network=network, loss="none", phase="untrained", step=0)
    save_checkpoint(tmp_path / "random.safetensors", card, MaterialNetwork(network), ConfidenceNets())
    report = infer(
        capture, tmp_path / "out", CheckpointMaps(tmp_path / "random.safetensors"), InferOptions(atlas=64)
    )
    for view in capture.views:
        assert any(w.startswith(f"{view.name}: ") and expected in w for w in report.warnings), report.warnings
    assert np.isfinite(read_image(tmp_path / "out" / "atlas" / "diffuse_albedo.exr")).all()


def test_a_long_name_is_shortened_in_the_id_of_the_asset(tmp_path: Path) -> None:
    """Names of folders in other scripts are transliterated, which makes them several times as long."""
    capture = replace(room_capture(1, (16, 12)), name="x" * 200)
    infer(capture, tmp_path, TRUTH, replace(OPTIONS, is_checked=False, has_exr=False))
    assert (tmp_path / f"{capture.name}.glb").is_file()
    asset = json.loads((tmp_path / "asset" / "asset.json").read_text())
    assert asset["id"] == "x" * 185 + "-reconstruction"


def test_a_mesh_in_hardly_any_pixel_is_refused_with_a_remedy() -> None:
    """An example is a mesh in centimetres instead of metres; the light stage needs an extended surface."""
    (view,) = trace_capture(room_capture(1, (16, 12))).views
    depth = np.zeros_like(view.geometry.depth_z_m)
    depth[0, 0] = 1
    seen = replace(view, geometry=replace(view.geometry, depth_z_m=depth))
    with pytest.raises(InputError, match=r"no view shows the mesh.*check the unit"):
        build_surfels([seen])


def test_a_mesh_off_by_two_centimetres(tmp_path: Path) -> None:
    capture = photographed_room()
    mesh = capture.geometry.mesh
    moved = replace(mesh, positions=mesh.positions + np.array([0.012, -0.012, 0.0106], np.float32))
    report = infer(with_mesh(capture, moved), tmp_path, TRUTH, OPTIONS)
    assert any("the mesh seems to be moved by" in warning for warning in report.warnings)
    assert np.median(errors(tmp_path)) < 0.03


@pytest.mark.parametrize("num", [1, pytest.param(300, marks=pytest.mark.slow)])
def test_few_and_many_views(tmp_path: Path, num: int) -> None:
    report = infer(room_capture(num, (48, 36)), tmp_path, TRUTH, OPTIONS)
    assert report.num_views == num
    assert report.seen_share > (0.05 if num == 1 else 0.85)
    assert np.median(errors_of_seen(tmp_path)) < 0.05


def errors_of_seen(out: Path) -> np.ndarray:
    """Absolute errors like those of :func:`errors`, for any number of seen texels."""
    found = read_image(out / "atlas" / "diffuse_albedo.exr")
    seen = read_image(out / "atlas" / "mask.png")[..., 0] == 255
    center = (np.arange(ATLAS) + 0.5) / ATLAS
    u, v = np.meshgrid(center, 1 - center)
    return np.abs(found - materials_at(np.stack([u, v], axis=-1))["diffuse_albedo"])[seen]


@contextmanager
def small_files(limit: int) -> Iterator[None]:
    """Limit files to ``limit`` bytes: writing fails as on a full disk."""
    old_signal = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, old_signal)


def files_of(out: Path) -> dict[str, bytes]:
    """Files of a run by relative path, without the reports, which contain measured times."""
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name not in ("report.json", "report.html")
    }


def test_full_disk(tmp_path: Path) -> None:
    """The run stops with the system's message and leaves no partial files; the next one gives the full
    result."""
    capture = room_capture(4, (48, 36))
    infer(capture, tmp_path / "whole", TRUTH, OPTIONS)
    out = tmp_path / "full"
    for limit in (6000, 16000):  # neither the PNGs nor the EXRs fit
        with small_files(limit), pytest.raises(OSError, match="File too large") as caught:
            infer(capture, out, TRUTH, replace(OPTIONS, is_checked=False))
        assert str(out) in str(caught.value.filename)
    assert not (out / "report.json").exists()
    assert not [path for path in out.rglob("*") if "partial" in path.name]
    infer(capture, out, TRUTH, OPTIONS)
    assert files_of(out) == files_of(tmp_path / "whole")


KILLED = """
import os, signal, sys
from pathlib import Path
import torch
torch.set_num_threads(1)
from mitsuba_plugins.variant import select_variant
select_variant("llvm_ad_rgb")
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.predict.sources import CheckpointMaps
from tests.model.test_reconstruction_robustness import small_capture

def tell(stage, done, total):
    if stage == "predict" and done >= 2:
        os.kill(os.getpid(), signal.SIGKILL)

source = CheckpointMaps(Path(sys.argv[2]))
infer(small_capture(), Path(sys.argv[1]), source, InferOptions(atlas=64, batch=1), tell)
"""


def small_capture() -> Capture:
    """Capture of four small views."""
    return room_capture(4, (64, 48))


def test_killed_process(tmp_path: Path) -> None:
    """After a kill at two views, the next run keeps them, predicts the rest and yields the same result."""
    torch.manual_seed(3)
    network = NetworkConfig(base_channels=4, global_channels=8)
    card = CheckpointCard(network=network, loss="none", phase="untrained", step=0)
    checkpoint = tmp_path / "random.safetensors"
    save_checkpoint(checkpoint, card, MaterialNetwork(network), ConfidenceNets())
    out = tmp_path / "killed"
    command = [sys.executable, "-c", KILLED, str(out), str(checkpoint)]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    kept = {path.name: path.stat().st_mtime_ns for path in (out / "views").glob("*.exr")}
    assert len(kept) == 2 and not (out / "report.json").exists()
    options = InferOptions(atlas=64, batch=1)
    infer(small_capture(), out, CheckpointMaps(checkpoint), options)
    assert all((out / "views" / name).stat().st_mtime_ns == time_ns for name, time_ns in kept.items())
    infer(small_capture(), tmp_path / "whole", CheckpointMaps(checkpoint), options)
    assert files_of(out) == files_of(tmp_path / "whole")


LARGE = """
import json, resource, sys, time
from dataclasses import replace
from pathlib import Path
import numpy as np
from mitsuba_plugins.variant import select_variant
select_variant("llvm_ad_rgb")
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.predict.sources import TRUTH
from tests.model.photographed_room import with_mesh
from tests.model.test_reconstruction_robustness import large_room
from oracles.textured_room import room_capture

mesh = large_room(int(sys.argv[2]))
start = time.process_time()
report = infer(with_mesh(room_capture(4, (96, 72)), mesh), Path(sys.argv[1]), TRUTH,
               InferOptions(atlas=512))
print(json.dumps({"triangles": len(mesh.faces), "cpu_s": time.process_time() - start,
                  "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
                  "seen": report.seen_share, "source": report.unwrap["source"], "seconds": report.seconds}))
"""


def large_room(num_triangles: int) -> Mesh:
    """The room with every quad divided into a grid, with interpolated UVs."""
    mesh = room_mesh()
    assert mesh.normals is not None and mesh.uv is not None
    side = int(np.sqrt(num_triangles / 24))
    t = np.linspace(0, 1, side + 1)
    a, b = np.meshgrid(t, t, indexing="ij")
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b], axis=-1).reshape(-1, 4)
    index = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    p, q, r, s = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack(c, -1).reshape(-1, 3) for c in ((p, q, r), (p, r, s))])
    parts = [slice(4 * k, 4 * k + 4) for k in range(12)]
    arrays = [
        np.concatenate([weights @ values[part] for part in parts]).astype(np.float32)
        for values in (mesh.positions, mesh.normals, mesh.uv)
    ]
    all_faces = np.concatenate([faces + k * len(weights) for k in range(12)]).astype(np.int32)
    return Mesh(arrays[0], all_faces, arrays[1], arrays[2])


@pytest.mark.slow
def test_five_million_triangles(tmp_path: Path) -> None:
    """Runs in a separate process to measure its memory."""
    command = [sys.executable, "-c", LARGE, str(tmp_path / "out"), "5000000"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env={**os.environ})
    assert done.returncode == 0, done.stderr[-2000:]
    figures = json.loads(done.stdout.splitlines()[-1])
    print(figures)
    assert figures["triangles"] > 4_900_000 and figures["source"] == "mesh"
    assert figures["peak_gb"] < 8
    assert figures["seen"] > 0.3

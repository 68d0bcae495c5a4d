# SPDX-License-Identifier: MIT
"""Untrusted captures and weights yield a valid object or an InputError, without access to other folders or
unpickling.

For the full run see ``tests/datagen/test_hostile_input.py``.
"""

from __future__ import annotations

import ast
import io
import json
import os
import pickle
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from datagen.foundation.errors import InputError
from datagen.foundation.exr import encode_view
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.ply import encode_ply
from model.checkpoint import load_checkpoint
from model.reconstruction.captures.mesh_file import load_mesh
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.photographs import PhotographSource
from model.reconstruction.captures.read import read_capture
from tests.conftest import REPOSITORY
from tests.datagen.small_library import box, with_uv
from tests.hostile import attack, set_traps
from tests.model.hostile_cases import CASES, SIZE, capture_texts

OPTIONS = CaptureOptions(up="z", unit_m=1.0, max_width_px=32)


@pytest.mark.parametrize("name", CASES)
def test_readers_return_objects_or_refuse(name: str, tmp_path: Path) -> None:
    attack("tests.model.hostile_cases", name, tmp_path / "case")


# ---------------------------------------------------------------------- nothing outside the folder


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """A folder with a photograph and a mesh that a capture beside it must not read."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "a.png").write_bytes(encode_png(np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)))
    (folder / "room.ply").write_bytes(encode_ply(with_uv(box([-1, -1, 0], [1, 1, 1]))))
    return folder


def _write_form(root: Path, form: str, image: str) -> Path:
    """Write a capture in format ``form`` that names its photograph ``image``; its mesh is inside."""
    root.mkdir(exist_ok=True)
    for name, text in capture_texts(form).items():
        (root / name).write_text(re.sub(r'(images/)?a\.png|images/a(?=")', lambda _: image, text))
    (root / "room.ply").write_bytes(encode_ply(with_uv(box([-1, -1, 0], [1, 1, 1]))))
    return root


FORMS = ("capture_json", "transforms", "colmap_text", "openmvg", "realitycapture_csv", "bundler")


@pytest.mark.parametrize("how", ["absolute", "parent", "link", "linked_folder"])
@pytest.mark.parametrize("form", FORMS)
def test_photographs_outside_are_refused_unless_allowed(
    form: str, how: str, tmp_path: Path, outside: Path
) -> None:
    root = tmp_path / "capture"
    image = {"absolute": str(outside / "a.png"), "parent": "../outside/a.png", "link": "a.png",
             "linked_folder": "images/a.png"}[how]  # fmt: skip
    _write_form(root, form, image)
    if how == "link":
        (root / "a.png").symlink_to(outside / "a.png")
    if how == "linked_folder":
        (root / "images").symlink_to(outside)
    with pytest.raises(InputError, match="--images"):
        read_capture(root, OPTIONS)
    given = CaptureOptions(up="z", unit_m=1.0, max_width_px=32, images=outside)
    assert np.isfinite(read_capture(root, given).views[0].read().color).all()


def test_meshes_outside_are_refused_unless_allowed(tmp_path: Path, outside: Path) -> None:
    root = _write_form(tmp_path / "capture", "capture_json", "a.png")
    (root / "a.png").write_bytes((outside / "a.png").read_bytes())
    record = json.loads((root / "capture.json").read_text())
    for name in (str(outside / "room.ply"), "../outside/room.ply"):
        record["mesh"]["file"] = name
        (root / "capture.json").write_text(json.dumps(record))
        with pytest.raises(InputError, match=r"mesh\.file.*--mesh"):
            read_capture(root, OPTIONS)
        given = CaptureOptions(mesh=outside / "room.ply", max_width_px=32)
        assert len(read_capture(root, given).geometry.mesh.faces) == 12
    record["mesh"]["file"] = "room.ply"
    (root / "capture.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"mesh\.file = room\.ply; .*which --mesh names"):
        read_capture(root, given)
    root = _write_form(tmp_path / "other", "transforms", "a.png")
    (root / "a.png").write_bytes((outside / "a.png").read_bytes())
    (root / "room.ply").unlink()
    (root / "room.ply").symlink_to(outside / "room.ply")
    with pytest.raises(InputError, match="leads to"):
        read_capture(root, OPTIONS)


def test_folders_named_in_a_document_are_not_searched(tmp_path: Path, outside: Path) -> None:
    """OpenMVG's root_path is of another computer; only its last component is used, relative to the file."""
    root = _write_form(tmp_path / "capture", "openmvg", "a.png")
    path = root / "sfm_data.json"
    for name in (str(outside), "..", "../outside", "/"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "root_path": name}))
        with pytest.raises(InputError, match="not found"):
            read_capture(root, OPTIONS)


@pytest.mark.parametrize(
    "name", ["cameras.xml", "cameras.csv", "bundle.out", "transforms.json", "sfm_data.json", "capture.json",
             "scene.xml", "a.xmp", "asset.json", "images.txt", "room.ply"],
)  # fmt: skip
def test_pipes_do_not_block(name: str, tmp_path: Path) -> None:
    if name == "images.txt":
        (tmp_path / "cameras.txt").write_text("7 PINHOLE 12 8 10 11 6 4\n")
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError):
        read_capture(tmp_path, OPTIONS)
    with pytest.raises(InputError):
        read_capture(tmp_path / name, OPTIONS)


def test_scene_includes_outside_are_refused(tmp_path: Path, outside: Path) -> None:
    root = tmp_path / "scene"
    root.mkdir()
    (outside / "more.xml").write_text('<scene version="3.0.0"/>')
    (root / "link.xml").symlink_to(outside / "more.xml")
    for name in ("../outside/more.xml", str(outside / "more.xml"), "link.xml", "/dev/zero"):
        (root / "scene.xml").write_text(f'<scene version="3.0.0"><include filename="{name}"/></scene>')
        with pytest.raises(InputError, match="inside the scene's folder"):
            read_capture(root / "scene.xml", OPTIONS)


# ---------------------------------------------------------------------- false claims and bombs


def _gltf(**changes: Any) -> dict[str, Any]:
    data: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "type": "VEC3", "count": 3, "bufferView": 0}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": "data.bin"}],
    }
    return {**data, **changes}


def test_gltf_reads_nothing_outside_and_bounds_its_memory(tmp_path: Path, outside: Path) -> None:
    folder = tmp_path / "gltf"
    folder.mkdir()
    set_traps(folder)
    corners = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]).tobytes()
    for place in (folder, outside):
        (place / "data.bin").write_bytes(corners)
    (folder / "link.bin").symlink_to(outside / "data.bin")
    path = folder / "room.gltf"
    path.write_text(json.dumps(_gltf()))
    assert len(load_mesh(path).faces) == 1
    tree = [{"children": [k + 1, k + 1]} for k in range(40)] + [{"mesh": 0}]
    many = {"nodes": [{"mesh": 0}] * 100, "scenes": [{"nodes": list(range(100))}]}
    crowd = {"primitives": [{"attributes": {"POSITION": 0}}] * 10_000}
    claims = {"componentType": 5126, "type": "VEC3", "count": 1 << 40}
    for changes in (
        *({"buffers": [{"byteLength": 36, "uri": uri}]} for uri in (
            "../outside/data.bin", str(outside / "data.bin"), "link.bin", "/dev/zero", "file:///dev/zero",
            "%2e%2e/outside/data.bin", "fifo", "http://localhost/x.bin")),
        {"nodes": tree},
        {"nodes": [{"children": [0]}]},
        {"accessors": [claims]},
        {"accessors": [{**claims, "bufferView": 0}]},
        {**many, "meshes": [crowd]},
    ):  # fmt: skip
        path.write_text(json.dumps(_gltf(**changes)))
        with pytest.raises(InputError, match=r"room\.gltf"):
            load_mesh(path)


@pytest.mark.parametrize("suffix", [".tif", ".png", ".exr"])
def test_photographs_that_claim_a_billion_pixels_are_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    picture = Image.fromarray(np.zeros((8, 12, 3), np.uint8))
    stream = io.BytesIO()
    if suffix == ".exr":
        data = bytearray(encode_view({"beauty": np.zeros((8, 12, 3), np.float32)}))
        at = data.index(b"dataWindow\0box2i\0") + 21
        data[at : at + 16] = struct.pack("<4i", 0, 0, 39999, 24999)
    elif suffix == ".png":
        picture.save(stream, "PNG")
        data = bytearray(stream.getvalue())
        data[16:24] = struct.pack(">II", 40000, 25000)
    else:
        picture.save(stream, "TIFF")
        data = bytearray(stream.getvalue())
        start = struct.unpack_from("<I", data, 4)[0]
        for entry in range(struct.unpack_from("<H", data, start)[0]):
            at = start + 2 + 12 * entry
            tag = struct.unpack_from("<H", data, at)[0]
            if tag in (256, 257):  # width, height
                data[at : at + 12] = struct.pack("<HHII", tag, 4, 1, 40000 if tag == 256 else 25000)
    path.write_bytes(data)
    camera = read_capture(_with_picture(tmp_path / "capture"), OPTIONS).views[0].camera
    with pytest.raises(InputError, match=rf"a\{suffix}"):
        PhotographSource(path, camera, None, "auto").read(camera)


def _with_picture(root: Path) -> Path:
    _write_form(root, "transforms", "a.png")
    (root / "a.png").write_bytes(encode_png(np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)))
    return root


# ---------------------------------------------------------------------- no pickle


class _Runs:
    """Creates a file when unpickled."""

    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self) -> tuple:
        return os.mknod, (str(self.marker),)


def test_a_pickled_checkpoint_does_not_run(tmp_path: Path) -> None:
    marker, path = tmp_path / "ran", tmp_path / "weights.safetensors"
    torch.save(_Runs(marker), path)
    with pytest.raises(InputError, match="unreadable"):
        load_checkpoint(path)
    path.write_bytes(pickle.dumps(_Runs(marker)))
    with pytest.raises(InputError, match="unreadable"):
        load_checkpoint(path)
    assert not marker.exists()


def _calls(tree: ast.AST) -> list[tuple[str, ast.Call]]:
    return [(ast.unparse(node.func), node) for node in ast.walk(tree) if isinstance(node, ast.Call)]


def test_no_source_loads_pickles_or_unpacks_archives() -> None:
    """Only ``model.training.weights`` unpickles: a file of pinned hash, with a restricted unpickler."""
    forbidden = {
        "pickle.load", "pickle.loads", "pickle.Unpickler", "marshal.loads", "marshal.load", "shelve.open",
        "yaml.load", "yaml.unsafe_load", "yaml.full_load", "eval", "exec", "joblib.load", "dill.load",
    }  # fmt: skip
    found = []
    for package in ("datagen", "mitsuba_plugins", "model", "blender_addon", "scenes"):
        for path in sorted((REPOSITORY / package).rglob("*.py")):
            for name, call in _calls(ast.parse(path.read_text())):
                keywords = {k.arg: ast.unparse(k.value) for k in call.keywords}
                if (
                    name in forbidden
                    or (name == "torch.load" and keywords.get("weights_only") != "True")
                    or (
                        name in ("np.load", "numpy.load") and keywords.get("allow_pickle", "False") != "False"
                    )
                    or name.endswith((".extractall", ".unpack_archive"))
                ):
                    found.append(f"{path.relative_to(REPOSITORY)}:{call.lineno}: {name}")
    assert not found

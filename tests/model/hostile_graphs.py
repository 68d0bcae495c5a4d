# SPDX-License-Identifier: MIT
"""Captures with hostile sizes and node graphs, to attack readers; tests/datagen has files for importers."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from datagen.foundation.budget import Budget
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.ply import encode_ply
from model.reconstruction.captures.mesh_file import load_mesh
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from tests.datagen.hostile_graphs import Scale, gltf_document, size
from tests.datagen.small_library import box, with_uv
from tests.hostile import Case, CaseMaker, write_fresh
from tests.model.hostile_cases import capture_texts
from tests.oversized import capture_folder, gltf

Files = dict[str, bytes]
_BLACK = encode_png(np.zeros((8, 12, 3), np.uint8))


def _capture(files: Callable[[random.Random, int], Files], opened: str = "") -> CaseMaker:
    """Make a case of captures with a random number of frames."""

    def make(folder: Path) -> Case:
        scale, root = Scale(), folder / "capture"
        root.mkdir()
        capture_folder(root)

        def write(rng: random.Random) -> Path:
            scale.draw(rng)
            contents = files(rng, scale.size(rng, 100))
            for path in (root / "images").iterdir():  # images of the previous input
                if path.name != "a.png" and f"images/{path.name}" not in contents:
                    path.unlink()
            for name, content in contents.items():
                write_fresh(root / name, content)
            return root / opened if opened else root

        def read(path: Path) -> object:
            return read_capture(path, CaptureOptions(up="z", unit_m=1.0, limits=scale.limits))

        return Case(write, read)

    return make


def _transforms(rng: random.Random, count: int) -> Files:
    frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}
    frames = [frame if rng.random() < 0.999 else {} for _ in range(count)]
    depth = size(rng, 3000) if rng.random() < 0.2 else 0
    extra = "[" * depth + "]" * depth if depth else "0"
    text = json.dumps({"fl_x": 10, "w": 12, "h": 8, "frames": frames})
    return {"transforms.json": f'{text[:-1]}, "extra": {extra}}}'.encode()}


def _openmvg(rng: random.Random, count: int) -> Files:
    document = json.loads(capture_texts("openmvg")["sfm_data.json"])
    for key in ("views", "extrinsics"):
        document[key] = document[key][:1] * (count if rng.random() < 0.9 else size(rng, 500))
    return {"sfm_data.json": json.dumps(document).encode()}


def _colmap(rng: random.Random, count: int) -> Files:
    lenses = [f"{k} PINHOLE 12 8 10 11 6 4" for k in range(size(rng, 6000))]
    images = [f"{k} 1 0 0 0 0 0 2 {rng.randrange(len(lenses))} a.png\n" for k in range(count)]
    return {"cameras.txt": "\n".join(lenses).encode(), "images.txt": "\n".join(images).encode()}


def _colmap_binary(rng: random.Random, count: int) -> Files:
    lens = struct.pack("<iiQQ4d", 7, 1, 12, 8, 10, 11, 6, 4)
    claimed = count if rng.random() < 0.8 else rng.choice((2**63, 0, count + 1))
    image = struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 2, 7) + b"a.png\0" + struct.pack("<Q", 0)
    return {
        "cameras.bin": struct.pack("<Q", 1) + lens,
        "images.bin": struct.pack("<Q", claimed) + image * count,
    }


def _bundler(rng: random.Random, count: int) -> Files:
    pose = "10 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 -2\n"
    claimed = count if rng.random() < 0.8 else size(rng, 10**9)
    head = f"# Bundle file v0.3\n{claimed} 0\n"
    return {"bundle.out": (head + pose * count).encode(), "list.txt": b"images/a.png\n" * count}


def _metashape(rng: random.Random, count: int) -> Files:
    text = capture_texts("metashape")
    [(name, content)] = text.items()
    start, end = content.index("<camera "), content.index("</camera>") + len("</camera>")
    depth = size(rng, 400) if rng.random() < 0.2 else 0
    extra = "<a>" * depth + "</a>" * depth
    return {name: (content[:start] + content[start:end] * count + extra + content[end:]).encode()}


def _realitycapture(rng: random.Random, count: int) -> Files:
    [(name, content)] = capture_texts("realitycapture_csv").items()
    lines = content.splitlines()
    return {name: "\n".join([*lines[:-1], *[lines[-1]] * count]).encode()}


def _sensors(rng: random.Random, count: int) -> Files:
    texts = capture_texts("mitsuba_sensors")
    content = texts["scene.xml"]
    start, end = content.index("<sensor"), content.index("</sensor>") + len("</sensor>")
    sensor = content[start:end].replace('id="a"', "")
    body = content[:end] + sensor * count + content[end:]
    names = ["a", *(f"camera_{k}" for k in range(1, min(count, 300) + 1))]
    files = dict.fromkeys((f"images/{name}.png" for name in names), _BLACK)
    return {"scene.xml": body.encode(), "more.xml": texts["more.xml"].encode(), **files}


def mesh_gltf(folder: Path) -> Case:
    """glTF documents with node graphs as the mesh of a capture."""
    scale = Scale()

    def write(rng: random.Random) -> Path:
        scale.draw(rng)
        (folder / "model.gltf").unlink(missing_ok=True)
        return gltf(folder, gltf_document(rng, scale))

    return Case(write, lambda path: load_mesh(path, Budget(path, scale.limits)))


def mesh_file(folder: Path) -> Case:
    """PLY and OBJ files: polygons of any number of corners, vertices without faces, words of any length."""
    scale = Scale()

    def obj(rng: random.Random) -> bytes:
        count = scale.size(rng, 500)
        lines = [f"v {k} {k % 5} {k % 7}" for k in range(count)]
        for _ in range(scale.size(rng, 500)):
            corners = size(rng, 300) + 2 if rng.random() < 0.05 else 3
            lines.append("f " + " ".join(str(rng.randint(1, count)) for _ in range(corners)))
        if rng.random() < 0.05:
            lines[rng.randrange(count)] = "v 0 0 " + "0" * size(rng, 200_000)
        return "\n".join(lines).encode()

    def ply(rng: random.Random) -> bytes:
        is_ascii, num = rng.random() < 0.5, scale.size(rng, 250)
        form = "ascii" if is_ascii else "binary_little_endian"
        faces = [size(rng, 255) for _ in range(scale.size(rng, 125))]
        header = (
            f"ply\nformat {form} 1.0\nelement vertex {num}\nproperty float x\nproperty float y\n"
            f"property float z\nelement face {len(faces)}\n"
            "property list uchar uchar vertex_indices\nend_header\n"
        ).encode()
        if is_ascii:
            rows = [f"{k} {k % 3} {k % 5}" for k in range(num)]
            rows += [" ".join([str(n), *["0"] * n]) for n in faces]
            return header + "\n".join(rows).encode()
        points = np.arange(3 * num, dtype="<f4").tobytes()
        return header + points + b"".join(bytes([n]) + bytes(n) for n in faces)

    def write(rng: random.Random) -> Path:
        scale.draw(rng)
        if rng.random() < 0.5:
            return write_fresh(folder / "room.obj", obj(rng))
        usual = encode_ply(with_uv(box([-1, -1, 0], [1, 1, 1])))
        return write_fresh(folder / "room.ply", ply(rng) if rng.random() < 0.95 else usual)

    return Case(write, lambda path: load_mesh(path, Budget(path, scale.limits)))


CASES: dict[str, CaseMaker] = {
    "transforms": _capture(_transforms),
    "openmvg": _capture(_openmvg),
    "colmap": _capture(_colmap),
    "colmap_binary": _capture(_colmap_binary),
    "bundler": _capture(_bundler),
    "metashape": _capture(_metashape),
    "realitycapture": _capture(_realitycapture),
    "mitsuba_sensors": _capture(_sensors, "scene.xml"),
    "mesh_gltf": mesh_gltf,
    "mesh_file": mesh_file,
}

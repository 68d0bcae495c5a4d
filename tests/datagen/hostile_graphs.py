# SPDX-License-Identifier: MIT
"""Fuzz cases of importer input with extreme reference graphs, nesting depths and element counts.

Most inputs are read under the limits ``SMALL``, which small files reach in milliseconds; a few are up to
``FULL_FACTOR`` times larger and read under the default limits.
"""

from __future__ import annotations

import base64
import json
import random
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from datagen.asset_check import check_package
from datagen.formats.package import open_package
from datagen.foundation.budget import Budget, Limits
from datagen.foundation.images import encode_png
from datagen.importers.common import ImportOptions
from datagen.importers.dispatch import import_asset
from tests.datagen.hostile_cases import valid_documents
from tests.hostile import Case, CaseMaker, write_fresh
from tests.oversized import furniture, gltf

SMALL = Limits(
    nodes=1000,
    depth=40,
    references=100,
    instances=15,
    triangles=750,
    pairs=25_000,
    pixels=100_000,
    bytes=12_500,
    values=5000,
    frames=25,
)
FULL_SHARE, FULL_FACTOR = 0.005, 200


def size(rng: random.Random, top: int) -> int:
    """Return a log-uniform integer from 1 to ``top``."""
    return int(top ** rng.random())


class Scale:
    """Limits under which one input is read, and the factor applied to its maximum sizes."""

    def __init__(self) -> None:
        self.limits, self.factor = SMALL, 1

    def draw(self, rng: random.Random) -> None:
        is_full = rng.random() < FULL_SHARE
        self.limits, self.factor = (Limits(), FULL_FACTOR) if is_full else (SMALL, 1)

    def size(self, rng: random.Random, top: int) -> int:
        return size(rng, top * self.factor)


def _reader(scale: Scale, folder: Path) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        options = ImportOptions(
            license="CC0-1.0", dielectric="replace", as_zip=True, overwrite=True, limits=scale.limits
        )
        return import_asset(path, folder / "library", options)

    return read


def _bsdfs(rng: random.Random, scale: Scale) -> list[str]:
    """Return XML elements of BSDFs with up to two references each, mostly to earlier BSDFs."""
    count, reach = scale.size(rng, 75), size(rng, 20)
    lines = ['<bsdf type="diffuse" id="b0"/>']
    for k in range(1, count):
        targets = [max(0, k - rng.randint(1, reach)) for _ in range(rng.choice((0, 1, 1, 2, 2)))]
        if targets and rng.random() < 0.002:
            targets[0] = rng.randint(0, count)
        refs = "".join(f'<ref id="b{t}"/>' for t in targets)
        kind = ("diffuse", rng.choice(("twosided", "mask")), "blendbsdf")[len(targets)]
        lines.append(f'<bsdf type="{kind}" id="b{k}">{refs}</bsdf>')
    return lines


def _shapes(rng: random.Random, scale: Scale, num_bsdfs: int) -> list[str]:
    kinds = ("rectangle", "rectangle", "cube", "disk", "sphere")
    count = scale.size(rng, 25 if rng.random() < 0.9 else 1250)
    lines = []
    for k in range(count):
        ref = f'<ref id="b{rng.randrange(num_bsdfs)}"/>' if num_bsdfs and rng.random() < 0.7 else ""
        move = f'<transform name="to_world"><translate x="{k}"/></transform>'
        lines.append(f'<shape type="{rng.choice(kinds)}">{ref}{move}</shape>')
    return lines


def mitsuba(folder: Path) -> Case:
    """Return a fuzz case of Mitsuba scenes with many or deep references, instances, includes and defaults."""
    scale = Scale()

    def write(rng: random.Random) -> Path:
        scale.draw(rng)
        body: list[str] = []
        if rng.random() < 0.3:
            times, length = rng.randint(1, 4), size(rng, 40)
            body.append('<default name="a0" value="1234"/>')
            body += [f'<default name="a{k + 1}" value="{f"$a{k}" * times}"/>' for k in range(length)]
        bsdfs = _bsdfs(rng, scale) if rng.random() < 0.6 else []
        body += bsdfs + _shapes(rng, scale, len(bsdfs))
        if rng.random() < 0.4:
            members = '<shape type="rectangle"/>' * scale.size(rng, 15)
            body.append(f'<shape type="shapegroup" id="g">{members}</shape>')
            body += ['<shape type="instance"><ref id="g"/></shape>'] * scale.size(rng, 50)
        if rng.random() < 0.3:
            depth = scale.size(rng, 100)
            chain = '<bsdf type="twosided">' * depth + '<bsdf type="diffuse"/>' + "</bsdf>" * depth
            body.append(f'<shape type="rectangle">{chain}</shape>')
        if rng.random() < 0.3:
            levels, fan = rng.randint(1, 12), rng.randint(1, 5)
            for level in range(levels):
                include = f'<include filename="l{level + 1}.xml"/>' * fan
                write_fresh(folder / f"l{level}.xml", f'<scene version="3.0.0">{include}</scene>'.encode())
            last = '<scene version="3.0.0"><shape type="rectangle"/></scene>'
            write_fresh(folder / f"l{levels}.xml", last.encode())
            body.append('<include filename="l0.xml"/>')
        return write_fresh(folder / "scene.xml", f'<scene version="3.0.0">{"".join(body)}</scene>'.encode())

    return Case(write, _reader(scale, folder))


def gltf_document(rng: random.Random, scale: Scale) -> dict[str, Any]:
    """Return a glTF document with random numbers of nodes, mesh primitives and accessor elements."""
    count, reach = scale.size(rng, 100), size(rng, 500)
    parents = [-1] + [max(-1, k - rng.randint(1, reach)) for k in range(1, count)]
    num_meshes = size(rng, 8)
    nodes: list[dict[str, Any]] = [{} for _ in range(count)]
    share = rng.choice((0.02, 0.2, 1.0))
    for k, parent in enumerate(parents):
        if rng.random() < share or k == count - 1:
            nodes[k]["mesh"] = rng.randrange(num_meshes)
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(k)
    if rng.random() < 0.05:
        nodes[rng.randrange(count)].setdefault("children", []).append(rng.randrange(-1, count + 1))
    if rng.random() < 0.1:
        key = rng.choice(("matrix", "rotation", "scale", "translation"))
        nodes[rng.randrange(count)][key] = [rng.choice((0, 1, -1, 1e20, 2.5))] * rng.choice((3, 4, 9, 16))
    accessors: list[dict[str, Any]] = [
        {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4},
        {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 6},
        {"componentType": 5126, "type": "VEC3", "count": scale.size(rng, 5000)},
    ]
    if rng.random() < 0.2:
        index = rng.choice(("i1", "u1"))
        view = {"bufferView": 2, "componentType": 5120 if index == "i1" else 5121}
        accessors[0]["sparse"] = {"count": rng.randint(0, 4), "indices": view, "values": {"bufferView": 0}}
    meshes = []
    for _ in range(num_meshes):
        usual = {"attributes": {"POSITION": 0}, "indices": 1}
        empty = {"attributes": {"POSITION": 2}}
        primitives = [usual] * scale.size(rng, 15) + [empty] * (rng.random() < 0.05)
        meshes.append({"primitives": primitives})
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4").tobytes()
    small = bytes(rng.choice((0, 1, 2, 3, 4, 200, 255)) for _ in range(4))
    data = positions + np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes() + small
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return {
        "nodes": nodes,
        "scenes": [{"nodes": [k for k, parent in enumerate(parents) if parent < 0]}],
        "accessors": accessors,
        "meshes": meshes,
        "buffers": [{"byteLength": len(data), "uri": uri}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
            {"buffer": 0, "byteOffset": 60, "byteLength": 4},
        ],
    }  # fmt: skip


def gltf_graph(folder: Path) -> Case:
    """Return a fuzz case of glTF files with large or invalid node graphs."""
    scale = Scale()

    def write(rng: random.Random) -> Path:
        scale.draw(rng)
        (folder / "model.gltf").unlink(missing_ok=True)
        return gltf(folder, gltf_document(rng, scale))

    return Case(write, _reader(scale, folder))


def texture_folder(folder: Path) -> Case:
    """Return a fuzz case of texture folders with maps of random size, which compress well if constant."""
    scale, root = Scale(), folder / "oak"
    root.mkdir()
    roles = ("Color", "Roughness", "Metalness", "NormalGL", "NormalDX", "AO", "Opacity", "Displacement")

    def write(rng: random.Random) -> Path:
        scale.draw(rng)
        for path in root.iterdir():
            path.unlink()
        for role in rng.sample(roles, rng.randint(1, 5)) + ["Color"] * (rng.random() < 0.9):
            side = size(rng, 700 if scale.factor == 1 else 6000)
            pixels = np.full((side, size(rng, side), 3), rng.randrange(256), np.uint8)
            if rng.random() < 0.3:
                pixels[:: rng.randint(1, 9)] = 7
            (root / f"Oak_{role}.png").write_bytes(encode_png(pixels))
        return root

    return Case(write, _reader(scale, folder))


def sweet_home(folder: Path) -> Case:
    """Return a fuzz case of Sweet Home 3D libraries with many files, faces per vertex and polygon corners."""
    scale = Scale()

    def model(rng: random.Random) -> bytes:
        lines = ["mtllib a.mtl", "s 1"] if rng.random() < 0.5 else ["mtllib a.mtl"]
        corners = scale.size(rng, 75)
        lines += [f"v {rng.random():.2f} {rng.random():.2f} {k % 7}" for k in range(corners + 3)]
        if rng.random() < 0.4:
            ring = list(range(1, corners + 4))
            rng.shuffle(ring)
            lines.append("f " + " ".join(map(str, ring)))
        for k in range(scale.size(rng, 500)):
            if rng.random() < 0.002:
                lines.append(f"usemtl m{k}")
            fan = rng.random() < 0.5
            lines.append(f"f 1 {k % corners + 2} {(k + 1) % corners + 2 if fan else rng.randint(1, corners)}")
        lines += ["v 0 0 0"] * (scale.size(rng, 5000) if rng.random() < 0.2 else 0)
        return "\n".join(lines).encode()

    def write(rng: random.Random) -> Path:
        scale.draw(rng)
        names = [f"m{k}/a" for k in range(size(rng, 5))]
        members = {f"{name}.obj": model(rng) for name in names}
        mtl = b"newmtl m\nKd 1 1 1\n"
        members.update({f"{name}.mtl": mtl for name in names})
        if rng.random() < 0.2:
            members.update({f"filler/{k}": b"" for k in range(scale.size(rng, 1500))})
        pieces = [f"{rng.choice(names)}.obj" for _ in range(size(rng, 8))]
        path = folder / "a.sh3f"
        path.unlink(missing_ok=True)
        return furniture(path, pieces, members)

    def read(path: Path) -> object:
        options = ImportOptions(
            license="CC0-1.0", missing="replace", as_zip=True, overwrite=True, limits=scale.limits
        )
        return import_asset(path, folder / "library", options)

    return Case(write, read)


def package_zip(folder: Path) -> Case:
    """Return a fuzz case of zipped packages with members of random number, size and compression ratio."""
    scale = Scale()
    document = json.dumps(valid_documents()["material"][0])
    texture = encode_png(np.full((8, 8, 3), 9, np.uint8))

    def write(rng: random.Random) -> Path:
        scale.draw(rng)
        path = folder / "package.zip"
        path.unlink(missing_ok=True)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("asset.json", document)
            archive.writestr("a.png", texture)
            for k in range(scale.size(rng, 1500) if rng.random() < 0.3 else size(rng, 10)):
                noise = rng.randbytes(size(rng, 200))
                filler = bytes(scale.size(rng, 25_000)) if rng.random() < 0.1 else b""
                archive.writestr(f"x/{k}", noise + filler)
        return path

    def read(path: Path) -> object:
        with open_package(path, Budget(path, scale.limits)) as package:
            return check_package(package)

    return Case(write, read)


CASES: dict[str, CaseMaker] = {
    "mitsuba": mitsuba,
    "gltf": gltf_graph,
    "texture_folder": texture_folder,
    "sweet_home": sweet_home,
    "package_zip": package_zip,
}

# SPDX-License-Identifier: MIT
"""Fuzz cases for the readers of `datagen`: documents, packages, shards, images and dataset folders."""

from __future__ import annotations

import io
import json
import os
import random
import stat
import struct
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from datagen.asset_check import check_package
from datagen.farm.collect import collect
from datagen.farm.folder import DatasetFolder, FailureRecord, FolderRecord, Plan, UnitManifest
from datagen.farm.status import last_lines, read_status
from datagen.formats.asset import EnvironmentAsset, MaterialAsset, ObjectAsset
from datagen.formats.base import canonical_json, parse_model, read_json, read_yaml, sha256_hex
from datagen.formats.configuration import Configuration
from datagen.formats.package import open_package
from datagen.formats.recipe import Recipe
from datagen.formats.shard import CONFIGURATION_MEMBER, Dataset, DatasetIndex, ShardReader
from datagen.formats.view import ViewRecord
from datagen.foundation.errors import InputError
from datagen.foundation.exr import decode_view, encode_view
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.ply import encode_ply
from datagen.inspection.verify import verify_dataset
from tests.conftest import REPOSITORY
from tests.datagen.small_dataset import make_buffers, make_configuration, make_view_files
from tests.datagen.small_library import box, with_uv
from tests.hostile import (
    Case,
    CaseMaker,
    damage,
    hostile_value,
    mutate,
    set_traps,
    write_document,
    write_fresh,
)

HOSTILE_NAMES = [
    "../evil", "/abs", "a/../../b", "x.png", "asset.json/x", "", ".", "..", "a\\..\\b", "C:/x", "/dev/zero",
    "link.png", "é" * 40, "a" * 99,
]  # fmt: skip


def _as_data(model: Any) -> Any:
    return json.loads(model.model_dump_json())


def valid_documents() -> dict[str, tuple[Any, Callable[[Path], Any]]]:
    """Return a valid document of each format and the reader of that format, by format name."""
    configuration = make_configuration(num_views=2)
    material = {
        "format": "scene-materials/asset", "version": 1, "id": "oak", "title": "Oak", "kind": "material",
        "provenance": {"license": "CC0-1.0"},
        "material": {
            "classes": ["wood"], "roughness": 0.4, "specular_albedo": [0.3, 0.2, 0.1],
            "diffuse_albedo": {"texture": "a.png", "encoding": "srgb"},
        },
    }  # fmt: skip
    part = {"name": "a", "mesh": "a.ply", "material": "m"}
    thing = {
        **{k: v for k, v in material.items() if k != "material"}, "kind": "object", "category": "cup",
        "materials": {"m": {"roughness": {"texture": "a.png", "encoding": "linear"}}}, "parts": [part],
        "minimum_m": [0, 0, 0], "maximum_m": [1, 1, 1],
    }  # fmt: skip
    room = {
        **{k: v for k, v in thing.items() if k not in ("category", "minimum_m", "maximum_m")},
        "kind": "environment",
        "camera_regions": [{"minimum_m": [0, 0, 0], "maximum_m": [1, 1, 1]}],
        "lights": [
            {"type": "point", "name": "p", "position_m": [0, 0, 1], "intensity": [1, 1, 1]},
            {"type": "environment", "name": "e", "image": "sky.exr"},
        ],
        "openings": [{"name": "w", "origin_m": [0, 0, 0], "edge_u_m": [1, 0, 0], "edge_v_m": [0, 0, 1]}],
    }
    unit = {
        "index": 0, "id": "small-00000", "split": "train", "key": "k", "num_views": 1, "seed": 0,
        "assets": [],
    }  # fmt: skip
    plan = {"variant": "llvm_ad_rgb", "versions": {}, "assets": {}, "units": [unit]}
    manifest = {
        "key": "k", "id": "small-00000", "shard": "shards/small.tar", "sha256": "0", "num_bytes": 1,
        "num_views": 1, "attempt": "a", "host": "h", "seconds": {"render": 1.0},
        "views": [{"view": "view-000", "seconds": {}}], "peak_memory_mb": 1.0,
    }  # fmt: skip
    failure = {
        "id": "small-00000", "index": 0, "attempts": 3, "reason": "r", "log": "logs/small-00000.3.log",
        "command": "datagen run x --unit 0 --attempts 0",
    }  # fmt: skip
    record = {
        "recipe_sha256": "0", "library_sha256": "0", "library_paths": ["library"], "versions": {"a": "1"},
    }  # fmt: skip
    shard = {
        "file": "shards/small.tar", "sha256": "0", "num_bytes": 1, "configuration": "small-00000",
        "split": "train", "num_views": 1, "seed": 0, "assets": ["room"],
    }  # fmt: skip
    index = {
        "recipe": {"name": "x", "configurations": 1, "views": 1}, "versions": {}, "variant": "v",
        "num_configurations": 1, "num_views": 1, "num_bytes": 1, "is_complete": True, "splits": {"train": 1},
        "buffers": ["beauty"], "shards": [shard],
        "assets": {"room": {"kind": "environment", "sha256": "0", "license": "CC0-1.0"}},
    }  # fmt: skip
    recipe = _as_data(read_yaml(Recipe, REPOSITORY / "scenes" / "recipes" / "paper.yaml"))
    return {
        "recipe": (recipe, lambda path: read_yaml(Recipe, path)),
        "configuration": (_as_data(configuration), lambda path: read_json(Configuration, path)),
        "view": (_view_record(configuration, b""), lambda path: read_json(ViewRecord, path)),
        "material": (material, lambda path: read_json(MaterialAsset, path)),
        "object": (thing, lambda path: read_json(ObjectAsset, path)),
        "environment": (room, lambda path: read_json(EnvironmentAsset, path)),
        "plan": (plan, lambda path: read_json(Plan, path)),
        "manifest": (manifest, lambda path: read_json(UnitManifest, path)),
        "failure": (failure, lambda path: read_json(FailureRecord, path)),
        "folder": (record, lambda path: read_json(FolderRecord, path)),
        "index": (index, lambda path: read_json(DatasetIndex, path)),
    }


def _view_record(configuration: Configuration, exr: bytes) -> Any:
    import tempfile

    with tempfile.TemporaryDirectory() as scratch:
        make_view_files(Path(scratch), configuration)
        record = json.loads((Path(scratch) / f"{configuration.cameras[0].name}.json").read_text())
    return {**record, "exr_sha256": sha256_hex(exr)}


DOCUMENTS = tuple(valid_documents())


def _document(name: str) -> CaseMaker:
    def make(folder: Path) -> Case:
        document, read = valid_documents()[name]
        path = folder / "document.json"

        def check(target: Path) -> None:
            # accepted documents must round-trip unchanged
            result = read(target)
            text = canonical_json(result)
            assert canonical_json(parse_model(type(result), json.loads(text), target)) == text

        return Case(lambda rng: write_document(path, document, rng), check)

    return make


def _texture() -> bytes:
    return encode_png(np.random.default_rng(0).integers(0, 255, (6, 5, 3)).astype(np.uint8))


def _package_files() -> dict[str, bytes]:
    import cv2

    jpeg = cv2.imencode(".jpg", np.full((8, 8, 3), 90, np.uint8))[1].tobytes()
    sky = encode_view({"beauty": make_buffers(4, 8, seed=0)["beauty"]})
    return {"a.ply": encode_ply(with_uv(box([0, 0, 0], [1, 1, 1]))), "a.png": _texture(), "b.jpg": jpeg,
            "sky.exr": sky}  # fmt: skip


def package_folder(folder: Path) -> Case:
    """Return a fuzz case of package folders with a damaged file or a mutated description."""
    package = folder / "package"
    package.mkdir()
    set_traps(package)
    files = _package_files()
    documents = valid_documents()
    for name, data in files.items():
        (package / name).write_bytes(data)

    def write(rng: random.Random) -> Path:
        kind = rng.choice(("object", "environment", "environment", "material"))
        document = documents[kind][0]
        name = rng.choice(list(files))
        write_fresh(package / name, damage(files[name], rng) if rng.random() < 0.6 else files[name])
        for other in files.keys() - {name}:
            if not (package / other).is_file() or (package / other).stat().st_size != len(files[other]):
                write_fresh(package / other, files[other])
        if rng.random() < 0.5:
            return write_document(package / "asset.json", document, rng).parent
        write_fresh(package / "asset.json", json.dumps(document).encode())
        return package

    def read(path: Path) -> None:
        with open_package(path) as opened:
            check_package(opened)
            assert len(opened.sha256) == 64

    return Case(write, read)


def package_zip(folder: Path) -> Case:
    """Return a fuzz case of zipped packages with a mutated description, unsafe members or damaged bytes."""
    files = _package_files()
    documents = valid_documents()

    def write(rng: random.Random) -> Path:
        kind = rng.choice(("object", "environment", "material"))
        document = documents[kind][0]
        if rng.random() < 0.3:
            document = mutate(document, rng)
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", rng.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED))) as archive:
            archive.writestr("asset.json", json.dumps(document).encode("utf-8", "surrogatepass"))
            for name, data in files.items():
                archive.writestr(name, damage(data, rng) if rng.random() < 0.1 else data)
            if rng.random() < 0.2:
                info = zipfile.ZipInfo(rng.choice(HOSTILE_NAMES) or "x")
                info.external_attr = rng.choice((0, stat.S_IFLNK | 0o777, stat.S_IFCHR, stat.S_IFIFO)) << 16
                archive.writestr(info, "/etc/passwd")
        data = stream.getvalue()
        return write_fresh(folder / "package.zip", data if rng.random() < 0.5 else damage(data, rng))

    def read(path: Path) -> None:
        with open_package(path) as opened:
            check_package(opened)
            assert len(opened.sha256) == 64

    return Case(write, read)


class _SmallShard:
    """A valid shard with one view of five buffers, from which hostile shards are made."""

    def __init__(self) -> None:
        self.configuration = make_configuration(num_views=1, width=12, height=8)
        buffers = make_buffers(8, 12, seed=0)
        names = ("beauty", "roughness", "depth_z_m", "normal_world", "surface_mask")
        self.exr = encode_view({name: buffers[name] for name in names}, num_threads=1)
        self.record = {**_view_record(self.configuration, self.exr), "buffers": sorted(names)}
        self.tar = self.build(random.Random(0), is_hostile=False)

    def build(self, rng: random.Random, is_hostile: bool = True) -> bytes:
        """Return a tar; if ``is_hostile``, members may be damaged, renamed, duplicated or links."""
        members = [
            (CONFIGURATION_MEMBER, self.configuration.model_dump(mode="json")),
            ("small-00000/view-000.exr", self.exr),
            ("small-00000/view-000.json", self.record),
        ]
        stream = io.BytesIO()
        with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            for name, content in members:
                info = tarfile.TarInfo(name)
                if is_hostile and rng.random() < 0.3:
                    if isinstance(content, bytes):
                        content = damage(content, rng)
                    else:
                        content = mutate(content, rng)
                data = content if isinstance(content, bytes) else json.dumps(content).encode()
                info.size = len(data)
                if is_hostile and rng.random() < 0.1:
                    info.name = rng.choice(HOSTILE_NAMES)
                if is_hostile and rng.random() < 0.05:
                    info.type = rng.choice((tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE,
                                            tarfile.FIFOTYPE, tarfile.GNUTYPE_SPARSE, tarfile.XHDTYPE,
                                            tarfile.GNUTYPE_LONGNAME))  # fmt: skip
                    info.linkname = "/etc/passwd"
                for _ in range(2 if is_hostile and rng.random() < 0.05 else 1):
                    tar.addfile(info, io.BytesIO(data))
        return stream.getvalue()

    def write(self, path: Path, rng: random.Random) -> Path:
        data = self.build(rng) if rng.random() < 0.6 else damage(self.tar, rng)
        return write_fresh(path, data)


def shard(folder: Path) -> Case:
    """Return a fuzz case of hostile shards, which are verified and read view by view."""
    parts = _SmallShard()

    def read(path: Path) -> None:
        report = verify_dataset(path)
        assert report.num_shards == 1
        reader = ShardReader(path)
        for view in reader:
            assert view.buffers
        reader.configuration()

    return Case(lambda rng: parts.write(folder / "shard.tar", rng), read)


def exr(folder: Path) -> Case:
    """Return a fuzz case of EXR images with damaged bytes, false windows or false compression types."""
    buffers = make_buffers(6, 9, seed=1)
    chosen = {name: buffers[name] for name in ("beauty", "roughness", "material_id")}
    originals = [encode_view(chosen, kind, 1) for kind in ("none", "rle", "zips", "zip", "piz")]

    def write(rng: random.Random) -> Path:
        data = bytearray(rng.choice(originals))
        if rng.random() < 0.4:
            for name in rng.sample((b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"), rng.randint(1, 2)):
                start = data.index(name) + len(name) + 4
                window = [rng.choice((0, -1, 1, 7, 31622, 40000, 16383, 2**31 - 1, -(2**31))) for _ in "abcd"]
                data[start : start + 16] = struct.pack("<4i", *window)
        if rng.random() < 0.2:
            at = data.index(b"compression\0compression\0") + 28
            data[at] = rng.randrange(12)
        content = damage(bytes(data), rng) if rng.random() < 0.6 else bytes(data)
        return write_fresh(folder / "view.exr", content)

    return Case(write, decode_view)


def dataset_folder(folder: Path) -> Case:
    """Return a fuzz case of dataset folders with damaged or linked documents or a hostile shard."""
    root = folder / "set"
    for name in ("shards", "units", "failed", "logs", "configurations"):
        (root / name).mkdir(parents=True)
    set_traps(root)
    set_traps(root / "shards")
    (folder / "secret.tar").write_bytes(b"secret")
    parts, documents = _SmallShard(), valid_documents()
    places = {
        "index": root / "index.json",
        "plan": root / "plan.json",
        "manifest": root / "units" / "k.json",
        "failure": root / "failed" / "small-00000.json",
        "folder": root / "dataset.json",
        "recipe": root / "recipe.yaml",
    }
    valid = {name: documents[name][0] for name in places}
    valid["index"]["shards"][0].update(sha256=sha256_hex(parts.tar), num_bytes=len(parts.tar))
    valid["manifest"].update(num_bytes=len(parts.tar), sha256=sha256_hex(parts.tar))

    def write(rng: random.Random) -> Path:
        spoiled = rng.sample(list(places), rng.randint(1, 2))
        for name, path in places.items():
            if name not in spoiled:
                write_fresh(path, json.dumps(valid[name]).encode())
            elif rng.random() < 0.15:
                write_fresh(path, b"")
                path.unlink()
                if rng.random() < 0.5:
                    os.mkfifo(path)
                else:
                    path.symlink_to(rng.choice(("../outside/secret.json", "/dev/zero", path.name)))
            else:
                write_document(path, _with_hostile_paths(valid[name], rng), rng)
        target = root / "shards" / "small.tar"
        if rng.random() < 0.3:
            parts.write(target, rng)
        else:
            write_fresh(target, parts.tar)
        return root

    def read(path: Path) -> None:
        verify_dataset(path)
        status, refusal = None, None
        for step in (
            lambda: [list(ShardReader(p).members()) for p in Dataset(path).shard_paths()],
            lambda: read_status(path),
            lambda: DatasetFolder(path).read_record(),
            lambda: collect(path, deep=True),
        ):
            try:
                result = step()
            except InputError as error:
                refusal = error
                continue
            status = result if hasattr(result, "failed") else status
        for failure in status.failed if status else ():
            last_lines(path, failure.log)
        if refusal is not None:  # raised at the end, so that all steps run
            raise refusal

    return Case(write, read)


def _with_hostile_paths(document: Any, rng: random.Random) -> Any:
    """Return the document with some file names and unit ids replaced by hostile paths."""
    text = json.dumps(document)
    for name in ("shards/small.tar", "small-00000", "logs/small-00000.3.log", '"k"'):
        if rng.random() < 0.3:
            other = rng.choice(("../secret.tar", "/dev/zero", "shards/fifo", "shards/link", "shards/link.png",
                                "../../outside/secret.png", "..", str(hostile_value(rng))[:60]))  # fmt: skip
            text = text.replace(name if name[0] != '"' else name[1:-1], json.dumps(other)[1:-1])
    try:
        return json.loads(text)
    except ValueError:
        return document


CASES: dict[str, CaseMaker] = {
    **{name: _document(name) for name in DOCUMENTS},
    "package_folder": package_folder,
    "package_zip": package_zip,
    "shard": shard,
    "exr": exr,
    "dataset_folder": dataset_folder,
}

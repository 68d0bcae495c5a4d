# SPDX-License-Identifier: MIT
"""Files from strangers: every reader gives a valid object or an InputError; nothing else, ever.

``HOSTILE_EXAMPLES=20000 pytest tests/datagen/test_hostile_input.py`` is the full run.
"""

from __future__ import annotations

import copy
import io
import json
import os
import random
import resource
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from datagen.errors import InputError
from datagen.farm.folder import Plan, UnitManifest
from datagen.formats.asset import EnvironmentAsset, MaterialAsset, ObjectAsset
from datagen.formats.base import canonical_json, read_json, read_yaml
from datagen.formats.configuration import Configuration
from datagen.formats.package import open_package
from datagen.formats.recipe import Recipe
from datagen.formats.shard import DatasetIndex, ShardReader, write_shard
from datagen.formats.view import ViewRecord
from tests.conftest import REPOSITORY
from tests.datagen.small_dataset import make_configuration, make_view_files

EXAMPLES = int(os.environ.get("HOSTILE_EXAMPLES", "100"))
HOSTILE_VALUES: list[Any] = [
    None, True, -1, 0, 1e308, -1e308, 2**70, "", "..", "../../etc/passwd", "/etc/passwd", "a\x00b", "é" * 300,
    [], {}, [[]], {"": {}}, "NaN", [1] * 1000, {"texture": "x.png", "encoding": "linear"}, "​", "C:\\x",
]  # fmt: skip

fuzz = settings(
    max_examples=EXAMPLES,
    deadline=10_000,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def mutate(document: Any, rng: random.Random) -> Any:
    """A JSON document with one to four places replaced, removed, added or repeated."""
    document = json.loads(json.dumps(document))
    for _ in range(rng.randint(1, 4)):
        places: list[tuple[Any, Any]] = []
        _collect(document, places)
        if not places:
            return _hostile(rng)
        container, key = rng.choice(places)
        action = rng.random()
        if action < 0.6:
            container[key] = _hostile(rng)
        elif action < 0.75:
            del container[key]
        elif action < 0.9 and isinstance(container, dict):
            container[str(_hostile(rng))[:40]] = _hostile(rng)
        elif isinstance(container, list):
            container.extend(container[:50])
    return document


def _hostile(rng: random.Random) -> Any:
    return copy.deepcopy(rng.choice(HOSTILE_VALUES))


def _collect(value: Any, places: list[tuple[Any, Any]]) -> None:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in list(items):
        places.append((value, key))
        _collect(child, places)


def damage(data: bytes, rng: random.Random) -> bytes:
    """Bytes truncated, flipped, spliced or with zeros put in."""
    content = bytearray(data)
    for _ in range(rng.randint(1, 5)):
        if not content:
            return b""
        position = rng.randrange(len(content))
        action = rng.random()
        if action < 0.5:
            content[position] ^= rng.randint(1, 255)
        elif action < 0.7:
            del content[position:]
        elif action < 0.85:
            content[position:position] = content[max(0, position - 64) : position]
        else:
            content[position : position + 8] = b"\xff" * 8
    return bytes(content)


def _valid_documents(tmp_path: Path) -> dict[str, tuple[Any, Callable[[Path], object]]]:
    configuration = make_configuration(num_views=2)
    make_view_files(tmp_path, configuration)
    view = json.loads((tmp_path / "view-000.json").read_text())
    material = {
        "format": "scene-materials/asset", "version": 1, "id": "oak", "title": "Oak", "kind": "material",
        "provenance": {"license": "CC0-1.0"},
        "material": {"classes": ["wood"], "roughness": 0.4, "diffuse_albedo": [0.3, 0.2, 0.1]},
    }  # fmt: skip
    part = {"name": "a", "mesh": "a.ply", "material": "m"}
    thing = {
        **{k: v for k, v in material.items() if k != "material"}, "kind": "object", "category": "cup",
        "materials": {"m": {"roughness": 0.4}}, "parts": [part],
        "minimum_m": [0, 0, 0], "maximum_m": [1, 1, 1],
    }  # fmt: skip
    room = {
        **{k: v for k, v in thing.items() if k not in ("category", "minimum_m", "maximum_m")},
        "kind": "environment",
        "camera_regions": [{"minimum_m": [0, 0, 0], "maximum_m": [1, 1, 1]}],
        "lights": [{"type": "point", "name": "p", "position_m": [0, 0, 1], "intensity": [1, 1, 1]}],
        "openings": [{"name": "w", "origin_m": [0, 0, 0], "edge_u_m": [1, 0, 0], "edge_v_m": [0, 0, 1]}],
    }
    unit = {
        "index": 0, "id": "a", "split": "train", "key": "k", "num_views": 1, "seed": 0, "assets": [],
    }  # fmt: skip
    plan = {"variant": "llvm_ad_rgb", "versions": {}, "assets": {}, "units": [unit]}
    manifest = {
        "key": "k", "id": "a", "shard": "s.tar", "sha256": "0", "num_bytes": 1, "num_views": 1,
        "attempt": "a", "host": "h", "seconds": {}, "views": [], "peak_memory_mb": 1.0,
    }  # fmt: skip
    index = {
        "recipe": {"name": "x", "configurations": 1, "views": 1}, "versions": {}, "variant": "v",
        "num_configurations": 0, "num_views": 0, "num_bytes": 0, "is_complete": True, "splits": {},
        "buffers": [], "assets": {}, "shards": [],
    }  # fmt: skip
    recipe = json.loads(json.dumps(read_yaml(Recipe, _paper_recipe()).model_dump(mode="json")))
    return {
        "recipe": (recipe, lambda path: read_yaml(Recipe, path)),
        "configuration": (
            configuration.model_dump(mode="json"),
            lambda path: read_json(Configuration, path),
        ),
        "view": (view, lambda path: read_json(ViewRecord, path)),
        "material": (material, lambda path: read_json(MaterialAsset, path)),
        "object": (thing, lambda path: read_json(ObjectAsset, path)),
        "environment": (room, lambda path: read_json(EnvironmentAsset, path)),
        "plan": (plan, lambda path: read_json(Plan, path)),
        "manifest": (manifest, lambda path: read_json(UnitManifest, path)),
        "index": (index, lambda path: read_json(DatasetIndex, path)),
    }


def _paper_recipe() -> Path:
    return REPOSITORY / "scenes" / "recipes" / "paper.yaml"


NAMES = ["recipe", "configuration", "view", "material", "object", "environment", "plan", "manifest", "index"]


@pytest.mark.parametrize("name", NAMES)
def test_the_unchanged_document_is_valid(name: str, tmp_path: Path) -> None:
    document, read = _valid_documents(tmp_path)[name]
    path = tmp_path / "document.json"
    path.write_text(json.dumps(document))
    read(path)


@pytest.mark.parametrize("name", NAMES)
@fuzz
@given(seed=st.integers(0, 2**32 - 1))
def test_documents_are_read_or_refused(
    name: str, tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    folder = tmp_path_factory.getbasetemp() / f"hostile-{name}"
    if not folder.exists():
        folder.mkdir()
    documents = _CACHE.setdefault("documents", _valid_documents(folder))
    document, read = documents[name]
    rng = random.Random(seed)
    path = folder / "document.json"
    if rng.random() < 0.7:
        path.write_text(json.dumps(mutate(document, rng)))
    else:
        path.write_bytes(damage(json.dumps(document).encode(), rng))
    try:
        result = read(path)
    except InputError as error:
        assert str(path) in str(error)
        return
    canonical_json(result)  # what was accepted can be written again  # type: ignore[arg-type]


_CACHE: dict[str, Any] = {}


@fuzz
@given(seed=st.integers(0, 2**32 - 1))
def test_packages_are_opened_or_refused(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    folder = tmp_path_factory.getbasetemp() / "hostile-zip"
    folder.mkdir(exist_ok=True)
    rng = random.Random(seed)
    material = _CACHE.setdefault("documents", _valid_documents(folder))["material"][0]
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        document = material if rng.random() < 0.4 else mutate(material, rng)
        archive.writestr("asset.json", json.dumps(document))
        if rng.random() < 0.3:
            archive.writestr(rng.choice(["../evil", "/abs", "a/../../b", "x.png"]), b"data")
    data = stream.getvalue()
    path = folder / "package.zip"
    path.write_bytes(data if rng.random() < 0.3 else damage(data, rng))
    before = set(folder.parent.iterdir())
    try:
        with open_package(path) as package:
            assert package.asset.kind in ("material", "object", "environment")
    except InputError:
        pass  # refused with a message: as good as read
    assert set(folder.parent.iterdir()) == before, "nothing is written outside"


@fuzz
@given(seed=st.integers(0, 2**32 - 1))
def test_shards_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    folder = tmp_path_factory.getbasetemp() / "hostile-shard"
    folder.mkdir(exist_ok=True)
    if "shard" not in _CACHE:
        configuration = make_configuration(num_views=1, width=16, height=8)
        stream = io.BytesIO()
        write_shard(stream, canonical_json(configuration), make_view_files(folder, configuration))
        _CACHE["shard"] = stream.getvalue()
    path = folder / "shard.tar"
    path.write_bytes(damage(_CACHE["shard"], random.Random(seed)))
    reader = ShardReader(path)
    try:
        for view in reader:
            assert view.buffers
        reader.configuration()
    except InputError as error:
        assert "shard.tar" in str(error)


@pytest.mark.parametrize("last", [16383, 40000])
def test_exr_header_that_claims_too_many_pixels_is_refused(last: int) -> None:
    from datagen.formats.exr import decode_view, encode_view
    from tests.datagen.small_dataset import make_buffers

    data = bytearray(encode_view(make_buffers(8, 8, seed=0)))
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        start = data.index(name) + len(name) + 4
        data[start : start + 16] = b"".join(v.to_bytes(4, "little") for v in (0, 0, last, last))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="EXR"):
        decode_view(bytes(data))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # kB


def test_tar_with_links_and_devices_is_refused(tmp_path: Path) -> None:
    for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE):
        path = tmp_path / "shard.tar"
        with tarfile.open(path, "w") as tar:
            info = tarfile.TarInfo("small-00000/view-000.exr")
            info.type, info.linkname = kind, "/etc/passwd"
            tar.addfile(info)
        with pytest.raises(InputError, match="regular file"):
            list(ShardReader(path))


def test_tar_member_that_claims_to_be_huge_is_refused(tmp_path: Path) -> None:
    info = tarfile.TarInfo("small-00000/view-000.exr")
    info.size = 1 << 40
    path = tmp_path / "shard.tar"
    path.write_bytes(info.tobuf(tarfile.GNU_FORMAT) + b"\0" * 2048)
    with pytest.raises(InputError, match=r"shard\.tar"):
        list(ShardReader(path))


def test_deeply_nested_and_aliased_documents_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "deep.json"
    path.write_text("[" * 200_000)
    with pytest.raises(InputError):
        read_json(Recipe, path)
    bomb = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
        f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 9)}]\n" for i in range(9)
    )
    path.write_text(bomb)
    with pytest.raises(InputError):
        read_yaml(Recipe, path)


def test_yaml_tags_make_no_objects(tmp_path: Path) -> None:
    marker = tmp_path / "made"
    path = tmp_path / "recipe.yaml"
    path.write_text(f"name: !!python/object/apply:os.mknod ['{marker}']\n")
    with pytest.raises(InputError, match="valid YAML"):
        read_yaml(Recipe, path)
    assert not marker.exists()

# SPDX-License-Identifier: MIT
"""File names in untrusted files, through every reader: none may lead outside of the file's folder."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from datagen.formats.package import open_package
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.ply import encode_ply
from datagen.foundation.paths import fault_of, named_file
from datagen.importers.common import ImportOptions
from datagen.importers.dispatch import import_asset
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from tests.datagen.hostile_cases import valid_documents
from tests.datagen.small_library import box, with_uv
from tests.model.hostile_cases import capture_texts
from tests.oversized import furniture, gltf

SECRET = b"a secret that no reader may open"
_SCENE = '<scene version="3.0.0">{}</scene>'
_TEXTURED = (
    '<shape type="rectangle"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
    '<string name="filename" value="{}"/></texture></bsdf></shape>'
)


@dataclass(frozen=True)
class Reader:
    """``write`` puts a file that names another into a folder and returns the path to read; ``read`` reads it.

    ``suffix`` is that of the named file.
    """

    suffix: str
    write: Callable[[Path, str], Path]
    read: Callable[[Path, Path], object]


def _import(path: Path, out: Path) -> object:
    return import_asset(path, out, ImportOptions(license="CC0-1.0"))


def _capture(path: Path, out: Path) -> object:
    return read_capture(path, CaptureOptions(up="z", unit_m=1.0, max_width_px=32))


def _package(path: Path, out: Path) -> object:
    with open_package(path) as package:
        return [package.read_bytes(name) for name in package.names()]


def _scene(body: str) -> Callable[[Path, str], Path]:
    def write(folder: Path, name: str) -> Path:
        path = folder / "scene.xml"
        path.write_text(_SCENE.format(body.replace("{}", name)))
        return path

    return write


def _gltf_buffer(folder: Path, name: str) -> Path:
    return gltf(folder, {"buffers": [{"byteLength": 60, "uri": name}]})


def _gltf_image(folder: Path, name: str) -> Path:
    primitive = {"attributes": {"POSITION": 0}, "indices": 1, "material": 0}
    color = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    images = {"images": [{"uri": name}], "textures": [{"source": 0}], "materials": [color]}
    return gltf(folder, {"meshes": [{"primitives": [primitive]}], **images})


def _texture_folder(folder: Path, name: str) -> Path:
    """A texture folder whose map is a link to ``name``, since texture folders name no files."""
    (folder / "Oak_Roughness.png").write_bytes(_picture())
    target = folder / name if not name.startswith(("/", "file:")) else Path(name.removeprefix("file://"))
    if target.parent == folder and target.is_symlink():
        target.rename(folder / "Oak_Color.png")
    else:
        (folder / "Oak_Color.png").symlink_to(target)
    return folder


def _catalogue(folder: Path, name: str) -> Path:
    return furniture(folder / "a.sh3f", [name.lstrip("/")], {"a/a.obj": b"v 0 0 0\n"})


def _catalogue_image(folder: Path, name: str) -> Path:
    """A catalogue whose MTL file names an image; only its base name within the archive is used."""
    model = b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n"
    members = {"a/a.obj": model, "a/a.mtl": f"newmtl m\nKd 1 1 1\nmap_Kd {name}\n".encode()}
    return furniture(folder / "a.sh3f", ["a/a.obj"], members)


def _package_texture(folder: Path, name: str) -> Path:
    document = json.loads(json.dumps(valid_documents()["material"][0]))
    document["material"]["diffuse_albedo"]["texture"] = name
    (folder / "asset.json").write_text(json.dumps(document))
    return folder


def _picture() -> bytes:
    return encode_png(np.full((8, 12, 3), 90, np.uint8))


def _form(form: str, opened: str = "") -> Callable[[Path, str], Path]:
    def write(folder: Path, name: str) -> Path:
        for file, text in capture_texts(form).items():
            (folder / file).write_text(re.sub(r'(images/)?a\.png|images/a(?=")', lambda _: name, text))
        (folder / "room.ply").write_bytes(encode_ply(with_uv(box([-1, -1, 0], [1, 1, 1]))))
        return folder / opened if opened else folder

    return write


def _capture_mesh(folder: Path, name: str) -> Path:
    (folder / "images").mkdir(exist_ok=True)
    (folder / "images" / "a.png").write_bytes(_picture())
    record = json.loads(capture_texts("capture_json")["capture.json"])
    record["mesh"]["file"] = name
    (folder / "capture.json").write_text(json.dumps(record))
    return folder


READERS = {
    "mitsuba include": Reader(".xml", _scene('<include filename="{}"/>'), _import),
    "mitsuba mesh": Reader(
        ".ply", _scene('<shape type="ply"><string name="filename" value="{}"/></shape>'), _import
    ),
    "mitsuba texture": Reader(".png", _scene(_TEXTURED), _import),
    "mitsuba sky": Reader(
        ".exr",
        _scene(
            '<shape type="rectangle"/><emitter type="envmap"><string name="filename" value="{}"/></emitter>'
        ),
        _import,
    ),
    "mitsuba sensors": Reader(".xml", _scene('<include filename="{}"/>'), _capture),
    "gltf buffer": Reader(".bin", _gltf_buffer, _import),
    "gltf image": Reader(".png", _gltf_image, _import),
    "texture folder": Reader(".png", _texture_folder, _import),
    "furniture model": Reader(".obj", _catalogue, _import),
    "furniture image": Reader(".png", _catalogue_image, _import),
    "package": Reader(".png", _package_texture, _package),
    "capture.json image": Reader(".png", _form("capture_json"), _capture),
    "capture.json mesh": Reader(".ply", _capture_mesh, _capture),
    "transforms.json": Reader(".png", _form("transforms"), _capture),
    "COLMAP": Reader(".png", _form("colmap_text"), _capture),
    "OpenMVG": Reader(".png", _form("openmvg"), _capture),
    "Metashape": Reader(".png", _form("metashape"), _capture),
    "RealityCapture": Reader(".png", _form("realitycapture_csv"), _capture),
    "Bundler": Reader(".png", _form("bundler"), _capture),
}


def _names(way: str, outside: Path, root: Path, suffix: str) -> str:
    """A name that leads from ``root`` to the secret in ``outside``."""
    secret = outside / f"secret{suffix}"
    secret.write_bytes(SECRET)
    if way == "parent":
        return f"../outside/{secret.name}"
    if way == "absolute":
        return str(secret)
    if way == "uri":
        return f"file://{secret}"
    if way == "link":
        (root / f"inner{suffix}").symlink_to(secret)
        return f"inner{suffix}"
    (root / "linked").symlink_to(outside)
    return f"linked/{secret.name}"


@pytest.fixture
def opened() -> list[str]:
    """Paths that the interpreter opens while the test runs."""
    paths: list[str] = []
    is_over = False

    def hook(event: str, arguments: tuple) -> None:
        if event == "open" and not is_over and isinstance(arguments[0], str | bytes | Path):
            paths.append(str(Path(str(arguments[0])).resolve()))

    sys.addaudithook(hook)
    yield paths
    is_over = True


@pytest.mark.parametrize("way", ["parent", "absolute", "uri", "link", "linked_folder"])
@pytest.mark.parametrize("name", READERS)
def test_no_reader_leaves_its_folder(name: str, way: str, tmp_path: Path, opened: list[str]) -> None:
    reader = READERS[name]
    root, outside = tmp_path / "root", tmp_path / "outside"
    root.mkdir()
    outside.mkdir()
    target = _names(way, outside, root, reader.suffix)
    path = reader.write(root, target)
    opened.clear()
    with pytest.raises(InputError) as refused:
        reader.read(path, tmp_path / "library")
    assert not [p for p in opened if p.startswith(str(outside))]
    assert SECRET.decode() not in str(refused.value)
    problem = refused.value.problems[0]
    assert problem.expected and problem.remedy
    assert not (tmp_path / "library").exists() or not [
        p for p in (tmp_path / "library").rglob("*") if p.is_file() and SECRET in p.read_bytes()
    ]


@pytest.mark.parametrize("kind", ["map", "licence", "info", "folder"])
def test_links_in_a_texture_folder_are_not_followed_out_of_it(kind: str, tmp_path: Path) -> None:
    """Regression: the links' targets were copied into the library."""
    outside, textures = tmp_path / "outside", tmp_path / "all" / "oak"
    textures.mkdir(parents=True)
    outside.mkdir()
    for role in ("Color", "Roughness"):
        (textures / f"Oak_{role}.png").write_bytes(_picture())
        (outside / f"Oak_{role}.png").write_bytes(_picture())
    source = textures
    if kind == "map":
        (textures / "Oak_Color.png").unlink()
        (textures / "Oak_Color.png").symlink_to(outside / "Oak_Color.png")
    elif kind == "licence":
        (outside / "secret").write_text("CC0, version of 'Secret' by Someone, downloaded")
        (textures / "LICENSE.txt").symlink_to(outside / "secret")
    elif kind == "info":
        (outside / "secret").write_text('{"creator": "ambientcg", "name": "Secret"}')
        (textures / "info.json").symlink_to(outside / "secret")
    else:
        source = tmp_path / "all"
        (source / "pine").symlink_to(outside)
    options = ImportOptions(license="CC0-1.0")
    with pytest.raises(InputError, match="leads to"):
        import_asset(source, tmp_path / "library", options)
    assert not list((tmp_path / "library").rglob("*.png"))
    if kind == "map":
        allowed = ImportOptions(license="CC0-1.0", allowed=(outside,))
        assert len(import_asset(source, tmp_path / "library", allowed)) == 1


def test_links_within_the_folder_and_allowed_folders_are_followed(tmp_path: Path) -> None:
    root, other = tmp_path / "root", tmp_path / "other"
    (root / "textures").mkdir(parents=True)
    other.mkdir()
    (root / "textures" / "a.png").write_bytes(_picture())
    (other / "b.png").write_bytes(_picture())
    (root / "link.png").symlink_to("textures/a.png")
    for name in ("textures/a.png", "link.png", "textures\\a.png", "textures/../link.png", "./link.png"):
        assert named_file(root, name, "x", "y") == (root / "textures" / "a.png").resolve()
    for name in ("../other/b.png", str(other / "b.png")):
        assert named_file(root, name, "x", "y", [other]) == (other / "b.png").resolve()
        with pytest.raises(InputError, match="a file inside"):
            named_file(root, name, "x", "y")
    assert fault_of(root, "absent.png") == ((root / "absent.png").resolve(), "")
    for name, fault in (
        ("", "no name"), ("a\0b.png", "not a valid file name"), ("C:/a.png", "another system"),
        ("FILE:/a.png", "a URI"), ("http://x/a.png", "a URI"), ("textures", "not a regular"),
        ("/a.png", "absolute"), ("a" * 300, "long"),
    ):  # fmt: skip
        assert fault in fault_of(root, name)[1] and fault_of(root, name)[0] is None
    (root / "scene.xml").write_text(_SCENE.format(_TEXTURED.replace("{}", "../other/b.png")))
    options = ImportOptions(license="CC0-1.0", allowed=(other,))
    [record] = import_asset(root / "scene.xml", tmp_path / "library", options)
    assert (record.path / "textures" / "b.png").read_bytes() == _picture()

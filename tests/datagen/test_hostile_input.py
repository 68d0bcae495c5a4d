# SPDX-License-Identifier: MIT
"""Every reader of untrusted files returns a valid object or raises InputError.

``HOSTILE_EXAMPLES=20000 pytest tests/datagen/test_hostile_input.py tests/model/test_hostile_input.py -s`` is
the full run. The cases are in ``hostile_cases``, the code that runs them in ``tests.hostile``.
"""

from __future__ import annotations

import io
import json
import os
import resource
import stat
import struct
import tarfile
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from datagen.farm.folder import DatasetFolder
from datagen.formats.base import read_json, read_yaml
from datagen.formats.package import open_package
from datagen.formats.recipe import Recipe
from datagen.formats.shard import Dataset, ShardReader
from datagen.foundation.errors import InputError
from datagen.foundation.exr import decode_view, encode_view
from datagen.foundation.images import encode_png, read_image
from datagen.foundation.meshes.ply import read_ply
from datagen.foundation.paths import inside
from tests.datagen.hostile_cases import CASES, DOCUMENTS, valid_documents
from tests.datagen.small_dataset import make_buffers
from tests.hostile import attack, set_traps


@pytest.mark.parametrize("name", CASES)
def test_readers_return_objects_or_refuse(name: str, tmp_path: Path) -> None:
    attack("tests.datagen.hostile_cases", name, tmp_path / "case")


@pytest.mark.parametrize("name", DOCUMENTS)
def test_the_unchanged_document_is_valid(name: str, tmp_path: Path) -> None:
    document, read = valid_documents()[name]
    path = tmp_path / "document.json"
    path.write_text(json.dumps(document))
    read(path)


# ---------------------------------------------------------------------- bombs and false claims


@pytest.fixture
def memory_stays_low():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # kB


@pytest.mark.parametrize("window", [(0, 0, 16383, 16383), (0, 0, 31622, 31622), (-500, -500, 39499, 24499)])
def test_exr_header_that_claims_too_many_pixels_is_refused(
    window: tuple[int, ...], tmp_path: Path, memory_stays_low: None
) -> None:
    """A file of a few kilobytes that claims 2.7e8 to 1e9 pixels is refused as a view and as a texture."""
    data = bytearray(encode_view(make_buffers(8, 8, seed=0)))
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        start = data.index(name) + len(name) + 4
        data[start : start + 16] = struct.pack("<4i", *window)
    with pytest.raises(InputError, match=r"EXR|a size that the file can contain"):
        decode_view(bytes(data))
    path = tmp_path / "texture.exr"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"texture\.exr"):
        read_image(path)


def _png(width: int, height: int, body: bytes) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = struct.pack(">IIBBBBB", width, height, 16, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(31623, 31623), (16384, 16384), (2**31 - 1, 2**31 - 1), (0, 5)])
def test_png_that_claims_too_many_pixels_is_refused(
    size: tuple[int, int], tmp_path: Path, memory_stays_low: None
) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(_png(*size, zlib.compress(bytes(1 << 16))))
    with pytest.raises(InputError, match=r"bomb\.png"):
        read_image(path)


def test_png_chunk_of_four_gigabytes_is_refused(tmp_path: Path, memory_stays_low: None) -> None:
    """OpenCV would allocate the claimed chunk length: 4 GB in ten seconds for a file of 292 bytes."""
    data = bytearray(encode_png(np.zeros((5, 6, 3), np.uint8)))
    at = data.index(b"IDAT") - 4
    data[at : at + 4] = b"\xff\xff\xff\x7f"
    path = tmp_path / "chunk.png"
    path.write_bytes(data)
    with pytest.raises(InputError, match="corrupt data"):
        read_image(path)


def test_another_format_with_a_known_suffix_is_refused(tmp_path: Path) -> None:
    """OpenCV can decode these formats, but packages must not contain them."""
    import cv2

    for suffix in (".bmp", ".tiff", ".webp", ".jp2"):
        done, data = cv2.imencode(suffix, np.zeros((64, 64, 3), np.uint8))
        path = tmp_path / "image.png"
        path.write_bytes(data.tobytes())
        with pytest.raises(InputError, match=r"image\.png"):
            read_image(path)
        assert done


def test_ply_that_is_shorter_than_its_header_is_refused(tmp_path: Path, memory_stays_low: None) -> None:
    path = tmp_path / "mesh.ply"
    for header in (
        "element vertex 200000000\nproperty float x\nproperty float y\nproperty float z\n",
        "element vertex 200000000\n",
        "element vertex 1\nproperty float x\nproperty float x\n",
        "element face 200000000\nproperty list char int vertex_indices\n",
        "element vertex 999999999999\nproperty float x\n",
    ):
        for form in ("binary_little_endian", "ascii"):
            path.write_bytes(f"ply\nformat {form} 1.0\n{header}end_header\n".encode() + b"\xff" * 64)
            with pytest.raises(InputError, match=r"mesh\.ply"):
                read_ply(path)


def test_zip_bomb_is_refused(tmp_path: Path, memory_stays_low: None) -> None:
    """A zip that expands from 80 kB to 80 MB is refused, and so is one whose directory understates a size."""
    document = json.dumps(valid_documents()["material"][0])
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("asset.json", document)
        with archive.open("a.png", "w", force_zip64=True) as member:
            for _ in range(20):
                member.write(bytes(1 << 22))
    assert path.stat().st_size < 100_000
    with pytest.raises(InputError, match="unpacked members: bytes = 8388"):
        open_package(path)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("asset.json", document)
        archive.writestr("a.png", bytes(1 << 20))
    data = bytearray(stream.getvalue())
    at = data.index(b"PK\x01\x02", data.index(b"PK\x01\x02") + 1)  # the second entry of the directory
    data[at + 24 : at + 28] = struct.pack("<I", 1000)  # claims a kilobyte but unpacks to a megabyte
    path.write_bytes(data)
    with pytest.raises(InputError), open_package(path) as package:
        package.read_bytes("a.png")


def test_zip_members_that_lead_outside_are_refused(tmp_path: Path) -> None:
    document = json.dumps(valid_documents()["material"][0])
    for name, mode in (
        ("../evil.png", 0), ("/evil.png", 0), ("a/../../evil.png", 0), ("C:/evil.png", 0), ("a\\evil.png", 0),
        ("a.png", stat.S_IFLNK | 0o777), ("a.png", stat.S_IFCHR | 0o666), ("a.png", stat.S_IFIFO | 0o666),
    ):  # fmt: skip
        path = tmp_path / "package.zip"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("asset.json", document)
            info = zipfile.ZipInfo(name)
            info.external_attr = mode << 16
            archive.writestr(info, "/etc/passwd")
        with pytest.raises(InputError, match="plain files inside the archive"):
            open_package(path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["package.zip"]


@pytest.mark.parametrize("name", ["link.png", "fifo.png", "link/secret.png"])
def test_package_files_that_lead_outside_are_refused(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "package"
    folder.mkdir()
    set_traps(folder)
    document = valid_documents()["material"][0]
    document["material"]["diffuse_albedo"]["texture"] = name
    (folder / "asset.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"a symbolic link|not a regular file"):
        open_package(folder)


def test_tar_with_links_and_devices_is_refused(tmp_path: Path) -> None:
    for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE):
        path = tmp_path / "shard.tar"
        with tarfile.open(path, "w") as tar:
            info = tarfile.TarInfo("small-00000/view-000.exr")
            info.type, info.linkname = kind, "/etc/passwd"
            tar.addfile(info)
        with pytest.raises(InputError, match="regular file"):
            list(ShardReader(path))


def test_tar_member_that_claims_to_be_huge_is_refused(tmp_path: Path, memory_stays_low: None) -> None:
    info = tarfile.TarInfo("small-00000/view-000.exr")
    path = tmp_path / "shard.tar"
    for size in (1 << 40, (2 << 30) - 1):
        info.size = size
        path.write_bytes(info.tobuf(tarfile.GNU_FORMAT) + b"\0" * 2048)
        with pytest.raises(InputError, match=r"shard\.tar"):
            list(ShardReader(path))


def test_sparse_tar_member_is_refused(tmp_path: Path, memory_stays_low: None) -> None:
    """A sparse member of a few bytes may claim a gigabyte of zeros."""
    header = bytearray(tarfile.TarInfo("small-00000/view-000.exr").tobuf(tarfile.GNU_FORMAT))
    header[156:157] = tarfile.GNUTYPE_SPARSE
    header[483:495] = b"%011o\0" % (1 << 30)
    header[148:156] = b"        "
    header[148:156] = b"%06o\0 " % sum(header[:512])
    path = tmp_path / "shard.tar"
    path.write_bytes(bytes(header) + bytes(2048))
    with pytest.raises(InputError, match=r"shard\.tar"):
        list(ShardReader(path))


def test_pipes_and_devices_are_not_read(tmp_path: Path) -> None:
    """Reading a pipe or device would never end."""
    fifo = tmp_path / "fifo.tar"
    os.mkfifo(fifo)
    for path in (fifo, Path("/dev/zero"), tmp_path):
        with pytest.raises(InputError):
            read_json(Recipe, path)
        with pytest.raises(InputError):
            list(ShardReader(path).members())
        with pytest.raises(InputError):
            inside(path.parent, path)


def test_dataset_that_links_outside_is_refused(tmp_path: Path) -> None:
    root = tmp_path / "set"
    (root / "shards").mkdir(parents=True)
    index = valid_documents()["index"][0]
    (tmp_path / "outside.json").write_text(json.dumps(index))
    (root / "index.json").symlink_to("../outside.json")
    with pytest.raises(InputError, match="leads to"):
        Dataset(root)
    (root / "index.json").unlink()
    (root / "index.json").write_text(json.dumps(index))
    (root / "shards" / "small.tar").symlink_to("/etc/passwd")
    with pytest.raises(InputError, match="leads to"):
        list(Dataset(root).views())
    (root / "dataset.json").symlink_to("/etc/passwd")
    with pytest.raises(InputError, match="leads to"):
        DatasetFolder(root).read_record()


def test_many_faults_give_a_short_message(tmp_path: Path) -> None:
    path = tmp_path / "recipe.json"
    path.write_text(json.dumps({f"key{k}": "x" * 1000 for k in range(2_000)}))
    with pytest.raises(InputError, match="more problems") as caught:
        read_json(Recipe, path)
    assert len(str(caught.value)) < 50_000
    with pytest.raises(InputError, match="at most 512 kB"):
        read_yaml(Recipe, path)


def test_deeply_nested_and_aliased_documents_are_refused(tmp_path: Path, memory_stays_low: None) -> None:
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


def test_yaml_tags_create_no_objects(tmp_path: Path) -> None:
    marker = tmp_path / "made"
    path = tmp_path / "recipe.yaml"
    path.write_text(f"name: !!python/object/apply:os.mknod ['{marker}']\n")
    with pytest.raises(InputError, match="valid YAML"):
        read_yaml(Recipe, path)
    assert not marker.exists()

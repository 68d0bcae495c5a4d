# SPDX-License-Identifier: MIT
"""Photographs of every format are read, or refused once per format with name and remedy."""

from __future__ import annotations

import importlib.util
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from datagen.foundation.cameras import Camera
from datagen.foundation.color import linear_from_srgb
from datagen.foundation.errors import InputError
from model.reconstruction.captures import photograph_files
from model.reconstruction.captures.photograph_files import photograph_size, read_photograph
from model.reconstruction.captures.photographs import PhotographSource, exif_orientation, relative_exposure
from model.reconstruction.captures.posed import ImageFinder
from model.reconstruction.captures.read import read_capture
from model.reconstruction.photos.pipeline import photographs_in
from tests.model.test_reconstruction_captures import make_cameras, write_colmap, write_mesh

SIZE = (64, 40)
HAS_RAW = importlib.util.find_spec("rawpy") is not None
HAS_HEIC = importlib.util.find_spec("pillow_heif") is not None


def picture() -> Image.Image:
    """Smooth colours, which lossy formats keep, brighter to the right and greener downwards."""
    x, y = np.meshgrid(np.linspace(40, 220, SIZE[0]), np.linspace(30, 200, SIZE[1]))
    return Image.fromarray(np.stack([x, y, 0.5 * x], axis=-1).astype(np.uint8))


def write_heic(path: Path, orientation: int = 1) -> Path:
    from pillow_heif import register_heif_opener

    register_heif_opener()
    exif = Image.Exif()
    exif[0x0112] = orientation
    ifd = exif.get_ifd(0x8769)
    ifd.update({0x829A: 0.01, 0x829D: 2.0, 0x8827: 100})
    picture().save(path, format="HEIF", quality=95, exif=exif)
    return path


@pytest.fixture
def without_heic(monkeypatch: pytest.MonkeyPatch) -> None:
    found = photograph_files.find_spec
    monkeypatch.setattr(
        photograph_files, "find_spec", lambda name: None if name == "pillow_heif" else found(name)
    )


def colmap_of(folder: Path, suffix: str, num: int = 3) -> Path:
    """A COLMAP model of ``num`` photographs with names ending in ``suffix``, without the files."""
    write_colmap(folder / "sparse", make_cameras(num), "text", "PINHOLE", [55, 57, 32, 20])
    images = folder / "sparse" / "images.txt"
    images.write_text(images.read_text().replace(".png", suffix))
    (folder / "images").mkdir()
    write_mesh(folder)
    return folder


@pytest.mark.skipif(not HAS_HEIC, reason="needs pillow-heif")
def test_heic_is_read(tmp_path: Path) -> None:
    expected = np.asarray(picture()).astype(float)
    pixels = read_photograph(write_heic(tmp_path / "a.HEIC"))[0]
    assert pixels.dtype == np.uint8 and photograph_size(tmp_path / "a.HEIC") == SIZE
    assert np.abs(pixels - expected).mean() < 4
    assert exif_orientation(tmp_path / "a.HEIC") == 1
    assert relative_exposure(tmp_path / "a.HEIC") == pytest.approx(0.01 * 100 / 4)
    turned = write_heic(tmp_path / "b.heic", orientation=6)
    assert exif_orientation(turned) == 1, "HEIC is turned by its own property, which EXIF only repeats"
    assert photograph_size(turned) == read_photograph(turned)[0].shape[1::-1] == SIZE
    damaged = tmp_path / "c.heic"
    damaged.write_bytes(turned.read_bytes()[:400])
    with pytest.raises(InputError, match=r"c\.heic"):
        read_photograph(damaged)


@pytest.mark.skipif(not HAS_HEIC, reason="needs pillow-heif")
def test_a_capture_of_heic_photographs(tmp_path: Path) -> None:
    folder = colmap_of(tmp_path / "room", ".HEIC")
    for k in range(3):
        write_heic(folder / "images" / f"img{k}.HEIC")
    capture = read_capture(folder)
    assert [view.name for view in capture.views] == ["img0", "img1", "img2"]
    assert capture.views[0].read().color.shape == (*SIZE[::-1], 3)


def test_webp_is_read(tmp_path: Path) -> None:
    picture().save(tmp_path / "a.webp", lossless=True)
    np.testing.assert_array_equal(read_photograph(tmp_path / "a.webp")[0], np.asarray(picture()))
    assert photograph_size(tmp_path / "a.webp") == SIZE
    assert ImageFinder(tmp_path).find("a") == (tmp_path / "a.webp").resolve()
    camera = make_cameras(1)[0]
    assert PhotographSource(tmp_path / "a.webp", camera, None, "auto").read(camera).color.shape[2] == 3


def test_heic_without_its_reader_names_the_package_to_install(tmp_path: Path, without_heic: None) -> None:
    """Regression: the message was "not found" for each photograph."""
    folder = colmap_of(tmp_path / "room", ".HEIC")
    for k in range(3):
        (folder / "images" / f"img{k}.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert len(caught.value.problems) == 1
    text = str(caught.value)
    assert "img0.HEIC and 2 more = HEIC" in text and "pip install 'scene-materials[heic]'" in text
    with pytest.raises(InputError, match="pip install 'scene-materials"):
        read_photograph(folder / "images" / "img0.HEIC")


@pytest.fixture
def without_raw(monkeypatch: pytest.MonkeyPatch) -> None:
    found = photograph_files.find_spec
    monkeypatch.setattr(photograph_files, "find_spec", lambda name: None if name == "rawpy" else found(name))


NEUTRAL = (0.5, 1.0, 0.8)
BLACK, WHITE = 512, 15000
XYZ_TO_SRGB = (
    (3.2406, -1.5372, -0.4986),
    (-0.9689, 1.8758, 0.0415),
    (0.0557, -0.2040, 1.0570),
)


def write_dng(path: Path, linear: NDArray[np.float64], orientation: int = 1) -> Path:
    """Write a DNG with an R G / G B mosaic of linear Rec.709 colours ``linear`` (H, W, 3) and the as-shot
    neutral :data:`NEUTRAL`; 1/100 s, f/2, ISO 100."""
    height, width = linear.shape[:2]
    colors = np.tile([[0, 1], [1, 2]], (height // 2, width // 2))
    rows, columns = np.mgrid[:height, :width]
    share = np.clip(linear[rows, columns, colors] * np.array(NEUTRAL)[colors], 0, 1)
    sensor = np.round(BLACK + (WHITE - BLACK) * share).astype("<u2").tobytes()

    def ratios(values: object, denominator: int = 10000) -> list[int]:
        return [n for v in np.ravel(values) for n in (round(float(v) * denominator), denominator)]

    def directory(tags: dict[int, tuple[int, int, bytes]], at: int) -> bytes:
        """An IFD at offset ``at``, followed by values that do not fit into its entries."""
        entries, more = b"", b""
        behind = at + 2 + 12 * len(tags) + 4
        for tag, (kind, count, value) in sorted(tags.items()):
            if len(value) > 4:
                place, more = struct.pack("<I", behind + len(more)), more + value + bytes(len(value) % 2)
            else:
                place = value.ljust(4, b"\0")
            entries += struct.pack("<HHI", tag, kind, count) + place
        return struct.pack("<H", len(tags)) + entries + bytes(4) + more

    def shorts(*values: int) -> tuple[int, int, bytes]:
        return 3, len(values), struct.pack(f"<{len(values)}H", *values)

    def long(value: int) -> tuple[int, int, bytes]:
        return 4, 1, struct.pack("<I", value)

    def rationals(values: object, kind: int = 5) -> tuple[int, int, bytes]:
        numbers = ratios(values)
        return kind, len(numbers) // 2, struct.pack(f"<{len(numbers)}{'i' if kind == 10 else 'I'}", *numbers)

    exif_at = 8 + len(sensor)
    exif = directory({33434: rationals(0.01), 33437: rationals(2.0), 34855: shorts(100)}, exif_at)
    tags = {
        254: long(0), 256: long(width), 257: long(height), 258: shorts(16), 259: shorts(1),
        262: shorts(32803), 271: (2, 6, b"maker\0"), 272: (2, 6, b"model\0"), 273: long(8),
        274: shorts(orientation), 277: shorts(1), 278: long(height), 279: long(len(sensor)),
        33421: shorts(2, 2),
        33422: (1, 4, bytes([0, 1, 1, 2])), 34665: long(exif_at), 50706: (1, 4, bytes([1, 4, 0, 0])),
        50708: (2, 6, b"model\0"), 50714: long(BLACK), 50717: long(WHITE), 50721: rationals(XYZ_TO_SRGB, 10),
        50728: rationals(NEUTRAL), 50778: shorts(21),
    }  # fmt: skip
    first = exif_at + len(exif)
    path.write_bytes(b"II*\0" + struct.pack("<I", first) + sensor + exif + directory(tags, first))
    return path


@pytest.mark.skipif(not HAS_RAW, reason="needs rawpy")
def test_raw_photographs_are_linear_with_a_clipping_limit(tmp_path: Path) -> None:
    """Black level, white balance and exposure are applied; a clipped sensor value clips all channels."""
    height, width = 80, 120
    linear = np.empty((height, width, 3))
    linear[:] = np.linspace(0.02, 0.45, width)[None, :, None] * [1.0, 0.8, 0.6]
    linear[:20, :30] = [0.3, 1.2, 0.2]  # green is clipped
    path = write_dng(tmp_path / "a.dng", linear)
    assert photograph_size(path) == (width, height) and exif_orientation(path) == 1
    assert relative_exposure(path) == pytest.approx(0.01 * 100 / 4, rel=1e-3)
    camera = Camera(width, height, 100.0, 100.0, width / 2, height / 2, np.eye(4))
    image = PhotographSource(path, camera, None, "srgb").read(camera)  # raw files are not sRGB
    inner = (slice(30, -8), slice(8, -8))
    np.testing.assert_allclose(image.color[inner], linear[inner], rtol=0.02, atol=2e-3)
    assert image.clipped_mask is not None and image.clipped_mask[4:16, 4:26].all()
    assert not image.clipped_mask[30:].any() and not image.clipped_mask[:, 40:].any()
    turned = write_dng(tmp_path / "b.dng", linear, orientation=6)
    assert photograph_size(turned) == (height, width) == read_photograph(turned)[0].shape[1::-1]
    upright = np.rot90(read_photograph(path)[0], -1)
    np.testing.assert_array_equal(read_photograph(turned)[0][8:-8, 8:-8], upright[8:-8, 8:-8])
    damaged = tmp_path / "c.dng"
    damaged.write_bytes(path.read_bytes()[:400])
    with pytest.raises(InputError, match=r"c\.dng"):
        read_photograph(damaged)


@pytest.mark.parametrize(("suffix", "kind"), [("dng", "a raw photograph"), ("HEIC", "HEIC")])
def test_photographs_that_colmap_cannot_read_need_cameras(tmp_path: Path, suffix: str, kind: str) -> None:
    for name in "abc":
        (tmp_path / f"{name}.{suffix}").write_bytes(b"anything")
    with pytest.raises(InputError, match=rf"a\.{suffix} = {kind}; .*COLMAP reads.*capture with cameras"):
        photographs_in(tmp_path)


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_16_bits_are_kept(tmp_path: Path, suffix: str) -> None:
    """16-bit values are sRGB-encoded like 8-bit ones, in finer steps."""
    stored = np.arange(64 * 40 * 3, dtype=np.uint16).reshape(40, 64, 3) * 8
    cv2.imwrite(str(tmp_path / f"a{suffix}"), stored[..., ::-1])
    np.testing.assert_array_equal(read_photograph(tmp_path / f"a{suffix}")[0], stored)
    camera = make_cameras(1)[0]
    color = PhotographSource(tmp_path / f"a{suffix}", camera, None, "auto").read(camera).color
    np.testing.assert_allclose(color, linear_from_srgb(stored / 65535.0), atol=1e-6)


@pytest.mark.parametrize(
    ("suffix", "expected"),
    [
        (".CR2", r"CR2, a raw photograph.*scene-materials\[raw\].*develop"),
        (".bmp", "BMP.*convert them to PNG"),
    ],
)
def test_unsupported_photographs_are_distinguished_from_missing_ones(
    tmp_path: Path, suffix: str, expected: str, without_raw: None
) -> None:
    folder = colmap_of(tmp_path / "room", suffix)
    for k in range(2):
        (folder / "images" / f"img{k}{suffix}").write_bytes(b"anything")
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    unread, missing = caught.value.problems
    assert unread.field == f"img0{suffix} and 1 more"
    assert missing.field == f"img2{suffix}" and missing.got == "not found"
    with pytest.raises(InputError, match=expected):
        read_photograph(folder / "images" / f"img0{suffix}")


def test_every_reader_names_unsupported_formats(tmp_path: Path, without_heic: None) -> None:
    """Covers transforms.json, Bundler and RealityCapture."""
    (tmp_path / "a.heic").write_bytes(b"anything")
    write_mesh(tmp_path)
    frames = [{"file_path": "a.heic", "transform_matrix": np.eye(4).tolist()}]
    transforms = tmp_path / "transforms.json"
    transforms.write_text(json.dumps({"fl_x": 50, "frames": frames}))
    with pytest.raises(InputError, match=r"transforms\.json: a\.heic = HEIC; .*pillow-heif"):
        read_capture(tmp_path)
    transforms.unlink()
    (tmp_path / "bundle.out").write_text("# Bundle file v0.3\n1 0\n50 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n")
    (tmp_path / "list.txt").write_text("a.heic\n")
    with pytest.raises(InputError, match=r"bundle\.out: a\.heic = HEIC; .*pillow-heif"):
        read_capture(tmp_path)
    (tmp_path / "bundle.out").unlink()
    header = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
    (tmp_path / "cameras.csv").write_text(f"{header}\na.heic{',1' * 15}\n")
    with pytest.raises(InputError, match=r"cameras\.csv: a\.heic = HEIC; .*pillow-heif"):
        read_capture(tmp_path)


def test_a_raw_beside_its_jpeg_is_ignored(tmp_path: Path) -> None:
    picture().save(tmp_path / "a.jpg")
    (tmp_path / "a.cr2").write_bytes(b"anything")
    assert ImageFinder(tmp_path).find("somewhere/a") == (tmp_path / "a.jpg").resolve()


def test_a_mesh_of_an_unsupported_format_is_named(tmp_path: Path) -> None:
    """Regression: the message was "no mesh beside the cameras"."""
    folder = colmap_of(tmp_path / "room", ".webp", 1)
    picture().save(folder / "images" / "img0.webp", lossless=True)
    (folder / "room.ply").rename(folder / "room.fbx")
    with pytest.raises(InputError, match=r"room\.fbx, of an unsupported format; .*\.obj.*convert it"):
        read_capture(folder)

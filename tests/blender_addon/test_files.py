# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's file writers, texture pyramid and expressions, without Blender."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from blender_addon.bake import expression as ex
from blender_addon.bake.pyramid import fill, smallest_level
from blender_addon.problems import ProblemList
from blender_addon.settings import ExportSettings
from blender_addon.write import PackageWriter, exr_bytes, json_bytes, ply_bytes, png_bytes, rounded
from datagen.foundation.meshes.ply import decode_ply


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("shape", [(1, 1), (3, 7), (64, 33)])
def test_png_reads_back(channels: int, shape: tuple[int, int]) -> None:
    generator = np.random.default_rng(channels)
    smooth = np.cumsum(generator.integers(0, 5, (*shape, channels)), axis=1).astype(np.uint8)
    for pixels in (smooth, generator.integers(0, 256, (*shape, channels)).astype(np.uint8)):
        got = np.asarray(Image.open(io.BytesIO(png_bytes(pixels))))
        assert np.array_equal(got.reshape(pixels.shape), pixels)


def test_png_of_16_bits_reads_back() -> None:
    pixels = np.random.default_rng(0).integers(0, 65536, (9, 5, 1)).astype(np.uint16)
    got = np.asarray(Image.open(io.BytesIO(png_bytes(pixels))))
    assert np.array_equal(got, pixels[..., 0])


@pytest.mark.parametrize("shape", [(1, 1), (17, 5), (40, 64)])
def test_exr_reads_back_as_half(tmp_path: Path, shape: tuple[int, int]) -> None:
    pixels = np.random.default_rng(1).gamma(1.0, 3.0, (*shape, 3)).astype(np.float32)
    path = tmp_path / "x.exr"
    path.write_bytes(exr_bytes(pixels))
    with OpenEXR.File(str(path)) as file:
        got = file.channels()["RGB"].pixels
    assert np.array_equal(got, pixels.astype(np.float16))


@pytest.mark.parametrize("has_uv", [True, False])
def test_ply_reads_back(has_uv: bool) -> None:
    generator = np.random.default_rng(2)
    positions = generator.normal(size=(20, 3)).astype(np.float32)
    normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    uv = generator.random((20, 2)).astype(np.float32) if has_uv else None
    faces = generator.permutation(18).reshape(6, 3).astype(np.int32)
    mesh = decode_ply(ply_bytes(positions, normals, uv, faces), "x.ply")
    assert np.array_equal(mesh.positions, positions)
    assert np.array_equal(mesh.faces, faces)
    assert (mesh.uv is None) == (uv is None)
    if uv is not None:
        assert np.array_equal(mesh.uv, uv)


def test_json_is_canonical_and_refuses_nan() -> None:
    assert json_bytes({"b": np.float32(0.1), "a": [-0.0]}) == json_bytes({"a": [0.0], "b": np.float32(0.1)})
    with pytest.raises(ValueError, match="nan"):
        rounded({"x": float("nan")})


def test_package_is_written_atomically(tmp_path: Path) -> None:
    folder = tmp_path / "thing"
    with PackageWriter(folder) as writer:
        first = writer.add("textures", "a", ".png", b"1")
        assert writer.add("textures", "b", ".png", b"1") == first
        assert writer.add("textures", "a", ".png", b"2") == "textures/a_2.png"
        writer.finish({"id": "thing"})
    before = sorted(path.name for path in folder.rglob("*"))
    with pytest.raises(RuntimeError), PackageWriter(folder) as writer:
        writer.add("textures", "c", ".png", b"3")
        raise RuntimeError
    assert sorted(path.name for path in folder.rglob("*")) == before
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]


def _mask(size: int) -> np.ndarray:
    return np.ones((size, size), bool)


def test_smooth_image_shrinks_and_stays_within_tolerance() -> None:
    t = (np.arange(256) + 0.5) / 256 * 2 * np.pi
    image = (0.5 + 0.4 * np.sin(t)[None, :, None] * np.ones((256, 1, 1))).astype(np.float32)
    level = smallest_level(image, _mask(256), 1 / 255)
    assert level.image.shape[0] == 1, "nothing varies along v"
    assert 4 <= level.image.shape[1] <= 64
    assert level.error <= 1 / 255


def test_noise_does_not_shrink() -> None:
    image = np.random.default_rng(3).random((64, 64, 1)).astype(np.float32)
    assert smallest_level(image, _mask(64), 1 / 255).image.shape == image.shape


def test_fill_extends_the_covered_colour() -> None:
    image = np.zeros((32, 32, 1), np.float32)
    mask = np.zeros((32, 32), bool)
    mask[8:16, 8:16], image[8:16, 8:16] = True, 0.7
    assert np.allclose(fill(image, mask), 0.7)


def test_expressions_fold_constants() -> None:
    socket = ex.SocketValue((), "Image", "Color", 3)
    assert ex.multiply(socket, ex.ONE) == socket
    assert ex.multiply(socket, ex.ZERO) == ex.BLACK
    assert ex.lerp(socket, ex.constant(1, 1, 1), ex.ZERO) == socket
    assert ex.complement(ex.complement(socket)) == socket
    assert ex.fresnel_f0(ex.constant(1.5)).value == pytest.approx((0.04,))  # type: ignore[union-attr]
    assert ex.sockets(ex.add(ex.multiply(socket, ex.constant(0.5)), ex.BLACK)) == {socket}


def test_invalid_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="power of two"):
        ExportSettings(max_texture_px=1000)
    with pytest.raises(ValueError, match="kind"):
        ExportSettings(kind="room")


def test_problems_are_deduplicated_and_readable() -> None:
    problems = ProblemList()
    for _ in range(2):
        problems.add("error", "it is broken", "mend it", object="Cup", node="Glass")
    assert [str(p) for p in problems] == ["error: object 'Cup', node 'Glass': it is broken; mend it"]

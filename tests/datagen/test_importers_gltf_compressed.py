# SPDX-License-Identifier: MIT
"""glTF with meshopt compression or Basis Universal textures imports as the uncompressed file does."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datagen.formats.package import open_package
from datagen.foundation.budget import Budget, Limits
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png, read_image
from datagen.foundation.meshes.gltf import GltfFile
from datagen.foundation.meshes.gltf_compressed import png_of_basis
from datagen.foundation.meshes.ply import decode_ply
from datagen.importers.gltf import import_gltf
from tests.datagen.test_importers_gltf import LICENSED, QUAD, QUAD_UV, Builder, panel

alktx2 = pytest.importorskip("alktx2", reason="writes textures of Basis Universal (extra `dev`)")
meshopt = pytest.importorskip("meshopt", reason="not installed (extra `gltf`)")
basisu = pytest.importorskip("opengl_basisu", reason="not installed (extra `gltf`)")

INDICES = np.array([0, 1, 2, 0, 2, 3], np.uint16)


def compressed(path: Path, filters: bool = False, **changes: Any) -> Path:
    """Write the quad of the uncompressed tests with all buffer views compressed by meshopt; return ``path``.
    The fallback buffer is omitted, as by gltfpack. ``changes`` replace fields of the extension."""
    builder = Builder().quad().material()
    data, views = b"", []
    contents = [(QUAD, "ATTRIBUTES"), (QUAD_UV, "ATTRIBUTES"), (INDICES, "TRIANGLES")]
    for (array, mode), plain in zip(contents, builder.json["bufferViews"], strict=True):
        extra = {}
        if filters and array is QUAD:
            array, extra = meshopt.encode_filter_exp(array, 15), {"filter": "EXPONENTIAL"}
        packed = meshopt.encode_gltf_buffer(array, mode)
        stride = array[0].nbytes
        extension = {
            "buffer": 1, "byteOffset": len(data), "byteLength": len(packed), "byteStride": stride,
            "count": len(array), "mode": mode, **extra, **changes,
        }  # fmt: skip
        views.append({**plain, "extensions": {"EXT_meshopt_compression": extension}})
        data += packed + b"\0" * (-len(packed) % 4)
    absent = {"EXT_meshopt_compression": {"fallback": True}}
    fallback = {"byteLength": len(builder.data), "extensions": absent}
    path.parent.mkdir(parents=True, exist_ok=True)
    (path.parent / "panel.bin").write_bytes(data)
    document = {
        **{key: value for key, value in builder.json.items() if value != []},
        "bufferViews": views,
        "buffers": [fallback, {"byteLength": len(data), "uri": "panel.bin"}],
        "extensionsRequired": ["EXT_meshopt_compression"],
    }
    path.write_text(json.dumps(document))
    return path


def mesh_of(package: Any) -> Any:
    (part,) = package.asset.parts
    return decode_ply(package.read_bytes(part.mesh), part.mesh)


@pytest.mark.parametrize("filters", [False, True])
def test_a_meshopt_mesh_equals_the_plain_one(tmp_path: Path, filters: bool) -> None:
    _, plain = panel(tmp_path / "plain", Builder().quad().material())
    path = compressed(tmp_path / "source" / "panel.gltf", filters)
    (record,) = import_gltf(path, tmp_path / "library", LICENSED)
    found, expected = mesh_of(open_package(record.path)), mesh_of(plain)
    np.testing.assert_allclose(found.positions, expected.positions, atol=1e-4 if filters else 0)
    np.testing.assert_array_equal(found.faces, expected.faces)
    np.testing.assert_array_equal(found.uv, expected.uv)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": 1 << 40}, r"bufferViews\[0\].*bytes unpacked or substituted"),
        ({"byteStride": 0}, r"bufferViews\[0\] = count 4, byteStride 0; expected a stride of 1 to 256"),
        ({"mode": "ELSE"}, r"bufferViews\[0\] = mode must be ATTRIBUTES"),
        ({"byteLength": 9}, r"bufferViews\[0\] = .*; expected intact data of EXT_meshopt_compression"),
        ({"mode": None}, r"bufferViews\[0\]"),
    ],
)
def test_damaged_meshopt_is_refused_by_name(tmp_path: Path, changes: dict, message: str) -> None:
    path = compressed(tmp_path / "panel.gltf", **changes)
    with pytest.raises(InputError, match=message):
        import_gltf(path, tmp_path / "library", LICENSED)


def picture(alpha: bool = False) -> np.ndarray:
    """Return an image (64, 64, 3 or 4) of 4 x 4 uniform patches, which block compression hardly changes."""
    colors = np.random.default_rng(3).integers(40, 220, (4, 4, 4 if alpha else 3)).astype(np.uint8)
    return colors.repeat(16, axis=0).repeat(16, axis=1)


def ktx2(pixels: np.ndarray, codec: str) -> bytes:
    return alktx2.encode_bytes_to_ktx2(encode_png(pixels), mime="image/png", codec=codec, quality=100)


def textured(image: dict[str, Any]) -> Builder:
    builder = Builder().quad()
    builder.json["images"].append(image)
    builder.json["textures"].append({"extensions": {"KHR_texture_basisu": {"source": 0}}})
    builder.json["extensionsRequired"] = ["KHR_texture_basisu"]
    return builder.material(pbrMetallicRoughness={"baseColorTexture": {"index": 0}, "metallicFactor": 0})


@pytest.mark.parametrize("codec", ["etc1s", "uastc"])
@pytest.mark.parametrize("embedded", [True, False])
def test_a_basis_texture_is_decoded(tmp_path: Path, codec: str, embedded: bool) -> None:
    pixels = picture()
    content = ktx2(pixels, codec)
    if embedded:
        builder = textured({"mimeType": "image/ktx2", "bufferView": 3})
        builder.data += b"\0" * (-len(builder.data) % 4)
        view = {"buffer": 0, "byteOffset": len(builder.data), "byteLength": len(content)}
        builder.json["bufferViews"].append(view)
        builder.data += content
    else:
        builder = textured({"uri": "wall.ktx2"})
        (tmp_path / "source").mkdir()
        (tmp_path / "source" / "wall.ktx2").write_bytes(content)
    _, package = panel(tmp_path, builder)
    (material,) = package.asset.materials.values()
    stored = package.read_bytes(material.diffuse_albedo.texture)
    found = np.array(Image.open(io.BytesIO(stored)).convert("RGB"))
    assert np.abs(found.astype(int) - pixels).mean() < 6 and found.shape == pixels.shape


def test_alpha_of_a_basis_texture_is_kept(tmp_path: Path) -> None:
    pixels = picture(alpha=True)
    (tmp_path / "leaf.png").write_bytes(png_of_basis(ktx2(pixels, "uastc"), Budget(tmp_path), tmp_path, "x"))
    assert np.abs(read_image(tmp_path / "leaf.png").astype(int) - pixels).mean() < 6


@pytest.mark.parametrize("damage", ["cut", "header", "other"])
def test_a_damaged_basis_texture_is_refused_by_name(tmp_path: Path, damage: str) -> None:
    content = ktx2(picture(), "etc1s")
    content = {"cut": content[:300], "header": content[:12] + bytes(200), "other": content[:20]}[damage]
    (tmp_path / "source").mkdir()
    (tmp_path / "source" / "wall.ktx2").write_bytes(content)
    with pytest.raises(InputError, match=r"images\[0\] = .*expected an intact KTX 2 file of Basis Universal"):
        panel(tmp_path, textured({"uri": "wall.ktx2"}))


def test_an_absent_basis_texture_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'wall.ktx2' \(no such file\)"):
        panel(tmp_path, textured({"uri": "wall.ktx2"}))


def test_a_basis_texture_has_to_fit_the_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCENE_MATERIALS_LIMITS", "pixels=1")
    (tmp_path / "source").mkdir()
    flat = ktx2(np.full((512, 512, 3), 90, np.uint8), "etc1s")
    (tmp_path / "source" / "wall.ktx2").write_bytes(flat)
    with pytest.raises(InputError, match=r"pixels decoded"):
        panel(tmp_path, textured({"uri": "wall.ktx2"}))


def test_basis_textures_are_charged_once_each(tmp_path: Path) -> None:
    builder = textured({"uri": "wall.ktx2"})
    builder.json["images"].append({"uri": "floor.ktx2"})
    for k, name in enumerate(("wall", "floor")):
        flat = ktx2(np.full((512, 512, 3), 90 + k, np.uint8), "etc1s")
        (tmp_path / f"{name}.ktx2").write_bytes(flat)
    path = builder.write(tmp_path / "panel.gltf")
    with GltfFile(path, Budget(path, Limits(pixels=300_000))) as file:
        assert file.image_file(0, "first") == file.image_file(0, "second")
        with pytest.raises(InputError, match=r"images\[1\]: pixels = 524288 or more"):
            file.image_file(1, "third")

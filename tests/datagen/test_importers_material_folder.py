# SPDX-License-Identifier: MIT
"""PBR texture folders as material packages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.formats.asset import MaterialAsset, Texture
from datagen.formats.package import open_package
from datagen.formats.textures import texture_values
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png, read_image
from datagen.importers.channels import encode_exr
from datagen.importers.classes import guess_category, guess_class
from datagen.importers.common import ImportOptions
from datagen.importers.dispatch import import_asset
from datagen.importers.material_folder import import_material_folder, role_of
from datagen.importers.pbr import green_points_up
from datagen.importers.watch import ImportWatch

LICENSED = ImportOptions(license="CC0-1.0")


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("Wood051_1K_Color.jpg", "color"),
        ("Wood051_2K-PNG_NormalGL.png", "normal_gl"),
        ("Wood051_1K-JPG_NormalDX.jpg", "normal_dx"),
        ("Metal007_1K_Metalness.jpg", "metalness"),
        ("Tiles036_1K_AmbientOcclusion.jpg", "occlusion"),
        ("oak_veneer_01_diff_1k.jpg", "color"),
        ("oak_veneer_01_nor_gl_4k.exr", "normal_gl"),
        ("oak_veneer_01_nor_dx_1k.png", "normal_dx"),
        ("oak_veneer_01_arm_1k.jpg", "arm"),
        ("oak_veneer_01_rough_1k.jpg", "roughness"),
        ("oak_veneer_01_disp_1k.png", "displacement"),
        ("thumbnail.jpg", ""),
        ("color.png", "color"),
    ],
)
def test_names_determine_the_channel_of_an_image(name: str, role: str) -> None:
    assert role_of(name) == role


def bumps(side: int = 64, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a tiling height map (side, side, 1) and its OpenGL normal map (side, side, 3) as uint8."""
    rng = np.random.default_rng(seed)
    spectrum = rng.normal(size=(side, side)) + 1j * rng.normal(size=(side, side))
    k = np.fft.fftfreq(side) * side
    spectrum[np.hypot(*np.meshgrid(k, k)) > 8] = 0
    height = np.fft.ifft2(spectrum).real
    height /= np.abs(height).max()
    du = (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)) * 2
    dv = (np.roll(height, 1, axis=0) - np.roll(height, -1, axis=0)) * 2
    normal = np.stack([-du, -dv, np.ones_like(du)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    grey = np.round((height * 0.5 + 0.5) * 255).astype(np.uint8)
    return grey[..., None], np.round((normal * 0.5 + 0.5) * 255).astype(np.uint8)


@pytest.mark.parametrize("seed", range(4))
def test_orientation_of_normal_maps_is_detected_from_pixels(seed: int) -> None:
    height, up = bumps(seed=seed)
    down = up.copy()
    down[..., 1] = 255 - down[..., 1]
    assert green_points_up(up)
    assert not green_points_up(down)
    assert green_points_up(up, height)
    assert not green_points_up(down, height)


def write_folder(folder: Path, normal: str = "NormalGL") -> Path:
    folder.mkdir()
    rng = np.random.default_rng(1)
    color = rng.integers(0, 255, (64, 64, 3)).astype(np.uint8)
    (folder / "Oak_1K_Color.png").write_bytes(encode_png(color))
    (folder / "Oak_1K_Roughness.png").write_bytes(encode_png(color[..., :1]))
    (folder / f"Oak_1K_{normal}.png").write_bytes(encode_png(bumps()[1]))
    return folder


def test_a_dielectric_folder_is_copied_unchanged(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "oak-planks")
    record = import_material_folder(
        folder, tmp_path / "library", ImportOptions(license="CC0-1.0", tile_size_m=1.5)
    )
    package = open_package(record.path)
    asset = package.asset
    assert isinstance(asset, MaterialAsset)
    material = asset.material
    assert material.classes == ("wood",)
    assert material.tile_size_m == 1.5
    assert material.specular_albedo == (0.04, 0.04, 0.04)
    assert isinstance(material.diffuse_albedo, Texture)
    assert isinstance(material.roughness, Texture)
    assert (material.roughness.encoding, material.roughness.channel) == ("linear", "r")
    assert package.read_bytes(material.diffuse_albedo.texture) == (folder / "Oak_1K_Color.png").read_bytes()


@pytest.mark.parametrize("name", ["NormalDX", "Normal"])
def test_directx_normals_are_flipped(tmp_path: Path, name: str) -> None:
    folder = write_folder(tmp_path / "oak", name)
    up = bumps()[1]
    down = up.copy()
    down[..., 1] = 255 - down[..., 1]
    (folder / f"Oak_1K_{name}.png").write_bytes(encode_png(down))
    record = import_material_folder(folder, tmp_path / "library", LICENSED)
    asset = open_package(record.path).asset
    assert isinstance(asset, MaterialAsset)
    assert asset.material.normal is not None
    np.testing.assert_array_equal(read_image(record.path / asset.material.normal.texture), up)


def test_directx_normals_in_an_exr_are_flipped(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "oak")
    (folder / "Oak_1K_NormalGL.png").unlink()
    up = (bumps()[1] / 255).astype(np.float32)
    (folder / "Oak_1K_NormalDX.exr").write_bytes(encode_exr(up * [1, -1, 1] + [0, 1, 0]))
    record = import_material_folder(folder, tmp_path / "library", LICENSED)
    asset = open_package(record.path).asset
    assert isinstance(asset, MaterialAsset)
    assert asset.material.normal is not None
    found = read_image(record.path / asset.material.normal.texture)
    np.testing.assert_allclose(found, up, atol=1e-3)


def test_real_folders_are_imported(tmp_path: Path, shared_data: Path) -> None:
    textures = shared_data / "textures" / "ambientcg"
    gold = import_material_folder(textures / "gold", tmp_path)
    asset = open_package(gold.path).asset
    assert isinstance(asset, MaterialAsset)
    assert asset.provenance.license == "CC0-1.0"
    assert asset.material.classes == ("metal",)
    for channel, low, high in (("diffuse_albedo", 0.0, 0.02), ("specular_albedo", 0.2, 1.0)):
        texture = getattr(asset.material, channel)
        values = texture_values(texture, read_image(gold.path / texture.texture), is_scalar=False)
        assert low <= values.mean() < high
    tiles = import_material_folder(textures / "tiles", tmp_path)
    assert open_package(tiles.path).asset.material.classes == ("ceramic",)  # type: ignore[union-attr]
    assert any("DirectX" in note for note in tiles.notes)


def test_bad_folders_are_refused(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "oak")
    with pytest.raises(InputError, match="--license"):
        import_material_folder(folder, tmp_path / "library")
    (folder / "Oak_2K_Color.png").write_bytes((folder / "Oak_1K_Color.png").read_bytes())
    with pytest.raises(InputError, match=r"Oak_1K_Color\.png, Oak_2K_Color\.png"):
        import_material_folder(folder, tmp_path / "library", LICENSED)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="a colour map"):
        import_material_folder(tmp_path / "empty", tmp_path / "library", LICENSED)


def test_names_determine_classes_and_categories() -> None:
    assert guess_class("WoodFloor") == "wood"
    assert guess_class("FloorTiles") == "ceramic"
    assert guess_class("StainlessSteel") == "metal"
    assert guess_class("painted_wooden_stool") == "painted"
    assert guess_class("Mesh042", "sofa_03") == "fabric"
    assert guess_class("Xyz") == "other"
    assert guess_category("tea_set_01_cup_small_01") == "crockery"
    assert guess_category("wooden_bookshelf_worn") == "shelf"
    assert guess_category("thing") == ""


def test_records_follow_the_bar_of_an_import(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On terminals, a progress bar is shown and the lines about imported assets are printed after it."""
    folder = tmp_path / "Oak001"
    folder.mkdir()
    for role, channels in (("Color", 3), ("Roughness", 1)):
        pixels = np.full((8, 8, channels), 90, np.uint8)
        (folder / f"Oak001_1K_{role}.png").write_bytes(encode_png(pixels))
    for is_terminal in (False, True):
        monkeypatch.setattr("sys.stderr.isatty", lambda shown=is_terminal: shown)
        with ImportWatch() as watch:
            import_asset(folder, tmp_path / str(is_terminal), LICENSED, watch=watch)
            assert ("material oak001" in capsys.readouterr().out) != is_terminal
        assert ("material oak001" in capsys.readouterr().out) == is_terminal

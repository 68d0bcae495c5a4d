# SPDX-License-Identifier: MIT
"""File formats: EXR views, shards, strict models, canonical bytes, readable errors."""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.assembly.plan import configuration_id
from datagen.formats.asset import Box, SlotMaterial, Texture
from datagen.formats.base import canonical_json, parse_model, read_json, read_yaml, write_bytes_atomically
from datagen.formats.recipe import Recipe
from datagen.formats.shard import ShardReader, write_shard
from datagen.foundation.buffers import (
    BUFFERS,
    LIGHT_BUFFERS,
    MATERIAL_MAPS,
    MIRROR_ROUGHNESS,
    RENDERED_BUFFERS,
    VIEW_BUFFERS,
    get_buffer,
    split_channels,
)
from datagen.foundation.errors import InputError
from datagen.foundation.exr import decode_view, encode_view, to_storage
from datagen.foundation.images import read_image
from tests.conftest import REPOSITORY
from tests.datagen.small_dataset import make_buffers, make_configuration, make_view_files


@pytest.mark.parametrize("compression", ["none", "rle", "zips", "zip", "piz"])
def test_exr_round_trip_is_exact(compression: str) -> None:
    buffers = make_buffers(24, 40, seed=3)
    decoded = decode_view(encode_view(buffers, compression))
    assert set(decoded) == set(VIEW_BUFFERS)
    for name, array in decoded.items():
        assert array.dtype == BUFFERS[name].dtype
        np.testing.assert_array_equal(array, to_storage(BUFFERS[name], buffers[name]), err_msg=name)


def test_exr_bytes_depend_on_content_alone() -> None:
    buffers = make_buffers(24, 40, seed=3)
    shuffled = {name: array.copy() for name, array in reversed(list(buffers.items()))}
    assert encode_view(buffers) == encode_view(shuffled)
    buffers["roughness"][0, 0] += 0.25
    assert encode_view(buffers) != encode_view(shuffled)


def test_exr_layers_are_named_for_any_viewer(tmp_path: Path) -> None:
    import OpenEXR

    path = tmp_path / "view.exr"
    path.write_bytes(encode_view(make_buffers(8, 8, seed=0)))
    with OpenEXR.File(str(path), separate_channels=True) as file:
        names = set(file.channels())
    assert {"R", "G", "B", "diffuse_albedo.R", "normal_world.X", "depth_z_m.Z", "instance_id.I"} <= names


def test_exr_images_are_never_read_as_their_alpha(tmp_path: Path) -> None:
    import OpenEXR

    def read(*names: str) -> list[float]:
        planes = {name: np.full((2, 3), float(name[-1] == "A"), np.float32) for name in names}
        with OpenEXR.File({"type": OpenEXR.scanlineimage}, planes) as file:
            file.write(str(tmp_path / "image.exr"))
        return read_image(tmp_path / "image.exr")[0, 0].tolist()

    assert read("Y", "A") == [0, 1] and read(*"RGBA") == [0, 0, 0, 1] and read("V") == [0]
    with pytest.raises(InputError, match=r"channels = Layer\.A, Layer\.R; expected R, G and B, or Y"):
        read("Layer.R", "Layer.A")


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_exr_is_refused_or_decoded(data: st.DataObject) -> None:
    """A truncated file or one with a changed byte gives an InputError or arrays of the right shape."""
    good = encode_view(make_buffers(16, 16, seed=1))
    if data.draw(st.booleans()):
        bad = good[: data.draw(st.integers(0, len(good) - 1))]
    else:
        position = data.draw(st.integers(0, len(good) - 1))
        flip = data.draw(st.integers(1, 255))
        bad = good[:position] + bytes([good[position] ^ flip]) + good[position + 1 :]
    try:
        decoded = decode_view(bad)
    except InputError:
        return
    for name, array in decoded.items():
        assert array.ndim == 3 and array.shape[2] == BUFFERS[name].num_channels


def test_missing_buffer_is_named() -> None:
    data = encode_view({"roughness": np.zeros((4, 4, 1), np.float32)})
    with pytest.raises(InputError, match=r"diffuse_albedo.*no channel diffuse_albedo\.R"):
        decode_view(data, ["roughness", "diffuse_albedo"])


def test_unknown_buffer_and_shape_are_refused() -> None:
    with pytest.raises(KeyError, match="known: beauty"):
        get_buffer("albedo")
    with pytest.raises(ValueError, match=r"expected \(H, W, 3\)"):
        encode_view({"diffuse_albedo": np.zeros((4, 4, 1), np.float32)})


def test_half_overflow_is_clipped_and_nan_kept_visible() -> None:
    array = np.full((2, 2, 3), 1e6, np.float32)
    array[0, 0] = np.nan
    stored = to_storage(BUFFERS["beauty"], array)
    assert stored[1, 1, 0] == np.float16(65504) and np.isnan(stored[0, 0, 0])


def test_shard_bytes_are_deterministic_and_read_back(tmp_path: Path) -> None:
    configuration = make_configuration(num_views=3)
    members = make_view_files(tmp_path, configuration)
    first, second = io.BytesIO(), io.BytesIO()
    write_shard(first, canonical_json(configuration), members)
    write_shard(second, canonical_json(configuration), members)
    assert first.getvalue() == second.getvalue()
    path = tmp_path / "shard.tar"
    path.write_bytes(first.getvalue())
    reader = ShardReader(path, ["beauty", "roughness"])
    views = list(reader)
    assert [view.record.name for view in views] == [c.name for c in configuration.cameras]
    assert set(views[0].buffers) == {"beauty", "roughness"}
    assert reader.configuration() == configuration
    with tarfile.open(path) as tar:
        assert all(m.mtime == 0 and m.uid == 0 and m.uname == "" for m in tar)


def test_truncated_shard_is_refused(tmp_path: Path) -> None:
    configuration = make_configuration(num_views=2)
    path = tmp_path / "shard.tar"
    stream = io.BytesIO()
    write_shard(stream, canonical_json(configuration), make_view_files(tmp_path, configuration))
    path.write_bytes(stream.getvalue()[: len(stream.getvalue()) // 2])
    with pytest.raises(InputError, match=r"shard\.tar"):
        list(ShardReader(path))


def test_every_problem_of_a_file_is_reported_at_once() -> None:
    bad = {
        "roughness": 1.4,
        "classes": ["wood"],
        "colour": 1,
        "normal": {"texture": "/etc/x", "encoding": "srgb"},
    }
    with pytest.raises(InputError) as caught:
        parse_model(SlotMaterial, bad, "kitchen/asset.json")
    text = str(caught.value)
    for field in ("roughness", "colour", "normal.texture"):
        assert f"kitchen/asset.json: {field}" in text


def test_paths_with_backslashes_are_those_of_any_system() -> None:
    assert parse_model(Texture, {"texture": "maps\\d.png", "encoding": "srgb"}, "").texture == "maps/d.png"


def test_shards_can_contain_configurations_with_the_longest_name(tmp_path: Path) -> None:
    recipe = Recipe(name="n" * 147, configurations=10_000_000, views=1)
    member = f"{configuration_id(recipe, recipe.configurations - 1)}/view-0000.exr"
    (tmp_path / "view.exr").touch()
    write_shard(io.BytesIO(), b"{}", [(member, tmp_path / "view.exr")])
    with pytest.raises(ValueError, match="at most 147 characters"):
        Recipe(name="n" * 148, configurations=1, views=1)


@pytest.mark.parametrize(
    "path", ["/etc/passwd", "../up.png", "a/../../b.png", "C:/x.png", "a\\..\\..\\b", ""]
)
def test_paths_that_leave_the_package_are_refused(path: str) -> None:
    with pytest.raises(InputError, match="relative path"):
        parse_model(Texture, {"texture": path, "encoding": "srgb"}, "asset.json")


def test_box_must_be_ordered() -> None:
    with pytest.raises(InputError, match="minimum_m < maximum_m"):
        parse_model(Box, {"minimum_m": [0, 0, 0], "maximum_m": [1, 0, 1]}, "asset.json")


def test_nan_is_refused_in_files(tmp_path: Path) -> None:
    path = tmp_path / "material.json"
    path.write_text('{"roughness": NaN}')
    with pytest.raises(InputError, match="roughness"):
        read_json(SlotMaterial, path)


@pytest.mark.parametrize("name", sorted(p.stem for p in (REPOSITORY / "scenes" / "recipes").glob("*.yaml")))
def test_bundled_recipes_are_valid(name: str) -> None:
    recipe = read_yaml(Recipe, REPOSITORY / "scenes" / "recipes" / f"{name}.yaml")
    assert recipe.name == name
    if name == "paper":
        assert recipe.configurations * recipe.views == 6400 and recipe.resolution == (640, 384)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vews": 4}, "vews.*no such key"),
        ({"views": 0}, "views = 0"),
        ({"objects": {"count": [9, 2]}}, "low <= high"),
        ({"splits": {"train": 0.5}}, "train \\+ validation \\+ test = 1"),
        ({"resolution": [640]}, "resolution"),
        ({"cameras": {"fov_x_deg": [50, 200]}}, r"cameras.fov_x_deg\[1\] = 200; expected less than 180"),
    ],
)
def test_bad_recipes_name_field_and_remedy(change: dict, message: str, tmp_path: Path) -> None:
    good = {"name": "x", "configurations": 1, "views": 1}
    path = tmp_path / "recipe.yaml"
    path.write_text(json.dumps({**good, **change}))
    with pytest.raises(InputError, match=message):
        read_yaml(Recipe, path)


def test_unreadable_files_are_reported_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_yaml(Recipe, tmp_path / "absent.yaml")
    broken = tmp_path / "broken.yaml"
    broken.write_text("a: [1")
    with pytest.raises(InputError, match="valid YAML"):
        read_yaml(Recipe, broken)
    broken.write_text("name: 2026-11-31\nconfigurations: 1\nviews: 1\n")
    with pytest.raises(InputError, match="day is out of range for month; expected valid YAML"):
        read_yaml(Recipe, broken)
    binary = tmp_path / "binary.json"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="UTF-8"):
        read_json(Recipe, binary)


def test_failed_atomic_write_leaves_no_files(tmp_path: Path) -> None:
    target = tmp_path / "folder"
    target.mkdir()
    (target / "inside").write_text("x")
    with pytest.raises(OSError):
        write_bytes_atomically(target, b"data")  # a non-empty folder cannot be replaced
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_each_buffer_has_a_stage() -> None:
    """The order of a stage's buffers determines the bytes of an EXR file; optional buffers are not listed."""
    truth = ("normal_world", "depth_z_m", "surface_mask", "instance_id", "material_id")
    assert ("beauty", *MATERIAL_MAPS, *truth) == RENDERED_BUFFERS
    assert VIEW_BUFFERS[len(RENDERED_BUFFERS) :] == (
        "color_min", "color_median", "color_max", "observation_count",
    )  # fmt: skip
    assert set(BUFFERS) - set(VIEW_BUFFERS) == {"beauty_noisy", *LIGHT_BUFFERS}
    assert LIGHT_BUFFERS == ("reflectance", "known_share", "mirror_sharp", "mirror_broad")
    assert set(MIRROR_ROUGHNESS) < set(LIGHT_BUFFERS)
    assert [BUFFERS[name].num_channels for name in MATERIAL_MAPS] == [3, 3, 1]


def test_channels_are_split_by_the_registry() -> None:
    values = np.arange(14).reshape(2, 7)
    parts = split_channels(values, MATERIAL_MAPS)
    assert list(parts) == list(MATERIAL_MAPS)
    np.testing.assert_array_equal(np.concatenate(list(parts.values()), axis=1), values)
    assert parts["roughness"].tolist() == [[6], [13]] and np.shares_memory(parts["roughness"], values)
    with pytest.raises(AssertionError):
        split_channels(values[:, 1:], MATERIAL_MAPS)

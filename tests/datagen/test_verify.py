# SPDX-License-Identifier: MIT
"""Verification: a valid dataset passes, and each injected fault is found and named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from datagen.formats.base import canonical_json, sha256_file, sha256_hex
from datagen.formats.configuration import (
    ColorAdjustment,
    Configuration,
    MaterialAssignment,
    PlacedAsset,
    ViewCamera,
)
from datagen.formats.recipe import Recipe
from datagen.formats.shard import AssetRecord, DatasetIndex, ShardRecord, write_shard
from datagen.formats.view import RenderRecord, StatisticsRecord, ViewRecord
from datagen.foundation.buffers import BUFFERS, VIEW_BUFFERS
from datagen.foundation.color import exposure_for
from datagen.foundation.errors import InputError
from datagen.foundation.exr import encode_view, to_storage
from datagen.inspection.checks import check_fireflies, firefly_mask
from datagen.inspection.findings import CHECKS
from datagen.inspection.verify import expected_roughness, verify_command, verify_dataset
from datagen.multiview.statistics import StatisticsView, compute_statistics
from oracles.multiview_scenes import make_views

View = dict[str, np.ndarray]
SIZE = (128, 90)


@pytest.fixture(scope="module")
def sound_views(mitsuba_variant) -> list[tuple[ViewCamera, View]]:
    """Return complete views of boxes with exact geometry, plausible materials and computed statistics."""
    views = [view for index, view in enumerate(make_views((SIZE,), is_noise=False)) if index not in (4, 5)]
    rng = np.random.default_rng(3)
    inputs, complete = [], []
    for view in views:
        surface = view.depth_z_m > 0
        shade = 0.4 + 0.2 * np.sin(8 * view.depth_z_m) + rng.normal(0, 0.02, view.color.shape)
        inputs.append(
            StatisticsView(
                view.camera,
                np.where(surface, np.clip(view.color * shade, 0, 1), 0.2).astype(np.float16),
                view.depth_z_m,
                view.normal_world.astype(np.float16),
                surface.astype(np.float16),
                view.name,
            )
        )
    for view, statistics in zip(inputs, compute_statistics(inputs), strict=True):
        surface = view.surface_mask > 0
        rough = np.clip(0.5 + 0.3 * np.sin(20 * view.depth_z_m), 0, 1)
        buffers = {
            "beauty": view.color,
            "diffuse_albedo": np.where(surface, 0.6, 0) * np.ones(3),
            "specular_albedo": np.where(surface, 0.04, 0) * np.ones(3),
            "roughness": np.where(surface, rough, 0),
            "normal_world": view.normal_world,
            "depth_z_m": view.depth_z_m,
            "surface_mask": view.surface_mask,
            "instance_id": surface.astype(np.uint32),
            "material_id": surface.astype(np.uint32),
            **statistics,
        }
        stored = {name: to_storage(BUFFERS[name], buffers[name]) for name in VIEW_BUFFERS}
        complete.append((ViewCamera.from_camera(view.name, view.camera), stored))
    return complete


class Dataset:
    """A dataset folder of one shard; tests change its views before it is written, or its files afterwards."""

    def __init__(self, folder: Path, views: list[tuple[ViewCamera, View]]):
        self.folder = folder
        self.cameras = [camera for camera, _ in views]
        self.views = [{name: array.copy() for name, array in view.items()} for _, view in views]
        self.placed = PlacedAsset(name="environment", asset="room")
        self.drop: set[str] = set()
        self.change_record: Callable[[ViewRecord], ViewRecord] = lambda record: record

    @property
    def shard(self) -> Path:
        return self.folder / "shards" / "boxes-00000.tar"

    def configuration(self) -> Configuration:
        return Configuration(
            id="boxes-00000",
            index=0,
            seed=1,
            environment=self.placed,
            cameras=tuple(self.cameras),
            assets={"room": "0" * 64},
        )

    def record(self, index: int, data: bytes) -> ViewRecord:
        view = self.views[index]
        record = ViewRecord(
            configuration="boxes-00000",
            name=self.cameras[index].name,
            index=index,
            split="train",
            camera=self.cameras[index],
            exposure=exposure_for(np.nan_to_num(view["beauty"].astype(np.float32))),
            buffers=tuple(sorted(view)),
            instances={"1": "environment/wall"},
            materials={"1": "wood"},
            render=RenderRecord(
                variant="llvm_ad_rgb",
                seed=1,
                path_samples=1,
                auxiliary_samples=1,
                max_depth=2,
                russian_roulette_depth=5,
                denoiser="none",
            ),
            statistics=StatisticsRecord(
                num_views=len(self.views), best_views=12, visibility="depth", include_self=True
            ),
            versions={},
            exr_sha256=sha256_hex(data),
        )
        return self.change_record(record)

    def write(self) -> Path:
        """Write the shard and an index with its hash; return the folder."""
        self.shard.parent.mkdir(parents=True, exist_ok=True)
        source = self.folder / "source"
        source.mkdir(exist_ok=True)
        configuration = self.configuration()
        members = []
        for index, view in enumerate(self.views):
            data = encode_view(view)
            name = self.cameras[index].name
            for suffix, content in (("exr", data), ("json", canonical_json(self.record(index, data)))):
                (source / f"{name}.{suffix}").write_bytes(content)
                if f"{name}.{suffix}" not in self.drop:
                    members.append((f"{configuration.id}/{name}.{suffix}", source / f"{name}.{suffix}"))
        with self.shard.open("wb") as file:
            write_shard(file, canonical_json(configuration), members)
        self.write_index()
        return self.folder

    def write_index(self, **changes) -> None:
        record = ShardRecord(
            file="shards/boxes-00000.tar",
            sha256=sha256_file(self.shard),
            num_bytes=self.shard.stat().st_size,
            configuration="boxes-00000",
            split="train",
            num_views=len(self.views),
            seed=1,
            assets=("room",),
        )
        values = {
            "recipe": Recipe(name="boxes", configurations=1, views=len(self.views)),
            "versions": {},
            "variant": "llvm_ad_rgb",
            "num_configurations": 1,
            "num_views": len(self.views),
            "num_bytes": record.num_bytes,
            "is_complete": True,
            "splits": {"train": 1},
            "buffers": tuple(sorted(VIEW_BUFFERS)),
            "assets": {"room": AssetRecord(kind="environment", sha256="0" * 64, license="CC0-1.0")},
            "shards": (record,),
        }
        index = DatasetIndex(**{**values, **changes})
        (self.folder / "index.json").write_bytes(canonical_json(index))


@pytest.fixture
def dataset(tmp_path, sound_views) -> Dataset:
    return Dataset(tmp_path, sound_views)


def found(folder: Path, library=None) -> dict[str, list]:
    """Verify a dataset and return its faults by check, for checks that find any."""
    report = verify_dataset(folder, library)
    return {check: mine for check in CHECKS if (mine := [f for f in report.faults if f.check == check])}


def expect_only(folder: Path, check: str, text: str = "", where: str = "") -> None:
    """Assert that only ``check`` finds faults, one with ``text`` at ``where``, with exit code 1."""
    faults = found(folder)
    assert list(faults) == [check], faults
    assert any(text in fault.got and where in fault.where for fault in faults[check]), faults
    assert verify_dataset(folder).exit_code() == 1


def test_a_sound_dataset_passes(dataset):
    report = verify_dataset(dataset.write())
    assert report.faults == []
    assert report.exit_code(strict=True) == 0
    assert (report.num_shards, report.num_views) == (1, 7)
    for check in ("finite", "range", "normal", "firefly", "exposure", "statistics", "reprojection"):
        assert report.applied[check] == 7, check


# ---------------------------------------------------------------------- files


def test_missing_image(dataset):
    dataset.drop = {"view_01.exr"}
    expect_only(dataset.write(), "member", "without an image", "view_01")


def test_missing_record(dataset):
    dataset.drop = {"view_02.json"}
    expect_only(dataset.write(), "member", "no such view", "view_02")


def test_missing_view(dataset):
    dataset.drop = {"view_03.json", "view_03.exr"}
    expect_only(dataset.write(), "member", "no such view", "view_03")


def test_missing_shard(dataset):
    dataset.write()
    dataset.shard.unlink()
    expect_only(dataset.folder, "member", "no such file")


def test_cut_shard(dataset):
    dataset.write()
    data = dataset.shard.read_bytes()
    dataset.shard.write_bytes(data[: len(data) // 2])
    faults = found(dataset.folder)
    assert {"hash", "member"} <= faults.keys()


def test_flipped_bit_breaks_the_hashes(dataset):
    dataset.write()
    data = bytearray(dataset.shard.read_bytes())
    position = data.find(b"view_02.exr") + 512 + 4000
    data[position] ^= 0x10
    dataset.shard.write_bytes(bytes(data))
    faults = found(dataset.folder)
    assert any("as in the index" in fault.expected for fault in faults["hash"])
    assert any("view_02" in fault.where for fault in faults["hash"])


def test_corrupt_image_with_a_matching_hash(dataset, tmp_path):
    dataset.write()
    image = tmp_path / "source" / "view_01.exr"
    broken = image.read_bytes()[:2000]
    image.write_bytes(broken)
    record = json.loads((tmp_path / "source" / "view_01.json").read_text())
    record["exr_sha256"] = sha256_hex(broken)
    (tmp_path / "source" / "view_01.json").write_text(json.dumps(record))
    names = [f"{camera.name}.{suffix}" for camera in dataset.cameras for suffix in ("exr", "json")]
    members = [(f"boxes-00000/{name}", tmp_path / "source" / name) for name in names]
    with dataset.shard.open("wb") as file:
        write_shard(file, canonical_json(dataset.configuration()), members)
    dataset.write_index()
    expect_only(dataset.folder, "member", where="view_01")


def test_bad_json_and_stray_members(dataset, tmp_path):
    dataset.write()
    source = tmp_path / "source"
    (source / "view_00.json").write_text("{broken")
    (source / "notes.txt").write_text("hello")
    names = [f"{camera.name}.{suffix}" for camera in dataset.cameras for suffix in ("exr", "json")]
    members = [(f"boxes-00000/{name}", source / name) for name in [*names, "notes.txt"]]
    with dataset.shard.open("wb") as file:
        write_shard(file, canonical_json(dataset.configuration()), members)
    dataset.write_index()
    texts = [fault.got for fault in found(dataset.folder)["member"]]
    assert any("unknown kind" in text for text in texts)
    assert any("Expecting property name" in text for text in texts)


def test_camera_that_differs_from_the_configuration(dataset):
    def move(record: ViewRecord) -> ViewRecord:
        if record.name != "view_01":
            return record
        return record.model_copy(update={"camera": record.camera.model_copy(update={"cx_px": 41.0})})

    dataset.change_record = move
    faults = found(dataset.write())
    assert any("differs from the configuration" in fault.got for fault in faults["member"])


# ---------------------------------------------------------------------- index


def test_index_faults(dataset):
    dataset.write()
    dataset.write_index(num_views=40)
    expect_only(dataset.folder, "index", "num_views = 40")
    dataset.write_index()
    (dataset.shard.parent / "stray.tar").write_bytes(dataset.shard.read_bytes())
    dataset.write_index(is_complete=False, missing=("boxes-00001",))
    report = verify_dataset(dataset.folder)
    assert [fault.severity for fault in report.faults] == ["warning", "warning"]
    assert report.exit_code() == 0 and report.exit_code(strict=True) == 1
    dataset.folder.joinpath("index.json").unlink()
    report = verify_dataset(dataset.folder)
    assert [fault.check for fault in report.faults] == ["index"]
    assert report.num_shards == 2  # shards on disk are still checked


def test_index_path_that_leaves_the_dataset(dataset):
    dataset.write()
    index = json.loads((dataset.folder / "index.json").read_text())
    name = index["shards"][0]["file"]
    index["shards"][0]["file"] = "../boxes-00000.tar"
    (dataset.folder / "index.json").write_text(json.dumps(index))
    assert any("without '..'" in fault.expected for fault in found(dataset.folder)["index"])
    index["shards"][0]["file"] = name
    (dataset.folder / "index.json").write_text(json.dumps(index))
    outside = (dataset.folder / name).rename(dataset.folder.parent / "outside.tar")
    (dataset.folder / name).symlink_to(outside)
    assert any("inside the dataset" in fault.expected for fault in found(dataset.folder)["index"])


def test_split_leak(dataset):
    dataset.write()
    index = json.loads((dataset.folder / "index.json").read_text())
    index["recipe"]["splits"] = {"train": 0.5, "validation": 0, "test": 0.5, "disjoint": True}
    other = {**index["shards"][0], "split": "test"}
    index["shards"].append(other)
    for name in ("num_configurations", "num_views", "num_bytes"):
        index[name] *= 2
    (dataset.folder / "index.json").write_text(json.dumps(index))
    expect_only(dataset.folder, "split", "room")
    index["recipe"]["splits"]["disjoint"] = False
    (dataset.folder / "index.json").write_text(json.dumps(index))
    assert found(dataset.folder) == {}


# ---------------------------------------------------------------------- pixels


def test_missing_buffer(dataset):
    del dataset.views[2]["color_median"]
    expect_only(dataset.write(), "buffer", "color_median", "view_02")


def test_wrong_size(dataset):
    dataset.views[0] = {name: array[:-2] for name, array in dataset.views[0].items()}
    faults = found(dataset.write())
    assert list(faults) == ["buffer"]


@pytest.mark.parametrize(
    ("name", "value"),  # half floats never contain Inf: values are clipped when written
    [("beauty", np.nan), ("normal_world", np.nan), ("color_max", np.nan), ("depth_z_m", np.inf)],
)
def test_values_that_are_not_finite(dataset, name, value):
    dataset.views[1][name][5, 7] = value
    faults = found(dataset.write())
    assert [f"1 pixels of {name}" in fault.got for fault in faults["finite"]] == [True]
    assert "row 5, column 7" in faults["finite"][0].got


@pytest.mark.parametrize(
    ("name", "value"),
    [("diffuse_albedo", 1.05), ("specular_albedo", -0.05), ("roughness", 1.05), ("beauty", -0.5)],
)
def test_out_of_range(dataset, name, value):
    dataset.views[3][name][20:22, 10] = value
    faults = found(dataset.write())
    assert f"2 pixels of {name}" in faults["range"][0].got and "view_03" in faults["range"][0].where


def test_normals_that_are_not_unit(dataset):
    dataset.views[2]["normal_world"] = (dataset.views[2]["normal_world"] * 0.95).astype(np.float16)
    expect_only(dataset.write(), "normal", "length 0.95", "view_02")


def test_zero_normal_in_one_pixel_is_a_warning(dataset):
    row, column = np.argwhere(dataset.views[2]["surface_mask"][..., 0] > 0)[40]
    dataset.views[2]["normal_world"][row, column] = 0
    report = verify_dataset(dataset.write())
    assert [(fault.check, fault.severity) for fault in report.faults] == [("normal", "warning")]


def test_fireflies(dataset):
    view = dataset.views[0]
    solid = view["surface_mask"][..., 0].copy()
    solid[:6], solid[-6:], solid[:, :6], solid[:, -6:] = 0, 0, 0, 0
    rng = np.random.default_rng(1)
    candidates = [p for p in rng.permutation(np.argwhere(solid > 0)) if all(p % 6 == 0)]
    inside = [p for p in candidates if (solid[p[0] - 4 : p[0] + 5, p[1] - 4 : p[1] + 5] > 0).all()]
    for row, column in inside[:6]:
        view["beauty"][row, column] = 300
    faults = found(dataset.write())
    assert f"{len(inside[:6])} fireflies of luminance up to 300" in faults["firefly"][0].got
    assert faults["firefly"][0].severity == "error"
    assert int(firefly_mask(view).sum()) == len(inside[:6]) == 6


def test_highlights_and_lamps_are_not_fireflies():
    light = np.full((40, 40, 3), 0.1, np.float32)
    light[10:14, 10:14] = 50  # a highlight of sixteen pixels
    light[30, 30] = 500  # a lamp of one pixel
    mask = np.ones((40, 40, 1), np.float32)
    mask[30, 30] = 0
    assert not firefly_mask({"beauty": light, "surface_mask": mask}).any()
    mask[30, 30] = 1
    assert firefly_mask({"beauty": light, "surface_mask": mask}).sum() == 1


@pytest.mark.parametrize(
    "specular, roughness, count, severity",
    [
        (0.04, 0.8, 1, "warning"),
        (0.9, 0.35, 1, None),
        (0.04, 0.2, 1, None),
        (0.04, 0.8, 5, "error"),
        (0.9, 0.35, 5, "error"),
    ],
)
def test_few_bright_pixels_of_metal_or_gloss_are_highlights(specular, roughness, count, severity):
    light = np.full((40, 40, 3), 0.1, np.float32)
    light[5 : 5 + 6 * count : 6, 20] = 50
    view = {
        "beauty": light,
        "specular_albedo": np.full_like(light, specular),
        "roughness": np.full((40, 40, 1), roughness, np.float32),
    }
    assert int(firefly_mask(view).sum()) == count
    assert [fault.severity for fault in check_fireflies(view, "view")] == ([severity] if severity else [])


@pytest.mark.parametrize(
    ("factor", "offset", "text"),
    [(0, 0, "black"), (0, 0.5, "flat"), (40, 0, "overexposed"), (0, 70000, "overexposed")],
)
def test_empty_frames(dataset, factor, offset, text):
    view = dataset.views[1]
    beauty = np.minimum(view["beauty"].astype(np.float32) * factor + offset, 65504)
    if text == "overexposed" and offset:
        beauty[::2] = 1.0
    view["beauty"] = beauty.astype(np.float16)
    faults = found(dataset.write())
    assert [fault.got.split(":")[0] for fault in faults["exposure"]] == [text]
    assert "view_01" in faults["exposure"][0].where


# ---------------------------------------------------------------------- statistics


def test_statistics_out_of_order(dataset):
    view = dataset.views[0]
    view["color_median"][20, 30, 1] = view["color_max"][20, 30, 1] + np.float16(0.1)
    expect_only(dataset.write(), "statistics", "1 pixels out of order, first at row 20, column 30")


def test_count_of_zero_on_a_surface(dataset):
    view = dataset.views[3]
    row, column = np.argwhere(view["surface_mask"][..., 0] > 0)[100]
    view["observation_count"][row, column] = 0
    faults = found(dataset.write())
    assert any("of surface with count 0" in fault.got for fault in faults["statistics"])


def test_impossible_counts(dataset):
    view = dataset.views[3]
    background = np.argwhere(view["depth_z_m"][..., 0] == 0)[0]
    surface = np.argwhere(view["surface_mask"][..., 0] > 0)[0]
    view["observation_count"][tuple(background)] = 2
    view["observation_count"][tuple(surface)] = 9
    texts = " ".join(fault.got for fault in found(dataset.write())["statistics"])
    assert "of background with a count" in texts and "with a count over 7" in texts


def test_background_with_foreign_colors(dataset):
    view = dataset.views[3]
    row, column = np.argwhere(view["depth_z_m"][..., 0] == 0)[0]
    view["color_max"][row, column] += np.float16(0.5)
    expect_only(dataset.write(), "statistics", "differ from their own colour", "view_03")


# ---------------------------------------------------------------------- reprojection


@pytest.mark.parametrize(("scale", "text"), [(1.02, "surfaces differ"), (1.05, ""), (1.5, "no surface at")])
def test_wrong_depth(dataset, scale, text):
    dataset.views[2]["depth_z_m"] *= np.float32(scale)
    expect_only(dataset.write(), "reprojection", text, "view_02")


def test_camera_of_another_view(dataset):
    dataset.cameras[1] = dataset.cameras[2].model_copy(update={"name": dataset.cameras[1].name})
    expect_only(dataset.write(), "reprojection", where="view_01")


def test_slightly_moved_camera(dataset):
    matrix = np.array(dataset.cameras[0].world_from_camera)
    matrix[:3, 3] += [0.04, 0.03, 0.04]
    dataset.cameras[0] = dataset.cameras[0].model_copy(
        update={"world_from_camera": tuple(tuple(float(v) for v in row) for row in matrix)}
    )
    expect_only(dataset.write(), "reprojection", where="view_00")


# ---------------------------------------------------------------------- roughness


@pytest.fixture(scope="module")
def rough_library(tmp_path_factory):
    """Yield a library, its room, and the id of a wood with a roughness texture."""
    from datagen.formats.asset import Material, MaterialAsset, Texture
    from datagen.formats.package import write_package
    from datagen.foundation.images import encode_png
    from datagen.library import Library
    from tests.datagen import small_library

    root = tmp_path_factory.mktemp("library")
    small_library.write_small_library(root)
    pixels = np.linspace(80, 200, 64, dtype=np.uint8).reshape(8, 8)
    asset = MaterialAsset(
        id="grainy-wood",
        title="Grainy wood",
        provenance=small_library.CC0,
        material=Material(
            classes=("wood",), roughness=Texture(texture="rough.png", encoding="linear", channel="r")
        ),
    )
    write_package(root / "grainy-wood", asset, {"rough.png": encode_png(pixels)})
    with Library([root]) as library:
        yield library, library.select("environment")[0], "grainy-wood"


def assign(dataset: Dataset, rough_library, offset: float = 0.0) -> None:
    """Assign the textured material to every slot of the room, and name it in the views' records."""
    _, room, material = rough_library
    assignment = MaterialAssignment(asset=material, adjustment=ColorAdjustment(roughness_offset=offset))
    dataset.placed = PlacedAsset(
        name="environment", asset=room.id, materials={slot: assignment for slot in room.asset.materials}
    )
    dataset.change_record = lambda record: record.model_copy(update={"materials": {"1": f"{material}#2"}})


def test_roughness_that_varies_passes(dataset, rough_library):
    assign(dataset, rough_library)
    expected = expected_roughness(dataset.configuration(), rough_library[0])
    assert expected == {"grainy-wood": pytest.approx(120 / 255, rel=0.05)}
    report = verify_dataset(dataset.write(), rough_library[0])
    assert report.faults == [] and report.applied["roughness"] == 1


def test_constant_roughness_of_a_textured_material(dataset, rough_library):
    assign(dataset, rough_library)
    for view in dataset.views:
        view["roughness"][view["surface_mask"] > 0] = 0.5
    faults = found(dataset.write(), rough_library[0])
    assert list(faults) == ["roughness"]
    assert f"roughness of {rough_library[2]} is 0.5" in faults["roughness"][0].got


def test_saturated_roughness_may_be_constant(dataset, rough_library):
    assign(dataset, rough_library, offset=1.0)
    expected = expected_roughness(dataset.configuration(), rough_library[0])
    assert expected == {"grainy-wood": 0}
    for view in dataset.views:
        view["roughness"][view["surface_mask"] > 0] = 1.0
    assert found(dataset.write(), rough_library[0]) == {}


def test_without_a_library_the_report_names_skipped_checks(dataset):
    report = verify_dataset(dataset.write())
    assert report.applied["roughness"] == 0
    assert any("roughness was not checked" in note for note in report.notes)


# ---------------------------------------------------------------------- the command


def test_command_prints_a_table_and_json(dataset, capsys):
    folder = dataset.write()
    assert verify_command(folder) == 0
    printed = capsys.readouterr().out
    assert "reprojection" in printed and "0 errors, 0 warnings" in printed
    dataset.views[0]["diffuse_albedo"][3, 3] = 2
    dataset.write()
    assert verify_command(folder, as_json=True) == 1
    data = json.loads(capsys.readouterr().out)
    assert data["num_errors"] == 1 and data["faults"][0]["check"] == "range"
    assert set(data["applied"]) == set(CHECKS)


def test_a_single_shard_can_be_verified(dataset):
    dataset.write()
    report = verify_dataset(dataset.shard)
    assert report.faults == [] and report.num_views == 7


def test_workers_report_the_same_faults(dataset):
    dataset.views[2]["depth_z_m"] *= np.float32(1.05)
    dataset.write()
    (dataset.shard.parent / "other.tar").write_bytes(dataset.shard.read_bytes())
    (dataset.folder / "index.json").unlink()
    one, two = verify_dataset(dataset.folder), verify_dataset(dataset.folder, workers=2)
    assert one.to_json() == two.to_json() and one.num_shards == 2


def test_a_missing_dataset_is_refused(tmp_path):
    with pytest.raises(InputError, match="neither a folder nor"):
        verify_dataset(tmp_path / "nothing")

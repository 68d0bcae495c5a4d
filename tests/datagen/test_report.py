# SPDX-License-Identifier: MIT
"""Figures of a report agree with independent counts, its pixels with the shards; bad input is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from datagen.farm.collect import collect
from datagen.formats.base import canonical_json
from datagen.formats.lights import AreaLight, PointLight, SkyLight
from datagen.formats.shard import Dataset, DatasetIndex, ShardReader, ShardRecord, write_shard
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.errors import InputError
from datagen.foundation.exr import decode_view, encode_view
from datagen.inspection.commands import ReportOptions
from datagen.inspection.findings import Fault, Report
from datagen.inspection.report import summary
from datagen.inspection.report.figures import (
    NUM_COVERAGE_BINS,
    PIXEL_AXES,
    Axis,
    count_metal_and_gloss,
    count_view,
    hue_deg,
)
from datagen.inspection.report.gather import (
    NO_VIEW,
    GatherJob,
    gather_shard,
    light_intensity,
    options_of,
    source_views,
)
from datagen.inspection.report.predictions import parse_methods
from datagen.inspection.report.tiles import encode_tile, write_tile
from datagen.inspection.report.writing import (
    PAGE_FILES,
    choose_configurations,
    report_command,
    write_report,
)
from datagen.library import Library
from datagen.multiview.statistics import StatisticsView
from tests.datagen.report_tiles import decode_tile, read_tile
from tests.datagen.small_dataset import make_buffers, make_configuration, make_view_files
from tests.datagen.small_plan import plan_small
from tests.datagen.small_rendered import predict, rendered_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered_dataset(tmp_path_factory)


@pytest.fixture(scope="module")
def report(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a report that contains the pixels of all views; return its folder."""
    out = tmp_path_factory.mktemp("report") / "page"
    with Library([dataset.parent / "library"]) as library:
        result = write_report(dataset, out, ReportOptions(cost=2.0), library)
    assert result.num_views == result.num_pixel_views == 10
    return out


def read_script(path: Path, name: str) -> dict:
    text = path.read_text()
    assert text.startswith(f"REPORT.{name} = ") and text.endswith(";\n")
    return json.loads(text.removeprefix(f"REPORT.{name} = ").removesuffix(";\n"))


# ---------------------------------------------------------------------- tiles


@pytest.mark.parametrize(
    ("dtype", "word"),
    [(np.float16, "half"), (np.float32, "float"), (np.uint32, "uint"), (np.uint16, "ushort")],
)
@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 7, 3), (16, 3, 12)])
def test_tiles_keep_every_bit(dtype: type, word: str, shape: tuple[int, int, int], tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    array = np.frombuffer(rng.bytes(size), dtype).reshape(shape)  # includes NaN, Inf and denormals
    height, width, channels = shape
    assert decode_tile(encode_tile(array), word, width, height, channels).tobytes() == array.tobytes()
    write_tile(tmp_path / "tile.html", "a/b/c", array)
    assert read_tile(tmp_path / "tile.html").tobytes() == array.tobytes()


def test_smooth_pixels_compress_well() -> None:
    rows, columns = np.indices((96, 160))
    array = (np.float32(1.5) + 0.001 * (rows + columns)).astype(np.float16)[..., None]
    assert len(encode_tile(array)) < array.nbytes / 8


def test_a_file_that_is_no_tile_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.html").write_text("<p>REPORT</p>")
    with pytest.raises(InputError, match="not a tile"):
        read_tile(tmp_path / "x.html")


# ---------------------------------------------------------------------- counting


def make_view(seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = (20, 30)
    return {
        "diffuse_albedo": rng.random((*shape, 3)).astype(np.float16),
        "specular_albedo": rng.random((*shape, 3)).astype(np.float16),
        "roughness": rng.random((*shape, 1)).astype(np.float16),
        "depth_z_m": np.where(rng.random((*shape, 1)) < 0.2, 0, rng.uniform(0.05, 300, (*shape, 1))).astype(
            "f4"
        ),
        "observation_count": rng.integers(0, 13, (*shape, 1)).astype(np.float16),
        "surface_mask": rng.random((*shape, 1)).astype(np.float16),
    }


def test_counts_agree_with_a_loop() -> None:
    view = make_view()
    counts, coverage = count_view(view)
    expected = {name: np.zeros(len(axis.edges) - 1, int) for name, axis in PIXEL_AXES.items()}
    cells = np.zeros((NUM_COVERAGE_BINS, NUM_COVERAGE_BINS), int)
    for row in range(20):
        for column in range(30):
            at = {name: array[row, column].astype(float) for name, array in view.items()}
            if at["depth_z_m"][0] <= 0 or at["surface_mask"][0] < 0.5:
                continue
            red, green, blue = at["diffuse_albedo"]
            light = 0.212671 * red + 0.715160 * green + 0.072169 * blue
            values = {
                "diffuse_luminance": light,
                "diffuse_chroma": max(red, green, blue) - min(red, green, blue),
                "roughness": at["roughness"][0],
                "depth": at["depth_z_m"][0],
                "observation_count": at["observation_count"][0],
            }
            for name, value in values.items():
                edges = PIXEL_AXES[name].edges
                value = min(max(value, edges[0]), edges[-1])
                expected[name][min(np.searchsorted(edges, value, "right") - 1, len(edges) - 2)] += 1
            cells[min(int(values["roughness"] * 32), 31), min(int(light * 32), 31)] += 1
    for name in ("diffuse_luminance", "diffuse_chroma", "roughness", "depth", "observation_count"):
        np.testing.assert_array_equal(counts[name], expected[name], err_msg=name)
    np.testing.assert_array_equal(coverage, cells)
    assert counts["specular_luminance"].sum() == cells.sum()


def test_hue_is_in_degrees() -> None:
    colors = np.array(
        [[1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0.5, 1], [0.5, 0, 1], [1, 0, 0.5], [0.3, 0.3, 0.3]]
    )
    np.testing.assert_allclose(hue_deg(colors), [0, 60, 120, 210, 270, 330, np.nan])


def test_values_beyond_an_axis_count_in_its_last_bins() -> None:
    axis = Axis.linear("x", "1", 0, 1, 4)
    np.testing.assert_array_equal(axis.count([-5, 0.1, 0.3, 2, np.nan, np.inf]), [2, 1, 0, 2])
    assert Axis.whole("n", "views", 0, 24).count([0, 12, 12, 24, 30]).tolist()[12] == 2


def test_missing_regions_are_named() -> None:
    cells = np.ones((32, 32), int)
    cells[0:4, 8:16] = 0
    views = [{"surface_pixels": 60, "metal_pixels": 6, "gloss_pixels": 30}, {"surface_pixels": 40}]
    views[1] |= {"metal_pixels": 0, "gloss_pixels": 0}
    found = summary.coverage([{"coverage": cells.tolist(), "split": "train", "views": views}])
    assert (found["metal_share"], found["gloss_share"]) == (0.06, 0.3)
    assert found["lack_for_training"] == ""
    assert found["missing"] == ["R 0 to 0.125, luminance of D 0.25 to 0.5"]
    assert found["coarse_filled"] == 62 and found["filled_share"] == 1 - 32 / 1024


def test_lack_of_metal_and_gloss_refers_to_the_training_split() -> None:
    matt = {"surface_pixels": 100, "metal_pixels": 1, "gloss_pixels": 30}
    steel = {"surface_pixels": 100, "metal_pixels": 90, "gloss_pixels": 90}
    cells = np.ones((32, 32), int).tolist()

    def lack(*splits: str) -> str:
        shown = zip(splits, (matt, steel), strict=False)
        return summary.coverage([{"coverage": cells, "split": s, "views": [v]} for s, v in shown])[
            "lack_for_training"
        ]

    assert "S > 0.3 in 1.0%" in lack("train", "validation") and "R < 0.3" not in lack("train")
    assert lack("validation", "train") == lack("train", "train") == lack("test") == ""


def test_metal_and_gloss_are_counted() -> None:
    view = {
        "specular_albedo": np.full((4, 5, 3), 0.04, np.float16),
        "roughness": np.full((4, 5, 1), 0.5, np.float16),
        "surface_mask": np.ones((4, 5, 1), np.float16),
    }
    view["specular_albedo"][:2, :, 0] = 0.9  # copper: one channel is bright
    view["roughness"][:3] = 0.2
    view["surface_mask"][0] = 0  # a lamp
    assert count_metal_and_gloss(view) == {"surface_pixels": 15, "metal_pixels": 5, "gloss_pixels": 10}


def test_light_intensities_keep_their_units() -> None:
    point = PointLight(name="a", position_m=(0, 0, 0), intensity=(1.0, 1.0, 1.0))
    assert light_intensity(point) == {"type": "point", "unit": "W/sr", "value": pytest.approx(1.0)}
    edge = {"origin_m": (0, 0, 0), "edge_u_m": (1, 0, 0), "edge_v_m": (0, 1, 0)}
    area = AreaLight(name="b", radiance=(0.0, 2.0, 0.0), **edge)
    assert light_intensity(area)["value"] == pytest.approx(2 * 0.71516)
    assert light_intensity(SkyLight(name="c", sun_direction=(0, 0, 1), sky_scale=3.0))["value"] == 3.0


# ---------------------------------------------------------------------- findings and pixels


def test_findings_link_to_their_views() -> None:
    files = {"shards/room-00000-ab.tar": "room-00000", "shards/room-00001-cd.tar": "room-00001"}
    names = {"room-00000": {"view-000"}, "room-00001": {"view-000", "view-001"}}
    for where, expected in (
        ("shards/room-00001-cd.tar:room-00001/view-001", ("room-00001", "view-001")),
        ("shards/room-00001-cd.tar/view-001", ("room-00001", "view-001")),
        ("shards/room-00000-ab.tar:room-00000/view-000.exr", ("room-00000", "view-000")),
        ("shards/room-00000-ab.tar:__meta__/configuration.json", ("room-00000", "")),
        ("shards/room-00000-ab.tar", ("room-00000", "")),
        ("/data/index.json", ("", "")),
    ):
        assert summary.place_of(where, files, names) == expected, where


def test_worst_views_come_first(dataset: Path, report: Path) -> None:
    index = Dataset(dataset).index
    gathered = [json.loads(path.read_text()) for path in sorted((report / "gathered").glob("*.json"))]
    where = [f"{shard.file}:{shard.configuration}/view-00" for shard in index.shards]
    faults = [
        Fault("firefly", f"{where[0]}1", "3 fireflies", "none", "warning"),
        Fault("finite", f"{where[1]}2", "NaN", "none"),
        *[Fault("range", f"{where[1]}4", f"{k}", "less") for k in range(30)],
    ]
    found = summary.findings(Report("x", faults=faults), index, gathered)
    assert [(v["configuration"], v["view"], v["errors"], v["warnings"]) for v in found["views"]] == [
        ("small-00001", "view-004", 30, 0),
        ("small-00001", "view-002", 1, 0),
        ("small-00000", "view-001", 0, 1),
    ]
    assert len(found["views"][0]["faults"]) == summary.MAX_LISTED_FAULTS
    assert {strip["title"] for strip in found["stand_out"]} >= {"least surface"}


def with_splits(
    index: DatasetIndex, *splits: str, assets: list[tuple[str, ...]] | None = None
) -> DatasetIndex:
    shards = tuple(
        shard.model_copy(update={"split": split, "assets": assets[k] if assets else shard.assets})
        for k, (shard, split) in enumerate(zip(index.shards, splits, strict=True))
    )
    return index.model_copy(update={"shards": shards, "splits": dict.fromkeys(splits, 1)})


def test_leaks_between_splits_are_found(dataset: Path) -> None:
    index = Dataset(dataset).index
    assert summary.splits(index)["shared"] == []
    leaking = summary.splits(with_splits(index, "train", "test"))
    assert leaking["shared"] == [{"asset": "room-0", "kind": "environment", "splits": ["train", "test"]}]
    apart = with_splits(index, "train", "test", assets=[("room-0",), ("room-9",)])
    assert summary.splits(apart)["shared"] == []
    same = {**index.assets, "room-9": index.assets["room-0"]}
    copied = summary.splits(apart.model_copy(update={"assets": same}))
    assert [s["kind"] for s in copied["shared"]] == ["equal content"]


def test_pixels_are_written_for_the_most_relevant_views(dataset: Path) -> None:
    index = Dataset(dataset).index
    shard = index.shards[0]
    many = [shard.model_copy(update={"configuration": f"c-{k:03d}", "num_views": 40}) for k in range(160)]
    large = index.model_copy(update={"shards": tuple(many)})
    chosen = sorted(choose_configurations(large, 400))
    assert len(chosen) == 10
    gaps = np.diff([int(name[2:]) for name in chosen])
    assert gaps.max() <= 32  # spread over the whole dataset, not its beginning
    assert {"c-077", "c-003"} <= choose_configurations(large, 400, ["c-077", "", "c-003"])
    assert len(choose_configurations(large, None)) == 160
    assert choose_configurations(large, 39) == set()


# ---------------------------------------------------------------------- the folder


def test_report_contains_all_data_of_the_page(report: Path, dataset: Path) -> None:
    for name in PAGE_FILES:
        assert (report / name).stat().st_size > 500, name
    page = (report / "index.html").read_text()
    assert "http" not in page and all(f'"{name}"' in page for name in PAGE_FILES if name != "index.html")
    views = read_script(report / "data" / "views.js", "views")
    assert len(views["rows"]) == 10 and [c[0] for c in views["configurations"]] == [
        "small-00000",
        "small-00001",
    ]
    for shard in Dataset(dataset).index.shards:
        for record in ShardReader(dataset / shard.file).records():
            thumbnail = report / "thumbnails" / shard.configuration / f"{record.name}.jpg"
            assert thumbnail.read_bytes()[:2] == b"\xff\xd8"
    summed = read_script(report / "data" / "summary.js", "summary")
    assert summed["num_views"] == 10
    assert (
        summed["effort"]["cost"] == pytest.approx(2 * summed["effort"]["hours"])
        and summed["effort"]["hours"] > 0
    )
    figures = {figure["title"]: figure for figure in summed["distributions"]}
    assert sum(figures["Surface pixels clipped at a photographic exposure"]["counts"]) == 10
    assert sum(figures["Camera height (z)"]["counts"]) == 10
    assert sum(figures["Intensity of point lights"]["counts"]) == 2
    classes = dict(summed["assets"]["class_shares"])
    assert set(classes) == {"wood", "painted"} and sum(classes.values()) == pytest.approx(1)
    assert "steel" in summed["assets"]["never_used"]["assets of the library"]
    assert "metal" in summed["assets"]["never_used"]["material classes"]


def test_distributions_count_every_surface_pixel(report: Path, dataset: Path) -> None:
    summed = read_script(report / "data" / "summary.js", "summary")
    roughness = next(f for f in summed["distributions"] if f["title"] == "Roughness R")
    expected = np.zeros(64, int)
    for view in Dataset(dataset).views():
        mask = (view.buffers["depth_z_m"][..., 0] > 0) & (view.buffers["surface_mask"][..., 0] >= 0.5)
        expected += np.histogram(view.buffers["roughness"][..., 0][mask].astype(float), 64, (0, 1))[0]
    assert roughness["counts"] == expected.tolist() and expected.sum() > 10_000


def test_tiles_equal_the_shards(report: Path, dataset: Path) -> None:
    for view in Dataset(dataset).views():
        folder = report / "tiles" / view.record.configuration / view.record.name
        for name in ("beauty", "depth_z_m", "instance_id", "color_median", "normal_world"):
            assert read_tile(folder / f"{name}.html").tobytes() == view.buffers[name].tobytes(), name


def test_source_views_match_the_statistics(report: Path, dataset: Path) -> None:
    """Each pixel has as many source views as the statistics counted, including the view itself."""
    for view in Dataset(dataset).views():
        folder = report / "tiles" / view.record.configuration / view.record.name
        chosen = read_tile(folder / "sources.html")
        counts = (chosen != NO_VIEW).sum(axis=-1)
        np.testing.assert_array_equal(counts, view.buffers["observation_count"][..., 0])
        has_own = (chosen == view.record.index).any(axis=-1)
        np.testing.assert_array_equal(has_own, counts > 0)
    assert counts.max() > 1


def test_source_views_follow_the_options(dataset: Path) -> None:
    """Injected fault: with other options, the numbers of source views differ from the statistics."""
    views = list(ShardReader(dataset / Dataset(dataset).index.shards[0].file))
    inputs = [StatisticsView.from_buffers(v.record.camera.camera(), v.buffers) for v in views]
    record = views[0].record.statistics
    assert record is not None
    without = options_of(record.model_copy(update={"include_self": False}))
    chosen = next(source_views(inputs, without))
    assert not (chosen == 0).any()
    assert ((chosen != NO_VIEW).sum(axis=-1) != views[0].buffers["observation_count"][..., 0]).any()


def test_a_second_report_reuses_the_counts(report: Path, dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "page"
    shutil.copytree(report, out)
    tile = out / "tiles" / "small-00000" / "view-000" / "beauty.html"
    before = tile.stat().st_mtime_ns
    write_report(dataset, out, ReportOptions(check=False))
    assert tile.stat().st_mtime_ns == before
    assert read_script(out / "data" / "summary.js", "summary")["findings"]["is_checked"] is False
    kept = out / "gathered" / "small-00000.json"
    kept.write_text(kept.read_text()[:100])  # truncated, as after a crash
    write_report(dataset, out, ReportOptions(check=False))
    assert tile.stat().st_mtime_ns > before


def test_views_without_pixels_have_thumbnails_only(dataset: Path, tmp_path: Path) -> None:
    options = ReportOptions(pixels="5", sources=False, check=False)
    result = write_report(dataset, tmp_path / "page", options)
    assert result.num_pixel_views == 5
    assert [p.name for p in (tmp_path / "page" / "tiles").iterdir()] == ["small-00000"]
    assert len(list((tmp_path / "page" / "thumbnails").glob("*/*.jpg"))) == 10
    assert not list((tmp_path / "page" / "tiles").glob("*/*/sources.html"))


def test_files_of_an_earlier_report_do_not_stay(report: Path, dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "page"
    shutil.copytree(report, out)
    tiles = out / "tiles"
    assert (tiles / "small-00001").is_dir() and list(tiles.glob("*/**/sources.*"))
    shutil.copytree(out / "thumbnails" / "small-00000", out / "thumbnails" / "removed-00007")
    (out / "gathered" / "removed-00007.json").write_text("{}")
    write_report(dataset, out, ReportOptions(pixels="5", sources=False, check=False))
    assert [path.name for path in tiles.iterdir()] == ["small-00000"]
    assert not list(tiles.glob("*/**/sources.*"))
    assert not list(out.glob("*/removed-00007*"))


def test_a_damaged_shard_is_named_and_omitted(dataset: Path, tmp_path: Path) -> None:
    copy = tmp_path / "dataset"
    shutil.copytree(dataset, copy)
    shard = copy / Dataset(copy).index.shards[0].file
    shard.write_bytes(shard.read_bytes()[:5000])
    result = write_report(copy, tmp_path / "page", ReportOptions(sources=False))
    summed = read_script(tmp_path / "page" / "data" / "summary.js", "summary")
    assert result.num_views == 5 and result.num_faults
    assert [file for file, _ in summed["unreadable"]] == [f"shards/{shard.name}"]
    assert summed["findings"]["views"][0]["configuration"] == "small-00000"


def _gather(folder: Path, buffers: dict[str, np.ndarray]) -> dict:
    """Write a shard with one view of ``buffers`` and return what a report gathers from it."""
    configuration = make_configuration(1)
    (image, path), *record = make_view_files(folder, configuration)
    path.write_bytes(encode_view(buffers))
    with (folder / "a.tar").open("wb") as file:
        write_shard(file, canonical_json(configuration), [(image, path), *record])
    fields = {"configuration": "small-00000", "split": "train", "num_views": 1, "seed": 1, "assets": ()}
    entry = ShardRecord(file="a.tar", sha256="0" * 64, num_bytes=1, **fields)
    return gather_shard(GatherJob(folder / "a.tar", entry, folder / "page", False, False))


def test_faulty_views_do_not_end_a_report(tmp_path: Path) -> None:
    buffers = make_buffers(24, 40, 0)
    buffers["observation_count"][:] = 4
    buffers["observation_count"][3, 4] = np.nan
    (view,) = _gather(tmp_path, buffers)["views"]
    assert view["mean_count"] == 4
    shutil.rmtree(tmp_path / "page")
    del buffers["roughness"]
    with pytest.raises(InputError, match="view-000: no roughness"):
        _gather(tmp_path, buffers)


def test_wrong_folders_and_options_are_refused(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("do not lose")
    with pytest.raises(InputError, match="other files"):
        write_report(dataset, tmp_path / "letters", ReportOptions())
    assert [p.name for p in (tmp_path / "letters").iterdir()] == ["dear.txt"]
    with pytest.raises(InputError, match="no such file"):
        write_report(tmp_path / "nothing", tmp_path / "page", ReportOptions())
    with pytest.raises(InputError, match="--pixels"):
        assert ReportOptions(pixels="many").max_pixel_views is None
    assert [ReportOptions(pixels=p).max_pixel_views for p in ("all", "12")] == [None, 12]


def test_a_dataset_without_shards_is_refused(tmp_path: Path) -> None:
    folder = plan_small(tmp_path / "dataset", tmp_path / "library", num_units=1, num_views=2)
    collect(folder.root)
    with pytest.raises(InputError, match="no shards"):
        write_report(folder.root, tmp_path / "page", ReportOptions())


def test_dry_run_writes_nothing(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert report_command(dataset, tmp_path / "page", ReportOptions(), is_dry_run=True) == 0
    assert "10 views; pixels of 10 views in 2 configurations" in capsys.readouterr().out
    assert not (tmp_path / "page").exists()


# ---------------------------------------------------------------------- predictions


@pytest.fixture(scope="module")
def compared(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Write a report on two methods, one with a missing and four invalid views; return all three folders."""
    root = tmp_path_factory.mktemp("predictions")
    good, bad = (predict(dataset, root / name, seed) for seed, name in enumerate(("good", "B & W")))
    places = {f"{v.record.configuration}/{v.record.name}": v for v in Dataset(dataset).views()}
    (bad / "small-00000" / "view-000.exr").unlink()
    (bad / "small-00000" / "view-001.exr").write_bytes(b"no picture")
    maps = {name: places["small-00000/view-002"].buffers[name].astype(np.float32) for name in MATERIAL_MAPS}
    del maps["roughness"]
    (bad / "small-00000" / "view-002.exr").write_bytes(encode_view(maps))
    maps = {name: places["small-00000/view-003"].buffers[name][:-8] for name in MATERIAL_MAPS}
    (bad / "small-00000" / "view-003.exr").write_bytes(encode_view(maps))
    maps = {name: places["small-00000/view-004"].buffers[name].copy() for name in MATERIAL_MAPS}
    maps["specular_albedo"][20, 20] = np.nan
    (bad / "small-00000" / "view-004.exr").write_bytes(encode_view(maps))
    # `materials infer` writes a folder views/ for each configuration
    (good / "small-00001" / "views").mkdir()
    for path in (good / "small-00001").glob("*.exr"):
        path.rename(path.parent / "views" / path.name)
    out = root / "page"
    options = ReportOptions(check=False, predictions=(good, bad), label=("ours",))
    result = write_report(dataset, out, options)
    assert result.predicted == {"ours": (10, 0), "B & W": (9, 4)}
    return out, good, bad


def test_prediction_errors_agree_with_another_count(compared: tuple[Path, Path, Path], dataset: Path) -> None:
    out, good, _ = compared
    table = read_script(out / "data" / "predictions.js", "predictions")
    sums, num = np.zeros(3), 0
    for row, view in enumerate(Dataset(dataset).views()):
        folder = good / view.record.configuration
        path = next(folder.rglob(f"{view.record.name}.exr"))
        predicted = decode_view(path)
        mask = (view.buffers["depth_z_m"][..., 0] > 0) & (view.buffers["surface_mask"][..., 0] >= 0.5)
        squares = [
            ((predicted[m].astype(float) - view.buffers[m].astype(float)) ** 2)[mask].mean(axis=-1)
            for m in MATERIAL_MAPS
        ]
        np.testing.assert_allclose(table["errors"]["ours"][row][:3], [s.mean() for s in squares], rtol=1e-5)
        assert table["errors"]["ours"][row][3] == 0b111
        sums += [s.sum() for s in squares]
        num += int(mask.sum())
    ours = table["methods"][0]
    assert ours["num_views"] == 10 and ours["num_missing"] == ours["num_problems"] == 0
    np.testing.assert_allclose([ours["total"][m] for m in MATERIAL_MAPS], sums / num, rtol=1e-6)
    assert sums.min() / num > 1e-4  # some pixels are compared


def test_wrong_predictions_are_named_and_the_others_shown(compared: tuple[Path, Path, Path]) -> None:
    out, _, _ = compared
    table = read_script(out / "data" / "predictions.js", "predictions")
    method, errors = table["methods"][1], table["errors"]["b-w"]
    assert method["missing"] == ["small-00000/view-000"] and errors[0] is None
    problems = {view: text for _, view, text in method["problems"]}
    assert sorted(problems) == ["view-001", "view-002", "view-003", "view-004"]
    assert problems["view-001"].startswith("the file:") and "intact EXR" in problems["view-001"]
    assert problems["view-002"].startswith("roughness: no channel roughness") and errors[2][3] == 0b011
    assert problems["view-003"] == "the file: 64 x 40 pixels; expected 64 x 48" and errors[3][3] == 0
    assert "1 surface pixels are NaN" in problems["view-004"]
    assert errors[4][1] is None and errors[4][0] == 0 and errors[4][3] == 0b111
    assert all(error is not None for error in errors[5:])
    tile = out / "tiles" / "predictions" / "b-w" / "small-00000" / "view-004" / "specular_albedo.html"
    assert np.isnan(read_tile(tile)[20, 20]).all()
    assert not (tile.parent.parent / "view-003").exists()


def test_methods_are_updated(compared: tuple[Path, Path, Path], dataset: Path, tmp_path: Path) -> None:
    out, good, _ = compared
    copy = tmp_path / "page"
    shutil.copytree(out, copy)
    tile = copy / "tiles" / "predictions" / "ours" / "small-00000" / "view-000" / "roughness.html"
    before = tile.stat().st_mtime_ns
    options = ReportOptions(check=False, predictions=(good,), label=("ours",))
    write_report(dataset, copy, options)
    assert tile.stat().st_mtime_ns == before  # unchanged predictions are not compared again
    assert [p.name for p in (copy / "tiles" / "predictions").iterdir()] == ["ours"]
    write_report(dataset, copy, ReportOptions(check=False))
    assert read_script(copy / "data" / "predictions.js", "predictions")["methods"] == []
    assert not tile.exists()


def test_a_single_result_of_infer_is_found_by_its_report(dataset: Path, tmp_path: Path) -> None:
    predict(dataset, tmp_path / "all", 0)
    (tmp_path / "all" / "small-00001").rename(tmp_path / "views")
    (tmp_path / "report.json").write_text('{"name": "small-00001"}')
    (method,) = parse_methods([tmp_path], [])
    assert method.label == tmp_path.name
    assert method.find("small-00001", "view-002") == tmp_path / "views" / "view-002.exr"
    assert method.find("small-00000", "view-002") is None and not method.covers("small-00000")


def test_options_for_predictions_are_checked(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name / "x").mkdir(parents=True)
    folders = [tmp_path / "a" / "x", tmp_path / "b" / "x"]
    with pytest.raises(InputError, match="a distinct name"):
        parse_methods(folders, [])
    assert [m.slug for m in parse_methods(folders, ["A+", "A-"])] == ["a", "a_2"]
    slugs = [m.slug for m in parse_methods([*folders, tmp_path], ["a_2", "a", "A"])]
    assert len(set(slugs)) == 3
    with pytest.raises(InputError) as caught:
        parse_methods([tmp_path / "none"], ["x", "y"])
    assert len(caught.value.problems) == 2

# SPDX-License-Identifier: MIT
"""Shards to batches: order, ranks and workers, crops and flips, and refusal of bad data."""

from __future__ import annotations

import multiprocessing
import os
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from datagen.formats.base import read_json
from datagen.formats.shard import DatasetIndex, ShardReader, index_shard
from datagen.foundation.errors import InputError
from model.networks import NetworkConfig
from model.training.config import DataConfig
from model.training.dataset import (
    BatchPlan,
    CropDataset,
    CropOrder,
    SharedViews,
    flip_sample,
    load_view,
    make_loader,
    view_sample,
)
from model.training.dataset import buffer_names as names_for
from model.training.sources import open_data, spread
from tests.model.training_data import make_dataset, make_shard

NETWORK = NetworkConfig(base_channels=2, global_channels=4)
NAMES = names_for(NETWORK)
CONFIG = DataConfig(crop_px=32, crops_per_view=3, block_views=4, workers=0)


@pytest.fixture(scope="module")
def shard(tmp_path_factory):
    return make_shard(tmp_path_factory.mktemp("data"), "room-00000", 4)


# --- order ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("views", "crops", "block"), [(10, 7, 4), (5, 1, 32), (1, 3, 1)])
def test_an_epoch_is_a_permutation_and_epochs_differ(views, crops, block):
    order = CropOrder(views, crops, block, seed=3)
    first = order.epoch(0)
    assert sorted(first) == list(range(views * crops))
    assert np.array_equal(first, order.epoch(0))
    if len(first) > 10:
        assert not np.array_equal(first, order.epoch(1))
        assert not np.array_equal(first, CropOrder(views, crops, block, seed=4).epoch(0))


def test_crops_of_a_view_stay_within_their_block():
    ids = CropOrder(12, 5, 4, seed=0).epoch(0)
    for start in range(0, 60, 20):
        assert len(set(ids[start : start + 20] // 5)) == 4


@pytest.mark.parametrize(("ranks", "batch", "accumulation"), [(1, 8, 1), (2, 4, 1), (4, 1, 2), (2, 2, 2)])
def test_ranks_share_each_step_without_overlap_or_loss(ranks, batch, accumulation):
    """The 8 crops of a step are the same for any split among ranks and micro-batches."""
    order = CropOrder(13, 3, 4, seed=1)
    plans = [list(BatchPlan(order, batch, accumulation, r, ranks, stop=9)) for r in range(ranks)]
    reference = list(BatchPlan(order, 8, stop=9))
    for step in range(9):
        micro = slice(step * accumulation, (step + 1) * accumulation)
        seen = [crop for plan in plans for part in plan[micro] for crop in part]
        assert sorted(seen) == sorted(reference[step])
    whole_epoch = [crop for part in reference[:4] for crop in part]
    assert len(set(whole_epoch)) == 32 and max(whole_epoch) < 39
    assert min(crop for part in reference[4:8] for crop in part) >= 39


def test_order_resumes_in_the_middle_of_an_epoch():
    order = CropOrder(13, 3, 4, seed=1)
    assert list(BatchPlan(order, 8, start=6, stop=9)) == list(BatchPlan(order, 8, stop=9))[6:]
    assert len(BatchPlan(order, 8, accumulation=2, start=6, stop=9)) == 6


def test_too_little_data_for_one_step_is_refused():
    with pytest.raises(InputError, match="at least 8"):
        BatchPlan(CropOrder(2, 3, 4, seed=1), 8)


# --- samples ----------------------------------------------------------------------------------------------


def test_a_view_agrees_with_the_shard_reader_and_the_camera(shard):
    place = index_shard(shard)[1]
    view = load_view(place, NAMES)
    expected = list(ShardReader(shard, NAMES))[1]
    assert view.record == expected.record
    sample = view_sample(view, 7)
    np.testing.assert_array_equal(
        sample["beauty"].permute(1, 2, 0).numpy(), expected.buffers["beauty"].astype(np.float32)
    )
    camera = expected.record.camera.camera()
    world = camera.unproject(camera.pixel_centers(), expected.buffers["depth_z_m"][..., 0])
    local = (world - camera.position_m) @ camera.world_from_camera[:3, :3]
    mask = sample["mask"][0].numpy()
    np.testing.assert_allclose(sample["position"].permute(1, 2, 0).numpy()[mask], local[mask], atol=1e-4)
    normal = camera.camera_from_world[:3, :3] @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(
        sample["normal_camera"].permute(1, 2, 0).numpy()[mask], np.tile(normal, (mask.sum(), 1)), atol=1e-3
    )
    facing = (sample["normal_camera"] * -sample["position"]).sum(dim=0)[sample["mask"][0]]
    assert (facing > 0).all()


def test_a_window_is_a_part_of_the_whole(shard):
    view = load_view(index_shard(shard)[0], NAMES)
    whole, part = view_sample(view, 0), view_sample(view, 0, (5, 9, 32, 40))
    for name, value in part.items():
        if value.dim() == 3:
            torch.testing.assert_close(value, whole[name][:, 5:37, 9:49])
    assert part["depth_max_m"] == whole["depth_max_m"]


def test_a_flip_is_the_mirror_image_of_the_scene(shard):
    """Points stay on their plane, normals remain valid, and projections move with the pixels."""
    sample = view_sample(load_view(index_shard(shard)[0], NAMES), 0)
    for horizontal, vertical in ((True, False), (False, True), (True, True)):
        flipped = flip_sample(dict(sample), horizontal=horizontal, vertical=vertical)
        mask = flipped["mask"][0]
        position, normal = (flipped[n][:, mask] for n in ("position", "normal_camera"))
        plane = (position * normal).sum(dim=0)
        assert plane.std() < 1e-3 * plane.abs().mean()
        assert (plane < 0).all()
        height, width = mask.shape
        u = position[0] / position[2] * 57.6 + 32  # fx = 0.9 * 64, cx = 32
        v = position[1] / position[2] * 57.6 + 24
        rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        torch.testing.assert_close(u, columns[mask], atol=2e-2, rtol=0)
        torch.testing.assert_close(v, rows[mask], atol=2e-2, rtol=0)
        twice = flip_sample(dict(flipped), horizontal=horizontal, vertical=vertical)
        assert torch.equal(twice["position"], sample["position"])


def test_crops_are_reproducible_and_differ(shard):
    dataset = CropDataset(index_shard(shard), CONFIG, NETWORK, seed=2)
    again = CropDataset(index_shard(shard), CONFIG, NETWORK, seed=2)
    assert len(dataset) == 12
    for crop in (0, 5, 17):
        for name, value in dataset[crop].items():
            assert torch.equal(value, again[crop][name])
    assert not torch.equal(dataset[0]["beauty"], dataset[1]["beauty"])
    assert not torch.equal(dataset[0]["beauty"], dataset[12]["beauty"])  # the same crop in the next epoch
    stops = torch.stack([torch.log2(dataset[k]["exposure"] / 1.2) for k in range(60)])
    assert stops.abs().max() <= CONFIG.exposure_jitter_stops + 1e-5
    assert stops.std() > 0.2


def lit_crops(folder, **options):
    """Crops with recorded light, drawn with the same seed for any data ``options``."""
    if not (folder / "lit").exists():
        make_dataset(folder / "lit", {"room-0": ("train", 3)}, has_light=True)
    places = index_shard(next(folder.glob("lit/shards/*.tar")))
    network = NETWORK.model_copy(update={"light_inputs": ("reflectance", "known_share", "mirror_broad")})
    return CropDataset(places, CONFIG.model_copy(update=options), network, seed=2)


def test_light_jitter_scales_only_recorded_light(tmp_path):
    plain, jittered = lit_crops(tmp_path), lit_crops(tmp_path, light_jitter_stops=0.5)
    stops = []
    for crop in range(20):
        before, after = plain[crop], jittered[crop]
        scaled = [name for name, value in before.items() if not torch.equal(value, after[name])]
        assert scaled == ["reflectance", "mirror_broad"]
        lit = before["reflectance"] > 1e-3
        ratio = torch.log2(after["reflectance"][lit] / before["reflectance"][lit])
        torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio), atol=1e-4, rtol=0)
        expected = before["mirror_broad"] * 2 ** ratio[0]
        torch.testing.assert_close(after["mirror_broad"], expected, atol=1e-6, rtol=1e-4)
        stops.append(float(ratio[0]))
    assert -0.5 <= min(stops) < -0.1 and 0.1 < max(stops) <= 0.5


def test_light_color_changes_channels_of_light_and_materials_equally(tmp_path):
    plain, colored = lit_crops(tmp_path), lit_crops(tmp_path, light_color_stops=0.5)
    radiance = ("beauty", "color_median", "color_max", "color_min", "mirror_broad")
    albedo = ("reflectance", "diffuse_albedo", "specular_albedo")
    orders, stops = set(), []
    for crop in range(20):
        before, after = plain[crop], colored[crop]
        colors = before["reflectance"].flatten(1), after["reflectance"].flatten(1)
        order = [next(c for c in range(3) if torch.equal(colors[0][c], channel)) for channel in colors[1]]
        assert sorted(order) == [0, 1, 2]
        orders.add(tuple(order))
        reordered = before["beauty"][order].sum(dim=(1, 2))
        gain = (after["beauty"].sum(dim=(1, 2)) / reordered).reshape(3, 1, 1)
        for name, value in before.items():
            expected = value[order] * gain if name in radiance else value[order] if name in albedo else value
            torch.testing.assert_close(after[name], expected, atol=1e-6, rtol=1e-4, msg=name)
        stops += torch.log2(gain).ravel().tolist()
    assert len(orders) == 6
    assert -0.5 <= min(stops) < -0.3 and 0.3 < max(stops) <= 0.5


def test_noise_grows_with_the_root_of_exposed_radiance(shard):
    plain = CropDataset(index_shard(shard), CONFIG, NETWORK, seed=2)
    noisy = CropDataset(index_shard(shard), CONFIG.model_copy(update={"noise": 0.1}), NETWORK, seed=2)
    deviations = []
    for crop in range(20):
        before, after = plain[crop], noisy[crop]
        assert [n for n, value in before.items() if not torch.equal(value, after[n])] == ["beauty"]
        exposed = before["beauty"] * before["exposure"]
        bright = exposed > 0.05  # none of these values is clipped at zero
        error = (after["beauty"] * after["exposure"] - exposed)[bright]
        relative = error / exposed[bright].sqrt()
        dim, light = exposed[bright] < exposed[bright].median(), exposed[bright] >= exposed[bright].median()
        assert 0.8 < float(relative[dim].std() / relative[light].std()) < 1.25
        assert abs(float(relative.mean())) < 5 * float(relative.std()) / relative.numel() ** 0.5
        assert (after["beauty"] >= 0).all()
        deviations.append(float(relative.std()))
    assert max(deviations) < 0.105 and min(deviations) < 0.03 and np.std(deviations) > 0.02


def test_spread_jitter_widens_minimum_and_maximum(shard):
    plain = CropDataset(index_shard(shard), CONFIG, NETWORK, seed=2)
    config = CONFIG.model_copy(update={"spread_jitter_stops": 0.5})
    jittered = CropDataset(index_shard(shard), config, NETWORK, seed=2)
    stops = {"color_min": [], "color_max": []}
    for crop in range(20):
        before, after = plain[crop], jittered[crop]
        for name, value in before.items():
            if name not in stops:
                assert torch.equal(value, after[name]), name  # other buffers and random draws are unchanged
                continue
            lit = value > 1e-3
            ratio = torch.log2(after[name][lit] / value[lit])
            torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio), atol=1e-4, rtol=0)
            stops[name].append(float(ratio[0]))
    assert min(stops["color_min"]) >= -0.5 and max(stops["color_min"]) <= 0
    assert min(stops["color_max"]) >= 0 and max(stops["color_max"]) <= 0.5
    assert np.std(stops["color_min"]) > 0.05 and np.std(stops["color_max"]) > 0.05
    single = CropDataset(
        index_shard(shard), config, NETWORK.model_copy(update={"uses_statistics": False}), seed=2
    )
    assert "color_min" not in single[0]


@pytest.mark.parametrize("workers", [0, 2])
def test_loader_yields_the_plan_for_any_number_of_workers(shard, workers):
    dataset = CropDataset(index_shard(shard), CONFIG, NETWORK, seed=2)
    plan = BatchPlan(CropOrder(4, 3, 4, seed=0), 4, stop=5)
    torch.manual_seed(11)
    before = torch.get_rng_state()
    batches = list(make_loader(dataset, plan, workers=workers))
    assert torch.equal(before, torch.get_rng_state())  # loading does not use the training's random stream
    assert [b["sample_id"].tolist() for b in batches] == list(plan)
    assert batches[0]["beauty"].shape == (4, 3, 32, 32)
    torch.testing.assert_close(batches[2]["beauty"][1], dataset[list(plan)[2][1]]["beauty"])


def test_loader_processes_outlast_signals_to_the_whole_run(shard):
    """After a Ctrl-C, which reaches all processes of a terminal, the training process still needs batches."""
    dataset = CropDataset(index_shard(shard), CONFIG, NETWORK, seed=2)
    plan = BatchPlan(CropOrder(4, 3, 4, seed=0), 4, stop=12)
    batches = iter(make_loader(dataset, plan, workers=1))
    seen = [next(batches)["sample_id"].tolist()]
    for process in multiprocessing.active_children():
        for number in (signal.SIGINT, signal.SIGTERM):
            os.kill(process.pid, number)
    seen += [batch["sample_id"].tolist() for batch in batches]
    assert seen == list(plan)


def test_views_in_memory_are_decoded_once_for_all_workers(shard, monkeypatch):
    """Batches equal those decoded from shards; views that are in memory are not decoded again."""
    places = index_shard(shard)
    plan = BatchPlan(CropOrder(4, 3, 4, seed=0), 4, stop=6)  # two epochs
    expected = list(make_loader(CropDataset(places, CONFIG, NETWORK, seed=2), plan, workers=0))
    shared = SharedViews(places, NAMES, (64, 48))
    dataset = CropDataset(places, CONFIG, NETWORK, seed=2, size_px=(64, 48), views=shared)
    for loader in (make_loader(dataset, plan, workers=2), make_loader(dataset, plan, workers=0)):
        for batch, other in zip(loader, expected, strict=True):
            assert batch.keys() == other.keys()
            assert all(torch.equal(batch[name], other[name]) for name in batch)
        monkeypatch.setattr("model.training.dataset.read_buffers", None)
    shared[1] = None  # an invalid view, which is skipped
    assert dataset[3]["is_skipped"] and not dataset[0]["is_skipped"]
    monkeypatch.setattr("model.training.dataset.shutil.disk_usage", lambda path: SimpleNamespace(free=10**6))
    SharedViews(places, NAMES, (64, 48))
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    with pytest.raises(InputError, match="shm-size"):
        SharedViews(places, NAMES, (64, 48))


@pytest.mark.parametrize(
    ("ranks", "workers"), [(1, 0), (2, 0), (3, 0), pytest.param(2, 2, marks=pytest.mark.slow)]
)
def test_ranks_and_loader_workers_resume_in_an_epoch_without_overlap_or_loss(shard, ranks, workers):
    """Any number of ranks and loader workers and any interruption yield each of the 12 crops of an epoch
    once, in the same order and with the same pixels."""
    order = CropOrder(4, 3, 4, seed=5)
    batch, cut = 12 // ranks // 2, 1
    whole = CropDataset(index_shard(shard), CONFIG, NETWORK, seed=2)
    seen = []
    for start, stop in ((0, cut), (cut, 4)):  # a run interrupted in the first epoch, and its continuation
        loaders = []
        for rank in range(ranks):
            plan = BatchPlan(order, batch, rank=rank, num_ranks=ranks, start=start, stop=stop)
            dataset = CropDataset(index_shard(shard), CONFIG, NETWORK, seed=2)
            loaders.append(make_loader(dataset, plan, workers=workers))
        for parts in zip(*loaders, strict=True):
            for part in parts:
                seen += part["sample_id"].tolist()
                torch.testing.assert_close(part["beauty"][0], whole[int(part["sample_id"][0])]["beauty"])
    assert len(order.epoch(0)) == 12
    assert sorted(seen[:12]) == list(range(12)) and sorted(seen[12:]) == list(range(12, 24))
    assert seen == [*order.epoch(0), *(12 + order.epoch(1))]


def test_single_view_network_needs_no_statistics(shard):
    names = names_for(NETWORK.model_copy(update={"uses_statistics": False}))
    assert not any(n.startswith("color_") for n in names)
    assert "color_median" not in view_sample(load_view(index_shard(shard)[0], names), 0)


# --- bad input --------------------------------------------------------------------------------------------


def _drop(name):
    def change(buffers, record):
        del buffers[name]

    return change


def _spoil(name, value, where=(3, 4)):
    def change(buffers, record):
        buffers[name] = np.array(buffers[name])
        buffers[name][where] = value

    return change


def _record(**changes):
    def change(buffers, record):
        record.update(changes)

    return change


def _smaller(buffers, record):
    for name in buffers:
        buffers[name] = buffers[name][:40]


def _meters_from_mm(buffers, record):
    buffers["depth_z_m"] = 0 * buffers["depth_z_m"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_drop("color_max"), "color_max"),
        (_drop("roughness"), "roughness"),
        (_spoil("beauty", np.nan), "beauty = 3 values NaN or Inf"),
        (_spoil("roughness", 1.4), r"roughness = .* 1\.4; expected values in \[0, 1\]"),
        (_spoil("diffuse_albedo", -0.2), "diffuse_albedo"),
        (_spoil("normal_world", 0.1, np.s_[:]), "normal_world = median length"),
        (_meters_from_mm, "depth_z_m"),
        (_smaller, "size = 64 x 40; expected 64 x 48"),
        (_record(version=0), "version"),
        (_record(format="scene-materials/other"), "format"),
        (_record(surprise=1), "surprise"),
        (_record(exposure=0.0), "exposure"),
    ],
)
def test_a_bad_view_is_named_and_refused_or_skipped(tmp_path, change, message):
    path = make_shard(tmp_path, "room-00000", 1, change=change)
    places = index_shard(path)
    with pytest.raises(InputError, match=message) as caught:
        CropDataset(places, CONFIG, NETWORK, seed=0)[0]
    assert "room-00000.tar:room-00000/view-000" in str(caught.value)
    lenient = CropDataset(places, CONFIG.model_copy(update={"on_bad_view": "skip"}), NETWORK, seed=0)
    sample = lenient[0]
    assert sample["is_skipped"] and not sample["mask"].any()
    good = CropDataset(index_shard(make_shard(tmp_path, "room-00001", 1)), CONFIG, NETWORK, seed=0)[0]
    assert {n: v.shape for n, v in good.items()} == {n: v.shape for n, v in sample.items()}


def test_another_resolution_than_the_rest_is_refused(shard):
    with pytest.raises(InputError, match="64 x 48; expected 128 x 96 as in the rest"):
        load_view(index_shard(shard)[0], NAMES, size_px=(128, 96))
    with pytest.raises(InputError, match="at least the crop"):
        load_view(index_shard(shard)[0], NAMES, min_side_px=64)


def test_damaged_shards_are_refused(shard, tmp_path):
    data = shard.read_bytes()
    for content, message in (
        (b"", "intact shard|no views"),
        (b"x" * 2000, "intact shard"),
        (data[: len(data) // 2], "cut off|intact|one .exr and one .json"),
        (data[:512], "intact|no views"),
    ):
        path = tmp_path / "broken.tar"
        path.write_bytes(content)
        with pytest.raises(InputError, match=message):
            index_shard(path)
    place = index_shard(shard)[0]
    flipped = bytearray(data)
    flipped[place.exr[0] + 50 : place.exr[0] + 4000] = b"\xff" * 3950
    path.write_bytes(bytes(flipped))
    with pytest.raises(InputError, match="view-000"):
        load_view(index_shard(path)[0], NAMES)


def test_dataset_folders_are_opened_by_their_index(tmp_path):
    folder = make_dataset(
        tmp_path / "d", {"room-0": ("train", 3), "room-1": ("validation", 2), "room-2": ("test", 1)}
    )
    data = open_data([folder], NETWORK, 32)
    assert (len(data.train), len(data.validation), data.size_px) == (3, 2, (64, 48))
    assert data.records[0].name == "tiny" and len(data.records[0].index_sha256) == 64
    with pytest.raises(InputError, match="at least 64 px"):
        open_data([folder], NETWORK, 64)
    index = read_json(DatasetIndex, folder / "index.json")
    old = index.model_copy(update={"buffers": tuple(b for b in index.buffers if b != "color_min")})
    (folder / "index.json").write_text(old.model_dump_json())
    with pytest.raises(InputError, match="no color_min"):
        open_data([folder], NETWORK, 32)
    assert len(open_data([folder], NETWORK.model_copy(update={"uses_statistics": False}), 32).train) == 3
    (folder / "index.json").write_text(index.model_dump_json().replace('"version":1', '"version":0', 1))
    with pytest.raises(InputError, match="version"):
        open_data([folder], NETWORK, 32)
    (folder / "index.json").write_text(index.model_dump_json())
    shard = folder / "shards" / "room-0.tar"
    shard.rename(tmp_path / "room-0.tar")
    shard.symlink_to(tmp_path / "room-0.tar")
    with pytest.raises(InputError, match="a symbolic link that leads to"):
        open_data([folder], NETWORK, 32)
    only_test = make_dataset(tmp_path / "e", {"room-2": ("test", 1)})
    with pytest.raises(InputError, match="no views of split train"):
        open_data([only_test], NETWORK, 32)


def test_spread_selects_views_evenly():
    assert spread(list(range(10)), 3) == [0, 3, 6]
    assert spread(list(range(3)), 10) == [0, 1, 2]

# SPDX-License-Identifier: MIT
"""Datasets as streams of tensors: each view once for any ranks and processes; crops with their cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from datagen.formats.shard import ShardReader
from datagen.foundation.errors import InputError
from model.loading import ViewStream
from tests.model.training_data import make_dataset, make_shard


@pytest.fixture(scope="module")
def shards(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("shards")
    return [make_shard(folder, f"room-0000{k}", 5, seed=k) for k in range(2)]


def _keys(samples) -> list[str]:
    return [f"{s['configuration']}/{s['view']}" for s in samples]


def test_whole_views_equal_the_shards(shards) -> None:
    stream = ViewStream(shards, ["beauty", "depth_z_m", "material_id"], shuffle=False)
    views = [view for path in shards for view in ShardReader(path)]
    samples = list(stream)
    assert len(samples) == len(stream) == len(views) == 10
    for sample, view in zip(samples, views, strict=True):
        assert sample["view"] == view.record.name
        for name in ("beauty", "depth_z_m", "material_id"):
            assert sample[name].dtype == (torch.int64 if name == "material_id" else torch.float32)
            np.testing.assert_array_equal(sample[name].numpy().transpose(1, 2, 0), view.buffers[name])
        assert sample["exposure"] == pytest.approx(view.record.exposure)


def test_every_view_occurs_once_for_any_ranks_and_processes(shards) -> None:
    everything = sorted(_keys(ViewStream(shards, ["roughness"], shuffle=False)))
    for num_ranks, workers in ((1, 0), (1, 2), (2, 2)):
        seen: list[str] = []
        for rank in range(num_ranks):
            stream = ViewStream(shards, ["roughness"], rank=rank, num_ranks=num_ranks)
            loader = DataLoader(stream, batch_size=None, num_workers=workers)
            mine = _keys(loader)
            assert len(mine) == len(stream)
            seen += mine
        assert sorted(seen) == everything, (num_ranks, workers)


def test_ranks_get_equal_counts_of_indivisible_views(shards) -> None:
    parts = [_keys(ViewStream(shards, ["roughness"], rank=r, num_ranks=3)) for r in range(3)]
    assert [len(part) for part in parts] == [3, 3, 3]
    assert len(set().union(*parts)) == 9


def test_epochs_differ_and_persistent_processes_follow(shards) -> None:
    stream = ViewStream(shards, ["roughness"], seed=4)
    loader = DataLoader(stream, batch_size=None, num_workers=1, persistent_workers=True)
    first, again = _keys(loader), _keys(loader)
    stream.set_epoch(1)
    second = _keys(loader)
    assert first == again
    assert first != second and sorted(first) == sorted(second)


def test_crops_are_windows_with_their_cameras(shards) -> None:
    """The principal point moves with the window, whose position thus follows from the intrinsics."""
    views = {
        (v.record.configuration, v.record.name): v for path in shards for v in ShardReader(path, ["beauty"])
    }
    stream = ViewStream(shards, ["beauty"], crop_px=16, crops_per_view=3)
    samples = list(stream)
    assert len(samples) == len(stream) == 30
    corners = set()
    for sample in samples:
        view = views[sample["configuration"], sample["view"]]
        camera = view.record.camera
        left = round(camera.cx_px - float(sample["intrinsics"][0, 2]))
        top = round(camera.cy_px - float(sample["intrinsics"][1, 2]))
        corners.add((top, left))
        window = view.buffers["beauty"][top : top + 16, left : left + 16]
        np.testing.assert_array_equal(sample["beauty"].numpy().transpose(1, 2, 0), window)
    assert len(corners) > 20
    assert len(set(_keys(samples)[:8])) > 3  # crops of one view are not consecutive


def test_crops_do_not_depend_on_the_number_of_processes(shards) -> None:
    def crops(workers: int) -> set[tuple[str, float, float]]:
        stream = ViewStream(shards, ["roughness"], crop_px=16, crops_per_view=2)
        loader = DataLoader(stream, batch_size=None, num_workers=workers)
        return {(s["view"] + s["configuration"], *s["intrinsics"][:2, 2].tolist()) for s in loader}

    assert crops(0) == crops(2)


def test_batches_and_splits_of_a_dataset(tmp_path) -> None:
    folder = make_dataset(tmp_path / "rooms", {"room-00000": ("train", 3), "room-00001": ("validation", 2)})
    train = ViewStream([folder], ["beauty"], crop_px=16)
    assert {s["configuration"] for s in train} == {"room-00000"}
    assert len(ViewStream([folder], ["beauty"], split=None)) == 5
    batch = next(iter(DataLoader(train, batch_size=3)))
    assert batch["beauty"].shape == (3, 3, 16, 16) and batch["world_from_camera"].shape == (3, 4, 4)


def test_wrong_arguments_are_refused(shards, tmp_path) -> None:
    with pytest.raises(InputError, match=r"crop_px = 0; expected at least 1"):
        ViewStream(shards, ["beauty"], crop_px=0)
    with pytest.raises(InputError, match=r"crops_per_view = 0; expected at least 1"):
        ViewStream(shards, ["beauty"], crop_px=16, crops_per_view=0)
    with pytest.raises(InputError, match=r"buffers = albedo; expected beauty, "):
        ViewStream(shards, ["albedo"])
    with pytest.raises(InputError, match=r"rank = 2; expected a number from 0 to num_ranks - 1 = 1"):
        ViewStream(shards, ["beauty"], rank=2, num_ranks=2)
    with pytest.raises(InputError, match=r"10 views of split train; expected at least one for each of 11"):
        ViewStream(shards, ["beauty"], rank=0, num_ranks=11)
    with pytest.raises(
        InputError, match=r"room-00000.*view-.*size = 64 x 48; expected at least the crop, 50"
    ):
        list(ViewStream(shards, ["beauty"], crop_px=50, shuffle=False))
    data = bytearray(shards[0].read_bytes())
    place = ViewStream(shards[:1], ["beauty"]).places[2]
    data[place.exr[0] + 400 : place.exr[0] + 800] = bytes(400)
    broken = tmp_path / "broken.tar"
    broken.write_bytes(data)
    with pytest.raises(InputError, match=r"broken.tar:.*view-"):
        list(ViewStream([broken], ["beauty"]))

# SPDX-License-Identifier: MIT
"""Comparison of generated and imported rooms: statistics and written files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.studies.compare_rooms import figures_of, is_window, main, read_room
from datagen.formats.shard import Dataset, View
from datagen.foundation.color import clipped_share, photographic_exposure
from tests.datagen.small_rendered import rendered_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered_dataset(tmp_path_factory)


def lit_sill(view: View) -> View:
    """Return ``view`` as a dim room with a brightly lit window sill at the top and metal at the bottom."""
    height, width = view.buffers["beauty"].shape[:2]
    rows = max(1, round(0.05 * height))
    buffers = {name: array.copy() for name, array in view.buffers.items()}
    buffers["beauty"][:] = np.linspace(0.02, 0.04, width)[:, None]
    buffers["beauty"][:rows] = 1.0
    buffers["surface_mask"][:] = 1
    buffers["depth_z_m"][:] = 1
    buffers["instance_id"][:] = 1
    buffers["instance_id"][:rows] = 2
    buffers["specular_albedo"][:] = 0.04
    buffers["specular_albedo"][-rows:] = 0.8
    names = {"1": "room/wall_north.wall", "2": "room/window_0.sill"}
    return View(view.record.model_copy(update={"instances": names}), buffers)


def test_clipping_is_counted_with_and_without_windows(dataset: Path) -> None:
    view = lit_sill(next(iter(Dataset(dataset).views())))
    rows = is_window(view).mean()
    assert 0.03 < rows < 0.09
    found = figures_of("a", [view])
    assert found.clipped[0] == pytest.approx(rows) and found.clipped_in_room[0] == 0
    assert found.metal_share == pytest.approx(rows)
    assert found.exposures[0] == photographic_exposure(view.buffers["beauty"].astype(np.float32))
    brighter = View(view.record, {**view.buffers, "beauty": 2 * view.buffers["beauty"]})
    assert figures_of("a", [view, brighter]).exposure_ratio == pytest.approx(2, rel=1e-3)


def test_densities_sum_to_one_and_pictures_are_exposed(dataset: Path) -> None:
    shard = dataset / Dataset(dataset).index.shards[0].file
    room = read_room(shard, 2)
    assert len(room.exposures) == 2
    assert all(density.sum() == pytest.approx(1) for density in room.densities.values())
    views = [view for k, view in enumerate(Dataset(dataset).views()) if k < 5]
    beauty = views[0].buffers["beauty"].astype(np.float32)
    mask = views[0].buffers["surface_mask"][..., 0] >= 0.5
    mask &= views[0].buffers["depth_z_m"][..., 0] > 0
    shares = clipped_share(beauty, room.exposures[0], mask)
    assert room.clipped[0] == pytest.approx(shares)
    assert room.picture.shape == beauty.shape and 20 < room.picture.mean() < 235


def test_the_command_writes_table_and_pictures(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shard = str(dataset / Dataset(dataset).index.shards[1].file)
    main([str(dataset), "--imported", shard, "--out", str(tmp_path / "out"), "--views", "3", "--page", "2"])
    printed = capsys.readouterr().out
    assert "| generated rooms | 2, 6 |" in printed and "| imported rooms | 1, 3 |" in printed
    with (
        Image.open(tmp_path / "out" / "page.jpg") as page,
        Image.open(tmp_path / "out" / "beside.jpg") as pair,
    ):
        assert page.size == (4 * 228 - 4, 140) and pair.size == (2 * 364 - 4, 225)
    assert (tmp_path / "out" / "distributions.png").stat().st_size > 5000

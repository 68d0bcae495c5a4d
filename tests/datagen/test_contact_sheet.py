# SPDX-License-Identifier: MIT
"""Contact sheets have every column, and each cell shows its buffer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.formats.base import canonical_json
from datagen.formats.shard import write_shard
from datagen.foundation.color import (
    clipped_share,
    exposure_for,
    luminance,
    photographic_exposure,
    srgb_from_linear,
)
from datagen.foundation.errors import InputError
from datagen.inspection.contact_sheet import (
    COLUMNS,
    Scales,
    choose_rows,
    choose_scales,
    exposure_of,
    make_contact_sheet,
    screen_image,
    shard_sheet,
)
from tests.datagen.small_dataset import make_buffers, make_configuration, make_view_files

SCALES = Scales(exposure=0.5, farthest_m=4.0, max_views=12)


def flat_view(**values) -> dict[str, np.ndarray]:
    """Return a view in which the buffers named by ``values`` are constant."""
    view = make_buffers(6, 8, seed=1)
    for name, value in values.items():
        view[name] = np.broadcast_to(np.float32(value), view[name].shape).copy()
    return view


def test_rows_are_few_and_spread_over_the_views():
    assert choose_rows(4) == [0, 1, 2, 3]
    assert choose_rows(40) == [0, 8, 16, 23, 31, 39]
    assert choose_rows(1) == [0]
    assert choose_rows(7, 2) == [0, 6]


def test_radiance_is_exposed_and_encoded_albedo_only_encoded():
    view = flat_view(beauty=[0.8, 0.4, 0.1], diffuse_albedo=[0.8, 0.4, 0.1])
    beauty = screen_image("beauty", view, SCALES)[0, 0]
    np.testing.assert_array_equal(beauty, np.round(255 * srgb_from_linear(np.array([0.4, 0.2, 0.05]))))
    albedo = screen_image("diffuse_albedo", view, SCALES)[0, 0]
    np.testing.assert_array_equal(albedo, np.round(255 * srgb_from_linear(np.array([0.8, 0.4, 0.1]))))


def test_normals_are_mapped_to_the_unit_cube():
    view = flat_view(normal_world=[0, -1, 0.5])
    np.testing.assert_array_equal(screen_image("normal_world", view, SCALES)[0, 0], [128, 0, 191])


@pytest.mark.parametrize(
    ("name", "full"), [("roughness", 1.0), ("depth_z_m", 4.0), ("observation_count", 12.0)]
)
def test_scalars_grow_brighter_along_the_color_map(name, full):
    shades = [
        int(screen_image(name, flat_view(**{name: full * share}), SCALES)[0, 0].sum())
        for share in (0.05, 0.3, 0.6, 1.0)
    ]
    assert shades == sorted(set(shades))
    over = screen_image(name, flat_view(**{name: full * 1.7}), SCALES)
    np.testing.assert_array_equal(over, screen_image(name, flat_view(**{name: full}), SCALES))


def test_pixels_without_a_value_are_hatched():
    view = flat_view(depth_z_m=1.0, diffuse_albedo=1.0)
    view["depth_z_m"][0, 0] = 0
    view["surface_mask"][1, 1] = 0
    view["beauty"][2, 2] = np.nan
    for name, row, column in (("depth_z_m", 0, 0), ("diffuse_albedo", 1, 1), ("beauty", 2, 2)):
        picture = screen_image(name, view, SCALES)
        assert set(picture[row, column]) <= {46, 58}
        assert not set(picture[4, 4]) <= {46, 58}


def test_scales_ignore_background_and_non_finite_values():
    view = flat_view(beauty=2.0, depth_z_m=3.0, observation_count=5)
    view["beauty"][0, :] = 1000
    view["surface_mask"][0, :] = 0
    view["depth_z_m"][1, :] = 0
    view["depth_z_m"][2, 2] = np.nan
    scales = choose_scales([view])
    assert scales.exposure == pytest.approx(0.45)
    assert scales.farthest_m == pytest.approx(3.0)
    assert scales.max_views == 5


def test_exposure_clips_few_highlights():
    rng = np.random.default_rng(3)
    warm = rng.lognormal(0.0, 0.8, (60, 80, 1)) * np.array([1.9, 1.0, 0.35])
    at_95 = exposure_for(warm)
    exposure = photographic_exposure(warm)
    assert ((warm * at_95).max(axis=-1) > 1).mean() > 0.1
    clipped = ((warm * exposure).max(axis=-1) > 1).mean()
    assert 0.02 < clipped <= 0.025
    grey = np.full((60, 80, 3), 0.3)
    assert photographic_exposure(grey) == pytest.approx(exposure_for(grey))
    window = np.zeros((60, 80), dtype=bool)
    window[:20] = True
    bright = np.where(window[..., None], 500.0, warm)
    assert photographic_exposure(bright, ~window) == pytest.approx(photographic_exposure(warm[20:]))
    assert photographic_exposure(np.zeros((4, 4, 3))) == 1.0


def test_exposure_ignores_a_bright_sill():
    rng = np.random.default_rng(4)
    room = rng.uniform(0.02, 0.04, (60, 80, 1)) * np.ones(3)
    room[:2, :72] = 1.0  # 3 % of the pixels: a sill in sky light
    exposure = photographic_exposure(room)
    assert np.median(luminance(room)) * exposure == pytest.approx(0.1)
    assert clipped_share(room, exposure) == pytest.approx(144 / 4800)
    room[:8] = 1.0  # 13 %: a wall, which must be visible
    assert clipped_share(room, photographic_exposure(room)) == 0
    is_room = np.ones((60, 80), dtype=bool)
    is_room[:8] = False
    assert clipped_share(room, 30, ~is_room) == 1 and clipped_share(room, 30, np.zeros_like(is_room)) == 0


def test_every_view_of_a_sheet_has_a_separate_exposure():
    dark, bright = (dict(make_buffers(96, 160, seed=1)) for _ in range(2))
    for name in ("beauty", "color_min", "color_median", "color_max"):
        bright[name] = 8 * bright[name]
    sheet = np.asarray(make_contact_sheet([dark, bright], ["same", "same"], "title"))
    half = np.asarray(make_contact_sheet([dark, dark], ["same", "same"], "title"))
    assert exposure_of(dark) == pytest.approx(8 * exposure_of(bright))
    pictures = slice(-10 * 328, None)  # columns of images, without the exposure labels
    np.testing.assert_array_equal(sheet[:, pictures], half[:, pictures])
    assert sheet.shape != half.shape or (sheet != half).any()


@pytest.mark.parametrize("size", [(24, 40), (96, 160), (300, 500)])
def test_every_column_and_row_is_drawn(size):
    views = [make_buffers(*size, seed=index) for index in range(3)]
    full = np.asarray(make_contact_sheet(views, ["view-0", "view-1", "view-2"], "title"))
    one = np.asarray(make_contact_sheet(views[:1], ["view-0"], "title"))
    assert full.shape[1] == one.shape[1] and full.shape[0] > one.shape[0]
    fewer = [{k: v for k, v in view.items() if k != "color_min"} for view in views]
    narrow = np.asarray(make_contact_sheet(fewer, ["view-0", "view-1", "view-2"], "title"))
    assert (full.shape[1] - narrow.shape[1]) * len(COLUMNS) > 0.9 * (full.shape[1] - 100)
    # a black buffer changes only the pixels of its column
    changed = [dict(view, diffuse_albedo=np.zeros_like(view["diffuse_albedo"])) for view in views]
    black = np.asarray(make_contact_sheet(changed, ["view-0", "view-1", "view-2"], "title"))
    columns = np.nonzero((black != full).any(axis=(0, 2)))[0]
    assert 0 < np.ptp(columns) < full.shape[1] / len(COLUMNS)


def test_an_empty_selection_is_refused():
    with pytest.raises(InputError, match="no views"):
        make_contact_sheet([], [], "title")
    with pytest.raises(InputError, match="without beauty"):
        make_contact_sheet([{"roughness": np.ones((2, 2, 1))}], ["a"], "title")


def write_small_shard(tmp_path: Path, num_views: int) -> Path:
    configuration = make_configuration(num_views)
    members = make_view_files(tmp_path, configuration)
    shard = tmp_path / "small.tar"
    with shard.open("wb") as file:
        write_shard(file, canonical_json(configuration), members)
    return shard


def test_sheet_of_a_shard(tmp_path):
    shard = write_small_shard(tmp_path, 8)
    sheet = shard_sheet(shard, max_rows=3)
    assert sheet.width > 10 * 200
    assert sheet.height < shard_sheet(shard).height


def test_damaged_shard_is_refused(tmp_path):
    shard = write_small_shard(tmp_path, 2)
    shard.write_bytes(shard.read_bytes()[:3000])
    with pytest.raises(InputError):
        shard_sheet(shard)

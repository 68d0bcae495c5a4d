# SPDX-License-Identifier: MIT
"""Statistics, projection, depth tests, encodings and rendering at their extremes (docs/measurements.md)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.studies.data_extremes import (
    HALF_VALUES,
    RADIANCES,
    alike_views,
    image_at_scales,
    lit_floor,
    log_round_trip,
    scale_of_radiance,
    scale_of_scene,
    spread_of_alike_views,
    stored_as_half,
)
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import exposure_for, linear_from_log, log_from_linear, srgb_from_linear
from datagen.multiview.statistics import StatisticsOptions, StatisticsView, compute_statistics
from datagen.multiview.visibility import PackedViews, VisibilityOptions
from datagen.rendering.error import relative_mse
from oracles.multiview_scenes import POSES, make_views, seen_boxes
from oracles.point_observations import observe_points
from oracles.statistics import statistics_vectorized
from tests.datagen.test_multiview_statistics import disagreement, oracle_options

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
EPS = float(np.finfo(np.float32).eps)


def many_views(num_views: int, size: tuple[int, int] = (16, 12)) -> list[StatisticsView]:
    """Make views of the boxes with random colours, from random positions near the cameras of ``POSES``."""
    rng = np.random.default_rng(3)
    base = make_views((size,))
    found = []
    for index in range(num_views):
        position, target = (np.array(p) for p in POSES[index % len(POSES)])
        camera: Camera = base[index % len(base)].camera
        camera = replace(camera, world_from_camera=look_at(position + rng.uniform(-0.2, 0.2, 3), target))
        depth, normals = seen_boxes(camera)
        color = rng.random(normals.shape).astype(np.float32)
        mask = (depth > 0).astype(np.float32)
        depth, normals = depth.astype(np.float32), normals.astype(np.float32)
        found.append(StatisticsView(camera, color, depth, normals, mask, f"view_{index:03}"))
    return found


# ---- statistics


@pytest.mark.parametrize("factor", [1e-3, 1e4])
def test_size_of_the_scene_changes_no_statistic(factor: float) -> None:
    found = scale_of_scene(factor)
    assert found["pixels with another count"] < 1e-3
    assert found["largest difference of a colour"] < 5e-5
    assert found["largest error of a projection, px"] < 1e-4


@pytest.mark.parametrize("factor", RADIANCES)
def test_brightness_scales_statistics(factor: float) -> None:
    assert scale_of_radiance(factor) < 4 * EPS


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**20])
def test_powers_of_two_scale_statistics_exactly(factor: float) -> None:
    assert scale_of_radiance(factor) == 0.0


@pytest.mark.parametrize("value", [0.0, 65504.0, 1e30])
def test_constant_colours_are_their_own_statistics(value: float) -> None:
    views = [replace(v, color=np.full_like(v.color, value)) for v in make_views()]
    for result in compute_statistics(views):
        for name in ("color_min", "color_median", "color_max"):
            np.testing.assert_allclose(result[name], value, rtol=3 * EPS)


def test_identical_views_agree() -> None:
    # projecting a pixel onto itself errs by about 1e-5 px; white noise has gradients of up to 1 per px
    assert spread_of_alike_views(1) == 0.0
    assert spread_of_alike_views(12) < 1e-4
    (result,) = compute_statistics(alike_views(40), StatisticsOptions(best_views=24), only=(7,))
    assert result["observation_count"].max() == 24


def test_three_hundred_views_equal_the_oracle() -> None:
    views = many_views(300)
    options = StatisticsOptions(best_views=12)
    (result,) = compute_statistics(views, options, only=(150,))
    expected = statistics_vectorized(views, 150, oracle_options(options))
    num_wrong, share = disagreement(result, expected, options)
    assert num_wrong == 0
    assert share > 0.3  # of pixels; in the others one of the many views is too close to a threshold
    assert result["observation_count"].max() == 12


# ---- depth tests and borders


def wall_camera() -> tuple[PackedViews, Camera]:
    """A view of 10 x 10 px from the origin with a depth of 2 m everywhere, and its camera."""
    camera = Camera(10, 10, 10.0, 10.0, 5.0, 5.0, look_at((0, 0, 0), (0, 1, 0)))
    return PackedViews([camera], [np.full((10, 10), 2.0)]), camera


def test_depth_test_includes_equality_and_ends_at_its_tolerance() -> None:
    packed, _ = wall_camera()
    options = VisibilityOptions(depth_tolerance=0.25, slope_limit=0.0)
    # |2 - z| <= z / 4 means 1.6 <= z <= 2.666...; a tolerance of 0 accepts only z = 2
    depths = np.array([2.0, 1.6001, 1.5999, 2.6666, 2.6667])
    points = np.stack([np.zeros(5), depths, np.zeros(5)], axis=1)
    normals = np.tile([0.0, -1.0, 0.0], (5, 1))
    seen = observe_points(packed, points, normals, options).visible_mask[0]
    assert seen.tolist() == [True, True, False, True, False]
    exact = observe_points(
        packed, points[:2], normals[:2], VisibilityOptions(depth_tolerance=0.0, slope_limit=0.0)
    )
    assert exact.visible_mask[0].tolist() == [True, False]


def test_only_left_and_upper_borders_belong_to_the_image() -> None:
    packed, camera = wall_camera()
    inside = [(0.0, 5.0), (5.0, 0.0), (0.0, 0.0), (np.nextafter(10.0, 0, dtype=np.float32), 5.0)]
    outside = [(10.0, 5.0), (5.0, 10.0), (-1e-5, 5.0), (5.0, -1e-5)]
    pixels = np.array([*inside, *outside], dtype=np.float64)
    points = camera.unproject(pixels, np.full(len(pixels), 2.0))
    normals = np.tile([0.0, -1.0, 0.0], (len(points), 1))
    seen = observe_points(packed, points, normals)
    assert seen.visible_mask[0].tolist() == [True] * 4 + [False] * 4
    np.testing.assert_allclose(seen.pixels[0][:4], pixels[:4], atol=1e-6)


def test_points_at_the_camera_and_in_its_plane_are_not_seen() -> None:
    packed, _ = wall_camera()
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1e-30, 0.0]])
    seen = observe_points(packed, points, np.tile([0.0, -1.0, 0.0], (3, 1)))
    assert not seen.visible_mask.any()
    assert np.isfinite(seen.distance_m).all()


# ---- encodings


def test_files_clip_values_beyond_half_floats() -> None:
    for value in HALF_VALUES:
        stored = stored_as_half(value)
        if value >= 65504:
            assert stored == 65504.0
        else:
            # half an ulp; 2^-25 is half the step of values below 2^-14
            assert abs(stored - value) <= max(2.0**-11 * value, 2.0**-25)


def test_log_encoding_at_its_ends() -> None:
    assert log_round_trip(np.float64) < 1e-14
    assert log_round_trip(np.float32) < 4 * EPS
    ends = np.array([-1.0, 0.0, 1.0, 65504.0, 1e30, np.inf])
    np.testing.assert_allclose(log_from_linear(ends), [-1, -1, 1, 1, 1, 1], atol=1e-12)
    np.testing.assert_allclose(linear_from_log(np.array([-1.0, 1.0])), [0, 1], atol=1e-12)
    assert np.isnan(log_from_linear(np.array([np.nan]))).all()  # NaN is kept, so checks detect it
    dark = np.array([0.0, 1e-6, 1e-5])
    assert (np.diff(log_from_linear(dark)) > 0).all()


def test_exposure_and_error_do_not_depend_on_the_unit_of_radiance() -> None:
    rng = np.random.default_rng(0)
    reference = rng.random((16, 16, 3))
    image = reference * rng.normal(1.0, 0.1, reference.shape)
    expected = relative_mse(image, reference, exposed=True)
    for factor in (1e-30, 1e-6, 1e6, 1e30):
        exposure = exposure_for(reference * factor)
        assert exposure * factor == pytest.approx(exposure_for(reference), rel=1e-12)
        assert relative_mse(image * factor, reference * factor, exposed=True) == pytest.approx(expected)
        assert np.isfinite(srgb_from_linear(image * factor * exposure)).all()
    assert exposure_for(np.zeros((4, 4, 3))) == 1.0


# ---- rendering


def test_scale_and_brightness_of_a_room_hardly_change_its_image() -> None:
    # Mitsuba starts rays at least 1.8e-4 m off a surface, a large offset at a scale of 1e-3. At a scale of
    # 0.1 one path in 64 may hit or miss the light's edge, which changes one pixel but not the median.
    largest = {(1e-3, 1.0): 0.02, (0.1, 1.0): 1 / 64, (1e4, 1.0): 1e-5, (1.0, 1e-6): 1e-6, (1.0, 1e4): 1e-6}
    found = dict(zip(largest, image_at_scales(list(largest)), strict=True))
    assert all(found[key][0] <= limit for key, limit in largest.items()), found
    assert found[0.1, 1.0][1] <= 1e-4


def test_radiance_beyond_half_floats_is_clipped_in_images() -> None:
    assert lit_floor(1.0, 1e9).max() == 65504.0

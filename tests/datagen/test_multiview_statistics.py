# SPDX-License-Identifier: MIT
"""Statistics of views agree with a float64 oracle and have their defining properties."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.foundation.buffers import BUFFERS, STATISTICS_BUFFERS
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import InputError
from datagen.multiview.statistics import (
    StatisticsOptions,
    StatisticsView,
    compute_statistics,
    has_surface,
    sorting_network,
)
from datagen.multiview.visibility import VisibilityOptions
from oracles.multiview_scenes import is_occluded, make_views, mitsuba_scene
from oracles.statistics import OracleOptions, statistics_by_loops, statistics_vectorized

pytestmark = pytest.mark.usefixtures("mitsuba_variant")

# Comparisons with a margin below this may turn out differently in float32: projections err by about 1e-5 px.
DECISION_MARGIN = 2e-4
# Bilinear weights have the errors of projections, and white noise has gradients of up to 1 per pixel.
COLOR_TOLERANCE = 1e-4

COLORS = [name for name in STATISTICS_BUFFERS if BUFFERS[name].num_channels == 3]
CASES = {
    "default": StatisticsOptions(),
    "best_4": StatisticsOptions(best_views=4),
    "best_5_without_self": StatisticsOptions(best_views=5, include_self=False),
    "best_24": StatisticsOptions(best_views=24),
    "trace": StatisticsOptions(visibility=VisibilityOptions("trace")),
    "trace_best_4": StatisticsOptions(best_views=4, visibility=VisibilityOptions("trace")),
}


def oracle_options(options: StatisticsOptions) -> OracleOptions:
    return OracleOptions(
        best_views=options.best_views,
        include_self=options.include_self,
        depth_tolerance=options.visibility.depth_tolerance,
        slope_tolerance_px=options.visibility.slope_tolerance_px,
        slope_limit=options.visibility.slope_limit,
        occlusion=is_occluded if options.visibility.mode == "trace" else None,
    )


def compute(views, options=None):
    options = options or StatisticsOptions()
    scene = mitsuba_scene() if options.visibility.mode == "trace" else None
    return list(compute_statistics(views, options, scene))


def disagreement(result, expected, options) -> tuple[int, float]:
    """Return the number of unambiguous pixels that differ from the oracle, and the share of such pixels."""
    *colors, count, margin = expected
    is_sure = margin > DECISION_MARGIN
    is_wrong = result["observation_count"][..., 0] != count
    for name, color in zip(COLORS, colors, strict=True):
        is_wrong |= (np.abs(result[name] - color) > COLOR_TOLERANCE).any(axis=-1)
    return int((is_wrong & is_sure).sum()), float(is_sure.mean())


@pytest.mark.parametrize("is_exact", [False, True], ids=["depth", "exact"])
@pytest.mark.parametrize("best_views", [4, 12])
def test_vectorized_oracle_equals_loops(is_exact, best_views):
    views = make_views(((15, 10), (12, 13)))
    options = OracleOptions(
        best_views=best_views, is_bilinear=best_views == 12, occlusion=is_occluded if is_exact else None
    )
    for index in (0, 4, 6):
        slow = statistics_by_loops(views, index, options)
        fast = statistics_vectorized(views, index, options)
        for a, b in zip(slow, fast, strict=False):
            np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_equals_oracle(name):
    options = CASES[name]
    views = make_views(((45, 30), (37, 41)))
    counts = []
    for index, result in enumerate(compute(views, options)):
        expected = statistics_vectorized(views, index, oracle_options(options))
        wrong, sure = disagreement(result, expected, options)
        assert wrong == 0, f"view {index}: {wrong} pixels differ"
        assert sure > 0.97
        counts.append(result["observation_count"].ravel())
    counts = np.concatenate(counts)
    assert len(np.unique(counts)) >= 4, "the scene no longer exercises different counts"
    assert (counts == options.best_views).any() == (options.best_views <= 5), "the cut at k is exercised"


@pytest.mark.parametrize(
    "wrong",
    [
        {"depth_tolerance": 0.005 * 1.05, "slope_limit": 0.05 * 1.05, "slope_tolerance_px": 1.05},
        {"best_views": 11, "is_bilinear": False},
        {"include_self": False},
    ],
)
def test_a_wrong_oracle_is_detected(wrong):
    """Injected fault: an oracle with parameters 5 % too large or with other options is detected."""
    options = StatisticsOptions()
    views = make_views(((90, 60),))
    wrongs = 0
    for index, result in enumerate(compute(views, options)):
        expected = statistics_vectorized(views, index, replace(oracle_options(options), **wrong))
        wrongs += disagreement(result, expected, options)[0]
    assert wrongs > 0


def test_background_and_emitters_keep_the_colour_of_the_view():
    views = make_views()
    for view, result in zip(views, compute(views), strict=True):
        is_empty = ~has_surface(view.depth_z_m, view.surface_mask)
        assert (result["observation_count"][is_empty] == 0).all()
        assert (result["observation_count"][~is_empty] >= 1).all()
        for name in COLORS:
            np.testing.assert_array_equal(result[name][is_empty], view.color[is_empty])
    assert not has_surface(views[5].depth_z_m, views[5].surface_mask).any()  # the camera that faces away


def test_statistics_are_ordered_bounded_and_shaped():
    views = make_views(((21, 14), (16, 18)))
    for view, result in zip(views, compute(views), strict=True):
        shape = (view.camera.height_px, view.camera.width_px)
        assert list(result) == list(STATISTICS_BUFFERS)
        assert {name: array.shape for name, array in result.items()} == {
            **dict.fromkeys(COLORS, (*shape, 3)),
            "observation_count": (*shape, 1),
        }
        assert all(array.dtype == np.float32 for array in result.values())
        assert (result["color_min"] <= result["color_median"]).all()
        assert (result["color_median"] <= result["color_max"]).all()
        # statistics include the pixel's colour (nine views, best_views = 12)
        assert (result["color_min"] <= view.color).all() and (view.color <= result["color_max"]).all()


def test_single_view_returns_the_colours_of_the_view_exactly():
    view = make_views(num_views=1)[0]
    result = compute([view])[0]
    is_surface = has_surface(view.depth_z_m, view.surface_mask)
    for name in COLORS:
        np.testing.assert_array_equal(result[name], view.color)
    np.testing.assert_array_equal(result["observation_count"][..., 0], is_surface)


def test_even_count_takes_the_mean_of_the_middle_two():
    """The median of four identical cameras with the constant colours 0, 0.1, 0.4 and 1 is 0.25."""
    base = make_views(num_views=1)[0]
    mask = np.ones_like(base.surface_mask)
    views = [
        replace(base, color=np.full_like(base.color, value), surface_mask=mask)
        for value in (0.4, 0.0, 1.0, 0.1)
    ]
    hit = base.depth_z_m[..., 0] > 0
    for result in compute(views):
        assert (result["observation_count"][hit] == 4).all()
        np.testing.assert_allclose(result["color_median"][hit], 0.25, atol=1e-7)
    for result in compute(views[:3]):
        np.testing.assert_allclose(result["color_median"][hit], 0.4, atol=1e-7)


def test_equal_costs_keep_the_first_view():
    """With ``best_views=4``, each of six identical cameras selects views 0 to 3."""
    base = make_views(num_views=1)[0]
    views = [replace(base, color=np.full_like(base.color, value / 10)) for value in range(6)]
    hit = has_surface(base.depth_z_m, base.surface_mask)
    for result in compute(views, StatisticsOptions(best_views=4)):
        np.testing.assert_allclose(result["color_min"][hit], 0.0, atol=1e-7)
        np.testing.assert_allclose(result["color_max"][hit], 0.3, atol=1e-7)


def test_ranking_prefers_views_along_the_normal():
    """Cameras nearly above a floor rank before grazing ones; with a wrong sign they would rank last."""
    from datagen.foundation.cameras import look_at

    views = []
    angles = np.deg2rad([5, 10, 15, 20, 60, 65, 70, 75])
    for index, angle in enumerate(angles):
        position = np.array([3 * np.sin(angle), 0.1 * index, 3 * np.cos(angle)])
        camera = Camera(40, 40, 60.0, 60.0, 20.0, 20.0, look_at(position, (0, 0, 0)))
        directions = camera.ray_directions()
        depth = -camera.position_m[2] / directions[..., 2] * (directions @ camera.forward)
        normal = np.broadcast_to(np.float32([0, 0, 1]), (40, 40, 3))
        color = np.full((40, 40, 3), index, dtype=np.float32)
        views.append(StatisticsView(camera, color, depth[..., None], normal, np.ones((40, 40, 1))))
    result = compute(views, StatisticsOptions(best_views=4, include_self=False))[4]
    assert result["color_min"][20, 20, 0] == 0
    assert result["color_max"][20, 20, 0] == 3


def test_one_kernel_serves_all_views_and_any_number_of_them():
    import drjit as dr

    def large_kernels(num_views: int) -> set[str]:
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            compute(make_views(((19, 12), (14, 15)), num_views))
            history = dr.kernel_history([dr.KernelType.JIT])
        return {entry["hash"] for entry in history if entry["operation_count"] > 500}

    first, second = large_kernels(4), large_kernels(9)
    assert len(first) == 1
    assert second == first


def test_half_precision_input_is_accepted():
    views = make_views(num_views=4)
    halves = [
        replace(view, color=view.color.astype(np.float16), normal_world=view.normal_world.astype(np.float16))
        for view in views
    ]
    for full, half in zip(compute(views), compute(halves), strict=True):
        np.testing.assert_array_equal(full["observation_count"], half["observation_count"])
        np.testing.assert_allclose(full["color_median"], half["color_median"], atol=1e-3)


def test_bad_input_is_refused_with_every_fault_named():
    views = make_views(num_views=3)
    color = views[1].color.copy()
    color[0, 0, 1] = np.nan
    bad = [views[0], replace(views[1], color=color), replace(views[2], depth_z_m=views[2].depth_z_m[:-1])]
    with pytest.raises(InputError) as caught:
        compute_statistics(bad)
    assert [(p.where, p.field) for p in caught.value.problems] == [
        ("view_01", "color"),
        ("view_02", "depth_z_m"),
    ]
    with pytest.raises(InputError, match="no views"):
        compute_statistics([])
    with pytest.raises(InputError, match="scene to trace"):
        compute_statistics(views, StatisticsOptions(visibility=VisibilityOptions("trace")))


@pytest.mark.parametrize("arguments", [{"best_views": 3}, {"best_views": 25}])
def test_bad_options_are_refused(arguments):
    with pytest.raises(InputError, match=next(iter(arguments))):
        StatisticsOptions(**arguments)


@pytest.mark.parametrize("size", range(1, 25))
def test_sorting_network_sorts(size):
    rng = np.random.default_rng(size)
    values = rng.integers(0, 6, (200, size)).astype(float)
    expected = np.sort(values, axis=1)
    for low, high in sorting_network(size):
        a, b = values[:, low].copy(), values[:, high].copy()
        values[:, low], values[:, high] = np.minimum(a, b), np.maximum(a, b)
    np.testing.assert_array_equal(values, expected)

# SPDX-License-Identifier: MIT
"""Agreement of visibility by depth with visibility by rays on an imported scene."""

from __future__ import annotations

import pytest

from benchmarks.bench_statistics import (
    capture,
    measure_accuracy,
    measure_visibility,
    place_cameras,
    scene_from_file,
)

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


@pytest.mark.slow
def test_depth_and_rays_agree_on_a_real_scene(shared_data):
    """Depth and rays disagree on under 5 % of visible points in twelve views; statistics hardly differ."""
    scene, pose, up = scene_from_file(shared_data / "scenes" / "staircase" / "scene.xml")
    cameras = place_cameras(scene, pose, up, 12, 320, 192)
    views = [capture(scene, camera, f"view_{index}", True) for index, camera in enumerate(cameras)]
    difference = measure_visibility(views, scene)
    assert difference["pairs_seen_by_rays"] > 100_000
    assert difference["only_depth_sees_share"] < 0.02
    assert difference["only_rays_see_share"] < 0.03
    accuracy = measure_accuracy(views, scene)
    for statistic in ("minimum", "median", "maximum"):
        assert accuracy["depth_bilinear"][statistic] < 0.06
        difference = abs(accuracy["depth_bilinear"][statistic] - accuracy["trace_bilinear"][statistic])
        assert difference < 2e-3
    # nearest-pixel lookup creates false highlights, the reason for interpolating colours
    feigned = "share_with_false_range_over_0.3"
    assert accuracy["depth_bilinear"][feigned] < 0.5 * accuracy["depth_nearest"][feigned]

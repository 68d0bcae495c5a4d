# SPDX-License-Identifier: MIT
"""Projection and visibility of arbitrary points, by depth buffers and by shadow rays."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.errors import InputError
from datagen.multiview.visibility import PackedViews, VisibilityOptions, max_distance
from mitsuba_plugins.arrays import vectors_from_rows
from oracles.multiview_scenes import is_occluded, make_views, mitsuba_scene
from oracles.point_observations import observe_points

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def surface_points(seed: int = 3, count: int = 3000):
    """Return points (N, 3) on the floor and on the front of a box, and their normals (N, 3)."""
    rng = np.random.default_rng(seed)
    u, v = rng.random((2, count))
    floor = np.stack([-2 + 4 * u, -2.5 + 4 * v, np.zeros(count)], axis=-1)
    front = np.stack([-1.1 + 0.9 * u, np.full(count, -0.3), 1.1 * v], axis=-1)
    inside = ((floor[:, :2] > [-1.1, -0.3]) & (floor[:, :2] < [-0.2, 0.6])).all(axis=1)
    inside |= ((floor[:, :2] > [0.4, 0.1]) & (floor[:, :2] < [1.3, 0.9])).all(axis=1)
    floor = floor[~inside]
    points = np.concatenate([floor, front])
    normals = np.concatenate([np.tile([0.0, 0, 1], (len(floor), 1)), np.tile([0.0, -1, 0], (count, 1))])
    return points, normals


def exact_visibility(views, points, normals):
    visible = []
    for view in views:
        camera = view.camera
        pixels, z = camera.project(points)
        with np.errstate(invalid="ignore"):
            inside = (z > 0) & (pixels >= 0).all(-1) & (pixels < [camera.width_px, camera.height_px]).all(-1)
        faces = np.einsum("nc,nc->n", normals, camera.position_m - points) > 0
        centre = np.broadcast_to(camera.position_m, points.shape)
        visible.append(inside & faces & ~is_occluded(centre, points))
    return np.array(visible)


def test_traced_visibility_is_exact_and_depth_is_within_a_pixel_of_silhouettes():
    points, normals = surface_points()
    mismatch = []
    for size in ((120, 80), (240, 160), (480, 320)):
        views = make_views((size,))
        expected = exact_visibility(views, points, normals)
        packed = PackedViews([v.camera for v in views], [v.depth_z_m for v in views])
        by_depth = observe_points(packed, points, normals, VisibilityOptions("depth"))
        mismatch.append((by_depth.visible_mask != expected).mean())
    assert 0.1 < expected.mean() < 0.9
    # errors occur along silhouettes, so they halve with the pixel size, down to those within the tolerance
    assert mismatch[1] < 0.6 * mismatch[0] and mismatch[2] < 0.7 * mismatch[1] and mismatch[2] < 0.01
    traced = observe_points(packed, points, normals, VisibilityOptions("trace"), mitsuba_scene())
    assert (traced.visible_mask != expected).mean() < 2e-4  # within the tolerance of a shadow edge


def test_pixels_distance_and_cosine_equal_the_camera_model():
    views = make_views(((60, 40), (50, 45)))
    points, normals = surface_points(count=500)
    packed = PackedViews([v.camera for v in views], [v.depth_z_m for v in views])
    seen = observe_points(packed, points, normals)
    for index, view in enumerate(views):
        mask = seen.visible_mask[index]
        pixels, _ = view.camera.project(points)
        offset = view.camera.position_m - points
        distance = np.linalg.norm(offset, axis=-1)
        np.testing.assert_allclose(seen.pixels[index][mask], pixels[mask], atol=1e-3)
        np.testing.assert_allclose(seen.distance_m[index], distance, rtol=1e-5)
        cosine = np.einsum("nc,nc->n", normals, offset) / distance
        np.testing.assert_allclose(seen.cosine[index][mask], cosine[mask], atol=1e-5)
        assert np.isnan(seen.pixels[index][~mask]).all() and (seen.cosine[index][~mask] == 0).all()


@pytest.mark.parametrize("tilt_deg", [0, 60, 80, 88])
def test_slope_keeps_a_tilted_plane_visible(tilt_deg):
    """Without the slope term, points between pixel centres of a grazing plane would count as occluded."""
    camera = Camera(64, 64, 64.0, 64.0, 32.0, 32.0, look_at((0, 0, 0), (0, 1, 0)))
    tilt = np.deg2rad(tilt_deg)
    normal = np.array([0.0, -np.cos(tilt), np.sin(tilt)])
    pixel_rays = camera.unproject(camera.pixel_centers(), np.ones((64, 64)))
    through = np.array([0.0, 3.0, 0.0]) @ normal
    slanted = pixel_rays @ normal
    depth = np.where(slanted < -1e-3, through / np.where(slanted < -1e-3, slanted, 1), 0)
    depth = np.where(depth < 50, depth, 0)
    rng = np.random.default_rng(1)
    pixels = rng.uniform(24, 40, (2000, 2))
    rays = camera.unproject(pixels, np.ones(2000))
    z = through / (rays @ normal)
    points = rays * z[:, None]
    hit = (z > 0.1) & (z < 20)
    assert hit.sum() > 300
    normals = np.tile(normal, (2000, 1))
    packed = PackedViews([camera], [depth])
    options = VisibilityOptions(depth_tolerance=1e-3, slope_limit=1.0)
    seen = observe_points(packed, points[hit], normals[hit], options).visible_mask[0]
    flat = VisibilityOptions(depth_tolerance=1e-3, slope_limit=0.0)
    without = observe_points(packed, points[hit], normals[hit], flat).visible_mask[0]
    assert seen.mean() > 0.99
    assert tilt_deg < 60 or without.mean() < 0.9


@pytest.mark.parametrize("cosine", [0.9, 0.3, 0.1, 0.055])
def test_a_point_below_its_surface_is_visible_unless_occluded(cosine):
    """At any angle, a point 0.7 tolerances below its surface is visible and one at 1.5 tolerances is not. An
    occluder just in front of a point on the surface hides it."""
    import mitsuba as mi

    distance, tolerance = 4.0, 1e-3
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(20.0)}
    eye = np.array([0.0, -distance * np.sqrt(1 - cosine**2), distance * cosine])
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0, look_at(eye, (0, 0, 0), up=(1.0, 0.0, 0.0)))
    packed = PackedViews([camera], None)
    options = VisibilityOptions("trace", trace_tolerance=tolerance)
    normal = np.array([[0.0, 0.0, 1.0]])

    def is_seen(depth_m: float, scene: dict) -> bool:
        room = mi.load_dict({"type": "scene", **scene})
        return bool(observe_points(packed, -depth_m * normal, normal, options, room).visible_mask[0, 0])

    assert is_seen(0.7 * tolerance * distance, {"floor": floor})
    assert not is_seen(1.5 * tolerance * distance, {"floor": floor})
    # a pane across the line of sight, 4 % in front of the point
    pane = mi.ScalarTransform4f().look_at((0.04 * eye).tolist(), eye.tolist(), [1, 0, 0])
    assert not is_seen(0.0, {"pane": {"type": "rectangle", "to_world": pane}})


def test_an_occluder_is_not_overlooked_at_the_most_grazing_angles():
    """The tolerance shortens the shadow ray by at most a few per cent of its length."""
    import mitsuba as mi

    eye = np.array([0.0, -4.0, 4.0 * 1e-3])
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0, look_at(eye, (0, 0, 0), up=(1.0, 0.0, 0.0)))
    pane = mi.ScalarTransform4f().look_at((0.04 * eye).tolist(), eye.tolist(), [1, 0, 0])
    room = mi.load_dict({"type": "scene", "pane": {"type": "rectangle", "to_world": pane}})
    options = VisibilityOptions("trace", trace_tolerance=1e-3)
    origin, up = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
    packed = PackedViews([camera], None)
    assert not observe_points(packed, origin, up, options, room).visible_mask[0, 0]
    empty = mi.load_dict({"type": "scene"})
    assert observe_points(packed, origin, up, options, empty).visible_mask[0, 0]


def test_points_behind_outside_and_facing_away_are_not_seen():
    camera = Camera(10, 10, 10.0, 10.0, 5.0, 5.0, look_at((0, 0, 0), (0, 1, 0)))
    packed = PackedViews([camera], [np.full((10, 10), 2.0)])
    points = [(0, 2, 0), (0, -2, 0), (3, 2, 0), (0, 2, 0), (0, 2.5, 0), (0, 1.5, 0)]
    normals = [(0, -1, 0), (0, -1, 0), (0, -1, 0), (0, 1, 0), (0, -1, 0), (0, -1, 0)]
    seen = observe_points(packed, np.array(points), np.array(normals))
    assert seen.visible_mask[0].tolist() == [True, False, False, False, False, False]


def test_the_image_ends_at_the_outer_edge_of_its_last_pixel():
    """Points exactly on the left or top border of an image are visible, on the right or bottom border not."""
    camera = Camera(10, 10, 10.0, 10.0, 5.0, 5.0, look_at((0, 0, 0), (0, 1, 0)))
    packed = PackedViews([camera, camera], [np.full((10, 10), 2.0)] * 2)
    points = np.array([(-1, 2, 0), (1, 2, 0), (0, 2, 1), (0, 2, -1)])
    pixels, _ = camera.project(points)
    np.testing.assert_array_equal(pixels, [(0, 5), (10, 5), (5, 0), (5, 10)])
    seen = observe_points(packed, points, np.tile([0.0, -1.0, 0.0], (4, 1)))
    assert seen.visible_mask[0].tolist() == [True, False, True, False]


@pytest.mark.parametrize("farthest", [0, 1, 2])
def test_the_farthest_camera_is_found_at_any_index(farthest):
    """All cameras are far from the origin, so zeros read beyond their list would give a farther camera."""
    import mitsuba as mi

    centres = np.array([[40.0, 41.0, 40.0], [40.0, 40.0, 42.0], [41.0, 41.0, 40.0]])
    centres[farthest, 0] += 9.0
    poses = [look_at(centre, (60.0, 40.0, 40.0)) for centre in centres]
    packed = PackedViews([Camera(4, 4, 4.0, 4.0, 2.0, 2.0, pose) for pose in poses], None)
    points = np.array([[40.0, 40.0, 41.0], [42.0, 39.0, 40.0]])
    found = max_distance(packed, mi.Point3f(vectors_from_rows(points)))
    expected = np.linalg.norm(centres[:, None] - points, axis=-1).max(axis=0)
    np.testing.assert_allclose(np.array(found), expected, rtol=1e-6)


def test_bad_input_is_refused():
    camera = Camera(10, 10, 10.0, 10.0, 5.0, 5.0, np.eye(4))
    with pytest.raises(InputError, match="like its camera"):
        PackedViews([camera], [np.zeros((5, 10))])
    with pytest.raises(InputError, match="NaN or Inf"):
        PackedViews([camera], [np.full((10, 10), np.inf)])
    with pytest.raises(InputError, match="one per camera"):
        PackedViews([camera], [])
    with pytest.raises(InputError, match="mode"):
        VisibilityOptions("raster")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="depth_tolerance"):
        VisibilityOptions(depth_tolerance=-1.0)
    packed = PackedViews([camera], None)
    with pytest.raises(ValueError, match="depth buffers"):
        observe_points(packed, np.zeros((1, 3)), np.ones((1, 3)))
    with pytest.raises(ValueError, match="scene"):
        observe_points(packed, np.zeros((1, 3)), np.ones((1, 3)), VisibilityOptions("trace"))

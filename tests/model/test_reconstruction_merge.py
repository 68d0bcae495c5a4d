# SPDX-License-Identifier: MIT
"""The merge against brute force on noise, and the atlas of a known textured room from its views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.foundation.errors import InputError
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import TracedGeometry, face_normals, seen_sides, smooth_regions
from datagen.multiview.visibility import VisibilityOptions
from model.reconstruction.atlas.atlas import empty_atlas
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.merge.lane_sort import LANES, STEP, networks, sort_lanes, sort_weighted_lanes
from model.reconstruction.merge.merger import MapMerger, MapView, MergeOptions, pixels_per_metre
from model.reconstruction.merge.weights import Weights
from oracles.textured_room import geometry_of, materials_at, room_cameras, room_mesh, uv_of_pixels, view_maps

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
SMALL = (33, 26)


def noise_views(mesh: Mesh, num: int) -> list[MapView]:
    """Views with white noise as maps, which reveals wrong lookups."""
    rng = np.random.default_rng(1)
    views = []
    for camera in room_cameras(num, SMALL):
        shape = (camera.height_px, camera.width_px)
        maps = {
            name: rng.random((*shape, c)).astype(np.float32)
            for name, c in (("diffuse_albedo", 3), ("specular_albedo", 3), ("roughness", 1))
        }
        depth = uv_of_pixels(mesh, camera)[1][..., None].astype(np.float32)
        views.append(MapView(camera, maps, depth))
    return views


def surface_under(mesh: Mesh, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face (N, N), point and normal (N, N, 3) at each texel's centre, in float64 over all triangles."""
    assert mesh.uv is not None
    column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    uv = np.stack([column / size, 1 - row / size], axis=-1)
    face_of = np.full((size, size), -1)
    points, normals = np.zeros((size, size, 3)), np.zeros((size, size, 3))
    for index, face in enumerate(mesh.faces):
        a, b, c = mesh.uv[face].astype(np.float64)
        matrix = np.linalg.inv(np.stack([b - a, c - a], axis=1))
        s, t = np.moveaxis((uv - a) @ matrix.T, -1, 0)
        inside = (s >= 0) & (t >= 0) & (s + t <= 1)
        p, q, r = mesh.positions[face].astype(np.float64)
        at = p + s[..., None] * (q - p) + t[..., None] * (r - p)
        normal = np.cross(q - p, r - p)
        face_of[inside] = index
        points[inside] = at[inside]
        normals[inside] = normal / np.linalg.norm(normal)
    return face_of, points, normals


def fetched(
    view: MapView, u: float, v: float, z: float, region: float, options: MergeOptions, regions: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray]:
    """A view's seven channels at pixel (u, v), or None if no surface matches, and its confidences (3,)."""
    maps = np.concatenate([view.maps[k] for k in ("diffuse_albedo", "specular_albedo", "roughness")], axis=-1)
    confidence = np.ones((*maps.shape[:2], 3)) if view.confidence is None else view.confidence
    height, width = maps.shape[:2]
    x, y = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
    see, values, worth, total = options.visibility, np.zeros(7), np.zeros(3), 0.0
    for row in (int(y), min(int(y) + 1, height - 1)):
        for column in (int(x), min(int(x) + 1, width - 1)):
            share = max(0.0, 1 - abs(column - x)) * max(0.0, 1 - abs(row - y))
            face = -1 if view.face is None else view.face[row, column]
            is_same = view.face is None or (face >= 0 and regions[face] == region)
            is_near = abs(view.depth_z_m[row, column, 0] - z) <= z * (see.depth_tolerance + see.slope_limit)
            if is_same and is_near:
                values += share * maps[row, column]
                worth += share * confidence[row, column]
                total += share
    return (None, worth) if total <= 1e-3 else (values / total, worth / total)


def pixel_weights(view: MapView, options: MergeOptions) -> np.ndarray:
    """Weights (H, W, 3) of a view's D, S, R by pixel, for a median resolution of 1 pixel per metre."""
    found = np.ones(view_shape(view))
    if options.weights != "none":
        found *= distance_to_border(view)[..., None]
    if options.weights == "confidence" and view.confidence is not None:
        found *= np.maximum(view.confidence, 1e-3)
    if options.weights == "resolution" and view.confidence is not None and view.resolution is not None:
        found *= np.where(view.resolution > 0, view.resolution, 1)[..., None] ** (2 * view.confidence)
    return found


def mean_of_middle(values: np.ndarray, weights: np.ndarray) -> float:
    """Weighted mean of the sorted values within the middle half of their cumulative weight."""
    order = np.argsort(values)
    ends = np.cumsum(weights[order]) / weights.sum()
    inside = np.diff(np.clip(np.concatenate([[0.0], ends]), 0.25, 0.75))
    return float((values[order] * inside).sum() / inside.sum())


def distance_to_border(view: MapView) -> np.ndarray:
    """Weights (H, W) of a view by brute force: relative distance to the nearest pixel outside of the image,
    without surface, or at a depth discontinuity, in [1e-3, 1]."""
    depth = view.depth_z_m[..., 0]
    is_border = np.pad(depth <= 0, 1, constant_values=True)
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            for other in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
                if 0 <= other[0] < depth.shape[0] and 0 <= other[1] < depth.shape[1]:
                    here, there = depth[row, column], depth[other]
                    is_border[row + 1, column + 1] |= abs(here - there) > 0.055 * max(here, there)
    borders = np.argwhere(is_border)
    places = np.stack(np.indices(depth.shape), axis=-1).reshape(-1, 1, 2) + 1
    distance = np.linalg.norm(places - borders[None], axis=2).min(axis=1).reshape(depth.shape)
    return np.asarray(np.clip(distance / (0.1 * np.hypot(*depth.shape)), 1e-3, 1))


def brute_force(
    mesh: Mesh, views: list[MapView], size: int, options: MergeOptions
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Merged channels (N, N, 7), counts and faces (N, N), and mask of ambiguous texels, by float64 loops."""
    face_of, points, normals = surface_under(mesh, size)
    regions = smooth_regions(mesh)
    views = [replace(view, confidence=pixel_weights(view, options)) for view in views]
    medians, counts = np.zeros((size, size, 7)), np.zeros((size, size), int)
    is_close = np.zeros((size, size), bool)
    for row, column in np.argwhere(face_of >= 0):
        p, n = points[row, column], normals[row, column]
        values, weights = [], []
        for view in views:
            camera = view.camera
            (u, v), z = camera.project(p)
            facing = float(n @ (camera.position_m - p))
            if z <= 0 or not (0 <= u < camera.width_px and 0 <= v < camera.height_px):
                is_close[row, column] |= z > 0 and bool(
                    min(abs(u), abs(v), abs(u - camera.width_px), abs(v - camera.height_px)) < 1e-3
                )
                continue
            is_close[row, column] |= min(u % 1, 1 - u % 1, v % 1, 1 - v % 1) < 1e-3
            if facing <= 0:
                continue
            seen = float(view.depth_z_m[int(v), int(u), 0])
            local = camera.camera_from_world[:3, :3] @ n
            step = abs(local[0]) / camera.fx_px + abs(local[1]) / camera.fy_px
            gap = abs(seen - z) - z * (options.visibility.depth_tolerance + min(step * z / facing, 0.05))
            is_close[row, column] |= abs(gap) < 1e-4
            if gap > 0:
                continue
            found, confidence = fetched(view, u, v, z, regions[face_of[row, column]], options, regions)
            if found is None:
                continue
            values.append(found)
            weights.append(confidence[[0, 0, 0, 1, 1, 1, 2]])
        counts[row, column] = len(values)
        if values:
            stacked, heavy = np.array(values, np.float64), np.array(weights)
            medians[row, column] = [mean_of_middle(stacked[:, c], heavy[:, c]) for c in range(7)]
            if options.weights == "none":
                medians[row, column] = np.median(stacked, axis=0)
    return medians, counts, face_of, is_close


@pytest.mark.parametrize("num_views", [1, 9])
def test_equals_brute_force(num_views: int) -> None:
    mesh, size = room_mesh(), 40
    views = noise_views(mesh, num_views)
    options = MergeOptions(tile=17)
    expected, counts, faces, is_close = brute_force(mesh, views, size, options)
    merger = MapMerger(views, options)
    atlas = empty_atlas(size)
    merger.merge(TexelSurface(mesh, face_normals(mesh), size), atlas)
    sure = ~is_close
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(atlas.face, faces)
    np.testing.assert_array_equal(atlas.count[sure], counts[sure])
    got = np.concatenate(list(atlas.maps.values()), axis=-1).astype(np.float64)
    limit = 2.0**-11  # half floats in [0.5, 1], and the mean of two float32
    assert np.abs(got - expected)[sure].max() <= limit * 1.001
    assert len(np.unique(counts[sure])) > num_views / 2  # odd and even counts, none and many
    wrong = np.abs(got * 1.05 - expected)[sure & (counts > 0)]
    assert wrong.max() > limit


@pytest.mark.parametrize("weights", ["none", "borders", "resolution", "confidence"])
def test_between_pixels_and_with_weights_equals_brute_force(weights: Weights) -> None:
    """Noise maps on the views' real geometry: depths, regions and weights matter at every texel."""
    mesh, size = room_mesh(), 40
    rng = np.random.default_rng(3)
    views = [
        replace(
            view,
            face=seen.face,
            depth_z_m=seen.depth_z_m,
            confidence=rng.random(view_shape(view)),
            resolution=resolutions(view, rng),
        )
        for view, seen in zip(noise_views(mesh, 12), traced_views(mesh, 12, SMALL), strict=True)
    ]
    options = MergeOptions(weights=weights)
    expected, counts, _, is_close = brute_force(mesh, views, size, options)
    atlas = empty_atlas(size)
    MapMerger(views, options, None, smooth_regions(mesh)).merge(
        TexelSurface(mesh, face_normals(mesh), size), atlas
    )
    sure = ~is_close
    np.testing.assert_array_equal(atlas.count[sure], counts[sure])
    got = np.concatenate(list(atlas.maps.values()), axis=-1).astype(np.float64)
    error = np.abs(got - expected)[sure]
    assert error.max() <= 2.0**-11 * 1.001


def resolutions(view: MapView, rng: np.random.Generator) -> np.ndarray:
    """Random resolutions (H, W), partly 0, with a median of 1 over the others."""
    found = np.exp(rng.normal(0, 1, view_shape(view)[:2]))
    found[1::8] = 0
    return np.asarray(found / np.median(found[found > 0]))


def view_shape(view: MapView) -> tuple[int, int, int]:
    return view.camera.height_px, view.camera.width_px, 3


@pytest.mark.parametrize("num", [1, 2, 3, 7, 30, 161])
def test_lists_are_sorted_with_their_weights(num: int) -> None:
    rng = np.random.default_rng(num)
    comparisons, starts = networks(num)
    rows = -(-num // STEP) * STEP
    values = np.full((rows, LANES), np.inf, np.float32)
    values[:num] = rng.integers(0, 20, (num, LANES))
    weights = rng.random((rows, LANES)).astype(np.float32)
    sorted_values, sorted_too, sorted_weights = values.copy(), values.copy(), weights.copy()
    network = comparisons[starts[rows // STEP] : starts[rows // STEP + 1]]
    sort_lanes(sorted_values, network)
    sort_weighted_lanes(sorted_too, sorted_weights, network)
    np.testing.assert_array_equal(sorted_values, np.sort(values, axis=0))
    np.testing.assert_array_equal(sorted_too, sorted_values)
    for lane in (0, LANES - 1):
        pairs = sorted(zip(values[:, lane], weights[:, lane], strict=True))
        again = sorted(zip(sorted_too[:, lane], sorted_weights[:, lane], strict=True))
        assert pairs == again


def test_no_texel_falls_between_triangles() -> None:
    """In a square of 800 random triangles every texel belongs to a triangle, to the same one in tiles as in
    the whole, and to two only on shared edges. Moving a vertex of one triangle leaves a gap."""
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21)), axis=-1)
    grid[1:-1, 1:-1] += rng.uniform(-0.012, 0.012, (19, 19, 2))
    index = np.arange(441).reshape(21, 21)
    p, q, r, t = (
        index[a, b].ravel() for a, b in (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, 1:], np.s_[1:, :-1])
    )
    faces = np.concatenate([np.stack([p, q, r], -1), np.stack([p, t, r], -1)]).astype(np.int32)
    uv = grid.reshape(-1, 2).astype(np.float32)
    mesh = Mesh(np.pad(uv, ((0, 0), (0, 1))), faces, None, uv)
    size = 600
    surface = TexelSurface(mesh, face_normals(mesh), size)
    whole = surface.faces(0, 0, size, size)
    assert (whole >= 0).all()
    parts = [[surface.faces(x, y, 200, 300) for x in (0, 200, 400)] for y in (0, 300)]
    np.testing.assert_array_equal(np.block(parts), whole)
    assert surface.overlaps()[1].mean() < 1e-3
    points = surface.points(whole, 0, 0)[0]
    np.testing.assert_allclose(points[..., :2], texel_uv(size), atol=1e-6)
    torn = Mesh(mesh.positions[faces.ravel()], np.arange(len(faces) * 3, dtype=np.int32).reshape(-1, 3), None,
                uv[faces.ravel()])  # fmt: skip
    assert torn.uv is not None
    torn.uv[3 * 210] += 0.004
    assert (TexelSurface(torn, face_normals(torn), size).faces(0, 0, size, size) < 0).any()


def test_tile_size_does_not_matter() -> None:
    mesh, size = room_mesh(), 30
    views = noise_views(mesh, 5)
    surface = TexelSurface(mesh, face_normals(mesh), size)
    results = []
    for tile in (7, 64):
        atlas = empty_atlas(size)
        MapMerger(views, MergeOptions(tile=tile)).merge(surface, atlas)
        results.append(atlas)
    for name, array in results[0].maps.items():
        np.testing.assert_array_equal(array, results[1].maps[name])
    np.testing.assert_array_equal(results[0].count, results[1].count)


def traced_views(mesh: Mesh, num: int = 10, size: tuple[int, int] = (96, 72)) -> list[MapView]:
    traced = TracedGeometry(geometry_of(mesh))
    views = []
    for camera in room_cameras(num, size):
        seen = traced.trace_view(camera)
        views.append(MapView(camera, view_maps(mesh, camera), seen.depth_z_m, seen.face))
    return views


def test_no_seam_where_a_view_ends() -> None:
    """For inconsistent views and weights that fade at borders, merged D is between the views' values and
    changes gradually where the set of views changes, unlike for medians and equal weights."""
    mesh, size = room_mesh(), 128
    traced = TracedGeometry(geometry_of(mesh))
    views = [
        replace(
            view,
            maps={name: np.full_like(m, 0.2 + 0.05 * number) for name, m in view.maps.items()},
            confidence=np.ones(view_shape(view), np.float32),
            resolution=pixels_per_metre(view.camera, traced.trace_view(view.camera)),
        )
        for number, view in enumerate(traced_views(mesh, 8))
    ]
    found = {}
    for weights in ("none", "borders", "resolution"):
        atlas = empty_atlas(size)
        options = MergeOptions(weights=weights)  # type: ignore[arg-type]
        MapMerger(views, options, None, smooth_regions(mesh)).merge(
            TexelSurface(mesh, face_normals(mesh), size), atlas
        )
        is_both = (atlas.count[1:] > 0) & (atlas.count[:-1] > 0) & (atlas.face[1:] == atlas.face[:-1])
        changes = is_both & (atlas.count[1:] != atlas.count[:-1])
        merged = atlas.maps["diffuse_albedo"][..., 0].astype(np.float64)
        found[weights] = np.abs(np.diff(merged, axis=0))[changes].mean()
        assert merged[atlas.count > 0].min() > 0.199 and merged[atlas.count > 0].max() < 0.551
        assert changes.sum() > 300
    assert found["borders"] < 1 / 3 * found["none"], found
    assert found["resolution"] < 0.4 * found["none"], found  # fewer views share a texel's weight


def test_resolution_is_that_of_the_coarser_axis() -> None:
    """Pixels per metre at image centres are 1000 times the smallest displacement (px) of a surface point that
    moves by a millimetre in any tangential direction."""
    mesh = room_mesh()
    traced = TracedGeometry(geometry_of(mesh))
    cosines = []
    for camera in room_cameras(10, (97, 73)):
        seen = traced.trace_view(camera)
        row, column = 36, 48
        normal = seen.normal_world[row, column].astype(np.float64)
        ray = camera.ray_directions()[row, column]
        point = camera.position_m + ray * seen.depth_z_m[row, column, 0] / (ray @ camera.forward)
        first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        start = np.array(camera.project(point)[0])
        moved = [
            np.linalg.norm(
                np.array(camera.project(point + 1e-3 * (np.cos(a) * first + np.sin(a) * second))[0]) - start
            )
            for a in np.linspace(0, np.pi, 181)
        ]
        found = pixels_per_metre(camera, seen)[row, column]
        assert found == pytest.approx(1000 * min(moved), rel=0.02)
        cosines.append(-normal @ ray)
    assert min(cosines) < 0.7


def test_exact_maps_keep_their_texture() -> None:
    """With few fine views and many coarse ones, weights by resolution reduce the error of confident maps, and
    change nothing without confidence."""
    mesh, size = room_mesh(), 128
    traced = TracedGeometry(geometry_of(mesh))
    truth = materials_at(texel_uv(size))
    atlases = {}
    for weights, confidence in (("borders", 1), ("resolution", 1), ("resolution", 0)):
        views = [
            replace(
                view,
                confidence=np.full(view_shape(view), confidence, np.float32),
                resolution=pixels_per_metre(view.camera, traced.trace_view(view.camera)),
            )
            for view in traced_views(mesh, 4) + traced_views(mesh, 8, (24, 18))
        ]
        atlas = empty_atlas(size)
        options = MergeOptions(weights=weights)  # type: ignore[arg-type]
        MapMerger(views, options, None, smooth_regions(mesh)).merge(
            TexelSurface(mesh, face_normals(mesh), size), atlas
        )
        atlases[weights, confidence] = atlas.maps["diffuse_albedo"].astype(np.float64)
    many = atlas.count >= 3
    error = {key: np.mean((found - truth["diffuse_albedo"])[many] ** 2) for key, found in atlases.items()}
    assert error["resolution", 1] < 0.7 * error["borders", 1], error
    np.testing.assert_array_equal(atlases["resolution", 0], atlases["borders", 1])


def texel_uv(size: int) -> np.ndarray:
    column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    return np.stack([column / size, 1 - row / size], axis=-1)


@pytest.mark.parametrize("mode", ["depth", "trace"])
def test_ground_truth_maps_reproduce_the_atlas(mode: str) -> None:
    """The median over views, each interpolated between pixels h apart, of a wave of period p = 3.6 m or less
    errs by at most h^2/8 (2 pi/p)^2 A, A = 0.3; the median excludes grazing views, where h grows. h is 0.05 m
    for pixels 3 m away at 60 degrees; that is 0.3 * 0.0009 / p^2 * 5 = 1e-3 on the large walls and up to
    0.008 on the block's sides (p = 0.7 m)."""
    mesh, size = room_mesh(), 128
    views = traced_views(mesh)
    options = MergeOptions(visibility=VisibilityOptions(mode=mode))  # type: ignore[arg-type]
    merger = MapMerger(views, options, TracedGeometry(geometry_of(mesh)).scene, smooth_regions(mesh))
    atlas = empty_atlas(size)
    merger.merge(TexelSurface(mesh, face_normals(mesh), size), atlas)
    truth = materials_at(texel_uv(size))
    enough = atlas.count >= 3
    assert enough.sum() > 0.35 * (atlas.face >= 0).sum()
    for name, array in atlas.maps.items():
        error = np.abs(array.astype(np.float64) - truth[name])[enough]
        assert np.median(error) < 1e-3, name
        assert np.quantile(error, 0.99) < 0.02, name
        worse = np.abs(array.astype(np.float64) * 1.05 - truth[name])[enough]
        assert np.median(worse) > 1e-3, name
    bottom = np.isin(atlas.face, [20, 21])  # covered by the block
    assert bottom.any() and not atlas.count[bottom].any()


def test_depth_and_traced_visibility_agree_except_at_edges() -> None:
    mesh, size = room_mesh(), 64
    views = traced_views(mesh, 8)
    counts = []
    for mode in ("depth", "trace"):
        atlas = empty_atlas(size)
        options = MergeOptions(visibility=VisibilityOptions(mode=mode))  # type: ignore[arg-type]
        MapMerger(views, options, TracedGeometry(geometry_of(mesh)).scene, smooth_regions(mesh)).merge(
            TexelSurface(mesh, face_normals(mesh), size), atlas
        )
        counts.append(atlas.count.astype(int))
    differing = counts[0] != counts[1]
    assert differing[counts[1] > 0].mean() < 0.12


def test_geometry_of_views() -> None:
    mesh = room_mesh()
    traced = TracedGeometry(geometry_of(mesh))
    camera = room_cameras(2)[1]
    view = traced.trace_view(camera)
    expected = uv_of_pixels(mesh, camera)[1]
    np.testing.assert_allclose(view.depth_z_m[..., 0], expected, rtol=2e-5)
    assert view.is_front.all()
    toward = (view.normal_world * camera.ray_directions()).sum(axis=-1)
    assert (toward < 0).all()
    valid = np.zeros(expected.shape, bool)
    valid[:10] = True
    masked = traced.trace_view(camera, valid)
    assert (masked.depth_z_m[..., 0] > 0)[:10].all() and not masked.depth_z_m[10:].any()


def test_wrong_winding_is_recognised() -> None:
    mesh = room_mesh()
    faces = mesh.faces.copy()
    flipped = np.arange(0, len(faces), 3)
    faces[flipped] = faces[flipped][:, [0, 2, 1]]
    traced = TracedGeometry(geometry_of(Mesh(mesh.positions, faces, mesh.normals, mesh.uv)))
    views = [traced.trace_view(camera) for camera in room_cameras(10)]
    sides = seen_sides(views, len(faces))
    seen = np.unique(np.concatenate([view.face.ravel() for view in views]))
    expected = np.ones(len(faces))
    expected[flipped] = -1
    np.testing.assert_array_equal(sides[seen], expected[seen])
    assert len(seen) >= 21
    turned = face_normals(Mesh(mesh.positions, faces), sides)
    np.testing.assert_allclose(turned[seen], face_normals(mesh)[seen], atol=1e-6)


def test_meshes_of_many_triangles_may_have_few_regions() -> None:
    """Region numbers are float32, which is exact below 2^24, for any number of triangles."""
    views = noise_views(room_mesh(), 1)
    MapMerger(views, region_of_face=np.zeros(2**24, np.int8))
    with pytest.raises(ValueError, match="fewer regions"):
        MapMerger(views, region_of_face=np.array([2**24]))


def test_bad_maps_are_refused() -> None:
    mesh = room_mesh()
    (view,) = noise_views(mesh, 1)
    view.maps["roughness"][3, 3] = np.nan
    broken = MapView(
        view.camera, {**view.maps, "diffuse_albedo": view.maps["roughness"]}, view.depth_z_m, name="v7"
    )
    with pytest.raises(InputError, match="a confidence for every view"):
        MapMerger(noise_views(mesh, 1), MergeOptions(weights="confidence"))
    broken = replace(broken, resolution=np.ones((2, 2)))
    with pytest.raises(InputError) as caught:
        MapMerger([broken])
    assert "v7: diffuse_albedo" in str(caught.value) and "roughness = NaN" in str(caught.value)
    assert "v7: resolution" in str(caught.value)

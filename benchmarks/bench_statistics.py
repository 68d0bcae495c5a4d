# SPDX-License-Identifier: MIT
"""Speed of the multi-view statistics, and the accuracy of their options.

    python -m benchmarks.bench_statistics                       speed, relative to the vectorised NumPy oracle
    python -m benchmarks.bench_statistics --scene S/scene.xml   the same on a Mitsuba scene, and accuracy

Speed: 40 views of 640x384, statistics of the 12 best views; kernels and oracle run in turn on the same views.
Growth: seconds per view for 10, 20, 40 and 80 views, in turn, with a straight line fitted. Accuracy (for a
scene with textures): colours are the diffuse reflectance, which does not depend on the view direction, so
minimum, median and maximum should equal the pixel's colour; the depth test is compared with shadow rays.

Prints JSON with medians and interquartile ranges, and writes it to --out.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.timing import machine, summary, timed, write_report
from datagen.foundation.cameras import Camera, look_at
from datagen.multiview.statistics import StatisticsOptions, StatisticsView, compute_statistics, has_surface
from datagen.multiview.visibility import PackedViews, VisibilityOptions
from mitsuba_plugins.variant import select_variant
from oracles.point_observations import observe_points
from oracles.statistics import OracleOptions, statistics_vectorized


def furnished_room():
    """Make a room with at most thirty boxes; returns it, a camera's pose (4, 4) and the up axis (3,)."""
    import mitsuba as mi

    rng = np.random.default_rng(7)
    to_world = mi.ScalarTransform4f().translate([0, 0, 1.5]).scale([3, 3, 1.5])
    scene = {"type": "scene", "room": {"type": "cube", "to_world": to_world, "flip_normals": True}}
    for index in range(30):
        half = rng.uniform(0.1, 0.5, 3)
        centre = np.append(rng.uniform(-2.6, 2.6, 2), half[2])
        if np.linalg.norm(centre[:2] - [0, -2.5]) < 1:
            continue
        box = mi.ScalarTransform4f().translate(centre.tolist()).scale(half.tolist())
        scene[f"box_{index}"] = {"type": "cube", "to_world": box}
    return mi.load_dict(scene), look_at((0, -2.5, 1.6), (0, 1, 0.8)), np.array([0.0, 0.0, 1.0])


def scene_from_file(path: Path):
    """Load a Mitsuba scene; returns it, its first sensor's pose (4, 4) and the axis (3,) nearest to up."""
    import mitsuba as mi

    scene = mi.load_file(str(path))
    pose = np.array(scene.sensors()[0].world_transform().matrix, dtype=np.float64).reshape(4, 4)
    up = np.eye(3)[np.abs(pose[:3, 1]).argmax()]
    return scene, look_at(pose[:3, 3], pose[:3, 3] + pose[:3, 2], up), up


def first_hits(scene, camera: Camera, jitter: tuple[float, float] = (0.5, 0.5)):
    """Hits and rays at the position ``jitter`` in [0, 1]^2 of each pixel, and depth along z [m], (H * W,)."""
    import drjit as dr
    import mitsuba as mi

    pixels = camera.pixel_centers() - 0.5 + np.array(jitter)
    rays = camera.unproject(pixels, np.ones(pixels.shape[:2])) - camera.position_m
    lengths = np.linalg.norm(rays, axis=-1)
    directions = (rays / lengths[..., None]).reshape(-1, 3).T.astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(camera.position_m.tolist()), mi.Vector3f(np.ascontiguousarray(directions)))
    si = scene.ray_intersect(ray)
    depth = dr.select(si.is_valid(), si.t, 0).numpy() / lengths.ravel()
    return si, ray, depth


def capture(scene, camera: Camera, name: str, is_textured: bool) -> StatisticsView:
    """View of exact buffers; colour: mean reflectance of 4x4 positions if ``is_textured``, else a pattern."""
    import drjit as dr
    import mitsuba as mi

    shape = (camera.height_px, camera.width_px)
    si, ray, depth = first_hits(scene, camera)
    normal = dr.select(dr.dot(si.sh_frame.n, ray.d) > 0, -si.sh_frame.n, si.sh_frame.n)
    normal = dr.select(si.is_valid(), normal, 0).numpy().T.reshape(*shape, 3)
    if is_textured:
        color = np.zeros((*shape, 3))
        for step in range(16):
            si, _, _ = first_hits(scene, camera, ((step % 4 + 0.5) / 4, (step // 4 + 0.5) / 4))
            value = si.bsdf().eval_diffuse_reflectance(si, si.is_valid())
            color += dr.select(si.is_valid(), value, 0).numpy().T.reshape(*shape, 3) / 16
    else:
        pattern = mi.Vector3f(dr.sin(9 * si.p.x), dr.sin(11 * si.p.y), dr.sin(7 * si.p.z))
        color = dr.select(si.is_valid(), 0.5 + 0.4 * pattern, 0).numpy().T.reshape(*shape, 3)
    depth = depth.reshape(*shape, 1).astype(np.float32)
    mask = (depth > 0).astype(np.float32)
    return StatisticsView(camera, color.astype(np.float32), depth, normal, mask, name)


def place_cameras(
    scene, base: np.ndarray, up: np.ndarray, count: int, width: int, height: int
) -> list[Camera]:
    """Place ``count`` cameras at and around the pose ``base`` (4, 4), directed at points visible from it."""
    import mitsuba as mi

    rng = np.random.default_rng(0)
    focal = 0.5 * width / np.tan(np.deg2rad(60) / 2)

    def camera(pose: np.ndarray) -> Camera:
        return Camera(width, height, focal, focal, width / 2, height / 2, pose)

    cameras = [camera(base)]
    _, _, depth = first_hits(scene, cameras[0])
    points = cameras[0].unproject(cameras[0].pixel_centers().reshape(-1, 2), depth)[depth > 0]
    scale = float(np.median(depth[depth > 0]))
    spread = 0.5 * scale * (1 - 0.5 * up)
    while len(cameras) < count:
        position = base[:3, 3] + rng.uniform(-1, 1, 3) * spread
        target = points[rng.integers(len(points))]
        step = position - base[:3, 3]
        length = float(np.linalg.norm(step))
        ray = mi.Ray3f(mi.Point3f(base[:3, 3].tolist()), mi.Vector3f((step / length).tolist()))
        ray.maxt = mi.Float(length)  # type: ignore[assignment]  # Mitsuba's stubs
        if scene.ray_test(ray)[0] or np.linalg.norm(target - position) < 0.3 * scale:
            continue
        candidate = camera(look_at(position, target, up))
        _, _, depth = first_hits(scene, candidate.scaled(width // 8, height // 8))
        if (depth > 0).mean() > 0.7 and np.percentile(depth[depth > 0], 5) > 0.1 * scale:
            cameras.append(candidate)
    return cameras


def seconds_per_view(views: list[StatisticsView], options: StatisticsOptions, scene=None) -> float:
    """Wall seconds per view of the statistics, including packing, upload, kernels and download."""
    return timed(lambda: list(compute_statistics(views, options, scene))).wall / len(views)


def measure_speed(views: list[StatisticsView], scene, repeats: int) -> dict:
    options = StatisticsOptions()
    traced = StatisticsOptions(visibility=VisibilityOptions("trace"))
    seconds: dict[str, list[float]] = {"kernel": [], "kernel_trace": [], "oracle": [], "ratio": []}
    first = 2 * seconds_per_view(views[:2], options)
    seconds_per_view(views[:2], traced, scene)
    for repeat in range(repeats):
        seconds["kernel"].append(seconds_per_view(views, options))
        oracle = partial(statistics_vectorized, views, repeat % len(views), OracleOptions())
        seconds["oracle"].append(timed(oracle).wall)
        seconds["ratio"].append(seconds["oracle"][-1] / seconds["kernel"][-1])
        seconds["kernel_trace"].append(seconds_per_view(views, traced, scene))
    return {"first_two_views_with_compilation_s": first} | {k: summary(v) for k, v in seconds.items()}


def measure_growth(views: list[StatisticsView], repeats: int) -> dict:
    numbers = [n for n in (10, 20, 40, 80) if n <= len(views)]
    seconds: dict[int, list[float]] = {n: [] for n in numbers}
    for _ in range(repeats):
        for n in numbers:
            seconds[n].append(seconds_per_view(views[:n], StatisticsOptions()))
    medians = [float(np.median(seconds[n])) for n in numbers]
    slope, intercept = np.polyfit(numbers, medians, 1)
    residual = np.array(medians) - (slope * np.array(numbers) + intercept)
    r_squared = 1 - residual.var() / np.var(medians)
    exponent = np.polyfit(np.log(numbers), np.log(medians), 1)[0]
    return {
        "seconds_a_view": {str(n): summary(seconds[n]) for n in numbers},
        "line": {"seconds": float(intercept), "seconds_a_source_view": float(slope), "r2": float(r_squared)},
        "log_log_exponent": float(exponent),
    }


def measure_visibility(views: list[StatisticsView], scene) -> dict:
    """Number of pairs (surface point, other view) that are visible by shadow rays; and the pairs visible only
    by the depth test, and only by shadow rays, as shares of that number.
    """
    packed = PackedViews([view.camera for view in views], [view.depth_z_m for view in views])
    rng = np.random.default_rng(1)
    traced_count, extra, missed = 0, 0, 0
    for index in range(0, len(views), max(1, len(views) // 8)):
        view = views[index]
        pixels = rng.permutation(np.argwhere(has_surface(view.depth_z_m, view.surface_mask)))[:30_000]
        rows, columns = pixels.T
        centres = np.stack([columns, rows], axis=-1) + 0.5
        points = view.camera.unproject(centres, view.depth_z_m[rows, columns, 0])
        normals = view.normal_world[rows, columns]
        by_depth = observe_points(packed, points, normals).visible_mask
        traced = observe_points(packed, points, normals, VisibilityOptions("trace"), scene).visible_mask
        others = np.arange(len(views)) != index
        traced_count += int(traced[others].sum())
        extra += int((by_depth & ~traced)[others].sum())
        missed += int((traced & ~by_depth)[others].sum())
    return {
        "pairs_seen_by_rays": traced_count,
        "only_depth_sees_share": extra / traced_count,
        "only_rays_see_share": missed / traced_count,
    }


def measure_accuracy(views: list[StatisticsView], scene) -> dict:
    """Mean absolute error of each statistic against the pixel's colour, which is the same in all views."""
    results = {}
    for mode in ("depth", "trace"):
        options = StatisticsOptions(visibility=VisibilityOptions(mode))
        errors = []
        for view, result in zip(views, compute_statistics(views, options, scene), strict=True):
            mask = has_surface(view.depth_z_m, view.surface_mask)
            parts = [np.abs(result[n] - view.color)[mask].mean() for n in ("color_min", "color_median")]
            parts.append(np.abs(result["color_max"] - view.color)[mask].mean())
            spread = (result["color_max"] - result["color_min"])[mask].max(axis=-1)
            count = result["observation_count"][mask]
            errors.append([*parts, (spread > 0.3).mean(), count.mean()])
        names = ("minimum", "median", "maximum", "share_with_false_range_over_0.3", "mean_count")
        results[mode] = dict(zip(names, np.mean(errors, axis=0).tolist(), strict=True))
    return results


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", type=Path, help="a Mitsuba scene instead of the room of boxes")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 384), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument(
        "--views", type=int, default=80, help="number of views; all but growth use the first 40"
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--variant", default=None)
    parser.add_argument("--out", type=Path, default=Path("bench_statistics.json"))
    arguments = parser.parse_args()

    variant = select_variant(arguments.variant)
    scene, pose, up = scene_from_file(arguments.scene) if arguments.scene else furnished_room()
    cameras = place_cameras(scene, pose, up, arguments.views, *arguments.size)
    is_textured = arguments.scene is not None
    views = [capture(scene, camera, f"view_{i}", is_textured) for i, camera in enumerate(cameras)]
    report = {
        "benchmark": "statistics",
        "variant": variant,
        "machine": machine(),
        "scene": str(arguments.scene or "room of boxes"),
        "size": list(arguments.size),
        "best_views": 12,
        "speed_40_views": measure_speed(views[:40], scene, arguments.repeats),
        "growth": measure_growth(views, arguments.repeats),
        "visibility": measure_visibility(views[:40], scene),
    }
    if is_textured:
        report["accuracy"] = measure_accuracy(views[:40], scene)
    write_report(report, arguments.out)


if __name__ == "__main__":
    main()

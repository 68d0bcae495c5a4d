# SPDX-License-Identifier: MIT
"""Time by stage, and error, of views of the imported scene ``staircase``.

    python benchmarks/bench_view.py                             640x384, 40 views
    python benchmarks/bench_view.py --samples 2 4 8 --views 8   a sweep
    python benchmarks/bench_view.py --overlap                   sequential and overlapped rendering in turn

Stages of a view: path, ground-truth buffers, denoiser, statistics against all views, EXR (zip). Wall and CPU
seconds (user + system of all threads) are given by stage; on a busy machine, the CPU seconds divided by the
number of cores are more meaningful. The error is the relMSE of ``datagen.rendering.error`` against two
independent references, which are rendered once and stored in --cache. The scene is converted from
../shared/data by the project's own importer.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.timing import REPOSITORY, RESULTS, Stopwatch, interleaved, machine, summary, write_report
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.configuration import Configuration, PlacedAsset, ViewCamera
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera
from datagen.foundation.exr import encode_view
from datagen.foundation.versions import pixel_versions
from datagen.importers.common import ImportOptions
from datagen.importers.mitsuba_xml import import_mitsuba_scene
from datagen.library import Library
from datagen.multiview.statistics import StatisticsView, compute_statistics
from datagen.rendering.error import relative_mse
from datagen.rendering.renderer import SceneRenderer
from datagen.rendering.view_job import RenderedView

SHARED_DATA = Path(os.environ.get("SCENE_DATA", REPOSITORY.parent / "shared" / "data"))
SAMPLES_A_CHUNK = 64


def converted(scene: str, cache: Path) -> Library:
    """Import a scene into the folder ``cache`` unless done; returns its library."""
    folder = cache / "library" / scene
    if not (folder / "environments").is_dir():
        source = SHARED_DATA / "scenes" / scene / "scene.xml"
        import_mitsuba_scene(source, folder, ImportOptions(dielectric="replace", missing="replace"))
    return Library([folder])


def candidates(environment: EnvironmentAsset, size: tuple[int, int]) -> Iterator[Camera]:
    """Yield the scene's camera, widened to 61 degrees, then copies turned and moved at random."""
    pose = np.array(environment.cameras[0].asset_from_camera)
    focal = 0.85 * size[0]
    rng = np.random.default_rng(1)
    angle, shift = 0.0, np.zeros(3)
    while True:
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        world_from_camera = pose.copy()
        world_from_camera[:3, :3] = turn @ pose[:3, :3]
        world_from_camera[:3, 3] += shift
        yield Camera(*size, focal, focal, size[0] / 2, size[1] / 2, world_from_camera)
        angle, shift = rng.uniform(-0.5, 0.5), rng.uniform(-0.2, 0.2, 3)


def lit_views(
    base: Configuration, library: Library, environment: EnvironmentAsset, count: int
) -> list[Camera]:
    """The first ``count`` of :func:`candidates` that are outside walls, judged by images of a tenth of the
    size: at least a fifth of the first image's median radiance, less than 5 % of the pixels within 0.3 m.
    """
    recipe = RenderRecipe(path_samples=64, auxiliary_samples=4, denoise=False)
    chosen: list[Camera] = []
    brightness = 0.0
    size = (base.cameras[0].width_px, base.cameras[0].height_px)
    renderer = SceneRenderer(base, library, recipe)
    for camera in candidates(environment, size):
        small = camera.scaled(size[0] // 10, size[1] // 10)
        view = ViewCamera.from_camera("probe", small)
        renderer.configuration = base.model_copy(update={"cameras": (view,)})
        buffers = renderer.render_view(0).buffers
        light, depth = float(np.median(buffers["beauty"])), buffers["depth_z_m"]
        if not chosen:
            brightness = light
        if light >= 0.2 * brightness and (depth < 0.3).mean() < 0.05:
            chosen.append(camera)
        if len(chosen) == count:
            return chosen
    raise AssertionError("candidates never end")


def configuration_of(library: Library, count: int, size: tuple[int, int]) -> Configuration:
    """Configuration of the imported room with its own lights and ``count`` views of ``size``."""
    (package,) = library.select("environment", for_training=False)
    environment = package.asset
    assert isinstance(environment, EnvironmentAsset)
    base = Configuration(
        id=package.id,
        index=0,
        seed=1,
        environment=PlacedAsset(name=package.id, asset=package.id),
        lights=environment.lights,
        cameras=(ViewCamera.from_camera("own", next(candidates(environment, size))),),
        assets={p.id: p.sha256 for p in library},
    )
    views = lit_views(base, library, environment, count)
    cameras = tuple(ViewCamera.from_camera(f"view_{k:03}", camera) for k, camera in enumerate(views))
    return base.model_copy(update={"cameras": cameras})


def references(
    renderer: SceneRenderer, cache: Path, views: list[int], samples: int
) -> dict[int, tuple[Any, Any]]:
    """Two independent converged images (H, W, 3) by view, rendered unless ``cache`` contains them."""
    folder = cache / "references"
    folder.mkdir(parents=True, exist_ok=True)
    configuration = renderer.configuration
    width, height = configuration.cameras[0].width_px, configuration.cameras[0].height_px
    pairs = {}
    for view in views:
        path = folder / f"{configuration.id}-{width}x{height}-view{view}-{samples}.npz"
        write_reference(path, ("arr_0", "arr_1"), renderer, view, samples, "reference")
        with np.load(path) as data:
            pairs[view] = (data["arr_0"], data["arr_1"])
    return pairs


def write_reference(
    path: Path, names: tuple[str, str], renderer: SceneRenderer, view: int, samples: int, label: str
) -> None:
    """Write two converged images (H, W, 3) of a view, as arrays ``names``, to ``path`` unless it exists."""
    if path.is_file():
        return
    start = time.perf_counter()
    halves = [reference_half(renderer, view, samples, half) for half in (0, 1)]
    partial = path.with_suffix(".partial.npz")
    np.savez(partial, **dict(zip(names, halves, strict=True)))
    partial.replace(path)
    print(f"{label} of view {view}: {time.perf_counter() - start:.0f} s", file=sys.stderr)


def reference_half(renderer: SceneRenderer, view: int, samples: int, half: int) -> np.ndarray:
    """Image (H, W, 3) of ``samples`` paths per pixel with visible emission; ``half`` selects the seed."""
    sensor = renderer.sensor(renderer.configuration.cameras[view].camera())
    total: Any = 0.0
    for chunk in range(samples // SAMPLES_A_CHUNK):
        seed = 0x5EED0000 + 65536 * half + chunk
        total = total + renderer.tracer.render(sensor, SAMPLES_A_CHUNK, seed).astype(np.float64)
    return (total / (samples // SAMPLES_A_CHUNK)).astype(np.float32)


def measure(renderer: SceneRenderer, configuration: Configuration, compression: str) -> dict[str, Any]:
    """Run the stages of all views one after the other; returns seconds by stage and the size of the files."""
    watch = Stopwatch()
    count = len(configuration.cameras)
    renderer.render_view(0)  # warm-up: compiles kernels
    views: list[RenderedView] = []
    for index in range(count):
        with watch.stage("path + buffers"):
            traced = renderer.view_job(index)
            traced.add_pass(renderer.recipe.path_samples or 0)
        with watch.stage("denoiser"):
            views.append(traced.finish())
    inputs = [
        StatisticsView.from_buffers(camera.camera(), view.buffers)
        for camera, view in zip(configuration.cameras, views, strict=True)
    ]
    statistics = iter(compute_statistics(inputs))
    next(statistics)  # warm-up: compiles kernels
    statistics = iter(compute_statistics(inputs))
    results = []
    for _ in range(count):
        with watch.stage("statistics"):
            results.append(next(statistics))
    sizes = []
    for view, result in zip(views, results, strict=True):
        with watch.stage("exr"):
            sizes.append(len(encode_view({**view.buffers, **result}, compression)))
    stages = watch.result()
    total = {
        kind: round(sum(stage[kind]["median"] for stage in stages.values()), 4)
        for kind in ("wall_s", "cpu_s")
    }
    passes = {name: summary([view.seconds[name] for view in views]) for name in ("path", "buffers")}
    return {
        "stages": stages,
        "passes_wall_s": passes,
        "sum_of_medians": total,
        "exr_megabytes": round(float(np.median(sizes)) / 1e6, 3),
    }


def measure_error(
    configuration: Configuration, library: Library, recipe: RenderRecipe, pairs: dict[int, tuple[Any, Any]]
) -> dict[str, Any]:
    """relMSE of denoised images against the ``pairs`` of references by view, as means of three seeds."""
    result: dict[str, Any] = {}
    for exposed in (False, True):
        errors = {view: [] for view in pairs}  # type: dict[int, list[float]]
        result["rel_mse_exposed" if exposed else "rel_mse"] = errors
    for seed in range(3):
        seeded = configuration.model_copy(update={"seed": 100 + seed})
        renderer = SceneRenderer(seeded, library, recipe)
        for view, (first, second) in pairs.items():
            beauty = renderer.render_view(view).buffers["beauty"]
            result["rel_mse"][view].append(relative_mse(beauty, first, second))
            result["rel_mse_exposed"][view].append(relative_mse(beauty, first, second, exposed=True))
    for name in list(result):
        by_view = {str(view): round(float(np.mean(values)), 5) for view, values in result[name].items()}
        result[name] = {"by_view": by_view, "mean": round(float(np.mean(list(by_view.values()))), 5)}
    return result


def measure_overlap(renderer: SceneRenderer, count: int, repeats: int) -> dict[str, Any]:
    """Seconds per view of sequential and overlapped rendering, measured in turn, and their paired ratio."""
    seconds: dict[str, list[float]] = {}
    orders = {
        "sequential": lambda: [renderer.render_view(index) for index in range(count)],
        "overlapped": lambda: list(renderer.render_views(range(count))),
    }
    for name, times in interleaved(orders, repeats, warm_up=0).items():
        seconds[name] = [turn.wall / count for turn in times]
    ratios = [a / b for a, b in zip(seconds["sequential"], seconds["overlapped"], strict=True)]
    return {name: summary(values) for name, values in seconds.items()} | {"speedup": summary(ratios)}


def main() -> None:
    """Run the command, which writes the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="staircase")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 384))
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--samples", type=int, nargs="+", default=[4])
    parser.add_argument("--auxiliary-samples", type=int, default=64)
    parser.add_argument("--max-depth", type=int, default=8)
    parser.add_argument("--reference-views", type=int, nargs="*", default=[0, 1])
    parser.add_argument(
        "--reference-samples", type=int, default=256, help="paths per pixel in each of two references"
    )
    parser.add_argument("--compression", default="zip")
    parser.add_argument("--overlap", action="store_true")
    parser.add_argument("--cache", type=Path, default=RESULTS)
    parser.add_argument("--out", type=Path, default=RESULTS / "bench_view.json")
    arguments = parser.parse_args()
    library = converted(arguments.scene, arguments.cache)
    configuration = configuration_of(library, arguments.views, tuple(arguments.size))
    result: dict[str, Any] = {
        "machine": machine(),
        "versions": pixel_versions(),
        "arguments": {k: v if not isinstance(v, Path) else v.name for k, v in vars(arguments).items()},
        "by_samples": {},
    }
    pairs: dict[int, tuple[Any, Any]] = {}
    for samples in arguments.samples:
        recipe = RenderRecipe(
            path_samples=samples, auxiliary_samples=arguments.auxiliary_samples, max_depth=arguments.max_depth
        )
        renderer = SceneRenderer(configuration, library, recipe)
        if not pairs and arguments.reference_views:
            pairs = references(
                renderer, arguments.cache, arguments.reference_views, arguments.reference_samples
            )
        entry = measure(renderer, configuration, arguments.compression)
        entry["seconds_to_build"] = round(renderer.seconds_to_build, 2)
        if arguments.overlap:
            entry["overlap"] = measure_overlap(renderer, min(6, arguments.views), 4)
        if pairs:
            entry |= measure_error(configuration, library, recipe, pairs)
        result["by_samples"][str(samples)] = entry
        print(json.dumps({str(samples): entry}, indent=1))
    write_report(result, arguments.out, is_printed=False)


if __name__ == "__main__":
    main()

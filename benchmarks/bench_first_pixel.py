# SPDX-License-Identifier: MIT
"""Seconds from the start of a process to the first pixels of a 40-view configuration, stage by stage.

    python -m benchmarks.bench_first_pixel                    the bundled library, 640x384, warm caches
    python -m benchmarks.bench_first_pixel --cold             an empty cache of compiled kernels each time
    python -m benchmarks.bench_first_pixel --profile          profile of the scene's construction

A separate process follows the steps of ``datagen run --unit``: it imports modules, opens the library, reads
plan and configuration, builds the scene (meshes, textures, BVH, BSDFs), and renders the first view with
one path and one auxiliary sample per pixel into memory. Warm means that an earlier run filled the file cache
of the operating system and Dr.Jit's kernel cache. Medians of --repeats runs; the target is 10 s on 2 cores.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.timing import REPOSITORY, RESULTS, markdown, planned_folder, timed, write_report

TARGET_S = 10.0


def first_pixels(folder: Path, profile: Path | None) -> None:
    """Body of the measured process: print each stage's name, end (epoch) and processor seconds as JSON."""
    marks: list[tuple[str, float, float]] = [("interpreter", time.time(), time.process_time())]

    def mark(name: str) -> None:
        marks.append((name, time.time(), time.process_time()))

    from datagen.farm.folder import DatasetFolder
    from datagen.formats.recipe import RenderRecipe
    from datagen.library import Library

    mark("imports")
    from mitsuba_plugins.variant import select_variant

    select_variant("llvm_ad_rgb")
    mark("mitsuba")
    planned = DatasetFolder(folder)
    configuration = planned.read_configuration(planned.read_plan().units[0])
    library = Library(planned.library_paths())
    mark("plan and library")
    from datagen.rendering.renderer import SceneRenderer

    mark("renderer's imports")
    recipe = RenderRecipe(
        variant="llvm_ad_rgb", path_samples=1, auxiliary_samples=1, denoise=False, irradiance_cache=True
    )
    if profile is not None:
        import cProfile

        profiler = cProfile.Profile()
        profiler.enable()
    renderer = SceneRenderer(configuration, library, recipe)
    if profile is not None:
        profiler.disable()
        profiler.dump_stats(str(profile))
    mark("scene")
    view = renderer.render_view(0)
    assert view.buffers["beauty"].max() > 0
    mark("first view")
    print(json.dumps({"marks": marks, "passes": passes(renderer)}))


def passes(renderer: Any) -> dict[str, float]:
    """Median wall seconds of a pass over 32 x 32 pixels with a newly recorded and with a replayed kernel."""
    sensor = renderer.sensor(renderer.configuration.cameras[0].camera())
    found = {}
    for name in ("new recording", "replayed"):
        seconds = []
        for seed in range(5):
            if name == "new recording":
                renderer.tracer.forget_recordings()
            one_pass = partial(renderer.tracer.accumulate, sensor, 1, seed, grid=(32, 32))
            seconds.append(timed(one_pass).wall)
        found[name] = statistics.median(seconds)
    return found


def planned_room(cache: Path, size: tuple[int, int], views: int) -> Path:
    """Plan the measured configuration unless ``cache`` contains it; returns its folder."""
    from datagen.formats.recipe import ObjectRecipe, Recipe

    objects = ObjectRecipe(count=(10, 24))
    recipe = Recipe(name="first", seed=2022, configurations=1, views=views, resolution=size, objects=objects)
    folder = cache / f"first_pixel_{size[0]}x{size[1]}_{views}_1"
    return planned_folder(folder, recipe, cache / "first_pixel.yaml", stdout=subprocess.DEVNULL)


def run_once(folder: Path, is_cold: bool, profile: Path | None) -> dict[str, Any]:
    """Wall and processor seconds of one process, by stage and in total."""
    with tempfile.TemporaryDirectory() as home:
        environment = {**os.environ, **({"HOME": home} if is_cold else {})}  # kernels are in ~/.drjit
        command = [sys.executable, "-m", "benchmarks.bench_first_pixel", "--child", str(folder)]
        if profile is not None:
            command += ["--profile-to", str(profile)]
        began = time.time()
        done = subprocess.run(
            command, cwd=REPOSITORY, env=environment, check=True, capture_output=True, text=True
        )
    found = json.loads(done.stdout.splitlines()[-1])
    stages, before, cpu_before = {}, began, 0.0
    for name, moment, cpu in found["marks"]:
        stages[name] = {"wall_s": round(moment - before, 3), "cpu_s": round(cpu - cpu_before, 3)}
        before, cpu_before = moment, cpu
    total = {"wall_s": round(before - began, 3), "cpu_s": round(cpu_before, 3)}
    return {"stages": stages, **total, "passes": found["passes"]}


def main() -> None:
    """Run the command, which prints and writes the medians."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, nargs=2, default=(640, 384))
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--cache", type=Path, default=RESULTS)
    parser.add_argument("--out", type=Path, default=RESULTS / "bench_first_pixel.json")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--profile-to", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child is not None:
        first_pixels(arguments.child, arguments.profile_to)
        return
    folder = planned_room(arguments.cache, tuple(arguments.size), arguments.views)
    if arguments.profile:
        import pstats

        path = arguments.cache / "first_pixel.prof"
        run_once(folder, arguments.cold, path)
        pstats.Stats(str(path)).sort_stats("cumulative").print_stats(35)
        return
    if not arguments.cold:
        run_once(folder, False, None)
    runs = [run_once(folder, arguments.cold, None) for _ in range(arguments.repeats)]
    stages = {
        name: {
            kind: statistics.median(run["stages"][name][kind] for run in runs) for kind in ("wall_s", "cpu_s")
        }
        for name in runs[0]["stages"]
    }
    total = {kind: statistics.median(run[kind] for run in runs) for kind in ("wall_s", "cpu_s")}
    result = {
        "cores": os.cpu_count(),
        "is_cold": arguments.cold,
        "stages": stages,
        "total": total,
        "pass_s": {n: statistics.median(run["passes"][n] for run in runs) for n in runs[0]["passes"]},
        "target_s": TARGET_S,
    }
    write_report(result, arguments.out, is_printed=False)
    rows = [
        (name, f"{seconds['wall_s']:.2f}", f"{seconds['cpu_s']:.2f}")
        for name, seconds in {**stages, "start of process to first pixels": total}.items()
    ]
    print(markdown(("stage", "wall s", "processor s"), rows))
    print("a pass: " + ", ".join(f"{name} {1e3 * s:.0f} ms" for name, s in result["pass_s"].items()))


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: MIT
"""Savings from the sky guide (docs/decisions/0073): variance and time in each room.

    python -m benchmarks.bench_sky_guide                  6 rooms, 4 views of 160x96; 4 minutes

Each view of rooms assembled from the bundled library is traced with ``--samples`` paths per pixel, four times
with and four times without the guide, with the firefly clamp of the named qualities. Variance is half the
exposed relMSE between two images, averaged over views; time is the median processor time of an image.
The product of both ratios is the relative time for the same noise, without the time to build the guide.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bench_qualities import planned_rooms
from benchmarks.timing import RESULTS, Stopwatch, timed, write_report
from datagen.farm.folder import DatasetFolder
from datagen.formats.recipe import RenderRecipe
from datagen.library import Library
from datagen.rendering.error import relative_mse
from datagen.rendering.renderer import SceneRenderer
from datagen.tradeoff.reference import sized

IMAGES = 4
CLAMP = 30.0


def compare(renderer: SceneRenderer, samples: int) -> dict[str, Any]:
    """Variance, seconds, and their ratios (with : without guide) in one room, and the guide's share."""
    tracer, guide = renderer.tracer, renderer.tracer.sky_guide
    kinds = {"plain": None, "guided": guide}
    variances: dict[str, list[float]] = {name: [] for name in kinds}
    watch = Stopwatch()
    for index, view in enumerate(renderer.configuration.cameras):
        sensor = renderer.sensor(view.camera())
        limit = renderer.view_job(index).clamp_limit
        images: dict[str, list[Any]] = {name: [] for name in kinds}
        for name, chosen in kinds.items():
            tracer.use_sky_guide(chosen)
            tracer.accumulate(sensor, 1, 0, limit=limit)  # warm-up: compiles kernels
            for seed in range(IMAGES):
                with watch.stage(name):
                    images[name].append(tracer.accumulate(sensor, samples, 1 + seed, limit=limit).mean())
        reference = np.mean([image for found in images.values() for image in found], axis=0)
        for name, found in images.items():
            pairs = zip(found[::2], found[1::2], strict=True)
            # the relMSE of these images is the mean of (a - b)^2 / 2 over reference^2 + epsilon
            differences = [reference + (a - b) / np.sqrt(2.0) for a, b in pairs]
            variances[name] += [relative_mse(image, reference, exposed=True) for image in differences]
    tracer.use_sky_guide(guide)
    mean = {name: statistics.mean(values) for name, values in variances.items()}
    cost = {name: statistics.median(values) for name, values in watch.cpu.items()}
    return {
        "share": float(guide.shares.sum()) if guide is not None else 0.0,
        "variance": mean,
        "seconds": cost,
        "variance_ratio": mean["guided"] / mean["plain"],
        "time_ratio": cost["guided"] / cost["plain"],
    }


def main() -> None:
    """Run the command, which prints a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--configurations", type=int, default=6)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 96))
    parser.add_argument("--out", type=Path, default=RESULTS / "sky_guide")
    arguments = parser.parse_args()
    folder = DatasetFolder(planned_rooms(arguments.out, arguments.configurations))
    library = Library(folder.library_paths())
    results = {}
    print("| room | sky's share | learning s | variance | time | same noise in |\n|---|---|---|---|---|---|")
    for unit in folder.read_plan().units:
        configuration = sized(folder.read_configuration(unit), tuple(arguments.size), 4)
        renderer = SceneRenderer(configuration, library, RenderRecipe(path_samples=1, firefly_clamp=CLAMP))
        learning = timed(renderer.prepare_paths).cpu
        found = {"learning_s": learning, **compare(renderer, arguments.samples)}
        renderer.close()
        results[configuration.id] = found
        print(
            f"| {configuration.environment.asset} | {found['share']:.2f} | {learning:.2f} | "
            f"{found['variance_ratio']:.2f} | {found['time_ratio']:.2f} | "
            f"{found['variance_ratio'] * found['time_ratio']:.2f} |",
            flush=True,
        )
    write_report(results, arguments.out / "bench_sky_guide.json", is_printed=False)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: MIT
"""How well the error that a view's record states predicts the true one: 30 views of 6 scenes.

    python -m benchmarks.bench_error_estimate                     references, measurement, figures, plot
    python -m benchmarks.bench_error_estimate --only references   makes what is missing of them, then stops

Three configurations of the bundled library and three imported scenes (from ../shared/data, or SCENE_DATA),
five views each, small images. Each view has two independent references of 2,048 paths a pixel or more; they
are written to --cache as EXR one after the other, so that the command can be stopped and started again. Each
view is rendered as `draft` and `standard` are, with clamp and irradiance cache, pass by pass; at every total
the estimated error is set against the true one. References are of paths of 32 segments without a clamp.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from benchmarks.bench_view import RESULTS, configuration_of, converted
from benchmarks.error_plot import save_error_plot
from datagen.formats.base import canonical_json, sha256_hex
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import QUALITIES, AssetFilter, Recipe, RenderRecipe
from datagen.foundation.exr import decode_channels
from datagen.library import Library, resolve_library_paths
from datagen.rendering.error import relative_mse
from datagen.rendering.renderer import SceneRenderer
from datagen.rendering.sample_budget import PathSums, SampleBudget
from datagen.tradeoff.reference import MAX_DEPTH, RUSSIAN_ROULETTE_DEPTH

BUNDLED = ("living_room", "kitchen", "bathroom")
IMPORTED = ("staircase", "veach-ajar", "bathroom2")
VIEWS = 5
TARGETS = (0.02, 0.005, 0.002)
CHUNK = 128  # paths a pixel of one launch of a reference
IMAGE = Path(__file__).resolve().parents[1] / "docs" / "images" / "error_estimate.png"


@dataclass(frozen=True)
class Point:
    """A view at a number of samples. Errors are exposed relMSE."""

    scene: str
    view: str
    samples: int
    estimated: float
    true: float
    true_of_average: float
    standard_error: float
    spread: float
    measured_bias: float
    bias_error: float
    removed_share: float

    def meets(self, target: float) -> bool:
        """Whether a budget with this target ends here."""
        return self.estimated + self.standard_error <= target


def scenes(
    names: list[str], cache: Path, size: tuple[int, int]
) -> Iterator[tuple[str, Configuration, Library]]:
    """Name, configuration and library of each scene."""
    for name in names:
        if name in BUNDLED:
            yield bundled(name, BUNDLED.index(name), size)
        else:
            library = converted(name, cache)
            yield name, configuration_of(library, VIEWS, size), library


def bundled(name: str, seed: int, size: tuple[int, int]) -> tuple[str, Configuration, Library]:
    """A configuration of one of the bundled rooms."""
    from datagen.assembly.plan import assemble

    library = Library(resolve_library_paths(("bundled",), Path()))
    recipe = Recipe(
        name=f"error-{name}",
        seed=70 + seed,
        configurations=1,
        views=VIEWS,
        resolution=size,
        environments=AssetFilter(include=(name,)),
    )
    return name, assemble(recipe, 0, library), library


def read_rgb(path: Path) -> NDArray[np.float32]:
    """(H, W, 3) of an EXR file."""
    channels = decode_channels(path.read_bytes(), path)
    return np.stack([channels[name] for name in "RGB"], axis=-1)


def reference(
    renderer: SceneRenderer, index: int, half: int, samples: int, path: Path
) -> NDArray[np.float32]:
    """Mean of ``samples`` unclamped paths a pixel, (H, W, 3), without seen lights; read if it is there.

    All light is traced, and further than the renderer does it: what a cache holds has no longest path.
    """
    from datagen.rendering.transport.integrator import PathTracer

    if not path.is_file():
        sensor = renderer.sensor(renderer.configuration.cameras[index].camera())
        tracer = PathTracer(renderer.built, MAX_DEPTH, RUSSIAN_ROULETTE_DEPTH)
        tracer.use_sky_guide(renderer.tracer.sky_guide)
        sums = PathSums()
        for number in range(math.ceil(samples / CHUNK)):
            seed = 0x5EED0000 + 0x10000 * half + number
            sums = sums + tracer.accumulate(sensor, CHUNK, seed)
        partial = path.with_suffix(".partial")
        with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"RGB": sums.mean()}) as file:
            file.write(str(partial))
        partial.replace(path)
    return read_rgb(path)


def references(renderer: SceneRenderer, index: int, samples: int, folder: Path) -> list[NDArray[np.float32]]:
    """Two independent references of a view."""
    configuration = renderer.configuration
    camera = configuration.cameras[index]
    digest = sha256_hex(canonical_json(configuration))[:8]
    size = f"{camera.width_px}x{camera.height_px}"
    stem = f"{configuration.id}-{digest}-{size}-{index}-{samples}-{MAX_DEPTH}"
    return [reference(renderer, index, half, samples, folder / f"{stem}-{half}.exr") for half in (0, 1)]


def measure_view(
    renderer: SceneRenderer, scene: str, index: int, pair: list[NDArray[np.float32]], most: int
) -> Iterator[Point]:
    """Estimated and true error of a view after each pass, as the renderer would have stopped there."""
    view = renderer.view_job(index)
    first, second = (image + view.visible_emission for image in pair)
    budget = SampleBudget(0.0, most)  # goes on to the end
    height, width, _ = view.visible_emission.shape
    counts = budget.first_counts((height, width))
    while counts.any():
        view.add_pass(counts)
        estimate = view.estimate_error()
        finished = view.finish().buffers["beauty"]
        halves = [view.denoise(half.mean(), view.denoiser) + view.visible_emission for half in view.halves]
        yield Point(
            scene=scene,
            view=renderer.configuration.cameras[index].name,
            samples=round(sum(half.mean_samples for half in view.halves)),
            estimated=estimate.rel_mse,
            true=relative_mse(finished, first, second, exposed=True),
            true_of_average=relative_mse(0.5 * (halves[0] + halves[1]), first, second, exposed=True),
            standard_error=estimate.standard_error,
            spread=estimate.spread,
            measured_bias=estimate.measured_bias,
            bias_error=estimate.bias_error,
            removed_share=(view.halves[0] + view.halves[1]).removed_share(),
        )
        counts = budget.next_counts(view.halves[0].counts, estimate)


def stopped(points: list[Point], target: float) -> list[Point]:
    """The point of each view at which a budget with this target ends; its last one if that is never met."""
    ends: dict[tuple[str, str], Point] = {}
    for point in points:
        key = (point.scene, point.view)
        if key not in ends or not ends[key].meets(target):
            ends[key] = point
    return list(ends.values())


def figures(points: list[Point]) -> dict[str, Any]:
    """Rank correlation, median and 90 % range of estimated / true error."""
    from scipy.stats import spearmanr

    estimated, true = (np.array([getattr(p, name) for p in points]) for name in ("estimated", "true"))
    ratio = estimated / true
    return {
        "points": len(points),
        "rank_correlation": round(float(spearmanr(estimated, true).statistic), 3),
        "median_ratio": round(float(np.median(ratio)), 3),
        "range_90": [round(float(v), 3) for v in np.percentile(ratio, [5, 95])],
    }


def summarise(points: list[Point]) -> dict[str, Any]:
    """Figures by number of samples, over all of them, and where budgets with several targets end."""
    result: dict[str, Any] = {"all": figures(points)}
    # whole steps of tiles stay a little below what a pass aims at
    passes: dict[int, int] = {p.samples: 2 ** round(math.log2(p.samples)) for p in points}
    for samples in sorted(set(passes.values())):
        result[f"{samples} samples"] = figures([p for p in points if passes[p.samples] == samples])
    for target in TARGETS:
        ends = stopped(points, target)
        met = [p for p in ends if p.meets(target)]
        entry: dict[str, Any] = {
            "met": len(met),
            "samples": sorted(p.samples for p in ends),
            "true_above_target": sum(p.true > target for p in met),
            "true_above_twice": sum(p.true > 2 * target for p in met),
        }
        if met:
            low, middle, high = np.percentile([p.true for p in met], [5, 50, 95])
            entry["true_5_50_95"] = [round(float(v), 5) for v in (low, middle, high)]
        result[f"target {target:g}"] = entry
    return result


def plot(points: list[Point], target: float, reference_samples: int, path: Path) -> None:
    """Estimated against true error, both axes logarithmic; the ends of one target are outlined."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.6), layout="constrained")
    axes = figure.add_subplot()
    names = list(dict.fromkeys(p.scene for p in points))
    for number, name in enumerate(names):
        own = [p for p in points if p.scene == name]
        sizes = [8 + 5 * math.log2(p.samples) for p in own]
        axes.scatter(
            [p.true for p in own], [p.estimated for p in own], s=sizes, color=f"C{number}", alpha=0.55, lw=0
        )
        axes.scatter([], [], s=30, color=f"C{number}", label=name)
    ends = stopped(points, target)
    axes.scatter(
        [p.true for p in ends],
        [p.estimated for p in ends],
        s=[8 + 5 * math.log2(p.samples) for p in ends],
        facecolor="none",
        edgecolor="black",
        lw=0.9,
        label=f"where max_rel_mse {target:g} stops",
    )
    values = [v for p in points for v in (p.true, p.estimated)]
    ends_of_axes = np.array([min(values) / 1.3, max(values) * 1.3])
    axes.axhline(target, color="black", lw=0.7, ls=":")
    xlabel = f"true relMSE, against two references of {reference_samples:,} samples"
    save_error_plot(figure, axes, ends_of_axes, xlabel, "estimated relMSE, from two halves", path)


def main() -> None:
    """Parse, make references, measure, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=("references",))
    parser.add_argument("--scenes", nargs="+", choices=BUNDLED + IMPORTED, default=BUNDLED + IMPORTED)
    parser.add_argument("--size", type=int, nargs=2, default=(128, 80))
    parser.add_argument("--views", type=int, default=VIEWS, help="the first views of each scene")
    parser.add_argument("--reference-samples", type=int, default=2048, help="paths a pixel in each of two")
    parser.add_argument("--most", type=int, default=128, help="samples of the last pass")
    parser.add_argument("--clamp", type=float, default=QUALITIES["standard"]["firefly_clamp"])
    parser.add_argument("--whole-paths", action="store_true", help="measure without the irradiance cache")
    parser.add_argument("--cache", type=Path, default=RESULTS)
    parser.add_argument("--out", type=Path, default=RESULTS / "bench_error_estimate.json")
    parser.add_argument("--plot", type=Path, default=IMAGE)
    arguments = parser.parse_args()
    folder = arguments.cache / "references"
    folder.mkdir(parents=True, exist_ok=True)
    points: list[Point] = []
    recipe = RenderRecipe(
        max_rel_mse=1e-9,
        max_path_samples=1 << 16,
        firefly_clamp=arguments.clamp,
        irradiance_cache=not arguments.whole_paths,
    )
    for name, configuration, library in scenes(arguments.scenes, arguments.cache, tuple(arguments.size)):
        renderer = SceneRenderer(configuration, library, recipe)
        for index in range(min(arguments.views, len(configuration.cameras))):
            start = time.process_time()
            pair = references(renderer, index, arguments.reference_samples, folder)
            print(f"{name} {index}: reference after {time.process_time() - start:.0f} CPU s", file=sys.stderr)
            if arguments.only != "references":
                points += measure_view(renderer, name, index, pair, arguments.most)
        renderer.close()
    if not points:
        return
    result = {"arguments": {k: str(v) for k, v in vars(arguments).items()}, **summarise(points)}
    print(json.dumps(result, indent=1))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    result["points"] = [asdict(p) for p in points]
    arguments.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    plot(points, TARGETS[1], arguments.reference_samples, arguments.plot)


if __name__ == "__main__":
    main()

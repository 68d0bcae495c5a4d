# SPDX-License-Identifier: MIT
"""Recorded and true error of views, in ten rooms with four views each.

    python -m benchmarks.bench_recorded_error                      96x64: references, views, figures, picture
    python -m benchmarks.bench_recorded_error --size 320 192 --views 1 --samples 128

The rooms are five of the bundled library and five imported scenes (from ../shared/data, or SCENE_DATA). The
true error is measured as in `datagen verify --recheck`, against four independent references of plain paths of
up to 65 segments, here with the sky guide, which does not change their expectation. References are stored in
--cache, so an interrupted command resumes. A true error is *known* if its standard error is below a quarter
of it. The bias of the irradiance cache is measured in whole views and in blocks of 16x16 pixels, with
--cached-samples undenoised, unclamped paths per pixel that use the cache.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.bench_view import configuration_of, converted
from benchmarks.timing import REPOSITORY, RESULTS, write_report
from datagen.assembly.plan import assemble
from datagen.formats.base import canonical_json, parse_model, sha256_hex
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import EnvironmentRecipe, Recipe, RenderRecipe
from datagen.foundation.color import luminance
from datagen.foundation.versions import pixel_versions
from datagen.inspection.recheck import DEPTH, PARTS, ROULETTE_DEPTH
from datagen.library import Library, resolve_library_paths
from datagen.rendering.error import relative_mse_of_parts
from datagen.rendering.renderer import SceneRenderer
from datagen.rendering.transport.integrator import PathTracer

BUNDLED = ("living_room", "kitchen", "bathroom", "dining_room", "study")
IMPORTED = ("staircase", "veach-ajar", "bathroom2", "staircase2", "contemporary")
FOLDERS = {"contemporary": "bathroom"}  # a bundled room is also named bathroom
BLOCK_PX = 16
IMAGE = REPOSITORY / "docs" / "images" / "recorded_error.png"


@dataclass(frozen=True)
class Point:
    """Errors of a view: ``recorded`` and ``true`` relMSE (exposed), ``true_error`` (standard error of
    ``true``) and ``bias`` (relative error of the mean luminance).

    ``cell_m`` is the cell size of the irradiance cache, ``cache_bias`` the relative bias of mean luminance
    that it causes, ``cache_error`` the standard error of this bias; ``block_bias`` is the largest absolute
    bias of a block, less two standard errors.
    """

    room: str
    view: int
    samples: float
    recorded: float
    true: float
    true_error: float
    bias: float
    cell_m: float | None
    cache_bias: float
    cache_error: float
    block_bias: float

    @property
    def is_known(self) -> bool:
        """True if the standard error of the true error is below a quarter of it."""
        return self.true_error < 0.25 * self.true


def room_named(name: str, views: int, size: tuple[int, int], cache: Path) -> tuple[Configuration, Library]:
    """Configuration of a room with ``views`` cameras of ``size`` (width, height), and the room's library."""
    if name in IMPORTED:
        library = converted(FOLDERS.get(name, name), cache)
        return configuration_of(library, views, size), library
    library = Library(resolve_library_paths(("bundled",), Path()))
    recipe = Recipe(
        name=f"error-{name}",
        seed=70 + BUNDLED.index(name),
        configurations=1,
        views=views,
        resolution=size,
        environments=EnvironmentRecipe(include=(name,)),
    )
    return assemble(recipe, 0, library), library


def reference_paths(
    configuration: Configuration, room: str, view: int, samples: int, cache: Path
) -> list[Path]:
    """Paths of a view's references, named after room, view, part, and a hash of all their inputs."""
    determined = [configuration.model_dump(mode="json"), samples, pixel_versions()]
    key = sha256_hex(canonical_json(determined))[:12]
    return [cache / f"{room}-{key}-{view}-{part}.npy" for part in range(PARTS)]


def references(
    renderer: SceneRenderer, room: str, view: int, samples: int, cache: Path
) -> list[NDArray[np.float32]]:
    """Independent images (H, W, 3) of reflected light, of ``samples`` paths in total, stored in ``cache``."""
    camera = renderer.configuration.cameras[view].camera()
    paths = reference_paths(renderer.configuration, room, view, samples, cache)
    for part, path in enumerate(paths):
        if not path.is_file():
            tracer = PathTracer(renderer.built, renderer.materials, DEPTH, ROULETTE_DEPTH)
            tracer.use_sky_guide(renderer.tracer.sky_guide)
            sums = tracer.accumulate(renderer.sensor(camera), samples // PARTS, 0x5EED0000 + part)
            np.save(path, sums.mean())
    return [np.load(path) for path in paths]


def cache_bias(
    renderer: SceneRenderer, view: int, parts: list[NDArray[np.float32]], samples: int
) -> tuple[float, float, float]:
    """Biases (see :class:`Point`) of a view's paths with the cache, against the references ``parts``."""
    sensor = renderer.sensor(renderer.configuration.cameras[view].camera())
    images = [renderer.tracer.accumulate(sensor, samples // PARTS, part).mean() for part in range(PARTS)]
    cached, plain = (np.stack([_block_means(luminance(image)) for image in p]) for p in (images, parts))
    means, blocks = _bias(cached.mean(axis=(1, 2)), plain.mean(axis=(1, 2))), _bias(cached, plain)
    return float(means[0]), float(means[1]), float(np.maximum(np.abs(blocks[0]) - 2.0 * blocks[1], 0.0).max())


def _bias(values: NDArray[Any], references: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Relative difference (...) of the means of independent ``values`` and ``references``, both (PARTS, ...),
    and its standard error."""
    mean = references.mean(axis=0)
    error = np.sqrt((values.var(axis=0, ddof=1) + references.var(axis=0, ddof=1)) / PARTS)
    return (values.mean(axis=0) - mean) / mean, error / mean


def _block_means(image: NDArray[np.floating]) -> NDArray[np.floating]:
    """Means (h, w) of blocks of an image (H, W)."""
    rows, columns = (n // BLOCK_PX for n in image.shape)
    blocks = image[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(rows, BLOCK_PX, columns, BLOCK_PX)
    return blocks.mean(axis=(1, 3))


def points_of(room: str, arguments: argparse.Namespace) -> Iterator[Point]:
    """Render the views of a room and yield a point for each."""
    size = (arguments.size[0], arguments.size[1])
    configuration, library = room_named(room, arguments.views, size, arguments.cache)
    recipe = parse_model(RenderRecipe, {"quality": arguments.quality}, "recipe")
    renderer = SceneRenderer(configuration, library, recipe)
    for index in range(arguments.views):
        lights = renderer.view_job(index).visible_emission
        folder = arguments.cache / "plain"
        folder.mkdir(parents=True, exist_ok=True)
        plain = references(renderer, room, index, arguments.samples, folder)
        parts = [part + lights for part in plain]
        view = renderer.render_view(index)
        image, record = view.buffers["beauty"], view.render
        true, true_error = relative_mse_of_parts(image, parts, exposed=True)
        bias = float(luminance(image).mean() / np.mean([luminance(part) for part in parts])) - 1.0
        assert record.estimated_rel_mse is not None
        yield Point(
            room, index, record.path_samples, record.estimated_rel_mse, true, true_error, bias,
            record.irradiance_cell_m, *cache_bias(renderer, index, plain, arguments.cached_samples),
        )  # fmt: skip
    renderer.close()


def figures(points: list[Point]) -> dict[str, Any]:
    """Statistics, by name, of the biases, and of recorded / true error over views of known true error."""
    known = [p for p in points if p.is_known]
    ratios = np.array([p.recorded / p.true for p in known])
    return {
        "views": len(points),
        "known": len(known),
        "within_2": round(float(np.mean((ratios >= 0.5) & (ratios <= 2.0))), 3),
        "below_a_fourth": int((ratios < 0.25).sum()),
        "least": round(float(ratios.min()), 3),
        "median": round(float(np.median(ratios)), 3),
        "most": round(float(ratios.max()), 3),
        "cache_bias_below_half_a_percent": int(sum(abs(p.cache_bias) < 0.005 for p in points)),
        "largest_cache_bias": round(max(abs(p.cache_bias) - 2.0 * p.cache_error for p in points), 5),
        "largest_block_bias": round(max(p.block_bias for p in points), 4),
    }


def plot(points: list[Point], path: Path) -> None:
    """Plot recorded against true error, both logarithmic, with error bars from the references."""
    figure = Figure(figsize=(6.4, 5.6), layout="constrained")
    axes = figure.add_subplot()
    for number, room in enumerate(dict.fromkeys(p.room for p in points)):
        own = [p for p in points if p.room == room and p.true > 0.0]
        color = f"C{number}"
        true, recorded = [p.true for p in own], [p.recorded for p in own]
        low = [min(p.true_error, 0.9 * p.true) for p in own]
        bars = [low, [p.true_error for p in own]]
        axes.errorbar(true, recorded, xerr=bars, fmt="o", ms=4, lw=0.7, color=color, label=room)
    ends = np.array([1e-3, 0.02])
    axes.plot(ends, ends, color="grey", lw=1)
    axes.fill_between(ends, ends / 2, ends * 2, color="grey", alpha=0.12, lw=0)
    axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends)
    axes.set(xlabel="true relMSE, against plain paths", ylabel="recorded relMSE")
    ticks = [0.001, 0.002, 0.005, 0.01, 0.02]
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.set_ticks([], minor=True)
    axes.set_aspect("equal")
    axes.legend(fontsize=8, loc="upper left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run the command, which writes the points, the figures and a plot."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rooms", nargs="+", choices=BUNDLED + IMPORTED, default=BUNDLED + IMPORTED)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 64))
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--samples", type=int, default=1024, help=f"plain paths per pixel, in {PARTS} parts")
    parser.add_argument("--cached-samples", type=int, default=512, help="paths per pixel with the cache")
    parser.add_argument("--quality", choices=("draft", "standard"), default="standard")
    parser.add_argument("--cache", type=Path, default=RESULTS)
    parser.add_argument("--out", type=Path, default=RESULTS / "bench_recorded_error.json")
    parser.add_argument("--plot", type=Path, default=IMAGE)
    arguments = parser.parse_args()
    points: list[Point] = []
    for room in arguments.rooms:
        for point in points_of(room, arguments):
            points.append(point)
            print(json.dumps(asdict(point)), file=sys.stderr, flush=True)
    result = {"arguments": {k: str(v) for k, v in vars(arguments).items()}, **figures(points)}
    print(json.dumps(result, indent=1))
    write_report({**result, "points": [asdict(p) for p in points]}, arguments.out, is_printed=False)
    plot(points, arguments.plot)


if __name__ == "__main__":
    main()

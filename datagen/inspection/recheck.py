# SPDX-License-Identifier: MIT
"""Renders views of a dataset again by plain path tracing: ``datagen verify --recheck N``.

All accelerations are off: paths have up to 65 segments, emitters are sampled with nearly equal probability,
and there is no sky guide, irradiance cache, clamp or denoiser. The samples form four independent images. The
error is the mean product of a view's differences from two of these images, to which their noise contributes
0 in expectation (:mod:`datagen.rendering.error`). The standard errors of error and bias are computed from the
spread of the images.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.recipe import RenderRecipe
from datagen.formats.shard import Dataset, ShardReader, View
from datagen.foundation.color import luminance
from datagen.foundation.errors import InputError, input_error
from datagen.foundation.paths import inside
from datagen.foundation.progress import Advance, no_advance
from datagen.inspection.findings import Fault, Report
from datagen.library import Library
from datagen.rendering.error import relative_mse_of_parts
from datagen.rendering.renderer import SceneRenderer
from datagen.rendering.sample_budget import PathSums

DEPTH, ROULETTE_DEPTH = 65, 5
"""Maximum number of segments of a path, and the first segment at which Russian roulette may end it."""
PARTS = 4
CHUNK = 64
"""Maximum number of paths per pixel in one kernel launch."""
SEED = 0x0EC4EC40
"""Base of the launches' seeds; a dataset's seeds, which are hashes, hardly ever equal them."""
MAX_RATIO = 4.0
"""Maximum ratio of true to recorded error."""
MAX_BIAS = 0.05
"""Maximum relative deviation of the mean luminance."""
SURE = 3.0
"""Number of standard errors by which a deviation must exceed its limit to be a fault."""


@dataclass(frozen=True)
class Rechecked:
    """Comparison of a view with its rendering by plain path tracing.

    ``recorded`` is the estimated relMSE in the view's record (None if it was not rendered to an error
    target), ``rel_mse`` the true one, ``bias`` the relative deviation of the mean luminance.
    ``rel_mse_error`` and ``bias_error`` are the standard errors due to the noise of the plain paths.
    """

    configuration: str
    view: str
    path_samples: float
    recorded: float | None
    rel_mse: float
    rel_mse_error: float
    bias: float
    bias_error: float

    @property
    def where(self) -> str:
        """The view's name in reports."""
        return f"{self.configuration}/{self.view}"

    def faults(self) -> Iterable[Fault]:
        """Yield a warning for each deviation above its limit by more than :data:`SURE` standard errors."""
        if self.recorded is not None and self.rel_mse - SURE * self.rel_mse_error > MAX_RATIO * self.recorded:
            got = f"relMSE {self.rel_mse:.4f} +- {self.rel_mse_error:.4f} (recorded: {self.recorded:.4f})"
            yield Fault(
                "recheck", self.where, got, f"at most {MAX_RATIO:g} times the recorded value", "warning"
            )
        if abs(self.bias) - SURE * self.bias_error > MAX_BIAS:
            got = f"mean luminance {100 * self.bias:+.1f} +- {100 * self.bias_error:.1f} % from plain paths"
            expected = f"at most {100 * MAX_BIAS:g} %"
            yield Fault("recheck", self.where, got, expected, "warning")


def check_recheck(folder: Path, samples: int) -> None:
    """Raise :class:`InputError` if ``folder`` is a single shard, or if ``samples`` is not a multiple of 4."""
    if samples < PARTS or samples % PARTS:
        expected = f"a multiple of {PARTS}, the number of images that are compared"
        raise input_error("datagen verify", "--recheck-samples", samples, expected, "choose another number")
    if not folder.is_dir():
        remedy = "name the shard's dataset folder"
        raise input_error(folder, "--recheck", "a single shard", "a dataset folder", remedy)


def recheck(
    folder: Path, library: Library, count: int, samples: int, report: Report, progress: Advance = no_advance
) -> list[Rechecked]:
    """Render ``count`` random views again with ``samples`` paths per pixel; compare with the stored images.

    The recipe's seed selects the views. Faults and notes are added to ``report``. Configurations that are
    damaged or whose assets have changed are skipped with a note; without an index, all are.
    ``progress(done, total)`` counts views. The arguments must pass :func:`check_recheck`.
    """
    try:
        dataset = Dataset(folder)
    except InputError as error:
        report.notes.append(f"no view was rendered again: {error}")
        return []
    places = [(k, view) for k, shard in enumerate(dataset.index.shards) for view in range(shard.num_views)]
    chosen = np.random.default_rng([dataset.index.recipe.seed, count]).permutation(len(places))[:count]
    wanted: dict[int, list[int]] = {}
    for number in sorted(chosen):
        shard, view = places[number]
        wanted.setdefault(shard, []).append(view)
    found: list[Rechecked] = []
    for shard, views in wanted.items():
        file = dataset.index.shards[shard].file
        try:
            found += _recheck_shard(inside(folder, folder / file), set(views), library, samples, report)
        except InputError as error:
            report.notes.append(f"{file} was not rendered again: {error}")
        progress(len(found), len(chosen))
    report.applied["recheck"] += len(found)
    report.faults += [fault for view in found for fault in view.faults()]
    return found


def _recheck_shard(
    path: Path, positions: set[int], library: Library, samples: int, report: Report
) -> list[Rechecked]:
    configuration = ShardReader(path).configuration()
    for asset, digest in configuration.assets.items():
        if asset not in library or library.package(asset).sha256 != digest:
            report.notes.append(f"{path.name} was not rendered again: {asset} is missing or has changed")
            return []
    recipe = RenderRecipe(path_samples=1, auxiliary_samples=1, denoise=False)
    renderer = SceneRenderer(configuration, library, recipe)
    try:
        views = (view for k, view in enumerate(ShardReader(path, ["beauty"])) if k in positions)
        return [_against_plain_paths(renderer, view, samples) for view in views]
    finally:
        renderer.close()


def _against_plain_paths(renderer: SceneRenderer, view: View, samples: int) -> Rechecked:
    from datagen.rendering.transport.integrator import PathTracer

    tracer = PathTracer(renderer.built, renderer.materials, DEPTH, ROULETTE_DEPTH)
    sensor = renderer.sensor(view.record.camera.camera())
    parts = []
    for part in range(PARTS):
        sums, left = PathSums(), samples // PARTS
        while left > 0:
            seed = SEED + 0x10000 * part + left
            sums = sums + tracer.accumulate(sensor, min(CHUNK, left), seed, with_visible_emission=True)
            left -= CHUNK
        parts.append(sums.mean())
    return compared(view, parts)


def compared(view: View, parts: Sequence[NDArray[np.floating]]) -> Rechecked:
    """Compare a view with ``PARTS`` independent images (H, W, 3) by plain path tracing."""
    image = view.buffers["beauty"].astype(np.float64)
    rel_mse, rel_mse_error = relative_mse_of_parts(image, parts, exposed=True)
    levels = [luminance(part.astype(np.float64)) for part in parts]
    light = float(np.mean(levels))
    noise = np.var(levels, axis=0, ddof=1) / PARTS
    render = view.record.render
    return Rechecked(
        view.record.configuration,
        view.record.name,
        render.path_samples,
        render.estimated_rel_mse,
        rel_mse,
        rel_mse_error,
        float(luminance(image).mean()) / light - 1.0 if light > 0.0 else 0.0,
        float(np.sqrt(noise.sum())) / noise.size / light if light > 0.0 else 0.0,
    )


def print_rechecked(found: list[Rechecked], samples: int) -> None:
    """Print a table of recorded and true errors; ``samples`` is the number of plain paths per pixel."""
    from rich.table import Table

    from datagen.foundation.progress import table_console

    headings = ("view", "paths", "recorded relMSE", "true relMSE", "true / recorded", "bias")
    table = Table(*headings, title=f"against {samples} plain paths per pixel")
    for view in found:
        recorded = "-" if view.recorded is None else f"{view.recorded:.4f}"
        ratio = "-" if not view.recorded else f"{view.rel_mse / view.recorded:.2f}"
        true = f"{view.rel_mse:.4f} +- {view.rel_mse_error:.4f}"
        bias = f"{100 * view.bias:+.2f} +- {100 * view.bias_error:.2f} %"
        table.add_row(view.where, f"{view.path_samples:g}", recorded, true, ratio, bias)
    table_console().print(table)

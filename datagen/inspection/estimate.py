# SPDX-License-Identifier: MIT
"""Predicts time, disk space and memory of a recipe from two timed samples, of at most 4 and 8 views.

Each sample plans one configuration with the recipe's other settings, and runs it through all stages in a
temporary folder. Time and disk space are extrapolated linearly to all views and configurations. Memory,
planning time and the statistics' time *per view* are fitted as linear in a configuration's number of views.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from datagen.farm.folder import DatasetFolder, UnitManifest
from datagen.farm.local import LocalOptions, run_local
from datagen.farm.planning import create_plan
from datagen.farm.space import working_bytes
from datagen.formats.recipe import Recipe, SplitRecipe
from datagen.foundation.errors import input_error
from datagen.foundation.progress import Advance, duration, no_advance
from datagen.library import Library


@dataclass(frozen=True)
class Estimate:
    """Predicted cost of a recipe with one worker; ``working_bytes``: temporary files of a running unit."""

    num_configurations: int
    num_views: int
    seconds_per_view: float
    seconds_per_configuration: float
    planning_seconds: float
    total_seconds: float
    bytes_per_view: float
    total_bytes: float
    working_bytes: float
    peak_memory_mb: float
    sample_seconds: float


@dataclass(frozen=True)
class _Sample:
    num_views: int
    plan_s: float
    manifest: UnitManifest

    @property
    def view_s(self) -> float:
        return statistics.median(sum(t.seconds.values()) for t in self.manifest.views)

    def stage_s(self, stage: str) -> float:
        return self.manifest.seconds.get(stage, 0.0)


def _run_sample(recipe: Recipe, library: Library, num_views: int, root: Path) -> _Sample:
    # one configuration cannot be distributed over several splits; its split does not affect its cost
    small = recipe.model_copy(update={"configurations": 1, "views": num_views, "splits": SplitRecipe()})
    start = time.perf_counter()
    plan = create_plan(small, library, root)
    plan_s = time.perf_counter() - start
    summary = run_local(root, LocalOptions(attempts=1))
    if summary.interrupted:
        raise KeyboardInterrupt
    if summary.failures:
        reason = summary.failures[0].reason
        raise input_error("estimate", "sample", reason, "a unit without errors", "correct the error")
    manifest = DatasetFolder(root).read_manifest(plan.units[0])
    assert manifest is not None
    return _Sample(num_views, plan_s, manifest)


def _line(x1: float, y1: float, x2: float, y2: float, x: float) -> float:
    """Value at ``x`` of the line through (x1, y1) and (x2, y2); a negative slope is replaced by 0."""
    slope = max(0.0, (y2 - y1) / (x2 - x1)) if x2 != x1 else 0.0
    return y2 + slope * (x - x2) if x >= x2 else y1 + slope * (x - x1)


def estimate(recipe: Recipe, library: Library, report: Advance = no_advance) -> Estimate:
    """Predict the cost of ``recipe`` from timed samples, counted by ``report(done, total)``.

    Raises :class:`InputError` if a sample fails.
    """
    begin = time.perf_counter()
    samples = []
    sizes = sorted({min(4, recipe.views), min(8, recipe.views)})
    with tempfile.TemporaryDirectory(prefix="datagen-estimate-") as folder:
        for number, num_views in enumerate(sizes):
            report(number, len(sizes))
            samples.append(_run_sample(recipe, library, num_views, Path(folder) / str(number)))
        report(len(sizes), len(sizes))
    a, b = samples[0], samples[-1]
    views = recipe.views
    once_s = statistics.median(max(0.0, s.stage_s("render") - s.num_views * s.view_s) for s in samples)
    few_s, many_s = (s.stage_s("stats") / s.num_views for s in (a, b))
    statistics_s = _line(a.num_views, few_s, b.num_views, many_s, views) * views
    pack_s = b.stage_s("pack") / b.num_views * views
    planning_s = _line(a.num_views, a.plan_s, b.num_views, b.plan_s, views) * recipe.configurations
    unit_s = once_s + b.view_s * views + statistics_s + pack_s
    bytes_per_view = b.manifest.num_bytes / b.num_views
    return Estimate(
        num_configurations=recipe.configurations,
        num_views=recipe.configurations * views,
        seconds_per_view=unit_s / views,
        seconds_per_configuration=unit_s,
        planning_seconds=planning_s,
        total_seconds=planning_s + unit_s * recipe.configurations,
        bytes_per_view=bytes_per_view,
        total_bytes=bytes_per_view * views * recipe.configurations,
        working_bytes=float(views * working_bytes(recipe)),
        peak_memory_mb=_line(
            a.num_views, a.manifest.peak_memory_mb, b.num_views, b.manifest.peak_memory_mb, views
        ),
        sample_seconds=time.perf_counter() - begin,
    )


def print_estimate(result: Estimate, workers: int, free_bytes: float, as_json: bool = False) -> bool:
    """Print the prediction; return whether ``free_bytes`` suffice for the dataset and all workers."""
    needed = result.total_bytes + workers * result.working_bytes
    if as_json:
        import json

        print(json.dumps(asdict(result), indent=2))
        return needed <= free_bytes
    hours = result.total_seconds / 3600
    print(f"{result.num_configurations} configurations, {result.num_views} views")
    print(
        f"time    {duration(result.total_seconds)} on this machine, "
        f"{result.seconds_per_view:.2f} s per view, {duration(result.seconds_per_configuration)} per "
        f"configuration ({hours:.1f} machine hours, which a farm shares among its nodes)"
    )
    print(
        f"disk    {result.total_bytes / 1e9:.2f} GB, {result.bytes_per_view / 1e6:.2f} MB per view, and "
        f"{workers * result.working_bytes / 1e9:.2f} GB for {workers} units in progress; "
        f"{free_bytes / 1e9:.1f} GB are free"
    )
    print(f"memory  {result.peak_memory_mb / 1024:.2f} GB per worker, {workers} workers")
    print(f"(from samples that took {duration(result.sample_seconds)})")
    if needed > free_bytes:
        print("the disk is too small: free space, or lower configurations, views or resolution")
    return needed <= free_bytes

# SPDX-License-Identifier: MIT
"""Runs ``datagen report``: verifies a dataset, measures its shards, and writes a folder with this content.

index.html report.css *.js    the page
data/summary.js data/views.js measured values, and one line per view
data/predictions.js           errors of predicted maps by method and view
configurations/<id>.js        cameras and names, loaded when a view of that configuration is opened
thumbnails/<id>/<view>.jpg
tiles/<id>/<view>/<buffer>.html pixels, loaded on demand
tiles/predictions/<method>/<id>/<view>/<map>.html predicted maps
gathered/<id>.json            stored counts, reused by the next report
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib.resources import files
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import quote

from datagen.farm.folder import DatasetFolder, library_of, rooms_of
from datagen.formats.base import write_bytes_atomically
from datagen.formats.shard import INDEX_FILE, Dataset, DatasetIndex
from datagen.foundation.buffers import BUFFERS, MIN_COVERAGE
from datagen.foundation.color import LUMINANCE_WEIGHTS, cividis
from datagen.foundation.errors import InputError, input_error, raise_problems
from datagen.foundation.paths import output_problems
from datagen.foundation.progress import Bars, Progress
from datagen.inspection.contact_sheet import COLUMNS
from datagen.inspection.report import summary
from datagen.inspection.report.gather import SHOWN_BUFFERS, GatherJob, gather_shard
from datagen.inspection.report.predictions import TILES, CompareJob, Method, compare_shard, prediction_table
from datagen.inspection.report.tiles import write_script
from datagen.inspection.verify import verify_dataset
from datagen.library import Library
from datagen.multiview.visibility import VisibilityOptions

if TYPE_CHECKING:
    from datagen.inspection.commands import ReportOptions

PAGE_FILES = (
    "index.html", "report.css", "store.js", "charts.js", "overview.js", "compare.js", "gallery.js",
    "panels.js", "viewer.js", "sources.js", "main.js",
)  # fmt: skip
_LABELS = {name: label.replace("  ", ", ") for name, label in COLUMNS}
_LABELS["observation_count"] = "observation count"


@dataclass(frozen=True)
class ReportResult:
    """Result of :func:`write_report`: page, numbers of views and of views with pixels, size of the tiles.

    ``num_faults`` is None if the dataset was not verified; ``predicted`` contains, by method, the numbers of
    predicted views and of faulty predictions.
    """

    page: Path
    num_views: int
    num_pixel_views: int
    tile_bytes: int
    num_faults: int | None
    predicted: dict[str, tuple[int, int]] = field(default_factory=dict)


def choose_configurations(index: DatasetIndex, max_views: int | None, first: Iterable[str] = ()) -> set[str]:
    """Choose the configurations whose pixels are written: ``first``, then others evenly spaced by index.

    Together they have at most ``max_views`` views; None chooses all configurations.
    """
    if max_views is None:
        return {shard.configuration for shard in index.shards}
    views = {shard.configuration: shard.num_views for shard in index.shards}
    count = len(index.shards)
    # every prefix of the bit-reversed order is evenly spaced
    bits = max(count - 1, 1).bit_length()
    spread = sorted(range(count), key=lambda i: int(f"{i:0{bits}b}"[::-1], 2))
    order = [*dict.fromkeys([*first, *(index.shards[i].configuration for i in spread)])]
    chosen: set[str] = set()
    left = max_views
    for identity in order:
        if identity in views and views[identity] <= left:
            chosen.add(identity)
            left -= views[identity]
    return chosen


def estimate_tile_bytes(index: DatasetIndex, chosen: set[str]) -> int:
    """Estimate the size in bytes of the pixel files of configurations ``chosen``.

    Base64 adds a third to the size of the shards; the source views need about as much space as a few buffers.
    """
    return int(1.55 * sum(shard.num_bytes for shard in index.shards if shard.configuration in chosen))


def write_report(
    folder: Path,
    out: Path,
    options: ReportOptions,
    library: Library | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> ReportResult:
    """Write the report of a dataset folder into ``out``, or update an existing one.

    ``progress(stage, done, total)`` counts shards. Raises :class:`InputError` if the folder has no index,
    ``out`` contains other files, there is no readable shard, or source views are requested without LLVM.
    """
    index, methods = Dataset(folder).index, options.methods
    if not index.shards:
        remedy = "render the plan first: datagen run"
        raise input_error(folder / INDEX_FILE, "", "no shards", "at least one", remedy)
    raise_problems(output_problems(out, (out / "gathered").is_dir(), "an earlier report"))
    (out / "gathered").mkdir(parents=True, exist_ok=True)
    found = None
    if options.check:
        found = verify_dataset(folder, library, options.workers, partial(progress, "verify"))
    worst = summary.findings(found, index, [])["views"]
    first = [w["configuration"] for w in worst] + predicted_configurations(index, methods)
    chosen = choose_configurations(index, options.max_pixel_views, first)
    jobs = [
        GatherJob(folder / shard.file, shard, out, shard.configuration in chosen, options.sources)
        for shard in index.shards
    ]
    gathered, unreadable = _run_jobs(jobs, gather_shard, "figures", options.workers, progress)
    if not gathered:
        raise InputError(*unreadable[0][1].problems)
    damaged = {job.shard for job, _ in unreadable}
    pairs = [
        CompareJob(job.shard, job.record, out, method, job.with_pixels)
        for method in methods
        for job in jobs
        if job.shard not in damaged and method.covers(job.record.configuration)
    ]
    _remove_obsolete(out, methods, {shard.configuration for shard in index.shards})
    compared, _ = _run_jobs(pairs, compare_shard, "predictions", options.workers, progress)
    predictions = prediction_table(methods, compared, gathered)
    data = {
        **_head(index, folder),
        "sheets": _sheets(index, folder, out),
        "distributions": summary.distributions(gathered),
        "coverage": summary.coverage(gathered),
        "assets": summary.assets(gathered, index, library),
        "splits": summary.splits(index),
        "effort": summary.effort(DatasetFolder(folder), index, options.cost),
        "findings": summary.findings(found, index, gathered),
        "unreadable": [[job.record.file, str(error)] for job, error in unreadable],
    }
    for name, content in (("summary", data), ("views", view_table(gathered)), ("predictions", predictions)):
        write_script(out / "data" / f"{name}.js", f"{name} = ", content)
    page = files("datagen.inspection.report") / "page"
    for name in PAGE_FILES:
        write_bytes_atomically(out / name, (page / name).read_bytes())
    return ReportResult(
        page=out / "index.html",
        num_views=sum(len(shard["views"]) for shard in gathered),
        num_pixel_views=sum(len(shard["views"]) for shard in gathered if shard["has_pixels"]),
        tile_bytes=sum(shard["tile_bytes"] for shard in (*gathered, *compared)),
        num_faults=len(found.faults) if found is not None else None,
        predicted={m["label"]: (m["num_views"], m["num_problems"]) for m in predictions["methods"]},
    )


def predicted_configurations(index: DatasetIndex, methods: Iterable[Method]) -> list[str]:
    """Configurations with predictions by at least one method, in the order of the index."""
    return [
        shard.configuration
        for shard in index.shards
        if any(method.covers(shard.configuration) for method in methods)
    ]


def _remove_obsolete(out: Path, methods: Iterable[Method], configurations: set[str]) -> None:
    """Remove the files of methods and configurations of an earlier report that are not in this one."""
    slugs = {method.slug for method in methods}
    kept = {
        out / "tiles": configurations | {TILES},
        out / "tiles" / TILES: slugs,
        out / "gathered": configurations | {"predictions"},
        out / "gathered" / "predictions": slugs,
        out / "thumbnails": configurations,
        out / "configurations": configurations,
    }
    for home, names in kept.items():
        for path in home.iterdir() if home.is_dir() else ():
            if path.stem not in names and path.is_dir():
                shutil.rmtree(path)
            elif path.stem not in names:
                path.unlink()


Job = TypeVar("Job", GatherJob, CompareJob)


def _run_jobs(
    jobs: Sequence[Job], work: Callable[[Job], dict[str, Any]], stage: str, workers: int, progress: Progress
) -> tuple[list[dict[str, Any]], list[tuple[Job, InputError]]]:
    """Run ``jobs`` in processes; return the results in order, and the failed jobs with their errors."""
    results: dict[int, dict[str, Any]] = {}
    failures: dict[int, InputError] = {}

    def take(position: int, call: Callable[[], dict[str, Any]]) -> None:
        try:
            results[position] = call()
        except InputError as error:
            failures[position] = error
        progress(stage, len(results) + len(failures), len(jobs))

    if workers <= 1 or len(jobs) <= 1:
        for position, job in enumerate(jobs):
            take(position, partial(work, job))
    else:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            futures = {pool.submit(work, job): position for position, job in enumerate(jobs)}
            for future in as_completed(futures):
                take(futures[future], future.result)
    ordered = [results[position] for position in sorted(results)]
    return ordered, [(jobs[position], failures[position]) for position in sorted(failures)]


def _sheets(index: DatasetIndex, folder: Path, out: Path) -> dict[str, str]:
    """Paths of contact sheets by configuration, relative to the page; none for a page outside the dataset."""
    page, root = out.resolve(), folder.resolve()
    if not page.is_relative_to(root):  # the page may be moved without the dataset
        return {}
    up = "../" * len(page.relative_to(root).parts)
    identities = [shard.configuration for shard in index.shards]
    return {i: f"{up}sheets/{quote(i)}.png" for i in identities if (root / "sheets" / f"{i}.png").is_file()}


def _head(index: DatasetIndex, folder: Path) -> dict[str, Any]:
    """Plain data on the dataset, its buffers, and the constants of the statistics for the viewer."""
    visibility = VisibilityOptions()
    shown = [name for name in SHOWN_BUFFERS if name in index.buffers]
    return {
        "name": index.recipe.name,
        "folder": folder.resolve().name,
        "made": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "variant": index.variant,
        "versions": index.versions,
        "num_configurations": index.num_configurations,
        "num_views": index.num_views,
        "resolution": index.recipe.resolution,
        "is_complete": index.is_complete,
        "missing": index.missing,
        "recipe": index.recipe.model_dump(mode="json"),
        "buffers": [
            {
                **{k: v for k, v in asdict(BUFFERS[name]).items() if k in ("name", "channels", "unit")},
                "label": _LABELS[name],
                "description": BUFFERS[name].description,
                "is_radiance": BUFFERS[name].unit.startswith("W"),
            }
            for name in shown
        ],
        "min_coverage": MIN_COVERAGE,
        "depth_agreement": visibility.depth_tolerance + visibility.slope_limit,
        "luminance_weights": LUMINANCE_WEIGHTS.tolist(),
        "color_map": cividis(),
    }


VIEW_COLUMNS = (
    "name", "samples", "rel_mse", "clipped_pixels", "exposure", "height_m", "surface_share", "mean_count",
)  # fmt: skip


def view_table(gathered: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Plain data of a table with a row per view; rows are lists without keys, to save space."""
    configurations, rows = [], []
    for number, shard in enumerate(gathered):
        configurations.append([shard["id"], shard["split"], shard["has_pixels"]])
        rows += [[number, *(view[name] for name in VIEW_COLUMNS)] for view in shard["views"]]
    return {"configurations": configurations, "columns": ["configuration", *VIEW_COLUMNS], "rows": rows}


def report_command(
    folder: Path,
    out: Path | None,
    options: ReportOptions,
    library_paths: Iterable[Path] | None = None,
    is_dry_run: bool = False,
) -> int:
    """Print the planned output and, unless ``is_dry_run``, write the report; return the exit code.

    Raises :class:`InputError` if the disk has too little space, or for the reasons of :func:`write_report`.
    """
    methods, max_views = options.methods, options.max_pixel_views
    index = Dataset(folder).index
    target = out if out is not None else folder / "report"
    first = predicted_configurations(index, methods)
    chosen = choose_configurations(index, max_views, first)
    num_bytes = estimate_tile_bytes(index, chosen)
    num_views = sum(shard.num_views for shard in index.shards if shard.configuration in chosen)
    print(
        f"{target}: {index.num_views} views; pixels of {num_views} views in {len(chosen)} configurations, "
        f"about {num_bytes / 1e6:,.0f} MB",
        flush=True,
    )
    if is_dry_run:
        return 0
    existing = next(p for p in (target.absolute(), *target.absolute().parents) if p.exists())
    free = shutil.disk_usage(existing).free
    if num_bytes > free:
        remedy = "write fewer pixels with --pixels, or choose another --out"
        got, expected = f"{num_bytes / 1e6:,.0f} MB", f"at most {free / 1e6:,.0f} MB"
        raise input_error(target, "--pixels", got, expected, remedy)
    paths = [*library_paths, *rooms_of(folder)] if library_paths is not None else library_of(folder)
    with Bars("shards") as bars, Library(paths) if paths else nullcontext() as library:
        result = write_report(folder, target, options, library, bars.tell)
    faults = "not verified" if result.num_faults is None else f"{result.num_faults} findings"
    print(f"{result.num_views} views, {faults}, {result.tile_bytes / 1e6:,.0f} MB of pixels")
    for label, (num_views, num_problems) in result.predicted.items():
        what = f"{num_views} of {result.num_views} views predicted"
        print(f"{label}: {what}, {num_problems} with problems" if num_problems else f"{label}: {what}")
    print(f"open {result.page.absolute().as_uri()}")
    return 0

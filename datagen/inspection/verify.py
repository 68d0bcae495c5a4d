# SPDX-License-Identifier: MIT
"""Reads a dataset and reports faults of its content, shard by shard: ``datagen verify``.

A fault does not end the verification: all other members are still checked. The checks are in ``checks``,
``reprojection`` and ``shard_check``.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from datagen.farm.collect import find_leftovers
from datagen.farm.folder import library_of, rooms_of
from datagen.formats.asset import EnvironmentAsset, ObjectAsset, Texture
from datagen.formats.base import read_json
from datagen.formats.configuration import Configuration
from datagen.formats.shard import INDEX_FILE, DatasetIndex, ShardReader
from datagen.formats.textures import texture_values
from datagen.foundation.errors import InputError, input_error
from datagen.foundation.images import read_image
from datagen.foundation.paths import inside
from datagen.foundation.progress import Advance, Bars, no_advance
from datagen.inspection.findings import Fault, Report, Severity
from datagen.inspection.recheck import Rechecked, check_recheck, print_rechecked
from datagen.inspection.recheck import recheck as recheck_views
from datagen.inspection.shard_check import ShardJob, verify_shard
from datagen.library import Library
from datagen.rendering.materials import resolve_materials

_MAX_LISTED = 40


def verify_dataset(
    path: Path, library: Library | None = None, workers: int = 1, progress: Advance = no_advance
) -> Report:
    """Verify a dataset folder, or a single shard (``.tar``).

    Without the dataset's ``library``, roughness is not checked, which is noted in the report.
    ``progress(done, total)`` counts shards. Raises :class:`InputError` for any other ``path``.
    """
    report = Report(str(path))
    if path.is_file() and path.suffix == ".tar":
        jobs = [ShardJob(path, path.name)]
    elif path.is_dir():
        jobs = _jobs_of_folder(path, report)
        if not jobs and not (path / INDEX_FILE).exists():
            remedy = "name a dataset folder or a shard, or make one with `datagen run`"
            raise input_error(path, "", f"neither {INDEX_FILE} nor shards", "a dataset", remedy)
    else:
        raise input_error(path, "", "neither a folder nor a .tar file", "a dataset", "check the path")
    if library is None:
        report.notes.append("roughness was not checked: the dataset's library was not found")
    else:
        jobs = [replace(job, textured=_textured_materials(job, library, report)) for job in jobs]
    for done, found in enumerate(_run(jobs, workers)):
        report.merge(found)
        progress(done + 1, len(jobs))
    return report


def _run(jobs: list[ShardJob], workers: int) -> Iterable[Report]:
    if workers <= 1 or len(jobs) <= 1:
        yield from map(verify_shard, jobs)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(verify_shard, jobs)


def _jobs_of_folder(folder: Path, report: Report) -> list[ShardJob]:
    """Return a job per shard in the index, or on disk without a readable index; report the index's faults."""
    report.applied["index"] += 1
    on_disk = sorted({*folder.glob("*.tar"), *folder.glob("shards/*.tar")})
    try:
        index = read_json(DatasetIndex, inside(folder, folder / INDEX_FILE))
    except InputError as error:
        for p in error.problems:
            report.faults.append(Fault("index", str(p.where), f"{p.field} {p.got}".strip(), p.expected))
        return [ShardJob(path, str(path.relative_to(folder))) for path in on_disk if path.is_file()]
    where = str(folder / INDEX_FILE)

    def add(got: str, expected: str, severity: Severity = "error") -> None:
        report.faults.append(Fault("index", where, got, expected, severity))

    if not index.is_complete:
        names = ", ".join(index.missing[:5]) + (" ..." if len(index.missing) > 5 else "")
        add(f"{len(index.missing)} configurations are missing: {names}", "a complete dataset", "warning")
    listed = {folder / record.file for record in index.shards}
    leftovers: list[Path] = []
    with suppress(InputError):  # a folder without a plan, such as a copy of the shards
        leftovers = find_leftovers(folder)
    for stray in sorted({*on_disk, *leftovers} - listed):
        got = f"{stray.relative_to(folder)} is not listed"
        if stray in leftovers:
            remedy = "`datagen run --only index` removes it"
            got = f"{stray.relative_to(folder)} was left by a killed attempt; {remedy}"
        add(got, "only files that the index lists", "warning")
    sums = {
        "num_configurations": len(index.shards),
        "num_views": sum(record.num_views for record in index.shards),
        "num_bytes": sum(record.num_bytes for record in index.shards),
    }
    for name, value in sums.items():
        if getattr(index, name) != value:
            add(f"{name} = {getattr(index, name)}", f"{value}, the sum over its shards")
    if index.recipe.splits.disjoint:
        report.applied["split"] += 1
        report.faults += _check_split(index, where)
    jobs = []
    for record in index.shards:
        try:
            inside(folder, folder / record.file)
        except InputError as error:
            add(f"shard {record.file!r}: {error.problems[0].got}", "a file inside the dataset")
            continue
        jobs.append(ShardJob(folder / record.file, record.file, record, index.buffers))
    return jobs


def _check_split(index: DatasetIndex, where: str) -> list[Fault]:
    used: dict[str, set[str]] = {}
    for record in index.shards:
        used.setdefault(record.split, set()).update(record.assets)
    expected = "splits that share no asset (splits.disjoint)"
    return [
        Fault("split", where, f"{asset} is in both the {one} and the {other} split", expected)
        for one, other in itertools.combinations(sorted(used), 2)
        for asset in sorted(used[one] & used[other])
    ]


# ---------------------------------------------------------------------- materials with varying roughness


def expected_roughness(configuration: Configuration, library: Library) -> dict[str, float]:
    """Range of roughness of each material with a roughness texture, by its name in the views' records.

    The range is the difference of the texture's 99th and 1st percentiles with the roughness offset, clipped
    to [0, 1]; with several offsets, the smallest. Raises :class:`InputError` if an asset or image is missing.
    """
    ranges: dict[str, float] = {}
    for placed in (configuration.environment, *configuration.objects):
        package = library.package(placed.asset)
        if not isinstance(package.asset, ObjectAsset | EnvironmentAsset):
            continue
        for surface in resolve_materials(placed, package, library, []).values():
            texture = surface.material.roughness
            if isinstance(texture, Texture):
                pixels = read_image(surface.package.local_file(texture.texture))
                values = texture_values(texture, pixels, is_scalar=True) + surface.adjustment.roughness_offset
                low, high = np.percentile(np.clip(values, 0, 1), [1, 99])
                ranges[surface.name] = min(float(high - low), ranges.get(surface.name, np.inf))
    return ranges


def _textured_materials(job: ShardJob, library: Library, report: Report) -> dict[str, float] | None:
    try:
        configuration = ShardReader(job.path).configuration()
    except InputError:
        return None  # reported when the shard is read
    for asset_id, digest in configuration.assets.items():
        if asset_id in library and library.package(asset_id).sha256 != digest:
            report.notes.append(f"roughness of {job.file} was not checked: {asset_id} has changed")
            return None
    try:
        return expected_roughness(configuration, library)
    except InputError as error:
        report.notes.append(f"roughness of {job.file} was not checked: {error}")
        return None


# ---------------------------------------------------------------------- the command


def verify_command(
    path: Path,
    library_paths: Sequence[Path] | None = None,
    workers: int = 1,
    as_json: bool = False,
    strict: bool = False,
    recheck: int = 0,
    recheck_samples: int = 256,
) -> int:
    """Verify a dataset or shard, print a table (or JSON) and return the exit code.

    Without ``library_paths``, the dataset's libraries are used if they still exist. ``recheck`` views are
    rendered again by plain path tracing, with ``recheck_samples`` paths per pixel. Raises :class:`InputError`
    if ``path`` is not a dataset, or if ``recheck`` is given without a library or fails :func:`check_recheck`.
    """
    library_paths = library_of(path) if library_paths is None else [*library_paths, *rooms_of(path)]
    if recheck:
        check_recheck(path, recheck_samples)
    if recheck and not library_paths:
        remedy = "name it with --library"
        raise input_error(path, "--recheck", "no library", "the assets of the views to render", remedy)
    found: list[Rechecked] = []
    with ExitStack() as stack:
        library = stack.enter_context(Library(library_paths)) if library_paths else None
        bars = stack.enter_context(Bars(is_transient=True, is_quiet=as_json))
        report = verify_dataset(path, library, workers, partial(bars.tell, "verify"))
        if library is not None and recheck:
            tell = partial(bars.tell, "recheck")
            found = recheck_views(path, library, recheck, recheck_samples, report, tell)
            report.rechecked = [asdict(view) for view in found]
    if as_json:
        print(report.to_json())
    else:
        print_report(report)
        if found:
            print_rechecked(found, recheck_samples)
    return report.exit_code(strict)


def print_report(report: Report) -> None:
    """Print the report as a table of checks and a list of findings."""
    from rich.table import Table

    from datagen.foundation.progress import table_console

    console = table_console()
    table = Table("check", "asserts", "checked", "errors", "warnings", title=report.path)
    for check, asserts, applied, errors, warnings in report.counts():
        style = "red" if errors else "yellow" if warnings else None
        numbers = str(applied or "-"), str(errors or ""), str(warnings or "")
        table.add_row(check, asserts, *numbers, style=style)
    console.print(table)
    for fault in report.faults[:_MAX_LISTED]:
        console.print(str(fault), style="red" if fault.severity == "error" else "yellow")
    if len(report.faults) > _MAX_LISTED:
        console.print(f"... and {len(report.faults) - _MAX_LISTED} more; --json lists all")
    for note in report.notes:
        console.print(f"note: {note}")
    verdict = f"{report.num_errors} errors, {len(report.faults) - report.num_errors} warnings"
    console.print(f"{report.num_shards} shards, {report.num_views} views: {verdict}")

# SPDX-License-Identifier: MIT
"""Runs ``datagen report`` and prints its plan, progress and result."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path

from datagen.farm.folder import library_of, rooms_of
from datagen.formats.shard import Dataset
from datagen.foundation.errors import input_error
from datagen.foundation.progress import Bars
from datagen.inspection.report.writing import (
    ReportOptions,
    choose_configurations,
    estimate_tile_bytes,
    predicted_configurations,
    write_report,
)
from datagen.library import Library


def parse_pixels(text: str) -> int | None:
    """Parse ``--pixels``: a number of views, or None for "all". Raises :class:`InputError` otherwise."""
    if text == "all":
        return None
    if not text.isdecimal():
        raise input_error("--pixels", "", repr(text), 'a number of views, or "all"', "correct it")
    return int(text)


def report_command(
    folder: Path,
    out: Path | None,
    options: ReportOptions,
    library_paths: Iterable[Path] | None = None,
    is_dry_run: bool = False,
) -> int:
    """Print the planned output and, unless ``is_dry_run``, write the report; returns the exit code.

    Raises :class:`InputError` if the disk has too little space, or for the reasons of :func:`write_report`.
    """
    index = Dataset(folder).index
    target = out if out is not None else folder / "report"
    first = predicted_configurations(index, options.predictions)
    chosen = choose_configurations(index, options.max_pixel_views, first)
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

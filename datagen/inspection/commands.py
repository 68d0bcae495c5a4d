# SPDX-License-Identifier: MIT
"""The subcommands ``doctor``, ``library``, ``verify`` and ``report`` of ``datagen``, which defer heavy
imports.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from datagen.foundation.command_line import with_options
from datagen.foundation.progress import Bars


def doctor() -> None:
    """List installed and used components; the exit code is 0 if rendering can work.

    Example: datagen doctor
    """
    from datagen.inspection.doctor import examine, print_report

    findings = examine()
    print_report(findings)
    raise typer.Exit(0 if all(f.is_fine or not f.is_required for f in findings) else 1)


def library(
    paths: Annotated[
        list[str] | None,
        typer.Argument(help='Library folders; "bundled" (the default) is the project\'s own.'),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Read every mesh and texture as well.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """List the assets of libraries with class, size and licence; --check finds their faults.

    Example: datagen library bundled my-library --check
    """
    from datagen.inspection.library_table import print_library

    raise typer.Exit(print_library(paths or ["bundled"], check, as_json))


LibraryOption = Annotated[
    list[str] | None,
    typer.Option("--library", help="Library folder, repeatable; the dataset's own if left out."),
]
WorkersOption = Annotated[int, typer.Option("--workers", min=1, help="Processes to use.")]


def _resolve(library: list[str] | None) -> list[Path] | None:
    from datagen.library import resolve_library_paths

    return list(resolve_library_paths(library, Path.cwd())) if library else None


def verify(
    path: Annotated[Path, typer.Argument(help="Dataset folder, or one shard.")],
    library: LibraryOption = None,
    workers: WorkersOption = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the whole report as JSON.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Treat warnings as errors.")] = False,
    recheck: Annotated[
        int, typer.Option(min=0, help="Render N random views again by plain path tracing, and compare.")
    ] = 0,
    recheck_samples: Annotated[
        int, typer.Option(min=4, help="Paths per pixel of each view, a multiple of 4.")
    ] = 256,
) -> None:
    """Check a dataset for semantic faults; exit code 1 if there are any.

    Example: datagen verify smoke --workers 2 --recheck 3
    """
    from datagen.inspection.verify import verify_command

    raise typer.Exit(
        verify_command(path, _resolve(library), workers, as_json, strict, recheck, recheck_samples)
    )


@dataclass(frozen=True)
class ReportWords:
    """Options for the report's contents."""

    pixels: Annotated[str, typer.Option(help="Views whose pixels are written: a number, or all.")] = "400"
    sources: Annotated[bool, typer.Option(help="Also the source views of each pixel's statistics.")] = True
    check: Annotated[bool, typer.Option("--verify/--no-verify", help="Verify the dataset first.")] = True
    cost: Annotated[float, typer.Option(min=0, help="Price of an hour of a unit's resources.")] = 0.0
    predictions: Annotated[
        tuple[Path, ...],
        typer.Option(help="Folder of predicted maps to show against the truth, repeatable."),
    ] = ()
    label: Annotated[
        tuple[str, ...], typer.Option(help="Name for the predictions, repeatable, in their order.")
    ] = ()


@with_options
def report(
    folder: Annotated[Path, typer.Argument(help="Dataset folder.")],
    words: ReportWords,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the page; report/ inside the dataset if left out.")
    ] = None,
    sheets_only: Annotated[
        bool, typer.Option("--sheets-only", help="Write the missing contact sheets, and no page.")
    ] = False,
    workers: WorkersOption = 1,
    library: LibraryOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the planned output and stop.")] = False,
) -> None:
    """Write a page that shows the contents of a dataset, with a viewer; it opens from disk in any browser.

    Example: datagen report smoke --workers 2
    """
    if sheets_only:
        write_sheets(folder)
        return
    from datagen.inspection.report.command import parse_pixels, report_command
    from datagen.inspection.report.predictions import parse_methods
    from datagen.inspection.report.writing import ReportOptions

    methods = parse_methods(words.predictions, words.label)
    pixels = parse_pixels(words.pixels)
    options = ReportOptions(pixels, words.sources, words.check, words.cost, workers, methods)
    raise typer.Exit(report_command(folder, out, options, _resolve(library), dry_run))


def write_sheets(folder: Path) -> None:
    """Write the missing contact sheets, and print their paths."""
    from datagen.inspection.contact_sheet import write_dataset_sheets

    with Bars("configurations") as bars:
        written = write_dataset_sheets(folder, partial(bars.tell, "contact sheets"))
    typer.echo(f"{folder}: contact sheets in {folder / 'sheets'} ({len(written)} new)")

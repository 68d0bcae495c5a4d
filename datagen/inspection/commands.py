# SPDX-License-Identifier: MIT
"""The subcommands ``doctor``, ``library``, ``verify`` and ``report``; they import heavy modules on demand."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from datagen.foundation.command_line import finite, with_options
from datagen.foundation.errors import input_error
from datagen.foundation.progress import Bars

if TYPE_CHECKING:
    from datagen.inspection.report.predictions import Method


def doctor() -> None:
    """List installed components and their faults. The exit code is 0 if rendering is possible.

    Example: datagen doctor
    """
    from datagen.inspection.doctor import examine, print_report

    findings = examine()
    print_report(findings)
    raise typer.Exit(0 if all(f.is_fine or not f.is_required for f in findings) else 1)


def library(
    paths: Annotated[
        list[str] | None,
        typer.Argument(help='Library folders; "bundled" (default) is installed with the project.'),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Check every asset, mesh and texture.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """List the assets of libraries with class, size and licence. --check finds their faults.

    Example: datagen library bundled my-library --check
    """
    from rich.table import Column, Table

    from datagen.foundation.progress import table_console
    from datagen.library import check_library, describe_library, find_packages, resolve_library_paths

    folders = resolve_library_paths(paths or ["bundled"], Path.cwd())
    for path in folders:
        if path.is_dir() and not find_packages(path):
            remedy = "name another folder, or add packages with `datagen import` or the Blender add-on"
            raise input_error(path, "", "no asset packages", "a library folder", remedy)
    if check:
        with Bars("packages", is_transient=True) as bars:
            report = check_library(folders, partial(bars.tell, "check"))
        if as_json:
            errors, warnings = [*map(str, report.errors)], [*map(str, report.warnings)]
            print(json.dumps({"errors": errors, "warnings": warnings}))
        else:
            for problem in report.warnings:
                print(f"warning: {problem}")
            for problem in report.errors:
                print(f"error: {problem}")
            counts = f"{len(report.errors)} errors, {len(report.warnings)} warnings"
            print(f"{report.num_packages} packages: {counts}")
        raise typer.Exit(1 if report.errors else 0)
    summaries = describe_library(folders, with_hash=as_json)
    if as_json:
        print(json.dumps([{**asdict(s), "path": str(s.path)} for s in summaries], indent=2))
        return
    table = Table("kind", Column("id", overflow="fold"), "title", "what", "licence")
    for summary in summaries:
        licence = summary.license + (" (evaluation only)" if summary.usage != "any" else "")
        table.add_row(summary.kind, summary.id, summary.title, summary.detail, licence)
    table_console().print(table)
    by_kind = Counter(s.kind for s in summaries)
    print(", ".join(f"{count} {kind}s" for kind, count in sorted(by_kind.items())))


LibraryOption = Annotated[
    list[str] | None,
    typer.Option("--library", help="Library folder, repeatable; default: those of the dataset."),
]
WorkersOption = Annotated[int, typer.Option("--workers", min=1, help="Processes to use.")]


def _resolve(library: list[str] | None) -> list[Path] | None:
    from datagen.library import resolve_library_paths

    return list(resolve_library_paths(library, Path.cwd())) if library else None


def verify(
    path: Annotated[Path, typer.Argument(help="Dataset folder, or one shard.")],
    library: LibraryOption = None,
    workers: WorkersOption = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Treat warnings as errors.")] = False,
    recheck: Annotated[
        int, typer.Option(min=0, help="Number of random views to compare with plain path tracing.")
    ] = 0,
    recheck_samples: Annotated[
        int, typer.Option(min=4, help="Paths per pixel of each view, a multiple of 4.")
    ] = 256,
) -> None:
    """Check the content of a dataset for faults. The exit code is 1 if there are any.

    Example: datagen verify smoke --workers 2 --recheck 3
    """
    from datagen.inspection.verify import verify_command

    raise typer.Exit(
        verify_command(path, _resolve(library), workers, as_json, strict, recheck, recheck_samples)
    )


@dataclass(frozen=True)
class ReportOptions:
    """Options for the contents of the report, and the number of processes that write it."""

    pixels: Annotated[str, typer.Option(help="Number of views to show in the pixel viewer, or all.")] = "400"
    sources: Annotated[bool, typer.Option(help="Write which views each pixel's statistics use.")] = True
    check: Annotated[bool, typer.Option("--verify/--no-verify", help="Verify the dataset first.")] = True
    cost: Annotated[
        float, typer.Option(min=0, callback=finite, help="Price of one unit's resources per hour.")
    ] = 0.0
    predictions: Annotated[
        tuple[Path, ...],
        typer.Option(help="Folder of predicted maps to compare with the ground truth, repeatable."),
    ] = ()
    label: Annotated[
        tuple[str, ...], typer.Option(help="Name for a folder of --predictions, repeatable, in their order.")
    ] = ()
    workers: int = 1

    @property
    def max_pixel_views(self) -> int | None:
        """Maximum number of views in the pixel viewer, which shows whole configurations only; None: all.

        Raises :class:`InputError` if ``pixels`` is neither a number nor "all".
        """
        if self.pixels == "all":
            return None
        if not self.pixels.isdecimal():
            raise input_error("--pixels", "", repr(self.pixels), 'a number of views, or "all"', "correct it")
        return int(self.pixels)

    @property
    def methods(self) -> tuple[Method, ...]:
        """The methods whose predictions are compared. Raises the errors of :func:`parse_methods`."""
        from datagen.inspection.report.predictions import parse_methods

        return parse_methods(self.predictions, self.label)


@with_options
def report(
    folder: Annotated[Path, typer.Argument(help="Dataset folder.")],
    options: ReportOptions,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the page; default: report/ in the dataset.")
    ] = None,
    sheets_only: Annotated[
        bool, typer.Option("--sheets-only", help="Write only the missing contact sheets.")
    ] = False,
    workers: WorkersOption = 1,
    library: LibraryOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the planned output and stop.")] = False,
) -> None:
    """Write a page with figures and a pixel viewer of a dataset. It opens from disk in any browser.

    Example: datagen report smoke --workers 2
    """
    if sheets_only:
        if dry_run or out is not None:
            got, expected = "with --out or --dry-run", "neither: sheets are written to the dataset at once"
            raise input_error("--sheets-only", "", got, expected, "leave them out")
        write_sheets(folder)
        return
    from datagen.inspection.report.writing import report_command

    options = replace(options, workers=workers)
    raise typer.Exit(report_command(folder, out, options, _resolve(library), dry_run))


def write_sheets(folder: Path) -> None:
    """Write missing and outdated contact sheets of a dataset, and print their number."""
    from datagen.inspection.contact_sheet import write_dataset_sheets

    with Bars("configurations") as bars:
        written = write_dataset_sheets(folder, partial(bars.tell, "contact sheets"))
    typer.echo(f"{folder}: contact sheets in {folder / 'sheets'} ({len(written)} new)")

# SPDX-License-Identifier: MIT
"""Prints the output of ``datagen library``: assets as a table or JSON, or the faults of a check."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from functools import partial
from pathlib import Path

from rich.table import Column, Table

from datagen.foundation.errors import input_error
from datagen.foundation.progress import Bars, table_console
from datagen.library import check_library, describe_library, find_packages, resolve_library_paths


def print_library(names: list[str], check: bool, as_json: bool) -> int:
    """Print the assets of libraries or, with ``check``, their faults; returns the exit code.

    Raises :class:`InputError` for a folder without packages.
    """
    paths = resolve_library_paths(names, Path.cwd())
    for path in paths:
        if path.is_dir() and not find_packages(path):
            remedy = "name another folder, or add packages by `datagen import` or the Blender add-on"
            raise input_error(path, "", "no asset packages", "a library folder", remedy)
    if check:
        with Bars("packages", is_transient=True) as bars:
            report = check_library(paths, partial(bars.tell, "check"))
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
        return 1 if report.errors else 0
    summaries = describe_library(paths, with_hash=as_json)
    if as_json:
        print(json.dumps([{**asdict(s), "path": str(s.path)} for s in summaries], indent=2))
        return 0
    table = Table("kind", Column("id", overflow="fold"), "title", "what", "licence")
    for summary in summaries:
        licence = summary.license + (" (evaluation only)" if summary.usage != "any" else "")
        table.add_row(summary.kind, summary.id, summary.title, summary.detail, licence)
    table_console().print(table)
    by_kind = Counter(s.kind for s in summaries)
    print(", ".join(f"{count} {kind}s" for kind, count in sorted(by_kind.items())))
    return 0

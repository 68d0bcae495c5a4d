# SPDX-License-Identifier: MIT
"""The command ``python -m datagen.tradeoff``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from datagen.farm.worker import EXIT_INTERRUPTED
from datagen.foundation.command_line import finite, with_options
from datagen.foundation.errors import InputError
from datagen.foundation.progress import Bars
from datagen.tradeoff.selection import Point, front_of, points_of, recommend
from datagen.tradeoff.sweep import Sweep, SweepOptions
from datagen.tradeoff.writing import Results, write_results


def _limit(name: str, what: str) -> Any:
    return typer.Option(f"--max-{name}", min=0, callback=finite, help=what)


_MAX_MEAN = "Maximum mean absolute error of the {} of the recommended setting."


@dataclass(frozen=True)
class Limits:
    """Maximum errors of the recommended setting; None for no limit."""

    rel_mse: Annotated[
        float | None, _limit("rel-mse", "Recommend the cheapest setting with at most this relMSE of beauty.")
    ] = None
    maps_error: Annotated[float | None, _limit("maps-error", _MAX_MEAN.format("ground-truth maps"))] = None
    statistics_error: Annotated[float | None, _limit("statistics-error", _MAX_MEAN.format("statistics"))] = (
        None
    )


@with_options
def tradeoff(
    folder: Annotated[Path, typer.Argument(help="Planned dataset folder whose configurations are measured.")],
    out: Annotated[Path, typer.Option(help="Folder for references, trials and results.")],
    options: SweepOptions,
    limits: Limits,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the planned trials and stop.")] = False,
) -> None:
    """Measure error and time of all settings that affect time, and recommend a setting for a given error.

    Example: python -m datagen.tradeoff smoke --out smoke-tradeoff --max-rel-mse 0.01
    """
    planned = Sweep(folder, out, options)
    _announce(planned)
    if dry_run:
        return
    _run(planned)
    _write(planned, {name: limit for name, limit in asdict(limits).items() if limit is not None})


def _announce(sweep: Sweep) -> None:
    pending = len(sweep.pending())
    total = len(sweep.settings) * len(sweep.subjects)
    typer.echo(
        f"{len(sweep.settings)} settings x {len(sweep.subjects)} configurations: {total - pending} of "
        f"{total} trials are done; {sweep.missing_views()} views of references are missing"
    )
    for setting in sweep.unavailable:
        typer.echo(f"not available on this machine: {setting.text(sweep.base)}")


def _run(sweep: Sweep) -> None:
    """Run the sweep with a progress bar; an interrupt ends the command with exit code 75."""
    total = sweep.missing_views() + len(sweep.pending())
    done = 0
    with Bars("steps") as bars:
        bars.tell("measure", 0, total)

        def report(what: str, steps: int) -> None:
            nonlocal done
            done += steps
            bars.tell("measure", done, total, what)

        try:
            sweep.run(report)
        except KeyboardInterrupt:
            typer.echo("interrupted; finished results are kept, and the same command continues", err=True)
            raise typer.Exit(EXIT_INTERRUPTED) from None


def _write(sweep: Sweep, limits: dict[str, float]) -> None:
    trials = sweep.trials()
    points = points_of(trials)
    recommended: Point | None = None
    failure: InputError | None = None
    if limits:
        try:
            recommended = recommend(points, sweep.base, limits)
        except InputError as error:  # raised below, after the results are written
            failure = error
    results = Results(trials, sweep.base, sweep.unavailable, sweep.description(), recommended, limits or None)
    for path in write_results(results, sweep.out):
        typer.echo(path)
    typer.echo("Pareto-optimal settings (processor seconds per view, relMSE):")
    for point in front_of(points, sweep.base):
        typer.echo(f"  {point.cpu_s:8.3f} s  {point.rel_mse:.5f}  {point.setting.text(sweep.base)}")
    if failure is not None:
        raise failure
    if recommended is not None:
        typer.echo(
            f"recommended: {recommended.setting.text(sweep.base)}: relMSE {recommended.rel_mse:.5f} "
            f"(worst configuration {recommended.worst_rel_mse:.5f}), maps {recommended.maps_error:.4f}, "
            f"statistics {recommended.statistics_error:.4f}, {recommended.cpu_s:.3f} processor s per view"
        )

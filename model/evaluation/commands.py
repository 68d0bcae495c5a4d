# SPDX-License-Identifier: MIT
"""The verb ``evaluate`` of ``materials``. Heavy imports happen in it."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated, Any, Optional

import typer


def register_verbs(app: typer.Typer) -> None:
    """Add the verb of this module to the command."""
    app.command()(evaluate)


def evaluate(
    suite: Annotated[Path, typer.Argument(help="A suite (YAML), or the name of a bundled one: small.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the tables and the page.")],
    cache: Annotated[
        Optional[Path],  # noqa: UP045 - typer reads this at run time, on Python 3.10 too
        typer.Option("--cache", help="Folder of scenes, atlases and renderings; default: OUT/cache."),
    ] = None,
    checkpoint: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--checkpoint", help="In place of the bundled weights (.safetensors)."),
    ] = None,
    compare: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--compare", help="evaluation.json of another run, or its folder: print differences."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would be done; render nothing.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Judge reconstructions on test scenes: tables of maps, re-renderings and time, and a page of pictures.

    Interrupt it with Ctrl-C and start it again with the same arguments: it continues.

    Example: materials evaluate small --out evaluation
    """
    from model.evaluation.suite import describe_suite, read_suite

    resolved = read_suite(suite, checkpoint)
    other = None
    if compare is not None:
        from model.evaluation.compare import comparison, read_other

        other = read_other(compare)
    if dry_run:
        typer.echo(describe_suite(resolved))
        return
    from model.evaluation.evaluate import evaluate as run
    from model.evaluation.writing import is_written, write_results

    folder = cache or out / "cache"
    try:
        if quiet:
            evaluation = run(resolved, folder)
        else:
            with _Stages() as stages:
                evaluation = run(resolved, folder, stages.tell)
    except KeyboardInterrupt:
        typer.echo("stopped; the same command continues", err=True)
        raise typer.Exit(130) from None
    if is_written(evaluation.result, out):
        typer.echo("nothing to do: the results are those of these scenes, methods and settings", err=True)
    else:
        write_results(evaluation.result, evaluation.truth, out)
    typer.echo((out / "evaluation.md").read_text(encoding="utf-8"))
    if other is not None:
        typer.echo(comparison(evaluation.result, other).markdown())
    typer.echo(str(out / "index.html"))
    for name, reason in evaluation.result.failures.items():
        typer.echo(f"scene {name} has no figures:\n{reason}", err=True)
    if evaluation.result.failures:
        raise typer.Exit(1)


_SILENCE_S = 30.0  # without a terminal, a stage that takes longer says where it is


class _Stages:
    """The stage that is worked on, on standard error: with a bar on a terminal, else a line a stage and one
    every half a minute."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        console = Console(file=sys.stderr)
        self._is_terminal = console.is_terminal
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=console,
            transient=True,
        )
        self._stage, self._said_at = "", 0.0
        self._task: Any = None

    def __enter__(self) -> _Stages:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def tell(self, stage: str, done: int, total: int) -> None:
        """Show where a stage is."""
        if not self._is_terminal:
            now = time.monotonic()
            if stage != self._stage or now - self._said_at >= _SILENCE_S:
                self._stage, self._said_at = stage, now
                typer.echo(f"{time.strftime('%H:%M:%S')} {stage} ({done} of {total})", err=True)
            return
        if stage != self._stage:
            if self._task is not None:
                self._progress.remove_task(self._task)
            self._stage, self._task = stage, self._progress.add_task(stage, total=total)
        self._progress.update(self._task, completed=done, total=total)

# SPDX-License-Identifier: MIT
"""The subcommand ``materials evaluate``, which imports heavy modules only when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from datagen.foundation.command_line import QuietOption


def evaluate(
    suite: Annotated[Path, typer.Argument(help="A suite (YAML), or the name of a bundled suite: small.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the tables and the page.")],
    cache: Annotated[
        Path | None,
        typer.Option("--cache", help="Folder of scenes, atlases and renderings; default: OUT/cache."),
    ] = None,
    checkpoint: Annotated[
        Path | None, typer.Option("--checkpoint", help="Weights (.safetensors) in place of the bundled ones.")
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option("--compare", help="Print differences from another run (evaluation.json or its folder)."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the planned work; render nothing.")
    ] = False,
    quiet: QuietOption = False,
) -> None:
    """Evaluate reconstructions on test scenes.

    Write tables of errors and times, and a page of pictures. After Ctrl-C, the same command resumes.

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
    from datagen.foundation.progress import Bars
    from model.evaluation.evaluate import evaluate as run
    from model.evaluation.writing import is_written, write_results

    folder = cache or out / "cache"
    try:
        with Bars(is_transient=True, is_quiet=quiet) as bars:
            evaluation = run(resolved, folder, bars.tell)
    except KeyboardInterrupt:
        typer.echo("stopped; the same command resumes", err=True)
        raise typer.Exit(130) from None
    if is_written(evaluation.result, out):
        typer.echo("nothing to do: the results already cover these scenes, methods and settings", err=True)
    else:
        write_results(evaluation.result, evaluation.truth, out)
    typer.echo((out / "evaluation.md").read_text(encoding="utf-8"))
    for name, reason in evaluation.result.failures.items():
        typer.echo(f"scene {name} has no figures:\n{reason}", err=True)
    if other is not None:
        typer.echo(comparison(evaluation.result, other).markdown())
    typer.echo(str(out / "index.html"))
    if evaluation.result.failures:
        raise typer.Exit(1)

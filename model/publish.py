# SPDX-License-Identifier: MIT
"""``python -m model.publish``: prepares a checkpoint for publication."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer

from datagen.foundation.command_line import run_function
from datagen.foundation.errors import input_error
from model.checkpoint import load_checkpoint, save_checkpoint


def publish_checkpoint(source: Path, target: Path) -> None:
    """Write the checkpoint ``source`` to ``target`` in half precision, without paths of this machine.

    Raises :class:`InputError` unless ``target`` ends in .safetensors; the card has the suffix .json instead.
    """
    if target.suffix != ".safetensors":
        raise input_error("--out", "", str(target), "the name of a .safetensors file", "correct it")
    checkpoint = load_checkpoint(source)
    training = {**checkpoint.card.training, "initial_checkpoint": None}
    if "perceptual" in training:
        training["perceptual"] = {**training["perceptual"], "vgg": None, "heads": None}
    card = checkpoint.card.model_copy(update={"training": training})
    save_checkpoint(target, card, checkpoint.network, checkpoint.confidence, torch.float16)


def main(
    checkpoint: Annotated[Path, typer.Argument(help="Weights of a run (.safetensors).")],
    out: Annotated[Path, typer.Option(help="File to write (.safetensors), with its card next to it.")],
) -> None:
    """Write a checkpoint for publication: half precision, no paths of this machine."""
    publish_checkpoint(checkpoint, out)
    typer.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    run_function(main)

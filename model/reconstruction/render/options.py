# SPDX-License-Identifier: MIT
"""Options of an animation of an asset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import typer

from datagen.foundation.errors import input_error

FILM_SUFFIXES = (".gif", ".mp4")
MIN_RATE = 0.01
"""Minimum frames per second, which keeps the delay of GIF frames below its limit of 655 s."""


@dataclass(frozen=True)
class FilmOptions:
    """Options of an animation; ``max_width_px`` bounds the longer side of frames."""

    way: Annotated[
        Literal["orbit", "cameras"],
        typer.Option(help="Animation: orbit inside the room, or through the asset's cameras."),
    ] = "orbit"
    frames: Annotated[int, typer.Option(min=2, help="Animation: number of frames.")] = 48
    frames_per_second: Annotated[
        float, typer.Option("--fps", help="Animation: frames per second, at most 50 for GIF.")
    ] = 12.0
    max_width_px: Annotated[
        int, typer.Option("--max-width", min=16, help="Animation: maximum side of frames in pixels.")
    ] = 480

    def __post_init__(self) -> None:
        if not 2 <= self.frames <= 100_000:
            raise input_error("turntable", "frames", self.frames, "2 to 100000", "correct it")
        rate = self.frames_per_second
        if not MIN_RATE <= rate <= 100:
            raise input_error("turntable", "frames per second", rate, f"{MIN_RATE} to 100", "correct it")

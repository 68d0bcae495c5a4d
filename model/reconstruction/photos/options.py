# SPDX-License-Identifier: MIT
"""Options of ``materials photos``, without slow imports."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import typer

from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.infer_options import InferOptions


@dataclass(frozen=True)
class PhotosOptions:
    """Options of ``materials photos``; ``reading`` and ``inference`` are as in ``materials infer``."""

    program: Annotated[str, typer.Option("--colmap", help="Command that runs COLMAP.")] = "colmap"
    reading: CaptureOptions = field(default_factory=CaptureOptions)
    inference: InferOptions = field(default_factory=InferOptions)
    frames: Annotated[int, typer.Option(min=2, help="Frames of the turntable.")] = 24
    samples: Annotated[int, typer.Option(min=1, help="Light paths per pixel of the turntable.")] = 8

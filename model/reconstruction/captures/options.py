# SPDX-License-Identifier: MIT
"""Options for reading a capture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from datagen.foundation.budget import Limits
from datagen.foundation.encodings import Encoding

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
Exposure = Literal["auto", "common", "exif"]
"""Source of relative exposures: none (common), EXIF (exif), or EXIF if all photographs have it (auto)."""
DEFAULT_MAX_WIDTH_PX = 640


def _metres(text: str) -> float | None:
    try:
        return None if text == "auto" else float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r}; expected auto or a number of metres") from None


@dataclass(frozen=True)
class FrameOptions:
    """Options for the mesh and the coordinate frame of a capture.

    ``up`` is the up axis of the cameras' world and ``unit_m`` its unit in metres; "auto" and None estimate
    them (``captures.frames``); "cameras" estimates an up direction that need not be an axis. Views whose
    longer side exceeds ``max_width_px`` are scaled down, since networks are trained on views of 640 pixels.
    """

    mesh: Annotated[Path | None, typer.Option(help="PLY, OBJ, glTF or GLB in the cameras' frame.")] = None
    up: Annotated[
        Literal["auto", "cameras", Axis],
        typer.Option(help="Up axis of the cameras' world; cameras: any direction, estimated from poses."),
    ] = "auto"
    unit_m: Annotated[
        float | None,
        typer.Option(
            "--unit",
            parser=_metres,
            metavar="METRES",
            help="Metres per unit of cameras and mesh, or auto (default).",
        ),
    ] = None
    max_width_px: Annotated[
        int, typer.Option("--max-width", min=16, help="Maximum side of views in pixels.")
    ] = DEFAULT_MAX_WIDTH_PX


@dataclass(frozen=True)
class CaptureOptions(FrameOptions):
    """Options for reading a capture.

    ``library``: folders with the asset packages of a rendered capture, by default the library of its dataset
    or, without one, the bundled library; ``mesh_up``: up axis of the mesh, or "same" as that of the cameras;
    ``limits``: limits on the input size, by default from environment variables.
    """

    images: Annotated[Path | None, typer.Option(help="Folder of the photographs.")] = None
    library: Annotated[
        tuple[Path, ...],
        typer.Option(
            help="Library of a shard's assets, repeatable; default: those of its dataset, or bundled."
        ),
    ] = ()
    mesh_up: Annotated[Literal["same", Axis], typer.Option(help="Up axis of the mesh.")] = "same"
    encoding: Annotated[Encoding, typer.Option(help="Transfer function of the photographs' values.")] = "auto"
    exposure: Annotated[
        Exposure,
        typer.Option(
            help="Relative exposures: auto (EXIF and overlapping surfaces), exif (EXIF alone), common (none)."
        ),
    ] = "auto"
    limits: Limits | None = None

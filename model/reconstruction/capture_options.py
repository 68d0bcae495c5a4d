# SPDX-License-Identifier: MIT
"""Options for reading a capture, for the commands and for
:func:`~model.reconstruction.captures.read_capture`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from datagen.foundation.budget import Limits
from datagen.foundation.encodings import Encoding

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
Exposure = Literal["auto", "common", "exif"]
"""Exposure: the same for all photographs, or as recorded in EXIF, or (auto) the latter if every photograph
has a record."""
DEFAULT_MAX_WIDTH_PX = 640


def _metres(text: str) -> float | None:
    try:
        return None if text == "auto" else float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r}; expected auto or metres") from None


@dataclass(frozen=True)
class FrameOptions:
    """The mesh, and the frames of mesh and cameras.

    ``up`` is the up axis of the cameras' world, ``unit_m`` its unit; "auto" and None estimate them
    (``captures.frames``), "cameras" levels a world of arbitrary orientation. Views wider than
    ``max_width_px`` are scaled down, since the networks are trained on views of 640 pixels.
    """

    mesh: Annotated[Path | None, typer.Option(help="PLY, OBJ, glTF or GLB in the cameras' frame.")] = None
    up: Annotated[
        Literal["auto", "cameras", Axis],
        typer.Option(help="Up axis of the cameras' world; cameras: level it by them."),
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
    max_width_px: Annotated[int, typer.Option("--max-width", min=16, help="Wider views are shrunk.")] = (
        DEFAULT_MAX_WIDTH_PX
    )


@dataclass(frozen=True)
class CaptureOptions(FrameOptions):
    """Options for reading a capture.

    ``library``, for rendered captures only: folders of their assets' packages, by default from their dataset
    folder, else the bundled library. ``mesh_up`` is the mesh's up axis if it differs. ``exposure`` "exif"
    applies recorded exposures, "auto" does so if all photographs have one. ``limits`` are by default from the
    environment variables.
    """

    images: Annotated[Path | None, typer.Option(help="Folder of the photographs.")] = None
    library: Annotated[
        tuple[Path, ...],
        typer.Option(help="Packages that a shard was rendered with, repeatable; default: its own, bundled."),
    ] = ()
    mesh_up: Annotated[Literal["same", Axis], typer.Option(help="Up axis of the mesh.")] = "same"
    encoding: Annotated[Encoding, typer.Option(help="Transfer function of the photographs' values.")] = "auto"
    exposure: Annotated[
        Exposure,
        typer.Option(
            help="Exposures by EXIF and common surfaces (auto), by EXIF alone, or unchanged (common)."
        ),
    ] = "auto"
    limits: Limits | None = None

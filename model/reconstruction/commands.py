# SPDX-License-Identifier: MIT
"""The subcommands ``check``, ``infer`` and ``photos`` of ``materials``, which defer heavy imports."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from datagen.foundation.command_line import QuietOption, with_options
from datagen.foundation.progress import Bars
from model.events import Event, ListenerOption, load_listeners
from model.reconstruction.captures.options import CaptureOptions, FrameOptions
from model.reconstruction.infer_options import AssetOptions, InferOptions
from model.reconstruction.photos.options import PhotosOptions

if TYPE_CHECKING:
    from datagen.formats.capture import Capture
    from model.reconstruction.stages import MapSource

CaptureArgument = Annotated[
    Path,
    typer.Argument(
        help="Cameras in any supported format (docs/captures.md), a shard, a package, or capture.json."
    ),
]
OutOption = Annotated[Path, typer.Option("--out", help="Folder of the result; unfinished work is resumed.")]
CheckpointOption = Annotated[
    Path | None, typer.Option("--checkpoint", help="Weights (.safetensors); default: the bundled ones.")
]


def _opened(path: Path, reading: CaptureOptions) -> Capture:
    from datagen.library import resolve_library_paths
    from model.reconstruction.captures.read import read_capture, refuse_unused

    refuse_unused(path, reading)
    library = resolve_library_paths([str(name) for name in reading.library], Path())
    return read_capture(path, replace(reading, library=library))


@with_options
def infer(
    capture: CaptureArgument,
    out: OutOption,
    reading: CaptureOptions,
    options: InferOptions,
    checkpoint: CheckpointOption = None,
    truth: Annotated[
        bool, typer.Option("--truth", help="Merge a rendered capture's ground truth instead of predictions.")
    ] = False,
    listener: ListenerOption = None,
    quiet: QuietOption = False,
) -> None:
    """Turn a capture into a material atlas and a renderable asset.

    Example: materials infer photos --mesh room.glb --out room
    """
    unused = {
        "--checkpoint": checkpoint is not None,
        "--materials": options.materials != InferOptions.materials,
        "--no-filter": not options.is_filtered,
        "--no-level": not options.is_leveled,
    }
    for name in [name for name, is_given in unused.items() if truth and is_given]:
        raise typer.BadParameter("has no effect with --truth", param_hint=name)
    listeners = load_listeners(listener or ())
    opened = _opened(capture, reading)  # before torch is imported, so that errors appear at once

    from model.checkpoint import bundled_checkpoint
    from model.reconstruction.infer import infer as run
    from model.reconstruction.predict.sources import TRUTH, CheckpointMaps

    source: MapSource = TRUTH if truth else CheckpointMaps(checkpoint or bundled_checkpoint())
    options = replace(options, is_evened=reading.exposure == "auto")
    try:
        with Bars(is_quiet=quiet) as bars:

            def tell(stage: str, done: int, total: int) -> None:
                listeners.tell(Event("infer", "progress", out, stage, done, {"total": total}))
                bars.tell(stage, done, total)

            report = run(opened, out, source, options, tell)
        listeners.tell(Event("infer", "end", out, values={"seconds": sum(report.seconds.values())}))
    except KeyboardInterrupt:
        typer.echo("stopped; the same command continues", err=True)
        raise typer.Exit(130) from None
    for warning in report.warnings:
        typer.echo(f"warning: {warning}", err=True)
    for note in report.notes:
        typer.echo(f"note: {note}", err=True)
    if report.gltf_error.get("texture_px", report.atlas_size) < report.atlas_size:
        side = report.gltf_error["texture_px"]
        typer.echo(
            f"note: textures in the GLB are reduced to {side:.0f} x {side:.0f} for viewers; the atlas and "
            f"package have {report.atlas_size}",
            err=True,
        )
    unwrap = report.unwrap
    typer.echo(
        f"{report.num_views} views, {report.num_triangles} triangles, UVs from {unwrap['source']}, atlas "
        f"{report.atlas_size} x {report.atlas_size} "
        f"({report.atlas_size / unwrap['metres_per_side']:.0f} texels per metre), "
        f"{report.seen_of_visible:.0%} of the visible surface observed"
    )
    typer.echo(report.table())
    typer.echo(str(out / "asset"))
    typer.echo(str(out / "report.html"))


@with_options
def photos(
    folder: Annotated[Path, typer.Argument(help="Folder of photographs, or a capture with cameras.")],
    out: OutOption,
    frame: FrameOptions,
    options: AssetOptions,
    steps: PhotosOptions,
    checkpoint: CheckpointOption = None,
    quiet: QuietOption = False,
) -> None:
    """Turn a folder of photographs into an asset.

    COLMAP estimates cameras and mesh. A turntable of the asset is rendered as well.

    After an interruption, the same command continues.

    Example: materials photos kitchen --out kitchen-asset
    """
    from model.checkpoint import bundled_checkpoint
    from model.reconstruction.photos.pipeline import make_asset
    from model.reconstruction.predict.sources import CheckpointMaps

    reading, inference = CaptureOptions(**asdict(frame)), InferOptions(**asdict(options))
    wanted = replace(steps, reading=reading, inference=inference)
    source = CheckpointMaps(checkpoint or bundled_checkpoint())
    echo = partial(typer.echo, err=True)
    try:
        with Bars(is_quiet=quiet) as bars:
            made = make_asset(folder, out, source, wanted, bars.tell, echo)
    except KeyboardInterrupt:
        typer.echo("stopped; the same command continues", err=True)
        raise typer.Exit(130) from None
    for text in () if made.report is None else (*made.report.warnings, *made.report.notes):
        echo(f"note: {text}")
    for path in (out / "asset", out / "report.html", made.turntable):
        typer.echo(str(path))


@with_options
def check(
    capture: CaptureArgument,
    reading: CaptureOptions,
    out: Annotated[Path | None, typer.Option(help="Folder for check.json and the contact sheets.")] = None,
    quiet: QuietOption = False,
) -> None:
    """Check whether a mesh fits the photographs. The exit code is 1 if there are warnings.

    Example: materials check photos --mesh room.glb --out check
    """
    opened = _opened(capture, reading)

    from model.reconstruction.check.capture_check import check_capture

    with Bars(is_quiet=quiet) as bars:
        report = check_capture(opened, out, bars.tell)
    for note in report.notes:
        typer.echo(f"note: {note}", err=True)
    warnings = report.all_warnings
    for warning in warnings:
        typer.echo(f"warning: {warning}", err=True)
    judged = [view for view in report.views if view.is_judged]
    typer.echo(
        f"{len(report.views)} views, {len(judged)} with enough edges, fit {report.fit:.1f} standard "
        f"deviations; {len(warnings)} warnings"
    )
    if out is not None:
        typer.echo(str(out / "sheet-01.png"))
    if warnings:
        raise typer.Exit(1)

# SPDX-License-Identifier: MIT
"""The verbs ``check`` and ``infer`` of ``materials``. Heavy imports happen in the verbs."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from datagen.foundation.command_line import check_choices

if TYPE_CHECKING:
    from model.reconstruction.captures import CaptureOptions
    from model.reconstruction.stages import MapSource


def register_verbs(app: typer.Typer) -> None:
    """Add the verbs of a reconstruction to the command."""
    from model.reconstruction.render.commands import render, turntable, view

    for verb in (check, infer, photos, render, turntable, view):
        app.command()(verb)


def infer(
    capture: Annotated[
        Path, typer.Argument(help="Cameras of any form (docs/captures.md), a shard, a package, capture.json.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder of the result; unfinished work continues.")],
    checkpoint: Annotated[
        Optional[Path],  # noqa: UP045 - typer reads this at run time, on Python 3.10 too
        typer.Option("--checkpoint", help="Weights (.safetensors); default: the bundled ones."),
    ] = None,
    mesh: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--mesh", help="PLY, OBJ, glTF or GLB in the cameras' frame."),
    ] = None,
    images: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--images", help="Folder of the photographs."),
    ] = None,
    library: Annotated[
        Optional[list[Path]],  # noqa: UP045
        typer.Option("--library", help="Packages that a shard was rendered with; default: its own, bundled."),
    ] = None,
    up: Annotated[
        str, typer.Option("--up", help="Up axis of the cameras' world: auto, y, z, -y ...")
    ] = "auto",
    mesh_up: Annotated[
        str, typer.Option("--mesh-up", help="Up axis of the mesh: same, y, z, -y ...")
    ] = "same",
    unit: Annotated[
        str, typer.Option("--unit", help="Metres in a unit of cameras and mesh, or auto.")
    ] = "auto",
    encoding: Annotated[str, typer.Option("--encoding", help="auto, linear, srgb or gamma22.")] = "auto",
    exposure: Annotated[
        str, typer.Option("--exposure", help="auto: what EXIF and overlaps tell; exif alone; or common.")
    ] = "auto",
    max_width: Annotated[int, typer.Option("--max-width", min=16, help="Wider views are shrunk.")] = 640,
    atlas: Annotated[str, typer.Option("--atlas", help="Side in texels, or auto.")] = "auto",
    visibility: Annotated[str, typer.Option("--visibility", help="depth, or trace.")] = "depth",
    weights: Annotated[
        str,
        typer.Option("--weights", help="Of the medians over views: none, angle, distance, confidence, all."),
    ] = "none",
    materials: Annotated[
        str, typer.Option("--materials", help="From the network, from light, or both.")
    ] = "both",
    precision: Annotated[str, typer.Option("--precision", help="auto, float32 or bfloat16.")] = "auto",
    device: Annotated[str, typer.Option("--device", help="cpu or cuda, for the networks.")] = "cpu",
    no_filter: Annotated[bool, typer.Option("--no-filter", help="Leave the bilateral solver out.")] = False,
    no_level: Annotated[
        bool, typer.Option("--no-level", help="Leave diffuse albedo at the level that was predicted.")
    ] = False,
    no_check: Annotated[
        bool, typer.Option("--no-check", help="Do not compare the mesh with the photographs first.")
    ] = False,
    mend_poses: Annotated[
        bool, typer.Option("--mend-poses", help="Mend cameras that are off by millimetres; says by how much.")
    ] = False,
    punctual: Annotated[
        bool, typer.Option("--punctual", help="Small lamps in the GLB as point lights, too.")
    ] = False,
    truth: Annotated[
        bool, typer.Option("--truth", help="Merge a rendered capture's ground truth; no checkpoint.")
    ] = False,
    listener: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--listener", help="MODULE:FUNCTION that hears of what happens, repeatable."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Turn a capture into a material atlas and an asset that renders.

    Example: materials infer photos --mesh room.glb --out room
    """
    from datagen.foundation.progress import Bars
    from model.checkpoint import bundled_checkpoint
    from model.events import Event, load_listeners
    from model.reconstruction.captures import read_capture
    from model.reconstruction.infer import InferOptions
    from model.reconstruction.infer import infer as run
    from model.reconstruction.predict.sources import TRUTH, CheckpointMaps

    choices: dict[str, tuple[str, tuple[str, ...]]] = {
        "--visibility": (visibility, ("depth", "trace")),
        "--precision": (precision, ("auto", "float32", "bfloat16")),
        "--materials": (materials, ("network", "light", "both")),
        "--weights": (weights, ("none", "angle", "distance", "confidence", "all")),
    }
    check_choices(choices)
    listeners = load_listeners(listener or ())
    if atlas != "auto" and not atlas.isdigit():
        raise typer.BadParameter(f"{atlas!r}; expected auto or a number", param_hint="--atlas")
    opened = read_capture(
        capture, _reading(mesh, images, library, up, mesh_up, unit, encoding, exposure, max_width)
    )
    source: MapSource = TRUTH if truth else CheckpointMaps(checkpoint or bundled_checkpoint())
    doing: dict[str, Any] = {"visibility": visibility, "precision": precision, "weights": weights}
    doing["materials"] = materials
    options = InferOptions(
        atlas="auto" if atlas == "auto" else int(atlas),
        is_filtered=not no_filter,
        is_leveled=not no_level,
        device=device,
        is_checked=not no_check,
        has_punctual=punctual,
        is_evened=exposure == "auto",
        mends_poses=mend_poses,
        **doing,
    )
    try:
        with Bars() if not quiet else nullcontext() as bars:

            def tell(stage: str, done: int, total: int) -> None:
                listeners.tell(Event("infer", "progress", out, stage, done, {"total": total}))
                if bars is not None:
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
            f"note: textures in the GLB are {side:.0f} x {side:.0f}, which viewers take; the atlas and the "
            f"package have {report.atlas_size}",
            err=True,
        )
    unwrap = report.unwrap
    typer.echo(
        f"{report.num_views} views, {report.num_triangles} triangles, UVs from {unwrap['source']}, atlas "
        f"{report.atlas_size} x {report.atlas_size} "
        f"({report.atlas_size / unwrap['metres_per_side']:.0f} texels a metre), "
        f"{report.seen_of_visible:.0%} of the surface seen that can be seen"
    )
    typer.echo(report.table())
    typer.echo(str(out / "asset"))
    typer.echo(str(out / "report.html"))


def photos(
    folder: Annotated[Path, typer.Argument(help="Photographs; or a capture with cameras of its own.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the result; unfinished work continues.")],
    mesh: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--mesh", help="A mesh in the cameras' frame, instead of COLMAP's."),
    ] = None,
    checkpoint: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--checkpoint", help="Weights (.safetensors); default: the bundled ones."),
    ] = None,
    up: Annotated[str, typer.Option("--up", help="As for infer.")] = "auto",
    unit: Annotated[str, typer.Option("--unit", help="As for infer.")] = "auto",
    max_width: Annotated[int, typer.Option("--max-width", min=16, help="Wider views are shrunk.")] = 640,
    atlas: Annotated[str, typer.Option("--atlas", help="Side in texels, or auto.")] = "auto",
    device: Annotated[str, typer.Option("--device", help="cpu or cuda, for the networks.")] = "cpu",
    colmap: Annotated[str, typer.Option("--colmap", help="COLMAP's program.")] = "colmap",
    frames: Annotated[int, typer.Option("--frames", min=2, help="Frames of the turntable.")] = 24,
    samples: Annotated[int, typer.Option("--samples", min=1, help="Light paths a pixel of it.")] = 8,
    no_check: Annotated[
        bool, typer.Option("--no-check", help="Do not compare the mesh with the photographs first.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Turn a folder of photographs into an asset: COLMAP's cameras and mesh, materials, a turntable.

    Stopped, the same command continues. Example: materials photos kitchen --out kitchen-asset
    """
    from datagen.foundation.progress import Bars
    from model.checkpoint import bundled_checkpoint
    from model.reconstruction.infer import InferOptions
    from model.reconstruction.photos.pipeline import PhotosOptions, make_asset
    from model.reconstruction.predict.sources import CheckpointMaps

    if atlas != "auto" and not atlas.isdigit():
        raise typer.BadParameter(f"{atlas!r}; expected auto or a number", param_hint="--atlas")
    options = PhotosOptions(
        program=colmap,
        reading=_reading(mesh, None, None, up, "same", unit, "auto", "auto", max_width),
        inference=InferOptions(
            atlas="auto" if atlas == "auto" else int(atlas), device=device, is_checked=not no_check
        ),
        frames=frames,
        samples=samples,
    )
    source = CheckpointMaps(checkpoint or bundled_checkpoint())

    def say(text: str) -> None:
        typer.echo(text, err=True)

    try:
        with Bars() if not quiet else nullcontext() as bars:
            told = (lambda stage, done, total: None) if bars is None else bars.tell
            made = make_asset(folder, out, source, options, told, say)
    except KeyboardInterrupt:
        typer.echo("stopped; the same command continues", err=True)
        raise typer.Exit(130) from None
    for text in () if made.report is None else (*made.report.warnings, *made.report.notes):
        say(f"note: {text}")
    for path in (out / "asset", out / "report.html", made.turntable):
        typer.echo(str(path))


def check(
    capture: Annotated[
        Path, typer.Argument(help="Cameras of any form (docs/captures.md), a shard, a package, capture.json.")
    ],
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--out", help="Folder for check.json and the contact sheets."),
    ] = None,
    mesh: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--mesh", help="PLY, OBJ, glTF or GLB in the cameras' frame."),
    ] = None,
    images: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--images", help="Folder of the photographs."),
    ] = None,
    library: Annotated[
        Optional[list[Path]],  # noqa: UP045
        typer.Option("--library", help="Packages that a shard was rendered with; default: its own, bundled."),
    ] = None,
    up: Annotated[str, typer.Option("--up", help="As for infer.")] = "auto",
    mesh_up: Annotated[str, typer.Option("--mesh-up", help="As for infer.")] = "same",
    unit: Annotated[str, typer.Option("--unit", help="As for infer.")] = "auto",
    encoding: Annotated[str, typer.Option("--encoding", help="As for infer.")] = "auto",
    exposure: Annotated[str, typer.Option("--exposure", help="As for infer.")] = "auto",
    max_width: Annotated[int, typer.Option("--max-width", min=16, help="Wider views are shrunk.")] = 640,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Say whether a mesh projects onto the photographs; exit code 1 with warnings.

    Example: materials check photos --mesh room.glb --out check
    """
    from datagen.foundation.progress import Bars
    from model.reconstruction.captures import read_capture
    from model.reconstruction.check.capture_check import check_capture

    opened = read_capture(
        capture, _reading(mesh, images, library, up, mesh_up, unit, encoding, exposure, max_width)
    )
    if quiet:
        report = check_capture(opened, out)
    else:
        with Bars() as bars:
            report = check_capture(opened, out, bars.tell)
    for note in report.notes:
        typer.echo(f"note: {note}", err=True)
    warnings = report.all_warnings
    for warning in warnings:
        typer.echo(f"warning: {warning}", err=True)
    judged = [view for view in report.views if view.is_judged]
    typer.echo(
        f"{len(report.views)} views, {len(judged)} with edges to go by, fit {report.fit:.1f} standard "
        f"deviations; {len(warnings)} warnings"
    )
    if out is not None:
        typer.echo(str(out / "sheet-01.png"))
    if warnings:
        raise typer.Exit(1)


def _reading(
    mesh: Path | None,
    images: Path | None,
    library: list[Path] | None,
    up: str,
    mesh_up: str,
    unit: str,
    encoding: str,
    exposure: str,
    max_width: int,
) -> CaptureOptions:
    """How to read a capture, from the command line's words."""
    from datagen.library import resolve_library_paths
    from model.reconstruction.captures import AXES, CaptureOptions

    check_choices(
        {
            "--up": (up, ("auto", *AXES)),
            "--mesh-up": (mesh_up, ("same", *AXES)),
            "--encoding": (encoding, ("auto", "linear", "srgb", "gamma22")),
            "--exposure": (exposure, ("auto", "common", "exif")),
        }
    )
    try:
        unit_m = None if unit == "auto" else float(unit)
    except ValueError:
        raise typer.BadParameter(f"{unit!r}; expected auto or metres", param_hint="--unit") from None
    chosen: dict[str, Any] = {"up": up, "mesh_up": mesh_up, "encoding": encoding, "exposure": exposure}
    return CaptureOptions(
        mesh=mesh,
        images=images,
        unit_m=unit_m,
        max_width_px=max_width,
        library=resolve_library_paths([str(name) for name in library or ()], Path()),
        **chosen,
    )

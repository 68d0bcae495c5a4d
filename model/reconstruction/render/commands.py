# SPDX-License-Identifier: MIT
"""The verbs ``render``, ``turntable`` and ``view`` of ``materials``. Heavy imports happen in the verbs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from datagen.foundation.command_line import check_choices

if TYPE_CHECKING:
    from model.reconstruction.render.relight import RelightOptions


def render(
    asset: Annotated[Path, typer.Argument(help="An environment package, such as OUT/asset.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the images (EXR and PNG).")],
    view: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--view", help="Name of a camera, repeatable; default: all."),
    ] = None,
    sky: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--sky", help="Instead of the asset's lights: an environment map (EXR) or R,G,B."),
    ] = None,
    lamp: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--lamp", help="Instead of the asset's lights: X,Y,Z or X,Y,Z,INTENSITY, repeatable."),
    ] = None,
    insert: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--insert",
            help="PACKAGE@X,Y,Z[,DEGREES], repeatable; bundled:ID is a package too.",
        ),
    ] = None,
    samples: Annotated[int, typer.Option("--samples", min=1, help="Light paths a pixel.")] = 16,
    no_denoise: Annotated[bool, typer.Option("--no-denoise", help="Leave the denoiser out.")] = False,
) -> None:
    """Render an asset from its cameras, under its own or other light, with objects put in.

    Example: materials render room/asset --out renders --sky 1,1,1 --insert bundled:mug@1,2,0.8
    """
    from dataclasses import replace

    from model.reconstruction.render.relight import write_renders

    options = replace(_relighting(sky, lamp, insert, samples, no_denoise), views=tuple(view or ()))
    for path in write_renders(asset, out, options, _warn):
        typer.echo(str(path))


def turntable(
    asset: Annotated[Path, typer.Argument(help="An environment package, such as OUT/asset.")],
    out: Annotated[Path, typer.Option("--out", help="FILE.gif or FILE.mp4 (VP9).")],
    way: Annotated[
        str, typer.Option("--way", help="orbit: a turn inside; cameras: through the asset's cameras.")
    ] = "orbit",
    frames: Annotated[int, typer.Option("--frames", min=2, help="Frames of the whole way.")] = 48,
    fps: Annotated[float, typer.Option("--fps", help="Frames a second.")] = 12.0,
    max_width: Annotated[int, typer.Option("--max-width", min=16, help="Wider frames are shrunk.")] = 480,
    sky: Annotated[Optional[str], typer.Option("--sky", help="As for render.")] = None,  # noqa: UP045
    lamp: Annotated[Optional[list[str]], typer.Option("--lamp", help="As for render.")] = None,  # noqa: UP045
    insert: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--insert", help="As for render."),
    ] = None,
    samples: Annotated[int, typer.Option("--samples", min=1, help="Light paths a pixel.")] = 16,
    no_denoise: Annotated[bool, typer.Option("--no-denoise", help="Leave the denoiser out.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Render an asset on a way through it, as a GIF or a video that repeats without a seam.

    Example: materials turntable room/asset --out room.gif --lamp 0,0,2
    """
    from datagen.foundation.progress import Bars
    from model.reconstruction.render.turntable import TurntableOptions, write_turntable

    check_choices({"--way": (way, ("orbit", "cameras"))})
    chosen: dict[str, Any] = {"way": way}
    options = TurntableOptions(
        frames=frames,
        frames_per_second=fps,
        max_width_px=max_width,
        render=_relighting(sky, lamp, insert, samples, no_denoise),
        **chosen,
    )
    if quiet:
        write_turntable(asset, out, options, None, _warn)
    else:
        with Bars() as bars:
            write_turntable(asset, out, options, bars.tell, _warn)
    typer.echo(str(out))


def _warn(text: str) -> None:
    typer.echo(f"warning: {text}", err=True)


def _relighting(
    sky: str | None, lamp: list[str] | None, insert: list[str] | None, samples: int, no_denoise: bool
) -> RelightOptions:
    """Light, insertions and samples, from the command line's words."""
    from model.reconstruction.render.relight import RelightOptions

    return RelightOptions(
        sky=_sky(sky),
        lamps=tuple(_lamp(text) for text in lamp or ()),
        insertions=tuple(_insertion(text) for text in insert or ()),
        samples=samples,
        denoise=not no_denoise,
    )


def view(
    asset: Annotated[Path, typer.Argument(help="What `materials infer` wrote, or an asset package.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the page.")],
    max_side: Annotated[
        int, typer.Option("--max-side", min=64, max=4096, help="Larger textures are averaged down.")
    ] = 4096,
) -> None:
    """Write a page that shows an asset in 3D, with a light to move; it opens from disk in any browser.

    Example: materials view room --out room-page
    """
    from model.reconstruction.atlas_page.writing import write_view

    result = write_view(asset, out, max_side)
    for note in result.notes:
        typer.echo(f"note: {note}", err=True)
    size = f"{result.num_bytes / 1e6:,.0f} MB"
    typer.echo(f"{result.num_triangles} triangles, {result.num_materials} materials, {size}")
    typer.echo(f"open {result.page.absolute().as_uri()}")


def _numbers(text: str, counts: tuple[int, ...], option: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in counts:
        expected = " or ".join(str(count) for count in counts)
        raise typer.BadParameter(f"{text!r}; expected {expected} numbers", param_hint=option)
    return values


def _sky(text: str | None) -> Path | tuple[float, float, float] | None:
    if text is None:
        return None
    if text.lower().endswith(".exr"):
        return Path(text)
    red, green, blue = _numbers(text, (3,), "--sky")
    return red, green, blue


def _lamp(text: str) -> Any:
    from model.reconstruction.render.relight import Lamp

    x, y, z, *strength = _numbers(text, (3, 4), "--lamp")
    if not strength:
        return Lamp((x, y, z))
    if not strength[0] > 0:
        raise typer.BadParameter(f"{text!r}; expected an intensity above 0", param_hint="--lamp")
    return Lamp((x, y, z), (strength[0],) * 3)


def _insertion(text: str) -> Any:
    from math import radians

    from datagen.foundation.bundled import object_package
    from model.reconstruction.render.relight import Insertion

    package, separator, place = text.rpartition("@")
    if not separator:
        raise typer.BadParameter(f"{text!r}; expected PACKAGE@X,Y,Z", param_hint="--insert")
    x, y, z, *yaw = _numbers(place, (3, 4), "--insert")
    return Insertion(object_package(package, Path()), (x, y, z), radians(yaw[0]) if yaw else 0.0)

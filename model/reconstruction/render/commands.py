# SPDX-License-Identifier: MIT
"""The subcommands ``render`` and ``view`` of ``materials``, which defer slow imports."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from math import isfinite, radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from datagen.foundation.bundled import object_package
from datagen.foundation.command_line import QuietOption, with_options
from datagen.foundation.progress import Bars
from model.reconstruction.render.options import FILM_SUFFIXES, FilmOptions

if TYPE_CHECKING:
    from model.reconstruction.render.relight import RelightOptions


MAX_STOPS = 100
"""Maximum exposure compensation, at which exposed images are still finite."""


@dataclass(frozen=True)
class LightWords:
    """Options for lights, inserted objects and samples, as text."""

    sky: Annotated[
        str | None, typer.Option(help="Replace the asset's lights: environment map (EXR) or radiance R,G,B.")
    ] = None
    lamp: Annotated[
        tuple[str, ...],
        typer.Option(
            help="Point light instead of the asset's: X,Y,Z[,INTENSITY] or X,Y,Z,R,G,B (m, W/sr), repeatable."
        ),
    ] = ()
    insert: Annotated[
        tuple[str, ...],
        typer.Option(
            help="Object to insert, position (m), yaw: PACKAGE@X,Y,Z[,DEGREES], repeatable; PACKAGE may be "
            "bundled:ID."
        ),
    ] = ()
    samples: Annotated[int, typer.Option(min=1, help="Light paths per pixel.")] = 16
    no_denoise: Annotated[bool, typer.Option("--no-denoise", help="Render without the denoiser.")] = False
    stops: Annotated[
        float, typer.Option(help="Exposure compensation of PNG and animation: -1 halves the brightness.")
    ] = 0.0

    def parse(self) -> RelightOptions:
        """Parse options. Raises ``typer.BadParameter`` for an invalid light, position, colour or stops."""
        from model.reconstruction.render.relight import RelightOptions

        if not abs(self.stops) <= MAX_STOPS:
            expected = f"-{MAX_STOPS} to {MAX_STOPS}"
            raise typer.BadParameter(f"{self.stops}; expected {expected}", param_hint="--stops")
        return RelightOptions(
            sky=_sky(self.sky),
            lamps=tuple(_lamp(text) for text in self.lamp),
            insertions=tuple(_insertion(text) for text in self.insert),
            samples=self.samples,
            denoise=not self.no_denoise,
            compensation=2.0**self.stops,
        )


@with_options
def render(
    asset: Annotated[Path, typer.Argument(help="An environment package, such as OUT/asset.")],
    out: Annotated[
        Path, typer.Option(help="Folder of images (EXR, PNG), or an animation: FILE.gif, FILE.mp4 (VP9).")
    ],
    light: LightWords,
    film: FilmOptions,
    view: Annotated[
        tuple[str, ...], typer.Option(help="Images: name of a camera, repeatable; default: all.")
    ] = (),
    quiet: QuietOption = False,
) -> None:
    """Render an asset from its cameras or as an animation.

    Options replace the asset's lights and insert objects. An animation follows a path through the room and
    loops seamlessly.

    Example: materials render room/asset --out renders --sky 1,1,1 --insert bundled:mug@1,2,0.8
    """
    from model.reconstruction.render.relight import write_renders
    from model.reconstruction.render.turntable import TurntableOptions, write_turntable

    is_film = out.suffix.lower() in FILM_SUFFIXES
    for option, is_given in (("--view", view and is_film), ("--out", film != FilmOptions() and not is_film)):
        if is_given:
            expected = "FILE.gif or FILE.mp4 with options of an animation, a folder with --view"
            raise typer.BadParameter(f"{str(out)!r}; expected {expected}", param_hint=option)
    options = replace(light.parse(), views=tuple(view))
    with Bars("frames" if is_film else "views", is_quiet=quiet) as bars:
        if is_film:
            write_turntable(asset, out, TurntableOptions(**asdict(film), render=options), bars.tell, _warn)
            written = [out]
        else:
            written = write_renders(asset, out, options, _warn, bars.tell)
    for path in written:
        typer.echo(str(path))


def _warn(text: str) -> None:
    typer.echo(f"warning: {text}", err=True)


def view(
    asset: Annotated[Path, typer.Argument(help="Output of `materials infer`, or an asset package.")],
    out: Annotated[Path, typer.Option(help="Folder of the page.")],
    max_side: Annotated[
        int,
        typer.Option(min=64, max=4096, help="Maximum side of textures in texels; larger ones are shrunk."),
    ] = 4096,
    quiet: QuietOption = False,
) -> None:
    """Write a web page that shows an asset in 3D, with a movable light. It opens from disk in any browser.

    Example: materials view room --out room-page
    """
    from model.reconstruction.atlas_page.writing import write_view

    with Bars("images", is_quiet=quiet) as bars:
        result = write_view(asset, out, max_side, partial(bars.tell, "view"))
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
    if len(values) not in counts or not all(map(isfinite, values)):
        expected = " or ".join(str(count) for count in counts)
        raise typer.BadParameter(f"{text!r}; expected {expected} finite numbers", param_hint=option)
    return values


def _sky(text: str | None) -> Path | tuple[float, float, float] | None:
    if text is None:
        return None
    if text.lower().endswith(".exr"):
        return Path(text)
    red, green, blue = _numbers(text, (3,), "--sky")
    if min(red, green, blue) < 0:
        raise typer.BadParameter(f"{text!r}; expected a radiance of at least 0", param_hint="--sky")
    return red, green, blue


def _lamp(text: str) -> Any:
    from model.reconstruction.render.relight import Lamp

    x, y, z, *intensity = _numbers(text, (3, 4, 6), "--lamp")
    if not intensity:
        return Lamp((x, y, z))
    if min(intensity) < 0 or not max(intensity) > 0:
        raise typer.BadParameter(f"{text!r}; expected an intensity above 0", param_hint="--lamp")
    red, green, blue = intensity if len(intensity) == 3 else intensity * 3
    return Lamp((x, y, z), (red, green, blue))


def _insertion(text: str) -> Any:
    from model.reconstruction.render.relight import Insertion

    package, separator, place = text.rpartition("@")
    if not separator:
        raise typer.BadParameter(f"{text!r}; expected PACKAGE@X,Y,Z", param_hint="--insert")
    x, y, z, *yaw = _numbers(place, (3, 4), "--insert")
    return Insertion(object_package(package, Path()), (x, y, z), radians(yaw[0]) if yaw else 0.0)

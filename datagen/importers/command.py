# SPDX-License-Identifier: MIT
"""The subcommand ``datagen import``. Heavy modules are imported only when it runs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from datagen.foundation.command_line import declared_options, with_options
from datagen.foundation.errors import InputError, Problems, input_error
from datagen.importers.watch import ImportWatch

if TYPE_CHECKING:
    from datagen.importers.common import ImportOptions


@dataclass(frozen=True)
class ImportWords:
    """Command-line options of an import as strings, which :meth:`parse` checks."""

    kind: Annotated[str, typer.Option(help="auto, environment, object or material.")] = "auto"
    asset_id: Annotated[str, typer.Option("--id", help="Id of the asset; by default from its name.")] = ""
    title: Annotated[str, typer.Option(help="Title of the asset.")] = ""
    license: Annotated[str, typer.Option(help="SPDX licence; by default from the source's folder.")] = ""
    author: Annotated[str, typer.Option(help="Author; by default from the source's folder.")] = ""
    source: Annotated[str, typer.Option(help="Origin, such as a web address.")] = ""
    evaluation_only: Annotated[
        bool, typer.Option("--evaluation-only", help="Exclude the asset from training data.")
    ] = False
    category: Annotated[str, typer.Option(help="Category of an object; guessed if left out.")] = ""
    classes: Annotated[
        tuple[str, ...], typer.Option("--class", help="Material class, repeatable; guessed if left out.")
    ] = ()
    up: Annotated[str, typer.Option(help="Axis that points up in the file: auto, y or z.")] = "auto"
    unit_scale: Annotated[
        float | None, typer.Option(help="Metres per unit of the file; guessed for OBJ, PLY and STL.")
    ] = None
    tile_size_m: Annotated[
        float | None, typer.Option("--tile-size", help="Width of a material's tile in metres.")
    ] = None
    dielectric: Annotated[str, typer.Option(help="Transparent materials: refuse or replace.")] = "refuse"
    dielectric_as: Annotated[
        tuple[str, ...], typer.Option(help="MATERIAL=REPLACEMENT for one transparent material, repeatable.")
    ] = ()
    missing: Annotated[str, typer.Option(help="Missing files: refuse or replace.")] = "refuse"
    annotations: Annotated[
        Path | None,
        typer.Option(help="YAML with support surfaces, openings, light slots and camera regions."),
    ] = None
    defines: Annotated[
        tuple[str, ...],
        typer.Option("--define", help="NAME=VALUE sets $NAME in a Mitsuba scene, repeatable."),
    ] = ()
    allowed: Annotated[
        tuple[Path, ...],
        typer.Option("--allow", help="Another folder from which files may be read, repeatable."),
    ] = ()
    as_zip: Annotated[bool, typer.Option("--zip", help="Write packages as zips.")] = False
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace assets of the same id.")] = False

    def parse(self) -> ImportOptions:
        """Return the options with checked types and choices. Raises :class:`InputError` with all faults."""
        from pydantic import TypeAdapter, ValidationError

        from datagen.importers.common import ImportOptions

        values = {
            **asdict(self),
            "dielectric_as": _pairs("--dielectric-as", self.dielectric_as),
            "defines": _pairs("--define", self.defines),
        }
        try:
            return TypeAdapter(ImportOptions).validate_python(values)
        except ValidationError as error:
            options, problems = declared_options(ImportWords), Problems("datagen import")
            for entry in error.errors():
                option, expected = options[str(entry["loc"][0])][0], entry["msg"].lower()
                expected = expected.removeprefix("input should be ")
                problems.add(option, repr(entry.get("input")), expected, "correct the option")
            raise InputError(*problems) from None


def _pairs(option: str, values: tuple[str, ...]) -> dict[str, str]:
    pairs = {}
    for value in values:
        name, separator, text = value.partition("=")
        if not separator or not name:
            raise input_error(option, got=repr(value), expected="NAME=VALUE", remedy="correct the option")
        pairs[name] = text
    return pairs


@with_options
def import_command(
    path: Annotated[
        Path,
        typer.Argument(
            help="Mitsuba scene, glTF, OBJ, PLY, STL, FBX, USD, .blend or Sweet Home 3D file, texture "
            "folder, or a folder of these."
        ),
    ],
    library: Annotated[Path, typer.Option(help="Library folder to import into.")],
    words: ImportWords,
    split: Annotated[
        bool, typer.Option("--split", help="Import each separate group of a glTF file as an object.")
    ] = False,
) -> None:
    """Convert files of other programs to asset packages. Approximations are listed.

    Example: datagen import staircase/scene.xml --library my-library --dielectric replace
    """
    from datagen.importers.dispatch import import_asset

    options = words.parse()
    with ImportWatch() as watch:
        imported = import_asset(path, library, options, split=split, watch=watch)
    typer.echo(f"{len(imported)} assets imported into {library}")

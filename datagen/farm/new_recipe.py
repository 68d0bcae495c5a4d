# SPDX-License-Identifier: MIT
"""The command ``datagen recipe new``, which writes a recipe from four answers, and its schema for editors."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated

import typer

from datagen.foundation.errors import input_error
from datagen.foundation.naming import slug

recipe = typer.Typer(
    name="recipe", help="Recipes: descriptions of datasets.", no_args_is_help=True, rich_markup_mode=None
)
SCHEMA_FILE = "recipe.schema.json"
_TEXT = """\
# yaml-language-server: $schema={schema}
# {images} images. To list all keys of a recipe: datagen run {file} --out DATASET --dry-run
format: scene-materials/recipe
version: 1
name: {name}
seed: {seed}
configurations: {configurations}  # rooms, each with its own objects, materials and lights
views: {views}  # cameras per configuration
resolution: [{width}, {height}]
library: [bundled]  # folders of assets, relative to this file
render: {{quality: {quality}}}  # draft, standard or reference
"""


@recipe.callback()
def _recipe() -> None:
    """The group ``recipe``: descriptions of datasets."""


@recipe.command()
def new(
    file: Annotated[Path, typer.Argument(help="Recipe to write (YAML), named after the dataset.")],
    configurations: Annotated[int | None, typer.Option(min=1, help="Number of rooms.")] = None,
    views: Annotated[int | None, typer.Option(min=1, help="Views per configuration.")] = None,
    resolution: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT in pixels.")] = None,
    quality: Annotated[str | None, typer.Option(help="draft, standard or reference.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random choices.")] = 0,
) -> None:
    """Ask four questions and write a recipe; options answer them in advance.

    Example: datagen recipe new rooms.yaml --configurations 4 --views 8 --resolution 320x192 --quality draft
    """
    if configurations is None:
        configurations = typer.prompt("How many rooms", default=10, type=int)
    if views is None:
        views = typer.prompt("How many views of each", default=12, type=int)
    if resolution is None:
        resolution = typer.prompt("Width x height in pixels", default="320x192")
    if quality is None:
        quality = typer.prompt("Quality: draft, standard or reference", default="draft")
    typer.echo(write_recipe(file, configurations, views, resolution, quality, seed))
    typer.echo(f"next: datagen run {file} --out {file.stem}")


def write_recipe(
    file: Path, configurations: int, views: int, resolution: str, quality: str, seed: int = 0
) -> Path:
    """Write a recipe and, to the same folder, its schema; return ``file``.

    Raises :class:`InputError` for invalid answers and an existing file.
    """
    import yaml

    from datagen.formats.base import parse_model, write_bytes_atomically
    from datagen.formats.recipe import Recipe
    from datagen.formats.schemas import json_schemas

    if file.suffix.lower() not in (".yaml", ".yml"):
        raise input_error(file, "", file.suffix or "no suffix", ".yaml", "change the suffix")
    if file.exists():
        raise input_error(file, "", "an existing file", "a new one", "choose another name, or remove it")
    size = re.fullmatch(r"\s*(\d{1,6})\s*[x×, ]\s*(\d{1,6})\s*", resolution)
    if size is None:
        raise input_error("--resolution", "", resolution, "WIDTHxHEIGHT, such as 320x192", "correct it")
    text = _TEXT.format(
        schema=SCHEMA_FILE,
        images=f"{configurations * views:,}",
        file=file.name,
        name=slug(file.stem),
        seed=seed,
        configurations=configurations,
        views=views,
        width=int(size[1]),
        height=int(size[2]),
        quality=json.dumps(quality) if not quality.isalpha() else quality,
    )
    parse_model(Recipe, yaml.safe_load(text), "the answers")
    file.parent.mkdir(parents=True, exist_ok=True)
    schema = json.dumps(json_schemas()["recipe"], indent=2, sort_keys=True) + "\n"
    write_bytes_atomically(file.parent / SCHEMA_FILE, schema.encode())
    write_bytes_atomically(file, text.encode())
    return file

# SPDX-License-Identifier: MIT
"""The command ``datagen recipe new``, which asks four questions and writes a recipe and its schema."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import typer

from datagen.foundation.errors import input_error
from datagen.foundation.naming import slug

recipe = typer.Typer(
    name="recipe", help="Write recipes of datasets.", no_args_is_help=True, rich_markup_mode=None
)
SCHEMA_FILE = "recipe.schema.json"


@recipe.callback()
def _recipe() -> None:
    """Write recipes of datasets."""


def _question(prompt: str, text: str, least: int | None = None) -> Any:
    return typer.Option(prompt=prompt, min=least, help=text, show_default=False)


@recipe.command()
def new(
    file: Annotated[
        Path, typer.Argument(help="Recipe to write (YAML); its file name also names the dataset.")
    ],
    configurations: Annotated[int, _question("How many rooms [10]", "Number of rooms.", 1)] = 10,
    views: Annotated[int, _question("How many views of each [12]", "Views per configuration.", 1)] = 12,
    resolution: Annotated[
        str, _question("Width x height in pixels [320x192]", "WIDTHxHEIGHT in pixels.")
    ] = "320x192",
    quality: Annotated[
        str, _question("Quality: draft, standard or reference [draft]", "draft, standard or reference.")
    ] = "draft",
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random choices.")] = 0,
) -> None:
    """Ask four questions and write a recipe. Options answer them in advance.

    Example: datagen recipe new rooms.yaml --configurations 4 --views 8 --resolution 320x192 --quality draft
    """
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
    template = files("datagen.farm") / "templates" / "recipe.yaml"
    text = template.read_text(encoding="utf-8").format(
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

# SPDX-License-Identifier: MIT
"""JSON Schemas of every file format, exported from the models that read them.

``python -m datagen.formats.schemas`` writes them to ``docs/schemas``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import TypeAdapter

from datagen.formats.asset import Asset
from datagen.formats.base import write_bytes_atomically
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import Recipe
from datagen.formats.shard import DatasetIndex
from datagen.formats.view import ViewRecord
from datagen.foundation.command_line import run_function

DIALECT = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
_ADAPTERS: dict[str, TypeAdapter[Any]] = {
    "asset": TypeAdapter(Asset),
    "configuration": TypeAdapter(Configuration),
    "recipe": TypeAdapter(Recipe),
    "view": TypeAdapter(ViewRecord),
    "dataset-index": TypeAdapter(DatasetIndex),
}


def json_schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON Schema (2020-12) of each format, by name."""
    return {name: {**DIALECT, **adapter.json_schema()} for name, adapter in _ADAPTERS.items()}


def write_schemas(folder: Path, schemas: dict[str, dict[str, Any]] | None = None) -> list[Path]:
    """Write ``<name>.schema.json`` for each of ``schemas`` (:func:`json_schemas`); return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, schema in (schemas or json_schemas()).items():
        path = folder / f"{name}.schema.json"
        write_bytes_atomically(path, (json.dumps(schema, indent=2, sort_keys=True) + "\n").encode())
        written.append(path)
    return written


SchemaFolder = Annotated[Path, typer.Option("--out", help="Folder for the schemas.")]
SCHEMA_FOLDER = Path("docs/schemas")


def main(out: SchemaFolder = SCHEMA_FOLDER) -> None:
    """Write the JSON Schemas of all file formats."""
    for path in write_schemas(out):
        typer.echo(path)


if __name__ == "__main__":
    run_function(main)

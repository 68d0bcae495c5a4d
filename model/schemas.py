# SPDX-License-Identifier: MIT
"""JSON Schemas of evaluation suites and training settings, for completion in editors.

``python -m model.schemas`` writes them to ``docs/schemas``.
"""

from __future__ import annotations

from typing import Any

import typer

from datagen.formats.schemas import DIALECT, SCHEMA_FOLDER, SchemaFolder, write_schemas
from datagen.foundation.command_line import run_function
from model.evaluation.suite import Suite
from model.training.config import TrainingConfig


def json_schemas() -> dict[str, dict[str, Any]]:
    """JSON Schema (2020-12) of each format, by name.

    No training setting is required, since a file of settings overrides a preset.
    """
    training = TrainingConfig.model_json_schema()
    training.pop("required", None)
    return {"suite": {**DIALECT, **Suite.model_json_schema()}, "training": {**DIALECT, **training}}


def main(out: SchemaFolder = SCHEMA_FOLDER) -> None:
    """Write the JSON Schemas of suites and of training settings."""
    for path in write_schemas(out, json_schemas()):
        typer.echo(path)


if __name__ == "__main__":
    run_function(main)

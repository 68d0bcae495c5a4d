# SPDX-License-Identifier: MIT
"""JSON Schemas of what people write for ``materials``: suites, and settings of training."""

from __future__ import annotations

from typing import Any

from datagen.formats.schemas import DIALECT
from model.evaluation.suite import Suite
from model.training.config import TrainingConfig


def json_schemas() -> dict[str, dict[str, Any]]:
    """JSON Schema (2020-12) of each format, by name. Settings of training go over a preset, so none is
    required."""
    training = TrainingConfig.model_json_schema()
    training.pop("required", None)
    return {"suite": {**DIALECT, **Suite.model_json_schema()}, "training": {**DIALECT, **training}}

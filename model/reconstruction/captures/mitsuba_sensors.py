# SPDX-License-Identifier: MIT
"""Reads the sensors of a Mitsuba scene in the scene's frame; images are named by sensor id."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datagen.formats.mitsuba.scene import parse_scene
from datagen.formats.mitsuba.sensors import camera_of
from datagen.foundation.budget import Budget
from datagen.foundation.errors import input_error
from datagen.foundation.findings import Findings
from model.reconstruction.captures.posed import Calibration, PosedImage, head_of


def find(path: Path) -> Path | None:
    """Return ``path`` if it is a Mitsuba scene, else None."""
    return path if path.suffix == ".xml" and "<scene" in head_of(path) else None


def read(path: Path, images: Path | None, budget: Budget) -> Calibration:
    """Read the calibration of every sensor. Raises :class:`InputError` if there is none or one is invalid."""
    posed = []
    for number, node in enumerate(parse_scene(path, budget=budget).all_of("sensor")):
        budget.spend("frames", 1, node.where)
        try:
            made = camera_of(node, number, np.eye(4), Findings())
        except (ArithmeticError, TypeError) as error:
            raise input_error(path, node.where, str(error), "a perspective sensor", "correct it") from None
        posed.append(PosedImage(made.name, made.camera(), None))
    if not posed:
        raise input_error(path, "sensor", "none", "at least one sensor", "add the cameras to the scene")
    return Calibration(tuple(posed), images or path.parent)

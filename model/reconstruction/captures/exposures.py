# SPDX-License-Identifier: MIT
"""Normalises recorded exposures of photographs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from datagen.foundation.errors import InputError, Problem
from model.reconstruction.captures.photographs import relative_exposure


def exposure_scales(images: Sequence[Path], *, is_required: bool) -> list[float]:
    """Compute the factor that compensates for the recorded exposure of each photograph, 1 at the median.

    If any photograph has no record, all factors are 1; if ``is_required``, raises :class:`InputError` with
    all of these photographs.
    """
    gathered = [relative_exposure(image) for image in images]
    problems = [
        Problem(image, "EXIF", "no exposure time, aperture or ISO", "all three", "use --exposure common")
        for image, value in zip(images, gathered, strict=True)
        if value is None
    ]
    if problems and is_required:
        raise InputError(*problems)
    if problems:
        return [1.0] * len(gathered)
    values = np.array(gathered, dtype=np.float64)
    return [float(value) for value in np.median(values) / values]

# SPDX-License-Identifier: MIT
"""The colour map of all scalar images."""

from __future__ import annotations

import numpy as np


def cividis() -> list[list[int]]:
    """256 sRGB colours for values from 0 to 1, perceived alike with and without colour blindness."""
    from matplotlib import colormaps

    colors = colormaps["cividis"](np.linspace(0, 1, 256))[:, :3]
    rows: list[list[int]] = (colors * 255 + 0.5).astype(int).tolist()
    return rows

# SPDX-License-Identifier: MIT
"""The colour map of all scalar images."""

from __future__ import annotations

import numpy as np


def cividis() -> list[list[int]]:
    """Return the cividis colour map for values 0 to 1: 256 sRGB colours [red, green, blue], 0 to 255."""
    from matplotlib import colormaps

    colors = colormaps["cividis"](np.linspace(0, 1, 256))[:, :3]
    rows: list[list[int]] = (colors * 255 + 0.5).astype(int).tolist()
    return rows

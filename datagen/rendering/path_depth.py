# SPDX-License-Identifier: MIT
"""How long light paths have to be: from the albedo that light meets to a depth that leaves little behind.

Light that is reflected once more is rho times what it was, if rho is the reflectance of what it meets. Paths
of d segments end after d - 1 reflections, so that the share rho^(d-1) of all reflected light is missing.

What light meets inside a room is what eyes there meet: rho is taken from the surfaces that a few of the
configuration's cameras see, the (1 - S) D + S of the ground truth. Surfaces by area would count the outside
of walls and the inside of things.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

MIN_DEPTH = 2
"""Direct light."""
MAX_DEPTH = 64
"""Where surfaces reflect nearly everything; Russian roulette ends nearly all paths before."""


def reflectance_met(buffers: list[dict[str, NDArray[np.float32]]]) -> float:
    """Reflectance of the surfaces in views, in [0, 1]; 0 where none is seen.

    The root mean square over pixels, of the channel that reflects most: bright surfaces send more light on
    than dark ones, so that the mean would be too small. ``buffers`` are ground truth of views, (H, W, C).
    """
    squares, weight = np.zeros(3), 0.0
    for view in buffers:
        mask = view["surface_mask"].astype(np.float64)
        diffuse, specular = (view[name].astype(np.float64) for name in ("diffuse_albedo", "specular_albedo"))
        squares += (mask * ((1.0 - specular) * diffuse + specular) ** 2).sum(axis=(0, 1))
        weight += float(mask.sum())
    return float(np.sqrt(squares.max() / weight)) if weight > 0.0 else 0.0


def depth_for(reflectance: float, max_energy_left: float) -> int:
    """Fewest segments, 2 ... 64, for which ``reflectance`` ** (depth - 1) is at most ``max_energy_left``."""
    if reflectance <= 0.0:
        return MIN_DEPTH
    if reflectance >= 1.0:
        return MAX_DEPTH
    # The slack keeps a share that is exactly reached from asking for a segment more by rounding.
    bounces = math.ceil(math.log(max_energy_left) / math.log(reflectance) - 1e-9)
    return min(MAX_DEPTH, max(MIN_DEPTH, 1 + bounces))


def truncation(reflectance: float, depth: int) -> float:
    """Share of the reflected light that paths of ``depth`` segments miss, in [0, 1]."""
    return min(1.0, reflectance) ** (depth - 1)

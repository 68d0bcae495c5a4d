# SPDX-License-Identifier: MIT
"""Computes the path depth that bounds the truncation, from the reflectance of the scene.

Each bounce scales light by the reflectance rho of the surface. Paths of d segments end after d - 1 bounces
and lack the share rho^(d-1) of all reflected light, which is the truncation.

rho is the reflectance (1 - S) D + S of the ground truth, over the surfaces visible to a few of the
configuration's cameras. An area-weighted mean would include the outside of walls and the inside of objects.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

MIN_DEPTH = 2
"""Minimum depth, with only direct light."""
MAX_DEPTH = 64
"""Maximum depth, for nearly white surfaces; Russian roulette ends nearly all paths earlier."""


def rms_reflectance(buffers: list[dict[str, NDArray[np.float32]]]) -> float:
    """Reflectance in [0, 1] that represents all surfaces in views, given the buffers of each by name.

    It is the root mean square over pixels, in the channel where that is largest; a plain mean would
    underestimate the share of light from bright surfaces. 0 without surfaces.
    """
    squares, weight = np.zeros(3), 0.0
    for view in buffers:
        mask = view["surface_mask"].astype(np.float64)
        diffuse, specular = (view[name].astype(np.float64) for name in ("diffuse_albedo", "specular_albedo"))
        squares += (mask * ((1.0 - specular) * diffuse + specular) ** 2).sum(axis=(0, 1))
        weight += float(mask.sum())
    return float(np.sqrt(squares.max() / weight)) if weight > 0.0 else 0.0


def depth_for(reflectance: float, max_energy_left: float) -> int:
    """Smallest path depth with a truncation of at most ``max_energy_left``, clamped to [2, 64]."""
    if reflectance <= 0.0:
        return MIN_DEPTH
    if reflectance >= 1.0:
        return MAX_DEPTH
    # without the slack, rounding would add a segment if the bound is met exactly
    bounces = math.ceil(math.log(max_energy_left) / math.log(reflectance) - 1e-9)
    return min(MAX_DEPTH, max(MIN_DEPTH, 1 + bounces))


def truncation(reflectance: float, depth: int) -> float:
    """Share, in [0, 1], of the reflected light that paths of ``depth`` segments lack."""
    return min(1.0, reflectance) ** (depth - 1)

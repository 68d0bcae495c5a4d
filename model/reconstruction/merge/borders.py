# SPDX-License-Identifier: MIT
"""Weights a view's pixels by their distance to borders.

At a border, of the image or of a silhouette, the set of merged views changes, which would cause visible steps
in the merged maps. A pixel's weight therefore decreases to almost 0 towards the nearest border.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

RAMP = 0.1
"""Distance over which the weight decreases, relative to the image diagonal."""
MIN_BORDER_WEIGHT = 1e-3
"""Weight at a border, above 0 so that texels visible only near borders, such as leaves, get a value."""


def border_weights(depth_z_m: NDArray, max_jump: float) -> NDArray[np.float32]:
    """Compute the weight (H, W) in [MIN_BORDER_WEIGHT, 1] of each pixel by distance to the nearest border.

    Borders are the edges of the image, pixels without a surface (``depth_z_m`` (H, W) is 0), and neighbouring
    pixels whose depths differ by more than ``max_jump`` relative to the larger one.
    """
    import cv2

    is_free = depth_z_m > 0
    for axis in (0, 1):
        depth, free = np.swapaxes(depth_z_m, 0, axis), np.swapaxes(is_free, 0, axis)
        jumps = np.abs(np.diff(depth, axis=0)) > max_jump * np.maximum(depth[1:], depth[:-1])
        free[1:] &= ~jumps
        free[:-1] &= ~jumps
    padded = np.pad(is_free, 1).astype(np.uint8)
    distance_px: Any = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    ramp_px = RAMP * float(np.linalg.norm(depth_z_m.shape))
    return np.clip(distance_px / ramp_px, MIN_BORDER_WEIGHT, 1).astype(np.float32)

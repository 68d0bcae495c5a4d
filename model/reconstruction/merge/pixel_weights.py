# SPDX-License-Identifier: MIT
"""Weights of a view's pixels in the merge.

At a border, of the image or of a silhouette, the set of merged views changes, which would cause visible steps
in the merged maps. A pixel's weight therefore decreases to almost 0 towards the nearest border.

Distant and grazing views blur texture. Where maps are exact, pixels are therefore weighted by the square of
their resolution on the surface; where they are predictions, whose errors differ between views, equally.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera
from datagen.geometry.traced import ViewGeometry

RAMP = 0.1
"""Distance over which the weight decreases, relative to the image diagonal."""
MIN_BORDER_WEIGHT = 1e-3
"""Weight at a border, above 0 so that texels visible only near borders, such as leaves, get a value."""
MIN_COSINE = 0.02
"""Minimum cosine of the angle of incidence, since a weight of 0 would discard views that show the texel."""


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


def pixels_per_metre(camera: Camera, view: ViewGeometry) -> NDArray[np.float32]:
    """Compute f cos / z (H, W), each pixel's resolution on the surface along its coarser axis.

    f: focal length in pixels; cos: cosine of the angle of incidence; z: depth. 0 at pixels without a surface.
    """
    depth = view.depth_z_m[..., 0]
    found = np.sqrt(camera.fx_px * camera.fy_px) * np.maximum(view.cosine(camera), MIN_COSINE)
    return np.divide(found, depth, out=np.zeros_like(depth), where=depth > 0)


def resolution_weights(resolution: NDArray, typical: float, confidence: NDArray) -> NDArray[np.float32]:
    """Compute (``resolution`` / ``typical``)^(2 ``confidence``) (H, W, 3) of D, S and R.

    ``resolution`` (H, W): pixels per metre; where it is 0, weights are 1. ``typical``: that of the views'
    median pixel; ``confidence`` (H, W, 3) in [0, 1].
    """
    relative = np.where(resolution > 0, resolution / typical, 1).astype(np.float32)
    return relative[..., None] ** (2 * confidence.astype(np.float32))

# SPDX-License-Identifier: MIT
"""Chooses the atlas size at which texels are as fine as the views' pixels on the surface."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from datagen.foundation.cameras import Camera
from datagen.geometry.traced import ViewGeometry

MIN_SIZE, MAX_SIZE = 256, 16384
_GRAZING_COSINE = 0.1  # bounds the footprints of grazing views


def pixel_footprint_m(views: Iterable[tuple[Camera, ViewGeometry]], quantile: float = 0.1) -> float | None:
    """Compute the side in metres of a fine pixel's footprint on the surface; None if no surface is visible.

    The result is the ``quantile`` over pixels of z / f / sqrt(cos), with depth z, focal length f in pixels
    and cosine of the angle of incidence.
    """
    footprints = []
    for camera, view in views:
        step = max(1, view.face.size // 20_000)
        z = view.depth_z_m.ravel()[::step].astype(np.float64)
        cosine = view.cosine(camera).ravel()[::step]
        hit = z > 0
        focal = np.sqrt(camera.fx_px * camera.fy_px)
        footprints.append(z[hit] / focal / np.sqrt(np.maximum(cosine[hit], _GRAZING_COSINE)))
    joined = np.concatenate(footprints) if footprints else np.zeros(0)
    return float(np.quantile(joined, quantile)) if joined.size else None


def atlas_size(footprint_m: float | None, metres_per_side: float) -> int:
    """Compute the side in texels, a multiple of 256 in [256, 16384], for texels of ``footprint_m``."""
    if footprint_m is None:
        return MIN_SIZE
    return int(np.clip(np.ceil(metres_per_side / footprint_m / 256) * 256, MIN_SIZE, MAX_SIZE))

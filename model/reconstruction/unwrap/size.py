# SPDX-License-Identifier: MIT
"""Chooses the atlas size at which texels are as fine as the views' pixels on the surface."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera
from datagen.geometry.traced import ViewGeometry

MIN_SIZE, MAX_SIZE = 256, 16384
MAX_PIXELS = 20_000
FINE_QUANTILE = 0.9
"""Quantile of pixels per metre that counts as fine."""
_GRAZING_COSINE = 0.1  # bounds the footprints of grazing views


@dataclass(frozen=True)
class PixelDensity:
    """Samples of the views' pixels on the surface: the ``face`` (K,) that a pixel shows, and the pixels per
    metre there (K,), f sqrt(cos) / z, with focal length f in pixels, cosine of the angle of incidence and
    depth z.
    """

    face: NDArray[np.int32]
    per_m: NDArray[np.float64]

    @property
    def footprint_m(self) -> float | None:
        """Side of a fine pixel's footprint on the surface in metres; None if no surface is visible."""
        return float(1 / np.quantile(self.per_m, FINE_QUANTILE)) if len(self.per_m) else None


def pixel_density(views: Iterable[tuple[Camera, ViewGeometry]]) -> PixelDensity:
    """Sample up to :data:`MAX_PIXELS` pixels of each view."""
    faces, densities = [np.zeros(0, np.int32)], [np.zeros(0)]
    for camera, view in views:
        step = max(1, view.face.size // MAX_PIXELS)
        z = view.depth_z_m.ravel()[::step].astype(np.float64)
        cosine = view.cosine(camera).ravel()[::step]
        hit = z > 0
        focal = np.sqrt(camera.fx_px * camera.fy_px)
        faces.append(view.face.ravel()[::step][hit])
        densities.append(focal * np.sqrt(np.maximum(cosine[hit], _GRAZING_COSINE)) / z[hit])
    return PixelDensity(np.concatenate(faces), np.concatenate(densities))


def atlas_size(footprint_m: float | None, metres_per_side: float) -> int:
    """Compute the side in texels, a multiple of 256 in [256, 16384], for texels of ``footprint_m``."""
    if footprint_m is None:
        return MIN_SIZE
    return int(np.clip(np.ceil(metres_per_side / footprint_m / 256) * 256, MIN_SIZE, MAX_SIZE))

# SPDX-License-Identifier: MIT
"""The recovered lights of a room, for export (docs/light.md)."""

from __future__ import annotations

import numpy as np

from datagen.formats.capture import CaptureGeometry
from datagen.foundation.color import luminance
from datagen.geometry.traced import TracedGeometry
from datagen.light.lighting import Lit
from model.reconstruction.found_lights import FoundLights
from model.reconstruction.light.lamps import found_lamps
from model.reconstruction.light.openings import found_windows, leaving_rays
from model.reconstruction.light.shining import shining_patches
from model.reconstruction.light.sky import sky_image


def found_lights(lit: Lit, traced: TracedGeometry, geometry: CaptureGeometry) -> FoundLights:
    """Lamps, windows and, if light from outside is far, the sky, with their photographed radiance.

    Lamps that the geometry names are taken from it.
    """
    field = lit.baker.field
    lamps = found_lamps(field.emitters, traced.mesh, geometry.parts)
    rays = leaving_rays(field, lit.surfels)
    median = float(np.median(luminance(lit.surfels.radiance.astype(np.float64))))
    windows = found_windows(rays, field.background, median)
    sky = sky_image(field.background) if windows and field.background.layout.is_far else None
    return FoundLights(lamps, shining_patches(lit), windows, sky)

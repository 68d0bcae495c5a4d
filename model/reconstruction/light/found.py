# SPDX-License-Identifier: MIT
"""The recovered lights of a room, for export (docs/light.md)."""

from __future__ import annotations

import numpy as np

from datagen.formats.capture import CaptureGeometry
from datagen.foundation.color import luminance
from datagen.geometry.traced import TracedGeometry
from datagen.light.lighting import Lit
from datagen.light.surfels import Surfels
from model.reconstruction.found_lights import FoundLights, RadianceSamples
from model.reconstruction.light.lamps import found_lamps
from model.reconstruction.light.openings import found_windows, leaving_rays
from model.reconstruction.light.shining import shining_patches
from model.reconstruction.light.sky import sky_image

NUM_SAMPLES = 1600
"""Observations by which exported lights are balanced."""
_START_CELLS = 2.0  # distance of a ray's start from its surfel, which is a mean over a cell
_SEED = 0x62616C


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


def radiance_samples(surfels: Surfels, num: int = NUM_SAMPLES) -> RadianceSamples:
    """At most ``num`` observations, in proportion to their pixels, of surfels that are not mixed."""
    observations, owner = surfels.observations, surfels.surfel_of_observation()
    weight = observations.weight * ~surfels.is_mixed[owner]
    usable = int((weight > 0).sum())
    if not usable:
        return RadianceSamples(*np.zeros((3, 0, 3), np.float32))
    random = np.random.default_rng(_SEED)
    drawn = random.choice(
        len(weight), min(num, usable), replace=False, p=weight / weight.sum(dtype=np.float64)
    )
    toward = surfels.directions(owner[drawn], observations.view[drawn])
    origin = surfels.position_m[owner[drawn]] + _START_CELLS * surfels.grid.cell_m * toward
    return RadianceSamples(origin.astype(np.float32), -toward, observations.radiance[drawn])

# SPDX-License-Identifier: MIT
"""White balance of lamps beside panoramas.

A panorama is a photograph and already balanced; lamps have the colour that a camera with automatic white
balance gives them. It takes the mean light of the room, walls included, for that of a black body and shifts
it most of the way to white, so that lamps by night are slightly warm, and orange where daylight prevails.
"""

from __future__ import annotations

import math

import numpy as np

from datagen.assembly.geometry import Floats
from datagen.foundation.color import color_of_temperature

ADAPTATION = 0.7  # share of the way to white, in reciprocal temperature: cameras keep lamps warm
_WHITE_MIRED = 1e6 / 6500
_MIREDS = np.linspace(_WHITE_MIRED, 1e6 / 2000, 64)  # warmer than white, where a camera's range ends
Tint = tuple[float, float, float]
NO_TINT: Tint = (1.0, 1.0, 1.0)


def tint_of_lamps(irradiance: Floats) -> Tint:
    """Factors on lamps' red, green and blue in light of mean ``irradiance`` (3,); 1 in white or bluish light.

    Light of the black body that is seen keeps its luminance.
    """
    red, _, blue = irradiance.tolist()
    if red <= 0 or blue <= 0:
        return NO_TINT
    ratios = [math.log(r / b) for r, _, b in map(color_of_temperature, (1e6 / _MIREDS).tolist())]
    seen = float(np.interp(math.log(red / blue), ratios, _MIREDS))
    shown = seen + ADAPTATION * (_WHITE_MIRED - seen)
    before, after = color_of_temperature(1e6 / seen), color_of_temperature(1e6 / shown)
    one, two, three = (b / a for a, b in zip(before, after, strict=True))
    return (one, two, three)

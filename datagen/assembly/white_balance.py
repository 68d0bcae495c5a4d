# SPDX-License-Identifier: MIT
"""White balance of lamps in rooms with panoramas.

A panorama is a photograph and already balanced; lamps get the colour that a camera with automatic white
balance would record. Such a camera estimates the mean light of the room as blackbody light and shifts it most
of the way to white, so lamps appear slightly warm at night and orange in rooms with much daylight.
"""

from __future__ import annotations

import math

import numpy as np

from datagen.assembly.geometry import Floats
from datagen.foundation.color import color_of_temperature

ADAPTATION = 0.7  # fraction of the full shift to white in mireds; below 1, as cameras keep lamps warm
_WHITE_MIRED = 1e6 / 6500
# from white to 2000 K, the warmest light that a camera's white balance corrects
_MIREDS = np.linspace(_WHITE_MIRED, 1e6 / 2000, 64)
Tint = tuple[float, float, float]
NO_TINT: Tint = (1.0, 1.0, 1.0)


def tint_of_lamps(irradiance: Floats) -> Tint:
    """Return RGB factors of lamps for the mean irradiance (3,) of a room; 1 if it is white or bluish.

    The factors preserve the luminance of the estimated blackbody light.
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

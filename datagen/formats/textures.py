# SPDX-License-Identifier: MIT
"""Conversion of texture pixels to material values."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import Texture
from datagen.foundation.color import LUMINANCE_WEIGHTS, linear_from_srgb
from datagen.foundation.errors import input_error
from datagen.foundation.images import normalized


def texture_values(texture: Texture, pixels: NDArray[Any], is_scalar: bool) -> NDArray[np.float32]:
    """Convert the pixels of a texture to material values: decoded, scaled, offset and clamped to [0, 1].

    ``pixels``: (H, W, C) from :func:`datagen.foundation.images.read_image`. Returns (H, W) if ``is_scalar``
    (the luminance of ``rgb``, as in Mitsuba), else (H, W, 3). Raises :class:`InputError` if the image lacks
    the channel.
    """
    values = normalized(pixels)
    num_channels = values.shape[2]
    if texture.channel == "rgb":
        color = values[..., :3] if num_channels >= 3 else np.repeat(values[..., :1], 3, axis=2)
    else:
        index = "rgba".index(texture.channel)
        if num_channels < 3 and index < 3:
            index = 0  # grey images store their value once
        elif num_channels == 2 and index == 3:
            index = 1
        if index >= num_channels:
            raise input_error(
                texture.texture, "channel", texture.channel, f"one of the image's {num_channels} channels"
            )
        color = np.repeat(values[..., index : index + 1], 3, axis=2)
    if texture.encoding == "srgb" and texture.channel != "a":
        color = linear_from_srgb(color)
    color = np.clip(color * texture.scale + texture.offset, 0.0, 1.0).astype(np.float32)
    if not is_scalar:
        return color
    return color[..., 0] if texture.channel != "rgb" else color @ LUMINANCE_WEIGHTS.astype(np.float32)

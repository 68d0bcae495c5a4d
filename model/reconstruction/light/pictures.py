# SPDX-License-Identifier: MIT
"""Makes pictures of views for the report: photograph, D and the confidence of D."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datagen.foundation.color import cividis, srgb_from_linear
from datagen.foundation.images import quantized_bytes
from datagen.geometry.views import TracedView
from model.reconstruction.stages import Maps, ViewPicture

NUM_VIEWS, WIDTH_PX = 6, 320
NO_SURFACE = 128
"""Grey value of pixels without a surface."""


def view_pictures(views: Sequence[TracedView], maps: Sequence[Maps], exposure: float) -> list[ViewPicture]:
    """Make pictures of up to :data:`NUM_VIEWS` evenly spaced views, at most :data:`WIDTH_PX` wide."""
    chosen = np.unique(np.linspace(0, len(views) - 1, NUM_VIEWS).round().astype(int))
    pictures = []
    for index in chosen:
        view, view_maps = views[index], maps[index]
        step = max(1, -(-view.camera.width_px // WIDTH_PX))
        thin = (slice(None, None, step), slice(None, None, step))
        scale = np.array(cividis(), np.uint8)
        confidence = scale[quantized_bytes(view_maps["confidence"][thin][..., 0].astype(np.float32))]
        confidence[view.geometry.surface_mask[thin][..., 0] == 0] = NO_SURFACE
        pictures.append(
            ViewPicture(
                view.name,
                quantized_bytes(srgb_from_linear(view.color[thin] * exposure)),
                quantized_bytes(srgb_from_linear(view_maps["diffuse_albedo"][thin].astype(np.float32))),
                confidence,
            )
        )
    return pictures

# SPDX-License-Identifier: MIT
"""Confidence of an atlas at the pixels of views."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import CaptureGeometry
from datagen.foundation.cameras import Camera
from datagen.geometry.texture_lookup import looked_up, pixel_uv
from datagen.geometry.traced import TracedGeometry


def merged_confidence(
    folder: Path, geometry: CaptureGeometry, cameras: Mapping[str, Camera]
) -> dict[str, NDArray[np.float64]]:
    """Confidence (H, W, 3) of D, S and R in [0, 1] in each view, by name; empty for an atlas without it.

    ``folder`` is the output of ``materials infer``, ``geometry`` the unwrapped mesh of its atlas.
    """
    from PIL import Image

    path = folder / "atlas" / "confidence.png"
    if not path.is_file():
        return {}
    with Image.open(path) as image:
        atlas = np.asarray(image.convert("RGB"), np.float32) / 255
    traced = TracedGeometry(geometry)
    found = {}
    for name, camera in cameras.items():
        uv = pixel_uv(geometry.mesh, camera, traced.trace_view(camera))
        is_surface = ~np.isnan(uv[..., 0])
        found[name] = np.zeros((camera.height_px, camera.width_px, 3))
        found[name][is_surface] = looked_up(atlas, uv[is_surface])
    return found

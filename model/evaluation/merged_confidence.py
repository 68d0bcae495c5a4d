# SPDX-License-Identifier: MIT
"""Confidence of an atlas at the pixels of views."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.ply import read_ply
from datagen.geometry.texture_lookup import looked_up, pixel_uv
from datagen.geometry.traced import TracedGeometry


def merged_confidence(folder: Path, cameras: Mapping[str, Camera]) -> dict[str, NDArray[np.float64]]:
    """Confidence (H, W, 3) of D, S and R in [0, 1] in each view, by name; empty for an atlas without it.

    ``folder`` is the output of ``materials infer``.
    """
    from PIL import Image

    path = folder / "atlas" / "confidence.png"
    if not path.is_file():
        return {}
    with Image.open(path) as image:
        atlas = np.asarray(image.convert("RGB"), np.float32) / 255
    mesh = read_ply(folder / "asset" / "surface.ply")
    traced = TracedGeometry(CaptureGeometry(mesh, (GeometryPart("surface", 0, len(mesh.faces)),)))
    found = {}
    for name, camera in cameras.items():
        uv = pixel_uv(mesh, camera, traced.trace_view(camera))
        is_surface = ~np.isnan(uv[..., 0])
        found[name] = np.zeros((camera.height_px, camera.width_px, 3))
        found[name][is_surface] = looked_up(atlas, uv[is_surface])
    return found

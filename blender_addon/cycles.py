# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders a scene with Cycles and returns linear pixels, without leaving a Render Result."""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray


def pixels_of(image: bpy.types.Image) -> NDArray[np.float32]:
    """Pixels (H, W, C) of a Blender image, row 0 at the top."""
    pixels = np.empty(image.size[0] * image.size[1] * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], image.channels)[::-1]


def read_linear(path: Path) -> NDArray[np.float32]:
    """Read pixels (H, W, 3) of an image file without colour conversion, row 0 at the top."""
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.name = "Non-Color"
        return pixels_of(image)[..., :3].copy()
    finally:
        bpy.data.images.remove(image)


def render_linear(scene: bpy.types.Scene) -> NDArray[np.float32]:
    """Render the view of the scene's camera; returns linear Rec.709 (H, W, 3), row 0 at the top."""
    render = scene.render
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_depth = "32"
    render.image_settings.color_mode = "RGB"
    scene.view_settings.view_transform = "Raw"
    had_result = "Render Result" in bpy.data.images
    with tempfile.TemporaryDirectory() as folder:
        render.filepath = str(Path(folder) / "render.exr")
        try:
            bpy.ops.render.render(write_still=True, scene=scene.name)
        finally:
            if not had_result and "Render Result" in bpy.data.images:
                bpy.data.images.remove(bpy.data.images["Render Result"])
        return read_linear(Path(render.filepath))

# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts Blender's cameras to pinhole intrinsics and a pose (x right, y down, z forward)."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ..problems import APPROXIMATION, ERROR, ProblemList


@dataclass(frozen=True)
class CameraData:
    """A pinhole camera: rigid pose ``asset_from_camera`` (4, 4) in metres, and intrinsics in pixels.

    ``clip_m``: near and far limit along the optical axis, as applied by Cycles to camera rays.
    """

    name: str
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    asset_from_camera: NDArray[np.float64]
    clip_m: tuple[float, float]


def gather_camera(
    thing: bpy.types.Object, render: bpy.types.RenderSettings, metres_per_unit: float, problems: ProblemList
) -> CameraData | None:
    """Convert a perspective camera; for others and empty clip ranges, add an error and return None."""
    camera = thing.data
    if camera.type != "PERSP":
        message = f"camera of type {camera.type.lower()} cannot be exported"
        problems.add(ERROR, message, "use a perspective camera, or set sm_role = ignore", object=thing.name)
        return None
    if camera.dof.use_dof:
        problems.add(APPROXIMATION, "depth of field is left out: everything is sharp", object=thing.name)
    if not camera.clip_start < camera.clip_end:
        message = f"clips from {camera.clip_start:g} to {camera.clip_end:g}, an empty range"
        problems.add(ERROR, message, "set Clip End above Clip Start", object=thing.name)
        return None
    scale = render.resolution_percentage / 100
    width, height = max(1, int(render.resolution_x * scale)), max(1, int(render.resolution_y * scale))
    # Lengths are in units of a pixel's width; aspect is a pixel's height divided by its width.
    aspect = render.pixel_aspect_y / render.pixel_aspect_x
    tall = height * aspect
    fits_width = camera.sensor_fit == "HORIZONTAL" or (camera.sensor_fit == "AUTO" and width >= tall)
    extent = width if fits_width else tall
    sensor = camera.sensor_height if camera.sensor_fit == "VERTICAL" else camera.sensor_width
    focal = extent * camera.lens / sensor
    pose = np.array(thing.matrix_world, dtype=np.float64)
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    pose[:3, 3] *= metres_per_unit
    return CameraData(
        thing.name,
        width,
        height,
        focal,
        focal / aspect,
        width / 2 - camera.shift_x * extent,
        height / 2 + camera.shift_y * extent / aspect,
        pose @ np.diag([1.0, -1.0, -1.0, 1.0]),
        (camera.clip_start * metres_per_unit, camera.clip_end * metres_per_unit),
    )

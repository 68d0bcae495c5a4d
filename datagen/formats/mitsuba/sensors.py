# SPDX-License-Identifier: MIT
"""Conversion of Mitsuba sensors to cameras."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import AssetCamera
from datagen.formats.base import matrix4, quantized
from datagen.formats.mitsuba.scene import MitsubaScene, SceneNode
from datagen.foundation.axes import affine, unit_vector
from datagen.foundation.findings import Findings

MITSUBA_FROM_CAMERA = np.diag([-1.0, -1.0, 1.0, 1.0])
"""From the project's camera frame (x right, y down, z forward) to Mitsuba's (x left, y up, z forward)."""


def guess_up(scene: MitsubaScene) -> Literal["y", "z"]:
    """Return the axis, y or z, to which the first sensor's up vector is closer; y if there are no sensors."""
    for sensor in scene.all_of("sensor"):
        up = sensor.to_world()[:3, 1]
        return "z" if abs(up[2]) > abs(up[1]) else "y"
    return "y"


def camera_of(
    node: SceneNode, number: int, asset_from_source: NDArray[np.float64], findings: Findings
) -> AssetCamera:
    """Convert a sensor to a pinhole camera; add ignored apertures, film crops and mirroring to ``findings``.

    ``asset_from_source`` (4, 4) is the rotation to Z up times the unit scale.
    """
    film = next(iter(node.children_of("film")), SceneNode("film", "hdrfilm"))
    width, height = int(film.get("width", 768)), int(film.get("height", 576))
    name = node.id or f"camera_{number}"
    if node.type != "perspective":
        findings.approximate(f"{name}: sensor {node.type!r} as a pinhole camera")
    if film.get("crop_width") or film.get("crop_height"):
        findings.approximate(f"{name}: crop of the film left out")
    to_world = node.to_world()
    if np.linalg.det(to_world[:3, :3]) < 0:
        findings.approximate(f"{name}: the sensor mirrors the image, the camera does not")
    matrix = asset_from_source @ to_world @ MITSUBA_FROM_CAMERA
    forward, down = unit_vector(matrix[:3, 2]), matrix[:3, 1]
    down = unit_vector(down - forward * float(down @ forward))
    rigid = affine(np.stack([np.cross(down, forward), down, forward], axis=1), matrix[:3, 3])
    focal = _focal_px(node, width, height)
    return AssetCamera(
        name=name,
        width_px=width,
        height_px=height,
        fx_px=quantized(focal),
        fy_px=quantized(focal),
        cx_px=width * (0.5 + float(node.get("principal_point_offset_x", 0.0))),
        cy_px=height * (0.5 + float(node.get("principal_point_offset_y", 0.0))),
        asset_from_camera=matrix4(rigid),
    )


def _focal_px(node: SceneNode, width: int, height: int) -> float:
    if "focal_length" in node.values:  # in mm, relative to the diagonal of 35 mm film
        focal_mm = float(str(node.get("focal_length")).removesuffix("mm"))
        return focal_mm / math.hypot(36, 24) * math.hypot(width, height)
    axis = str(node.get("fov_axis", "x"))
    size = {
        "x": width,
        "y": height,
        "diagonal": math.hypot(width, height),
        "smaller": min(width, height),
        "larger": max(width, height),
    }.get(axis, width)
    return 0.5 * size / math.tan(0.5 * math.radians(float(node.get("fov", 90.0))))

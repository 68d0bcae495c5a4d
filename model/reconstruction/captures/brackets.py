# SPDX-License-Identifier: MIT
"""Merges exposure brackets: photographs with one camera and pose, but different exposures.

A pixel is the mean of the photographs in which it is not clipped, weighted by exposure: for photon noise,
this estimator has the least variance (Hanji, Zhong and Mantiuk, "Noise-aware merging of high dynamic range
image stacks without camera calibration", ECCV workshops 2020). A pixel clipped in all of them stays clipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import CaptureView, ColorImage
from datagen.foundation.cameras import Camera
from model.reconstruction.captures.photographs import PhotographSource

MAX_APART_M = 1e-3
"""Maximum distance between the estimated camera centres of one bracket."""
MAX_TURN_RAD = 1e-3
"""Maximum angle between orientations in a bracket: 0.6 pixels at a width of 640 pixels and 60 degrees."""
MAX_INTRINSICS_SHARE = 1e-3
"""Maximum difference between the intrinsics of one bracket, relative to the image width."""
MIN_EXPOSURE_RATIO = 1.1
"""Minimum ratio of a bracket's longest to its shortest exposure."""


@dataclass(frozen=True)
class BracketSource:
    """Photographs of one camera and pose with different exposures, in any order."""

    photographs: tuple[PhotographSource, ...]

    def read(self, camera: Camera) -> ColorImage:
        """Resample the photographs to ``camera`` and merge them; the shortest exposure defines the limit."""
        ordered = sorted(self.photographs, key=lambda p: (p.exposure_scale, str(p.path)))
        return merged([source.read(camera) for source in ordered], [p.exposure_scale for p in ordered])

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        """Return an empty dictionary, since photographs have no ground truth."""
        return {}


def merged(images: Sequence[ColorImage], scales: Sequence[float]) -> ColorImage:
    """Merge ``images`` of one size; ``scales`` are the factors that brought them to one exposure.

    Pixels clipped in all images get the value of the shortest exposure, which is the highest lower bound.
    """
    shape = images[0].color.shape
    total, weights = np.zeros(shape), np.zeros(shape)
    clipped = np.ones(shape, dtype=bool)
    for image, scale in zip(images, scales, strict=True):
        mask = np.zeros(shape, bool) if image.clipped_mask is None else image.clipped_mask
        weight = ~mask / scale
        total += weight * image.color
        weights += weight
        clipped &= mask
    shortest = images[int(np.argmax(scales))]
    color = np.where(clipped, shortest.color, total / np.where(clipped, 1.0, weights)).astype(np.float32)
    valid = np.logical_and.reduce([image.valid_mask for image in images])
    has_limit = shortest.clipped_mask is not None
    return ColorImage(color, valid, clipped if has_limit else None, shortest.limit)


def with_brackets(views: Sequence[CaptureView]) -> tuple[tuple[CaptureView, ...], tuple[str, ...]]:
    """Replace each bracket in ``views`` by one view, named after its first photograph; also return notes.

    Photographs with the same pose and equal exposures are not merged: their exposures may be unrecorded.
    """
    groups: list[list[CaptureView]] = []
    for view in views:
        group = next((g for g in groups if _are_one_camera(g[0], view)), None)
        if group is None:
            groups.append([view])
        else:
            group.append(view)
    found: list[CaptureView] = []
    unknown: list[str] = []
    num_merged = num_brackets = 0
    for group in groups:
        sources = [view.source for view in group if isinstance(view.source, PhotographSource)]
        scales = [source.exposure_scale for source in sources]
        if len(group) == 1:
            found += group
        elif max(scales) < MIN_EXPOSURE_RATIO * min(scales):
            found += group
            unknown.append(group[0].name)
        else:
            found.append(CaptureView(group[0].name, group[0].camera, BracketSource(tuple(sources))))
            num_merged, num_brackets = num_merged + len(group), num_brackets + 1
    notes = []
    if num_brackets:
        notes.append(f"{num_merged} photographs are merged as {num_brackets} exposure brackets")
    if unknown:
        where = ", ".join(unknown[:8])
        notes.append(
            f"several photographs share the pose of {where} and are not merged, since no different exposures "
            "are recorded; keep EXIF, or state exposure_scale in capture.json"
        )
    return tuple(found), tuple(notes)


def _are_one_camera(one: CaptureView, other: CaptureView) -> bool:
    if not (isinstance(one.source, PhotographSource) and isinstance(other.source, PhotographSource)):
        return False
    a, b = one.camera, other.camera
    if (a.width_px, a.height_px) != (b.width_px, b.height_px):
        return False
    if np.linalg.norm(a.position_m - b.position_m) > MAX_APART_M:
        return False
    # for a small angle between the orientations, |R_a - R_b| = sqrt(2) angle
    turn = np.linalg.norm(a.world_from_camera[:3, :3] - b.world_from_camera[:3, :3]) / np.sqrt(2)
    difference = np.subtract((a.fx_px, a.fy_px, a.cx_px, a.cy_px), (b.fx_px, b.fy_px, b.cx_px, b.cy_px))
    return bool(turn <= MAX_TURN_RAD and np.abs(difference).max() <= MAX_INTRINSICS_SHARE * a.width_px)

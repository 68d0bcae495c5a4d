# SPDX-License-Identifier: MIT
"""Divides surfels into segments that share specular albedo and roughness.

A segment is a part of a smooth region of the mesh with similar reflectance and predictions. These features
are binned, and a bin with few surfels is merged with the nearest bin of its region.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LUMINANCE_STEP, CHROMA_STEP = 0.5, 0.35
"""Bin widths of the mean ln reflectance over channels, and of ln red and ln blue minus ln green."""
SPECULAR_STEP, ROUGHNESS_STEP = 0.3, 0.35
"""Bin widths of the square root of the predicted specular albedo, and of the predicted roughness."""
MIN_SURFELS = 24
"""Number of surfels below which a bin is merged with another."""
_MIN_REFLECTANCE, _MAX_REFLECTANCE = 0.01, 2.0


def segment_surfels(
    region: NDArray, reflectance: NDArray, specular_albedo: NDArray, roughness: NDArray
) -> NDArray[np.int32]:
    """Compute the index (N,) of each surfel's segment, from 0 without gaps, from its smooth ``region`` (N,),
    ``reflectance`` pi radiance / irradiance (N, 3), and predicted ``specular_albedo`` (N, 3) and
    ``roughness`` (N,).
    """
    feature = _features(reflectance, specular_albedo, roughness)
    bins = np.round(feature).astype(np.int64)
    bins -= bins.min(axis=0, initial=0)
    key = region.astype(np.int64)
    for axis in range(bins.shape[1]):
        key = key * (int(bins[:, axis].max(initial=0)) + 1) + bins[:, axis]
    keys, segment = np.unique(key, return_inverse=True)
    num = np.bincount(segment, minlength=len(keys))
    centre = np.stack([np.bincount(segment, column, len(keys)) / num for column in feature.T], axis=1)
    region_of = np.zeros(len(keys), region.dtype)
    region_of[segment] = region
    target = np.arange(len(keys))
    order = np.argsort(region_of, kind="stable")
    starts = np.flatnonzero(np.diff(region_of[order])) + 1
    for rows in np.split(order, starts):
        large = rows[num[rows] >= MIN_SURFELS]
        if not len(large):
            large = rows[[num[rows].argmax()]]
        small = np.setdiff1d(rows, large)
        if len(small):
            distance = ((centre[small, None] - centre[None, large]) ** 2).sum(axis=2)
            target[small] = large[distance.argmin(axis=1)]
    return np.unique(target[segment], return_inverse=True)[1].astype(np.int32)


def _features(reflectance: NDArray, specular_albedo: NDArray, roughness: NDArray) -> NDArray[np.float64]:
    """Compute the features (N, 5) of surfels in units of bin width."""
    rho = np.log(np.clip(reflectance.astype(np.float64), _MIN_REFLECTANCE, _MAX_REFLECTANCE))
    green = rho[:, 1]
    return np.stack(
        [
            rho.mean(axis=1) / LUMINANCE_STEP,
            (rho[:, 0] - green) / CHROMA_STEP,
            (rho[:, 2] - green) / CHROMA_STEP,
            np.sqrt(np.clip(specular_albedo.mean(axis=1), 0, 1)) / SPECULAR_STEP,
            roughness / ROUGHNESS_STEP,
        ],
        axis=1,
    )

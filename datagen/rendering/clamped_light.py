# SPDX-License-Identifier: MIT
"""Restores light removed by the firefly clamp, and estimates the error due to the light not restored.

Fireflies are paths of light that sampling rarely finds, such as caustics of a lamp in a mirror. Without their
light, views would be up to 5 % darker. It is therefore spread over neighbouring pixels: the image is
multiplied by 1 plus the share of light removed around each pixel, in a narrow neighbourhood if it contains
enough fireflies, else in a wide one. If even that has too few, at most part of their energy is restored.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from datagen.rendering.error import EPSILON

NARROW_PX = 2.0
"""Standard deviation of the Gaussian over which dense fireflies, such as those of highlights, are spread."""
WIDE = 1.0 / 8.0
"""The same for scattered fireflies, as a fraction of the square root of the image's area."""
COARSE_SIGMA_PX = 8.0
"""Standard deviation of wide Gaussians, in pixels of the downscaled image on which they are computed."""
MIN_DENSE, MIN_SCATTERED = 10.0, 3.0
"""Minimum number of equally bright fireflies in the narrow and the wide Gaussian for restoring light."""


def restored_share(level: NDArray[np.floating], removed: NDArray[np.floating]) -> NDArray[np.float64]:
    """Light to restore (H, W), relative to the luminance ``level`` (H, W) of the clamped image.

    ``removed`` (H, W) is the luminance removed from the mean of all samples. With m its local mean around a
    pixel, v the variance of m and k the minimum number of fireflies, the share max(0, 1 - k v / m^2) of the
    pixel's removed light is spread over the narrow neighbourhood. For the rest, this is repeated in the wide.
    """
    share = np.zeros(removed.shape)
    if not removed.any():
        return share
    unit = float(removed.max())  # in this unit, squares of luminance neither overflow nor underflow
    level, left = np.asarray(level / unit, np.float64), np.asarray(removed / unit, np.float64)
    for sigma, minimum in ((NARROW_PX, MIN_DENSE), (WIDE * math.sqrt(removed.size), MIN_SCATTERED)):
        mean, variance = _smoothed(left, sigma), _variance(left, sigma)
        certain = np.maximum(1.0 - minimum * variance / np.maximum(mean**2, 1e-300), 0.0)
        kept = _smoothed(level, sigma)
        share += np.divide(_smoothed(certain * left, sigma), kept, out=np.zeros_like(kept), where=kept > 0.0)
        left = left * (1.0 - certain)
    return share


def _variance(removed: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """Variance (H, W) of the Gaussian-weighted mean of ``removed`` (H, W), for independent fireflies.

    It is the sum of their squares, weighted by the squared Gaussian, which is a Gaussian narrower by the root
    of 2, divided by 4 pi sigma^2.
    """
    return _smoothed(removed**2, sigma, narrower=math.sqrt(2.0)) / (4.0 * math.pi * sigma**2)


def _smoothed(image: NDArray[np.float64], sigma: float, narrower: float = 1.0) -> NDArray[np.float64]:
    """Smooth an image (H, W) by a Gaussian of ``sigma / narrower`` pixels, truncated at 4 ``sigma``."""
    import cv2
    from scipy import ndimage

    coarse = max(sigma / COARSE_SIGMA_PX, 1.0)  # downscaling factor
    height, width = image.shape
    size = (max(round(width / coarse), 1), max(round(height / coarse), 1))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    radius = math.ceil(4.0 * sigma / coarse)
    small = ndimage.gaussian_filter(small, sigma / narrower / coarse, radius=radius)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def missing_error(
    level: NDArray[np.floating], removed: tuple[NDArray[np.floating], NDArray[np.floating]], scale: float
) -> float:
    """relMSE due to removed light that is not restored.

    ``level`` (H, W) is the luminance of the clamped image, ``scale`` its exposure, ``removed`` the luminance
    (H, W) removed from each of two independent halves of the samples. The squared share of light missing
    around each pixel is estimated by the product of the halves' shares, whose noise cancels on average.
    """
    if not (removed[0].any() and removed[1].any()):
        return 0.0
    share = restored_share(level, 0.5 * (removed[0] + removed[1]))
    kept, *lost = (_smoothed(np.asarray(image, np.float64), NARROW_PX) for image in (level, *removed))
    light = np.maximum(kept + 0.5 * (lost[0] + lost[1]), 1e-300)  # prevents 0 / 0 in unlit areas
    missing = [(half - share * kept) / light for half in lost]
    weight = (scale * level) ** 2 / ((scale * level) ** 2 + EPSILON)
    return max(float((weight * missing[0] * missing[1]).mean()), 0.0)

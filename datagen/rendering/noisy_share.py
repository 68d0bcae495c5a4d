# SPDX-License-Identifier: MIT
"""Weight of the noisy image near very bright sources, whose light the denoiser spreads to darker pixels.

OIDN's error is a few per cent of the highest radiance in its network's receptive field. For radiance up to
white, that is less than the noise that it removes. Next to window panes at forty times white, it is more than
the radiance of a dark glazing bar, whose samples are noisy but unbiased.

Two independent halves a and b of the samples identify these pixels. With F the denoised image, the
expectation of (a - F)(b - F) is F's squared error, as long as F does not depend on the pixel's own noise; a
firefly occurs in only one half and makes the product negative. The noisy image N therefore gets the weight

    g max(0, 1 - v / ((a - F)(b - F)))

where v is the variance of a half. This shrinkage towards F (James and Stein 1961; for renderings Gu,
Iglesias-Guitian and Moon 2022) keeps F wherever noise may explain the difference. Two halves give a poor
estimate of a single pixel's variance, so v is the relative variance averaged over neighbouring pixels, times
the squared radiance of the darker of F and N. The gate g rises from 0 to 1 as the brightest source nearby,
in both halves and F, rises from ``FAINTEST_SOURCE`` to ``BRIGHT_SOURCE``. Without it, samples that are low by
chance would count as dark surfaces (decision 78).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import exposure_for, luminance

FAINTEST_SOURCE, BRIGHT_SOURCE = 4.0, 8.0
"""Luminances of the brightest source nearby, relative to the exposed image's white, at which g is 0 and 1."""
REACH_PX = 5
"""Side in pixels of the square around a pixel that is searched for a bright source."""
NEAR_PX, WIDE_PX = 3, 15
"""Sides in pixels of the squares over which relative variances are averaged. The larger of the two means is
used, since the pixel's own samples may miss noise that occurs nearby."""
MIN_LEVEL = 0.01
"""Radiance, relative to white, whose square keeps relative variances of black pixels finite."""


def noisy_share(
    halves: tuple[NDArray[np.floating], NDArray[np.floating]],
    denoised: NDArray[np.floating],
    visible_emission: NDArray[np.floating],
) -> NDArray[np.float32]:
    """Weight (H, W, 1) of the noisy image in the finished one, in [0, 1] and mostly 0.

    The independent ``halves`` and the ``denoised`` image (H, W, 3) are reflected light. ``visible_emission``
    (H, W, 3), which is added later, affects only the exposure.
    """
    from scipy import ndimage

    scale = exposure_for(denoised.astype(np.float64) + visible_emission)
    a, b, clean = (scale * image.astype(np.float64) for image in (*halves, denoised))
    agreed = np.minimum(np.minimum(luminance(a), luminance(b)), luminance(clean))
    source = ndimage.maximum_filter(agreed, REACH_PX)
    gate = np.clip((source - FAINTEST_SOURCE) / (BRIGHT_SOURCE - FAINTEST_SOURCE), 0.0, 1.0)
    if not gate.any():
        return np.zeros((*gate.shape, 1), np.float32)
    noisy = 0.5 * (a + b)
    power = [(image**2).mean(axis=-1) + MIN_LEVEL**2 for image in (clean, noisy)]
    relative = ((a - b) ** 2).mean(axis=-1) / (power[0] + power[1])  # relative variance of a half
    relative = np.maximum(*(ndimage.uniform_filter(relative, side) for side in (NEAR_PX, WIDE_PX)))
    variance = relative * np.minimum(*power)
    squared_error = ((a - clean) * (b - clean)).mean(axis=-1)
    share = np.clip(1.0 - variance / np.maximum(squared_error, 1e-30), 0.0, 1.0)
    return (gate * np.where(squared_error > 0.0, share, 0.0))[..., None].astype(np.float32)


def blended(
    denoised: NDArray[np.float32], noisy: NDArray[np.float32], share: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Blend ``denoised`` and ``noisy``, both (H, W, 3); ``share`` (H, W, 1) is the weight of ``noisy``."""
    return denoised + share * (noisy - denoised) if share.any() else denoised

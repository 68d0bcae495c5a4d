# SPDX-License-Identifier: MIT
"""How far an image is from convergence: the relative mean squared error that budgets and benchmarks use.

relMSE(x, r) = mean of (x - r)^2 / (r^2 + epsilon), epsilon = 0.01, over pixels and channels, in scene-linear
radiance. With two independent references r1, r2 of the same pixels the numerator is (x - r1)(x - r2): their
own noise then adds nothing to the expectation. ``exposed`` scales everything first so that the reference's
95th percentile of luminance is 0.9, which makes the figure independent of how bright the lights are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import exposure_for

EPSILON = 0.01
"""Keeps black pixels from counting without bound; a hundredth of white, squared, in exposed images."""


def relative_mse_map(
    image: NDArray, reference: NDArray, other_reference: NDArray | None = None, *, exposed: bool = False
) -> NDArray[np.float64]:
    """Per-pixel relMSE (H, W); single pixels can be negative where two references are given."""
    first = reference.astype(np.float64)
    second = first if other_reference is None else other_reference.astype(np.float64)
    mean = 0.5 * (first + second)
    scale = exposure_for(mean) if exposed else 1.0
    x = image.astype(np.float64)
    squared = (x - first) * (x - second) * scale**2
    return (squared / ((mean * scale) ** 2 + EPSILON)).mean(axis=-1)


def relative_mse(
    image: NDArray, reference: NDArray, other_reference: NDArray | None = None, *, exposed: bool = False
) -> float:
    """Mean of :func:`relative_mse_map`. Images are (H, W, 3), linear."""
    return float(relative_mse_map(image, reference, other_reference, exposed=exposed).mean())

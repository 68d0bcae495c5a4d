# SPDX-License-Identifier: MIT
"""Relative mean squared error of an image, for sample budgets and benchmarks.

relMSE(x, r) = mean of (x - r)^2 / (r^2 + epsilon), epsilon = 0.01, over pixels and channels, in scene-linear
radiance. With two independent references r1, r2 of the same pixels, the numerator is (x - r1)(x - r2); the
references' noise then adds to the expectation only through its correlation with the divisor, which
:func:`relative_mse_of_parts` avoids. ``exposed`` first scales all images to bring the reference's 95th
percentile of luminance to 0.9, which makes the error independent of the brightness of the lights.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import exposure_for

EPSILON = 0.01
"""Bounds the weight of black pixels; in exposed images, it is the square of a tenth of white."""


def relative_mse_map(
    image: NDArray, reference: NDArray, other_reference: NDArray | None = None, *, exposed: bool = False
) -> NDArray[np.float64]:
    """relMSE (H, W) of each pixel of linear images (H, W, 3); may be negative with two references."""
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
    """Mean of :func:`relative_mse_map` over linear images (H, W, 3)."""
    return float(relative_mse_map(image, reference, other_reference, exposed=exposed).mean())


def relative_mse_of_parts(
    image: NDArray, parts: Sequence[NDArray], *, exposed: bool = False
) -> tuple[float, float]:
    """Mean relMSE of ``image`` against four independent references ``parts``, and its standard error.

    For each of the six pairs (r1, r2), (x - r1)(x - r2) is divided by the squared mean of the other two.
    Dividing by the mean of r1 and r2 would overweight pixels that are dark by chance in both; relative noise
    s of each reference would add 3/2 s^4.
    """
    x, references = image.astype(np.float64), [part.astype(np.float64) for part in parts]
    scale = exposure_for(np.mean(references, axis=0)) if exposed else 1.0
    differences = [scale * (x - reference) for reference in references]
    pairs = []
    for i, j in itertools.combinations(range(4), 2):
        others = [references[k] for k in range(4) if k not in (i, j)]
        level = 0.5 * scale * (others[0] + others[1])
        pairs.append((differences[i] * differences[j] / (level**2 + EPSILON)).mean(axis=-1))
    errors = np.mean(pairs, axis=0)
    middle = np.mean(references, axis=0)
    variance = scale**2 * np.var(references, axis=0, ddof=1) / ((scale * middle) ** 2 + EPSILON)
    variance = variance.mean(axis=-1)
    # With error e, noise n_i of variance s^2 in each reference and its mean n, the variance of
    # e^2 - 2 e n + (mean of the six products n_i n_j) is e^2 s^2 + s^4 / 6. The square of the variance
    # estimated from four values is 5/3 s^4 on average.
    noise = np.maximum(errors, 0.0) * variance + variance**2 / 10.0
    return float(errors.mean()), math.sqrt(float(noise.sum())) / noise.size

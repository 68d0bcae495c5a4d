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


def relative_mse(
    image: NDArray, reference: NDArray, other_reference: NDArray | None = None, *, exposed: bool = False
) -> float:
    """relMSE of linear images (H, W, 3); may be negative with two references."""
    first = reference.astype(np.float64)
    second = first if other_reference is None else other_reference.astype(np.float64)
    mean = 0.5 * (first + second)
    scale = exposure_for(mean) if exposed else 1.0
    x = image.astype(np.float64)
    squared = (x - first) * (x - second) * scale**2
    return float((squared / ((mean * scale) ** 2 + EPSILON)).mean())


def relative_mse_of_parts(
    image: NDArray, parts: Sequence[NDArray], *, exposed: bool = False
) -> tuple[float, float]:
    """Mean relMSE of ``image`` against four independent references ``parts``, and its standard error.

    For each of the six pairs (r1, r2), (x - r1)(x - r2) is divided by the squared mean of the other two.
    Dividing by the mean of r1 and r2 would overweight pixels that are dark by chance in both; references with
    relative noise s would then add 3/2 s^4. The standard error assumes only that noise is independent
    between pixels; two references with a firefly in the same pixel make it large.
    """
    x, references = image.astype(np.float64), [part.astype(np.float64) for part in parts]
    scale = exposure_for(np.mean(references, axis=0)) if exposed else 1.0
    differences = [scale * (x - reference) for reference in references]
    pairs, totals = [], [np.zeros(x.shape[:2]) for _ in range(4)]  # totals of the pairs with each reference
    for i, j in itertools.combinations(range(4), 2):
        others = [references[k] for k in range(4) if k not in (i, j)]
        level = 0.5 * scale * (others[0] + others[1])
        pairs.append((differences[i] * differences[j] / (level**2 + EPSILON)).mean(axis=-1))
        totals[i] += pairs[-1]
        totals[j] += pairs[-1]
    errors = np.mean(pairs, axis=0)
    # Analysis of variance of a diallel: each pair is the sum of effects of its two references, of variance
    # s^2, and of an interaction, of variance t^2. The mean of all pairs has the variance s^2 + t^2 / 6.
    of_references = sum(np.square(total - 3.0 * errors) for total in totals) / 2.0
    of_interaction = sum(np.square(pair - errors) for pair in pairs) - of_references
    per_reference, per_pair = of_references / 3.0, of_interaction / 2.0  # expectations 2 s^2 + t^2 and t^2
    variance = float((per_reference / 2.0 - per_pair / 3.0).sum())
    return float(errors.mean()), math.sqrt(max(variance, 0.0)) / errors.size

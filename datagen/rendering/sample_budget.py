# SPDX-License-Identifier: MIT
"""How many samples a view needs: its error is estimated from two independent halves of its samples.

Letters: ``a`` and ``b`` are the images of the two halves, n samples a pixel each, independent and with the
right expectation r; ``A`` and ``B`` the same images denoised; all of them (H, W, 3), scene-linear, and here
multiplied by the image's exposure. Errors are relMSE as :mod:`datagen.rendering.error` defines it: per-pixel
squares are divided by r^2 + 0.01, for which (A + B) / 2 stands in (dark details that the denoiser drowns in
their surroundings therefore weigh too little).

The error of a denoised half is a spread V, which the halves show, and a bias of the denoiser, which both
share and their difference hides. What shows the bias is that each half is an unbiased witness of the other:

    U = [(A - b)^2 + (B - a)^2 - (a - b)^2] / 2      E U = E [(A - r)^2 + (B - r)^2] / 2
    V = (A - B)^2 / 2                                 E V = Var A
    bias^2 = U - V

    E [((A + B) / 2 - r)^2] = E [U - V / 2],  pixel by pixel, whatever the denoiser does.

U contains products of the halves' noise, (a - r)(b - r), which vanish in the mean over many pixels only:
with few pixels or wild noise, bias^2 is known badly, and V, which is calm, serves to guess it
(:func:`_squared_bias`). What a firefly clamp took away is common to everything and seen by none of this: the
square of its share is added, which is what it costs if the light is missing evenly everywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from datagen.color import exposure_for, luminance
from datagen.rendering.error import EPSILON

FIRST_SAMPLES = 4
"""Samples of the first pass, both halves together; later passes double the total."""
BIAS_PER_SPREAD = 1.0
"""Squared bias of a denoised half over its spread, as far as nothing better is known (decision 70)."""


@dataclass(frozen=True)
class PathSums:
    """What ``num_samples`` light paths a pixel brought: ``radiance`` (H, W, 3), summed, and the luminance
    (H, W) that a clamp took away from it; both float64. Nothing yet: zeros that fit any image."""

    radiance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((1, 1, 3)))
    removed_luminance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((1, 1)))
    num_samples: int = 0

    def __add__(self, other: PathSums) -> PathSums:
        return PathSums(
            self.radiance + other.radiance,
            self.removed_luminance + other.removed_luminance,
            self.num_samples + other.num_samples,
        )

    def mean(self) -> NDArray[np.float32]:
        """Radiance (H, W, 3)."""
        return (self.radiance / self.num_samples).astype(np.float32)

    def removed_share(self) -> float:
        """Share of the luminance that the clamp took away, in [0, 1]."""
        removed = float(self.removed_luminance.sum())
        return removed / max(removed + float(luminance(self.radiance).sum()), 1e-300)  # of nothing: 0


@dataclass(frozen=True)
class ErrorEstimate:
    """``rel_mse`` of the finished image and its ``standard_error``; of one half: ``spread``, the squared bias
    as it was measured (it may be negative) and the standard error of that measurement."""

    rel_mse: float
    standard_error: float
    spread: float
    measured_bias: float
    bias_error: float


def estimate_error(
    halves: tuple[NDArray[np.float32], NDArray[np.float32]],
    denoised: tuple[NDArray[np.float32], NDArray[np.float32]],
    seen_lights: NDArray[np.float32],
    removed_share: float = 0.0,
) -> ErrorEstimate:
    """Error of the image that is made of both halves. All arrays (H, W, 3).

    ``seen_lights`` is what is added to the image without noise; it weighs in the image's brightness only.
    ``denoised`` are the halves themselves where there is no denoiser. ``removed_share`` of the light was
    taken away by a clamp.
    """
    a, b = (half.astype(np.float64) for half in halves)
    clean_a, clean_b = (image.astype(np.float64) for image in denoised)
    middle = 0.5 * (clean_a + clean_b)
    finished = middle + seen_lights
    scale = exposure_for(finished)
    weight = scale**2 / ((scale * finished) ** 2 + EPSILON) / 3.0
    spread = float((weight * 0.5 * (clean_a - clean_b) ** 2).sum(axis=-1).mean())
    if denoised[0] is halves[0]:  # unbiased: the halves' spread is all there is
        return ErrorEstimate(0.5 * spread + removed_share**2, 0.0, spread, 0.0, 0.0)
    witnessed = 0.5 * ((clean_a - b) ** 2 + (clean_b - a) ** 2 - (a - b) ** 2)
    measured = float((weight * witnessed).sum(axis=-1).mean()) - spread
    noise = (weight * (a - middle) * (b - middle)).sum(axis=-1)
    bias_error = math.sqrt(float((noise**2).sum())) / noise.size
    bias, standard_error = _squared_bias(spread, measured, bias_error)
    return ErrorEstimate(0.5 * spread + bias + removed_share**2, standard_error, spread, measured, bias_error)


def _squared_bias(spread: float, measured: float, bias_error: float) -> tuple[float, float]:
    """Squared bias of a denoised half from its measurement and from the spread, and its standard error.

    Before anything is measured the bias is ``BIAS_PER_SPREAD`` times the spread, give or take as much, or
    more where the measurement is further above than its own error explains. The mean of the two figures with
    weights 1 / variance; never negative.
    """
    expected = BIAS_PER_SPREAD * spread
    variance = bias_error**2
    prior_variance = expected**2
    if measured > expected:
        prior_variance = max(prior_variance, (measured - expected) ** 2 - variance)
    total = prior_variance + variance
    if total == 0.0:
        return expected, 0.0
    mean = (expected * variance + measured * prior_variance) / total
    return max(0.0, mean), math.sqrt(prior_variance * variance / total)


@dataclass(frozen=True)
class SampleBudget:
    """When to stop: a target for the estimated relMSE and the most samples a pixel (at least 2).

    Totals are even, because both halves have the same number of samples.
    """

    max_rel_mse: float
    max_samples: int

    def first_total(self) -> int:
        """Samples of the first pass."""
        return min(FIRST_SAMPLES, self.ceiling)

    def is_met(self, estimate: ErrorEstimate) -> bool:
        """Whether the target is met with a margin of one standard error: few samples of wild noise show a
        small error easily, but do not show it well."""
        return estimate.rel_mse + estimate.standard_error <= self.max_rel_mse

    @property
    def ceiling(self) -> int:
        """Most samples, even."""
        return self.max_samples // 2 * 2

    def next_total(self, total: int, estimate: ErrorEstimate) -> int:
        """Samples a pixel, both halves together, to have after the next pass; ``total`` to stop.

        Totals double, so that there are few estimates and not more than twice the samples that were needed.
        """
        if self.is_met(estimate) or total >= self.ceiling:
            return total
        return min(2 * total, self.ceiling)

# SPDX-License-Identifier: MIT
"""Adaptive sampling: the error of a view is estimated from two independent halves of its samples.

The images a and b of the two halves are independent, and their expectation is the exact image r; A and B are
the same images denoised. All are (H, W, 3), scene-linear and multiplied by the view's exposure. Errors are
relMSE (:mod:`datagen.rendering.error`), in which per-pixel squares are divided by r^2 + 0.01; (A + B) / 2
replaces r. A and B contain noisy pixels where those are more accurate (:mod:`datagen.rendering.noisy_share`);
otherwise a dark glazing bar, which the denoiser blurs with the bright panes around it, would have a weight
hundreds of times too low.

The error of a denoised half consists of a spread V, the variance between the halves, and a bias of the
denoiser, common to both halves. The bias is estimated by comparing each denoised half with the other noisy
half, whose noise is independent and unbiased:

    U = [(A - b)^2 + (B - a)^2 - (a - b)^2] / 2      E U = E [(A - r)^2 + (B - r)^2] / 2
    V = (A - B)^2 / 2                                 E V = Var A
    bias^2 = U - V

    E [((A + B) / 2 - r)^2] = E [U - V / 2],  pixel by pixel, for any denoiser.

U contains products of the halves' noise, (a - r)(b - r), which vanish only in the mean over many pixels. With
few pixels or strong noise, the estimate of bias^2 has a high variance, and V, whose variance is low, serves
as a prior (:func:`_squared_bias`). None of these includes the energy removed by a firefly clamp, whose amount
is recorded per pixel and half (:mod:`datagen.rendering.clamped_light`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import exposure_for, luminance
from datagen.rendering.clamped_light import missing_error
from datagen.rendering.error import EPSILON

FIRST_SAMPLES = 4
"""Samples per pixel of the first pass, both halves together; later passes depend on the estimated error."""
BIAS_PER_SPREAD = 1.0
"""Prior of the squared bias of a denoised half, divided by its spread (decision 70)."""
QUICK_BIAS_PER_SPREAD = 1.5
"""The same for OIDN ``balanced``, whose bias is larger."""
TILE_PX = 4
"""Side of the tiles that get the same number of samples; small, because edges and highlights are narrow."""
AROUND_PX = 3
"""Side of the squares over which errors are averaged, to suppress outliers. A maximum filter of the same size
then adds samples to edges where the halves agree by chance."""
MAX_GROWTH = 4
"""Maximum factor by which a pass multiplies a tile's samples, since errors from few samples are imprecise."""
MIN_SHARE = 0.05
"""Fraction of the tiles' mean error added to the error of each, in case all its samples missed the light."""
MIN_PASS = 0.1
"""Minimum size of a pass relative to all earlier samples, since every pass requires an error estimate."""
MIN_ADDED = 1.0
"""Minimum mean number of samples added to a half; tracing these takes about as long as the error estimate."""
SAMPLE_STEP = 4
"""The number of samples added to a half of a tile is a multiple of this, to shorten the lists of pixels."""


@dataclass(frozen=True)
class PathSums:
    """Sums of ``radiance`` (H, W, 3) over light paths, and the number of paths ``counts`` (H, W).

    ``removed_luminance`` (H, W) was removed by a clamp. The default is zero and broadcasts to any image.
    """

    radiance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((1, 1, 3)))
    removed_luminance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((1, 1)))
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros((1, 1), np.int64))

    def __add__(self, other: PathSums) -> PathSums:
        return PathSums(
            self.radiance + other.radiance,
            self.removed_luminance + other.removed_luminance,
            self.counts + other.counts,
        )

    @property
    def mean_samples(self) -> float:
        """Mean number of paths per pixel."""
        return float(self.counts.mean())

    def mean(self) -> NDArray[np.float32]:
        """Mean radiance (H, W, 3)."""
        return (self.radiance / self.counts[..., None]).astype(np.float32)

    def removed_mean(self) -> NDArray[np.float64]:
        """Luminance (H, W) that the clamp removed from the mean radiance."""
        return self.removed_luminance / self.counts

    def removed_share(self) -> float:
        """Share, in [0, 1], of the image's luminance that the clamp removed; 0 without light."""
        removed = float(self.removed_mean().sum())
        kept = float((luminance(self.radiance) / self.counts).sum())
        return removed / max(removed + kept, 1e-300)


@dataclass(frozen=True)
class ErrorEstimate:
    """Estimated error of a view.

    ``rel_mse`` is the error of the finished image, with its ``standard_error``. The others describe one
    denoised half: ``spread`` is the mean of ``spread_map`` (H, W), and ``measured_bias`` its squared bias,
    which noise can make negative, with the standard error ``bias_error``.
    """

    rel_mse: float
    standard_error: float
    spread: float
    measured_bias: float
    bias_error: float
    spread_map: NDArray[np.float32]

    @property
    def bound(self) -> float:
        """``rel_mse`` plus one standard error, the value that is recorded and compared with the target.

        Sampling stops when an estimate is low, often by chance. Over finished views, the median estimate is
        three quarters of the true error, and the median bound is equal to the true error (decision 70).
        """
        return self.rel_mse + self.standard_error


def estimate_error(
    halves: tuple[NDArray[np.float32], NDArray[np.float32]],
    denoised: tuple[NDArray[np.float32], NDArray[np.float32]],
    visible_emission: NDArray[np.float32],
    removed: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    bias_per_spread: float = BIAS_PER_SPREAD,
) -> ErrorEstimate:
    """Estimate the error of the mean of both halves. Arrays are (H, W, 3), except ``removed`` (H, W).

    ``visible_emission``, free of noise, affects only the exposure and the divisors of relMSE. ``denoised``
    are the denoised halves or, without a denoiser, the halves themselves. ``removed`` is the luminance that a
    clamp removed from each half. ``bias_per_spread`` is the prior of the denoiser's bias.
    """
    a, b = (half.astype(np.float64) for half in halves)
    clean_a, clean_b = (image.astype(np.float64) for image in denoised)
    middle = 0.5 * (clean_a + clean_b)
    finished = middle + visible_emission
    scale = exposure_for(finished)
    weight = scale**2 / ((scale * finished) ** 2 + EPSILON) / 3.0
    spread_map = (weight * 0.5 * (clean_a - clean_b) ** 2).sum(axis=-1).astype(np.float32)
    spread = float(spread_map.mean(dtype=np.float64))
    clamped = 0.0 if removed is None else missing_error(luminance(finished), removed, scale)
    if denoised[0] is halves[0]:  # without a denoiser, there is no bias
        return ErrorEstimate(0.5 * spread + clamped, 0.0, spread, 0.0, 0.0, spread_map)
    squared_error = 0.5 * ((clean_a - b) ** 2 + (clean_b - a) ** 2 - (a - b) ** 2)
    measured = float((weight * squared_error).sum(axis=-1).mean()) - spread
    noise = (weight * (a - middle) * (b - middle)).sum(axis=-1)
    bias_error = math.sqrt(float((noise**2).sum())) / noise.size
    bias, standard_error = _squared_bias(bias_per_spread * spread, measured, bias_error)
    error = 0.5 * spread + bias + clamped
    return ErrorEstimate(error, standard_error, spread, measured, bias_error, spread_map)


def _squared_bias(expected: float, measured: float, bias_error: float) -> tuple[float, float]:
    """Estimate the squared bias of a denoised half, and the standard error of the estimate.

    The prior has the mean and standard deviation ``expected``, or a larger deviation if ``measured`` exceeds
    it by more than ``bias_error`` explains. Prior and measurement are averaged with weights 1 / variance, and
    negative means are clamped to 0.
    """
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
    """Stopping criterion: a target for the estimated relMSE, and a maximum number of samples per pixel.

    The maximum, at least 2, is a mean over the image. Both halves have equal numbers of samples in each
    pixel. The first pass is uniform; each later one adds samples to tiles whose denoised halves differ, as
    many as the target is expected to require, but at most twice the previous total.
    """

    max_rel_mse: float
    max_samples: int

    def is_met(self, estimate: ErrorEstimate) -> bool:
        """Return whether the estimate's ``bound`` is at most the target."""
        return estimate.bound <= self.max_rel_mse

    def first_counts(self, shape: tuple[int, int]) -> NDArray[np.int64]:
        """Samples (H, W) of one half in the first pass, for images of ``shape`` (H, W).

        If the maximum is too small for a second pass, the first pass uses all of it.
        """
        is_only = self.max_samples < FIRST_SAMPLES + 2 * SAMPLE_STEP
        return np.full(shape, (self.max_samples if is_only else FIRST_SAMPLES) // 2, np.int64)

    def next_counts(self, counts: NDArray[np.int64], estimate: ErrorEstimate) -> NDArray[np.int64]:
        """Samples (H, W) to add to each half, which has ``counts`` (H, W) so far; all 0 to stop."""
        nothing = np.zeros_like(counts)
        if self.is_met(estimate):
            return nothing
        mean = float(counts.mean())
        remaining = self.max_samples / 2 - mean
        if remaining < MIN_PASS * mean:
            return nothing
        tiles = _Tiles(counts.shape)
        errors = tiles.means(_around(estimate.spread_map))
        errors += MIN_SHARE * float(errors.mean())
        if not errors.any():
            errors += 1.0  # the halves agree everywhere; the rest is bias, whose position is unknown
        before = tiles.means(counts)
        for share in (s for s in (0.25, 0.5, 1.0, 2.0) if s * mean >= MIN_ADDED):
            after = _distribute(errors, before, tiles.areas, min(share * mean, remaining))
            gain = (errors * tiles.areas * before / after).sum() / (errors * tiles.areas).sum()
            if gain * estimate.bound <= self.max_rel_mse:
                break
        return tiles.spread_out((after - before).astype(np.int64))


def _around(spread_map: NDArray[np.float32]) -> NDArray[np.float32]:
    """Maximum (H, W) around each pixel of the local means of a map (H, W)."""
    from scipy import ndimage

    return ndimage.maximum_filter(ndimage.uniform_filter(spread_map, AROUND_PX), AROUND_PX)


class _Tiles:
    """R x C tiles of ``TILE_PX`` x ``TILE_PX`` pixels, cropped at the right and lower border of an image."""

    def __init__(self, shape: tuple[int, ...]):
        self.shape = shape
        self.starts = [np.arange(0, side, TILE_PX) for side in shape]
        self.areas = self._sums(np.ones(shape))

    def _sums(self, image: NDArray) -> NDArray[np.float64]:
        rows = np.add.reduceat(image.astype(np.float64), self.starts[0], axis=0)
        return np.add.reduceat(rows, self.starts[1], axis=1)

    def means(self, image: NDArray) -> NDArray[np.float64]:
        """Mean (R, C) of an image (H, W) over each tile."""
        return self._sums(np.broadcast_to(image, self.shape)) / self.areas

    def spread_out(self, values: NDArray) -> NDArray:
        """Expand ``values`` (R, C) of the tiles to an image (H, W) with constant values in each tile."""
        rows, columns = (np.arange(side) // TILE_PX for side in self.shape)
        return values[rows[:, None], columns[None, :]]


def _distribute(
    errors: NDArray[np.float64], counts: NDArray[np.float64], areas: NDArray[np.float64], added: float
) -> NDArray[np.float64]:
    """Increase the tiles' sample ``counts`` by at most ``added`` per pixel on average; all arrays (R, C).

    If errors are inversely proportional to counts, as variances are, their sum is minimal for counts
    proportional to the root of error x count. No count decreases, and each grows by at most the factor
    ``MAX_GROWTH``, in multiples of ``SAMPLE_STEP``.
    """
    wanted = np.sqrt(errors * counts)
    most = float(((counts + added) * areas).sum())

    def counts_at(level: float) -> NDArray[np.float64]:
        more = np.clip(level * wanted, counts, MAX_GROWTH * counts) - counts
        return counts + np.floor(more / SAMPLE_STEP) * SAMPLE_STEP

    low, high = 0.0, float((MAX_GROWTH * counts / wanted).max()) * 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        fits = float((counts_at(middle) * areas).sum()) <= most
        low, high = (middle, high) if fits else (low, middle)
    return counts_at(low)

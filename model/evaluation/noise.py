# SPDX-License-Identifier: MIT
"""Standard errors of figures.

A figure is a mean over views. Its noise due to the choice of views is estimated by bootstrap, the noise of
the renderer by rendering some views with a second seed; the two are added in quadrature. The bootstrap of the
difference of two methods on the same views is paired, so variation common to the methods cancels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

_RESAMPLES = 2000
_SEED = 0x6E6F6973
SURE = 2.0  # minimum significant difference in standard errors


def bootstrap_error(values: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Standard error of the (weighted) mean of ``values`` (V,), by bootstrap; NaN for fewer than two."""
    values = np.asarray(values, np.float64)
    if len(values) < 2:
        return float("nan")
    share = np.ones(len(values)) if weights is None else np.asarray(weights, np.float64)
    drawn = np.random.default_rng(_SEED).integers(0, len(values), (_RESAMPLES, len(values)))
    means = (values * share)[drawn].sum(axis=1) / np.maximum(share[drawn].sum(axis=1), 1e-30)
    # the variance of the bootstrap is too low by the square of this factor
    return float(means.std() * np.sqrt(len(values) / (len(values) - 1)))


@dataclass(frozen=True)
class Figure:
    """A mean over views, and its standard errors due to the choice of views (NaN if unknown) and to the
    renderer's seed (0 if unknown).
    """

    mean: float
    by_views: float
    by_seed: float

    @property
    def error(self) -> float:
        """Standard error due to both causes, NaN if unknown."""
        return float(np.hypot(self.by_views, self.by_seed))

    @property
    def text(self) -> str:
        """Text such as "21.5 ± 0.3"; without the error if it is unknown."""
        return f"{self.mean:.1f}" if np.isnan(self.error) else f"{self.mean:.1f} ± {self.error:.1f}"


def figure_of(values: Sequence[float], spread: float = 0.0) -> Figure:
    """Mean and noise of ``values``, one per view; ``spread`` is a value's standard deviation over seeds."""
    return Figure(float(np.mean(values)), bootstrap_error(values), spread / float(np.sqrt(len(values))))


def seed_spread(
    pairs: Sequence[tuple[Mapping[str, float | None], Mapping[str, float | None]]],
) -> dict[str, float]:
    """Standard deviation over seeds of each figure of a view; a pair is a view's figures for two seeds.

    Figures with a gain are omitted, since the gain is fitted to all views but only a few are rendered twice.
    """
    found = {}
    for key in (key for key in pairs[0][0] if "gain" not in key):
        differences = [
            first - second
            for rows in pairs
            if (first := rows[0][key]) is not None and (second := rows[1][key]) is not None
        ]
        if differences:
            found[key] = float(np.sqrt(np.mean(np.square(differences)) / 2))
    return found


@dataclass(frozen=True)
class Difference:
    """Figures ``other`` and ``this`` of two runs, and the standard error of their difference."""

    other: float
    this: float
    error: float

    @property
    def is_insignificant(self) -> bool:
        """True if the difference is at most two standard errors, or NaN."""
        return not abs(self.this - self.other) > SURE * self.error


def difference(
    other: Mapping[str, float],
    this: Mapping[str, float],
    spreads: tuple[float, float] = (0.0, 0.0),
    weights: Mapping[str, float] | None = None,
) -> Difference | None:
    """Difference of a figure's means over the views that two runs share; None for fewer than two views.

    ``other`` and ``this`` contain the figure by view, ``spreads`` its standard deviations over seeds in the
    two runs; ``weights`` are by view.
    """
    names = [name for name in other if name in this]
    if len(names) < 2:
        return None
    share = np.array([1.0 if weights is None else weights[name] for name in names])
    before, after = (np.array([row[name] for name in names]) for row in (other, this))
    error = bootstrap_error(after - before, share)
    noise = sum(spread**2 for spread in spreads) / len(names)
    means = [float(np.average(values, weights=share)) for values in (before, after)]
    return Difference(means[0], means[1], float(np.hypot(error, np.sqrt(noise))))

# SPDX-License-Identifier: MIT
"""Random numbers that depend only on a key, not on scheduling, process count, hash seeds or NumPy's version.

Every random choice in a configuration is drawn from a :class:`Draws` keyed by (recipe seed, configuration,
purpose, index). It uses only the raw Philox stream, which NumPy guarantees not to change; the distributions
of ``Generator`` may change between releases, so the few that are needed are implemented here.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

ItemT = TypeVar("ItemT")


def digest(*key: int | str) -> bytes:
    """Return the SHA-256 digest of a key's parts, delimited by their types and lengths."""
    text = "".join(f"{type(part).__name__}:{len(str(part))}:{part};" for part in key)
    return hashlib.sha256(text.encode()).digest()


def weighted_item(items: Sequence[ItemT], weights: Sequence[float], number: float) -> ItemT:
    """Return the item selected by a uniform ``number`` in [0, 1), with probabilities proportional to weights.

    Raises ``ValueError`` if no weight is positive.
    """
    cumulative = np.cumsum(np.asarray(weights, dtype=np.float64))
    if not cumulative[-1] > 0:
        raise ValueError("expected a positive weight")
    index = int(np.searchsorted(cumulative, number * cumulative[-1], side="right"))
    last = int(np.flatnonzero(np.asarray(weights) > 0)[-1])
    return items[min(index, last)]


class Draws:
    """A reproducible stream of random numbers for one key."""

    def __init__(self, *key: int | str):
        self._bits = np.random.Philox(key=int.from_bytes(digest(*key)[:16], "little"))

    def units(self, *shape: int) -> NDArray[np.float64]:
        """Return an array of ``shape`` of uniform numbers in [0, 1)."""
        count = math.prod(shape)
        raw = np.atleast_1d(self._bits.random_raw(count)) if count else np.zeros(0, np.uint64)
        return ((raw >> np.uint64(11)).astype(np.float64) * 2.0**-53).reshape(shape)

    def unit(self) -> float:
        """Return one uniform number in [0, 1)."""
        return float(self.units(1)[0])

    def uniform(self, low: float, high: float) -> float:
        """Return a uniform number in [low, high]."""
        return low + (high - low) * self.unit()

    def log_uniform(self, low: float, high: float) -> float:
        """Return a number in [low, high] whose logarithm is uniform; both bounds are positive."""
        return math.exp(self.uniform(math.log(low), math.log(high)))

    def normal(self) -> float:
        """Return a standard normal number (Box-Muller)."""
        u, v = self.units(2).tolist()
        return math.sqrt(-2.0 * math.log(1.0 - u)) * math.cos(2.0 * math.pi * v)

    def integer(self, low: int, high: int) -> int:
        """Return a uniform integer in [low, high], both included."""
        return min(low + int(self.unit() * (high - low + 1)), high)

    def chance(self, probability: float) -> bool:
        return self.unit() < probability

    def choice(self, items: Sequence[ItemT]) -> ItemT:
        """Return one of the items, with equal probabilities."""
        return items[self.integer(0, len(items) - 1)]

    def weighted(self, items: Sequence[ItemT], weights: Sequence[float]) -> ItemT:
        """Return an item with probability proportional to its weight; raises like :func:`weighted_item`."""
        return weighted_item(items, weights, self.unit())

    def shuffled(self, items: Sequence[ItemT]) -> list[ItemT]:
        return [items[i] for i in np.argsort(self.units(len(items)), kind="stable").tolist()]

    def sphere(self, count: int) -> NDArray[np.float64]:
        """Return unit vectors (count, 3), uniform on the sphere."""
        u = self.units(count, 2)
        z = 1.0 - 2.0 * u[:, 0]
        radius = np.sqrt(np.maximum(0.0, 1.0 - z * z))
        angle = 2.0 * np.pi * u[:, 1]
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)

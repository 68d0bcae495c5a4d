# SPDX-License-Identifier: MIT
"""Owen-scrambled Sobol' points: low-discrepancy random numbers for light paths.

The samples of a pixel are the first points of a (0, 2)-sequence. The first 2^k of them, for any k, are
stratified over the unit square, and later passes continue the sequence. Every pair of dimensions of a path
uses this sequence with its own shuffle and scramble (padding). Scrambles are hashes (Laine and Karras 2011;
Burley, Practical Hash-Based Owen Scrambling, 2020, with its constants); the second dimension is computed by
the Pascal matrix in five steps (Ahmed, An Implementation Algorithm of 2D Sobol Sequence Fast, Elegant, and
Compact, 2024). With Owen scrambling, every single point is uniformly distributed, so estimates are unbiased.
"""

from __future__ import annotations

from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

Array = Any

_PASCAL = ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF))
_UNIT = 2.0**-24


class OwenSobol:
    """Sampler with one sample index per lane, usable as loop state and as argument of recorded functions.

    ``index`` is the index of the lane's sample within its pixel, ``key`` a hash of the pixel. Lanes with
    equal keys yield points of one sequence; the sequences of different keys are independent.
    """

    # Dr.Jit uses the names only; the types, all mi.UInt32, are unknown until a variant is selected.
    DRJIT_STRUCT: ClassVar[dict[str, type]] = dict.fromkeys(("reversed_index", "key", "dimension"), object)

    def __init__(self, index: Array = 0, key: Array = 0):
        self.reversed_index: Any = dr.brev(mi.UInt32(index))
        self.key: Any = mi.UInt32(key)
        self.dimension: Any = dr.zeros(mi.UInt32, dr.width(self.reversed_index))

    def _next(self) -> tuple[Any, Any]:
        """Return the shuffled index for the next dimensions, and the hash that seeds their scrambles."""
        hashed = _hash(self.key ^ (self.dimension * 0x9E3779B9 + 0x632BE5AB))
        self.dimension = self.dimension + 1
        return dr.brev(_scramble(self.reversed_index, hashed)), hashed

    def next_1d(self) -> Array:
        """Return a sample in [0, 1)."""
        index, hashed = self._next()
        return _to_unit(_scramble(index, _hash(hashed + 1)))

    def next_2d(self) -> Array:
        """Return a sample in [0, 1)^2 as Point2f."""
        index, hashed = self._next()
        other = index
        for shift, mask in _PASCAL:
            other = other ^ ((other >> shift) & mask)
        first, second = _scramble(index, _hash(hashed + 1)), _scramble(other, _hash(hashed + 2))
        return mi.Point2f(_to_unit(first), _to_unit(second))


def _scramble(reversed_bits: Array, seed: Array) -> Array:
    """Owen's nested scramble of bit-reversed numbers: each bit is flipped by a hash of the bits above it."""
    x = reversed_bits + seed
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x = x ^ (x * factor)
    return x


def _hash(x: Array) -> Array:
    """32-bit hash of two rounds, in the form of Wellons's ``lowbias32``."""
    x = x ^ (x >> 16)
    x = x * 0x21F0AAAD
    x = x ^ (x >> 15)
    x = x * 0x735A2D97
    return x ^ (x >> 15)


def _to_unit(reversed_bits: Array) -> Array:
    """Convert a bit-reversed number to a float in [0, 1) with 24 bits."""
    return mi.Float(dr.brev(reversed_bits) >> 8) * _UNIT

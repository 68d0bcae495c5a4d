# SPDX-License-Identifier: MIT
"""Conversion of positions on a regular grid to cell indices in Dr.Jit kernels."""

from __future__ import annotations

from typing import Any


def cell_of(position: Any, count: int) -> Any:
    """Index (UInt32), clamped to [0, ``count``), of the cell that contains ``position`` (in units of cells).

    NaN yields a valid index too. ``dr.clip`` would keep NaN, whose conversion to an unsigned integer depends
    on the processor (2^32 - 1 with AVX-512, 2^31 with AVX2); a gather at this index crashes the process.
    """
    import drjit as dr
    import mitsuba as mi

    return dr.minimum(mi.UInt32(dr.maximum(position, 0.0)), count - 1)

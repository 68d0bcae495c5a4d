# SPDX-License-Identifier: MIT
"""Cells of tables that kernels gather from."""

from __future__ import annotations

from typing import Any


def cell_of(position: Any, count: int) -> Any:
    """Cell (UInt32) in [0, ``count``) of a Dr.Jit position in units of cells, clamped to first and last cell.

    NaN also gives a valid cell. dr.clip keeps NaN, whose conversion to an unsigned integer depends on the
    processor: 2^32 - 1 with AVX-512, and 2^31 with AVX2, which would crash the process when gathered from.
    """
    import drjit as dr
    import mitsuba as mi

    return dr.minimum(mi.UInt32(dr.maximum(position, 0.0)), count - 1)

# SPDX-License-Identifier: MIT
"""Conversion between NumPy and Dr.Jit arrays without recompiling kernels for every size and value."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_ALIGNMENT = 64  # bytes of the widest SIMD register


def aligned_empty(size: int, dtype: Any) -> NDArray:
    """Return an uninitialised array (``size``,) in memory aligned for packet loads by Dr.Jit.

    On the CPU, Dr.Jit uses NumPy's memory directly. If it is not aligned, Dr.Jit compiles another kernel with
    scalar gathers instead of packet loads, so the allocator would determine which kernel runs.
    """
    num_bytes = size * np.dtype(dtype).itemsize
    memory = np.empty(num_bytes + _ALIGNMENT, dtype=np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    return memory[start : start + num_bytes].view(dtype)


def aligned(array: NDArray, dtype: Any = None) -> NDArray:
    """Return a flat copy of ``array`` in aligned memory, as ``dtype`` if given."""
    flat = aligned_empty(array.size, dtype or array.dtype)
    flat[:] = array.ravel()
    return flat


def vectors_from_rows(rows: NDArray) -> Any:
    """Convert an array (N, 3) to a ``mi.Vector3f`` without compiling a kernel for each N.

    ``mi.Vector3f(array)`` would make N a literal of the kernels.
    """
    import drjit as dr
    import mitsuba as mi

    flat = aligned(np.asarray(rows), np.float32)
    return dr.gather(mi.Vector3f, mi.Float(flat), dr.arange(mi.UInt32, len(flat) // 3))


def point_argument(position_m: NDArray) -> Any:
    """Convert a point (3,) to a ``mi.Point3f`` that kernels take as an argument, not as a literal."""
    import drjit as dr
    import mitsuba as mi

    return mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in position_m))


def rows_from_vectors(vectors: Any) -> NDArray[np.float32]:
    """Convert a ``mi.Vector3f`` or ``mi.Color3f`` to an array (N, 3).

    Inverse of :func:`vectors_from_rows`; ``vectors.numpy()`` would compile a kernel for each N.
    """
    import drjit as dr

    dr.eval(vectors)
    return np.stack(np.broadcast_arrays(*(part.numpy() for part in vectors)), axis=1)

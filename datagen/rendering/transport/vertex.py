# SPDX-License-Identifier: MIT
"""What all that follows light through a scene has in common, inside kernels."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

Array = Any


def facing_normal(si: Any, direction: Array) -> Array:
    """Normal of the geometry on the side that a ray of ``direction`` meets."""
    return dr.mulsign(mi.Vector3f(si.n), -dr.dot(si.n, direction))


def power_heuristic(pdf: Array, other: Array) -> Array:
    """Veach's power heuristic; 0 where both densities vanish."""
    square, other_square = dr.square(pdf), dr.square(other)
    total = square + other_square
    return dr.select(total > 0.0, square / dr.maximum(total, 1e-38), 0.0)

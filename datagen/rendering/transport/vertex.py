# SPDX-License-Identifier: MIT
"""Steps of random walks inside kernels, for path integrator, irradiance cache and sky guide.

Surfaces that a ray passes through (partial opacity, lights hidden from the camera) are not vertices; they do
not add to the path depth, and the MIS weight of emission behind them is that of the last bounce.
"""

from __future__ import annotations

from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

Array = Any

MAX_CROSSINGS = 32
"""Maximum number of surfaces that a path or shadow ray may pass through; with more, it is blocked."""
MAX_CROSSINGS_BEFOREHAND = 8
"""Like :data:`MAX_CROSSINGS`, for paths from which irradiance cache and sky guide are estimated."""
INVERSE_PI = 1.0 / np.pi


class Walk:
    """State of one random walk per lane, usable as the state of Dr.Jit loops."""

    # Dr.Jit uses the names only; the types are unknown until a variant is selected.
    DRJIT_STRUCT: ClassVar[dict[str, type]] = dict.fromkeys(
        ("ray", "depth", "num_crossed", "previous", "previous_pdf", "previous_is_delta", "previous_record"),
        object,
    )

    def __init__(self, ray: Any = None):
        self.ray: Any = dr.zeros(mi.Ray3f) if ray is None else mi.Ray3f(ray)  # segment to trace next
        num = dr.width(self.ray)
        self.depth: Any = dr.zeros(mi.UInt32, num)  # bounces before that segment
        self.num_crossed: Any = dr.zeros(mi.UInt32, num)  # surfaces passed through so far
        self.previous: Any = dr.zeros(mi.Interaction3f, num)  # vertex of the last bounce
        self.previous_pdf: Any = dr.full(mi.Float, 1.0, num)  # density of the direction sampled there [1/sr]
        self.previous_is_delta: Any = dr.full(mi.Bool, True, num)  # True if there was no emitter sample there
        # irradiance cache record of that vertex; 0: none
        self.previous_record: Any = dr.zeros(mi.UInt32, num)

    def intersect(self, scene: Any, active: Array) -> Any:
        """Surface interaction at the end of the current segment, in ``active`` lanes."""
        return scene.ray_intersect(self.ray, mi.RayFlags.All, coherent=False, active=active)

    def advance(
        self,
        si: Any,
        bounces: Array,
        passes: Array,
        direction: Array,
        pdf: Array,
        record: Array = 0,
    ) -> None:
        """Start the next segment at ``si``, along ``direction`` of density ``pdf`` [1/sr] where ``bounces``,
        else straight on. ``passes`` marks rays that pass through the surface without a bounce; ``record`` is
        the irradiance cache record of ``si``, 0 for none.
        """
        self.ray = si.spawn_ray(dr.select(bounces, direction, self.ray.d))
        self.previous = dr.select(bounces, mi.Interaction3f(si), self.previous)
        self.previous_pdf = dr.select(bounces, pdf, self.previous_pdf)
        self.previous_is_delta = self.previous_is_delta & ~bounces
        self.previous_record = dr.select(bounces, record, self.previous_record)
        self.depth = dr.select(bounces, self.depth + 1, self.depth)
        self.num_crossed = dr.select(passes, self.num_crossed + 1, self.num_crossed)


def facing_normal(si: Any, direction: Array) -> Array:
    """Geometric normal at hit ``si``, oriented against the ray's ``direction``."""
    return dr.mulsign(mi.Vector3f(si.n), -dr.dot(si.n, direction))


def cosine_bounce(normal: Array, sample: Array) -> tuple[Any, Any]:
    """Sample a cosine-distributed direction about ``normal`` by ``sample`` in [0, 1)^2, and its density."""
    local = mi.warp.square_to_cosine_hemisphere(sample)
    return mi.Frame3f(normal).to_world(local), local.z * INVERSE_PI


def power_heuristic(pdf: Array, other: Array) -> Array:
    """MIS weight (Veach's power heuristic) of a sample with density ``pdf``; 0 if both densities are 0."""
    square, other_square = dr.square(pdf), dr.square(other)
    total = square + other_square
    return dr.select(total > 0.0, square / dr.maximum(total, 1e-38), 0.0)

# SPDX-License-Identifier: MIT
"""Observes the environment from inside a scene, along rays that leave the scene after a bounce.

Paths from the cameras bounce twice in cosine-distributed directions, regardless of the materials.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.transport.vertex import MAX_CROSSINGS_BEFOREHAND, Walk, cosine_bounce, facing_normal

BOUNCES = 2
RADIANCE_PERCENTILE = 99.5
"""Percentile to which the radiance of escaping rays is clamped; the sun's disc is sampled separately."""
_NO_RAY, _HIT, _LEFT = 0, 1, 2


@dataclass(frozen=True)
class SkyObservations:
    """P surface points ``points_m`` (P, 3) with one cosine-distributed ray each; E of the rays escape.

    Escaping rays have ``origins_m`` (E, 3), ``directions`` (E, 3) and the luminance ``radiance`` (E,).
    ``environment`` and ``others`` are the luminance of the mean irradiance at the points, estimated by
    emitter sampling, from the environment (sun included) and from all other lights.
    """

    points_m: NDArray[np.float64]
    origins_m: NDArray[np.float64]
    directions: NDArray[np.float64]
    radiance: NDArray[np.float64]
    environment: float
    others: float

    def clamped_radiance(self) -> NDArray[np.float64]:
        """Return ``radiance`` (E,) clamped to its 99.5th percentile, since few rays hit the sun."""
        return np.minimum(self.radiance, np.percentile(self.radiance, RADIANCE_PERCENTILE))

    def sky_share(self) -> float:
        """Share, in [0, 1], of the direct light at the points that is from the sky without its sun."""
        if not self.radiance.size:
            return 0.0
        sky = np.pi * float(self.clamped_radiance().sum()) / len(self.points_m)
        total = max(self.environment, sky) + self.others
        return sky / total if total > 0.0 else 0.0


def observe_sky(
    scene: Any, is_hidden: Callable[[Any, Any], Any], camera_rays: Iterable[tuple[Any, Any]]
) -> SkyObservations:
    """Observe the sky along paths from the cameras.

    ``camera_rays`` are the rays of each camera and the sampler of their paths. ``is_hidden(si, depth)``
    returns the mask of hits on lights hidden from the camera.
    """
    points, origins, directions, radiance = [], [], [], []
    sums = np.zeros(2)
    for ray, numbers in camera_rays:
        segments, irradiance = _walk(scene, is_hidden, ray, numbers)
        dr.eval(segments, irradiance)
        for origin, direction, luminance, end in segments:
            kind = np.array(end)
            start = np.array(origin).T.astype(np.float64)
            points.append(start[kind != _NO_RAY])
            left = kind == _LEFT
            origins.append(start[left])
            directions.append(np.array(direction).T[left].astype(np.float64))
            radiance.append(np.array(luminance)[left].astype(np.float64))
        sums += [np.array(part).astype(np.float64).sum() for part in irradiance]
    points_m = np.concatenate(points)
    environment, others = (float(total) / max(len(points_m), 1) for total in sums)
    origin, direction, luminance = (np.concatenate(parts) for parts in (origins, directions, radiance))
    return SkyObservations(points_m, origin, direction, luminance, environment, others)


@dr.syntax
def _walk(scene: Any, is_hidden: Any, ray: Any, numbers: Any) -> tuple[list[tuple[Any, ...]], list[Any]]:
    """Trace paths. Return origin, direction, environment luminance and kind of end of the segment after each
    bounce, and the luminance of irradiance from environment and other lights, summed over a path's vertices.
    """
    walk = Walk(ray)  # current segment and previous vertex
    environment: Any = mi.EmitterPtr(scene.environment())
    from_sky = mi.Float(0.0)  # luminance of the irradiance from the environment, summed over vertices
    from_others = mi.Float(0.0)  # the same from other lights
    # One entry per segment after a bounce:
    origins: list[Any] = [mi.Point3f(0.0) for _ in range(BOUNCES)]
    directions: list[Any] = [mi.Vector3f(0.0) for _ in range(BOUNCES)]
    luminances: list[Any] = [mi.Float(0.0) for _ in range(BOUNCES)]  # of the environment, if the ray leaves
    ends: list[Any] = [mi.UInt32(_NO_RAY) for _ in range(BOUNCES)]  # _NO_RAY, _HIT or _LEFT
    active = mi.Bool(True)  # lanes whose path continues
    while active:
        si = walk.intersect(scene, active)
        is_null = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Null)
        passes = si.is_valid() & (is_null | is_hidden(si, walk.depth))
        leaves = active & ~si.is_valid()
        luminance = mi.luminance(si.emitter(scene).eval(si, leaves))
        for bounce in range(BOUNCES):
            arrives = active & ~passes & (walk.depth == bounce + 1)
            luminances[bounce] = dr.select(arrives & leaves, luminance, luminances[bounce])
            end = dr.select(leaves, mi.UInt32(_LEFT), mi.UInt32(_HIT))
            ends[bounce] = dr.select(arrives, end, ends[bounce])
        bounces = active & si.is_valid() & ~passes & (walk.depth < BOUNCES)
        ds, light = scene.sample_emitter_direction(si, numbers.next_2d(), True, bounces)
        normal = facing_normal(si, walk.ray.d)
        irradiance = mi.luminance(light) * dr.maximum(dr.dot(normal, ds.d), 0.0)
        is_sky = ds.emitter == environment
        from_sky += dr.select(bounces & is_sky, irradiance, 0.0)
        from_others += dr.select(bounces & ~is_sky, irradiance, 0.0)
        direction, pdf = cosine_bounce(normal, numbers.next_2d())
        walk.advance(si, bounces, passes, direction, pdf)
        for bounce in range(BOUNCES):
            starts = bounces & (walk.depth == bounce + 1)
            origins[bounce] = dr.select(starts, walk.ray.o, origins[bounce])
            directions[bounce] = dr.select(starts, walk.ray.d, directions[bounce])
        active &= (bounces | passes) & (walk.num_crossed < MAX_CROSSINGS_BEFOREHAND)
    return list(zip(origins, directions, luminances, ends, strict=True)), [from_sky, from_others]

# SPDX-License-Identifier: MIT
"""Observation of the environment from inside a scene, along paths from the cameras."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.transport.vertex import facing_normal

Array = Any

RADIANCE_PERCENTILE = 99.5
"""Brighter rays that left count as this one: the sun's disc is the business of its own sampling."""
MAX_CROSSINGS = 8
"""Transparent surfaces that a ray crosses while learning."""


@dataclass(frozen=True)
class SkyObservations:
    """What rays from surface points found; P points, E rays that left the scene.

    ``points_m`` (P, 3) with one cosine-distributed ray each; ``origins_m``, ``directions`` (E, 3) and
    ``radiance`` (E,), luminance, of those that left. ``environment``, ``others``: mean irradiance at the
    points by emitter sampling, from the environment (with its sun) and from all other lights.
    """

    points_m: NDArray[np.float64]
    origins_m: NDArray[np.float64]
    directions: NDArray[np.float64]
    radiance: NDArray[np.float64]
    environment: float
    others: float

    def calm_radiance(self) -> NDArray[np.float64]:
        """``radiance`` without its highest values: that a ray met the sun's disc is chance."""
        return np.minimum(self.radiance, np.percentile(self.radiance, RADIANCE_PERCENTILE))

    def sky_share(self) -> float:
        """Share of the sky without its sun in the direct light at the points, in [0, 1]."""
        if not self.radiance.size:
            return 0.0
        sky = np.pi * float(self.calm_radiance().sum()) / len(self.points_m)
        total = max(self.environment, sky) + self.others
        return sky / total if total > 0.0 else 0.0


def observe_sky(scene: Any, hides: Any, walks: Iterable[tuple[Any, Any]]) -> SkyObservations:
    """Send paths from cameras, which take two cosine-distributed turns and ask no material.

    ``walks``: for each camera its rays and a sampler seeded for as many. ``hides(si, depth)`` says which hits
    of rays of ``depth`` turns do not count (lights that the camera does not see).
    """
    points, origins, directions, radiance = [], [], [], []
    sums = np.zeros(2)
    for ray, sampler in walks:
        steps, lights = _walk(scene, hides, ray, sampler)
        dr.eval(steps, lights)
        for origin, direction, luminance, state in steps:
            kind = np.array(state)
            start = np.array(origin).T.astype(np.float64)
            points.append(start[kind > 0])
            left = kind == 2
            origins.append(start[left])
            directions.append(np.array(direction).T[left].astype(np.float64))
            radiance.append(np.array(luminance)[left].astype(np.float64))
        sums += [np.array(part).astype(np.float64).sum() for part in lights]
    points_m = np.concatenate(points)
    environment, others = (float(total) / max(len(points_m), 1) for total in sums)
    return SkyObservations(
        points_m,
        np.concatenate(origins),
        np.concatenate(directions),
        np.concatenate(radiance),
        environment,
        others,
    )


@dr.syntax
def _walk(scene: Any, hides: Any, ray: Any, sampler: Any) -> tuple[list[tuple[Any, ...]], list[Any]]:
    """Of the rays after the first and the second turn: origin, direction, luminance met, and whether there
    was none (0), it hit something (1) or left (2); irradiance at both points from environment and others."""
    ray = mi.Ray3f(ray)
    environment: Any = mi.EmitterPtr(scene.environment())
    from_sky, from_others = mi.Float(0.0), mi.Float(0.0)
    origins: list[Any] = [mi.Point3f(0.0), mi.Point3f(0.0)]
    directions: list[Any] = [mi.Vector3f(0.0), mi.Vector3f(0.0)]
    met: list[Any] = [mi.Float(0.0), mi.Float(0.0)]
    states: list[Any] = [mi.UInt32(0), mi.UInt32(0)]
    depth, num_crossed, active = mi.UInt32(0), mi.UInt32(0), mi.Bool(True)
    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        passes = si.is_valid() & (mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Null) | hides(si, depth))
        leaves = active & ~si.is_valid()
        luminance = mi.luminance(si.emitter(scene).eval(si, leaves))
        for turn in (0, 1):
            arrives = active & ~passes & (depth == turn + 1)
            met[turn] = dr.select(arrives & leaves, luminance, met[turn])
            states[turn] = dr.select(arrives, dr.select(leaves, mi.UInt32(2), mi.UInt32(1)), states[turn])
        turns = active & si.is_valid() & ~passes & (depth < 2)
        ds, light = scene.sample_emitter_direction(si, sampler.next_2d(), True, turns)
        normal = facing_normal(si, ray.d)
        irradiance = mi.luminance(light) * dr.maximum(dr.dot(normal, ds.d), 0.0)
        is_sky = ds.emitter == environment
        from_sky += dr.select(turns & is_sky, irradiance, 0.0)
        from_others += dr.select(turns & ~is_sky, irradiance, 0.0)
        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        ray = si.spawn_ray(dr.select(turns, mi.Frame3f(normal).to_world(local), ray.d))
        for turn in (0, 1):
            starts = turns & (depth == turn)
            origins[turn] = dr.select(starts, ray.o, origins[turn])
            directions[turn] = dr.select(starts, ray.d, directions[turn])
        depth = dr.select(turns, depth + 1, depth)
        num_crossed = dr.select(passes, num_crossed + 1, num_crossed)
        active &= (turns | passes) & (num_crossed < MAX_CROSSINGS)
    return list(zip(origins, directions, met, states, strict=True)), [from_sky, from_others]

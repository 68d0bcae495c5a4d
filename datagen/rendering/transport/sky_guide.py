# SPDX-License-Identifier: MIT
"""Where a room's sky comes in: sampling of environment light through the openings that let it in.

An environment that lights a room through a window covers a few per cent of the directions at most places, and
emitter sampling, which chooses directions by their radiance, meets walls with nearly all of its shadow rays.
Portals that users place by hand are the classic remedy (Bitterli, Novak and Jarosz, Portal-Masked Environment
Map Sampling, 2015). Here they are found: light-free paths from the cameras remember where rays that left the
room crossed the box around it, weighted with the radiance that they met.

From a point x inside a convex box every direction leaves through exactly one point of its faces. Faces are
divided into cells, cell c is chosen with the learned probability P_c and a point q of it uniformly; then

    p(w) = P_c / A_c * |q - x|^2 / |cos|

is known for every direction, whatever the openings look like. So the guide is one more technique of multiple
importance sampling and biases nothing, however badly it was learned.
"""

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

CELLS = 32
"""Cells of a face along each side: 0.15 m in a room of 5 m."""
TABLE = 1 << 16
"""Entries of the table that a cell is drawn from; probabilities are multiples of its inverse."""
BOX_PERCENTILE = 2.0
"""Share of the visited points beyond each face of the box: what is seen of the street is not the room."""
BOX_MARGIN = 0.02
"""What the box is larger than that, of its side, so that walls lie inside."""
RADIANCE_PERCENTILE = 99.5
"""Brighter rays that left count as this one: the sun's disc is the business of its own sampling."""
NEIGHBOUR_SHARE = 0.05
"""Of a cell's weight, for each of its eight neighbours: openings are larger than what was seen of them."""
MIN_ESCAPES = 256
"""Rays that have to leave the room for a guide to be worth anything."""
MAX_SHARE = 0.5
"""Greatest share of the shadow rays that the guide may take from the lights' own sampling."""
MIN_SHARE = 0.1
"""Below this share of the light the sky is not worth a technique of its own."""
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


class SkyGuide:
    """A density of directions towards openings, for points inside its box.

    ``share`` of the shadow rays follow it there unless places know better
    (:mod:`datagen.rendering.transport.light_sampler`); :func:`learn_sky` says when there is none.
    """

    def __init__(
        self,
        scene: Any,
        box_m: NDArray[np.float64],
        probabilities: NDArray[np.float64],
        share: float,
        brightest: float,
    ):
        """``box_m`` (2, 3): lower and upper corner; ``probabilities`` (6 CELLS^2,), by face, column, row;
        ``brightest`` luminance of the sky without its sun."""
        from datagen.rendering.plugins import outside_distance  # knows classes of the variant

        self.environment = scene.environment()
        self.box_m, self.share = box_m, share
        side = box_m[1] - box_m[0]
        areas = np.array([side[(axis + 1) % 3] * side[(axis + 2) % 3] for axis in (0, 0, 1, 1, 2, 2)])
        cumulative = np.cumsum(probabilities) / probabilities.sum()
        table = np.searchsorted(cumulative, (np.arange(TABLE) + 0.5) / TABLE)
        drawn = np.bincount(table, minlength=probabilities.size) / TABLE  # what the table really does
        self.low, self.high = _corners(box_m)
        self.brightest = mi.Float(brightest)
        self.distance = mi.Float(outside_distance(scene))  # from which the environment's light comes
        self.table = mi.UInt32(table.astype(np.uint32))
        self.density = mi.Float((drawn / np.repeat(areas / CELLS**2, CELLS**2)).astype(np.float32))
        dr.make_opaque(self.low, self.high, self.brightest, self.distance)

    def arrays(self) -> list[Any]:
        """All that a recorded kernel reads."""
        return [self.low, self.high, self.brightest, self.distance, self.table, self.density]

    def contains(self, point: Array) -> Array:
        """Whether a point is inside the box."""
        return dr.all((point >= self.low) & (point <= self.high))

    def pdf(self, point: Array, direction: Array) -> Array:
        """Density [1/sr] of :meth:`sample` at ``direction``; ``point`` must be inside the box."""
        cell, t, along = _exit(self.low, self.high, point, direction)
        return dr.gather(mi.Float, self.density, cell) * dr.square(t) / dr.maximum(dr.abs(along), 1e-9)

    def sample(self, point: Array, choice: Array, sample: Array) -> Array:
        """A direction from ``point``, which must be inside the box, by numbers in [0, 1)."""
        entry = dr.minimum(mi.UInt32(choice * TABLE), TABLE - 1)
        cell = dr.gather(mi.UInt32, self.table, entry)
        face, rest = cell // (CELLS * CELLS), cell % (CELLS * CELLS)
        column = (mi.Float(rest // CELLS) + sample.x) / CELLS
        row = (mi.Float(rest % CELLS) + sample.y) / CELLS
        axis, end = face // 2, mi.Float(face % 2)
        share: Any = mi.Vector3f(
            dr.select(axis == 0, end, column),
            dr.select(axis == 1, end, dr.select(axis == 0, column, row)),
            dr.select(axis == 2, end, row),
        )
        side: Any = self.high - self.low
        return dr.normalize(self.low + share * side - point)


def _corners(box_m: NDArray[np.float64]) -> tuple[Any, Any]:
    low, high = (mi.Point3f(*(float(c) for c in corner)) for corner in box_m)
    return low, high


def _exit(low: Array, high: Array, point: Array, direction: Array) -> tuple[Any, Any, Any]:
    """Where rays from inside leave the box: cell, distance, and the direction's part across the face."""
    far = [
        dr.select(d == 0.0, dr.inf, (dr.select(d > 0.0, upper, lower) - p) / d)
        for p, d, lower, upper in zip(point, direction, low, high, strict=True)
    ]
    t = dr.minimum(far[0], dr.minimum(far[1], far[2]))
    is_x, is_y = far[0] == t, far[1] == t
    along = dr.select(is_x, direction.x, dr.select(is_y, direction.y, direction.z))
    axis = dr.select(is_x, mi.UInt32(0), dr.select(is_y, mi.UInt32(1), mi.UInt32(2)))
    share = (point + t * direction - low) / (high - low)
    column, row = dr.select(is_x, share.y, share.x), dr.select(is_x | is_y, share.z, share.y)
    cell = 2 * axis + dr.select(along > 0.0, mi.UInt32(1), mi.UInt32(0))
    for place in (column, row):
        cell = cell * CELLS + mi.UInt32(dr.clip(place * CELLS, 0.0, CELLS - 1.0))
    return cell, t, along


def learn_sky(scene: Any, observations: SkyObservations) -> SkyGuide | None:
    """A guide from what was observed; None where the sky brings too little for one to pay."""
    from scipy import ndimage

    share = observations.sky_share()
    if len(observations.origins_m) < MIN_ESCAPES or share < MIN_SHARE:
        return None
    low, high = np.percentile(observations.points_m, [BOX_PERCENTILE, 100.0 - BOX_PERCENTILE], axis=0)
    margin = BOX_MARGIN * (high - low).max()
    if not margin > 0.0:
        return None
    box_m = np.stack([low - margin, high + margin])
    weights = observations.calm_radiance()
    is_inside = ((observations.origins_m >= box_m[0]) & (observations.origins_m <= box_m[1])).all(axis=1)
    if not weights[is_inside].any():
        return None
    low_corner, high_corner = _corners(box_m)
    origins: Any = mi.Point3f(observations.origins_m[is_inside].T.astype(np.float32))
    directions: Any = mi.Vector3f(observations.directions[is_inside].T.astype(np.float32))
    cells = np.array(_exit(low_corner, high_corner, origins, directions)[0])
    found = np.bincount(cells, weights[is_inside], 6 * CELLS**2).reshape(6, CELLS, CELLS)
    around = np.full((1, 3, 3), NEIGHBOUR_SHARE)
    around[0, 1, 1] = 1.0
    probabilities = ndimage.convolve(found, around, mode="constant").ravel()
    return SkyGuide(scene, box_m, probabilities, min(MAX_SHARE, share), float(weights.max()))


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

# SPDX-License-Identifier: MIT
"""Finds free camera positions in an environment's camera regions or, if it has none, near its cameras."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from datagen.assembly.geometry import Floats, RayScene, direction_of
from datagen.assembly.things import above_supports, fibonacci_sphere, has_consistent_winding
from datagen.formats.asset import EnvironmentAsset
from datagen.foundation.errors import input_error
from datagen.foundation.random import Draws

NUM_PROBE_RAYS = 96  # cast in all directions from a camera position, 20 degrees between neighbours
_REACH_M = 6.0  # without camera regions, free space extends this far from the environment's cameras
_MAX_BACK_SHARE = 0.35  # a camera is inside a solid if more than this share of probe rays hits back faces
_MAX_OPEN_SHARE = 0.75  # a camera is outside the room if more than this share of probe rays hits nothing


@dataclass(frozen=True)
class FreeSpace:
    """Free space of a furnished environment for camera heights in [``height_m[0]``, ``height_m[1]``].

    Heights are above the bottom of a camera region or, without regions, above the surface below the camera.
    ``rays`` contains the triangles of the environment and of its objects.
    """

    environment: EnvironmentAsset
    rays: RayScene
    height_m: tuple[float, float]

    def check(self) -> None:
        """Raise :class:`InputError` if there are neither regions nor cameras, or all regions are too low."""
        where = f"environment {self.environment.id}"
        if not self.environment.camera_regions and not self.environment.cameras:
            expected, remedy = "a camera region or a camera", "add one to the room's asset.json"
            raise input_error(where, "camera_regions", "none, and no cameras", expected, remedy)
        if self.environment.camera_regions and not self._regions:
            spans = [f"{r.minimum_m[2]:g} to {r.maximum_m[2]:g} m" for r in self.environment.camera_regions]
            raise input_error(
                where,
                "camera_regions",
                ", ".join(spans),
                f"a region that is higher than cameras.height_m[0] = {self.height_m[0]:g}",
                "lower cameras.height_m or raise the region",
            )

    @cached_property
    def _regions(self) -> list[tuple[Floats, Floats, float]]:
        """Camera regions clipped to the camera heights: lower corner (3,), upper corner (3,), area in m²."""
        found = []
        for region in self.environment.camera_regions:
            low, high = np.array(region.minimum_m), np.array(region.maximum_m)
            top = min(high[2], low[2] + self.height_m[1])
            low[2] += self.height_m[0]
            if low[2] <= top:
                high[2] = top
                found.append((low, high, float((high[0] - low[0]) * (high[1] - low[1]))))
        return found

    def draw(self, draws: Draws) -> Floats | None:
        """Draw a position (3,), not yet tested by :meth:`fault`; None if there is no floor below it."""
        if self._regions:
            low, high, _ = draws.weighted(self._regions, [w for _, _, w in self._regions])
            return low + draws.units(3) * (high - low)
        camera = draws.choice(self.environment.cameras)
        start = np.array(camera.asset_from_camera)[:3, 3]
        angle, tilt = draws.uniform(-math.pi, math.pi), draws.uniform(-0.25, 0.25)
        direction = direction_of(angle, tilt)
        reach = min(float(self.rays.cast(start, direction[None]).distance_m[0]), _REACH_M)
        position = start + 0.9 * draws.unit() * reach * direction
        height = draws.uniform(*self.height_m)
        ends = self.rays.cast(position, np.array([[0, 0, -1.0], [0, 0, 1.0]])).distance_m
        if not np.isfinite(ends[0]):
            return None
        lift = min(height - ends[0], 0.9 * ends[1])
        return position + np.array([0.0, 0.0, lift])

    @cached_property
    def has_consistent_winding(self) -> bool:
        """True if the triangles visible from cameras and from above supports are consistently wound."""
        starts = [np.array(c.asset_from_camera)[:3, 3] for c in self.environment.cameras]
        return has_consistent_winding(self.rays, [*starts, *above_supports(self.environment)])

    def fault(self, position: Floats, clearance_m: float) -> str:
        """Return why a position (3,) is not free: ``inside_solid``, ``too_close`` or ``outside``, else ''."""
        return self._faults(position[None], clearance_m)[0]

    def _faults(self, positions: Floats, clearance_m: float) -> list[str]:
        """Return the :meth:`fault` of each of the positions (P, 3)."""
        shape = len(positions), NUM_PROBE_RAYS
        directions = np.tile(fibonacci_sphere(NUM_PROBE_RAYS), (len(positions), 1))
        hits = self.rays.cast(np.repeat(positions, NUM_PROBE_RAYS, axis=0), directions)
        backs = self.rays.is_back_hit(hits, directions).reshape(shape).sum(axis=1)
        misses = (~hits.hit_mask).reshape(shape).sum(axis=1)
        nearest_m = hits.distance_m.reshape(shape).min(axis=1)
        is_inside = self.has_consistent_winding & (backs > _MAX_BACK_SHARE * NUM_PROBE_RAYS)
        is_outside = misses > _MAX_OPEN_SHARE * NUM_PROBE_RAYS
        conditions = [is_inside, nearest_m < clearance_m, is_outside]
        return np.select(conditions, ["inside_solid", "too_close", "outside"], "").tolist()

    def points(self, count: int, clearance_m: float, draws: Draws, rejections: Counter[str]) -> Floats:
        """Draw up to ``count`` free positions (P, 3) in at most ``8 * count`` tries.

        ``rejections`` counts rejected positions by reason. Raises :class:`InputError` if no position is free.
        """
        found: list[Floats] = []
        tries = 8 * count
        while tries > 0 and len(found) < count:
            drawn = [self.draw(draws) for _ in range(min(tries, count - len(found)))]
            tries -= len(drawn)
            positions = [position for position in drawn if position is not None]
            faults = self._faults(np.array(positions).reshape(-1, 3), clearance_m)
            found += [position for position, fault in zip(positions, faults, strict=True) if not fault]
            rejections.update(f"probe.{fault}" for fault in faults if fault)
            rejections.update(["probe.no_floor"] * (len(drawn) - len(positions)))
        if not found:
            counts = ", ".join(
                f"{k.removeprefix('probe.')} {v}"
                for k, v in sorted(rejections.items())
                if k.startswith("probe.")
            )
            field = "camera_regions" if self._regions else "cameras"
            raise input_error(
                f"environment {self.environment.id}",
                field,
                f"no free position for a camera ({counts})",
                "free space inside the room",
                f"correct {field}, which are inside geometry or outside the room",
            )
        return np.array(found).reshape(-1, 3)

# SPDX-License-Identifier: MIT
"""A small diffuse path tracer, used to set light intensities and to reject dark views.

Surfaces are diffuse with albedo D (1 - S) + S, the reflectance of the project's BSDF at normal incidence.
Radiance is returned separately for each group of lights, so that intensities can be changed without tracing
again. A few thousand paths take 0.1 s, with a relative error of about 10 %. Results are deterministic.
Shapes: M triangles, R rays, P points, G groups.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.assembly.geometry import Floats, RayScene, WorldScene
from datagen.formats.asset import Opening
from datagen.formats.lights import (
    AreaLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
    SkyLight,
    SphereLight,
    SpotLight,
)
from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.foundation.random import Draws

LUMINANCE = LUMINANCE_WEIGHTS
NUM_BOUNCES = 5
_OFFSET_M = 1e-4  # rays start this far from a surface, as float32 positions in a room have errors of 1e-6 m
_MAX_LIGHTS_PER_STEP = 6  # of a larger group, one random light is sampled at each bounce
_MAX_TAIL_ALBEDO = 0.9  # bounds the geometric series of albedos near 1, which would amplify a noisy estimate

EnvironmentMap = Callable[[Floats], Floats]
"""Function that maps unit directions (R, 3) to the radiance (R, 3) that arrives from them."""


@dataclass(frozen=True)
class Emitters:
    """Emissive triangles: indices ``faces`` (K,) in the scene, and their ``radiance`` (K, 3)."""

    faces: NDArray[np.int64]
    radiance: Floats


@dataclass(frozen=True)
class LightGroup:
    """Lights with a common intensity factor; ``sky`` is the radiance from outside, without the ``suns``."""

    lights: tuple[Light, ...] = ()
    emitters: Emitters | None = None
    sky: EnvironmentMap | None = None
    suns: tuple[DirectionalLight, ...] = ()


class LightProbe:
    """Path tracer of one scene; ``albedo`` (M, 3) is the albedo of each triangle of ``scene.rays``."""

    def __init__(
        self, scene: WorldScene, albedo: Floats, groups: list[LightGroup], openings: tuple[Opening, ...]
    ):
        self.rays: RayScene = scene.rays
        self.albedo = albedo
        self.groups = groups
        self.openings = [Rectangle.of(o) for o in openings]

    def irradiance(self, points: Floats, draws: Draws, rays_per_point: int = 8) -> Floats:
        """Irradiance (P, G, 3) in W/m² at points (P, 3), averaged over orientations of the receiver.

        This average is a quarter of the fluence rate. Direct light is sampled at emitters, indirect light
        with ``rays_per_point`` uniformly distributed rays.
        """
        count = len(points)
        direct = np.zeros((count, len(self.groups), 3))
        for k, group in enumerate(self.groups):
            direct[:, k] = 0.25 * self._direct(points, None, group, draws)
        origins = np.repeat(points, rays_per_point, axis=0)
        indirect = self.radiance(origins, draws.sphere(len(origins)), draws)
        shape = (count, rays_per_point, len(self.groups), 3)
        return direct + math.pi * indirect.reshape(shape).mean(axis=1)

    def radiance(self, origins: Floats, directions: Floats, draws: Draws) -> Floats:
        """Radiance (R, G, 3) along rays (R, 3), without the emission of lights and emitters hit directly.

        Light through openings is sampled at the openings (next-event estimation). Rays that leave the scene
        elsewhere, even before the first bounce, add the radiance of the sky.
        """
        count = len(origins)
        total = np.zeros((count, len(self.groups), 3))
        weight = np.ones((count, 3))
        index = np.arange(count)
        for bounce in range(NUM_BOUNCES + 1):
            hits = self.rays.cast(origins, directions)
            keep, missed = hits.hit_mask, ~hits.hit_mask
            self._add_escaped(total, index[missed], weight[missed], origins[missed], directions[missed])
            if bounce == NUM_BOUNCES:
                break  # the last segment only adds light from outside
            index, weight, face = index[keep], weight[keep], hits.face[keep]
            if len(index) == 0:
                break
            travelled = directions[keep]
            points = origins[keep] + hits.distance_m[keep, None] * travelled
            normals = self.rays.normals[face]
            normals = np.where((normals * travelled).sum(axis=1, keepdims=True) > 0, -normals, normals)
            points = points + _OFFSET_M * normals
            albedo = self.albedo[face]
            weight = weight * albedo
            if bounce == NUM_BOUNCES - 1:  # a geometric series of the mean albedo replaces later bounces
                weight = weight / (1.0 - min(float(albedo.mean()), _MAX_TAIL_ALBEDO))
            for k, group in enumerate(self.groups):
                arriving = self._direct(points, normals, group, draws)
                total[index, k] += weight * arriving / math.pi
            origins, directions = points, _cosine_directions(normals, draws)
        return total

    def _add_escaped(
        self, total: Floats, index: NDArray, weight: Floats, origins: Floats, directions: Floats
    ) -> None:
        if len(index) == 0 or not any(group.sky for group in self.groups):
            return
        through = np.zeros(len(index), dtype=bool)
        for opening in self.openings:
            through |= opening.is_crossed(origins, directions)
        free = ~through
        for k, group in enumerate(self.groups):
            if group.sky is not None and free.any():
                total[index[free], k] += weight[free] * group.sky(directions[free])

    def _direct(self, points: Floats, normals: Floats | None, group: LightGroup, draws: Draws) -> Floats:
        """Direct irradiance (R, 3) of a group at points (R, 3); fluence rate if ``normals`` is None."""
        arriving = np.zeros((len(points), 3))
        lights: list[Light] = [*group.lights, *group.suns]
        share = 1.0
        if len(lights) > _MAX_LIGHTS_PER_STEP:
            share = float(len(lights))
            lights = [draws.choice(lights)]
        for light in lights:
            arriving += share * self._arriving(points, normals, _sample_light(light, points, draws))
        if group.emitters is not None:
            arriving += self._arriving(points, normals, self._sample_emitters(group.emitters, points, draws))
        if group.sky is not None and self.openings:
            arriving += self._arriving(points, normals, self._sample_openings(group.sky, points, draws))
        return arriving

    def _arriving(self, points: Floats, normals: Floats | None, sample: _Sample) -> Floats:
        cosine = np.ones(len(points))
        if normals is not None:
            cosine = np.maximum(0.0, (normals * sample.directions).sum(axis=1))
        value = sample.irradiance * cosine[:, None]
        useful = np.flatnonzero(value.any(axis=1))
        reach = np.maximum(sample.distance_m[useful] - 2 * _OFFSET_M, 0.0)
        blocked = self.rays.occluded(points[useful], sample.directions[useful], reach)
        value[useful[blocked]] = 0.0
        return value

    def _sample_emitters(self, emitters: Emitters, points: Floats, draws: Draws) -> _Sample:
        area = self.rays.areas[emitters.faces]
        power = np.cumsum(area * (emitters.radiance @ LUMINANCE))
        u = draws.units(len(points), 3)
        chosen = np.minimum(np.searchsorted(power, u[:, 0] * power[-1], side="right"), len(power) - 1)
        probability = np.diff(power, prepend=0.0)[chosen] / power[-1]
        root = np.sqrt(u[:, 1:2])
        corners = self.rays.corners[emitters.faces[chosen]]
        shares = 1 - root, root * (1 - u[:, 2:3]), root * u[:, 2:3]
        on_light = shares[0] * corners[:, 0] + shares[1] * corners[:, 1] + shares[2] * corners[:, 2]
        normals = self.rays.normals[emitters.faces[chosen]]
        radiance = emitters.radiance[chosen] * (area[chosen] / np.maximum(probability, 1e-300))[:, None]
        return _from_surface(points, on_light + _OFFSET_M * normals, normals, radiance)

    def _sample_openings(self, sky: EnvironmentMap, points: Floats, draws: Draws) -> _Sample:
        areas = np.cumsum([o.area for o in self.openings])
        u = draws.units(len(points), 3)
        chosen = np.minimum(np.searchsorted(areas, u[:, 0] * areas[-1], side="right"), len(self.openings) - 1)
        frames = np.array([(o.origin, o.u, o.v, o.normal) for o in self.openings])[chosen]
        origin, edge_u, edge_v, normal = frames.transpose(1, 0, 2)
        on_opening = origin + u[:, 1:2] * edge_u + u[:, 2:3] * edge_v
        sample = _from_surface(points, on_opening, normal, np.full((len(points), 3), areas[-1]))
        radiance = sky(sample.directions)
        return _Sample(sample.directions, np.full(len(points), np.inf), sample.irradiance * radiance)


@dataclass(frozen=True)
class _Sample:
    """One emitter sample for each of R points: unit ``directions`` (R, 3) and ``distance_m`` (R,) towards it,
    and its unoccluded ``irradiance`` (R, 3) at normal incidence divided by the probability density.
    """

    directions: Floats
    distance_m: Floats
    irradiance: Floats


@dataclass(frozen=True)
class Rectangle:
    """An opening or flat light: corner ``origin`` and edges ``u`` and ``v`` in metres, unit ``normal`` that
    points into the room, ``area`` in m².
    """

    origin: Floats
    u: Floats
    v: Floats
    normal: Floats
    area: float

    @classmethod
    def of(cls, opening: Opening | AreaLight) -> Rectangle:
        """Return the rectangle spanned by the edges of an opening or area light."""
        u, v = np.array(opening.edge_u_m), np.array(opening.edge_v_m)
        cross = np.cross(u, v)
        area = float(np.linalg.norm(cross))
        return cls(np.array(opening.origin_m), u, v, cross / area, area)

    @property
    def middle(self) -> Floats:
        """Centre (3,) of the rectangle."""
        return self.origin + 0.5 * (self.u + self.v)

    def is_crossed(
        self, origins: Floats, directions: Floats, limit_m: Floats | float = np.inf
    ) -> NDArray[np.bool_]:
        """Mask (R,) of rays (R, 3) that cross the rectangle from its front within ``limit_m``."""
        cosine = directions @ self.normal
        height = (self.origin - origins) @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = height / cosine
            local = origins + distance[:, None] * directions - self.origin
            s, t = local @ self.u / (self.u @ self.u), local @ self.v / (self.v @ self.v)
            inside = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
            return inside & (cosine < 0) & (distance > 0) & (distance < limit_m)


def _from_surface(points: Floats, on_light: Floats, normals: Floats, radiance_area: Floats) -> _Sample:
    """Convert positions ``on_light`` (R, 3) on one-sided lights to light samples for ``points`` (R, 3).

    ``radiance_area`` (R, 3) or (1, 3) is the radiance divided by the probability density per area.
    """
    towards = on_light - points
    # bounds the irradiance from lights nearer than 1 mm
    squared = np.maximum((towards * towards).sum(axis=1), 1e-6)
    distance = np.sqrt(squared)
    directions = towards / distance[:, None]
    cosine = np.maximum(0.0, -(directions * normals).sum(axis=1))
    return _Sample(directions, distance, radiance_area * (cosine / squared)[:, None])


def _sample_light(light: Light, points: Floats, draws: Draws) -> _Sample:
    count = len(points)
    if isinstance(light, PointLight | SpotLight):
        towards = np.array(light.position_m) - points
        squared = np.maximum((towards * towards).sum(axis=1), 1e-6)
        directions = towards / np.sqrt(squared)[:, None]
        value = np.array(light.intensity)[None] / squared[:, None]
        if isinstance(light, SpotLight):
            axis = np.array(light.direction) / np.linalg.norm(light.direction)
            angle = np.arccos(np.clip(-directions @ axis, -1, 1))
            width = max(light.cutoff_rad - light.beam_width_rad, 1e-6)
            value = value * np.clip((light.cutoff_rad - angle) / width, 0.0, 1.0)[:, None]
        return _Sample(directions, np.sqrt(squared), value)
    if isinstance(light, DirectionalLight):
        towards_sun = -np.array(light.direction) / np.linalg.norm(light.direction)
        directions = np.repeat(towards_sun[None], count, axis=0)
        return _Sample(directions, np.full(count, np.inf), np.repeat([light.irradiance], count, axis=0))
    u = draws.units(count, 2)
    if isinstance(light, AreaLight):
        side = Rectangle.of(light)
        if light.shape == "disk":
            radius, angle = 0.5 * np.sqrt(u[:, 0]), 2 * math.pi * u[:, 1]
            u = 0.5 + np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        on_light = side.origin + u[:, :1] * side.u + u[:, 1:] * side.v
        normals = np.repeat(side.normal[None], count, axis=0)
        total_area = side.area * (math.pi / 4 if light.shape == "disk" else 1.0)
        return _from_surface(points, on_light, normals, np.array(light.radiance)[None] * total_area)
    assert isinstance(light, SphereLight)
    normals = draws.sphere(count)
    on_light = np.array(light.position_m) + light.radius_m * normals
    sphere_area = 4 * math.pi * light.radius_m**2
    return _from_surface(points, on_light, normals, np.array(light.radiance)[None] * sphere_area)


def _cosine_directions(normals: Floats, draws: Draws) -> Floats:
    """Cosine-weighted unit directions (R, 3): each normal plus a uniform point on the unit sphere."""
    summed = normals + draws.sphere(len(normals))
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.where(length > 1e-9, summed / np.maximum(length, 1e-9), normals)


def is_from_outside(light: Light) -> bool:
    """Return whether a light is a sky or environment map, which surrounds the scene."""
    return isinstance(light, EnvironmentLight | SkyLight)

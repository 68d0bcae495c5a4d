# SPDX-License-Identifier: MIT
"""Gathering of the irradiance cache from camera paths of all views."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.transport.irradiance_cache import INVERSE_PI, IrradianceCache, SurfaceCells
from datagen.rendering.transport.light_sampler import MAX_LEARNED, LightChoice
from datagen.rendering.transport.recording import undisturbed
from datagen.rendering.transport.sobol import OwenSobol
from datagen.rendering.transport.vertex import facing_normal, power_heuristic

if TYPE_CHECKING:
    from datagen.rendering.transport.integrator import PathTracer
    from mitsuba_plugins.surface_material import SceneMaterials

Array = Any

MAX_RAYS = 40960
"""Camera rays that paths start with, of all views together; each finds irradiance at up to four places."""
MIN_RAYS = 4096
PIXELS_PER_RAY = 16
"""Pixels of all views for which there is one of those rays: what is shared must cost less than the views."""
MAX_CELLS = 1 << 21
"""Cells of the grid with ``MAX_RAYS``, nearly all of them empty air: 0.07 m in a room of 5 m."""
BOX_PERCENTILE = 1.0
"""Share of the visited points beyond each face of the grid's box: what light meets of the street is not the
room."""
BOX_MARGIN = 0.05
"""What the box is larger than that, of its longest side."""
MIN_HITS = 64
"""Rays that have to meet a surface for a cache to be worth anything."""
TURNS = 3
"""Reflections of the paths that look for irradiance in the end."""
LONG_TURNS = 12
"""And in the rounds before, so that light gets around: 0.9^12 of white walls' light is left for the next."""
WARM_UP, ROUNDS = 6, 12
"""Rounds of whole paths, whose results count ``KEEP`` as much with each that follows, and rounds that count
fully."""
WARM_UP_SHARE, KEEP = 4, 0.25
"""What the rays are divided by in the former; what remains of the rounds before."""
MAX_CROSSINGS = 8
"""Transparent surfaces that a ray crosses while learning."""


def learn_irradiance(
    tracer: PathTracer, materials: SceneMaterials, sensors: Iterable[Any], num_pixels: int, seed: int
) -> IrradianceCache | None:
    """Gather the irradiance that paths of ``tracer`` may end in; None where cameras see nothing.

    ``sensors`` are asked one after the other, so that one object may stand for all. ``num_pixels`` of all
    views together say how much may be spent.
    """
    num_rays = min(MAX_RAYS, max(MIN_RAYS, num_pixels // PIXELS_PER_RAY))
    views = [(sensor.view, tuple(int(v) for v in sensor.film().crop_size())) for sensor in sensors]
    rays = _camera_rays(views, num_rays, seed)
    points = _visited(tracer.scene, rays, seed)
    if len(points) < MIN_HITS:
        return None
    low, high = np.percentile(points, [BOX_PERCENTILE, 100.0 - BOX_PERCENTILE], axis=0)
    margin = BOX_MARGIN * float((high - low).max())
    if not margin > 0.0:
        return None
    # As many samples for each cell that has a surface in it: their number goes with the side's inverse square
    most_cells = int(MAX_CELLS * (num_rays / MAX_RAYS) ** 1.5)
    lights = tracer.lights
    if lights is not None and lights.num_techniques > MAX_LEARNED:
        lights = None
    num_techniques = 0 if lights is None else lights.num_techniques
    cache = IrradianceCache(SurfaceCells(np.stack([low - margin, high + margin]), most_cells), num_techniques)

    def walk(scene: Any, ray: Any, sampler: Any, is_warm: Any) -> list[tuple[Any, ...]]:
        return _walk(tracer, scene, materials, cache, lights, ray, sampler, is_warm)

    def state(*_: Any) -> list[Any]:
        return [*tracer.tables(), *materials.tables(), *cache.arrays()]

    recorded: Any = dr.freeze(walk, state_fn=state)
    for number in range(WARM_UP + ROUNDS):
        is_warm = number >= WARM_UP
        lane: Any = dr.arange(mi.UInt32, num_rays if is_warm else num_rays // WARM_UP_SHARE)
        chosen: Any = lane if is_warm else lane * WARM_UP_SHARE
        launch: Any = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
        index = dr.opaque(mi.UInt32, number) + dr.zeros(mi.UInt32, dr.width(lane))
        sampler = OwenSobol(index, mi.sample_tea_32(chosen, launch)[0])
        ray = dr.gather(mi.Ray3f, rays, chosen)
        with undisturbed():
            steps = recorded(tracer.scene, ray, sampler, dr.opaque(mi.Bool, is_warm))
        dr.eval(steps)
        cache.add(*_observed(steps, num_techniques), keep=1.0 if number > WARM_UP else KEEP)
    recorded.clear()
    cache.finish()
    return cache


def _observed(
    steps: list[tuple[Any, ...]], num_techniques: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Cells (N,) and samples (N, 3 + T) as :meth:`IrradianceCache.add` takes them, from what :func:`_walk`
    returns."""
    cells, samples = [], []
    for cell, is_found, irradiance, technique, brought in steps:
        chosen = np.array(is_found)
        cells.append(np.array(cell)[chosen].astype(np.int64))
        values = np.zeros((len(cells[-1]), 3 + num_techniques))
        values[:, :3] = np.array(irradiance).T[chosen]
        if num_techniques:
            rows = np.arange(len(values))
            values[rows, 3 + np.array(technique)[chosen]] = np.array(brought)[chosen].astype(np.float64) ** 2
        samples.append(values)
    return np.concatenate(cells), np.concatenate(samples)


def _camera_rays(views: list[tuple[Any, tuple[int, ...]]], num_rays: int, seed: int) -> Any:
    """Rays through all views (``PinholePixels.view`` and size in pixels), spread evenly over each."""
    from datagen.rendering.plugins import rays_through  # knows classes of the variant

    parts = []
    for number, (view, (width, height)) in enumerate(views):
        share = num_rays * (number + 1) // len(views) - num_rays * number // len(views)
        lane: Any = dr.arange(mi.UInt32, share)
        camera: Any = dr.full(mi.UInt32, number, share)
        launch: Any = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
        key: Any = mi.sample_tea_32(camera, launch)[0]
        position = OwenSobol(lane, key).next_2d() * mi.Vector2f(width, height)
        ray = rays_through(view, position)
        parts.append([np.array(ray.o), np.array(ray.d), np.broadcast_to(np.array(ray.maxt), share)])
    origins, directions, reaches = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
    rays: Any = mi.Ray3f(mi.Point3f(origins), mi.Vector3f(directions))
    rays.maxt = mi.Float(reaches)
    return rays


def _visited(scene: Any, ray: Any, seed: int) -> NDArray[np.float64]:
    """Points (N, 3) that rays meet, and their reflections in all directions."""
    launch: Any = dr.opaque(mi.UInt32, (seed + 1) & 0xFFFFFFFF)
    lane: Any = dr.arange(mi.UInt32, dr.width(ray))
    sampler = OwenSobol(dr.zeros(mi.UInt32, dr.width(ray)), mi.sample_tea_32(lane, launch)[0])
    points, active = [], mi.Bool(True)
    for _ in range(TURNS):
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        active &= si.is_valid()
        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        ray = si.spawn_ray(mi.Frame3f(facing_normal(si, ray.d)).to_world(local))
        points.append(np.array(si.p).T[np.array(active)])
    return np.concatenate(points).astype(np.float64)


@dr.syntax
def _walk(
    tracer: Any,
    scene: Any,
    materials: Any,
    cache: Any,
    lights: Any,
    ray: Any,
    sampler: Any,
    is_warm: Any,
) -> list[tuple[Any, ...]]:
    """Of the surfaces that a path meets: cell, whether there is one, one sample of its irradiance, and what
    :func:`_put_down` says of its shadow ray.

    What a surface sends on is what its cell is known to receive if ``is_warm``, else what comes along the
    rest of the path; behind the last turn, always the former.
    """
    ray = mi.Ray3f(ray)
    cells: list[Any] = [mi.UInt32(0) for _ in range(TURNS + 1)]
    is_found: list[Any] = [mi.Bool(False) for _ in range(TURNS + 1)]
    irradiance: list[Any] = [mi.Color3f(0.0) for _ in range(TURNS + 1)]
    techniques: list[Any] = [mi.UInt32(0) for _ in range(TURNS + 1)]
    brought: list[Any] = [mi.Float(0.0) for _ in range(TURNS + 1)]
    # What light that comes along the ray adds to the irradiance of each surface before
    share: list[Any] = [mi.Color3f(0.0) for _ in range(TURNS + 1)]
    last = dr.select(is_warm, mi.UInt32(TURNS), mi.UInt32(LONG_TURNS))
    depth, num_crossed, active = mi.UInt32(0), mi.UInt32(0), mi.Bool(True)
    previous = dr.zeros(mi.Interaction3f)
    previous_pdf = mi.Float(1.0)
    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        hits = active & si.is_valid()
        is_light = hits & si.shape.is_emitter()
        channels = materials.channels_at(si, hits)
        passes = (hits & ~is_light & (sampler.next_1d() >= channels.opacity)) | tracer.is_hidden(si, depth)
        arrives = active & ~passes

        # ---- what the ray from the surface before has met -------------------------------------------------
        ds = mi.DirectionSample3f(scene, si, previous)
        emitter_pdf = scene.pdf_emitter_direction(previous, ds, arrives & (depth > 0))
        emitter = si.emitter(scene)
        emitter_pdf = tracer.mixed_pdf(previous.p, ray.d, emitter_pdf, emitter, mi.UInt32(0))
        emitted = emitter.eval(si, arrives) * power_heuristic(previous_pdf, emitter_pdf)
        normal = facing_normal(si, ray.d)
        known, is_known = cache.irradiance(cache.record(si.p, normal, arrives & hits), arrives & hits)
        diffuse, specular = channels.diffuse_albedo, channels.specular_albedo
        reflectance = dr.minimum((1.0 - specular) * diffuse + specular_reflectance(channels), 1.0)
        is_known &= is_warm | (depth > last)
        came = np.pi * emitted + dr.select(is_known, reflectance * known, 0.0)

        # ---- this surface ----------------------------------------------------------------------------------
        turns = arrives & hits & (depth <= last)
        ds, radiance = tracer.sample_emitter(si, sampler, mi.UInt32(0), turns)
        cosine = dr.maximum(dr.dot(normal, ds.d), 0.0)
        weight = dr.select(ds.delta, 1.0, power_heuristic(ds.pdf, cosine * INVERSE_PI))
        direct = dr.select(turns & (ds.pdf > 0.0), radiance * cosine * weight, 0.0)
        technique, value = _put_down(lights, ds, radiance, direct)
        cell, is_inside = cache.cells.index(si.p, normal)
        for turn in range(TURNS + 1):
            irradiance[turn] += dr.select(arrives, share[turn] * came, 0.0)
            share[turn] = dr.select(is_known, 0.0, dr.select(arrives, share[turn] * reflectance, share[turn]))
            here = turns & (depth == turn)
            cells[turn] = dr.select(here, cell, cells[turn])
            is_found[turn] |= here & is_inside
            techniques[turn] = dr.select(here, technique, techniques[turn])
            brought[turn] = dr.select(here, value, brought[turn])
            share[turn] = dr.select(here, 1.0, share[turn])
            irradiance[turn] += share[turn] * direct
        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        ray = si.spawn_ray(dr.select(turns, mi.Frame3f(normal).to_world(local), ray.d))
        previous = dr.select(turns, mi.Interaction3f(si), previous)
        previous_pdf = dr.select(turns, local.z * INVERSE_PI, previous_pdf)
        depth = dr.select(turns, depth + 1, depth)
        num_crossed = dr.select(passes, num_crossed + 1, num_crossed)
        active = (turns | (active & passes)) & (num_crossed < MAX_CROSSINGS)
    return list(zip(cells, is_found, irradiance, techniques, brought, strict=True))


def _put_down(lights: LightChoice | None, ds: Any, radiance: Any, direct: Any) -> tuple[Any, Any]:
    """Technique to which a shadow ray is put down, and the luminance that it brought, of ``direct``, times
    the root of the technique's probability: its square's mean over all rays is then that over its own."""
    if lights is None:
        return mi.UInt32(0), mi.Float(0.0)
    technique = lights.technique(ds, mi.luminance(radiance) * ds.pdf)
    probability = lights.probability(mi.UInt32(0), technique)
    return technique, mi.luminance(direct) * dr.sqrt(probability)


def specular_reflectance(channels: Any) -> Array:
    """Light of all directions that the specular lobe sends on, in [0, 1].

    Schlick's Fresnel term has the mean S + (1 - S) / 21 over the hemisphere; how both parts fall with
    roughness is a fit to the BSDF, to 0.01.
    """
    specular, square = channels.specular_albedo, channels.roughness * channels.roughness
    grazing = (1.0 - specular) / 21.0 * dr.maximum(1.0 - 1.25 * square, 0.0)
    return specular * (1.0 - 0.34 * square * channels.roughness) + grazing

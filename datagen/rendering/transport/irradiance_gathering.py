# SPDX-License-Identifier: MIT
"""Gathers the irradiance cache, and second moments for the light sampler, along camera paths of all views.

The first rounds trace whole paths, which distribute light through the scene. In later rounds, the diffuse
lobe at the end of a segment reflects (1 - S) D E / pi, with E from earlier rounds, and only light of the
specular lobe is traced further.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.transport.emitters import SceneEmitters
from datagen.rendering.transport.irradiance_cache import IrradianceCache, SurfaceCells
from datagen.rendering.transport.light_sampler import MAX_LEARNED, LightSampler
from datagen.rendering.transport.recording import undisturbed
from datagen.rendering.transport.sobol import OwenSobol
from datagen.rendering.transport.vertex import (
    INVERSE_PI,
    MAX_CROSSINGS_BEFOREHAND,
    Walk,
    cosine_bounce,
    facing_normal,
    power_heuristic,
)
from mitsuba_plugins.arrays import aligned

if TYPE_CHECKING:
    from mitsuba_plugins.surface_material import SceneMaterials

Array = Any

NUM_RAYS = 40960
"""Number of camera rays of all views together, for any resolution, since all pixels share the cache; each ray
yields samples of irradiance at up to four vertices."""
BOX_PERCENTILE = 0.2
"""Percentage of the visited points, such as distant landscape, left out at each end of each axis."""
MIN_HITS = 64
"""Minimum number of hits on surfaces for gathering a cache."""
BOUNCES = 3
"""Number of bounces before a path's last recorded vertex; the path then continues to known irradiance."""
WARM_UP_BOUNCES = 64
"""Maximum number of bounces of a path; large, since each later round adds only a few bounces of light."""
MIN_SURVIVAL, MAX_SURVIVAL = 0.05, 0.95
"""Bounds of the probability that Russian roulette continues a path beyond the recorded vertices."""
WARM_UP, ROUNDS = 6, 12
"""Number of rounds with whole paths, and of rounds whose paths end in the irradiance of earlier rounds."""
WARM_UP_SHARE = 4
"""Divisor of the number of rays in the first rounds."""


def gather_irradiance(
    emitters: SceneEmitters, materials: SceneMaterials, sensors: Iterable[Any], seed: int
) -> IrradianceCache | None:
    """Gather the irradiance of surfaces along paths from ``sensors``; None if too few rays hit a surface.

    ``sensors`` may be an iterator that yields the same object repeatedly with different cameras.
    """
    views = [(sensor.view, tuple(int(v) for v in sensor.film().crop_size())) for sensor in sensors]
    rays = _camera_rays(views, NUM_RAYS, seed)
    points = _visited(emitters.scene, rays, seed)
    if len(points) < MIN_HITS:
        return None
    low, high = np.percentile(points, [BOX_PERCENTILE, 100.0 - BOX_PERCENTILE], axis=0)
    if not (high > low).any():
        return None
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    sampler = emitters.light_sampler
    if sampler is not None and sampler.num_techniques > MAX_LEARNED:
        sampler = None
    num_techniques = 0 if sampler is None else sampler.num_techniques
    cache = IrradianceCache(SurfaceCells(points), num_techniques)

    def walk(scene: Any, ray: Any, numbers: Any, is_warm: Any) -> list[tuple[Any, ...]]:
        return _walk(emitters, scene, materials, cache, sampler, ray, numbers, is_warm)

    def state(*_: Any) -> list[Any]:
        return [*emitters.tables(), *materials.tables(), *cache.arrays()]

    recorded: Any = dr.freeze(walk, state_fn=state)
    for number in range(WARM_UP + ROUNDS):
        is_warm = number >= WARM_UP
        lane: Any = dr.arange(mi.UInt32, NUM_RAYS if is_warm else NUM_RAYS // WARM_UP_SHARE)
        chosen: Any = lane if is_warm else lane * WARM_UP_SHARE
        launch: Any = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
        index = dr.opaque(mi.UInt32, number) + dr.zeros(mi.UInt32, dr.width(lane))
        numbers = OwenSobol(index, mi.sample_tea_32(chosen, launch)[0])
        ray = dr.gather(mi.Ray3f, rays, chosen)
        dr.make_opaque(ray, numbers)  # otherwise, rounds with fewer rays need another kernel
        with undisturbed():
            vertices = recorded(emitters.scene, ray, numbers, dr.opaque(mi.Bool, is_warm))
        dr.eval(vertices)
        cache.add(*_observed(vertices, num_techniques))
    recorded.clear()
    cache.finish()
    return cache


def _observed(
    vertices: list[tuple[Any, ...]], num_techniques: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Convert the result of :func:`_walk` to arguments of :meth:`IrradianceCache.add`."""
    cells, samples = [], []
    for cell, is_found, irradiance, technique, contribution in vertices:
        chosen = np.array(is_found)
        cells.append(np.array(cell)[chosen].astype(np.int64))
        values = np.zeros((len(cells[-1]), 3 + num_techniques))
        values[:, :3] = np.array(irradiance).T[chosen]
        if num_techniques:
            rows = np.arange(len(values))
            squares = np.array(contribution)[chosen].astype(np.float64) ** 2
            values[rows, 3 + np.array(technique)[chosen]] = squares
        samples.append(values)
    return np.concatenate(cells), np.concatenate(samples)


def _camera_rays(views: list[tuple[Any, tuple[int, ...]]], num_rays: int, seed: int) -> Any:
    """Return ``num_rays`` camera rays, divided equally between the views and uniform over each image."""
    from datagen.rendering.plugins import rays_through  # needs a selected variant

    parts = []
    for number, (view, (width, height)) in enumerate(views):
        share = num_rays * (number + 1) // len(views) - num_rays * number // len(views)
        lane: Any = dr.arange(mi.UInt32, share)
        camera: Any = dr.opaque(mi.UInt32, number, share)  # a literal would be compiled for each camera
        launch: Any = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
        key: Any = mi.sample_tea_32(camera, launch)[0]
        position = OwenSobol(lane, key).next_2d() * mi.Vector2f(width, height)
        ray = rays_through(view, position)
        dr.eval(ray)
        parts.append([np.broadcast_to(np.array(value), share) for value in (*ray.o, *ray.d, ray.maxt)])
    joined = [mi.Float(aligned(np.concatenate(part), np.float32)) for part in zip(*parts, strict=True)]
    rays: Any = mi.Ray3f(mi.Point3f(*joined[:3]), mi.Vector3f(*joined[3:6]))
    rays.maxt = joined[6]
    return rays


def _visited(scene: Any, ray: Any, seed: int) -> NDArray[np.float64]:
    """Points (N, 3) hit by the rays ``ray`` and by their continuations in cosine-distributed directions."""
    launch: Any = dr.opaque(mi.UInt32, (seed + 1) & 0xFFFFFFFF)
    lane: Any = dr.arange(mi.UInt32, dr.width(ray))
    numbers = OwenSobol(dr.zeros(mi.UInt32, dr.width(ray)), mi.sample_tea_32(lane, launch)[0])
    walk, points, active = Walk(ray), [], mi.Bool(True)
    for _ in range(BOUNCES):
        si = walk.intersect(scene, active)
        active &= si.is_valid()
        direction, pdf = cosine_bounce(facing_normal(si, walk.ray.d), numbers.next_2d())
        walk.advance(si, True, False, direction, pdf)
        points.append(np.array(si.p).T[np.array(active)])
    return np.concatenate(points).astype(np.float64)


@dr.syntax
def _walk(
    emitters: Any, scene: Any, materials: Any, cache: Any, sampler: Any, ray: Any, numbers: Any, is_warm: Any
) -> list[tuple[Any, ...]]:
    """Trace a path; return for each vertex its cell, whether the cell is valid, a sample of the irradiance,
    and the shadow ray's technique and contribution (see :func:`_attributed`).

    After the warm-up (``is_warm``), known cached irradiance replaces the light of a vertex's diffuse lobe.
    """
    from mitsuba_plugins.surface_material import SurfaceLobes  # needs a selected variant

    walk = Walk(ray)  # current segment and previous vertex
    # One entry per recorded vertex:
    cells: list[Any] = [mi.UInt32(0) for _ in range(BOUNCES + 1)]  # cell of the irradiance cache
    is_found: list[Any] = [mi.Bool(False) for _ in range(BOUNCES + 1)]  # whether it is inside the grid
    irradiance: list[Any] = [mi.Color3f(0.0) for _ in range(BOUNCES + 1)]  # accumulated so far
    techniques: list[Any] = [mi.UInt32(0) for _ in range(BOUNCES + 1)]  # technique of the shadow ray
    contributions: list[Any] = [mi.Float(0.0) for _ in range(BOUNCES + 1)]  # see :func:`_attributed`
    # Derivative of that irradiance with respect to the radiance that arrives at the path's end
    throughput: list[Any] = [mi.Color3f(0.0) for _ in range(BOUNCES + 1)]
    active = mi.Bool(True)  # lanes whose path continues
    while active:
        si = walk.intersect(scene, active)
        hits = active & si.is_valid()
        is_light = hits & si.shape.is_emitter()
        channels = materials.reflecting_channels_at(si, hits)
        passes = (hits & ~is_light & (numbers.next_1d() >= channels.opacity)) | emitters.is_hidden(
            si, walk.depth
        )
        arrives = active & ~passes

        # ---- emission, and diffuse reflection of known irradiance -----------------------------------------
        emitted, weight = emitters.emission(si, walk, arrives, arrives)
        normal = facing_normal(si, walk.ray.d)
        is_last = walk.depth > WARM_UP_BOUNCES
        record = cache.record(si.p, normal, arrives & hits)
        known, is_known = cache.irradiance(record, is_last, arrives & hits & (is_warm | is_last))
        diffuse = channels.diffuse_reflectance()
        arriving = emitted * weight + dr.select(is_known, INVERSE_PI * diffuse * known, 0.0)

        # ---- Russian roulette beyond the recorded vertices -------------------------------------------------
        # Paths continue to a cell of known irradiance, since assuming 0 elsewhere would add bias.
        bounces = arrives & hits & ~is_last
        specular = channels.fresnel(si.wi)
        reflectance = specular + dr.select(is_known, 0.0, diffuse)
        is_recorded = walk.depth <= BOUNCES
        survival = dr.select(is_recorded, 1.0, dr.clip(dr.max(reflectance), MIN_SURVIVAL, MAX_SURVIVAL))
        bounces &= numbers.next_1d() < survival

        # ---- direct light at this vertex ------------------------------------------------------------------
        # Directions follow a mixture of the cosine, for irradiance, and the BSDF, for reflected light.
        channels = replace(channels, diffuse_albedo=dr.select(is_known, 0.0, channels.diffuse_albedo))
        lobes = SurfaceLobes(channels, si, bounces, materials.has_mapped_normals)
        share = dr.select(is_recorded, 1.0 - 0.5 * dr.max(specular), 0.0)  # of cosine-distributed directions
        ds, radiance = emitters.sample(si, numbers, mi.UInt32(0), bounces)
        radiance = emitters.visible(si, ds, radiance, bounces)
        value, pdf = lobes.eval_pdf(si.to_local(ds.d))
        cosine = dr.maximum(dr.dot(normal, ds.d), 0.0)
        pdf = dr.lerp(pdf, cosine * INVERSE_PI, share)
        weight = dr.select(ds.delta, 1.0, power_heuristic(ds.pdf, pdf))
        lit = dr.select(bounces & (ds.pdf > 0.0), radiance * weight, 0.0)
        direct = lit * cosine
        technique, contribution = _attributed(sampler, si.p, ds, radiance, direct)

        # ---- next direction --------------------------------------------------------------------------------
        choice: Any = numbers.next_1d()
        number: Any = numbers.next_2d()
        cosine_sampled, _ = cosine_bounce(normal, number)
        reflected, _, _ = lobes.sample((choice - share) / dr.maximum(1.0 - share, 1e-6), number)
        direction = dr.select(choice < share, cosine_sampled, si.to_world(reflected))
        next_value, next_pdf = lobes.eval_pdf(si.to_local(direction))
        next_cosine = dr.maximum(dr.dot(normal, direction), 0.0)
        next_pdf = dr.lerp(next_pdf, next_cosine * INVERSE_PI, share)
        inverse = dr.select(next_pdf > 0.0, 1.0 / next_pdf, 0.0)

        # ---- irradiance of the recorded vertices -----------------------------------------------------------
        onward = arriving + value * lit / survival  # radiance towards the previous vertex
        factor = dr.select(bounces, next_value * (inverse / survival), 1.0)
        cell, is_inside = cache.cells.index(si.p, normal)
        for bounce in range(BOUNCES + 1):
            irradiance[bounce] += dr.select(arrives, throughput[bounce] * onward, 0.0)
            throughput[bounce] *= factor
            here = bounces & (walk.depth == bounce)
            cells[bounce] = dr.select(here, cell, cells[bounce])
            is_found[bounce] |= here & is_inside
            techniques[bounce] = dr.select(here, technique, techniques[bounce])
            contributions[bounce] = dr.select(here, contribution, contributions[bounce])
            irradiance[bounce] += dr.select(here, direct, 0.0)
            throughput[bounce] = dr.select(here, next_cosine * inverse, throughput[bounce])
        bounces &= next_pdf > 0.0
        walk.advance(si, bounces, passes, direction, next_pdf)
        active = (bounces | (active & passes)) & (walk.num_crossed < MAX_CROSSINGS_BEFOREHAND)
    return list(zip(cells, is_found, irradiance, techniques, contributions, strict=True))


def _attributed(
    light_sampler: LightSampler | None, point: Any, ds: Any, radiance: Any, direct: Any
) -> tuple[Any, Any]:
    """Return a shadow ray's technique, and the luminance of ``direct`` times sqrt(technique probability).

    The mean square of this product over all rays is the second moment E_k[f^2] of :mod:`.light_sampler`.
    """
    if light_sampler is None:
        return mi.UInt32(0), mi.Float(0.0)
    technique = light_sampler.technique(point, ds, mi.luminance(radiance) * ds.pdf)
    probability = light_sampler.probability(mi.UInt32(0), technique)
    return technique, mi.luminance(direct) * dr.sqrt(probability)

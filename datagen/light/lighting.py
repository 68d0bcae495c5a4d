# SPDX-License-Identifier: MIT
"""Surfels and their incident light: radiance field, estimates of unphotographed surfaces and of the sun,
irradiance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import luminance
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from datagen.light.background import photographed_background
from datagen.light.bake import Baker, Irradiance, cosine_rays
from datagen.light.cells import surface_cells, unmixed_cells
from datagen.light.emitters import Emitters, photographed_emitters
from datagen.light.estimated_light import fitted_gains, surface_groups, with_gains
from datagen.light.radiance_field import RadianceField
from datagen.light.sun import LitSurfaces, ShadowRays, Sun, find_sun
from datagen.light.surfels import CELLS_ACROSS, Surfels, build_surfels, clipped_shares, near_surfels

MIN_KNOWN = 0.1
"""Lower bound of the known share of light, by which known light is divided to extrapolate to all light."""
MIN_SHADING = 1e-3
"""Share of the room's median shading below which a diffuse albedo is undetermined."""
MAX_ESTIMATED_SURFELS, ESTIMATE_RAYS_A_SURFEL = 40_000, 16
"""Approximate maximum number of surfels, and number of rays per surfel, that search for unphotographed
surfaces."""
MAX_RATIO_SURFELS, MIN_RATIO_PHOTOGRAPHED, SURFELS_OF_ROOM = 8000, 0.8, 4.0
"""Approximate maximum number of surfels from which typical reflectances are computed, minimum photographed
share of their light, and the number at which a region's median and the room's have equal weight."""
MAX_SUN_SURFELS, MAX_CLIPPED = 40_000, 0.1
"""Approximate maximum number of surfels from which the sun is found, and maximum share of clipped pixels of a
surfel whose radiance is known."""
MIXED_RAYS, BOUND_KNOWN = 48, (0.3, 0.6)
"""Rays per mixed surfel for the bound on its radiance, and the known shares of its incident light at which
the bound starts to act and acts fully."""
ESTIMATE_ROUNDS = 5
"""Number of rounds, each of which adds one bounce between unphotographed surfaces. The first assumes unknown
light to be as bright as known light; from the fifth on, the mean radiance changes by less than 2 %."""
_REFLECTANCE_RANGE = (0.05, 0.9)  # lower and upper bound


@dataclass(frozen=True)
class GatherOptions:
    """Options of :func:`light_surfels` and :func:`relight`.

    Rays per surfel: ``irradiance_rays``, ``second_irradiance_rays`` in :func:`relight`, and ``estimate_rays``
    for unphotographed surfaces. ``smoothing_neighbours``: number of surfels over which shading is smoothed.
    ``estimates_unseen``: whether the radiance of unphotographed surfaces is estimated; ``fits_estimates``:
    whether gains of the estimates are fitted; ``finds_sun``: whether the sun is estimated too.
    ``bounds_mixed``: whether the radiance of mixed surfels is bounded by their incident light.
    """

    irradiance_rays: int = 144
    second_irradiance_rays: int = 512
    estimate_rays: int = 48
    smoothing_neighbours: int = 9
    estimates_unseen: bool = True
    fits_estimates: bool = True
    finds_sun: bool = False
    bounds_mixed: bool = True


@dataclass(frozen=True)
class Lit:
    """Surfels with their shading.

    ``diffuse`` (N, 3): smoothed Ld = E / pi of all light; ``hidden`` (N,): share of the light attributed to
    unphotographed lamps, in [0, 1]; ``sun``, None if not found, and its part ``sunlight`` (N, 3) of Ld, which
    the irradiance lacks.
    """

    surfels: Surfels
    baker: Baker
    irradiance: Irradiance
    diffuse: NDArray[np.float32]
    hidden: NDArray[np.float64]
    sun: Sun | None
    sunlight: NDArray[np.float32]


@dataclass(frozen=True)
class _Estimates:
    """The radiance ``field`` with estimates, and ``hidden``, ``sun`` and ``sunlight`` as in :class:`Lit`."""

    field: RadianceField
    hidden: NDArray[np.float64]
    sun: Sun | None
    sunlight: NDArray[np.float32]


def light_surfels(
    views: Sequence[TracedView],
    traced: TracedGeometry,
    emits: NDArray[np.bool_],
    region_of_face: NDArray[np.int32],
    options: GatherOptions,
    step: Callable[[str], AbstractContextManager[None]] = lambda name: nullcontext(),
    unseen: Callable[[Lit], Emitters] | None = None,
) -> Lit:
    """Compute the surfels of the views and their incident light.

    ``emits`` (M,): mask of the emissive triangles; ``region_of_face`` (M,): smooth region of each triangle.
    ``step`` returns a context manager for the stage of a given name. ``unseen`` determines all emitters from
    the light of the photographed ones. Raises ``ValueError`` if the views show no extended surface.
    """
    with step("surfels"):
        surfels = build_surfels(views)
    with step("field"):
        emitters = photographed_emitters(views, traced, emits, region_of_face)
        grid = surfels.grid
        background = photographed_background(views, grid.low, grid.high)

    def lit_by(emitters: Emitters, options: GatherOptions) -> Lit:
        with step("field"):
            size_m = surfels.grid.cell_m * CELLS_ACROSS
            own = surfels
            if options.bounds_mixed:
                unmixed = RadianceField(traced.scene, own, emitters, background, unmixed_cells(own))
                own = bounded(own, Baker(unmixed, size_m))
            scene_field = RadianceField(traced.scene, own, emitters, background)
            found = _Estimates(scene_field, np.zeros(len(own)), None, np.zeros((len(own), 3), np.float32))
            if options.estimates_unseen:
                found = _estimated(scene_field, own, views, size_m, region_of_face, options)
        with step("irradiance"):
            return _lit(own, Baker(found.field, size_m), found, options.irradiance_rays, options)

    if unseen is not None and emitters.is_dark.any():
        emitters = unseen(lit_by(emitters, replace(options, fits_estimates=False)))
    return lit_by(emitters, options)


def bounded(surfels: Surfels, unmixed: Baker) -> Surfels:
    """Bound the radiance of mixed surfels by their incident light, less strictly where less of it is known.

    Otherwise, a blind's slat that is one pixel wide would have the radiance of the sky behind it. ``unmixed``
    computes light in the field without mixed surfels, most of whose pixels are at depth edges.
    """
    mixed = np.flatnonzero(surfels.is_mixed)
    if not len(mixed):
        return surfels
    lit = unmixed.irradiance(surfels.position_m[mixed], surfels.normal[mixed], MIXED_RAYS)
    arriving = luminance(_extrapolated(lit))
    scale = np.minimum(1, arriving / np.maximum(luminance(surfels.radiance[mixed]), 1e-12))
    low, high = BOUND_KNOWN
    scale **= np.clip((lit.known - low) / (high - low), 0, 1)
    radiance = surfels.radiance.copy()
    radiance[mixed] *= scale[:, None].astype(np.float32)
    return replace(surfels, radiance=radiance)


def relight(
    lit: Lit,
    specular_albedo: NDArray,
    roughness: NDArray,
    is_metal: NDArray[np.bool_],
    options: GatherOptions,
) -> Lit:
    """Compute the light of the surfels again, with more rays and with reflections at metals.

    Per surfel: ``specular_albedo`` (N, 3), ``roughness`` (N,) and ``is_metal`` (N,).
    """
    field = lit.baker.field
    if is_metal.any():
        field = field.with_metals(lit.surfels, specular_albedo, roughness, is_metal, lit.baker.start_m)
    baker = Baker(field, lit.baker.size_m)
    found = _Estimates(field, lit.hidden, lit.sun, lit.sunlight)
    return _lit(lit.surfels, baker, found, options.second_irradiance_rays, options)


def _lit(surfels: Surfels, baker: Baker, found: _Estimates, num_rays: int, options: GatherOptions) -> Lit:
    irradiance = baker.irradiance(surfels.position_m, surfels.normal, num_rays)
    diffuse = smoothed(surfels, _extrapolated(irradiance), options.smoothing_neighbours) + found.sunlight
    return Lit(surfels, baker, irradiance, diffuse, found.hidden, found.sun, found.sunlight)


def _extrapolated(irradiance: Irradiance) -> NDArray[np.float32]:
    """Diffuse shading (N, 3) on the assumption that unknown light is as bright as known light."""
    return irradiance.diffuse / np.maximum(irradiance.known, MIN_KNOWN)[:, None]


def _estimated(
    scene_field: RadianceField,
    surfels: Surfels,
    views: Sequence[TracedView],
    size_m: float,
    region_of_face: NDArray,
    options: GatherOptions,
) -> _Estimates:
    """Estimate the radiance of unphotographed surfaces, the share of light from unphotographed lamps, and the
    sun.

    The estimated radiance is the typical reflectance of the smooth region times the incident light times the
    fitted gain.
    """
    position, facing, face = _unknown_surface(scene_field, surfels, size_m)
    region = region_of_face[surfels.face]
    extended = scene_field
    radiance = np.zeros((len(position), 3), np.float32)
    if len(position):
        of_region = typical_reflectance(
            Baker(scene_field, size_m), surfels, region, int(region_of_face.max()) + 1, options
        )
        reflectance = of_region[region_of_face[face]]
        for _ in range(ESTIMATE_ROUNDS):
            lit = Baker(extended, size_m).irradiance(position, facing, options.estimate_rays)
            arriving = lit.diffuse / np.maximum(lit.known, 2 * MIN_KNOWN)[:, None]
            radiance = (reflectance * arriving).astype(np.float32)
            extended = scene_field.extended(position, facing, surfels, radiance)
    baker, sun, sunlight = Baker(extended, size_m), None, np.zeros((len(surfels), 3), np.float32)
    if options.finds_sun:
        sun = _found_sun(baker, surfels, clipped_surfels(views, surfels), region, options)
    if sun is not None:
        rays = ShadowRays(scene_field.scene, baker.start_m)
        sunlight = rays.sunlight(sun, surfels.position_m, surfels.normal)
    if not options.fits_estimates:
        return _Estimates(extended, np.zeros(len(surfels)), sun, sunlight)
    gains = fitted_gains(baker, surfels, region, sunlight)
    radiance *= gains.of_group[surface_groups(position, facing, surfels), None].astype(np.float32)
    background = with_gains(scene_field.background, gains.of_group)
    fitted = RadianceField(scene_field.scene, surfels, scene_field.emitters, background)
    if len(position):
        fitted = fitted.extended(position, facing, surfels, radiance)
    return _Estimates(fitted, gains.hidden, sun, sunlight)


def _found_sun(
    baker: Baker, surfels: Surfels, is_clipped: NDArray, region: NDArray, options: GatherOptions
) -> Sun | None:
    step = max(1, len(surfels) // MAX_SUN_SURFELS)
    chosen = np.flatnonzero(~surfels.is_mixed)[::step]
    position, normal = surfels.position_m[chosen], surfels.normal[chosen]
    diffuse = _extrapolated(baker.irradiance(position, normal, options.estimate_rays))
    sampled = LitSurfaces(
        position, normal, surfels.radiance[chosen], diffuse, region[chosen], is_clipped[chosen]
    )
    return find_sun(sampled, ShadowRays(baker.field.scene, baker.start_m))


def clipped_surfels(views: Sequence[TracedView], surfels: Surfels) -> NDArray[np.bool_]:
    """Compute whether more than :data:`MAX_CLIPPED` of each surfel's pixels are clipped in a channel (N,)."""
    return np.asarray((clipped_shares(views, surfels) > MAX_CLIPPED).any(axis=1))


def _unknown_surface(
    scene_field: RadianceField, surfels: Surfels, size_m: float
) -> tuple[NDArray, NDArray, NDArray[np.int64]]:
    """Find a position and normal (K, 3) and the triangle (K,) in each cell of unknown radiance that the
    surfels' rays hit.
    """
    step = max(1, len(surfels) // MAX_ESTIMATED_SURFELS)
    origin, normal = surfels.position_m[::step], surfels.normal[::step]
    ray = cosine_rays(origin, normal, ESTIMATE_RAYS_A_SURFEL, Baker(scene_field, size_m).start_m, seed=0)
    position, facing, face = scene_field.unknown_hits(ray)
    keys, first = np.unique(surface_cells(surfels.grid, position, facing), return_index=True)
    chosen = first[keys >= 0]
    return position[chosen], facing[chosen], face[chosen]


def typical_reflectance(
    baker: Baker, surfels: Surfels, region: NDArray, num_regions: int, options: GatherOptions
) -> NDArray[np.float64]:
    """Typical reflectance pi L / E (``num_regions``, 3) of smooth regions: the median over surfels in mostly
    photographed light, shrunk towards that of the room, which is 0.4 if there are none.

    ``region`` (N,) is the index of each surfel's region.
    """
    step = max(1, len(surfels) // MAX_RATIO_SURFELS)
    lit = baker.irradiance(surfels.position_m[::step], surfels.normal[::step], options.estimate_rays)
    used = (lit.photographed > MIN_RATIO_PHOTOGRAPHED) & (lit.diffuse.min(axis=1) > 0)
    if not used.any():
        return np.full((num_regions, 3), 0.4)
    ratio = surfels.radiance[::step][used] * lit.known[used, None] / lit.diffuse[used]
    log_ratio = np.log(np.clip(ratio, *_REFLECTANCE_RANGE))
    of_room = np.median(log_ratio, axis=0)
    found = np.repeat(of_room[None], num_regions, axis=0)
    of_sample = region[::step][used]
    for which in np.unique(of_sample):
        own = log_ratio[of_sample == which]
        weight = len(own) / (len(own) + SURFELS_OF_ROOM)
        found[which] += weight * (np.median(own, axis=0) - of_room)
    return np.exp(found)


def smoothed(surfels: Surfels, values: NDArray, neighbours: int) -> NDArray[np.float32]:
    """Gaussian means (N, K) of ``values`` (N, K) over the nearest ``neighbours`` with similar normals."""
    distance, index = near_surfels(surfels, neighbours)
    weight = np.exp(-0.5 * (distance / 1.5) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nkc->nc", weight, values[index]).astype(np.float32)

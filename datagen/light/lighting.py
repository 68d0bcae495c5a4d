# SPDX-License-Identifier: MIT
"""Surfels and their incident light: radiance field, estimates of unphotographed surfaces and of the sun, and
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
from datagen.light.bake import Baker, Irradiance
from datagen.light.cells import surfel_cells, unmixed_cells
from datagen.light.emitters import Emitters, photographed_emitters
from datagen.light.estimated_light import fitted_gains, surface_groups, with_gains
from datagen.light.radiance_field import RadianceField
from datagen.light.sun import LitSurfaces, ShadowRays, Sun, find_sun
from datagen.light.surfels import CELLS_ACROSS, Surfels, build_surfels, clipped_shares, near_surfels
from datagen.light.unseen_surfaces import Regions, unseen_surfaces

MIN_SHADING = 1e-3
"""Share of the room's median shading below which a diffuse albedo is undetermined."""
MAX_SUN_SURFELS, MAX_CLIPPED = 40_000, 0.1
"""Approximate maximum number of surfels from which the sun is found, and share of clipped pixels above which
the radiance of a surfel is only a lower bound."""
MIXED_RAYS, BOUND_KNOWN = 48, (0.3, 0.6)
"""Rays per mixed surfel for the bound on its radiance, and the known shares of its incident light at which
the bound starts to act and acts fully."""


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

    ``diffuse`` (N, 3): smoothed Ld = E / pi of all light; ``sunlight`` (N, 3): its part from ``sun`` (None if
    not found), which ``irradiance`` excludes; ``hidden`` (N,): share of the light attributed to
    unphotographed lamps, in [0, 1]; ``seen``: the field of photographed radiance, without estimates;
    ``baker``: computes shading in the field with estimates; ``regions``: smooth regions of the mesh.
    """

    surfels: Surfels
    seen: RadianceField
    baker: Baker
    irradiance: Irradiance
    diffuse: NDArray[np.float32]
    hidden: NDArray[np.float64]
    sun: Sun | None
    sunlight: NDArray[np.float32]
    regions: Regions


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
    ``step`` returns a context manager for the stage of a given name. If the radiance of an emitter is not
    photographed, it is 0 unless ``unseen`` is given, which returns the completed emitters, given the light of
    the photographed ones. Raises :class:`InputError` if the views show no extended surface.
    """
    with step("surfels"):
        surfels = build_surfels(views)
    with step("field"):
        emitters = photographed_emitters(views, traced, emits, region_of_face)
        grid = surfels.grid
        background = photographed_background(views, grid.low, grid.high)
        regions = Regions.of_mesh(traced.mesh, region_of_face)

    def lit_by(emitters: Emitters, options: GatherOptions) -> Lit:
        with step("field"):
            size_m = surfels.grid.cell_m * CELLS_ACROSS
            own = surfels
            if options.bounds_mixed:
                unmixed = RadianceField(traced.scene, unmixed_cells(own), emitters, background)
                own = bounded(own, Baker(unmixed, size_m))
            scene_field = RadianceField(traced.scene, surfel_cells(own), emitters, background)

            def sun_in(baker: Baker) -> Sun | None:
                is_clipped = clipped_surfels(views, own)
                return _found_sun(baker, own, is_clipped, region_of_face[own.face], options)

            found = _estimated(scene_field, own, own, size_m, regions, options, sun_in)
        with step("irradiance"):
            baker = Baker(found.field, size_m)
            return _lit(own, scene_field, baker, found, regions, options.irradiance_rays, options)

    if unseen is not None and emitters.is_dark.any():
        emitters = unseen(lit_by(emitters, replace(options, fits_estimates=False)))
    return lit_by(emitters, options)


def bounded(surfels: Surfels, unmixed: Baker) -> Surfels:
    """Bound the radiance of mixed surfels by their incident light, less strictly where less of it is known.

    Otherwise, a blind's slat that is one pixel wide would have the radiance of the sky behind it. ``unmixed``
    computes light in the field without mixed surfels (those with most pixels at depth edges).
    """
    mixed = np.flatnonzero(surfels.is_mixed)
    if not len(mixed):
        return surfels
    lit = unmixed.irradiance(surfels.position_m[mixed], surfels.normal[mixed], MIXED_RAYS)
    arriving = luminance(lit.extrapolated())
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
    outgoing: NDArray,
    diffuse: NDArray,
    options: GatherOptions,
) -> Lit:
    """Compute the light of the surfels again, with more rays, reflections at metals, and mean outgoing
    instead of photographed radiance.

    Per surfel: ``specular_albedo`` (N, 3), ``roughness`` (N,), ``is_metal`` (N,), mean ``outgoing`` radiance
    (N, 3) and its ``diffuse`` part (N, 3).
    """
    surfels, size_m = lit.surfels, lit.baker.size_m
    seen = lit.seen.with_radiance(surfels, outgoing)
    of_outgoing, of_diffuse = replace(surfels, radiance=outgoing), replace(surfels, radiance=diffuse)
    found = _estimated(seen, of_outgoing, of_diffuse, size_m, lit.regions, options, lambda baker: lit.sun)
    field = found.field
    if is_metal.any():
        field = field.with_metals(surfels, specular_albedo, roughness, is_metal)
    baker, num_rays = Baker(field, size_m), options.second_irradiance_rays
    return _lit(surfels, seen, baker, found, lit.regions, num_rays, options)


def _lit(
    surfels: Surfels,
    seen: RadianceField,
    baker: Baker,
    found: _Estimates,
    regions: Regions,
    num_rays: int,
    options: GatherOptions,
) -> Lit:
    irradiance = baker.irradiance(surfels.position_m, surfels.normal, num_rays)
    diffuse = smoothed(surfels, irradiance.extrapolated(), options.smoothing_neighbours) + found.sunlight
    return Lit(surfels, seen, baker, irradiance, diffuse, found.hidden, found.sun, found.sunlight, regions)


def _estimated(
    seen: RadianceField,
    surfels: Surfels,
    diffuse: Surfels,
    size_m: float,
    regions: Regions,
    options: GatherOptions,
    sun_in: Callable[[Baker], Sun | None],
) -> _Estimates:
    """Estimate the radiance of unphotographed surfaces, the share of light from unphotographed lamps, and the
    sun.

    A surface's estimate is its smooth region's typical reflectance times its incident light times a gain.
    Gains are fitted to ``diffuse``, surfels with only the diffuse part of the photographed radiance.
    """
    no_sunlight = np.zeros((len(surfels), 3), np.float32)
    if not options.estimates_unseen:
        return _Estimates(seen, np.zeros(len(surfels)), None, no_sunlight)
    unseen = unseen_surfaces(Baker(seen, size_m), surfels, regions, options.estimate_rays)
    extended = unseen.added_to(seen, surfels)
    baker, sunlight = Baker(extended, size_m), no_sunlight
    sun = sun_in(baker) if options.finds_sun else None
    if sun is not None:
        rays = ShadowRays(seen.scene, baker.start_m)
        sunlight = rays.sunlight(sun, surfels.position_m, surfels.normal)
    if not options.fits_estimates:
        return _Estimates(extended, np.zeros(len(surfels)), sun, sunlight)
    gains = fitted_gains(baker, diffuse, regions.of_face[surfels.face], sunlight)
    gain = gains.of_group[surface_groups(unseen.position_m, unseen.normal, surfels), None]
    unseen = replace(unseen, radiance=(unseen.radiance * gain).astype(np.float32))
    fitted = seen.with_background(with_gains(seen.background, gains.of_group))
    return _Estimates(unseen.added_to(fitted, surfels), gains.hidden, sun, sunlight)


def _found_sun(
    baker: Baker, surfels: Surfels, is_clipped: NDArray, region: NDArray, options: GatherOptions
) -> Sun | None:
    step = max(1, len(surfels) // MAX_SUN_SURFELS)
    chosen = np.flatnonzero(~surfels.is_mixed)[::step]
    position, normal = surfels.position_m[chosen], surfels.normal[chosen]
    diffuse = baker.irradiance(position, normal, options.estimate_rays).extrapolated()
    sampled = LitSurfaces(
        position, normal, surfels.radiance[chosen], diffuse, region[chosen], is_clipped[chosen]
    )
    return find_sun(sampled, ShadowRays(baker.field.scene, baker.start_m))


def clipped_surfels(views: Sequence[TracedView], surfels: Surfels) -> NDArray[np.bool_]:
    """Mask (N,) of the surfels with a share of clipped pixels above :data:`MAX_CLIPPED` in any channel."""
    return np.asarray((clipped_shares(views, surfels) > MAX_CLIPPED).any(axis=1))


def smoothed(surfels: Surfels, values: NDArray, neighbours: int) -> NDArray[np.float32]:
    """Means (N, K) of ``values`` (N, K) over the nearest ``neighbours`` surfels with similar normals.

    Weights are Gaussian, with a standard deviation of 1.5 cells.
    """
    distance, index = near_surfels(surfels, neighbours)
    weight = np.exp(-0.5 * (distance / 1.5) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nkc->nc", weight, values[index]).astype(np.float32)

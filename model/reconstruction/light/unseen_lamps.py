# SPDX-License-Identifier: MIT
"""Estimates the radiance of lamps that the geometry declares and no photograph shows.

A lamp is a connected part of the emitting triangles. Lamps with the same number of triangles and the same
area are of one kind and share one radiance: that of a photographed lamp of the kind or, without one, the
radiance that makes the albedo of the illuminated surfaces uniform in each smooth region and close to the
network's (:func:`~model.reconstruction.radiometry.recovered.recovered`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import smooth_regions
from datagen.light.emitters import Emitters
from datagen.light.lighting import Lit
from model.reconstruction.radiometry.recovered import RAYS, Gathered, Prior, SourceField, doubt_of, recovered
from model.reconstruction.radiometry.sources import Sources

MAX_POINTS = 2500
"""Maximum number of surfels from which the radiance is estimated."""
SAME_AREA = 0.02
"""Maximum relative difference in area between a lamp and the next larger one of its kind."""
MIN_LIGHT = 0.01
"""Lower bound on the light from a kind of lamp, relative to all other light."""
ALBEDO_SPREAD = 0.5
"""Prior standard deviation of the difference of a region's mean ln albedo from the network's."""
_EXPECTED, _EXPECTED_SPREAD = np.log(30.0), 2.0  # prior of ln(light / MIN_LIGHT)
_MIN_ALBEDO = 0.02  # limits the effect of dark predictions on the mean ln albedo
_MIN_KNOWN = 0.5  # minimum known share of a surfel's light


@dataclass(frozen=True)
class UnseenLamps:
    """All ``emitters`` of a room, with estimated radiance for unphotographed lamps.

    ``light_at`` returns the luminance (N,) of diffuse shading by the lamps whose radiance was estimated from
    surfaces, at positions and normals (N, 3); None if there are none.
    """

    emitters: Emitters
    light_at: Callable[[NDArray, NDArray], NDArray[np.float32]] | None = None

    def share(self, lit: Lit, region: NDArray) -> NDArray[np.float64]:
        """Compute the mean share (N,) of light from the estimated lamps over each surfel's smooth ``region``
        (N,), at least the mean over the whole room.
        """
        if self.light_at is None:
            return np.zeros(len(lit.surfels))
        light = self.light_at(lit.surfels.position_m, lit.surfels.normal)
        share = np.minimum(light / np.maximum(lit.diffuse @ LUMINANCE_WEIGHTS, 1e-12), 1)
        of_region = np.unique(region, return_inverse=True)[1]
        means = np.bincount(of_region, share) / np.bincount(of_region)
        return np.maximum(means, share.mean())[of_region]


def unseen_lamps(lit: Lit, mesh: Mesh, region: NDArray, predicted: NDArray) -> UnseenLamps:
    """Estimate the radiance of a room's unphotographed lamps, whose light ``lit`` does not include.

    ``region`` (N,) and ``predicted`` (N, 3) are the surfels' smooth regions and the network's D.
    """
    emitters, surfels = lit.baker.field.emitters, lit.surfels
    kind, radiance = lamp_kinds(emitters, mesh)
    usable = lit.irradiance.known >= _MIN_KNOWN
    usable &= (surfels.radiance > 0).all(axis=1) & (lit.diffuse > 0).all(axis=1)
    if not (kind >= 0).any() or not usable.any():
        return UnseenLamps(emitters.with_radiance(radiance))
    background = lit.baker.field.background
    field = SourceField(lit.baker.field.scene, surfels, emitters, background)
    chosen = np.sort(np.random.default_rng(0).permutation(np.flatnonzero(usable))[:MAX_POINTS])
    position, normal = surfels.position_m[chosen], surfels.normal[chosen]

    def sources(of_emitter: NDArray, bound: NDArray) -> Sources:
        bins, all_surfels = len(background.radiance), len(surfels)
        nowhere = np.full(bins, -1), np.full(all_surfels, -1)
        return Sources(bound, np.ones(bound.shape, dtype=bool), of_emitter, *nowhere)

    light = lit.diffuse[chosen].astype(np.float64)
    copies = np.flatnonzero(emitters.is_dark & radiance.any(axis=1))
    if len(copies):
        of_copy = np.full(len(emitters), -1)
        of_copy[copies] = np.arange(len(copies))
        shining = field.alone(sources(of_copy, radiance[copies]), radiance[copies])
        light += field.baker(shining).irradiance(position, normal, RAYS).diffuse
    lamps = sources(kind, np.ones((int(kind.max()) + 1, 3)))
    form = field.form_factors(lamps, position, normal)
    illuminates = form.mean(axis=0) > 0  # kinds that illuminate at least one point
    bound = MIN_LIGHT * light.mean(axis=0) / np.where(illuminates, form.mean(axis=0), np.inf)[:, None]
    group = np.unique(region[chosen], return_inverse=True)[1]
    log_albedo = np.log(np.maximum(predicted[chosen].astype(np.float64), _MIN_ALBEDO))
    albedo = np.stack([np.bincount(group, column) for column in log_albedo.T], axis=1)
    prior = Prior(
        albedo / np.bincount(group)[:, None], np.full(len(lamps), _EXPECTED), ALBEDO_SPREAD, _EXPECTED_SPREAD
    )
    gathered = Gathered(surfels.radiance[chosen].astype(np.float64), light, form, group)
    found = recovered(gathered, replace(lamps, bound=bound), prior)
    is_unknown = kind >= 0
    radiance[is_unknown] = np.where(illuminates[:, None], found.radiance, 0.0)[kind[is_unknown]]
    uncertain = replace(found, spread=np.ones(len(lamps)))  # all light from these lamps counts as uncertain
    return UnseenLamps(emitters.with_radiance(radiance), doubt_of(field, lamps, uncertain))


def lamp_kinds(emitters: Emitters, mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Compute the kind (K,) of each emitter of unknown radiance, -1 for others, and the radiance (K, 3) of
    all emitters, which is 0 if neither the lamp nor its kind is photographed.
    """
    faces = emitters.triangles
    lamp_of_face = smooth_regions(Mesh(mesh.positions, mesh.faces[faces]), np.pi)
    emitter_of_face = emitters.of_face[faces]
    area = mesh.areas()[faces]
    lamp = np.zeros(len(emitters), np.int64)
    lamp[emitter_of_face] = lamp_of_face
    emitter_area = np.bincount(emitter_of_face, area, len(emitters))
    lamp_area, lamp_faces = np.bincount(lamp_of_face, area), np.bincount(lamp_of_face)
    kind_of_lamp = np.zeros(len(lamp_area), np.int64)
    order = np.lexsort((lamp_area, lamp_faces))
    for before, after in pairwise(order):
        is_new = lamp_faces[before] != lamp_faces[after]
        is_new |= lamp_area[after] > (1 + SAME_AREA) * lamp_area[before]
        kind_of_lamp[after] = kind_of_lamp[before] + is_new
    kind, radiance = kind_of_lamp[lamp], emitters.radiance.astype(np.float64)
    for group in (lamp, kind):
        dark = ~radiance.any(axis=1)
        weight = emitter_area * ~dark
        total = np.bincount(group, weight)
        mean = np.stack([np.bincount(group, weight * column) for column in radiance.T], axis=1)
        mean = mean / np.maximum(total, 1e-30)[:, None]
        radiance[dark] = mean[group[dark]]
    unknown = ~radiance.any(axis=1)
    found = np.full(len(emitters), -1, np.int64)
    found[unknown] = np.unique(kind[unknown], return_inverse=True)[1]
    return found, radiance

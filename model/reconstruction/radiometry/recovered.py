# SPDX-License-Identifier: MIT
"""Estimates the radiance of sources that every photograph clips, from the surfaces that they illuminate.

At an unclipped surfel i, with the known diffuse shading E_i and the part F_ik by source k at radiance 1,

    ln L_i = ln D_g + ln (E_i + sum_k F_ik Le_k).

The model omits specular reflection, which does not follow the diffuse shading: on a dark, glossy floor it is
strongest in the shadows. The scale of residuals therefore increases with the ratio of specular to diffuse
reflection of a typical dielectric.

The albedo D_g of a region g is also unknown, so the contrast within a region, between surfels with and
without light from a source, determines Le_k. The logarithms of the sources' radiance by channel, bounded
below by the photographs, are estimated by least squares with Student's t weights and weak priors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.foundation.meshes.mesh import area_vectors
from datagen.light.background import Background
from datagen.light.bake import Baker
from datagen.light.cells import Cells
from datagen.light.emitters import Emitters
from datagen.light.radiance_field import RadianceField
from datagen.light.surfels import CELLS_ACROSS, Surfels, grouped_medians
from datagen.light.unseen_surfaces import Regions, unseen_surfaces
from model.reconstruction.radiometry.sources import Colored, Sources

if TYPE_CHECKING:
    import mitsuba as mi

MAX_POINTS, RAYS, UNSEEN_RAYS = 2500, 1152, 48
"""Maximum number of points, rays per point (noise in a source's light biases its radiance downwards), and
rays per point of unphotographed surfaces."""
DOUBT_RAYS = 144
MIN_VIEWS, MIN_PHOTOGRAPHED = 2, 0.5
"""Minimum number of views of a surfel, and minimum photographed share of its light, for the estimate."""
MAX_FACTOR = 3000.0
"""Maximum ratio of a source's estimated radiance to its photographed radiance."""
MAX_SUNLIT_FACTOR = 30.0
"""Like :data:`MAX_FACTOR`, for patches of surface, which rarely exceed it even in sunlight. A higher estimate
is rather due to a lamp that no photograph shows, so the patch keeps its photographed radiance."""
TYPICAL_SPECULAR = 0.04
"""Specular albedo of most dielectrics; its ratio to the diffuse albedo is the relative error of a purely
diffuse model."""
_SCALE = 0.15  # scale of Student's t, in ln L, without specular reflection
_FREEDOM = 2.0
_EFFECTIVE = 1000.0  # maximum number of independent points, since errors of neighbours are correlated
_ALBEDO, _ALBEDO_SPREAD = np.log(0.3), 1.2  # prior of ln D_g
_BRIGHTER, _BRIGHTER_SPREAD = np.log(5.0), 2.0  # prior of ln (Le / bound)
_HUE_SPREAD = 1.0  # spread of ln Le among channels
_NEIGHBOUR_SPREAD = 0.35  # spread of ln Le between adjacent blocks of sky
_MIN_SKY_SPREAD = 0.5  # minimum spread of ln Le of a block; clear sky varies in it by a factor of 2 to 3
_ROUNDS = 40
_STARTS = np.log(np.array([1.05, 3.0, 10.0, 30.0, 100.0, 300.0]))


@dataclass(frozen=True)
class Gathered:
    """Light at P points from S sources and from all else.

    ``radiance`` (P, 3): outgoing radiance; ``known`` (P, 3): diffuse shading without the sources; ``form``
    (P, S): diffuse shading by each source at radiance 1; ``group`` (P,): index of each point's region of
    uniform albedo; ``scale``, (P, 3) or one for all: scale of Student's t, in ln radiance.
    """

    radiance: NDArray[np.float64]
    known: NDArray[np.float64]
    form: NDArray[np.float64]
    group: NDArray[np.int64]
    scale: NDArray[np.float64] | float = _SCALE


@dataclass(frozen=True)
class Recovered:
    """The ``radiance`` (S, 3) of sources, and the standard deviation ``spread`` (S,) of its logarithm."""

    radiance: NDArray[np.float64]
    spread: NDArray[np.float64]


@dataclass(frozen=True)
class Prior:
    """Normal priors for G regions and S sources.

    ``albedo`` (G, 3): mean of ln D; ``brighter`` (S,): mean of ln (radiance / photographed lower bound) in
    all channels; ``albedo_spread`` and ``brighter_spread``: their standard deviations.
    """

    albedo: NDArray[np.float64]
    brighter: NDArray[np.float64]
    albedo_spread: float = _ALBEDO_SPREAD
    brighter_spread: NDArray[np.float64] | float = _BRIGHTER_SPREAD


class SourceField:
    """Light in a captured room for any radiance of its clipped sources."""

    def __init__(self, scene: mi.Scene, surfels: Surfels, emitters: Emitters, background: Background):
        self._scene, self.surfels = scene, surfels
        self._emitters, self._background = emitters, background
        self._area = 0.5 * np.linalg.norm(area_vectors(emitters.vertices.astype(np.float64)), axis=1)

    def colored(self, sources: Sources, radiance: NDArray) -> Colored:
        """Compute the room's radiance with ``radiance`` (S, 3) in the clipped channels of the sources."""
        return sources.colored(radiance, self._emitters, self._background, self.surfels)

    def alone(self, sources: Sources, radiance: NDArray) -> Colored:
        """Compute the room's radiance with ``radiance`` (S, 3) for the sources and 0 elsewhere."""
        whole = replace(sources, is_open=np.ones_like(sources.is_open))
        return whole.colored(
            radiance,
            replace(self._emitters, radiance=np.zeros_like(self._emitters.radiance)),
            replace(self._background, radiance=np.zeros_like(self._background.radiance)),
            replace(self.surfels, radiance=np.zeros_like(self.surfels.radiance)),
        )

    def baker(self, colored: Colored) -> Baker:
        """Make a :class:`Baker` for the room with the radiance ``colored``."""
        grid, emitters = self.surfels.grid, self._emitters
        power = self._area * (colored.emitters @ LUMINANCE_WEIGHTS)[emitters.of_face[emitters.triangles]]
        shining = replace(emitters, radiance=colored.emitters, power=power.astype(np.float32))
        background = replace(self._background, radiance=colored.background)
        photographed = np.ones(len(self.surfels), dtype=bool)
        cells = Cells(grid.surfel, grid.low, grid.cell_m, grid.shape, colored.surfels, photographed)
        field = RadianceField(self._scene, cells, shining, background)
        return Baker(field, grid.cell_m * CELLS_ACROSS)

    def form_factors(self, sources: Sources, position_m: NDArray, normal: NDArray) -> NDArray[np.float64]:
        """Compute the diffuse shading (P, S) at positions and normals (P, 3) by each source at radiance 1."""
        form = np.zeros((len(position_m), len(sources)))
        for first in range(0, len(sources), 3):  # three sources at a time, one per channel
            hues = np.zeros((len(sources), 3))
            last = min(first + 3, len(sources))
            hues[np.arange(first, last), np.arange(last - first)] = 1.0
            part = self.baker(self.alone(sources, hues)).irradiance(position_m, normal, RAYS).diffuse
            form[:, first:last] = part[:, : last - first]
        return form


class Gatherer:
    """Light at up to :data:`MAX_POINTS` clearly visible surfels from each source and from all else.

    The points' groups are their smooth ``regions``.
    """

    def __init__(self, field: SourceField, sources: Sources, regions: Regions):
        self._field, self._sources, self._regions = field, sources, regions
        surfels = field.surfels
        clear = np.bincount(surfels.surfel_of_observation(), surfels.observations.weight >= 0.5, len(surfels))
        clear[(surfels.radiance <= 0).any(axis=1)] = 0
        usable = np.flatnonzero((sources.of_surfel < 0) & (clear >= MIN_VIEWS))
        self._chosen = np.sort(np.random.default_rng(0).permutation(usable)[:MAX_POINTS])
        self._place = surfels.position_m[self._chosen], surfels.normal[self._chosen]
        self._form = field.form_factors(sources, *self._place)
        self._dark = field.baker(field.colored(sources, np.zeros_like(sources.bound)))

    def gathered(self, radiance: NDArray) -> Gathered:
        """Compute the light, with unphotographed surfaces illuminated by sources of ``radiance`` (S, 3)."""
        surfels, chosen, dark = self._field.surfels, self._chosen, self._dark
        lit = self._field.baker(self._field.colored(self._sources, radiance))
        unseen = unseen_surfaces(lit, surfels, self._regions, UNSEEN_RAYS)
        rest = Baker(unseen.added_to(dark.field, surfels), dark.size_m).irradiance(*self._place, RAYS)
        kept = rest.photographed >= MIN_PHOTOGRAPHED
        leaving = surfels.radiance[chosen[kept]].astype(np.float64)
        known, form = rest.extrapolated()[kept].astype(np.float64), self._form[kept]
        group = np.unique(self._regions.of_face[surfels.face[chosen[kept]]], return_inverse=True)[1]
        reflectance = leaving / np.maximum(known + form @ radiance, 1e-12)
        ones = np.ones(len(group), np.float32)
        albedo = grouped_medians(reflectance, ones, group, int(group.max(initial=-1)) + 1)[group]
        scale = np.hypot(_SCALE, TYPICAL_SPECULAR / np.maximum(albedo, 1e-3))
        return Gathered(leaving, known, form, group, scale)


def doubt_of(
    field: SourceField, sources: Sources, found: Recovered
) -> Callable[[NDArray, NDArray], NDArray[np.float32]]:
    """Make a function from positions and normals (N, 3) to the uncertainty (N,) of the luminance of diffuse
    shading: the sum over sources of the shading by a source times the standard deviation of its ln radiance,
    clamped to 1.
    """
    baker = field.baker(field.alone(sources, found.radiance * np.minimum(found.spread, 1)[:, None]))
    return lambda position_m, normal: (
        baker.irradiance(position_m, normal, DOUBT_RAYS).diffuse @ LUMINANCE_WEIGHTS
    )


def recovered(gathered: Gathered, sources: Sources, prior: Prior | None = None) -> Recovered:
    """Estimate the radiance of the sources in clipped channels; in other channels, it is as photographed."""
    if prior is None:
        num_groups = int(gathered.group.max(initial=-1)) + 1
        prior = Prior(np.full((num_groups, 3), _ALBEDO), np.full(len(sources), _BRIGHTER))
    bound = np.maximum(sources.bound, 1e-6 * max(float(sources.bound.max(initial=0)), 1e-12))
    patches = np.unique(sources.of_surfel[sources.of_surfel >= 0])
    is_open = sources.is_open.copy()
    implausible = patches[:0]
    while True:
        is_open[implausible] = False
        fitted = [_fitted(gathered, replace(sources, is_open=is_open), bound, prior, s) for s in _STARTS]
        _, factor, spread = min(fitted, key=lambda found: found[0])
        implausible = patches[factor[patches].max(axis=1, initial=0) > np.log(MAX_SUNLIT_FACTOR)]
        if not len(implausible):
            break
    of_sky = np.unique(sources.neighbours)
    spread[of_sky] = np.maximum(spread[of_sky], _MIN_SKY_SPREAD)
    return Recovered(np.where(is_open, bound * np.exp(factor), sources.bound), spread)


def _fitted(
    gathered: Gathered, sources: Sources, bound: NDArray, prior: Prior, start: float
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Compute the cost, ln (radiance / bound) (S, 3) and its standard deviation (S,) by damped Gauss-Newton
    steps from the value ``start``.
    """
    num = len(sources)
    is_open = sources.is_open
    factor = np.where(is_open, start, 0.0)
    damping = 1e-2
    cost, gradient, hessian = _derivatives(gathered, sources, bound, factor, prior)
    for _ in range(_ROUNDS):
        step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient).reshape(3, num).T
        tried = np.where(is_open, np.clip(factor - np.clip(step, -1, 1), 0.0, np.log(MAX_FACTOR)), 0.0)
        found = _derivatives(gathered, sources, bound, tried, prior)
        if found[0] < cost:
            settled = cost - found[0] < 1e-6 * cost
            factor, (cost, gradient, hessian) = tried, found
            damping = max(0.3 * damping, 1e-6)
            if settled:
                break
        else:
            damping *= 4
            if damping > 1e6:
                break
    variance = np.diag(np.linalg.inv(hessian)).reshape(3, num).T
    variance = np.where(is_open, variance, 0.0).max(axis=1)
    return cost, factor, np.sqrt(variance)


def _derivatives(
    gathered: Gathered, sources: Sources, bound: NDArray, factor: NDArray, prior: Prior
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Compute the cost at the best albedos, and its gradient (3 S,) and Hessian (3 S, 3 S) in ``factor``."""
    num, points, count = len(factor), max(len(gathered.group), 1), len(prior.albedo)
    is_open = sources.is_open
    brighter, brighter_spread = prior.brighter[:, None], np.reshape(prior.brighter_spread, (-1, 1))
    radiance = bound * np.exp(factor)
    unit = min(1.0, _EFFECTIVE / points)
    cost, gradient, hessian = 0.0, np.zeros(3 * num), np.zeros((3 * num, 3 * num))
    scales = np.broadcast_to(gathered.scale, (len(gathered.group), 3))
    for channel in range(3):
        scale = scales[:, channel]
        opened = is_open[:, channel]
        parts = gathered.form * np.where(opened, radiance[:, channel], 0.0)
        light = np.maximum(gathered.known[:, channel] + parts.sum(axis=1), 1e-12)
        wanted = np.log(gathered.radiance[:, channel]) - np.log(light)
        expected = prior.albedo[:, channel]
        albedo = expected
        for _ in range(4):
            rest = wanted - albedo[gathered.group]
            weight = unit * (_FREEDOM + 1) / (_FREEDOM + (rest / scale) ** 2) / scale**2
            total = np.bincount(gathered.group, weight, count) + 1 / prior.albedo_spread**2
            albedo = np.bincount(gathered.group, weight * wanted, count) + expected / prior.albedo_spread**2
            albedo = np.minimum(albedo / total, np.log(0.95))
        rest = wanted - albedo[gathered.group]
        cost += unit * 0.5 * (_FREEDOM + 1) * float(np.log1p((rest / scale) ** 2 / _FREEDOM).sum())
        cost += 0.5 * float((((albedo - expected) / prior.albedo_spread) ** 2).sum())
        slope = -parts / light[:, None]
        of_group = np.stack(
            [np.bincount(gathered.group, weight * column, count) for column in slope.T], axis=1
        )
        of_group = of_group.reshape(count, num)
        rows = slice(channel * num, (channel + 1) * num)
        hessian[rows, rows] += slope.T @ (weight[:, None] * slope) - of_group.T @ (of_group / total[:, None])
        gradient[rows] += slope.T @ (weight * rest)
    first, second = sources.neighbours.T
    link = np.zeros((len(first), num))
    link[np.arange(len(first)), first], link[np.arange(len(first)), second] = 1, -1
    steps = link @ np.log(radiance)
    cost += 0.5 * float(((steps / _NEIGHBOUR_SPREAD) ** 2).sum())
    gradient += (link.T @ steps).T.ravel() / _NEIGHBOUR_SPREAD**2
    hessian += np.kron(np.eye(3), link.T @ link) / _NEIGHBOUR_SPREAD**2
    hue = np.log(radiance) - np.log(radiance).mean(axis=1, keepdims=True)
    away = np.where(is_open, (factor - brighter) / brighter_spread, 0.0)
    cost += 0.5 * float((away**2).sum())
    cost += 0.5 * float(((hue / _HUE_SPREAD) ** 2).sum())
    gradient += (away / brighter_spread + np.where(is_open, hue, 0.0) / _HUE_SPREAD**2).T.ravel()
    own = np.tile(np.arange(num), 3)
    same = (own[:, None] == own[None]).astype(np.float64)
    hessian += (np.eye(3 * num) - same / 3) / _HUE_SPREAD**2
    hessian += np.diag(np.where(is_open, 1 / brighter_spread**2, 1e6).T.ravel())
    return cost, gradient, hessian

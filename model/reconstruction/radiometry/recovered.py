# SPDX-License-Identifier: MIT
"""Radiance of sources that clip in every photograph, from the surfaces that they illuminate.

At a surfel i below the limit, with the known light E_i and the contribution F_ik of source k at radiance 1,

    ln L_i = ln D_g + ln (E_i + sum_k F_ik Le_k),

where the albedo D_g of a region is unknown, too: the contrast within a region, between surfels that a source
does and does not illuminate, determines Le. The unknowns are the logarithms of each source's colour, bounded
below by the photographs, by least squares with Student's t weights and weak priors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.geometry.traced import TracedGeometry
from datagen.light.background import Background
from datagen.light.bake import Baker
from datagen.light.emitters import Emitters
from datagen.light.lighting import MIN_KNOWN
from datagen.light.radiance_field import Cells, RadianceField
from datagen.light.surfels import CELLS_ACROSS, Surfels
from model.reconstruction.radiometry.sources import Colored, Sources

MAX_POINTS, RAYS = 2500, 576
"""Points that serve, and rays of each: noise of what a source lights would make it look too dim."""
DOUBT_RAYS = 64
MIN_VIEWS, MIN_PHOTOGRAPHED = 2, 0.5
"""Views of a surfel that serves, and the part of its light that photographs must show."""
MAX_FACTOR = 3000.0
"""Of the radiance that photographs show."""
_SCALE = 0.15  # of Student's t, in ln L
_FREEDOM = 2.0
_EFFECTIVE = 1000.0  # independent points that all together count as: errors of neighbours are alike
_ALBEDO, _ALBEDO_SPREAD = np.log(0.4), 0.8  # prior of ln D_g
_BRIGHTER, _BRIGHTER_SPREAD = np.log(5.0), 2.0  # prior of ln (Le / bound)
_HUE_SPREAD = 1.0  # of ln Le among channels
_ROUNDS = 40
_STARTS = np.log(np.array([1.05, 3.0, 10.0, 30.0, 100.0, 300.0]))


@dataclass(frozen=True)
class Gathered:
    """Of P points: ``radiance`` (P, 3), light ``known`` (P, 3) beside the sources', ``form`` (P, S) the
    contribution of a source of radiance 1, and the ``group`` (P,) of equal albedo."""

    radiance: NDArray[np.float64]
    known: NDArray[np.float64]
    form: NDArray[np.float64]
    group: NDArray[np.int64]


@dataclass(frozen=True)
class Recovered:
    """``radiance`` (S, 3) of the sources and the standard deviation ``spread`` (S,) of its logarithm."""

    radiance: NDArray[np.float64]
    spread: NDArray[np.float64]


class _Field:
    """The radiance field of a room with substituted colours."""

    def __init__(self, traced: TracedGeometry, surfels: Surfels, emitters: Emitters, background: Background):
        self._traced, self._surfels = traced, surfels
        self._emitters, self._background = emitters, background
        corners = emitters.vertices.astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._area = 0.5 * np.linalg.norm(cross, axis=1)

    def alone(self, sources: Sources, radiance: NDArray) -> Colored:
        """The ``radiance`` (S, 3) of the sources, and nothing else."""
        whole = replace(sources, is_open=np.ones_like(sources.is_open))
        return whole.colored(
            radiance,
            replace(self._emitters, radiance=np.zeros_like(self._emitters.radiance)),
            replace(self._background, radiance=np.zeros_like(self._background.radiance)),
            replace(self._surfels, radiance=np.zeros_like(self._surfels.radiance)),
        )

    def baker(self, colored: Colored) -> Baker:
        grid, emitters = self._surfels.grid, self._emitters
        power = self._area * (colored.emitters @ LUMINANCE_WEIGHTS)[emitters.of_face[emitters.triangles]]
        shining = replace(emitters, radiance=colored.emitters, power=power.astype(np.float32))
        background = replace(self._background, radiance=colored.background)
        photographed = np.ones(len(self._surfels), dtype=bool)
        cells = Cells(grid.surfel, grid.low, grid.cell_m, grid.shape, colored.surfels, photographed)
        field = RadianceField(self._traced.scene, self._surfels, shining, background, cells)
        return Baker(field, grid.cell_m * CELLS_ACROSS)


def gather(
    traced: TracedGeometry,
    surfels: Surfels,
    emitters: Emitters,
    background: Background,
    sources: Sources,
    region_of_face: NDArray[np.int32],
) -> Gathered:
    """Irradiance of the surfels from the sources."""
    field = _Field(traced, surfels, emitters, background)
    clear = np.bincount(surfels.surfel_of_observation(), surfels.observations.weight >= 0.5, len(surfels))
    usable = np.flatnonzero((sources.of_surfel < 0) & (clear >= MIN_VIEWS))
    chosen = np.sort(np.random.default_rng(0).permutation(usable)[:MAX_POINTS])
    position, normal = surfels.position_m[chosen], surfels.normal[chosen]
    dark = sources.colored(np.zeros_like(sources.bound), emitters, background, surfels)
    lit = field.baker(dark).irradiance(position, normal, RAYS)
    share = np.maximum(lit.known, MIN_KNOWN)[:, None]
    form = np.zeros((len(chosen), len(sources)))
    for first in range(0, len(sources), 3):  # three sources at a time, one in each channel
        hues = np.zeros((len(sources), 3))
        last = min(first + 3, len(sources))
        hues[np.arange(first, last), np.arange(last - first)] = 1.0
        part = field.baker(field.alone(sources, hues)).irradiance(position, normal, RAYS).diffuse / share
        form[:, first:last] = part[:, : last - first]
    kept = lit.photographed >= MIN_PHOTOGRAPHED
    kept &= (surfels.radiance[chosen] > 0).all(axis=1)
    return Gathered(
        surfels.radiance[chosen][kept].astype(np.float64),
        (lit.diffuse / share)[kept].astype(np.float64),
        form[kept],
        np.unique(region_of_face[surfels.face[chosen[kept]]], return_inverse=True)[1],
    )


def doubt_of(
    traced: TracedGeometry,
    surfels: Surfels,
    emitters: Emitters,
    background: Background,
    sources: Sources,
    found: Recovered,
) -> Callable[[NDArray, NDArray], NDArray[np.float32]]:
    """Uncertain luminance (N,) of the diffuse shading at positions and normals (N, 3): the part from sources
    of uncertain radiance, weighted by the uncertainty."""
    field = _Field(traced, surfels, emitters, background)
    baker = field.baker(field.alone(sources, found.radiance * np.minimum(found.spread, 1)[:, None]))
    return lambda position_m, normal: (
        baker.irradiance(position_m, normal, DOUBT_RAYS).diffuse @ LUMINANCE_WEIGHTS
    )


def recovered(gathered: Gathered, sources: Sources) -> Recovered:
    """Radiance of the sources; in channels below the limit, that of the photographs."""
    bound = np.maximum(sources.bound, 1e-6 * max(float(sources.bound.max(initial=0)), 1e-12))
    fitted = [_fitted(gathered, sources, bound, start) for start in _STARTS]
    _, factor, spread = min(fitted, key=lambda found: found[0])
    return Recovered(np.where(sources.is_open, bound * np.exp(factor), sources.bound), spread)


def _fitted(
    gathered: Gathered, sources: Sources, bound: NDArray, start: float
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Cost, ln (Le / bound) (S, 3) and its spread (S,), from ``start`` on, by Gauss-Newton with damping."""
    num, count = len(sources), int(gathered.group.max(initial=-1)) + 1
    is_open = sources.is_open
    factor = np.where(is_open, start, 0.0)
    damping = 1e-2
    cost, gradient, hessian = _derivatives(gathered, is_open, bound, factor, count)
    for _ in range(_ROUNDS):
        step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient).reshape(3, num).T
        tried = np.where(is_open, np.clip(factor - np.clip(step, -1, 1), 0.0, np.log(MAX_FACTOR)), 0.0)
        found = _derivatives(gathered, is_open, bound, tried, count)
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
    gathered: Gathered, is_open: NDArray, bound: NDArray, factor: NDArray, count: int
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Cost, gradient (3 S,) and Hessian (3 S, 3 S) by channel and source, the regions' albedo eliminated."""
    num, points = len(factor), max(len(gathered.group), 1)
    radiance = bound * np.exp(factor)
    unit = min(1.0, _EFFECTIVE / points)
    cost, gradient, hessian = 0.0, np.zeros(3 * num), np.zeros((3 * num, 3 * num))
    for channel in range(3):
        opened = is_open[:, channel]
        parts = gathered.form * np.where(opened, radiance[:, channel], 0.0)
        light = np.maximum(gathered.known[:, channel] + parts.sum(axis=1), 1e-12)
        wanted = np.log(gathered.radiance[:, channel]) - np.log(light)
        albedo = np.full(count, _ALBEDO)
        for _ in range(4):
            rest = wanted - albedo[gathered.group]
            weight = unit * (_FREEDOM + 1) / (_FREEDOM + (rest / _SCALE) ** 2) / _SCALE**2
            total = np.bincount(gathered.group, weight, count) + 1 / _ALBEDO_SPREAD**2
            albedo = np.bincount(gathered.group, weight * wanted, count) + _ALBEDO / _ALBEDO_SPREAD**2
            albedo = np.minimum(albedo / total, np.log(0.95))
        rest = wanted - albedo[gathered.group]
        cost += unit * 0.5 * (_FREEDOM + 1) * float(np.log1p((rest / _SCALE) ** 2 / _FREEDOM).sum())
        cost += 0.5 * float((((albedo - _ALBEDO) / _ALBEDO_SPREAD) ** 2).sum())
        slope = -parts / light[:, None]
        of_group = np.stack(
            [np.bincount(gathered.group, weight * column, count) for column in slope.T], axis=1
        )
        of_group = of_group.reshape(count, num)
        rows = slice(channel * num, (channel + 1) * num)
        hessian[rows, rows] += slope.T @ (weight[:, None] * slope) - of_group.T @ (of_group / total[:, None])
        gradient[rows] += slope.T @ (weight * rest)
    hue = np.log(radiance) - np.log(radiance).mean(axis=1, keepdims=True)
    cost += 0.5 * float((((factor - _BRIGHTER) / _BRIGHTER_SPREAD) ** 2)[is_open].sum())
    cost += 0.5 * float(((hue / _HUE_SPREAD) ** 2).sum())
    brighter = np.where(is_open, (factor - _BRIGHTER) / _BRIGHTER_SPREAD**2, 0.0)
    gradient += (brighter + np.where(is_open, hue, 0.0) / _HUE_SPREAD**2).T.ravel()
    own = np.tile(np.arange(num), 3)
    same = (own[:, None] == own[None]).astype(np.float64)
    hessian += (np.eye(3 * num) - same / 3) / _HUE_SPREAD**2
    hessian += np.diag(np.where(is_open.T.ravel(), 1 / _BRIGHTER_SPREAD**2, 1e6))
    return cost, gradient, hessian

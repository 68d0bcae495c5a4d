# SPDX-License-Identifier: MIT
"""Computes material maps of views from solved surfels: texture from the photographs, scale from the light.

Shading and materials of the surfels around a pixel are interpolated between cell centres. With the pixel's
radiance L, its diffuse shading Ld and its specular part in the same view,

    D = (L - specular part) / ((1 - S) Ld),

clipped to [0, MAX_ALBEDO] or, in uncertain light, to the albedo of the room's white paint. S and R are those
of nearby surfels of similar reflectance, blended with the network's by confidence. S of rough metals is that
of the nearby surfels times L / (their radiance in the view), which adds the detail of the photograph. The
network's D is limited to the maximum that the recorded light permits.

Errors of cameras and mesh move the edges of sunlight by centimetres, which turns them into stripes of wrong
albedo, and clipped pixels contain no texture: materials there are replaced by those around them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.foundation.buffers import MATERIAL_MAPS, split_channels
from datagen.foundation.color import luminance
from datagen.geometry.views import TracedView
from datagen.light.bake import SpecularShading
from datagen.light.lighting import MIN_SHADING, Lit
from datagen.light.surfels import (
    NUM_SIDES,
    Surfels,
    camera_row,
    cell_of,
    grouped_medians,
    near_surfels,
    place_pixel,
    surfel_means,
    surfels_around,
)
from datagen.multiview.compiled import compiled
from model.reconstruction.light.points import UNSEEN_WEIGHT
from model.reconstruction.light.solve import MAX_ALBEDO

SHARP, BLURRED = 0.2, 0.3
"""Range of roughness over which S of a metal surfel changes from that of its segment to that of its own
observations; the grid's cells do not resolve sharp reflections."""
SEGMENT_VIEWS = 2.0
"""Weight of the segment's S, as a number of observations of the surfel."""
TYPICAL_WHITE = 0.85
"""Albedo of white paint where none is known; in the development rooms it is 0.78 to 1."""
MIN_WHITE, MAX_CHROMA = 0.7, 0.12
"""Minimum albedo of white paint, averaged over channels, and maximum difference between its channels."""
HALF_SUPPORT = 300.0
"""Number of confident surfels near the most frequent white at which it weighs as much as the typical one."""
_STEP, _BANDWIDTH, _REACH = 0.005, 0.015, 0.04  # histogram: bin width, smoothing, reach of the mode
SIMILAR = 0.35
"""Difference in ln reflectance from the pixel at which a surfel's S and R are weighted by exp(-1/2)."""
MAX_EXCESS = 1.5
"""Maximum of the network's D relative to its physical limit, the ratio of radiance to diffuse shading; the
margin allows for errors of shading."""
_DARK = 1e-12  # avoids 0 / 0 in the reflectance of a room without light
EDGE_NEIGHBOURS, EDGE_RANGE = 25, 0.1
"""Number of neighbours of a surfel, and range of the visible share of the sun's disk among them above which
the surfel is at an edge of sunlight."""
NUM_AVERAGED, MAX_DISTANCE_CELLS = 16, 20
"""Number of surrounding surfels that are averaged, and maximum distance to the nearest in cells."""
NORMAL_SCALE_CELLS = 16
"""Distance in cells that counts like a difference of 1 between two normals."""


def textured_specular_albedo(
    surfels: Surfels,
    specular_albedo: NDArray[np.float32],
    roughness: NDArray[np.float32],
    is_metal: NDArray[np.bool_],
    shading: SpecularShading,
) -> NDArray[np.float32]:
    """Compute S (N, 3) of the surfels: for rough metals mainly the median of (radiance - ls1) / ls0 over
    observations, for all others S of the segment.

    ``specular_albedo`` (N, 3), ``roughness`` (N,) and ``is_metal`` (N,) are those of the surfels' segments;
    ``shading`` has the terms of all M observations, extrapolated from known to all light.
    """
    observations = surfels.observations
    owner = surfels.surfel_of_observation()
    rows = np.flatnonzero(is_metal[owner])
    num = np.bincount(owner[rows], minlength=len(surfels))
    ratio = (observations.radiance[rows] - shading.ls1[rows]) / np.maximum(shading.ls0[rows], 1e-9)
    weight = observations.weight[rows] * (UNSEEN_WEIGHT + shading.photographed[rows])
    medians = grouped_medians(ratio, weight, owner[rows], len(surfels))
    blurred = np.clip((roughness - SHARP) / (BLURRED - SHARP), 0, 1)
    share = (blurred * num / (num + SEGMENT_VIEWS))[:, None]
    textured = share * np.clip(medians, 0, 1) + (1 - share) * specular_albedo
    return np.where(is_metal[:, None], textured, specular_albedo).astype(np.float32)


class White(NamedTuple):
    """``albedo`` of white paint: a mean of surfels, of weight ``known`` in [0, 1], and the typical white."""

    albedo: float = TYPICAL_WHITE
    known: float = 0.0


def white_paint(albedo: NDArray, confidence: NDArray) -> White:
    """Compute the mode of the ``albedo`` (N, 3) of bright grey surfels, weighted by ``confidence`` (N,) and
    shrunk to :data:`TYPICAL_WHITE`.
    """
    mean = np.minimum(albedo.mean(axis=1), MAX_ALBEDO)
    is_white = (mean >= MIN_WHITE) & (np.ptp(albedo, axis=1) <= MAX_CHROMA)
    edges = np.arange(MIN_WHITE, MAX_ALBEDO + 1.5 * _STEP, _STEP)
    centres = 0.5 * (edges[1:] + edges[:-1])
    num = np.histogram(mean[is_white], edges, weights=confidence[is_white])[0]
    distance = np.abs(centres[:, None] - centres)
    mode = int((np.exp(-0.5 * (distance / _BANDWIDTH) ** 2) @ num).argmax())
    support = float(num[distance[mode] < _REACH].sum())
    known = support / (support + HALF_SUPPORT)
    return White(known * float(centres[mode]) + (1 - known) * TYPICAL_WHITE, known)


@dataclass(frozen=True)
class SolvedSurfels:
    """Shading and materials of N surfels with M observations.

    ``diffuse`` (N, 3): diffuse shading; ``specular`` (M, 3): specular part of the radiance of each
    observation; ``specular_albedo`` (N, 3); ``roughness`` (N,); ``is_metal`` (N,); ``confidence`` (N, 3) of
    D, S and R in [0, 1]; ``replaced`` (N,): weight of D from light against the network's; ``prior_scale`` (N,
    3): factor of the network's D; ``white``: upper bound of D in uncertain light.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    specular_albedo: NDArray[np.float32]
    roughness: NDArray[np.float32]
    is_metal: NDArray[np.bool_]
    confidence: NDArray[np.float32]
    replaced: NDArray[np.float32]
    prior_scale: NDArray[np.float32]
    white: White


def packed_maps(view_maps: dict[str, NDArray]) -> NDArray:
    """Concatenate D, S and R of a view to (H, W, 7)."""
    return np.concatenate([view_maps[name] for name in MATERIAL_MAPS], axis=2)


def view_materials(
    surfels: Surfels, solved: SolvedSurfels, index: int, view: TracedView, predicted: dict[str, NDArray]
) -> dict[str, NDArray[np.float16]]:
    """Compute D, S, R and ``confidence`` (H, W, 3) of view number ``index``, by map name.

    Pixels without a surfel retain the network's maps ``predicted`` and have confidence 0.
    """
    observations = surfels.observations
    rows = np.flatnonzero(observations.view == index)
    surfel = surfels.surfel_of_observation()[rows]
    row_of = np.full(len(surfels), -1, np.int64)
    row_of[surfel] = rows
    height, width = view.color.shape[:2]
    prior = packed_maps(predicted).reshape(height * width, -1)
    floor = max(MIN_SHADING * float(np.median(solved.diffuse)), _DARK)
    packed = _pixels(
        np.ascontiguousarray(view.color.reshape(-1, 3), np.float32),
        view.geometry.depth_z_m.ravel(),
        np.ascontiguousarray(view.geometry.normal_world.reshape(-1, 3)),
        surfels.pixel_surfel[index],
        camera_row(view),
        surfels.grid.low,
        surfels.grid.cell_m,
        surfels.grid.shape,
        surfels.grid.surfel,
        row_of,
        observations.radiance,
        solved.diffuse,
        solved.specular,
        solved.specular_albedo,
        solved.roughness,
        solved.is_metal,
        solved.confidence,
        solved.replaced,
        solved.prior_scale,
        surfels.radiance,
        prior.astype(np.float32),
        np.float32(floor),
        np.float32(solved.white.albedo),
        np.float32(solved.white.known),
    ).reshape(height, width, -1)
    maps, confidence = np.split(packed, [-len(MATERIAL_MAPS)], axis=2)
    found = {**split_channels(maps, MATERIAL_MAPS), "confidence": confidence}
    return {name: values.astype(np.float16) for name, values in found.items()}


@compiled
def _pixels(
    color, depth, normal, own, camera, low, cell_m, shape, surfel, row_of, observed, diffuse, specular,
    albedo, rough, metal, confidence, replaced, prior_scale, radiance, prior, floor, white, white_known
):  # fmt: skip
    """Compute D, S, R and their confidence (P, 10) for the P pixels of a view."""
    out = np.zeros((len(color), 10), np.float32)
    width = int(camera[16])
    here = np.zeros(3)
    near = np.zeros(8, np.int64)
    share = np.zeros(8, np.float32)
    ld, spec, s = np.zeros(3, np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32)
    scale, s_around, l_around = np.zeros(3, np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32)
    for index in range(len(color)):
        for k in range(7):
            out[index, k] = prior[index, k]
        if own[index] < 0:
            continue
        place_pixel(index, depth[index], width, camera, here)
        cell = cell_of(here, normal[index], low, cell_m, shape)
        num = surfels_around(here, cell % NUM_SIDES, low, cell_m, shape, surfel, near, share)
        total = np.float32(0)
        total_spec = np.float32(0)
        conf = np.zeros(3, np.float32)
        of_light = np.float32(0)
        ld[:], spec[:], scale[:], s_around[:], l_around[:] = 0, 0, 0, 0, 0
        for k in range(num):
            i, w = near[k], share[k]
            total += w
            of_light += w * replaced[i]
            for c in range(3):
                ld[c] += w * diffuse[i, c]
                scale[c] += w * prior_scale[i, c]
                conf[c] += w * confidence[i, c]
            row = row_of[i]
            if row >= 0:
                total_spec += w
                for c in range(3):
                    spec[c] += w * specular[row, c]
                    s_around[c] += w * albedo[i, c]
                    l_around[c] += w * observed[row, c]
        of_light /= total
        for c in range(3):
            ld[c] = max(ld[c] / total, floor)
            conf[c] /= total
            spec[c] /= max(total_spec, np.float32(1e-12))
        max_albedo = white + conf[0] * (np.float32(MAX_ALBEDO) - white)
        s[:] = 0
        r, is_metal, total_like = np.float32(0), np.float32(0), np.float32(0)
        for k in range(num):
            i = near[k]
            distance2 = np.float32(0)
            for c in range(3):
                d = np.log(
                    (color[index, c] / ld[c] + np.float32(0.02))
                    / (radiance[i, c] / max(diffuse[i, c], floor) + np.float32(0.02))
                )
                distance2 += d * d
            w = share[k] * (np.exp(np.float32(-0.5 / SIMILAR**2) * distance2 / 3) + np.float32(1e-4))
            total_like += w
            r += w * rough[i]
            is_metal += w * metal[i]
            for c in range(3):
                s[c] += w * albedo[i, c]
        r /= total_like
        is_metal /= total_like
        blurred = min(
            max((r - np.float32(SHARP)) / np.float32(BLURRED - SHARP), np.float32(0)), np.float32(1)
        )
        for c in range(3):
            s[c] /= total_like
            d = (color[index, c] - spec[c]) / (max(1 - s[c], np.float32(0.05)) * ld[c])
            d = min(max(d, np.float32(0)), max_albedo) * (1 - is_metal)
            network = prior[index, c]
            scaled = min(network * scale[c] / total, white + (1 - white_known) * max(network - white, 0))
            scaled = min(scaled, np.float32(MAX_EXCESS) * color[index, c] / ld[c])
            out[index, c] = of_light * d + (1 - of_light) * scaled
            if l_around[c] > 0:
                of_pixel = min(s_around[c] * color[index, c] / l_around[c], np.float32(1))
                s[c] += is_metal * blurred * (of_pixel - s[c])
            out[index, 3 + c] = conf[1] * s[c] + (1 - conf[1]) * prior[index, 3 + c]
            out[index, 7 + c] = conf[c]
        out[index, 6] = conf[2] * r + (1 - conf[2]) * prior[index, 6]
    return out


def without_sunlit_edges(
    maps: Sequence[dict[str, NDArray]], lit: Lit, region: NDArray, is_clipped: NDArray[np.bool_]
) -> list[dict[str, NDArray]]:
    """Replace D, S and R at edges of sunlight by those around them in the same smooth ``region`` (N,).

    ``is_clipped`` (N,): mask of surfels whose radiance is a lower bound; they are replaced too if sunlit.
    """
    surfels = lit.surfels
    is_replaced = _at_edge(lit) | (is_clipped & (lit.sunlight.max(axis=1) > 0))
    means = surfel_means(surfels, [packed_maps(view_maps) for view_maps in maps])
    place = np.column_stack([surfels.position_m, surfels.normal * surfels.grid.cell_m * NORMAL_SCALE_CELLS])
    far = 10 * float(np.ptp(place, axis=0).max()) + 1.0
    place = np.column_stack([place, far * np.unique(region, return_inverse=True)[1]])
    rows, others = np.flatnonzero(is_replaced), np.flatnonzero(~is_replaced)
    if not len(rows) or not len(others):
        return list(maps)
    distance, index = cKDTree(place[others]).query(place[rows], k=np.arange(NUM_AVERAGED) + 1, workers=-1)
    is_near = distance[:, 0] <= MAX_DISTANCE_CELLS * surfels.grid.cell_m
    rows, distance, index = rows[is_near], distance[is_near], index[is_near]
    weight = np.where(distance < far, 1 / np.maximum(distance, surfels.grid.cell_m) ** 2, 0)
    weight /= weight.sum(axis=1, keepdims=True)
    filled = np.full((len(surfels), means.shape[1]), np.nan, np.float32)
    around = others[np.minimum(index, len(others) - 1)]
    filled[rows] = np.einsum("nk,nkc->nc", weight, means[around])
    return [
        _filled(view_maps, filled, surfel)
        for view_maps, surfel in zip(maps, surfels.pixel_surfel, strict=True)
    ]


def _at_edge(lit: Lit) -> NDArray[np.bool_]:
    """Compute the mask (N,) of surfels at edges of sunlight."""
    assert lit.sun is not None
    facing = np.maximum(lit.surfels.normal @ lit.sun.direction, 0.1) * luminance(lit.sun.radiance)
    share = luminance(lit.sunlight) / facing
    of_neighbours = share[near_surfels(lit.surfels, EDGE_NEIGHBOURS)[1]]
    return np.asarray(np.ptp(of_neighbours, axis=1) > EDGE_RANGE, bool)


def _filled(view_maps: dict[str, NDArray], filled: NDArray, surfel: NDArray) -> dict[str, NDArray]:
    values = np.where(surfel[:, None] >= 0, filled[surfel], np.nan)
    packed = packed_maps(view_maps)
    values = values.reshape(packed.shape)
    packed = np.where(np.isnan(values), packed, values).astype(np.float16)
    return {**view_maps, **split_channels(packed, MATERIAL_MAPS)}

# SPDX-License-Identifier: MIT
"""Finds lamps for export: emissive surfaces, and *panels*, lamps that the geometry does not declare.

Each emissive part of the geometry is a lamp, and so is every other smooth region that was found to emit.

Surfels of panels have several times the maximum radiance that they could reflect, in nearly all views (a
mirror reflects a lamp in some views only), and several times the radiance of the surrounding surface (the
light of a hidden lamp decreases gradually). Adjacent surfels with normals nearest to the same axis are
clustered and exported as rectangles perpendicular to it, just in front of the surface, since the triangles of
a ceiling extend beyond its lamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from datagen.formats.capture import GeometryPart
from datagen.foundation.color import luminance
from datagen.foundation.meshes.mesh import Mesh
from datagen.light.bright_guide import adjacent_cells, apart_by_side
from datagen.light.cells import cell_indices
from datagen.light.emitters import Emitters
from datagen.light.lighting import Lit
from model.reconstruction.found_lights import FoundLamp, FoundPatch, Rectangle, as_color
from model.reconstruction.light.rectangles import cover, cut

EXCESS = 2.5
"""Minimum radiance of a lamp relative to that of a white surface in the same light."""
FAINTEST, MIN_VIEWS = 0.2, 3
"""Share of the views in which a lamp may be fainter than that, and minimum number of views that show it."""
MIN_PHOTOGRAPHED = 0.5
"""Minimum photographed share of a surfel's hemisphere; its irradiance may lack the light of hidden lamps."""
MIN_CELLS, MIN_SHARE = 4, 0.003
"""Minimum number of cells of a lamp, and its minimum share of the radiant power of all surfels."""
MAX_BLOCK = 16
"""Maximum width and height of a rectangle in cells."""
MIN_EDGE, RING_CELLS = EXCESS, (1.5, 3.5)
"""Minimum radiance of a lamp relative to the surfels in a ring around it, and radii of the ring in cells. In
the smooth light of a hidden lamp, the ratio is up to 2.4."""
_GAP = 0.25  # cells between the surface and its rectangle


def found_lamps(emitters: Emitters, mesh: Mesh, parts: Sequence[GeometryPart]) -> tuple[FoundLamp, ...]:
    """Convert emissive ``parts`` to lamps ``lamp-0``, ..., and other emitting regions to ``found-0``, ...

    A part's radiance is the area-weighted mean over its triangles that emit from their front.
    """
    areas = mesh.areas()
    shown = np.zeros((len(mesh.faces), 3))
    lit = emitters.of_face >= 0
    shown[lit] = emitters.radiance[emitters.of_face[lit]]
    lamps: list[FoundLamp] = []
    free = lit.copy()
    for part in parts:
        faces = np.arange(part.first_face, part.first_face + part.num_faces, dtype=np.int32)
        if part.emission is None:
            continue
        free[faces] = False
        weight = areas[faces] * ((emitters.side_of_face[faces] > 0) & shown[faces].any(axis=1))
        radiance = weight @ shown[faces] / max(float(weight.sum()), 1e-30)
        lamps.append(_lamp(f"lamp-{len(lamps)}", faces, 1, radiance, mesh, is_named=True))
    regions = np.unique(emitters.of_face[free])
    shining = [region for region in regions if emitters.radiance[region].any()]
    for number, region in enumerate(shining):
        faces = np.flatnonzero(free & (emitters.of_face == region)).astype(np.int32)
        side = -1 if areas[faces] @ emitters.side_of_face[faces] < 0 else 1
        radiance = emitters.radiance[region].astype(np.float64)
        lamps.append(_lamp(f"found-{number}", faces, side, radiance, mesh, is_named=False))
    return tuple(lamps)


def _lamp(
    slot: str, faces: NDArray, side: int, radiance: NDArray, mesh: Mesh, *, is_named: bool
) -> FoundLamp:
    area = mesh.areas()[faces]
    total = float(area.sum())
    middle = mesh.triangles()[faces].mean(axis=1)
    place = (middle * area[:, None]).sum(axis=0) / max(total, 1e-30)
    return FoundLamp(slot, faces, side, as_color(radiance), as_color(place), total, is_named)


def found_panels(lit: Lit) -> tuple[FoundPatch, ...]:
    """Find the panels ``panel-0``, ... among the surfels, in decreasing order of power."""
    surfels, grid = lit.surfels, lit.surfels.grid
    sent = luminance(surfels.radiance.astype(np.float64))
    arriving = luminance(lit.diffuse.astype(np.float64))
    is_lit_by_seen = lit.irradiance.photographed > MIN_PHOTOGRAPHED
    bright = np.flatnonzero((sent > EXCESS * arriving) & is_lit_by_seen)
    shining = bright[_faintest(lit, bright) > EXCESS * arriving[bright]]
    if not len(shining):
        return ()
    keys = np.flatnonzero(grid.surfel >= 0)
    cells, sides = cell_indices(keys, grid.shape)
    separated = apart_by_side(cells, sides)
    others = np.setdiff1d(np.arange(len(keys)), shining)
    around = cKDTree(separated[others])
    found = []
    for cluster in adjacent_cells(cells[shining], sides[shining]):
        which = shining[cluster]
        share = sent[which].sum() / sent.sum()
        if len(which) < MIN_CELLS or share < MIN_SHARE:
            continue
        near, far = (_within(around, separated[which], reach) for reach in RING_CELLS)
        ring = others[np.setdiff1d(far, near)]
        if not len(ring) or np.median(sent[which]) >= MIN_EDGE * np.median(sent[ring]):
            patch = _patch(cells[which], int(sides[which][0]), which, lit)
            found.append((share, patch))
    found.sort(key=lambda item: -item[0])
    return tuple(replace(patch, slot=f"panel-{number}") for number, (_, patch) in enumerate(found))


def _within(tree: cKDTree, points: NDArray[np.int64], reach: float) -> NDArray[np.int64]:
    """Return the indices of points of ``tree`` within ``reach`` of any of ``points`` along every axis."""
    lists = tree.query_ball_point(points, reach, p=np.inf)
    return np.unique(np.concatenate([np.asarray(found, dtype=np.int64) for found in lists]))


def _faintest(lit: Lit, surfels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Compute the :data:`FAINTEST` quantile over views of the luminance of each of ``surfels`` (K,); 0 with
    fewer than :data:`MIN_VIEWS` views.
    """
    observations = lit.surfels.observations
    found = np.zeros(len(surfels))
    for row, surfel in enumerate(surfels):
        seen = observations.radiance[observations.start[surfel] : observations.start[surfel + 1]]
        if len(seen) >= MIN_VIEWS:
            found[row] = np.quantile(luminance(seen.astype(np.float64)), FAINTEST)
    return found


def _patch(cell: NDArray[np.int64], side: int, surfel: NDArray[np.int64], lit: Lit) -> FoundPatch:
    """Make the panel of the surfels ``surfel`` (K,) on the ``side``, 0 to 5, of the cells ``cell`` (K, 3)."""
    surfels, grid = lit.surfels, lit.surfels.grid
    axis, is_upper = side // 2, side % 2 == 1
    across = [k for k in range(3) if k != axis]
    low = cell[:, across].min(axis=0)
    at = cell[:, across] - low
    shape = tuple(at.max(axis=0) + 1)
    num = np.zeros(shape)
    sums = np.zeros((*shape, 3))
    np.add.at(num, tuple(at.T), 1)
    np.add.at(sums, tuple(at.T), surfels.radiance[surfel])
    mean = sums.sum(axis=(0, 1)) / num.sum()
    # fills gaps where cells have no observations
    mask = ndimage.binary_closing(np.pad(num > 0, 2), np.ones((3, 3)))[2:-2, 2:-2]
    area_m2 = float(mask.sum()) * grid.cell_m**2
    height = float(np.median(surfels.position_m[surfel, axis])) + _GAP * grid.cell_m * (1 if is_upper else -1)
    blocks = [block for whole in cover(mask) for block in cut(whole, MAX_BLOCK)]
    rectangles, covered = [], np.zeros(3)
    for row, column, rows, columns in blocks:
        window = (slice(row, row + rows), slice(column, column + columns))
        radiance = sums[window].sum(axis=(0, 1)) / num[window].sum() if num[window].any() else mean
        origin, u, v = np.zeros(3), np.zeros(3), np.zeros(3)
        origin[axis] = height
        origin[across] = grid.low[across] + (low + np.array([row, column])) * grid.cell_m
        u[across[0]], v[across[1]] = rows * grid.cell_m, columns * grid.cell_m
        if (np.cross(u, v)[axis] > 0) != is_upper:
            u, v = v, u
        rectangles.append((origin, u, v, radiance))
        covered += rows * columns * grid.cell_m**2 * radiance
    scale = area_m2 * mean / np.maximum(covered, 1e-30)
    middle = surfels.position_m[surfel].mean(axis=0)
    return FoundPatch(
        "",
        tuple(
            Rectangle(as_color(o), as_color(u), as_color(v), as_color(scale * r)) for o, u, v, r in rectangles
        ),
        as_color(middle),
        area_m2,
        as_color(mean),
    )

# SPDX-License-Identifier: MIT
"""Emitters of a room: emissive triangles, their photographed radiance, and their sampling.

The capture's geometry may mark emitters; others are detected where the radiance of a surface exceeds that of
a white surface (``model.reconstruction.light.lamps``). The emissive triangles of one smooth region form one
emitter of uniform radiance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.geometry.traced import PIXEL_RAYS, TracedGeometry, rays_within_pixels, seen_sides
from datagen.geometry.views import TracedView

MIN_PIXELS = 4
"""Minimum number of pixels of an emitter in all views; with fewer, it counts as unphotographed."""
MAX_PIXELS = 5000
"""Approximate maximum number of pixels from which the radiance of an emitter is computed."""
MIN_COVERED = 0.3
"""Minimum share of a pixel that an emitter must cover for its radiance to be computed from the pixel."""


@dataclass(frozen=True)
class Emitters:
    """K emitters of a mesh of M triangles, T of which emit.

    ``of_face`` (M,): emitter of each triangle, -1 for none; ``radiance`` (K, 3); ``side_of_face`` (M,): 1 if
    the triangle's front emits, -1 if its back. For sampling: indices ``triangles`` (T,), ``vertices``
    (T, 3, 3) in metres and ``power`` (T,), area times luminance.
    """

    of_face: NDArray[np.int32]
    radiance: NDArray[np.float32]
    side_of_face: NDArray[np.float32]
    triangles: NDArray[np.int32]
    vertices: NDArray[np.float32]
    power: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.radiance)

    @property
    def is_dark(self) -> NDArray[np.bool_]:
        """Mask (K,) of the emitters without photographed radiance."""
        return ~self.radiance.any(axis=1)

    def with_radiance(self, radiance: NDArray) -> Emitters:
        """Return the emitters with the given ``radiance`` (K, 3) and the corresponding power."""
        cross = np.cross(self.vertices[:, 1] - self.vertices[:, 0], self.vertices[:, 2] - self.vertices[:, 0])
        area = 0.5 * np.linalg.norm(cross, axis=1)
        power = area * (radiance @ LUMINANCE_WEIGHTS)[self.of_face[self.triangles]]
        return replace(self, radiance=radiance.astype(np.float32), power=power.astype(np.float32))


def photographed_emitters(
    views: Sequence[TracedView],
    traced: TracedGeometry,
    emits: NDArray[np.bool_],
    region_of_face: NDArray[np.int32],
) -> Emitters:
    """Emitters of the triangles in the mask ``emits`` (M,), one per smooth region of ``region_of_face`` (M,).

    The radiance is the median over pixels that show only the emitter. If there are fewer than
    :data:`MIN_PIXELS`, as behind blinds, it is the median of radiance / covered share, as if the rest were
    black, over pixels with a share of at least :data:`MIN_COVERED`; if these are too few, it is 0.
    """
    mesh = traced.mesh
    of_face = np.full(len(mesh.faces), -1, np.int32)
    if not emits.any():
        none, sides = np.zeros(0, np.float32), np.ones(len(mesh.faces), np.float32)
        return Emitters(of_face, none.reshape(0, 3), sides, of_face[:0], none.reshape(0, 3, 3), none)
    regions, of_face[emits] = np.unique(region_of_face[emits], return_inverse=True)
    color, share, emitter = _emitter_pixels(views, traced, of_face, len(regions))
    radiance = np.zeros((len(regions), 3), np.float32)
    for which in np.unique(emitter):
        mine = emitter == which
        whole, partial = mine & (share == 1), mine & (share >= MIN_COVERED)
        if whole.sum() >= MIN_PIXELS:
            radiance[which] = np.median(color[whole], axis=0)
        elif partial.sum() >= MIN_PIXELS:
            radiance[which] = np.median(color[partial] / share[partial, None], axis=0)
    sides = seen_sides([view.geometry for view in views], len(mesh.faces))
    triangles = np.flatnonzero(emits).astype(np.int32)
    vertices = mesh.positions[mesh.faces[triangles]].astype(np.float32)
    dark = Emitters(of_face, radiance, sides, triangles, vertices, np.zeros(len(triangles), np.float32))
    return dark.with_radiance(radiance)


def _emitter_pixels(
    views: Sequence[TracedView], traced: TracedGeometry, of_face: NDArray[np.int32], num_emitters: int
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.int32]]:
    """Sample pixels whose centre shows an emitter: radiance (K, 3), covered share (K,) and emitter (K,)."""
    pixels = []
    for view in views:
        face = view.geometry.face.ravel()
        pixel = np.flatnonzero((face >= 0) & view.valid_mask.ravel())
        emitter = of_face[face[pixel]]
        pixels.append((pixel[emitter >= 0], emitter[emitter >= 0]))
    count = np.bincount(np.concatenate([emitter for _, emitter in pixels]), minlength=num_emitters)
    step = np.maximum(1, count // MAX_PIXELS)
    passed = np.zeros(num_emitters, np.int64)
    colors, origins, directions, emitters = [], [], [], []
    for view, (pixel, emitter) in zip(views, pixels, strict=True):
        chosen = []
        for which in np.unique(emitter):
            mine = np.flatnonzero(emitter == which)
            chosen.append(mine[(passed[which] + np.arange(len(mine))) % step[which] == 0])
            passed[which] += len(mine)
        if not chosen:
            continue
        at = np.concatenate(chosen)
        colors.append(view.color.reshape(-1, 3)[pixel[at]])
        directions.append(rays_within_pixels(view.camera, pixel[at]).reshape(-1, 3))
        origins.append(np.broadcast_to(view.camera.position_m, directions[-1].shape))
        emitters.append(emitter[at])
    if not colors:
        return np.zeros((0, 3), np.float32), np.zeros(0), np.zeros(0, np.int32)
    found = np.concatenate(emitters)
    face = traced.faces_at(np.concatenate(origins), np.concatenate(directions)).reshape(-1, PIXEL_RAYS)
    is_own = (face >= 0) & (of_face[np.maximum(face, 0)] == found[:, None])
    return np.concatenate(colors), is_own.mean(axis=1), found


class EmitterSampler:
    """Samples points on emitters in Dr.Jit kernels, in proportion to power."""

    def __init__(self, emitters: Emitters):
        import drjit as dr
        import mitsuba as mi

        self.is_empty = not len(emitters) or float(emitters.power.sum()) <= 0
        if self.is_empty:
            return
        used = emitters.power > 0
        triangles = emitters.triangles[used]
        vertices = emitters.vertices[used].astype(np.float64)
        side = emitters.side_of_face[triangles].astype(np.float64)
        cross = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
        double_area = np.linalg.norm(cross, axis=1)
        self._distribution = mi.DiscreteDistribution(mi.Float(emitters.power[used].astype(np.float32)))

        def upload(rows: NDArray) -> Any:
            return mi.Float(np.ascontiguousarray(rows, np.float32).ravel())

        self._corner = upload(vertices[:, 0])
        self._edge_u = upload(vertices[:, 1] - vertices[:, 0])
        self._edge_v = upload(vertices[:, 2] - vertices[:, 0])
        self._normal = upload(cross / double_area[:, None] * side[:, None])
        radiance = emitters.radiance[emitters.of_face[triangles]]
        self._radiance = upload(radiance)
        luminance = np.maximum(radiance @ LUMINANCE_WEIGHTS, 1e-20)
        total = float(emitters.power[used].astype(np.float64).sum())
        self._area_pdf = upload(luminance / total)  # power / total / area
        # density by area [1/m^2] of :meth:`sample` on each triangle, for rays that hit it
        by_face = np.zeros(len(emitters.of_face), np.float32)
        by_face[triangles] = luminance / total
        self.area_pdf_of_face = mi.Float(by_face)
        dr.eval(self._corner, self._edge_u, self._edge_v, self._normal, self._radiance, self._area_pdf)

    def sample(self, sample_1: Any, sample_2: Any) -> tuple[Any, Any, Any, Any]:
        """Sample a point of an emitter; return its position, normal, radiance and density by area [1/m^2]."""
        import drjit as dr
        import mitsuba as mi

        index = self._distribution.sample(sample_1)
        root = dr.sqrt(sample_2.x)
        u, v = 1.0 - root, root * sample_2.y
        point = (
            dr.gather(mi.Point3f, self._corner, index)
            + dr.gather(mi.Vector3f, self._edge_u, index) * u
            + dr.gather(mi.Vector3f, self._edge_v, index) * v
        )
        return (
            point,
            dr.gather(mi.Vector3f, self._normal, index),
            dr.gather(mi.Color3f, self._radiance, index),
            dr.gather(mi.Float, self._area_pdf, index),
        )

# SPDX-License-Identifier: MIT
"""Divides a mesh into charts, each facing about one direction, and projects each onto a plane.

A chart grows from the largest unassigned triangle over shared edges while normals are within a cone around
its mean normal. xatlas' own charts, which minimise stretch, have only one or two triangles each on ornaments
and reconstructed meshes; gaps between charts would take three quarters of the atlas.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh, area_vectors, edge_pairs, unit_vectors, welded
from datagen.multiview.compiled import compiled

GROWTH_DEG = 50.0
"""Maximum angle between a triangle and the mean normal of a growing chart."""
MAX_TILT_DEG = 70.0
"""Maximum angle between a triangle and the mean normal of its finished chart, which bounds its stretch."""
_MAX_ROUNDS = 8

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class PlanarCharts:
    """Charts of ``mesh``: ``chart`` (M,) is the chart of each triangle."""

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        positions, vertex = welded(mesh)
        corners = vertex[mesh.faces]
        self._vectors = 0.5 * area_vectors(positions.astype(np.float64)[corners])
        self._areas = np.linalg.norm(self._vectors, axis=1)
        self._first, self._around = _faces_across_edges(corners)
        self.chart = np.full(len(corners), -1, np.int64)
        self._grow()

    def separate(self, is_separate: NDArray[np.bool_]) -> None:
        """Move the triangles ``is_separate`` (M,) from their charts to new ones."""
        self.chart[is_separate] = -1
        self._grow()

    def projected(self) -> Mesh:
        """Return the mesh with vertices split between charts, and with UVs in metres: each chart is projected
        onto its plane and scaled to preserve its area. Charts overlap.
        """
        chart = np.unique(self.chart, return_inverse=True)[1]
        num = int(chart.max()) + 1
        normal = unit_vectors(self._sums(chart, num), [0.0, 0.0, 1.0])
        helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        x = unit_vectors(np.cross(helper, normal), [0.0, 0.0, 1.0])
        axes = np.stack([x, np.cross(normal, x)], axis=1)[chart]  # (M, 2, 3)
        flat = np.einsum("mck,mik->mci", self.mesh.triangles(), axes)
        edges = flat[:, 1:] - flat[:, :1]
        flat_area = 0.5 * np.abs(np.linalg.det(edges))
        total, total_flat = (np.bincount(chart, areas, num) for areas in (self._areas, flat_area))
        scale = np.sqrt(np.where(total_flat > 0, total / np.maximum(total_flat, 1e-300), 1.0))
        corners = flat * scale[chart][:, None, None]
        keys = self.mesh.faces.astype(np.int64) * num + chart[:, None]
        _, first, faces = np.unique(keys.ravel(), return_index=True, return_inverse=True)
        vertex = self.mesh.faces.ravel()[first]
        return Mesh(
            self.mesh.positions[vertex],
            faces.reshape(-1, 3).astype(np.int32),
            None if self.mesh.normals is None else self.mesh.normals[vertex],
            corners.reshape(-1, 2)[first].astype(np.float32),
        )

    def _grow(self) -> None:
        """Assign triangles without a chart to new charts."""
        order = np.argsort(-self._areas, kind="stable")
        num = int(self.chart.max()) + 1
        cosine = np.cos(np.radians(GROWTH_DEG))
        for _ in range(_MAX_ROUNDS):
            num = _grow_charts(
                order, self._first, self._around, self._vectors, self._areas, cosine, self.chart, num
            )
            normal = unit_vectors(self._sums(self.chart, num), [0.0, 0.0, 1.0])[self.chart]
            facing = (self._vectors * normal).sum(axis=1)
            is_tilted = (facing < np.cos(np.radians(MAX_TILT_DEG)) * self._areas) & (self._areas > 0)
            if not is_tilted.any():
                break
            self.chart[is_tilted] = -1
        alone = np.flatnonzero(self.chart < 0)
        self.chart[alone] = num + np.arange(len(alone))

    def _sums(self, chart: Ints, num: int) -> Floats:
        return np.stack([np.bincount(chart, self._vectors[:, axis], num) for axis in range(3)], axis=1)


def _faces_across_edges(corners: Ints) -> tuple[Ints, Ints]:
    """Return each triangle's neighbours across edges in CSR form: offsets (M + 1,) by triangle, and
    neighbours; ``corners`` (M, 3) are indices of welded vertices.
    """
    pairs = edge_pairs(corners)
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    first = np.concatenate([[0], np.cumsum(np.bincount(one, minlength=len(corners)))])
    return first, other[np.argsort(one, kind="stable")]


@compiled
def _grow_charts(
    order: Ints,
    first: Ints,
    around: Ints,
    vectors: Floats,
    areas: Floats,
    cosine: float,
    chart: Ints,
    num: int,
) -> int:
    """Grow charts, numbered from ``num``, over triangles whose ``chart`` is -1; return the new ``num``."""
    queue = np.empty(len(order), np.int64)
    for seed in order:
        if chart[seed] >= 0:
            continue
        chart[seed] = num
        x, y, z = vectors[seed, 0], vectors[seed, 1], vectors[seed, 2]
        queue[0] = seed
        taken, found = 0, 1
        while taken < found:
            face = queue[taken]
            taken += 1
            for e in range(first[face], first[face + 1]):
                other = around[e]
                if chart[other] >= 0:
                    continue
                facing = vectors[other, 0] * x + vectors[other, 1] * y + vectors[other, 2] * z
                if facing < cosine * areas[other] * np.sqrt(x * x + y * y + z * z):
                    continue
                chart[other] = num
                queue[found] = other
                found += 1
                x += vectors[other, 0]
                y += vectors[other, 1]
                z += vectors[other, 2]
        num += 1
    return num

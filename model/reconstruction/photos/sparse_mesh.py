# SPDX-License-Identifier: MIT
"""Computes a closed surface through the sparse points of structure from motion, without dense depth.

A minimum cut divides Delaunay tetrahedra of the points into free and solid ones (Labatut, Pons and Keriven,
2007). A line of sight from a camera to a point indicates that the tetrahedra along it are free and that the
one behind the point is solid. The surface separates free from solid tetrahedra; wide triangles bridge areas
without points. COLMAP's Delaunay mesher needs CGAL, which Debian's COLMAP lacks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh
from datagen.multiview.compiled import compiled
from model.reconstruction.captures.colmap import Sights

SMOOTHNESS = 0.3
"""Cost of each triangle of the surface, in units of the cost of a line of sight that crosses it."""
SPREAD_QUANTILE = 0.25
"""Quantile of edge lengths that is used as the standard deviation of point positions."""
_UNITS = 256  # integer capacity per unit of cost
_OUTSIDE = 1.0  # margin of the tetrahedra around the points' box, relative to its longest side
_FACETS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the facet opposite each corner


def sparse_surface(sights: Sights) -> Mesh:
    """Compute the surface as a mesh whose triangles face free space; it is empty without points."""
    from scipy.spatial import Delaunay

    if not len(sights.points):
        return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    low = np.minimum(sights.points.min(axis=0), sights.centers.min(axis=0))
    high = np.maximum(sights.points.max(axis=0), sights.centers.max(axis=0))
    reach = _OUTSIDE * (high - low).max()
    corners = np.array(np.meshgrid(*np.stack([low - reach, high + reach], axis=1))).reshape(3, -1).T
    vertices = np.concatenate([sights.points, corners])
    tetrahedra = Delaunay(vertices)
    edges = (
        vertices[tetrahedra.simplices[:, [0, 0, 0, 1, 1, 2]]]
        - vertices[tetrahedra.simplices[:, [1, 2, 3, 2, 3, 3]]]
    )
    spread = float(np.quantile(np.linalg.norm(edges, axis=2), SPREAD_QUANTILE))
    origin, target = sights.centers[sights.camera], sights.points[sights.point]
    length = np.linalg.norm(target - origin, axis=1)
    is_ray = length > spread
    origin, target, length = origin[is_ray], target[is_ray], length[is_ray]
    direction = (target - origin) / length[:, None]
    crossed = np.zeros((len(tetrahedra.simplices), 4))
    start = tetrahedra.find_simplex(origin)
    inverse = np.ascontiguousarray(tetrahedra.transform)
    _cross(origin, direction, length, start, inverse, tetrahedra.neighbors, spread, crossed)
    behind = tetrahedra.find_simplex(target + spread * direction)
    is_free = _free(tetrahedra.neighbors, crossed, start, behind)
    return _boundary(vertices, tetrahedra.simplices, tetrahedra.neighbors, is_free, len(sights.points))


@compiled
def _cross(
    origin: Any,
    direction: Any,
    length: Any,
    start: Any,
    inverse: Any,
    neighbors: Any,
    spread: Any,
    crossed: Any,
) -> None:
    """Add the number of lines of sight through each facet of T tetrahedra to ``crossed`` (T, 4); crossings
    near the end of a line count less, since the position of its point is inexact.
    """
    for ray in range(len(origin)):
        tetrahedron = start[ray]
        for _ in range(len(neighbors)):
            if tetrahedron < 0:
                break
            leaving, facet = np.inf, -1
            last_at, last_step = 1.0, 0.0  # the last barycentric coordinate is 1 minus the others
            for k in range(4):
                at, step = last_at, last_step
                if k < 3:
                    at, step = 0.0, 0.0
                    for axis in range(3):
                        at += inverse[tetrahedron, k, axis] * (
                            origin[ray, axis] - inverse[tetrahedron, 3, axis]
                        )
                        step += inverse[tetrahedron, k, axis] * direction[ray, axis]
                    last_at -= at
                    last_step -= step
                if step < 0 and -at / step < leaving:
                    leaving, facet = -at / step, k
            rest = (length[ray] - leaving) / spread
            if facet < 0 or rest <= 1e-6:
                break
            crossed[tetrahedron, facet] += 1 - np.exp(-0.5 * rest * rest)
            tetrahedron = neighbors[tetrahedron, facet]


def _free(neighbors: NDArray, crossed: NDArray, start: NDArray, behind: NDArray) -> NDArray[np.bool_]:
    """Compute the mask (T,) of free tetrahedra, which are on the cameras' side of the minimum cut."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    num = len(neighbors)
    source, sink = num, num + 1
    tetrahedron, facet = np.nonzero(neighbors >= 0)
    cost = crossed[tetrahedron, facet] + SMOOTHNESS
    solid = np.bincount(behind[behind >= 0], minlength=num)
    cameras = np.unique(start[start >= 0])
    ends = np.flatnonzero(solid)
    rows = np.concatenate([tetrahedron, np.full(len(cameras), source), ends])
    columns = np.concatenate([neighbors[tetrahedron, facet], cameras, np.full(len(ends), sink)])
    most = np.iinfo(np.int32).max // (2 * max(len(cameras), 1))  # above the total cost of all lines of sight
    values = np.concatenate([_UNITS * cost, np.full(len(cameras), most), _UNITS * solid[ends]])
    graph = coo_matrix((np.round(values).astype(np.int32), (rows, columns)), (num + 2, num + 2)).tocsr()
    rest = graph - maximum_flow(graph, source, sink).flow
    rest.data = np.maximum(rest.data, 0)
    rest.eliminate_zeros()
    is_free = np.zeros(num + 2, dtype=bool)
    is_free[breadth_first_order(rest, source, return_predecessors=False)] = True
    return is_free[:num]


def _boundary(
    vertices: NDArray, simplices: NDArray, neighbors: NDArray, is_free: NDArray[np.bool_], num_points: int
) -> Mesh:
    """Make a mesh of the facets between free and solid tetrahedra, without facets at corners of the box."""
    tetrahedron, facet = np.nonzero(is_free[:, None] & (neighbors >= 0) & ~is_free[neighbors])
    faces = simplices[tetrahedron[:, None], _FACETS[facet]]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = vertices[simplices[tetrahedron, facet]] - a  # vector to the corner in free space
    is_turned = (np.cross(b - a, c - a) * inward).sum(axis=1) < 0
    faces[is_turned] = faces[is_turned][:, ::-1]
    faces = faces[(faces < num_points).all(axis=1)]
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used].astype(np.float32), index.reshape(-1, 3).astype(np.int32))

# SPDX-License-Identifier: MIT
"""Connected pieces of a mesh, on its surface and in its UVs, and areas in UVs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh, compacted, welded


def chart_of_faces(mesh: Mesh) -> NDArray[np.int32]:
    """Compute each triangle's chart index (M,); triangles that share a position and its UV share a chart."""
    return _pieces(compacted(Mesh(mesh.positions, mesh.faces, None, mesh.uv)).faces)


def connected_pieces(mesh: Mesh) -> NDArray[np.int32]:
    """Compute each triangle's piece (M,); triangles that share a corner's position share a piece."""
    return _pieces(welded(mesh)[1][mesh.faces])


def uv_areas(mesh: Mesh) -> NDArray[np.float64]:
    """Compute the areas (M,) of the triangles' UVs."""
    assert mesh.uv is not None
    corners = mesh.uv.astype(np.float64)[mesh.faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])


def _pieces(corners: NDArray) -> NDArray[np.int32]:
    """Number the connected pieces of triangles whose corners (M, 3) are vertex indices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    num = int(corners.max(initial=-1)) + 1
    first, second = corners[:, :2].ravel(), corners[:, 1:].ravel()
    graph = coo_array((np.ones(len(first), np.int32), (first, second)), shape=(num, num))
    return connected_components(graph, directed=False)[1][corners[:, 0]].astype(np.int32)

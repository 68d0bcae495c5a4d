# SPDX-License-Identifier: MIT
"""Charts of an unwrapped mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh, compacted


def chart_of_faces(mesh: Mesh) -> NDArray[np.int32]:
    """Compute each triangle's chart index (M,); triangles that share a position and its UV share a chart."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    bare = compacted(Mesh(mesh.positions, mesh.faces, None, mesh.uv))
    faces, num = bare.faces.astype(np.int64), len(bare.positions)
    rows = np.concatenate([faces[:, 0], faces[:, 1]])
    columns = np.concatenate([faces[:, 1], faces[:, 2]])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(num, num))
    return connected_components(graph, directed=False)[1][faces[:, 0]].astype(np.int32)

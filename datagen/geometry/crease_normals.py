# SPDX-License-Identifier: MIT
"""Vertex normals for meshes without normals: smooth on gently curved surfaces, discontinuous at creases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.foundation.meshes.mesh import Mesh, area_vectors, unit_vectors, welded

CREASE_RAD = np.radians(40.0)  # minimum angle between the normals of the triangles at a crease
_MAX_AROUND = 128  # maximum number of triangles averaged at a vertex


def with_normals(mesh: Mesh) -> Mesh:
    """Return ``mesh`` itself if it has normals, else a copy with normals that are discontinuous at creases.

    Vertices are split at creases; faces keep their order. The normal at a triangle's corner is the
    area-weighted mean over the triangles at the same vertex whose normals differ by less than ``CREASE_RAD``
    from the triangle's own. Weighting by area keeps large walls flat next to narrow bevels.
    """
    if mesh.normals is not None:
        return mesh
    cross = area_vectors(mesh.triangles())
    unit = unit_vectors(cross)
    vertex = welded(mesh)[1][mesh.faces].ravel()
    order = np.argsort(vertex, kind="stable")  # corners by vertex; corner k belongs to face k // 3
    start = np.concatenate([[0], np.cumsum(np.bincount(vertex))])
    size = (start[1:] - start[:-1])[vertex[order]]
    local = np.arange(len(order)) - start[:-1][vertex[order]]
    total = np.repeat(cross, 3, axis=0)
    for step in range(1, min(int(size.max(initial=1)), _MAX_AROUND)):
        rows = np.flatnonzero(size > step)  # paired with the corner ``step`` entries later at the same vertex
        other = rows - local[rows] + (local[rows] + step) % size[rows]
        a, b = order[rows] // 3, order[other] // 3
        is_near = (unit[a] * unit[b]).sum(axis=1) > np.cos(CREASE_RAD)
        total[order[rows[is_near]]] += cross[b[is_near]]
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals = np.where(length > 1e-30, total / np.maximum(length, 1e-300), np.repeat(unit, 3, axis=0))
    coded = np.round((normals + 1) * 511).astype(np.int64)
    keys = (mesh.faces.ravel().astype(np.int64) << 30) | (coded @ [1 << 20, 1 << 10, 1])
    _, first, split = np.unique(keys, return_index=True, return_inverse=True)
    source = mesh.faces.ravel()[first]
    return replace(mesh.picked(source, split), normals=normals[first].astype(np.float32))

# SPDX-License-Identifier: MIT
"""Removes noise from reconstructed meshes and preserves their edges (stage ``mesh`` of ``infer``).

Photogrammetry displaces vertices by millimetres, which turns the normals of small triangles by tens of
degrees. Normals are therefore smoothed by a bilateral filter (Zheng et al. 2011, Bilateral normal filtering
for mesh denoising), whose weights decrease with distance and with the angle between normals, and vertices are
moved until the triangles agree with these normals (Sun et al. 2007, Fast and effective feature-preserving
mesh denoising). Triangles keep their order and their vertices.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import Capture, CaptureGeometry
from datagen.foundation.meshes.mesh import Mesh, area_vectors, edge_pairs, unit_vectors, welded
from datagen.foundation.peak_memory import num_threads
from datagen.foundation.progress import Advance, no_advance
from datagen.multiview.compiled import compiled
from model.reconstruction.mesh.holes import filled
from model.reconstruction.stages import Run

NORMAL_ROUNDS, VERTEX_ROUNDS = 20, 20
ANGLE_SCALE = 0.35
"""Standard deviation of the filter's range kernel, in units of the length of the difference of normals."""
MIN_NOISE_DEG = 2.0
"""Minimum noise at which a mesh is mended; modelled meshes have 0, photogrammetry several degrees."""
_BLOCK = 16_384

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def noise_deg(mesh: Mesh) -> float:
    """Measure noise: the area-weighted median over triangles of the smallest angle to a neighbour's normal.

    It is 0 for modelled surfaces, on which every triangle has a coplanar neighbour (even on cylinders).
    """
    corners = welded(mesh)[1][mesh.faces]
    area_vector = area_vectors(mesh.triangles())
    length = np.linalg.norm(area_vector, axis=1)
    normal = unit_vectors(area_vector)
    a, b = edge_pairs(corners).T
    is_sound = (length[a] > 0) & (length[b] > 0) & (a != b)
    a, b = a[is_sound], b[is_sound]
    angle = np.arccos(np.clip((normal[a] * normal[b]).sum(axis=1), -1, 1))
    smallest = np.full(len(corners), np.inf)
    np.minimum.at(smallest, a, angle)
    np.minimum.at(smallest, b, angle)
    joined = np.flatnonzero(np.isfinite(smallest))
    if not len(joined):
        return 0.0
    joined = joined[np.argsort(smallest[joined], kind="stable")]
    area = np.cumsum(length[joined])
    return float(np.degrees(smallest[joined][np.searchsorted(area, 0.5 * area[-1])]))


def smoothed(mesh: Mesh, is_fixed: NDArray[np.bool_], progress: Advance = no_advance) -> Mesh:
    """Return ``mesh`` denoised and without normals; vertices of triangles ``is_fixed`` (M,) do not move."""
    positions, vertex = welded(mesh)
    moved = positions.astype(np.float64)
    faces = vertex[mesh.faces]
    first, around = _faces_around(faces, len(positions))
    rounds = NORMAL_ROUNDS + VERTEX_ROUNDS
    with ThreadPoolExecutor(num_threads()) as pool:
        area_vector = area_vectors(moved[faces])
        area = np.linalg.norm(area_vector, axis=1)
        normal = unit_vectors(area_vector)
        centre = moved[faces].mean(axis=1)
        for k in range(NORMAL_ROUNDS):
            normal = _in_blocks(pool, _filter_normals, normal, (faces, first, around, area, centre))
            progress(k + 1, rounds)
        stays = np.zeros(len(positions), np.bool_)
        stays[faces[is_fixed].ravel()] = True
        for k in range(VERTEX_ROUNDS):
            centre = moved[faces].mean(axis=1)
            moved = _in_blocks(pool, _fit_vertices, moved, (first, around, centre, normal, stays))
            progress(NORMAL_ROUNDS + k + 1, rounds)
    return Mesh(moved[vertex].astype(np.float32), mesh.faces, None, mesh.uv)


def _faces_around(faces: Ints, num_vertices: int) -> tuple[Ints, Ints]:
    """Return each vertex's triangles in CSR form: offsets (V + 1,) by vertex, and triangles (3M,)."""
    order = np.argsort(faces.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(faces.ravel(), minlength=num_vertices))])
    return first, order // 3


def _in_blocks(pool: ThreadPoolExecutor, function: Any, values: Floats, arguments: tuple[Any, ...]) -> Floats:
    """Compute new ``values`` (N, 3) in parallel blocks of rows; ``function`` reads all old values."""
    found = np.empty_like(values)
    starts = range(0, len(values), _BLOCK)
    list(pool.map(lambda s: function(s, min(s + _BLOCK, len(values)), values, found, *arguments), starts))
    return found


@compiled
def _square(values: Floats, i: int, j: int) -> float:
    """Compute the squared distance of two rows of ``values`` (N, 3)."""
    x, y, z = values[i, 0] - values[j, 0], values[i, 1] - values[j, 1], values[i, 2] - values[j, 2]
    return float(x * x + y * y + z * z)


@compiled
def _filter_normals(
    begin: int,
    end: int,
    normal: Floats,
    found: Floats,
    faces: Ints,
    first: Ints,
    around: Ints,
    area: Floats,
    centre: Floats,
) -> None:
    """Filter the normals of the triangles [begin, end) over neighbours; those across an edge count twice."""
    for i in range(begin, end):
        spread, count = 0.0, 0
        for k in range(3):
            v = faces[i, k]
            for e in range(first[v], first[v + 1]):
                spread += _square(centre, around[e], i)
                count += 1
        x, y, z = 0.0, 0.0, 0.0
        for k in range(3):
            v = faces[i, k]
            for e in range(first[v], first[v + 1]):
                j = around[e]
                distance = _square(centre, j, i) * count / (2 * spread + 1e-300)
                turn = _square(normal, j, i) / (2 * ANGLE_SCALE**2)
                weight = area[j] * np.exp(-distance - turn)
                x += weight * normal[j, 0]
                y += weight * normal[j, 1]
                z += weight * normal[j, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0:
            found[i, 0], found[i, 1], found[i, 2] = x / length, y / length, z / length
        else:
            found[i] = normal[i]


@compiled
def _fit_vertices(
    begin: int,
    end: int,
    position: Floats,
    found: Floats,
    first: Ints,
    around: Ints,
    centre: Floats,
    normal: Floats,
    stays: NDArray[np.bool_],
) -> None:
    """Move the vertices [begin, end) to the mean of their projections on the planes of their triangles."""
    for v in range(begin, end):
        found[v] = position[v]
        count = first[v + 1] - first[v]
        if stays[v] or count == 0:
            continue
        for e in range(first[v], first[v + 1]):
            j = around[e]
            height = 0.0
            for axis in range(3):
                height += (centre[j, axis] - position[v, axis]) * normal[j, axis]
            for axis in range(3):
                found[v, axis] += height / count * normal[j, axis]


def mended_mesh(capture: Capture, run: Run) -> Capture:
    """Fill holes of the mesh, remove its noise, and report both; a mesh without noise is unchanged.

    Lamps are unchanged. If holes are filled, they are added as a part, and the UVs are lost.
    """
    with run.stage("mesh") as advance:
        before = noise_deg(capture.geometry.mesh)
        run.report.mesh = {"noise_deg": round(before, 2)}
        if before < MIN_NOISE_DEG:
            return capture
        capture, num_filled = filled(capture)
        geometry = capture.geometry
        mesh = smoothed(geometry.mesh, geometry.emitter_mask(), advance)
        moved_mm = 1000 * np.linalg.norm(mesh.positions - geometry.mesh.positions, axis=1)
        median_mm, high_mm = (round(float(np.percentile(moved_mm, p)), 1) for p in (50, 95))
        after = noise_deg(mesh)
        run.report.mesh |= {
            "left_deg": round(after, 2),
            "moved_mm_50": median_mm,
            "moved_mm_95": high_mm,
            "holes_filled": num_filled,
        }
        run.report.num_triangles = len(mesh.faces)
        run.report.notes.append(
            f"the mesh was mended: triangles deviate by {after:.1f} instead of {before:.1f} degrees, "
            f"vertices moved by {median_mm:.1f} mm (median), {num_filled} holes were filled; --no-mend-mesh"
            " leaves it unchanged"
        )
        return replace(capture, geometry=CaptureGeometry(mesh, geometry.parts))

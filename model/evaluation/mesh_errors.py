# SPDX-License-Identifier: MIT
"""Simulates errors of reconstructed meshes, to measure how much results depend on exact geometry.

The order of parts is preserved. Lamps are unchanged, since errors of the lighting are not under test.
"""

from __future__ import annotations

import io
import json
import time
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from datagen.formats.base import (
    NonNegative,
    Positive,
    StrictModel,
    canonical_json,
    sha256_hex,
    write_bytes_atomically,
)
from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.foundation.meshes.mesh import Mesh, joined, vertex_normals, welded, without_degenerate
from datagen.foundation.progress import Progress
from model.reconstruction.unwrap.uv import unwrapped

_MIN_FACES = 4  # parts with fewer triangles are not reduced
_MAX_HOLES = 10_000
_REVISION = 2
_ARRAYS = ("positions", "faces", "normals", "uv")  # fields of Mesh, in order


class GeometryError(StrictModel):
    """Errors of a mesh, in the order of their application.

    Edges are split until none exceeds ``edge_m`` metres (None: not split), vertices are moved along each axis
    by Gaussian noise of standard deviation ``noise_m``, the number of triangles is reduced to the share
    ``keep_share``, and round holes of radius ``hole_radius_m`` remove the share ``hole_share`` of the area.
    """

    noise_m: NonNegative = 0.0
    keep_share: Annotated[float, Field(gt=0, le=1)] = 1.0
    hole_share: Annotated[float, Field(ge=0, le=0.9)] = 0.0
    hole_radius_m: Positive = 0.15
    edge_m: Positive | None = None
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    def describe(self) -> str:
        """Describe the errors in text such as "noise 10 mm, holes 5%"; "true" without errors."""
        parts = []
        if self.edge_m is not None:
            parts.append(f"edges {self.edge_m * 1000:g} mm")
        if self.noise_m:
            parts.append(f"noise {self.noise_m * 1000:g} mm")
        if self.keep_share < 1:
            parts.append(f"{self.keep_share:.0%} of triangles")
        if self.hole_share:
            parts.append(f"holes {self.hole_share:.0%}")
        return ", ".join(parts) or "true"


def with_errors(geometry: CaptureGeometry, error: GeometryError) -> CaptureGeometry:
    """Apply ``error`` to ``geometry``; like a reconstructed mesh, the result has neither UVs nor normals."""
    random = np.random.default_rng([error.seed, 0x6D657368])
    meshes = []
    for part in geometry.parts:
        mesh = _part_mesh(geometry.mesh, part)
        meshes.append(mesh if part.emission is not None else _worse(mesh, error, random))
    if error.hole_share:
        meshes = _with_holes(meshes, [p.emission is not None for p in geometry.parts], error, random)
    parts, first = [], 0
    for part, mesh in zip(geometry.parts, meshes, strict=True):
        parts.append(GeometryPart(part.name, first, len(mesh.faces), part.emission))
        first += len(mesh.faces)
    return CaptureGeometry(joined(meshes), tuple(parts))


def _part_mesh(mesh: Mesh, part: GeometryPart) -> Mesh:
    """Mesh of one part with the vertices that it uses, without UVs and normals."""
    bare = Mesh(mesh.positions, mesh.faces[part.first_face : part.first_face + part.num_faces])
    return bare.picked(*np.unique(bare.faces, return_inverse=True))


def _worse(mesh: Mesh, error: GeometryError, random: np.random.Generator) -> Mesh:
    positions, vertex = welded(mesh)
    faces = vertex[mesh.faces]
    if error.edge_m is not None:
        from trimesh.remesh import subdivide_to_size

        positions, faces = subdivide_to_size(positions, faces, error.edge_m, max_iter=20)
    if error.noise_m:
        positions = positions + random.normal(0.0, error.noise_m, positions.shape)
    if error.keep_share < 1 and len(faces) > _MIN_FACES:
        positions, faces = _reduced(positions, faces, error.keep_share)
    made = Mesh(
        np.ascontiguousarray(positions, np.float32), np.ascontiguousarray(faces.reshape(-1, 3), np.int32)
    )
    sound = without_degenerate(made)
    return sound if len(sound.faces) else mesh


def _reduced(positions: NDArray, faces: NDArray, keep_share: float) -> tuple[NDArray, NDArray]:
    """Collapse edges by quadric error (Garland and Heckbert 1997) until ``keep_share`` of the triangles is
    left; returns ``positions`` (V, 3) and ``faces`` (M, 3)."""
    from fast_simplification import simplify

    count = max(_MIN_FACES, round(keep_share * len(faces)))
    points, triangles = simplify(
        np.ascontiguousarray(positions, np.float32), np.ascontiguousarray(faces, np.int32), target_count=count
    )
    return (points, triangles) if len(triangles) else (positions, faces)


def _with_holes(
    meshes: list[Mesh], is_lamp: list[bool], error: GeometryError, random: np.random.Generator
) -> list[Mesh]:
    """Remove triangles near random ones, drawn with probability proportional to area; lamps are kept."""
    owner = np.concatenate([np.full(len(mesh.faces), k) for k, mesh in enumerate(meshes)])
    centres = np.concatenate([mesh.triangles().mean(axis=1) for mesh in meshes])
    areas = np.concatenate([mesh.areas() for mesh in meshes])
    areas[np.isin(owner, np.flatnonzero(is_lamp))] = 0.0
    from scipy.spatial import cKDTree

    tree, gone = cKDTree(centres), np.zeros(len(centres), dtype=bool)
    share = areas / areas.sum()
    for place in random.choice(len(centres), size=_MAX_HOLES, p=share):
        if share[gone].sum() >= error.hole_share:
            break
        gone[tree.query_ball_point(centres[place], error.hole_radius_m)] = True
    gone &= areas > 0
    result = []
    for k, mesh in enumerate(meshes):
        keep = ~gone[owner == k]
        if not keep.any():
            keep[0] = True  # parts must not be empty
        result.append(Mesh(mesh.positions, mesh.faces[keep]))
    return result


def geometry_for(
    true_geometry: CaptureGeometry,
    error: GeometryError | None,
    root: Path,
    tell: Progress,
) -> tuple[CaptureGeometry, float]:
    """Return ``true_geometry`` with ``error`` and with UVs for an atlas, and the unwrapping time in seconds.

    The result is stored in the folder ``root``, in a file named by a hash of mesh and error.
    """
    path = root / f"{_key(true_geometry, error)}.npz"
    if not path.is_file():
        tell("unwrap", 0, 1)
        geometry = true_geometry if error is None else with_errors(true_geometry, error)
        mesh = geometry.mesh
        if mesh.normals is None:
            mesh = Mesh(mesh.positions, mesh.faces, vertex_normals(mesh), mesh.uv)
        start = time.perf_counter()
        mesh, _ = unwrapped(mesh)
        _write(path, CaptureGeometry(mesh, geometry.parts), time.perf_counter() - start)
        tell("unwrap", 1, 1)
    return _read(path)


def _key(geometry: CaptureGeometry, error: GeometryError | None) -> str:
    described = None if error is None else error.model_dump(mode="json")
    parts = [[p.name, p.first_face, p.num_faces, p.emission] for p in geometry.parts]
    arrays = (getattr(geometry.mesh, name) for name in _ARRAYS)
    hashes = [None if a is None else sha256_hex(np.ascontiguousarray(a).tobytes()) for a in arrays]
    return sha256_hex(canonical_json([_REVISION, described, parts, hashes]))[:16]


def _write(path: Path, geometry: CaptureGeometry, seconds: float) -> None:
    mesh = geometry.mesh
    parts = json.dumps([[p.name, p.first_face, p.num_faces, p.emission] for p in geometry.parts])
    stream = io.BytesIO()
    arrays = {name: getattr(mesh, name) for name in _ARRAYS}
    np.savez(stream, **arrays, parts=np.array(parts), seconds=np.array(seconds))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes_atomically(path, stream.getvalue())


def _read(path: Path) -> tuple[CaptureGeometry, float]:
    with np.load(path) as data:
        mesh = Mesh(*(data[name] for name in _ARRAYS))
        rows = json.loads(str(data["parts"]))
        seconds = float(data["seconds"])
    parts = tuple(GeometryPart(name, first, num, e and tuple(e)) for name, first, num, e in rows)
    return CaptureGeometry(mesh, parts), seconds

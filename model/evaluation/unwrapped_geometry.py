# SPDX-License-Identifier: MIT
"""Unwrapped mesh, with or without errors, that all methods share."""

from __future__ import annotations

import io
import json
import time
from pathlib import Path

import numpy as np

from datagen.formats.base import canonical_json, sha256_hex, write_bytes_atomically
from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.foundation.meshes.mesh import Mesh, vertex_normals
from datagen.foundation.progress import Progress
from model.evaluation.mesh_errors import GeometryError, with_errors
from model.reconstruction.unwrap.uv import unwrapped

_REVISION = 2


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
    mesh = geometry.mesh
    arrays = [mesh.positions, mesh.faces, mesh.normals, mesh.uv]
    hashes = [None if a is None else sha256_hex(np.ascontiguousarray(a).tobytes()) for a in arrays]
    return sha256_hex(canonical_json([_REVISION, described, parts, hashes]))[:16]


def _write(path: Path, geometry: CaptureGeometry, seconds: float) -> None:
    mesh = geometry.mesh
    assert mesh.normals is not None and mesh.uv is not None
    parts = json.dumps([[p.name, p.first_face, p.num_faces, p.emission] for p in geometry.parts])
    stream = io.BytesIO()
    np.savez(
        stream,
        positions=mesh.positions,
        faces=mesh.faces,
        normals=mesh.normals,
        uv=mesh.uv,
        parts=np.array(parts),
        seconds=np.array(seconds),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes_atomically(path, stream.getvalue())


def _read(path: Path) -> tuple[CaptureGeometry, float]:
    with np.load(path) as data:
        mesh = Mesh(data["positions"], data["faces"], data["normals"], data["uv"])
        rows = json.loads(str(data["parts"]))
        seconds = float(data["seconds"])
    parts = tuple(
        GeometryPart(name, first, num, None if emission is None else tuple(emission))
        for name, first, num, emission in rows
    )
    return CaptureGeometry(mesh, parts), seconds

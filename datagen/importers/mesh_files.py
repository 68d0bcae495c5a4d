# SPDX-License-Identifier: MIT
"""Import of OBJ (with MTL), PLY and STL files, by conversion to glTF.

These formats state neither unit nor up axis. Y is up in OBJ, Z in PLY and STL, unless ``--up`` is given. The
unit is ``--unit-scale`` or the first of metre, centimetre, millimetre and inch with which the size is
plausible; a unit other than the metre is reported in a note.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from datagen.formats.category_sizes import CATEGORY_SIZES_M
from datagen.foundation.budget import Budget
from datagen.foundation.errors import input_error
from datagen.foundation.findings import Findings
from datagen.foundation.meshes.mesh import Mesh, area_vectors, compacted, unit_vectors, welded
from datagen.foundation.meshes.ply import read_ply
from datagen.foundation.paths import named_file
from datagen.importers.classes import guess_category
from datagen.importers.common import RESTORE_IT, ImportedAsset, ImportOptions
from datagen.importers.glb import GlbMaterial, encode_glb
from datagen.importers.gltf import import_gltf
from datagen.importers.obj_model import PhongMaterial, creased, read_mtl, read_obj_model

_IMAGE_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
_UNITS_M = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254}
_USUAL_M = (0.02, 20.0)  # plausible longest side of an object, or room, of unknown category
_STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")
_MAX_EXPONENT = 1000.0
"""Phong exponent in MTL files that counts as perfectly smooth; Blender's exporter writes 1000 (1 - R)^2."""


@dataclass(frozen=True)
class MeshSource:
    """Content of a mesh file: its surfaces as pairs (material name, mesh), and its materials by name."""

    surfaces: list[tuple[str, Mesh]]
    materials: dict[str, GlbMaterial]


def import_mesh_file(
    path: Path, out_library: Path, options: ImportOptions, *, split: bool
) -> list[ImportedAsset]:
    """Convert an OBJ, PLY or STL file to packages below ``out_library``, as :func:`import_gltf` does.

    Raises :class:`InputError` for damaged files, for referenced files that are missing or outside the allowed
    folders, and for an unknown licence.
    """
    findings, suffix = Findings(), path.suffix.lower()
    source = READERS[suffix](path, options, findings, Budget(path, options.limits))
    up: Literal["y", "z"] = "z" if options.up == "z" or (options.up == "auto" and suffix != ".obj") else "y"
    unit_m = options.unit_scale or _plausible_unit(source, path, options, findings)
    with tempfile.TemporaryDirectory() as folder:
        converted = Path(folder) / f"{path.stem}.glb"
        converted.write_bytes(encode_glb(source.surfaces, source.materials))
        resolved = replace(options, up=up, unit_scale=unit_m)
        return import_gltf(converted, out_library, resolved, split=split, origin=path, findings=findings)


def _plausible_unit(source: MeshSource, path: Path, options: ImportOptions, findings: Findings) -> float:
    """Return the first unit, in metres, for which the longest side is plausible; 1 if there is none."""
    points = [mesh.positions for _, mesh in source.surfaces]
    low, high = np.min([p.min(0) for p in points], 0), np.max([p.max(0) for p in points], 0)
    longest = float((high - low).max())
    category = options.category or guess_category(path.stem)
    least, most = CATEGORY_SIZES_M.get(category, _USUAL_M)
    for name, unit_m in _UNITS_M.items():
        if least <= longest * unit_m <= most:
            if unit_m != 1.0:
                findings.note(
                    f"{path.stem}: {longest:.4g} units long, taken as {name} ({longest * unit_m:.3g} m); "
                    "--unit-scale overrides this"
                )
            return unit_m
    return 1.0


def _read_obj(path: Path, options: ImportOptions, findings: Findings, budget: Budget) -> MeshSource:
    data = budget.read_file(path)
    model = read_obj_model(data, path, budget)
    stated: dict[str, PhongMaterial] = {}
    for library in model.libraries:
        file = named_file(path.parent, library, path, "mtllib", options.allowed)
        if file.is_file():
            stated.update(read_mtl(budget.read_file(file), file))
        elif options.missing == "refuse":
            raise input_error(path, "mtllib", f"{library!r} (no such file)", "its materials", RESTORE_IT)
        else:
            findings.approximate(f"{library}: missing materials, their surfaces are grey")
    materials = {
        name: _material_of(name, stated.get(name, PhongMaterial()), path, options, findings, budget)
        for name in dict.fromkeys(surface.material for surface in model.surfaces)
    }
    return MeshSource([(surface.material, surface.mesh) for surface in model.surfaces], materials)


def _material_of(
    name: str, phong: PhongMaterial, path: Path, options: ImportOptions, findings: Findings, budget: Budget
) -> GlbMaterial:
    """Convert an MTL material; R follows from the Phong exponent; mirrors with black ``Kd`` become metals."""
    image: tuple[str, bytes] | None = None
    for keyword, text in phong.maps.items():
        if keyword != "map_kd":
            findings.approximate(f"{name or 'default'}: {keyword} left out")
            continue
        file = named_file(path.parent, text.split(" -")[0].strip(), path, f"{name}: map_Kd", options.allowed)
        kind = _IMAGE_TYPES.get(file.suffix.lower())
        if not file.is_file() and options.missing == "replace":
            findings.approximate(f"{name or 'default'}: missing image {file.name}, only its colour is used")
        elif not file.is_file() or kind is None:
            got = f"{text!r}" + ("" if file.is_file() else " (no such file)")
            remedy = "convert or restore it" if file.is_file() else "restore it, or --missing replace"
            raise input_error(path, f"{name}: map_Kd", got, "a PNG or JPEG image", remedy)
        else:
            image = (kind, budget.read_file(file))
    is_metal = phong.illumination == 3 and max(phong.diffuse) < 0.04 < max(phong.specular)
    exponent = min(max(phong.exponent, 0.0), _MAX_EXPONENT)
    return GlbMaterial(
        color=phong.specular if is_metal else phong.diffuse if image is None else (1.0, 1.0, 1.0),
        roughness=1.0 - float(np.sqrt(exponent / _MAX_EXPONENT)),
        is_metal=is_metal,
        emission=phong.emission,
        opacity=phong.opacity,
        image=image,
    )


def _read_ply(path: Path, options: ImportOptions, findings: Findings, budget: Budget) -> MeshSource:
    mesh = read_ply(path, budget)
    if not len(mesh.faces):
        raise input_error(path, "", "points without faces", "a mesh", "reconstruct its surface")
    return MeshSource([("", mesh if mesh.normals is not None else _smoothed(mesh, budget))], {})


def _read_stl(path: Path, options: ImportOptions, findings: Findings, budget: Budget) -> MeshSource:
    data = budget.read_file(path)
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + _STL_RECORD.itemsize * count:
        budget.spend("triangles", count, path.name)
        corners = np.frombuffer(data, _STL_RECORD, count, 84)["corners"]
    else:
        fault = f"{len(data)} bytes without facets; the header states {count} triangles"
        try:
            rows = [[float(word) for word in found.groups()] for found in _VERTEX.finditer(data)]
            corners = np.array(rows, np.float32).reshape(-1, 3, 3)
        except ValueError as error:
            corners, fault = np.zeros((0, 3, 3), np.float32), str(error)[:200]
        budget.spend("triangles", len(corners), path.name)
        if not len(corners):
            raise input_error(path, got=fault, expected="an intact STL file", remedy="export it again")
    if not np.isfinite(corners).all():
        raise input_error(path, got="NaN or infinite vertices", expected="finite numbers", remedy="repair it")
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return MeshSource([("", _smoothed(Mesh(corners.reshape(-1, 3), faces), budget))], {})


def _smoothed(mesh: Mesh, budget: Budget) -> Mesh:
    """Merge equal vertices, and compute normals that are smooth across edges of less than 60 degrees."""
    positions, joined = welded(mesh)
    faces = joined[mesh.faces]
    points = positions.astype(np.float64)
    unit = unit_vectors(area_vectors(points[faces]))
    normals = creased(points, faces, unit, np.ones(len(faces), np.int64), budget).reshape(-1, 3)
    corners = np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3)
    uv = mesh.uv[mesh.faces.ravel()] if mesh.uv is not None else None
    return compacted(Mesh(positions[faces.ravel()], corners, normals.astype(np.float32), uv))


READERS: dict[str, Callable[[Path, ImportOptions, Findings, Budget], MeshSource]] = {
    ".obj": _read_obj,
    ".ply": _read_ply,
    ".stl": _read_stl,
}
"""Readers by file suffix."""

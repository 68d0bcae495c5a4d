# SPDX-License-Identifier: MIT
"""The project's own shards as captures: images out of the tar, geometry out of the configuration's
library."""

from __future__ import annotations

import tarfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.farm.folder import DatasetFolder, rooms_of
from datagen.formats.asset import EnvironmentAsset, Material, MaterialAsset, ObjectAsset
from datagen.formats.capture import Capture, CaptureGeometry, CaptureView, ColorImage, GeometryPart
from datagen.formats.configuration import Configuration, MaterialAssignment, PlacedAsset
from datagen.formats.package import Package
from datagen.formats.shard import ShardReader
from datagen.foundation.bundled import bundled_library
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import InputError, input_error
from datagen.foundation.exr import decode_view
from datagen.foundation.meshes.mesh import SINGULAR, Mesh, inspect_mesh, joined, without_degenerate
from datagen.foundation.meshes.ply import decode_ply
from datagen.library import Library


@dataclass(frozen=True)
class ShardSource:
    """One view's EXR inside a shard, at a byte offset."""

    shard: Path
    member: str
    offset: int
    num_bytes: int

    def read(self, camera: Camera) -> ColorImage:
        """The view's ``beauty``; a smaller ``camera`` gets it averaged over areas."""
        beauty = self._decode(("beauty",))["beauty"].astype(np.float32)
        size = (camera.width_px, camera.height_px)
        if (beauty.shape[1], beauty.shape[0]) != size:
            import cv2

            beauty = np.asarray(cv2.resize(beauty, size, interpolation=cv2.INTER_AREA), np.float32)
        return ColorImage(beauty, np.ones(beauty.shape[:2], dtype=bool))

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        """Stored buffers by name."""
        return self._decode(names)

    def _decode(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        with self.shard.open("rb") as file:
            file.seek(self.offset)
            data = file.read(self.num_bytes)
        try:
            return decode_view(data, names)
        except InputError as error:
            problem = error.problems[0]
            where = f"{self.shard}:{self.member}"
            raise input_error(where, problem.field, problem.got, problem.expected, problem.remedy) from None


def library_of(shard: Path, paths: tuple[Path, ...]) -> Library:
    """The library of a shard: the given paths, those that its dataset folder was started with, or the bundled
    one. Whether it is the right one is told by the hashes in the configuration."""
    folder = DatasetFolder(shard.parent.parent)
    if paths:
        return Library([*paths, *rooms_of(folder.root)])
    if folder.record_path.is_file():
        return Library(folder.library_paths())
    return Library([bundled_library()])


def read_shard(shard: Path, library: Library) -> Capture:
    """A shard as a capture. The packages must have the hashes that the configuration names."""
    reader = ShardReader(shard)
    configuration = reader.configuration()
    records = {record.name: record for record in reader.records()}
    with tarfile.open(shard, mode="r:") as tar:
        members = {Path(info.name).stem: info for info in tar if info.name.endswith(".exr")}
    views = []
    for name, record in records.items():
        if name not in members:
            raise input_error(shard, name, "a record without an image", "both", "make the shard again")
        info = members[name]
        source = ShardSource(shard, info.name, info.offset_data, info.size)
        views.append(CaptureView(name, record.camera.camera(), source))
    geometry, notes = configuration_geometry(configuration, library)
    return Capture(configuration.id, tuple(views), geometry, configuration.lights, notes)


def configuration_geometry(
    configuration: Configuration, library: Library
) -> tuple[CaptureGeometry, tuple[str, ...]]:
    """Every placed part as one mesh in the world, and notes about what a mesh cannot say."""
    found = []
    for placed in (configuration.environment, *configuration.objects):
        package = library.package(placed.asset)
        expected = configuration.assets.get(placed.asset)
        if package.sha256 != expected:
            remedy = "name the library that the capture was rendered with by --library"
            raise input_error(package.path, "hash", package.sha256, str(expected), remedy)
        found.append(_parts_of(package, placed, library))
    return _geometry([part for parts in found for part in parts])


def package_geometry(package: Package, placed: PlacedAsset) -> tuple[CaptureGeometry, tuple[str, ...]]:
    """The parts of one package with materials of its own."""
    return _geometry(_parts_of(package, placed, None))


@dataclass(frozen=True)
class _PlacedPart:
    name: str
    mesh: Mesh
    emission: tuple[float, float, float] | None
    has_opacity: bool


def _parts_of(package: Package, placed: PlacedAsset, library: Library | None) -> list[_PlacedPart]:
    asset = package.asset
    if not isinstance(asset, ObjectAsset | EnvironmentAsset):
        raise input_error(package.path, "kind", asset.kind, "an environment or an object to place")
    found = []
    for part in asset.parts:
        matrix = np.asarray(placed.world_from_asset) @ np.asarray(part.asset_from_part)
        if abs(np.linalg.det(matrix[:3, :3])) < SINGULAR:
            raise input_error(placed.name, f"{part.name} transform", matrix.tolist(), "an invertible matrix")
        mesh = decode_ply(package.read_bytes(part.mesh), f"{package.path}/{part.mesh}")
        faults = inspect_mesh(mesh)
        if faults.is_unusable:
            remedy = "re-export the asset"
            raise input_error(package.path, part.mesh, faults, "a surface of finite triangles", remedy)
        mesh = without_degenerate(_placed(mesh, matrix))
        material = _material(placed, asset, part.material, library)
        emission = placed.emission.get(part.material, material.emission)
        is_lamp = emission is not None and any(c > 0 for c in emission)
        has_opacity = material.opacity not in (None, 1.0)
        name = f"{placed.name}/{part.name}"
        found.append(_PlacedPart(name, mesh, emission if is_lamp else None, has_opacity))
    return found


def _geometry(found: list[_PlacedPart]) -> tuple[CaptureGeometry, tuple[str, ...]]:
    parts: list[GeometryPart] = []
    first = 0
    for part in found:
        parts.append(GeometryPart(part.name, first, len(part.mesh.faces), part.emission))
        first += len(part.mesh.faces)
    notes = dict.fromkeys(
        f"{part.name}: its opacity is not part of the geometry; the part counts as solid"
        for part in found
        if part.has_opacity
    )
    return CaptureGeometry(joined([part.mesh for part in found]), tuple(parts)), tuple(notes)


def _placed(mesh: Mesh, world_from_part: NDArray[np.float64]) -> Mesh:
    world = mesh.transformed(world_from_part)
    if np.linalg.det(world_from_part[:3, :3]) < 0:  # mirrored: keep the triangles wound outward
        return Mesh(world.positions, np.ascontiguousarray(world.faces[:, [0, 2, 1]]), world.normals, world.uv)
    return world


def _material(
    placed: PlacedAsset, asset: ObjectAsset | EnvironmentAsset, slot: str, library: Library | None
) -> Material:
    assignment = placed.materials.get(slot, MaterialAssignment())
    if assignment.asset is None or library is None:
        return asset.materials[slot]
    chosen = library.package(assignment.asset).asset
    if not isinstance(chosen, MaterialAsset):
        raise input_error(placed.name, f"materials.{slot}", chosen.kind, "a material package")
    return chosen.material

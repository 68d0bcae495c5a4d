# SPDX-License-Identifier: MIT
"""Checks of an asset package beyond its schema: meshes, textures, lights and support surfaces.

Errors make a package unusable. Faults that most published scenes have, such as non-manifold edges and flipped
triangles, are warnings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from datagen.formats.asset import (
    MATERIAL_CHANNELS,
    EnvironmentAsset,
    Material,
    MaterialAsset,
    ObjectAsset,
    PanoramaAsset,
    Part,
    Texture,
)
from datagen.formats.category_sizes import size_fault
from datagen.formats.degenerate_shapes import degenerate_problems, has_area
from datagen.formats.lights import DirectionalLight, EnvironmentLight, Light, SkyLight, SpotLight
from datagen.formats.package import Package
from datagen.foundation.errors import InputError, Problem
from datagen.foundation.images import MAX_IMAGE_SIDE_PX, read_image, read_radiance
from datagen.foundation.meshes.mesh import Mesh, inspect_mesh, lying_normals
from datagen.foundation.meshes.ply import decode_ply

BOUNDS_TOLERANCE_M = 2e-3  # declared bounds are rounded when written; larger differences are faults
_REEXPORT = "re-export the asset"


@dataclass(frozen=True)
class CheckReport:
    """Errors and warnings that :func:`check_package` found in ``num_packages`` packages."""

    errors: tuple[Problem, ...]
    warnings: tuple[Problem, ...]
    num_packages: int = 1


class _Checker:
    def __init__(self, package: Package):
        self.package = package
        self.asset = package.asset
        self.where = f"{package.path}/asset.json"
        self.errors: list[Problem] = []
        self.warnings: list[Problem] = []
        self._images: dict[str, tuple[int, str]] = {}  # file -> channel count, fault

    def error(self, field: str, got: object, expected: str, remedy: str = _REEXPORT) -> None:
        self.errors.append(Problem(self.where, field, str(got), expected, remedy))

    def warn(self, field: str, got: object, expected: str, remedy: str = "repair the mesh") -> None:
        self.warnings.append(Problem(self.where, field, str(got), expected, remedy))

    # textures

    def check_image(self, name: str) -> tuple[int, str]:
        """Return an image's number of channels (0 if unreadable) and its fault ('' if none)."""
        if name not in self._images:
            fault, channels = "", 0
            try:
                pixels = read_image(self.package.local_file(name))
                channels = pixels.shape[2]
                if 0 in pixels.shape or max(pixels.shape[:2]) > MAX_IMAGE_SIDE_PX:
                    fault = f"size {pixels.shape[1]}x{pixels.shape[0]}"
                elif pixels.dtype.kind == "f" and not np.isfinite(pixels).all():
                    fault = f"{int((~np.isfinite(pixels)).sum())} NaN or infinite values"
            except InputError as problem:
                fault = problem.problems[0].got
            self._images[name] = channels, fault
        return self._images[name]

    def check_texture(self, field: str, texture: Texture) -> None:
        channels, fault = self.check_image(texture.texture)
        if fault:
            expected = f"finite values and at most {MAX_IMAGE_SIDE_PX} pixels per side"
            self.error(field, f"{texture.texture!r}: {fault}", expected, "replace the image")
            return
        stored = {1: "rgb", 2: "rga", 3: "rgb"}.get(channels, "rgba")  # grey serves as every colour
        if texture.channel != "rgb" and texture.channel not in stored:
            self.error(f"{field}.channel", repr(texture.channel), f"one of the image's {channels} channels")
        if texture.encoding == "srgb" and texture.texture.lower().endswith(".exr"):
            self.error(f"{field}.encoding", "'srgb'", "'linear', as in all EXR files")

    def check_material(self, field: str, material: Material) -> None:
        for channel in MATERIAL_CHANNELS:
            value = getattr(material, channel)
            if isinstance(value, Texture):
                self.check_texture(f"{field}.{channel}", value)
        normal = material.normal
        if normal is not None and (normal.encoding, normal.channel) != ("linear", "rgb"):
            self.error(f"{field}.normal", normal.encoding, "a linear texture with channel 'rgb'")

    def check_radiance(self, field: str, image: str) -> None:
        try:
            read_radiance(self.package.local_file(image))
        except InputError as error:
            got, expected = f"{image!r}: {error.problems[0].got}", "an EXR file of finite radiance"
            self.error(field, got, expected, "replace the image")

    # geometry

    def check_part(self, index: int, part: Part, mesh: Mesh | None, material: Material) -> None:
        field = f"parts[{index}] ({part.name})"
        matrix = np.asarray(part.asset_from_part)[:3, :3]
        if abs(np.linalg.det(matrix)) < 1e-12:
            self.error(f"{field}.asset_from_part", "a singular matrix", "an invertible one")
        if mesh is None:
            return
        if material.textures() and mesh.uv is None:
            self.error(f"{field}.mesh", f"{part.mesh!r} without UVs", "u and v, which its textures need")

    def check_mesh(self, name: str) -> Mesh | None:
        try:
            mesh = decode_ply(self.package.read_bytes(name), f"{self.package.path}/{name}")
        except InputError as problem:
            self.errors.extend(problem.problems)
            return None
        faults = inspect_mesh(mesh)
        if faults.is_empty:
            self.error(name, "no triangles", "a mesh with a surface")
        elif faults.non_finite:
            self.error(name, f"{faults.non_finite} NaN or infinite vertices", "finite numbers")
        elif faults.bad_indices:
            self.error(
                name, f"{faults.bad_indices} triangles with bad indices", "indices of the mesh's vertices"
            )
        elif faults.degenerate == faults.total:
            self.error(name, "triangles of zero area only", "a mesh with a surface")
        if faults.is_unusable:
            return None
        num_tangent = int(lying_normals(mesh).sum())
        for count, what, expected in (
            (faults.degenerate, f"of {faults.total} triangles have no area", "none"),
            (faults.zero_normals, "zero normals", "unit normals"),
            (num_tangent, "normals are tangent to their surface", "perpendicular normals"),
            (faults.non_manifold_edges, "non-manifold edges", "at most two triangles at an edge"),
            (faults.inconsistent_edges, "edges between flipped triangles", "one orientation"),
        ):
            if count:
                self.warn(name, f"{count} {what}", expected)
        return mesh

    def check_bounds(self, asset: ObjectAsset, meshes: dict[str, Mesh | None]) -> None:
        lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
        for part in asset.parts:
            mesh = meshes[part.mesh]
            if mesh is None:
                return
            bare = Mesh(mesh.positions, mesh.faces)  # normals cannot be transformed by a singular matrix
            points = bare.transformed(np.asarray(part.asset_from_part)).positions
            lower, upper = np.minimum(lower, points.min(axis=0)), np.maximum(upper, points.max(axis=0))
        tolerance = BOUNDS_TOLERANCE_M + 1e-3 * float((upper - lower).max())
        bounds = (("minimum_m", asset.minimum_m, lower), ("maximum_m", asset.maximum_m, upper))
        for field, value, actual in bounds:
            if np.abs(np.asarray(value) - actual).max() > tolerance:
                self.error(field, value, f"the bound of its meshes, {np.round(actual, 4).tolist()}")
        if abs(lower[2]) > tolerance:
            self.error("minimum_m[2]", round(float(lower[2]), 4), "0: an object rests on the plane z = 0")
        fault = size_fault(asset)
        if fault:
            self.warn("minimum_m", fault, "", "")
        if asset.scale_range[0] > asset.scale_range[1]:
            self.error("scale_range", asset.scale_range, "smallest first")

    # lights and regions

    def check_light(self, index: int, light: Light) -> None:
        field = f"lights[{index}] ({light.name})"
        if isinstance(light, SpotLight | DirectionalLight):
            self.check_unit(f"{field}.direction", light.direction)
        if isinstance(light, SpotLight) and light.beam_width_rad > light.cutoff_rad:
            self.error(f"{field}.beam_width_rad", light.beam_width_rad, "at most cutoff_rad")
        if isinstance(light, SkyLight):
            self.check_unit(f"{field}.sun_direction", light.sun_direction)
        if isinstance(light, EnvironmentLight) and light.image is not None and light.asset is None:
            self.check_radiance(f"{field}.image", light.image)

    def check_unit(self, field: str, direction: tuple[float, float, float]) -> None:
        if any(direction) and abs(math.sqrt(sum(x * x for x in direction)) - 1) > 1e-3:
            self.error(field, direction, "a unit vector")

    def check_supports(self, asset: EnvironmentAsset) -> None:
        for k, surface in enumerate(asset.support_surfaces):
            normal = np.cross(surface.edge_u_m, surface.edge_v_m)
            if has_area(surface.edge_u_m, surface.edge_v_m) and normal[2] < 0.999 * np.linalg.norm(normal):
                field = f"support_surfaces[{k}] ({surface.name})"
                self.error(field, "a rectangle that does not face up", "edge_u x edge_v along +Z")

    def run(self) -> CheckReport:
        asset = self.asset
        if isinstance(asset, MaterialAsset):
            self.check_material("material", asset.material)
        elif isinstance(asset, PanoramaAsset):
            self.check_radiance("image", asset.image)
        else:
            for name, material in asset.materials.items():
                self.check_material(f"materials.{name}", material)
            meshes = {name: self.check_mesh(name) for name in sorted({p.mesh for p in asset.parts})}
            for k, part in enumerate(asset.parts):
                self.check_part(k, part, meshes[part.mesh], asset.materials[part.material])
            for k, light in enumerate(asset.lights):
                self.check_light(k, light)
            self.errors += degenerate_problems(asset, self.where)
            if isinstance(asset, ObjectAsset):
                self.check_bounds(asset, meshes)
            else:
                self.check_supports(asset)
        return CheckReport(tuple(self.errors), tuple(self.warnings))


def check_package(package: Package) -> CheckReport:
    """Read every mesh and texture of a package and report its faults; never raises for a bad package."""
    return _Checker(package).run()

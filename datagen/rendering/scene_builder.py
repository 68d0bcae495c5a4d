# SPDX-License-Identifier: MIT
"""Builds a Mitsuba scene, with tables of ids and names, from a configuration and its library.

Only used assets are loaded. Each object and each part of an environment is an instance; ids start at 1 and
follow the configuration's order.
"""

from __future__ import annotations

import functools
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import EnvironmentAsset, ObjectAsset, Part
from datagen.formats.configuration import Configuration, PlacedAsset
from datagen.formats.lights import EnvironmentLight
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import InputError, Problem, Problems, raise_problems
from datagen.rendering.geometry import (
    GroupKey,
    MeshCache,
    MeshGroup,
    in_world,
    make_shape,
    split_by_uv_handedness,
)
from datagen.rendering.lights import make_lights
from datagen.rendering.materials import SurfaceMaterial, make_bsdf, resolve_materials
from datagen.rendering.textures import TextureCache

if TYPE_CHECKING:
    from datagen.formats.package import Package
    from datagen.library import Library

BLACK_ALBEDO = {"type": "rgb", "value": [0.0, 0.0, 0.0]}


@dataclass
class AssetCaches:
    """Decoded meshes and uploaded textures, shared by the configurations of one process."""

    meshes: MeshCache = field(default_factory=MeshCache)
    textures: TextureCache = field(default_factory=TextureCache)


process_caches = functools.cache(AssetCaches)
"""Function that returns the caches of this process, created on first use."""


@dataclass
class BuiltScene:
    """A scene ready to render.

    ``instance_names`` and ``material_names`` map ids (from 1) to names. Instances are named ``placed/part``
    for parts of the environment and ``placed`` for objects, materials by asset id or ``asset/slot``, with a
    suffix ``#2`` etc. if there are several colour adjustments. ``face_instances`` maps shape ids to instance
    ids by triangle, ``shape_materials`` to material ids. ``hidden_shapes`` are ids of hidden lights.
    """

    scene: Any
    instance_names: dict[int, str]
    material_names: dict[int, str]
    face_instances: dict[str, NDArray[np.uint32]]
    shape_materials: dict[str, int]
    hidden_shapes: set[str]


def sensor_for(camera: Camera) -> Any:
    """Create a ``pinhole_pixels`` sensor with a box filter for ``camera``."""
    import mitsuba as mi

    from datagen.rendering.plugins import register_rendering_plugins

    register_rendering_plugins()
    size = {"width": camera.width_px, "height": camera.height_px}
    film = {"type": "hdrfilm", **size, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "pinhole_pixels", "film": film})
    sensor.set_camera(camera)
    return sensor


def build_scene(
    configuration: Configuration, library: Library, caches: AssetCaches | None = None
) -> BuiltScene:
    """Build the scene of a configuration. The Mitsuba variant must have been selected.

    Raises :class:`InputError` with all faults: packages that are missing or differ from the configuration's
    hashes, unknown slots, textures on meshes without UVs, lights without area, two skies.
    """
    import mitsuba as mi

    from datagen.rendering.plugins import register_rendering_plugins

    register_rendering_plugins()
    caches = caches or process_caches()
    _check_packages(configuration, library)
    caches.textures.forget_variations()
    builder = _Builder(library, caches)
    for placed in (configuration.environment, *configuration.objects):
        builder.add_placed(placed)
    black = mi.load_dict(
        {"type": "cook_torrance", "diffuse_albedo": BLACK_ALBEDO, "specular_albedo": BLACK_ALBEDO}
    )
    lights = make_lights(configuration, library, black, builder.problems)
    raise_problems(builder.problems)
    return builder.finish(lights.entries, lights.hidden)


def _check_packages(configuration: Configuration, library: Library) -> None:
    """Raise :class:`InputError` unless the library has every used asset with the configuration's hash."""
    used = {light.asset for light in configuration.lights if isinstance(light, EnvironmentLight)}
    for placed in (configuration.environment, *configuration.objects):
        used |= {placed.asset, *(assignment.asset for assignment in placed.materials.values())}
    problems = Problems(f"configuration {configuration.id}")
    for asset_id in sorted(filter(None, used)):
        try:
            got = library.package(asset_id).sha256
        except InputError as error:
            problems.extend(error.problems)
            continue
        expected = configuration.assets.get(asset_id)
        if expected is None:
            problems.add(f"assets.{asset_id}", "", f"the package's hash {got}", "plan it again")
        elif got != expected:
            remedy = "restore the package of that hash, or plan the configuration again"
            problems.add(f"assets.{asset_id}", f"{got} in the library", expected, remedy)
    raise_problems(problems)


class _Builder:
    """Collects triangle groups, ids and faults while placed assets are added one by one."""

    def __init__(self, library: Library, caches: AssetCaches):
        self.library, self.caches = library, caches
        self.problems: list[Problem] = []
        self.groups: dict[GroupKey, MeshGroup] = {}
        self.surfaces: dict[Hashable, SurfaceMaterial] = {}
        self.material_ids: dict[Hashable, int] = {}
        self.material_names: dict[int, str] = {}
        self.instance_names: dict[int, str] = {}

    def add_placed(self, placed: PlacedAsset) -> None:
        """Add all parts of a placed asset."""
        package, where = self.library.package(placed.asset), f"configuration: {placed.name}"
        asset = package.asset
        if not isinstance(asset, ObjectAsset | EnvironmentAsset):
            got, expected = f"{placed.asset!r} ({asset.kind})", "an object or an environment"
            self.problems.append(Problem(where, "asset", got, expected))
            return
        world_from_asset = np.asarray(placed.world_from_asset, dtype=np.float64)
        if not abs(np.linalg.det(world_from_asset[:3, :3])) > 1e-18:
            self.problems.append(Problem(where, "world_from_asset", "singular", "an invertible matrix"))
            return
        surfaces = resolve_materials(placed, package, self.library, self.problems)
        is_object = isinstance(asset, ObjectAsset)
        instance = self._new_instance(placed.name) if is_object else 0
        for part in asset.parts:
            if part.material not in surfaces:
                continue  # resolve_materials has added its fault
            if not is_object:
                instance = self._new_instance(f"{placed.name}/{part.name}")
            self._add_part(part, package, surfaces[part.material], world_from_asset, instance)

    def _new_instance(self, name: str) -> int:
        self.instance_names[len(self.instance_names) + 1] = name
        return len(self.instance_names)

    def _add_part(
        self,
        part: Part,
        package: Package,
        surface: SurfaceMaterial,
        world_from_asset: NDArray[np.float64],
        instance: int,
    ) -> None:
        try:
            mesh = self.caches.meshes.mesh(package, part.mesh)
        except InputError as error:
            self.problems.extend(error.problems)
            return
        if surface.needs_uv and mesh.uv is None:
            got = f"no UVs, but {surface.name} has textures"
            remedy = "unwrap the mesh and export it again, or assign a material of constants"
            where = f"{package.path}/{part.mesh}"
            self.problems.append(Problem(where, f"part {part.name}", got, "texture coordinates", remedy))
            return
        world_from_part = world_from_asset @ np.asarray(part.asset_from_part, dtype=np.float64)
        world = in_world(mesh, world_from_part, uv_scale_of(surface, part, world_from_part))
        has_normal_map = surface.material.normal is not None
        pieces = split_by_uv_handedness(world) if has_normal_map else [(False, world)]
        self._register_material(surface)
        for has_mirrored_uv, piece in pieces:
            has_normals, has_uv = piece.normals is not None, piece.uv is not None
            key = GroupKey(surface.key, surface.emission, has_normals, has_uv, has_mirrored_uv)
            group = self.groups.setdefault(key, MeshGroup())
            group.meshes.append(piece)
            group.instances.append(instance)

    def _register_material(self, surface: SurfaceMaterial) -> None:
        if surface.key in self.material_ids:
            return
        self.surfaces[surface.key] = surface
        new_id = len(self.material_ids) + 1
        self.material_ids[surface.key] = new_id
        name, count = surface.name, 1
        while name in self.material_names.values():
            count += 1
            name = f"{surface.name}#{count}"
        self.material_names[new_id] = name

    def finish(self, light_entries: dict[str, Any], hidden: set[str]) -> BuiltScene:
        """Upload meshes, textures and lights; return the scene. Raises :class:`InputError` for faults."""
        import mitsuba as mi

        from datagen.rendering.plugins import SunDisc  # needs a selected variant

        bsdfs: dict[tuple[Hashable, bool], Any] = {}
        description: dict[str, Any] = {"type": "scene"}
        face_instances: dict[str, NDArray[np.uint32]] = {}
        shape_materials: dict[str, int] = {}
        for index, (key, group) in enumerate(self.groups.items()):
            bsdf_key = (key.bsdf, key.has_mirrored_uv)
            if bsdf_key not in bsdfs:
                surface, textures = self.surfaces[key.bsdf], self.caches.textures
                try:
                    bsdfs[bsdf_key] = make_bsdf(surface, textures, has_mirrored_uv=key.has_mirrored_uv)
                except InputError as error:
                    self.problems.extend(error.problems)
                    continue
            name = f"shape_{index}"
            mesh, face_instances[name] = group.joined()
            description[name] = make_shape(name, mesh, bsdfs[bsdf_key], key.emission)
            shape_materials[name] = self.material_ids[key.bsdf]
        raise_problems(self.problems)
        description.update(light_entries)
        scene = mi.load_dict(description, optimize=False)
        for emitter in scene.emitters():
            if isinstance(emitter, SunDisc):
                emitter.set_scene(scene)  # Mitsuba does not call it for emitters in Python
        names = self.instance_names, self.material_names
        return BuiltScene(scene, *names, face_instances, shape_materials, hidden)


def uv_scale_of(surface: SurfaceMaterial, part: Part, world_from_part: NDArray[np.float64]) -> float:
    """UV scale of a part: as assigned, else one that gives an assigned material its real size, else 1."""
    if surface.uv_scale is not None:
        return surface.uv_scale
    tile_size_m = surface.material.tile_size_m
    if not surface.is_assigned or tile_size_m is None or part.uv_per_m is None:
        return 1.0
    world_per_part = abs(float(np.linalg.det(world_from_part[:3, :3]))) ** (1 / 3)
    return world_per_part / (tile_size_m * part.uv_per_m)

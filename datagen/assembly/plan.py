# SPDX-License-Identifier: MIT
"""Plans a configuration as a pure function of recipe, index and library.

The steps are room, objects, materials, lights and views, each in its module. Every configuration belongs to
one split; with ``splits.disjoint``, the library's rooms, objects and materials are partitioned too.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from datagen.assembly.coverage import Shell, measure
from datagen.assembly.free_space import FreeSpace
from datagen.assembly.generated import generated_room
from datagen.assembly.geometry import AssetGeometry, PackageCache, WorldScene, load_geometry
from datagen.assembly.light_levels import light_room
from datagen.assembly.lights import RoomToLight
from datagen.assembly.likely import LikelyMaterials
from datagen.assembly.looks import RoomStyle
from datagen.assembly.materials import MeanMaterials, assign_materials, mean_materials
from datagen.assembly.placement import Shortfall, place_things
from datagen.assembly.splits import Pools, pools_of_split, split_of
from datagen.assembly.surfaces import surfaces_of
from datagen.assembly.things import PlacedThing, Room, Thing
from datagen.assembly.views import ViewFinder
from datagen.formats.asset import EnvironmentAsset, ObjectAsset
from datagen.formats.configuration import Configuration, PlacedAsset, Split, ViewCamera
from datagen.formats.lights import EnvironmentLight
from datagen.formats.package import Package
from datagen.formats.recipe import Recipe
from datagen.foundation.random import Draws, digest
from datagen.library import Library

NUM_EYES = 384  # number of possible camera positions at which the irradiance of lights is computed
NUM_TRIES = 3  # a configuration with too few objects or views is drawn up to this many times


# per-process caches, shared by all configurations; entries depend only on package contents
_geometry = PackageCache(load_geometry, 6_000_000, lambda g: len(g.faces))  # about 1 GB with Embree's trees
_room = PackageCache(lambda package: Room(_geometry(package)), 2)
_thing = PackageCache(lambda package: Thing(package.as_kind(ObjectAsset), _geometry(package)), 200)
_surfaces = PackageCache(lambda package: surfaces_of(_geometry(package)))
_MEANS = MeanMaterials()


def configuration_id(recipe: Recipe, index: int) -> str:
    """Return the id of configuration ``index``: the recipe's name and the index in five digits."""
    return f"{recipe.name}-{index:05d}"


def assemble(recipe: Recipe, index: int, library: Library) -> Configuration:
    """Plan configuration ``index`` of a recipe; equal arguments yield equal ``canonical_json`` bytes.

    If too few objects or views are found, the configuration is drawn again, up to :data:`NUM_TRIES` times in
    total; a generated room is then replaced. ``rejections`` counts the repetitions as
    ``configuration.retried``. A generated room is not in ``library``;
    :func:`datagen.assembly.generated.room_of` returns it. Raises :class:`IndexError` for an index out of
    range, :class:`InputError` if the library cannot satisfy the recipe.
    """
    if not 0 <= index < recipe.configurations:
        raise IndexError(f"configuration {index} of {recipe.configurations}")
    split = split_of(recipe, index)
    pools = pools_of_split(recipe, library, split)
    earlier: Counter[str] = Counter()
    for attempt in range(NUM_TRIES):
        generated = generated_room(recipe, index, attempt)
        if generated is not None:
            environment = generated.package
            library = library.including(environment)
            pools = replace(pools, foreign_slots=pools.foreign_slots | generated.bare_slots)
        else:
            environment = Draws(recipe.seed, index, "environment").choice(pools.environments)
        rejections: Counter[str] = Counter()
        key = (recipe.seed, index) if attempt == 0 else (recipe.seed, index, "again", attempt)
        try:
            made = _assemble_once(recipe, index, library, split, environment, pools, key, rejections)
        except Shortfall:
            if attempt == NUM_TRIES - 1:
                raise
            rejections["configuration.retried"] += 1
            earlier += rejections
            continue
        total = earlier + rejections  # addition of counters drops counts of 0
        return made.model_copy(update={"rejections": {name: total[name] for name in sorted(total)}})
    raise AssertionError("unreachable")


def _assemble_once(
    recipe: Recipe,
    index: int,
    library: Library,
    split: Split,
    environment: Package,
    pools: Pools,
    key: tuple[int | str, ...],
    rejections: Counter[str],
) -> Configuration:
    room = _room(environment)
    things = [_thing(package) for package in pools.objects]
    weights = _library_weights(recipe, library, pools)
    placed_things = place_things(room, things, recipe.objects, key, rejections, weights)
    placed, packages = _placed_assets(recipe, key, environment, placed_things, pools, library)

    geometries = [_geometry(package) for package in packages]
    scene = _world(geometries, placed)
    space = FreeSpace(room.asset, scene.rays, recipe.cameras.height_m)
    space.check()
    eyes = space.points(NUM_EYES, 0.1, Draws(*key, "eyes"), rejections)
    assigned = tuple(mean_materials(p, library, _MEANS) for p in placed)
    assets = tuple(g.asset for g in geometries)
    to_light = RoomToLight(
        room.asset, scene, tuple(placed), assets, assigned, eyes, space.has_consistent_winding
    )
    lighting = light_room(to_light, recipe.lights, library, key, rejections)
    lit = [p.model_copy(update={"emission": e}) for p, e in zip(placed, lighting.emission, strict=True)]

    shell = Shell(scene, _surfaces(environment))
    finder = ViewFinder(scene, shell, space, lighting, recipe.cameras, recipe.resolution, key, rejections)
    cameras = finder.find(recipe.views)
    return Configuration(
        id=configuration_id(recipe, index),
        index=index,
        seed=int.from_bytes(digest(*key, "renderer")[:8], "little") >> 1,
        split=split,
        environment=lit[0],
        objects=tuple(lit[1:]),
        lights=lighting.lights,
        cameras=tuple(ViewCamera.from_camera(f"view-{k:03d}", camera) for k, camera in enumerate(cameras)),
        assets=_hashes(lit, lighting.lights, library),
        coverage=measure(scene, shell, assigned, cameras),
    )


def _placed_assets(
    recipe: Recipe,
    key: tuple[int | str, ...],
    environment: Package,
    things: list[PlacedThing],
    pools: Pools,
    library: Library,
) -> tuple[list[PlacedAsset], list[Package]]:
    """Assign *likely* or *wild* materials (see :class:`datagen.formats.recipe.Variation`); return the placed
    assets and their packages, with the room first."""
    packages = [environment] + [library.package(t.thing.asset.id) for t in things]
    weights, draws = recipe.materials.variation, Draws(*key[:2], "style")
    likely = None
    if draws.chance(weights.likely / (weights.likely + weights.wild)):
        likely = LikelyMaterials(RoomStyle.draw(draws), pools.materials, recipe.materials, _MEANS)
    placed = []
    for item, package in enumerate(packages):
        draws, foreign = Draws(*key, "materials", item), pools.foreign_slots
        if likely is not None:
            materials = likely.assign(package, _surfaces(package), draws, foreign)
        else:
            materials = assign_materials(package, pools.materials, recipe.materials, _MEANS, draws, foreign)
        if item == 0:
            placed.append(PlacedAsset(name="room", asset=package.id, materials=materials))
            continue
        thing = things[item - 1]
        rows = tuple(tuple(round(float(x), 9) for x in row) for row in thing.world_from_asset)
        placed.append(
            PlacedAsset(
                name=f"thing-{item - 1:02d}-{package.id}",
                asset=package.id,
                world_from_asset=rows,  # type: ignore[arg-type]
                materials=materials,
                support=thing.support.name,
            )
        )
    return placed, packages


def _library_weights(recipe: Recipe, library: Library, pools: Pools) -> dict[str, tuple[str, float]]:
    """Map object ids to library and weight (default: 1); empty if the recipe sets no ``library_weights``."""
    wanted = recipe.objects.library_weights
    if not wanted:
        return {}
    names = (*recipe.library, *map(str, library.paths[len(recipe.library) :]))
    found = {}
    for package in pools.objects:
        name = names[library.paths.index(library.root_of(package))]
        found[package.id] = (name, wanted.get(name, 1.0))
    return found


def _world(geometries: list[AssetGeometry], placed: list[PlacedAsset]) -> WorldScene:
    objects = [
        (geometry, np.array(p.world_from_asset))
        for geometry, p in zip(geometries[1:], placed[1:], strict=True)
    ]
    assert isinstance(geometries[0].asset, EnvironmentAsset)
    return WorldScene(geometries[0], objects)


def world_of(configuration: Configuration, library: Library) -> WorldScene:
    """Return the opaque triangles of a configuration's room and objects, in world space."""
    placed = [configuration.environment, *configuration.objects]
    return _world([_geometry(library.package(p.asset)) for p in placed], placed)


def _hashes(placed: list[PlacedAsset], lights: tuple, library: Library) -> dict[str, str]:
    used = {p.asset for p in placed}
    used |= {a.asset for p in placed for a in p.materials.values() if a.asset is not None}
    used |= {light.asset for light in lights if isinstance(light, EnvironmentLight) and light.asset}
    return {asset_id: library.package(asset_id).sha256 for asset_id in sorted(used)}

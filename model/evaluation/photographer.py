# SPDX-License-Identifier: MIT
"""Cameras for the photographs of a test scene, and for novel views on a walk.

Photographs use the view sampling of datasets (:mod:`datagen.assembly.views`): cameras at distinct positions
in free space, at the height of a handheld camera, directed at the room's contents. The walk leads through
free space between two photographs of similar direction, so that these cover most surfaces visible from it.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from datagen.assembly.coverage import Shell
from datagen.assembly.free_space import FreeSpace
from datagen.assembly.geometry import Floats, RayScene, WorldScene, load_geometry
from datagen.assembly.light_levels import light_room
from datagen.assembly.lights import RoomToLight
from datagen.assembly.materials import MeanMaterials, mean_materials
from datagen.assembly.plan import NUM_EYES
from datagen.assembly.surfaces import surfaces_of
from datagen.assembly.views import ViewFinder, preview_of
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.configuration import PlacedAsset, ViewCamera
from datagen.formats.package import Package
from datagen.formats.recipe import CameraRecipe, LightRecipe
from datagen.foundation.axes import affine
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import input_error
from datagen.foundation.random import Draws
from datagen.library import Library

_OWN_LIGHTS = LightRecipe(
    native_probability=1.0, area_probability=0.0, point_probability=0.0, daylight_probability=0.0
)
_MAX_TURN_RAD = np.radians(75.0)
_CHECKED_CAMERAS = 12  # maximum number of checked cameras of a walk


def choose_cameras(
    library: Library,
    package: Package,
    recipe: CameraRecipe,
    resolution: tuple[int, int],
    num_views: int,
    num_novel: int,
    seed: int,
) -> tuple[ViewCamera, ...]:
    """Choose ``num_views`` cameras view-000 ... and ``num_novel`` cameras path-000 ... on a walk.

    ``resolution`` is (width, height). Raises :class:`InputError` if the room has too few camera positions, or
    if its own lights illuminate none of them.
    """
    geometry = load_geometry(package)
    asset = geometry.asset
    assert isinstance(asset, EnvironmentAsset)
    placed = PlacedAsset(name="room", asset=package.id)
    scene = WorldScene(geometry, [])
    space = FreeSpace(asset, scene.rays, recipe.height_m)
    space.check()
    key: tuple[int | str, ...] = (seed, package.id, "photographs")
    rejections: Counter[str] = Counter()
    eyes = space.points(NUM_EYES, 0.1, Draws(*key, "eyes"), rejections)
    assigned = mean_materials(placed, library, MeanMaterials())
    room = RoomToLight(asset, scene, (placed,), (asset,), (assigned,), eyes, space.has_consistent_winding)
    lighting = light_room(room, _OWN_LIGHTS, library, key, rejections)
    shell = Shell(scene, surfaces_of(geometry))
    cameras = ViewFinder(scene, shell, space, lighting, recipe, resolution, key, rejections).find(num_views)
    walk = _walk(cameras, num_novel, space, recipe.min_distance_m)
    named = {f"view-{k:03d}": camera for k, camera in enumerate(cameras)}
    named |= {f"path-{k:03d}": camera for k, camera in enumerate(walk)}
    return tuple(ViewCamera.from_camera(name, camera) for name, camera in named.items())


def walk_between(
    cameras: list[Camera], count: int, room: EnvironmentAsset, rays: RayScene, recipe: CameraRecipe
) -> list[Camera]:
    """Place ``count`` cameras on a walk between two of ``cameras`` in a furnished room.

    Raises :class:`InputError` if there is no free path between any two of them.
    """
    return _walk(cameras, count, FreeSpace(room, rays, recipe.height_m), recipe.min_distance_m)


def _walk(cameras: list[Camera], count: int, space: FreeSpace, near_m: float) -> list[Camera]:
    """Place ``count`` cameras at equal distances between the most distant pair of ``cameras`` that have
    similar directions and a free path, ends excluded; ``near_m`` is the recipe's ``min_distance_m``."""
    if count == 0:
        return []
    for first, last in _pairs(cameras):
        steps = np.arange(1, count + 1) / (count + 1)
        walk = [_between(cameras[first], cameras[last], share) for share in steps.tolist()]
        checked = {round(k) for k in np.linspace(0, count - 1, min(count, _CHECKED_CAMERAS))}
        if _is_free(cameras[first], cameras[last], space.rays) and all(
            _has_free_view(walk[k], space, near_m) for k in sorted(checked)
        ):
            return walk
    where = f"environment {space.environment.id}"
    expected = "two photographs with a free path between them"
    raise input_error(where, "novel_views", "none", expected, "set more views, or novel_views: 0")


def _pairs(cameras: list[Camera]) -> NDArray[np.int64]:
    """Indices (N, 2) of pairs of cameras with a small angle between directions, by decreasing distance."""
    positions = np.array([camera.position_m for camera in cameras])
    forwards = np.array([camera.forward for camera in cameras])
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    angle = np.arccos(np.clip(forwards @ forwards.T, -1.0, 1.0))
    first, last = np.nonzero(np.triu(angle <= _MAX_TURN_RAD, 1))
    order = np.argsort(-distance[first, last], kind="stable")
    return np.stack([first, last], axis=1)[order]


def _between(first: Camera, last: Camera, share: float) -> Camera:
    ends = Rotation.from_matrix(np.stack([c.world_from_camera[:3, :3] for c in (first, last)]))
    position_m = (1 - share) * first.position_m + share * last.position_m
    pose = affine(Slerp([0.0, 1.0], ends)(share).as_matrix(), position_m)
    focal = (1 - share) * first.fx_px + share * last.fx_px
    size = first.width_px, first.height_px
    return Camera(*size, focal, focal, first.cx_px, first.cy_px, np.round(pose, 9))


def _is_free(first: Camera, last: Camera, rays: RayScene) -> bool:
    offset = last.position_m - first.position_m
    length = float(np.linalg.norm(offset))
    start: Floats = first.position_m[None]
    return length > 0 and not rays.occluded(start, (offset / length)[None], np.array([length])).any()


def _has_free_view(camera: Camera, space: FreeSpace, near_m: float) -> bool:
    if space.fault(camera.position_m, 0.5 * near_m):
        return False
    directions = preview_of(camera).ray_directions().reshape(-1, 3)
    hits = space.rays.cast(camera.position_m, directions)
    return bool((hits.distance_m < 2 * near_m).mean() < 0.1)

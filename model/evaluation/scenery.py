# SPDX-License-Identifier: MIT
"""The true scene and its reconstructions as configurations that differ only in their surfaces.

Own light: the scene's lamps and lights. Modified light: these times a gain, plus further lights.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.assembly.things import pose
from datagen.formats.asset import EnvironmentAsset, ObjectAsset
from datagen.formats.base import matrix4
from datagen.formats.capture import CaptureGeometry
from datagen.formats.configuration import Configuration, PlacedAsset
from datagen.formats.lights import AreaLight, Light, scaled
from datagen.formats.package import open_package
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import input_error
from datagen.library import Library
from datagen.rendering.capture_geometry import has_surface
from model.evaluation.suite import InsertedObject, ModifiedLight

CEILING_SIDE_M = 0.6
_CEILING_RADIANCE = (12.0, 12.0, 12.0)
_GAP_M = 0.1  # between lamp and ceiling
_LAMP_HEIGHT_M = 1.0  # above the camera, if there is no ceiling
_LEVEL = 0.95  # minimum cosine between the normal of a level surface and the vertical
_MARGIN, _GROUND = 0.03, 0.12  # margin above an object, and below its base, in image heights
_PICTURED_HEIGHT = 0.35  # height of an inserted object, in image heights
_INSERTED = "inserted"


@dataclass(frozen=True)
class Scenery:
    """A configuration and the folders of its packages."""

    configuration: Configuration
    library: tuple[Path, ...]

    def seen_by(self, cameras: Sequence[str]) -> Scenery:
        """Return a copy with only the named ``cameras``, in this order."""
        by_name = {camera.name: camera for camera in self.configuration.cameras}
        chosen = tuple(by_name[name] for name in cameras)
        return self._with({"cameras": chosen})

    def lit_by(self, modified: ModifiedLight, added: Sequence[Light]) -> Scenery:
        """Return a copy under its own lights times ``modified.own_gain`` plus the ``added`` lights.

        If the gain is 0, visible lights remain as black surfaces, like lamps that are switched off.
        """
        gain = modified.own_gain
        own = [scaled(light, gain) for light in self.configuration.lights if gain > 0 or has_surface(light)]
        lights = (*own, *added)
        with Library(self.library) as library:
            placed = [
                _dimmed(placed, library, gain)
                for placed in (self.configuration.environment, *self.configuration.objects)
            ]
        return self._with({"lights": lights, "environment": placed[0], "objects": tuple(placed[1:])})

    def with_object(self, inserted: InsertedObject, position_m: NDArray) -> Scenery:
        """Return a copy with ``inserted`` at ``position_m`` (3,) in metres.

        Raises :class:`InputError` if its package does not contain an object.
        """
        package = open_package(Path(inserted.package))
        if not isinstance(package.asset, ObjectAsset):
            raise input_error(package.path, "kind", package.asset.kind, "an object package to insert")
        matrix = pose(inserted.scale, np.radians(inserted.yaw_deg), position_m)
        thing = PlacedAsset(name=_INSERTED, asset=package.id, world_from_asset=matrix4(matrix))
        configuration = self.configuration
        known = package.id in configuration.assets
        return Scenery(
            configuration.model_copy(
                update={
                    "objects": (*configuration.objects, thing),
                    "assets": {**configuration.assets, package.id: package.sha256},
                }
            ),
            self.library if known else (*self.library, package.path),
        )

    def with_seed(self, seed: int) -> Scenery:
        """Return a copy with another ``seed`` of the renderer."""
        return self._with({"seed": seed})

    def _with(self, changes: dict[str, Any]) -> Scenery:
        return Scenery(self.configuration.model_copy(update=changes), self.library)


def recovered_scenery(
    truth: Scenery, asset: Path, emission: dict[str, tuple[float, float, float]], lamps: Collection[str] = ()
) -> Scenery:
    """Return ``truth`` with the surfaces of ``asset``, the package of a reconstruction, in place of its room.

    ``emission`` (RGB radiance by slot) replaces that of the package's lamps, in place of the visible lights
    named ``lamps``, which are omitted; other lights, and inserted objects, are those of ``truth``.
    """
    package = open_package(asset)
    configuration = truth.configuration
    inserted = tuple(placed for placed in configuration.objects if placed.name == _INSERTED)
    changes = {
        "environment": PlacedAsset(name="environment", asset=package.id, emission=emission),
        "objects": inserted,
        "lights": tuple(
            light for light in configuration.lights if light.name not in lamps or not has_surface(light)
        ),
        "assets": {**configuration.assets, package.id: package.sha256},
    }
    return Scenery(configuration.model_copy(update=changes), (*truth.library, asset))


def _dimmed(placed: PlacedAsset, library: Library, gain: float) -> PlacedAsset:
    """Return ``placed`` with the radiance of its lamps times ``gain``."""
    asset = library.package(placed.asset).asset
    assert isinstance(asset, EnvironmentAsset | ObjectAsset)
    emission = {}
    for slot, material in asset.materials.items():
        radiance = placed.emission.get(slot, material.emission)
        if radiance is not None:
            red, green, blue = (gain * channel for channel in radiance)
            emission[slot] = (red, green, blue)
    return placed.model_copy(update={"emission": emission})


def added_lights(
    modified: ModifiedLight, geometry: CaptureGeometry, cameras: Sequence[Camera]
) -> list[Light]:
    """Lights that ``modified`` adds; the lamp "ceiling" is above the most central of ``cameras``."""
    if modified.lights != "ceiling":
        return list(modified.lights)
    positions = np.array([camera.position_m for camera in cameras])
    middle = positions.mean(axis=0)
    eye = positions[np.linalg.norm(positions - middle, axis=1).argmin()]
    height = _height_above(geometry, eye)
    x, y, z = (float(v) for v in eye)
    z += _LAMP_HEIGHT_M if height is None else max(height - _GAP_M, 0.5 * height)
    half = 0.5 * CEILING_SIDE_M
    return [
        AreaLight(
            name="ceiling",
            origin_m=(x - half, y - half, z),
            edge_u_m=(0.0, CEILING_SIDE_M, 0.0),  # the light emits along u x v, downwards
            edge_v_m=(CEILING_SIDE_M, 0.0, 0.0),
            radiance=_CEILING_RADIANCE,
            is_visible=False,
        )
    ]


def _height_above(geometry: CaptureGeometry, eye: NDArray) -> float | None:
    """Height in metres of the free space above the point ``eye`` (3,); None under the open sky."""
    from trimesh import Trimesh

    mesh = Trimesh(geometry.mesh.positions, geometry.mesh.faces, process=False)
    hits, _, _ = mesh.ray.intersects_location([eye], [[0.0, 0.0, 1.0]], multiple_hits=False)
    return float(hits[0][2] - eye[2]) if len(hits) else None


@dataclass(frozen=True)
class Place:
    """Position (3,) in metres for an inserted object, and its ``cost`` >= 0; the lowest cost is chosen."""

    position_m: NDArray[np.float64]
    cost: float


def level_place(camera: Camera, depth_z_m: NDArray, normal_world: NDArray, height_m: float) -> Place | None:
    """Find a level position in front of a camera for an object of ``height_m``; None if there is none.

    The object fits into the image vertically, near the middle of the lower half, and is preferably about a
    third as high as the image. ``depth_z_m`` is (H, W, 1), ``normal_world`` (H, W, 3).
    """
    from scipy.ndimage import minimum_filter

    depth = depth_z_m[..., 0].astype(np.float64)
    rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]]
    level = (normal_world[..., 2] > _LEVEL) & (depth > 0)
    window = max(3, depth.shape[1] // 24)
    level = minimum_filter(level.astype(np.uint8), window) > 0
    height = height_m * camera.fy_px / np.maximum(depth, 1e-6) / camera.height_px
    share = rows / camera.height_px
    chosen = level & (share - height > _MARGIN) & (share < 1 - _GROUND)
    if not chosen.any():
        return None
    x = (columns - 0.5 * camera.width_px) / camera.width_px
    y = (rows - 0.7 * camera.height_px) / camera.height_px
    cost = np.where(chosen, x**2 + y**2 + np.abs(np.log(height / _PICTURED_HEIGHT)), np.inf)
    row, column = np.unravel_index(int(cost.argmin()), cost.shape)
    z = depth[row, column]
    u, v = (column + 0.5 - camera.cx_px) / camera.fx_px, (row + 0.5 - camera.cy_px) / camera.fy_px
    position = (camera.world_from_camera @ np.array([u * z, v * z, z, 1.0]))[:3]
    return Place(np.asarray(position), float(cost[row, column]))

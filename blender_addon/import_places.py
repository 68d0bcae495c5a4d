# SPDX-License-Identifier: GPL-3.0-or-later
"""Adds the lights, the world, cameras and markers of an asset package to Blender: the inverse of ``gather``.

Packages are in metres and watts; ``metres`` is the number of metres per Blender unit. Items without a
counterpart in Blender are left out, with a sentence about each in ``remarks``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from .gather.lights import fitted_beam_width
from .gather.world import WORLD_FROM_ENVIRONMENT

IMAGE_SHAPE = ("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y")
_SENSOR_MM = 36.0
_UNLIMITED_CLIP_M = (1e-3, 1e5)  # for cameras without clipping; Blender's limits must be finite
_SKEW = 1e-4  # cosine between the edges of a rectangle above which it is refused


class Places:
    """Adds the lights, cameras and markers of one package to ``collection``."""

    def __init__(self, collection: bpy.types.Collection, metres: float, remarks: list[str]):
        self.collection, self.metres, self.remarks = collection, metres, remarks

    def _link(self, name: str, data: bpy.types.ID | None, matrix: NDArray[np.float64]) -> bpy.types.Object:
        thing = bpy.data.objects.new(name, data)
        thing.matrix_world = matrix.T.tolist()
        self.collection.objects.link(thing)
        return thing

    def _frame(self, origin_m: Any, rotation: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        matrix = np.eye(4)
        if rotation is not None:
            matrix[:3, :3] = rotation
        matrix[:3, 3] = np.asarray(origin_m, dtype=np.float64) / self.metres
        return matrix

    # ---- lights

    def add_lights(self, lights: list[dict[str, Any]]) -> None:
        """Add all lights except environment lights, which :meth:`set_world` adds."""
        makers: dict[str, Callable[[dict[str, Any]], bpy.types.Object | None]] = {
            "point": self._point,
            "sphere": self._sphere,
            "spot": self._spot,
            "directional": self._sun,
            "area": self._area,
        }
        for light in lights:
            if light["type"] in makers:
                makers[light["type"]](light)
            elif light["type"] != "environment":
                self.remarks.append(f"light {light['name']!r} of type {light['type']} is left out")

    def _light(
        self, kind: str, light: dict[str, Any], power: Any, matrix: NDArray[np.float64]
    ) -> bpy.types.Object:
        """Add a light object; ``power`` (3,) is energy times colour."""
        data = bpy.data.lights.new(light["name"], kind)
        data.energy = max(power)
        data.color = [v / max(power) for v in power] if max(power) > 0 else (0, 0, 0)
        return self._link(light["name"], data, matrix)

    def _point(self, light: dict[str, Any]) -> bpy.types.Object:
        power = np.array(light["intensity"]) * 4 * math.pi / self.metres**2
        thing = self._light("POINT", light, power, self._frame(light["position_m"]))
        thing.data.shadow_soft_size = 0
        return thing

    def _sphere(self, light: dict[str, Any]) -> bpy.types.Object:
        radius = light["radius_m"] / self.metres
        power = np.array(light["radiance"]) * 4 * math.pi**2 * radius**2
        thing = self._light("POINT", light, power, self._frame(light["position_m"]))
        thing.data.shadow_soft_size = radius
        if hasattr(thing.data, "use_soft_falloff"):
            thing.data.use_soft_falloff = False
        thing.visible_camera = True
        return thing

    def _spot(self, light: dict[str, Any]) -> bpy.types.Object:
        power = np.array(light["intensity"]) * 4 * math.pi / self.metres**2
        frame = self._frame(light["position_m"], _emitting_along(light["direction"]))
        thing = self._light("SPOT", light, power, frame)
        thing.data.shadow_soft_size = 0
        half = light["cutoff_rad"]
        thing.data.spot_size = 2 * half
        thing.data.spot_blend = self._blend(light["name"], half, light["beam_width_rad"])
        return thing

    def _blend(self, name: str, half_angle: float, beam_width: float) -> float:
        """Spot blend in [0, 1] with the flux of a linear fall-off from ``beam_width`` to ``half_angle``."""
        if beam_width >= fitted_beam_width(half_angle, 0.0) - 1e-5:
            return 0.0
        if beam_width < fitted_beam_width(half_angle, 1.0) - 1e-5:
            self.remarks.append(f"spot {name!r}: the edge is softer than Blender supports")
            return 1.0
        low, high = 0.0, 1.0
        for _ in range(40):
            middle = (low + high) / 2
            low, high = (
                (middle, high) if fitted_beam_width(half_angle, middle) > beam_width else (low, middle)
            )
        return (low + high) / 2

    def _sun(self, light: dict[str, Any]) -> bpy.types.Object:
        frame = self._frame((0, 0, 0), _emitting_along(light["direction"]))
        thing = self._light("SUN", light, light["irradiance"], frame)
        thing.data.angle = light.get("angular_diameter_rad", 0.0)
        return thing

    def _area(self, light: dict[str, Any]) -> bpy.types.Object | None:
        edge_u, edge_v = np.array(light["edge_u_m"]), np.array(light["edge_v_m"])
        rotation = self._rotation(f"light {light['name']!r}", edge_u, -edge_v)
        if rotation is None:
            return None
        is_disk = light.get("shape", "rectangle") == "disk"
        sizes = np.linalg.norm([edge_u, edge_v], axis=1) / self.metres
        power = np.array(light["radiance"]) * math.pi * sizes.prod() * (math.pi / 4 if is_disk else 1)
        centre = np.array(light["origin_m"]) + (edge_u + edge_v) / 2
        thing = self._light("AREA", light, power, self._frame(centre, rotation))
        thing.data.shape = "ELLIPSE" if is_disk else "RECTANGLE"
        thing.data.size, thing.data.size_y = sizes
        thing.visible_camera = light.get("is_visible", True)
        return thing

    def _rotation(self, what: str, along_x: NDArray, along_y: NDArray) -> NDArray[np.float64] | None:
        """Rotation with X and Y along two edges; None, with a remark, if they are not perpendicular."""
        lengths = np.linalg.norm([along_x, along_y], axis=1)
        if not lengths.min() > 0 or abs(along_x @ along_y) > _SKEW * lengths.prod():
            self.remarks.append(f"{what} is not a rectangle and is left out")
            return None
        x = along_x / lengths[0]
        z = np.cross(x, along_y)
        z /= np.linalg.norm(z)
        return np.stack([x, np.cross(z, x), z], axis=1)

    # ---- the world

    def set_world(self, light: dict[str, Any], image: Path | None, pack: bool) -> None:
        """Make an environment light the scene's world; ``pack``: store its ``image`` in the .blend file."""
        scene = bpy.context.scene
        if scene.world is not None:
            self.remarks.append(f"the world {scene.world.name!r} was replaced by the package's world")
        world = bpy.data.worlds.new(light["name"])
        if hasattr(world, "use_nodes") and not world.use_nodes:
            world.use_nodes = True
        scene.world = world
        tree = world.node_tree
        background = tree.nodes["Background"]
        if image is None:
            radiance = light.get("radiance", (1.0, 1.0, 1.0))
            strength = max(radiance)
            colour = [v / strength for v in radiance] if strength > 0 else (0.0, 0.0, 0.0)
            background.inputs["Color"].default_value = (*colour, 1)
            background.inputs["Strength"].default_value = strength
            return
        texture, mapping = tree.nodes.new("ShaderNodeTexEnvironment"), tree.nodes.new("ShaderNodeMapping")
        coordinates = tree.nodes.new("ShaderNodeTexCoord")
        for column, node in enumerate((texture, mapping, coordinates), start=1):
            node.location = (background.location.x - 300 * column, background.location.y)
        texture.image = bpy.data.images.load(str(image), check_existing=True)
        texture.image.colorspace_settings.name = "Linear Rec.709"
        if pack:
            texture.image.pack()
        matrix = np.array(light.get("world_from_environment", np.eye(4)))
        turn = Matrix((matrix @ np.linalg.inv(WORLD_FROM_ENVIRONMENT)).tolist()).to_3x3()
        # the coordinates rotate by the inverse of the image's rotation
        mapping.inputs["Rotation"].default_value = turn.inverted().to_euler()
        background.inputs["Strength"].default_value = light.get("scale", 1.0)
        tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
        tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
        tree.links.new(texture.outputs["Color"], background.inputs["Color"])

    # ---- cameras

    def add_cameras(self, cameras: list[dict[str, Any]]) -> None:
        """Add cameras. The first sets the scene's resolution and pixel aspect if the scene has no camera."""
        scene, render = bpy.context.scene, bpy.context.scene.render
        for index, camera in enumerate(cameras):
            width, height = camera["width_px"], camera["height_px"]
            aspect = camera["fx_px"] / camera["fy_px"]  # ratio of a pixel's height to its width
            if index == 0 and scene.camera is None:
                shape = (width, height, 100, max(1.0, 1 / aspect), max(1.0, aspect))
                for name, value in zip(IMAGE_SHAPE, shape, strict=True):
                    setattr(render, name, value)
            thing = self._camera(camera, aspect)
            if scene.camera is None:
                scene.camera = thing
            has = (render.resolution_x, render.resolution_y, render.pixel_aspect_y / render.pixel_aspect_x)
            if not np.allclose(has, (width, height, aspect), rtol=1e-4):
                self.remarks.append(
                    f"camera {camera['name']!r} has {width} x {height} pixels with an aspect (height / "
                    f"width) of {aspect:.4g}, unlike the scene; set both in the scene's output properties"
                )

    def _camera(self, camera: dict[str, Any], aspect: float) -> bpy.types.Object:
        data = bpy.data.cameras.new(camera["name"])
        width, height = camera["width_px"], camera["height_px"]
        data.sensor_fit, data.sensor_width = "HORIZONTAL", _SENSOR_MM
        data.lens = camera["fx_px"] / width * _SENSOR_MM
        data.shift_x = (width / 2 - camera["cx_px"]) / width
        data.shift_y = (camera["cy_px"] - height / 2) * aspect / width
        near, far = camera.get("clip_m") or _UNLIMITED_CLIP_M
        data.clip_start, data.clip_end = near / self.metres, far / self.metres
        pose = np.array(camera["asset_from_camera"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        return self._link(camera["name"], data, self._frame(pose[:3, 3], pose[:3, :3]))

    # ---- markers

    def add_markers(self, data: dict[str, Any]) -> None:
        """Add support surfaces, light slots, openings and camera regions as tagged wireframes."""
        for entry in data.get("support_surfaces", ()):
            tags = {"sm_kind": entry["kind"], "sm_clearance_m": entry["clearance_m"]}
            self._rectangle(entry, "support_surface", tags)
        for entry in data.get("light_slots", ()):
            if entry["kind"] == "point":
                thing = self._link(entry["name"], None, self._frame(entry["origin_m"]))
                thing.empty_display_size = 0.1 / self.metres
                thing["sm_role"], thing["sm_kind"] = "light_slot", "point"
            else:
                self._rectangle(entry, "light_slot", {"sm_kind": entry["kind"]})
        for entry in data.get("openings", ()):
            self._rectangle(entry, "opening", {})
        for index, entry in enumerate(data.get("camera_regions", ())):
            low, high = (np.array(entry[key]) / self.metres for key in ("minimum_m", "maximum_m"))
            corners = [[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)]
            faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
            self._marker(f"camera_region_{index:03d}", corners, faces, np.eye(4), "camera_region", {})

    def _rectangle(self, entry: dict[str, Any], role: str, tags: dict[str, Any]) -> None:
        edge_u, edge_v = np.array(entry["edge_u_m"]), np.array(entry["edge_v_m"])
        rotation = self._rotation(f"{role} {entry['name']!r}", edge_u, edge_v)
        if rotation is None:
            return
        u, v = np.linalg.norm([edge_u, edge_v], axis=1) / self.metres
        corners = [(0, 0, 0), (u, 0, 0), (u, v, 0), (0, v, 0)]
        frame = self._frame(entry["origin_m"], rotation)
        self._marker(entry["name"], corners, [(0, 1, 2, 3)], frame, role, tags)

    def _marker(
        self,
        name: str,
        corners: Any,
        faces: Any,
        matrix: NDArray[np.float64],
        role: str,
        tags: dict[str, Any],
    ) -> None:
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata([tuple(map(float, corner)) for corner in corners], [], faces)
        thing = self._link(name, mesh, matrix)
        thing.display_type, thing.hide_render = "WIRE", True
        for key, value in {"sm_role": role, **tags}.items():
            thing[key] = value


def _emitting_along(direction: Any) -> NDArray[np.float64]:
    """A rotation (3, 3) with -Z along ``direction`` and arbitrary roll."""
    z = -np.asarray(direction, dtype=np.float64)
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)

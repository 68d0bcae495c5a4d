# SPDX-License-Identifier: MIT
"""A room of 4 x 3 x 2.5 m with known materials of the project's BSDF and known light, rendered by Mitsuba's
path tracer: coloured walls, a tiled floor, a glossy and a metal panel, a mirror, a lamp in the ceiling and a
window onto a blue sky."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import Capture, CaptureGeometry, CaptureView, ColorImage, GeometryPart
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from tests.once import once

SIDES = np.array([4.0, 3.0, 2.5])
LAMP = (14.0, 13.0, 10.0)
SKY = (1.5, 2.5, 5.0)
SUN_DIRECTION, SUN_IRRADIANCE = (0.8, 0.0, 0.6), (60.0, 50.0, 35.0)
"""Direction to the sun, which shines through the window on the floor, and irradiance at normal incidence."""
SIZE = (80, 60)
Color = tuple[float, float, float]


@dataclass(frozen=True)
class Quad:
    """A rectangle from ``corner`` along ``u`` and ``v``; u x v points into the room."""

    name: str
    corner: Color
    u: Color
    v: Color
    diffuse: Color
    specular: Color = (0.0, 0.0, 0.0)
    roughness: float = 1.0
    emission: Color | None = None

    def corners(self) -> NDArray[np.float64]:
        a, u, v = (np.array(part) for part in (self.corner, self.u, self.v))
        return np.stack([a, a + u, a + u + v, a + v])


def quads() -> list[Quad]:
    """All surfaces of the room."""
    x, y, z = (float(side) for side in SIDES)
    red, green, grey, white = (0.6, 0.3, 0.25), (0.3, 0.5, 0.3), (0.5, 0.5, 0.5), (0.8, 0.8, 0.8)
    found = [
        Quad("west", (0, 0, 0), (0, y, 0), (0, 0, z), red),
        Quad("south", (0, 0, 0), (0, 0, z), (x, 0, 0), green),
        Quad("north", (0, y, 0), (x, 0, 0), (0, 0, z), grey),
        Quad("ceiling", (0, 0, z), (0, y, 0), (x, 0, 0), white),
        # the east wall around a window of 1.2 x 1 m
        Quad("east-low", (x, 0, 0), (0, 0, 0.9), (0, y, 0), grey),
        Quad("east-high", (x, 0, 1.9), (0, 0, 0.6), (0, y, 0), grey),
        Quad("east-left", (x, 0, 0.9), (0, 0, 1.0), (0, 0.9, 0), grey),
        Quad("east-right", (x, 2.1, 0.9), (0, 0, 1.0), (0, 0.9, 0), grey),
        Quad("glossy", (0.02, 0.5, 0.3), (0, 1.0, 0), (0, 0, 1.2), (0.15, 0.2, 0.4), (0.04,) * 3, 0.25),
        Quad("metal", (0.4, y - 0.02, 0.4), (1.2, 0, 0), (0, 0, 1.4), (0, 0, 0), (0.9, 0.65, 0.35), 0.35),
        Quad("mirror", (2.4, 0.02, 0.8), (0, 0, 0.9), (0.8, 0, 0), (0, 0, 0), (0.9, 0.9, 0.9), 0.05),
        Quad("lamp", (1.5, 1.0, z - 0.02), (0, 1.0, 0), (1.0, 0, 0), (0, 0, 0), emission=LAMP),
    ]
    for column in range(8):
        for row in range(6):
            tone: Color = (0.45, 0.35, 0.25) if (row + column) % 2 else (0.2, 0.16, 0.12)
            found.append(
                Quad(f"tile-{column}-{row}", (0.5 * column, 0.5 * row, 0), (0.5, 0, 0), (0, 0.5, 0), tone)
            )
    return found


def room_geometry() -> CaptureGeometry:
    """Geometry of the room; faces 2 k and 2 k + 1 are quad k."""
    every = quads()
    positions = np.concatenate([quad.corners() for quad in every]).astype(np.float32)
    faces = [[4 * k + i for i in corner] for k in range(len(every)) for corner in ((0, 1, 2), (0, 2, 3))]
    parts = tuple(GeometryPart(quad.name, 2 * k, 2, quad.emission) for k, quad in enumerate(every))
    return CaptureGeometry(Mesh(positions, np.array(faces, np.int32), None, None), parts)


def room_cameras(num: int = 24) -> list[Camera]:
    """Cameras on two rings around the centre that look across it, level, up and down."""
    cameras = []
    for index in range(num):
        angle = 2 * np.pi * (index + 0.5 * (index % 2)) / num * 2
        way = np.array([np.cos(angle), np.sin(angle), (0.0, 0.6, -0.6, -0.2)[index % 4]])
        eye = SIDES / 2 - (0.9 if index < num // 2 else 0.3) * way * [1.2, 1, 0.6]
        cameras.append(Camera(*SIZE, 42.0, 42.0, SIZE[0] / 2, SIZE[1] / 2, look_at(eye, eye + way)))
    return cameras


@lru_cache(maxsize=1)
def photographed_room() -> tuple[TracedView, ...]:
    """Path-traced HDR views of the room, with 256 samples per pixel, all at its centre."""
    return once("light-room", lambda: _photographs(256))


@lru_cache(maxsize=1)
def sunlit_room() -> tuple[TracedView, ...]:
    """:func:`photographed_room` plus sunlight, rendered without the sky's panel, which would block it."""
    sun = once("light-room-sun", lambda: _photographs(512, is_sunlit=True))
    views = zip(photographed_room(), sun, strict=True)
    return tuple(replace(view, color=view.color + sunlit.color) for view, sunlit in views)


def _photographs(samples: int, *, is_sunlit: bool = False) -> tuple[TracedView, ...]:
    """Render the room in the light of its lamp and sky or, ``is_sunlit``, of the sun alone."""
    import mitsuba as mi

    from mitsuba_plugins import register

    register()
    scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": 16}}
    if is_sunlit:
        scene["sun"] = {
            "type": "directional",
            "direction": [-c for c in SUN_DIRECTION],
            "irradiance": {"type": "rgb", "value": list(SUN_IRRADIANCE)},
        }
    else:
        scene["sky"] = {  # a panel that fills the window has less noise than an environment
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f()
            .translate([SIDES[0] + 0.02, 1.5, 1.4])
            .rotate([0, 1, 0], -90)
            .scale([0.6, 0.7, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(SKY)}},
        }
    materials: dict[Any, Any] = {}
    for quad in quads():
        corner = quad.corners()
        to_world = np.eye(4)  # Mitsuba's rectangle spans [-1, 1]^2
        to_world[:3, 0], to_world[:3, 1] = (corner[1] - corner[0]) / 2, (corner[3] - corner[0]) / 2
        normal = np.cross(to_world[:3, 0], to_world[:3, 1])
        to_world[:3, 2], to_world[:3, 3] = normal / np.linalg.norm(normal), corner.mean(axis=0)
        material = (quad.diffuse, quad.specular, quad.roughness)
        if material not in materials:  # shared, since Dr.Jit traces each BSDF
            materials[material] = mi.load_dict(
                {
                    "type": "cook_torrance",
                    "diffuse_albedo": {"type": "rgb", "value": list(quad.diffuse)},
                    "specular_albedo": {"type": "rgb", "value": list(quad.specular)},
                    "roughness": quad.roughness,
                }
            )
        shape: dict[str, Any] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "bsdf": materials[material],
        }
        if quad.emission is not None and not is_sunlit:
            shape["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": list(quad.emission)}}
        scene[quad.name] = shape
    room, traced = mi.load_dict(scene, optimize=False), TracedGeometry(room_geometry())
    views = []
    for index, camera in enumerate(room_cameras()):
        direction = np.repeat(camera.ray_directions().reshape(-1, 3), samples, axis=0)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(index, len(direction))
        ray = mi.RayDifferential3f(
            mi.Ray3f(mi.Point3f(*camera.position_m.tolist()), mi.Vector3f(direction.astype(np.float32).T))
        )
        radiance = room.integrator().sample(room, sampler, ray)[0].numpy().T
        color = radiance.reshape(camera.height_px, camera.width_px, samples, 3).mean(axis=2)
        valid = np.ones(SIZE[::-1], dtype=bool)
        views.append(TracedView(camera, color.astype(np.float32), traced.trace_view(camera), valid))
    return tuple(views)


def without_pixels(view: TracedView, hidden: NDArray[np.bool_]) -> TracedView:
    """The view without the pixels of the mask ``hidden`` (H, W)."""
    geometry = replace(
        view.geometry,
        face=np.where(hidden, -1, view.geometry.face),
        depth_z_m=np.where(hidden[..., None], np.float32(0), view.geometry.depth_z_m),
    )
    return replace(view, geometry=geometry, valid_mask=view.valid_mask & ~hidden)


@dataclass(frozen=True)
class Photograph:
    """Photograph with the linear radiance ``color`` (H, W, 3), without clipping."""

    color: NDArray[np.float32]

    def read(self, camera: Camera) -> ColorImage:
        return ColorImage(self.color, np.ones(self.color.shape[:2], bool))

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        raise NotImplementedError("a photograph has no maps")


def room_capture(lamp: Color = LAMP) -> Capture:
    """The room as a capture; its geometry declares that the lamp's radiance is ``lamp``."""
    geometry = room_geometry()
    parts = tuple(part if part.emission is None else replace(part, emission=lamp) for part in geometry.parts)
    views = tuple(
        CaptureView(f"view-{k:03d}", view.camera, Photograph(view.color))
        for k, view in enumerate(photographed_room())
    )
    return Capture("box", views, CaptureGeometry(geometry.mesh, parts))

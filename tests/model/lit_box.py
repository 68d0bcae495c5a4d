# SPDX-License-Identifier: MIT
"""A closed room of 4 x 3 x 2.5 m with six walls of known diffuse albedos and a lamp in its ceiling, rendered
by Mitsuba's path tracer: a reference for methods based on interreflection."""

from __future__ import annotations

from dataclasses import dataclass
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
ALBEDOS = np.array(
    [[0.6, 0.5, 0.4], [0.6, 0.5, 0.4], [0.3, 0.5, 0.6], [0.7, 0.7, 0.7], [0.4, 0.3, 0.2], [0.8, 0.8, 0.8]]
)
"""Diffuse albedos (6, 3) of the walls x-low, x-high, y-low, y-high, floor and ceiling."""
LAMP_RADIANCE = (14.0, 13.0, 10.0)
SIZE = (48, 36)
_LAMP = np.array([[1.5, 1.0, 2.49], [1.5, 2.0, 2.49], [2.5, 2.0, 2.49], [2.5, 1.0, 2.49]])  # faces down


def _walls() -> list[NDArray[np.float64]]:
    """Corners (4, 3) of the walls, counter-clockwise seen from inside."""
    found = []
    for side in range(6):
        axis, is_high = side // 2, side % 2
        a, b = (axis + 1) % 3, (axis + 2) % 3
        quad = np.zeros((4, 3))
        quad[:, axis] = SIDES[axis] * is_high
        quad[:, a], quad[:, b] = SIDES[a] * np.array([0, 1, 1, 0]), SIDES[b] * np.array([0, 0, 1, 1])
        found.append(quad[::-1] if is_high else quad)
    return found


def box_geometry() -> CaptureGeometry:
    """Geometry of the box; faces 2 k and 2 k + 1 are wall k; the last two are the lamp."""
    quads = [*_walls(), _LAMP]
    faces = [[4 * k + i for i in corner] for k in range(7) for corner in ((0, 1, 2), (0, 2, 3))]
    mesh = Mesh(np.concatenate(quads).astype(np.float32), np.array(faces, np.int32), None, None)
    parts = (GeometryPart("room", 0, 12), GeometryPart("lamp", 12, 2, LAMP_RADIANCE))
    return CaptureGeometry(mesh, parts)


def box_cameras(num: int = 12) -> list[Camera]:
    """Cameras around the centre that look across it, level, up and down."""
    cameras = []
    for index in range(num):
        angle = 2 * np.pi * index / num
        way = np.array([np.cos(angle), np.sin(angle), (0.0, 0.7, -0.7)[index % 3]])
        eye = SIDES / 2 - 0.9 * way * [1, 1, 0.5]
        cameras.append(Camera(*SIZE, 22.0, 22.0, SIZE[0] / 2, SIZE[1] / 2, look_at(eye, eye + way)))
    return cameras


@lru_cache(maxsize=2)
def photographed_box(has_sun: bool = False, samples: int = 64) -> tuple[TracedView, ...]:
    """Path-traced views of the box. ``has_sun`` adds an unphotographed spot light that lights part of the
    floor several times brighter than the lamp does."""
    return once(f"lit-box-{has_sun}-{samples}", lambda: _photographs(has_sun, samples))


def _photographs(has_sun: bool, samples: int) -> tuple[TracedView, ...]:
    import mitsuba as mi

    scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": 24}}
    for index, quad in enumerate([*_walls(), _LAMP]):
        to_world = np.eye(4)  # Mitsuba's rectangle spans [-1, 1]^2
        to_world[:3, 0], to_world[:3, 1] = (quad[1] - quad[0]) / 2, (quad[3] - quad[0]) / 2
        normal = np.cross(to_world[:3, 0], to_world[:3, 1])
        to_world[:3, 2], to_world[:3, 3] = normal / np.linalg.norm(normal), quad.mean(axis=0)
        rgb = ALBEDOS[index].tolist() if index < 6 else [0.0, 0.0, 0.0]
        shape: dict[str, Any] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": rgb}},
        }
        if index == 6:
            shape["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": list(LAMP_RADIANCE)}}
        scene[f"quad{index}"] = shape
    if has_sun:
        scene["sun"] = {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at([1.0, 1.5, 2.4], [1.0, 1.5, 0.0], [1, 0, 0]),
            "intensity": {"type": "rgb", "value": [60.0, 60.0, 60.0]},
            "cutoff_angle": 25.0,
        }
    room, traced = mi.load_dict(scene), TracedGeometry(box_geometry())
    views = []
    for index, camera in enumerate(box_cameras()):
        color = _radiance(room, camera, samples, index)
        valid = np.ones(SIZE[::-1], dtype=bool)
        views.append(TracedView(camera, color, traced.trace_view(camera), valid))
    return tuple(views)


def _radiance(room: Any, camera: Camera, samples: int, seed: int) -> NDArray[np.float32]:
    """Radiance (H, W, 3) at pixel centres."""
    import mitsuba as mi

    direction = np.repeat(camera.ray_directions().reshape(-1, 3), samples, axis=0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, len(direction))
    ray = mi.RayDifferential3f(
        mi.Ray3f(mi.Point3f(*camera.position_m.tolist()), mi.Vector3f(direction.astype(np.float32).T))
    )
    radiance = room.integrator().sample(room, sampler, ray)[0].numpy().T
    return radiance.reshape(camera.height_px, camera.width_px, samples, 3).mean(axis=2).astype(np.float32)


@dataclass(frozen=True)
class Photograph:
    """A photograph of ``color`` by a sensor that clips at ``white``."""

    color: NDArray[np.float32]
    white: float

    def read(self, camera: Camera) -> ColorImage:
        valid = np.ones(self.color.shape[:2], dtype=bool)
        if np.isinf(self.white):
            return ColorImage(self.color, valid)
        return ColorImage(np.minimum(self.color, self.white), valid, self.color >= self.white, self.white)

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        return {}


def box_capture(white: float = np.inf) -> Capture:
    """The box as a capture by a sensor that clips at ``white``."""
    views = [
        CaptureView(f"view-{index:03d}", view.camera, Photograph(view.color, white))
        for index, view in enumerate(photographed_box())
    ]
    return Capture("box", tuple(views), box_geometry())

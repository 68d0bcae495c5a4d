# SPDX-License-Identifier: MIT
"""Mitsuba plugins of the renderer: a camera with full intrinsics and a sun with a disc.

``pinhole_pixels`` is a pinhole camera with fx, fy, cx, cy in pixels and any principal point and pixel aspect
(Mitsuba's ``perspective`` supports only square pixels). All parameters are opaque to Dr.Jit, so all views
share one kernel. ``sun_disc`` is a distant light with an angular diameter. Rays never hit it, so it is
invisible to camera and mirror rays, and its reflections come from emitter sampling alone.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from datagen.foundation.cameras import Camera

Array = Any
# Shadow rays end at this many scene diagonals, outside the scene yet within the precision of float32.
_SHADOW_DISTANCE_FACTOR = 2.0


class PinholePixels(mi.Sensor):
    """Pinhole sensor with pose and intrinsics of a :class:`Camera`, set by :meth:`set_camera`."""

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.m_needs_sample_2 = True
        self.m_needs_sample_3 = False
        size = self.film().crop_size()
        self.width_px, self.height_px = int(size[0]), int(size[1])
        self.set_camera(Camera(self.width_px, self.height_px, 1.0, 1.0, 0.0, 0.0, np.eye(4)))

    def set_camera(self, camera: Camera) -> None:
        """Set pose and intrinsics. Raises ``ValueError`` if camera and film differ in resolution."""
        if (camera.width_px, camera.height_px) != (self.width_px, self.height_px):
            got = f"{camera.width_px}x{camera.height_px}"
            raise ValueError(f"camera of {got} pixels; the film has {self.width_px}x{self.height_px}")
        matrix = np.asarray(camera.world_from_camera, dtype=np.float64)
        near, far = camera.clip_m or (0.0, np.finfo(np.float32).max)
        # parameters for rays_through, as opaque arrays, which become kernel arguments
        self.view = (
            _opaque(mi.Point3f, matrix[:3, 3]),
            _opaque(mi.Vector3f, matrix[:3, 0] / camera.fx_px),
            _opaque(mi.Vector3f, matrix[:3, 1] / camera.fy_px),
            _opaque(mi.Vector3f, matrix[:3, 2]),
            _opaque(mi.Point2f, np.array([camera.cx_px, camera.cy_px])),
            _opaque(mi.Point2f, np.array([near, far - near])),
        )
        # Mitsuba's cameras look along +z with y up and x to the left.
        to_world: Any = mi.ScalarTransform4f(matrix @ np.diag([-1.0, -1.0, 1.0, 1.0]))
        self.m_to_world = to_world

    def sample_ray(
        self, time: Array, sample1: Array, sample2: Array, sample3: Array, active: Array = True
    ) -> tuple[Any, Any]:
        """Return a ray through film position ``sample2`` in [0, 1]^2 (x right, y down), and its weight, 1."""
        position_px = sample2 * mi.ScalarVector2f(self.width_px, self.height_px)
        ray = rays_through(self.view, position_px)
        ray.time = time
        return ray, mi.Color3f(1.0)

    def sample_ray_differential(
        self, time: Array, sample1: Array, sample2: Array, sample3: Array, active: Array = True
    ) -> tuple[Any, Any]:
        """Like :meth:`sample_ray`, with empty differentials, since textures are not filtered by them."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def to_string(self) -> str:
        return f"PinholePixels[{self.width_px}x{self.height_px}]"


def _opaque(kind: Any, values: np.ndarray) -> Any:
    value = kind(*(mi.Float(float(v)) for v in values))
    dr.make_opaque(value)
    return value


def rays_through(view: tuple[Any, ...], position_px: Any) -> Any:
    """Rays through film positions ``position_px``, in pixels, of a sensor's :attr:`PinholePixels.view`."""
    origin, right, down, forward, centre, clip = view  # clip: near depth, and far minus near depth
    offset = position_px - centre
    ray = dr.zeros(mi.Ray3f, dr.width(position_px))
    direction = forward + offset.x * right + offset.y * down  # of depth 1
    ray.o = dr.fma(clip.x, direction, origin)
    ray.d = dr.normalize(direction)
    ray.maxt = dr.minimum(clip.y * dr.norm(direction), dr.largest(mi.Float))
    return ray


def outside_distance(scene: Any) -> float:
    """Distance [m] that leads outside a scene from any point in it; 2 for an empty scene."""
    box = scene.bbox()
    extent = np.asarray(box.max, np.float64).ravel() - np.asarray(box.min, np.float64).ravel()
    reach = float(np.linalg.norm(extent)) if np.isfinite(extent).all() else 1.0
    return _SHADOW_DISTANCE_FACTOR * max(reach, 1e-3)


class SunDisc(mi.Emitter):
    """Distant disc of uniform radiance; its light travels in ``direction``.

    ``irradiance`` E [W/m^2] refers to a surface perpendicular to ``direction``. A disc of
    ``angular_diameter_rad`` = 2 r has the radiance E / (pi sin^2 r). The emitter is flagged as a delta, since
    only emitter sampling can reach it.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.irradiance: Any = props.get_unbounded_texture("irradiance", 1.0)
        to_sun = -np.asarray(props["direction"], dtype=np.float64).ravel()
        to_sun /= np.linalg.norm(to_sun)
        helper = np.array([1.0, 0, 0]) if abs(to_sun[0]) < 0.7 else np.array([0, 1.0, 0])
        side = np.cross(to_sun, helper)
        side /= np.linalg.norm(side)
        self.frame = mi.Frame3f(
            *(mi.Vector3f(*(float(c) for c in v)) for v in (side, np.cross(to_sun, side), to_sun))
        )
        diameter: Any = props.get("angular_diameter_rad", 0.0)
        radius = 0.5 * float(diameter)
        # 1 - cos(radius) without cancellation in float32
        self.one_minus_cos = mi.Float(2.0 * math.sin(radius / 2) ** 2)
        # solid angle / projected solid angle, since irradiance weights directions by the cosine to the axis
        self.weight = mi.Float(2.0 / (1.0 + math.cos(radius)))
        self.distance = mi.Float(1.0)
        dr.make_opaque(self.frame, self.one_minus_cos, self.weight, self.distance)
        self.m_needs_sample_3 = False
        self.m_flags = +mi.EmitterFlags.Infinite | +mi.EmitterFlags.DeltaDirection

    def set_scene(self, scene: mi.Scene) -> None:
        """Set the length of shadow rays, which end outside the scene."""
        self.distance = mi.Float(outside_distance(scene))
        dr.make_opaque(self.distance)

    def is_environment(self) -> bool:
        """False, since rays never hit the disc."""
        return False

    def sample_direction(self, it: mi.Interaction3f, sample: Array, active: Array = True) -> tuple[Any, Any]:
        """Sample a direction uniformly over the disc's solid angle; return it and radiance / density."""
        one_minus_cos = sample.x * self.one_minus_cos
        sine = dr.sqrt(dr.maximum(one_minus_cos * (2.0 - one_minus_cos), 0.0))
        sin_phi, cos_phi = dr.sincos(2.0 * dr.pi * sample.y)
        direction: Any = self.frame.to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, 1.0 - one_minus_cos))
        ds: Any = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
        ds.p = it.p + direction * self.distance
        ds.n = -direction
        ds.uv = mi.Point2f(0.0)
        ds.time = it.time
        ds.pdf = mi.Float(1.0)
        ds.delta = mi.Bool(True)
        ds.emitter = mi.EmitterPtr(self)
        ds.d = direction
        ds.dist = self.distance
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(it.p))
        return ds, dr.select(active, self.irradiance.eval(si, active) * self.weight, 0.0)

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Array = True) -> Array:
        """Zero, since rays never hit the disc."""
        return mi.Float(0.0)

    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Array = True) -> Array:
        """Zero, since rays never hit the disc."""
        return mi.Color3f(0.0)

    def eval(self, si: mi.SurfaceInteraction3f, active: Array = True) -> Array:
        """Zero, since rays never hit the disc."""
        return mi.Color3f(0.0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Empty, since the light has no position."""
        return mi.ScalarBoundingBox3f()

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the irradiance to ``mi.traverse``."""
        callback.put("irradiance", self.irradiance, mi.ParamFlags.Differentiable)

    def to_string(self) -> str:
        return "SunDisc[]"


_registered: set[str] = set()


def register_rendering_plugins() -> None:
    """Register the plugins of this module and of ``mitsuba_plugins`` for the active Mitsuba variant."""
    from mitsuba_plugins import register

    register()
    variant = str(mi.variant())
    if variant not in _registered:
        mi.register_sensor("pinhole_pixels", PinholePixels)
        mi.register_emitter("sun_disc", SunDisc)
        _registered.add(variant)

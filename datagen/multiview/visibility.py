# SPDX-License-Identifier: MIT
"""Visibility of points in views: kernels for projection and occlusion, and the views as packed arrays.

Symbols: p is a world point with unit normal n, o_i the centre of view i, omega_i the unit direction from p to
o_i, d_ip = |o_i - p|, (x, y, z) the point in view i's camera space, (u, v) its projection in pixels.

Point p is visible in a view if it projects inside the image, n . omega_i > 0 and nothing occludes
it. Occlusion is tested in one of two ways:

- ``depth`` compares z with the view's depth buffer at the pixel that p projects into. With n' the normal in
  camera space, a step of one pixel changes the depth of p's tangent plane by
  z' = z (|n'_x| / f_x + |n'_y| / f_y) / |n' . (x/z, y/z, 1)|, and p counts as visible if
  |z_buffer - z| <= depth_tolerance * z + min(slope_tolerance_px * z', slope_limit * z).
  The test is two-sided: if the buffer's depth is far *beyond* p, the pixel's centre misses p's surface, so
  the pixel has the colour of another surface.
- ``trace`` casts a shadow ray from the camera into the scene's geometry; it stops short of p by
  ``trace_tolerance / max(n . omega_i, 0.05)`` times the distance.

Functions marked *traced* take and return Dr.Jit arrays and may be called inside a kernel; the view index is
an array, never a literal, so one compiled kernel serves any number of views. The pixels of all views are
packed into one array, view by view; views may differ in size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera
from datagen.foundation.errors import Problems, input_error, raise_problems
from mitsuba_plugins.arrays import aligned, aligned_empty
from mitsuba_plugins.variant import select_variant

if TYPE_CHECKING:
    import mitsuba as mi

CAMERA_STRIDE = 16  # floats per view: rotation (9, row-major camera_from_world), centre (3), fx, fy, cx, cy
_MAX_PIXELS = 2**32  # pixel indices are 32-bit
_MIN_TRACE_COSINE = 0.05  # otherwise, shadow rays at grazing angles would end far before the point


@dataclass(frozen=True)
class VisibilityOptions:
    """The occlusion test ``mode`` and its tolerances; see the module's docstring for the formulas.

    ``depth_tolerance`` and ``slope_limit`` are relative to depth, ``slope_tolerance_px`` is in pixels,
    ``trace_tolerance`` is relative to the distance between camera and point. Raises :class:`InputError` for
    invalid values.
    """

    mode: Literal["depth", "trace"] = "depth"
    depth_tolerance: float = 0.005
    slope_tolerance_px: float = 1.0
    slope_limit: float = 0.05
    trace_tolerance: float = 1e-4

    def __post_init__(self) -> None:
        problems = Problems("visibility")
        if self.mode not in ("depth", "trace"):
            problems.add("mode", repr(self.mode), "'depth' or 'trace'", "correct it")
        for name in ("depth_tolerance", "slope_tolerance_px", "slope_limit", "trace_tolerance"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                problems.add(name, repr(value), "a finite number of at least 0", "correct it")
        raise_problems(problems)


class Projection(NamedTuple):
    """Projection of points into a view, and the view's camera (*traced*)."""

    rotation: mi.Matrix3f
    """Rotation from world to camera space."""
    centre: mi.Point3f
    intrinsics: mi.Vector4f
    """fx, fy, cx, cy in pixels."""
    offset: mi.Vector3f
    """Vector p - o_i from the camera to the point, in world space."""
    z_m: mi.Float
    u_px: mi.Float
    v_px: mi.Float
    layout: mi.Vector4u
    """Index of the view's first pixel in the packed storage, width, height, 0."""

    def pixel(self) -> mi.UInt32:
        """Packed index of the pixel that the projection falls into."""
        import mitsuba as mi

        return self.layout[0] + mi.UInt32(self.v_px) * self.layout[1] + mi.UInt32(self.u_px)


class Observation(NamedTuple):
    """Visibility and projection of points in a view (*traced*); ``u_px``, ``v_px`` are valid if visible."""

    is_visible: mi.Bool
    cosine: mi.Float
    """Cosine n . omega_i between normal and direction to the camera."""
    distance_m: mi.Float
    """Distance d_ip between camera and point."""
    u_px: mi.Float
    v_px: mi.Float


class PackedViews:
    """Cameras and depth buffers of all views on the device.

    ``depth_z_m``: an array (H, W) or (H, W, 1) for each view, 0 where nothing is hit; None if visibility is
    tested only by ``trace``. Raises :class:`InputError` for empty or mismatched input, NaN and Inf.
    """

    def __init__(self, cameras: Sequence[Camera], depth_z_m: Sequence[NDArray] | None) -> None:
        if not cameras:
            raise input_error("views", "", "no views", "at least one view", "add views")
        if depth_z_m is not None and len(depth_z_m) != len(cameras):
            expected = f"{len(cameras)}, one per camera"
            raise input_error("views", "depth_z_m", f"{len(depth_z_m)} buffers", expected)
        select_variant()
        import mitsuba as mi

        sizes = [camera.width_px * camera.height_px for camera in cameras]
        self.num_views = len(cameras)
        self.num_pixels = sum(sizes)
        if self.num_pixels >= _MAX_PIXELS:
            got, expected = f"{self.num_pixels} pixels", f"fewer than {_MAX_PIXELS}"
            raise input_error("views", "", got, expected, "use smaller images")
        first = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
        self.first_pixels = first
        layout = [(at, view.width_px, view.height_px, 0) for at, view in zip(first, cameras, strict=True)]
        self.cameras = mi.Float(aligned(np.concatenate([_camera_row(camera) for camera in cameras])))
        centres = np.array([[*camera.position_m, 0.0] for camera in cameras], dtype=np.float32)
        self.centres = mi.Float(aligned(centres))
        self.layout = mi.UInt32(aligned(np.array(layout), np.uint32))
        self.depth = None if depth_z_m is None else mi.Float(_flatten_depth(cameras, depth_z_m))


def _camera_row(camera: Camera) -> NDArray[np.float32]:
    rotation = camera.camera_from_world[:3, :3].ravel()
    intrinsics = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
    return np.concatenate([rotation, camera.position_m, intrinsics]).astype(np.float32)


def _flatten_depth(cameras: Sequence[Camera], depth: Sequence[NDArray]) -> NDArray[np.float32]:
    problems = Problems("views")
    flat = aligned_empty(sum(camera.width_px * camera.height_px for camera in cameras), np.float32)
    first = 0
    for index, (camera, buffer) in enumerate(zip(cameras, depth, strict=True)):
        part = np.asarray(buffer, dtype=np.float32)
        shape = (camera.height_px, camera.width_px)
        if part.shape not in (shape, (*shape, 1)):
            problems.add(f"[{index}].depth_z_m", f"shape {part.shape}", f"{(*shape, 1)} like its camera")
        elif not np.isfinite(part).all():
            problems.add(f"[{index}].depth_z_m", "NaN or Inf", "finite depth, 0 where nothing was hit")
        else:
            flat[first : first + part.size] = part.ravel()
        first += camera.width_px * camera.height_px
    raise_problems(problems)
    return flat


def project(views: PackedViews, view: mi.UInt32, points: mi.Point3f) -> Projection:
    """Project ``points`` into the cameras of the views with indices ``view`` (*traced*)."""
    import drjit as dr
    import mitsuba as mi

    parts = CAMERA_STRIDE // 4
    packets = [dr.gather(mi.Vector4f, views.cameras, view * parts + part) for part in range(parts)]
    values = [packet[k] for packet in packets for k in range(4)]
    rotation, centre, intrinsics = mi.Matrix3f(*values[:9]), mi.Point3f(*values[9:12]), packets[3]
    offset: Any = mi.Vector3f(points - centre)
    local = rotation @ offset
    u = local.x / local.z * intrinsics[0] + intrinsics[2]
    v = local.y / local.z * intrinsics[1] + intrinsics[3]
    layout = dr.gather(mi.Vector4u, views.layout, view)
    return Projection(rotation, centre, intrinsics, offset, local.z, u, v, layout)


def max_distance(views: PackedViews, points: mi.Point3f) -> mi.Float:
    """Distance [m] from each point to the farthest camera, regardless of visibility (*traced*)."""
    import drjit as dr
    import mitsuba as mi

    num_views = dr.opaque(mi.UInt32, views.num_views)

    def body(view: mi.UInt32, largest: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        centre = dr.gather(mi.Vector4f, views.centres, view)
        offset: Any = mi.Point3f(centre[0], centre[1], centre[2]) - points
        return view + 1, dr.maximum(largest, dr.squared_norm(offset))

    state = (mi.UInt32(0), dr.zeros(mi.Float, dr.width(points)))
    _, largest = dr.while_loop(
        state, lambda view, _: view < num_views, body, labels=("view", "largest"), label="max_distance"
    )
    return dr.sqrt(largest)


def observe(
    views: PackedViews,
    view: mi.UInt32,
    points: mi.Point3f,
    normals: mi.Vector3f,
    options: VisibilityOptions,
    scene: mi.Scene | None = None,
) -> Observation:
    """Project ``points`` with unit ``normals`` into ``view`` and test their visibility (*traced*).

    Raises ``ValueError`` without the ``scene`` or the depth buffers that ``options.mode`` needs.
    """
    import drjit as dr
    import mitsuba as mi

    at = project(views, view, points)
    distance: Any = dr.norm(at.offset)
    facing: Any = -dr.dot(normals, at.offset)
    width, height = mi.Float(at.layout[1]), mi.Float(at.layout[2])
    is_inside = (at.z_m > 0) & (at.u_px >= 0) & (at.v_px >= 0) & (at.u_px < width) & (at.v_px < height)
    is_visible = is_inside & (facing > 0)
    if options.mode == "depth":
        is_visible &= _agrees_with_depth(views, at, normals, facing, options, is_visible)
    else:
        if scene is None:
            raise ValueError("visibility 'trace' needs a scene")
        gap = options.trace_tolerance / dr.maximum(facing / distance, _MIN_TRACE_COSINE)
        ray = mi.Ray3f(at.centre, at.offset / distance)
        ray.maxt = distance * (1 - gap)
        is_visible &= ~scene.ray_test(ray, active=is_visible)
    return Observation(is_visible, facing / distance, distance, at.u_px, at.v_px)


def _agrees_with_depth(
    views: PackedViews,
    at: Projection,
    normals: mi.Vector3f,
    facing: mi.Float,
    options: VisibilityOptions,
    active: mi.Bool,
) -> mi.Bool:
    import drjit as dr
    import mitsuba as mi

    if views.depth is None:
        raise ValueError("visibility 'depth' needs the views' depth buffers")
    stored = dr.gather(mi.Float, views.depth, at.pixel(), active)
    normal = at.rotation @ normals
    step = dr.abs(normal.x) / at.intrinsics[0] + dr.abs(normal.y) / at.intrinsics[1]
    # facing = |n' . (x/z, y/z, 1)| z; at grazing angles the quotient may be Inf, which min() bounds
    slope = dr.minimum(options.slope_tolerance_px * step * at.z_m / facing, options.slope_limit)
    return dr.abs(stored - at.z_m) <= at.z_m * (options.depth_tolerance + slope)

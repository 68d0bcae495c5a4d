# SPDX-License-Identifier: MIT
"""Ground-truth buffers: material channels, geometry and ids at the first hit.

Two kinds of buffer are computed in one kernel with one thread per pixel:

* *blended*: diffuse_albedo, specular_albedo, roughness, normal_world and surface_mask are averaged over
  ``spp`` sub-pixel samples with the film's reconstruction filter, as the beauty image is. The average is over
  reflecting surface only; ``surface_mask`` is its share of the pixel. Normals are renormalised after
  averaging.
* *at the centre*: depth_z_m, position_world, instance_id and material_id are taken from one ray through the
  centres of pixel and lens, because means of depths or of ids would be meaningless.

Sub-pixel offsets are importance-sampled: in proportion to the absolute value of the filter, whose sign is the
weight. No thread writes to another pixel, so all filters cost the same and need no atomics. Emitters and the
background are masked: surface_mask 0, ids 0, channels 0. Emitters keep their depth, because they occlude.
Axis order of arrays: (H, W, C), row 0 at the top.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from datagen.foundation.buffers import BUFFERS, GROUND_TRUTH_BUFFERS, MATERIAL_MAPS
from datagen.foundation.errors import input_error
from mitsuba_plugins.cells import cell_of
from mitsuba_plugins.lattice import generator, lattice_point
from mitsuba_plugins.surface_material import IdTable, SceneMaterials

Array = Any

MAX_LAYERS = 32
"""Maximum number of surfaces along a ray; 32 surfaces of opacity 0.2 transmit 0.08 %."""
MIN_THROUGHPUT = 1e-3
"""Transmittance below which rays end, since the remainder is negligible."""
SOLID_OPACITY = 0.5
"""Minimum opacity of a solid surface; the first solid surface determines a pixel's depth and ids."""
MIN_COVERAGE = 1e-6
"""Coverage by reflecting surface below which a pixel is masked, since its channels would be noise."""
# Steps of lens and time in units of 2^-32: the fractional parts of sqrt(2), sqrt(3) and sqrt(5), which are
# independent over the rationals, so that their multiples fill three dimensions evenly.
_LENS_X, _LENS_Y, _TIME = 1779033703, 3144134277, 1013904243
CHANNELS = {name: BUFFERS[name].channels for name in GROUND_TRUTH_BUFFERS} | {
    "position_world": ("X", "Y", "Z")
}
"""Channel names of each buffer, in the order of the integrator's output: the ground truth of
``foundation.buffers``, then positions."""


class PixelFilter:
    """Samples sub-pixel offsets along one axis in proportion to a film's reconstruction filter.

    Films ignore samples beyond their border unless ``sample_border`` is set. The filter of a pixel near the
    border is therefore truncated there, and variates are mapped to the remaining part.
    """

    TABLE_SIZE = 4096

    def __init__(self, film: Any):
        reconstruction_filter = film.rfilter()
        self.is_box = bool(reconstruction_filter.is_box_filter())
        self.is_cut_off = not (self.is_box or bool(film.sample_border()))
        self.has_negative_lobes = False
        if self.is_box:
            return
        self._filter = reconstruction_filter
        self._radius = float(reconstruction_filter.radius())
        edges = np.linspace(-self._radius, self._radius, self.TABLE_SIZE + 1)
        centres = (0.5 * (edges[1:] + edges[:-1])).astype(np.float32)
        weight = np.asarray(reconstruction_filter.eval(mi.Float(centres)), np.float64)
        self.has_negative_lobes = bool((weight < 0.0).any())
        distribution = np.concatenate([[0.0], np.cumsum(np.abs(weight))]) / np.abs(weight).sum()
        quantiles = np.interp(np.linspace(0.0, 1.0, self.TABLE_SIZE + 1), distribution, edges)
        self._distribution = mi.Float(distribution.astype(np.float32))
        self._quantiles = mi.Float(quantiles.astype(np.float32))

    def _look_up(self, table: Array, position: Array) -> Array:
        """Interpolate ``table`` linearly at ``position``, an index that is clamped to [0, TABLE_SIZE]."""
        position = dr.clip(position, 0.0, float(self.TABLE_SIZE))
        cell = cell_of(position, self.TABLE_SIZE)
        low, high = dr.gather(mi.Float, table, cell), dr.gather(mi.Float, table, cell + 1)
        return dr.lerp(low, high, position - mi.Float(cell))

    def variates_inside(self, pixel: Array, size: int) -> tuple[Any, Any]:
        """Return the range of variates that place samples of column or row ``pixel`` inside [0, ``size``]."""
        if not self.is_cut_off:
            return mi.Float(0.0), mi.Float(1.0)
        scale = self.TABLE_SIZE / (2.0 * self._radius)
        first = self._look_up(self._distribution, (self._radius - (pixel + 0.5)) * scale)
        last = self._look_up(self._distribution, (self._radius + size - (pixel + 0.5)) * scale)
        return first, last

    def sample(self, u: Array) -> tuple[Any, Any]:
        """Return the offset from the pixel's centre [px] and the weight (1 or -1) of a variate in [0, 1]."""
        if self.is_box:
            return u - 0.5, mi.Float(1.0)
        offset = self._look_up(self._quantiles, u * self.TABLE_SIZE)
        if not self.has_negative_lobes:
            return offset, mi.Float(1.0)
        return offset, dr.select(self._filter.eval(offset) < 0.0, mi.Float(-1.0), mi.Float(1.0))


@dataclass(frozen=True)
class _View:
    """A sensor with its film and the scene's materials."""

    scene: Any
    sensor: Any
    materials: SceneMaterials
    hide_emitters: bool
    width: int
    height: int

    def ray(self, x: Array, y: Array, time: Array, lens: Array) -> Any:
        """Return the ray through (x, y) on the (cropped) film [px]; ``time`` and ``lens`` are in [0, 1]."""
        position = mi.Point2f(x / self.width, y / self.height)
        shutter = self.sensor.shutter_open() + time * self.sensor.shutter_open_time()
        ray, _ = self.sensor.sample_ray(shutter, mi.Float(0.5), position, lens)
        return ray


@dataclass(frozen=True)
class _RayResult:
    """Coverage-weighted sums of channels along a ray; point and shape index of the first solid surface."""

    diffuse_albedo: Array
    specular_albedo: Array
    roughness: Array
    normal: Array
    coverage: Array
    point: Array
    shape_index: Array

    @property
    def state(self) -> tuple[Any, ...]:
        """The fields in order, as the state of a symbolic loop."""
        return tuple(vars(self).values())


def _empty_result(num_rays: int) -> _RayResult:
    kinds = (mi.Color3f, mi.Color3f, mi.Float, mi.Vector3f, mi.Float, mi.Point3f, mi.UInt32)
    return _RayResult(*(dr.zeros(kind, num_rays) for kind in kinds))


def _trace_surface(view: _View, ray: Any, active: Array) -> tuple[Any, Any, _RayResult]:
    """Return a ray's next hit, whether the ray may continue, and the hit's opacity-weighted channels."""
    # Camera rays are coherent, which makes Embree's packets three times as fast.
    si = view.scene.ray_intersect(ray, mi.RayFlags.All, coherent=True, active=active)
    is_hit = active & si.is_valid()
    is_emitter = view.materials.is_emitter(si, is_hit)
    is_surface = is_hit & ~is_emitter
    channels = view.materials.channels_at(si, is_surface)
    opacity = dr.select(is_surface, channels.opacity, 0.0)
    is_solid = is_hit & dr.select(is_emitter, not view.hide_emitters, opacity >= SOLID_OPACITY)
    result = _RayResult(
        channels.diffuse_albedo * opacity,
        channels.specular_albedo * opacity,
        channels.roughness * opacity,
        si.to_world(mi.Vector3f(channels.normal_local)) * opacity,
        opacity,
        dr.select(is_solid, si.p, 0.0),
        dr.select(is_solid, view.materials.shape_index(si), 0),
    )
    return si, is_hit & (~is_emitter | view.hide_emitters), result


def _trace(view: _View, ray: Any) -> _RayResult:
    """Trace a camera ray from front to back through partly transparent surfaces to the first opaque one."""
    if not (view.materials.has_transparency or view.hide_emitters):  # every ray ends at its first hit
        return _trace_surface(view, ray, mi.Bool(True))[2]

    def cond(active: Any, *_: Any) -> Any:
        return active

    def body(active: Any, ray: Any, depth: Any, left: Any, *result: Any) -> tuple[Any, ...]:
        si, may_pass, hit = _trace_surface(view, ray, active)
        *sums, point, shape_index = result
        sums = [total + left * value for total, value in zip(sums, hit.state[:5], strict=True)]
        is_first_solid = (shape_index == 0) & (hit.shape_index != 0)
        point = dr.select(is_first_solid, hit.point, point)
        shape_index = dr.select(is_first_solid, hit.shape_index, shape_index)
        left *= 1.0 - hit.coverage
        depth += 1
        active = active & may_pass & (left > MIN_THROUGHPUT) & (depth < MAX_LAYERS)
        ray = dr.select(active, si.spawn_ray(ray.d), ray)
        return (active, ray, depth, left, *sums, point, shape_index)

    state = (mi.Bool(True), mi.Ray3f(ray), mi.UInt32(0), mi.Float(1.0), *_empty_result(1).state)
    _, _, _, _, *result = dr.while_loop(state, cond, body, label="layers")
    return _RayResult(*result)


def _trace_pixel(view: _View, x: Array, y: Array, spp: int, seed: int) -> tuple[_RayResult, Any]:
    """Return filter-weighted sums over the samples of each pixel, and the sums of the filter weights.

    Point and shape index are taken from sample 0, at the pixel's centre with weight 0. It is part of the
    loop so that the scene's intersection code is compiled only once.
    """
    pixel: Any = mi.UInt32(y) * view.width + mi.UInt32(x)
    # opaque, so that one compiled kernel serves all seeds
    key: Any = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
    shift_x, shift_y = mi.sample_tea_32(pixel, key)
    lens_x, lens_y = mi.sample_tea_32(pixel, key ^ 0x9E3779B9)
    pixel_filter = PixelFilter(view.sensor.film())
    first_x, last_x = pixel_filter.variates_inside(x, view.width)
    first_y, last_y = pixel_filter.variates_inside(y, view.height)
    num_samples = dr.opaque(mi.UInt32, spp)
    step_x, step_y = (dr.opaque(mi.UInt32, step) for step in generator(spp))

    def cond(i: Any, *_: Any) -> Any:
        return i <= num_samples

    def body(i: Any, total_weight: Any, *result: Any) -> tuple[Any, ...]:
        *sums, point, shape_index = result
        is_centre = i == 0
        offset_x, sign_x = pixel_filter.sample(dr.lerp(first_x, last_x, lattice_point(i, shift_x, step_x)))
        offset_y, sign_y = pixel_filter.sample(dr.lerp(first_y, last_y, lattice_point(i, shift_y, step_y)))
        lens = mi.Point2f(lattice_point(i, lens_x, _LENS_X), lattice_point(i, lens_y, _LENS_Y))
        ray = view.ray(
            x + 0.5 + dr.select(is_centre, 0.0, offset_x),
            y + 0.5 + dr.select(is_centre, 0.0, offset_y),
            dr.select(is_centre, 0.5, lattice_point(i, lens_x ^ lens_y, _TIME)),
            dr.select(is_centre, 0.5, lens),
        )
        hit = _trace(view, ray)
        weight = dr.select(is_centre, 0.0, sign_x * sign_y)
        sums = [total + weight * value for total, value in zip(sums, hit.state[:5], strict=True)]
        point = dr.select(is_centre, hit.point, point)
        shape_index = dr.select(is_centre, hit.shape_index, shape_index)
        return (i + 1, total_weight + weight, *sums, point, shape_index)

    num_pixels = dr.width(x)
    zero = dr.zeros(mi.Float, num_pixels)
    state = (dr.zeros(mi.UInt32, num_pixels), zero, *_empty_result(num_pixels).state)
    _, total_weight, *result = dr.while_loop(state, cond, body, label="sub-pixel samples")
    return _RayResult(*result), total_weight


def _render(view: _View, spp: int, seed: int) -> dict[str, Any]:
    """Return the buffers by name, as unevaluated Dr.Jit arrays of H x W entries."""
    if spp < 1:
        raise input_error("material_buffers", "spp", spp, "at least 1 sample per pixel", "use 16 or more")
    index = dr.arange(mi.UInt32, view.width * view.height)
    row = index // view.width
    sums, weight = _trace_pixel(view, mi.Float(index - row * view.width), mi.Float(row), spp, seed)
    # With negative lobes, a pixel's coverage may be almost zero or negative.
    share = dr.select(weight > 0.0, sums.coverage / dr.select(weight > 0.0, weight, 1.0), 0.0)
    is_covered = share > MIN_COVERAGE
    scale = dr.select(is_covered, 1.0 / dr.select(is_covered, sums.coverage, 1.0), 0.0)
    length = dr.norm(sums.normal)
    has_normal = is_covered & (length > 0.0)
    to_world = view.sensor.world_transform()
    axis = dr.normalize(to_world @ mi.Vector3f(0.0, 0.0, 1.0))
    origin = to_world @ mi.Point3f(0.0, 0.0, 0.0)
    is_hit = sums.shape_index != 0
    instance, material = view.materials.ids_at(sums.shape_index)
    values = {
        MATERIAL_MAPS.diffuse_albedo: dr.clip(sums.diffuse_albedo * scale, 0.0, 1.0),
        MATERIAL_MAPS.specular_albedo: dr.clip(sums.specular_albedo * scale, 0.0, 1.0),
        MATERIAL_MAPS.roughness: dr.clip(sums.roughness * scale, 0.0, 1.0),
        "normal_world": dr.select(has_normal, sums.normal / dr.select(has_normal, length, 1.0), 0.0),
        "surface_mask": dr.select(is_covered, dr.minimum(share, 1.0), 0.0),
        "depth_z_m": dr.select(is_hit, dr.dot(sums.point - origin, axis), 0.0),
        "position_world": sums.point,
        "instance_id": instance,
        "material_id": material,
    }
    return {name: values[name] for name in CHANNELS}


def render_material_buffers(
    scene: mi.Scene,
    sensor: mi.Sensor | int = 0,
    spp: int = 64,
    seed: int = 0,
    ids: IdTable | SceneMaterials | None = None,
    hide_emitters: bool = False,
) -> dict[str, np.ndarray]:
    """Render the ground-truth buffers of a view: arrays (H, W, C) by the names of ``foundation.buffers``.

    They are float32 except for ``instance_id`` and ``material_id`` (uint32). The result also contains
    ``position_world`` [m], the point whose depth is ``depth_z_m`` [m]. ``ids`` maps shape ids to (instance
    id, material id), or is a :class:`SceneMaterials` shared by several views; None: shapes are numbered.
    ``hide_emitters`` must equal that of the beauty image's integrator. Raises :class:`InputError` if ``spp``
    is below 1, a shape's material has no D, S and R, or a shape is missing from ``ids``.
    """
    chosen: Any = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
    materials = ids if isinstance(ids, SceneMaterials) else SceneMaterials(scene, ids)
    width, height = (int(v) for v in chosen.film().crop_size())
    view = _View(scene, chosen, materials, hide_emitters, width, height)
    with dr.suspend_grad():
        buffers = _render(view, spp, seed)
        dr.eval(buffers)
    arrays = {}
    for name, value in buffers.items():
        array = np.array(value)
        array = array[None] if array.ndim == 1 else array
        arrays[name] = np.ascontiguousarray(array.T).reshape(height, width, len(CHANNELS[name]))
    return arrays


class MaterialBuffers(mi.SamplingIntegrator):
    """The integrator ``material_buffers``: all channels of :data:`CHANNELS` as one tensor (H, W, 17).

    Parameter ``hide_emitters`` (default false). Ids are from ``integrator.ids`` or, if that is None, from
    :func:`mitsuba_plugins.surface_material.number_shapes`. Ids below 2^24 are exact as floats.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.ids: IdTable | SceneMaterials | None = None

    def aov_names(self) -> list[str]:
        """Names ``buffer.channel`` of the channels, in the order of :meth:`render`'s output."""
        return [f"{name}.{channel}" for name, channels in CHANNELS.items() for channel in channels]

    def render(  # type: ignore[override]
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render and evaluate all channels of a view, (H, W, 17); ``spp`` 0 uses the sensor's sample count.

        Raises ``ValueError`` if ``develop`` is false.
        """
        if not develop:
            raise ValueError("material_buffers writes no film: develop must be True")
        chosen: Any = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        spp = spp or int(chosen.sampler().sample_count())
        seed = int(np.asarray(seed).ravel()[0])
        buffers = render_material_buffers(scene, chosen, spp, seed, self.ids, bool(self.hide_emitters))
        return mi.TensorXf(np.concatenate([b.astype(np.float32) for b in buffers.values()], axis=-1))

    def to_string(self) -> str:
        return f"MaterialBuffers[hide_emitters = {self.hide_emitters}]"

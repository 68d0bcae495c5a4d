# SPDX-License-Identifier: MIT
"""Light transport: unidirectional path tracing with emitter sampling and multiple importance sampling.

The estimator is that of Mitsuba's ``path`` (tests hold one against the other), with what rooms need besides:

* lights that the camera does not see: camera rays pass through them, everything else meets them;
* samples of a pixel that are spread evenly in every pair of dimensions (:mod:`.sobol`);
* an environment seen through windows: shadow rays are sent through the openings where it shines in
  (:mod:`.sky_guide`), where others nearly all end at walls;
* a cache of the irradiance behind the first turn, for those who want speed
  (:mod:`.irradiance_cache`);
* opacity: shadow rays are attenuated by what they cross instead of being stopped by it, so that leaves and
  curtains cast their own shadows also from point lights, and crossing them costs no path depth.

No film is involved: a pixel's samples are neighbours in one array and are added in their order, so that a
result has the same bytes however many threads made it. Camera, size, seed, sample count and the clamp are
data of the kernel, which is recorded once for a scene and played again.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.sample_budget import PathSums
from datagen.rendering.transport.irradiance_cache import (
    NARROW_PDF,
    IrradianceCache,
    spread_of,
)
from datagen.rendering.transport.irradiance_gathering import learn_irradiance
from datagen.rendering.transport.light_sampler import LightChoice, even_choice
from datagen.rendering.transport.recording import undisturbed
from datagen.rendering.transport.sky_guide import SkyGuide, learn_sky
from datagen.rendering.transport.sky_observation import observe_sky
from datagen.rendering.transport.sobol import OwenSobol
from datagen.rendering.transport.vertex import power_heuristic

if TYPE_CHECKING:
    from datagen.rendering.scene_builder import BuiltScene
    from mitsuba_plugins.surface_material import SceneMaterials

Array = Any

MAX_LANES = 1 << 24
"""Light paths traced in one launch; a view with more takes several. Each takes 36 bytes."""
LATTICE = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence: 1/g and 1/g^2 with g^3 = g + 1."""
MAX_CROSSINGS = 32
"""Transparent surfaces that one ray crosses before it counts as blocked."""
TINY = 1e-30
"""Keeps the clamp's quotient finite for paths that bring nothing."""

_LIVE: weakref.WeakSet[PathTracer] = weakref.WeakSet()


def forget_recordings() -> None:
    """Of all tracers there are; before Dr.Jit's cache of kernels is emptied."""
    for tracer in list(_LIVE):
        tracer.forget_recordings()


class PathTracer:
    """Traces the light paths of one scene.

    ``max_depth`` counts segments from the camera to the light (1: emitters only, 2: direct light);
    Russian roulette ends paths from ``russian_roulette_depth`` segments on.
    """

    def __init__(self, built: BuiltScene, max_depth: int, russian_roulette_depth: int):
        self.scene = built.scene
        self.max_depth, self.russian_roulette_depth = max_depth, russian_roulette_depth
        self._has_transparency = any(
            mi.has_flag(flags, mi.BSDFFlags.Null)
            for flags in (shape.bsdf().flags() for shape in built.scene.shapes() if shape.bsdf() is not None)
        )
        self._is_hidden_shape = self._hidden_table(built) if built.hidden_shapes else None
        self.sky_guide: SkyGuide | None = None
        self.lights: LightChoice | None = even_choice(self.scene, None)
        self.irradiance: IrradianceCache | None = None
        # Recorded once: tracing the Python of hundreds of materials takes longer than a small pass of paths.
        self._recorded: Any = dr.freeze(self._trace, state_fn=lambda *_: self.tables())
        _LIVE.add(self)

    def tables(self) -> list[Any]:
        """Arrays that kernels read and that no argument brings."""
        lights = [] if self.lights is None else self.lights.arrays()
        cache = [] if self.irradiance is None else self.irradiance.arrays()
        return [self._is_hidden_shape, *lights, *cache]

    def learn_sky(self, sensors: Iterable[Any], num_samples: int, seed: int) -> None:
        """Find out where the environment shines in (:mod:`.sky_guide`), as ``sensors`` lead
        there with ``num_samples`` paths a pixel. Without an environment there is nothing to find."""
        self.guide_by(None)
        if self.scene.environment() is None:
            return
        with dr.suspend_grad():
            walks = (self._walk_from(sensor, num_samples, seed + k) for k, sensor in enumerate(sensors))
            self.guide_by(learn_sky(self.scene, observe_sky(self.scene, self.is_hidden, walks)))

    def guide_by(self, guide: SkyGuide | None) -> None:
        """Let shadow rays go through the openings of ``guide``, and forget what was learned with another."""
        self.sky_guide, self.irradiance = guide, None
        self.lights = even_choice(self.scene, guide)
        self.forget_recordings()

    def learn_irradiance(
        self, materials: SceneMaterials, sensors: Iterable[Any], num_pixels: int, seed: int
    ) -> None:
        """Find out how bright surfaces are (:mod:`.irradiance_cache`), and let paths end
        there from here on. ``num_pixels``: of all views, for which this is done."""
        self.guide_by(self.sky_guide)
        if self.scene.emitters():
            with dr.suspend_grad():
                self.irradiance = learn_irradiance(self, materials, sensors, num_pixels, seed)
        if self.irradiance is not None and (shares := self.irradiance.light_shares()).size:
            self.lights = LightChoice(self.scene, self.sky_guide, shares)

    def _walk_from(self, sensor: Any, num_samples: int, seed: int) -> tuple[Any, Any]:
        """Rays through all pixels of a sensor, and a sampler for their ways."""
        from datagen.rendering.plugins import rays_through  # knows classes of the variant

        width, height = (int(v) for v in sensor.film().crop_size())
        lane: Any = dr.arange(mi.UInt32, width * height * num_samples)
        pixel: Any = lane // num_samples
        launch: Any = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
        sampler = OwenSobol(lane % num_samples, mi.sample_tea_32(pixel, launch)[0])
        corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
        return rays_through(sensor.view, corner + sampler.next_2d()), sampler

    def _hidden_table(self, built: BuiltScene) -> Any:
        pointers: Any = built.scene.shapes_dr()
        registry = np.asarray(dr.reinterpret_array(mi.UInt32, pointers)).astype(np.int64)
        table = np.zeros(int(registry.max(initial=0)) + 1, bool)
        for shape, index in zip(built.scene.shapes(), registry, strict=True):
            table[index] = shape.id() in built.hidden_shapes
        return mi.Bool(table)

    def render(
        self, sensor: Any, num_samples: int, seed: int, *, with_seen_lights: bool = True
    ) -> NDArray[np.float32]:
        """Mean radiance (H, W, 3) of ``num_samples`` paths a pixel, uniformly distributed over the pixel.

        ``with_seen_lights`` False leaves out what lights and background send straight to the camera; that is
        :meth:`render_seen_lights`, which has no noise worth denoising. ``seed`` is taken modulo 2^32.
        """
        sums = self.add_up(sensor, num_samples, seed, with_seen_lights=with_seen_lights)
        return sums.mean()

    def add_up(
        self,
        sensor: Any,
        num_samples: int | NDArray[np.int64],
        seed: int,
        *,
        with_seen_lights: bool = False,
        limit: float = math.inf,
        grid: tuple[int, int] | None = None,
        before: NDArray[np.int64] | int = 0,
    ) -> PathSums:
        """Sums over ``num_samples`` paths a pixel: one number, or one for each pixel (H, W).

        Where the light that a path brings by two or more reflections exceeds ``limit`` in its largest
        channel, it is scaled down to it, and what that takes away is added up too. Direct light is never
        clamped: a patch of sun is as bright as it is. ``grid`` (columns, rows) divides the image into other
        cells than its pixels. ``before``: samples that each cell had with this seed; these are the next
        ones of its sequence. All calls share one kernel.
        """
        width, height = grid or tuple(int(v) for v in sensor.film().crop_size())
        wanted = np.broadcast_to(np.asarray(num_samples, np.int64), (height, width)).ravel()
        step = int(np.gcd.reduce(wanted))  # samples of one entry of the list of pixels
        repeats = wanted // max(step, 1)
        cells = np.repeat(np.arange(wanted.size, dtype=np.uint32), repeats)
        earlier = np.arange(cells.size) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        firsts = np.repeat(np.broadcast_to(before, (height, width)).ravel(), repeats) + step * earlier
        num_per_launch = max(1, MAX_LANES // max(step, 1))
        sums = np.zeros((wanted.size, 4))
        if not self.scene.emitters():  # nothing to find, and lights of other scenes are not to be recorded
            cells = cells[:0]
        for start in range(0, cells.size, num_per_launch):
            part = slice(start, start + num_per_launch)
            chosen, entries = cells[part], (cells[part], firsts[part].astype(np.uint32))
            values = self._launch(sensor, (width, height), entries, step, seed, with_seen_lights, limit)
            for channel in range(4):  # in the order of the list, whatever the threads did
                sums[:, channel] += np.bincount(chosen, values[channel], wanted.size)
        image = sums.reshape(height, width, 4)
        return PathSums(image[..., :3], image[..., 3], wanted.reshape(height, width))

    def _launch(
        self,
        sensor: Any,
        size: tuple[int, int],
        entries: tuple[NDArray[np.uint32], NDArray[np.uint32]],
        count: int,
        seed: int,
        with_seen_lights: bool,
        limit: float,
    ) -> list[NDArray[np.float64]]:
        """Sums over ``count`` samples of each entry: red, green, blue and what the clamp took, (N,) each.

        ``entries``: cells, flat indices (N,), and the number of the first sample of each (N,).
        """
        cells, firsts = entries
        num_lanes = cells.size * count
        film = sensor.film().crop_size()
        with dr.suspend_grad():
            samples: Any = dr.opaque(mi.UInt32, count)
            lane: Any = dr.arange(mi.UInt32, num_lanes)
            entry: Any = lane // samples
            cell: Any = dr.gather(mi.UInt32, mi.UInt32(cells), entry)
            index: Any = dr.gather(mi.UInt32, mi.UInt32(firsts), entry) + (lane - entry * samples)
            launch: Any = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
            sampler = OwenSobol(index, mi.sample_tea_32(cell, launch)[0])
            width: Any = dr.opaque(mi.UInt32, size[0])
            row: Any = cell // width
            corner = mi.Point2f(mi.Float(cell - row * width), mi.Float(row))
            cell_px: Any = mi.Vector2f(film[0] / size[0], film[1] / size[1])
            dr.make_opaque(cell_px)
            limit_of_paths = dr.opaque(mi.Float, limit)
            with undisturbed():
                channels = self._recorded(
                    self.scene, sampler, sensor.view, corner, cell_px, limit_of_paths, with_seen_lights
                )
            sums = [dr.block_sum(channel, count) for channel in channels]
            dr.eval(sums)
        return [np.array(s).astype(np.float64) for s in sums]

    def _trace(
        self,
        scene: Any,
        sampler: Any,
        view: tuple[Any, ...],
        corner: Array,
        cell_px: Array,
        limit: Array,
        with_seen_lights: bool,
    ) -> list[Array]:
        """Red, green, blue and what the clamp took away, of one path through each cell of the image.

        Recorded and played again: whatever differs between calls comes in as an argument.
        """
        from datagen.rendering.plugins import rays_through  # knows classes of the variant

        ray = rays_through(view, (corner + sampler.next_2d()) * cell_px)
        direct, indirect = self.sample(sampler, ray, with_seen_lights)
        kept = dr.minimum(limit / dr.maximum(dr.max(indirect), TINY), 1.0)
        return [*(direct + indirect * kept), mi.luminance(indirect) * (1.0 - kept)]

    def forget_recordings(self) -> None:
        """Record anew at the next call, as is due when kernels are thrown away."""
        self._recorded.clear()

    def render_seen_lights(
        self, sensor: Any, pixels: NDArray[np.uint32], num_samples: int, seed: int
    ) -> NDArray[np.float32]:
        """What lights and background send straight to the camera, (P, 3), for flat pixel indices (P,).

        ``num_samples`` points of a shifted lattice a pixel; no light transport, hence cheap.
        """
        width, height = (int(v) for v in sensor.film().crop_size())
        with dr.suspend_grad():
            radiance = self._seen_lights(
                sensor, mi.UInt32(pixels), (width, height), dr.opaque(mi.UInt32, num_samples), seed
            )
            dr.eval(radiance)
        return np.ascontiguousarray((np.array(radiance) / num_samples).T.astype(np.float32))

    @dr.syntax
    def _seen_lights(
        self, sensor: Any, pixel: Array, size: tuple[int, int], num_samples: Array, seed: int
    ) -> Array:
        width, height = size
        key: Any = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
        bits_x, bits_y = mi.sample_tea_32(pixel, key)
        shift_x, shift_y = mi.Float(bits_x >> 8) * 2.0**-24, mi.Float(bits_y >> 8) * 2.0**-24
        row: Any = pixel // width
        left, top = mi.Float(pixel - row * width), mi.Float(row)
        result = dr.zeros(mi.Color3f, dr.width(pixel))
        i = dr.zeros(mi.UInt32, dr.width(pixel))
        while i < num_samples:
            x, y = shift_x + mi.Float(i) * LATTICE[0], shift_y + mi.Float(i) * LATTICE[1]
            position = mi.Point2f((left + x - dr.floor(x)) / width, (top + y - dr.floor(y)) / height)
            ray, _ = sensor.sample_ray(mi.Float(0.0), mi.Float(0.5), position, mi.Point2f(0.5))
            result += self._light_ahead(ray)
            i += 1
        return result

    @dr.syntax
    def _light_ahead(self, ray: Array) -> Array:
        """Radiance of the lights that a camera ray meets, through what is transparent."""
        result, throughput = mi.Color3f(0.0), mi.Color3f(1.0)
        num_crossed, active = mi.UInt32(0), mi.Bool(True)
        while active:
            si = self.scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
            is_seen = active & ~self.is_hidden(si, mi.UInt32(0))
            result += throughput * si.emitter(self.scene).eval(si, is_seen)
            active &= si.is_valid()
            if dr.hint(self._has_transparency, mode="scalar"):
                transmission = si.bsdf().eval_null_transmission(si, active & is_seen)
                throughput *= dr.select(is_seen, transmission, 1.0)
            else:
                active &= ~is_seen
            num_crossed += 1
            active &= (dr.max(throughput) > 0.0) & (num_crossed < MAX_CROSSINGS)
            ray = si.spawn_ray(ray.d)
        return result

    @dr.syntax
    def sample(self, sampler: Any, ray: Array, with_seen_lights: bool = True) -> tuple[Array, Array]:
        """Radiance that arrives along camera rays, one path each: (Color3f, Color3f), by at most one
        reflection and by more."""
        scene, ctx = self.scene, mi.BSDFContext()
        cache: Any = self.irradiance
        ray = mi.Ray3f(ray)
        direct, indirect, throughput = mi.Color3f(0.0), mi.Color3f(0.0), mi.Color3f(1.0)
        depth, num_crossed = mi.UInt32(0), mi.UInt32(0)
        previous = dr.zeros(mi.Interaction3f)
        previous_pdf, previous_is_delta = mi.Float(1.0), mi.Bool(True)
        spread_m, is_cached, cached = mi.Float(0.0), mi.Bool(False), mi.Color3f(0.0)
        place, previous_place = mi.UInt32(0), mi.UInt32(0)  # in the cache
        active = mi.Bool(True)
        while active:
            si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)

            # ---- light that the ray met ---------------------------------------------------------------
            is_seen = active & ~self.is_hidden(si, depth)
            emitter = si.emitter(scene)
            shows = is_seen
            if dr.hint(not with_seen_lights, mode="scalar"):
                shows = is_seen & (depth > 0)  # a new array: in place it would change is_seen too
            ds = mi.DirectionSample3f(scene, si, previous)
            emitter_pdf = scene.pdf_emitter_direction(previous, ds, is_seen & ~previous_is_delta)
            emitter_pdf = self.mixed_pdf(previous.p, ray.d, emitter_pdf, emitter, previous_place)
            weight = dr.select(previous_is_delta, 1.0, power_heuristic(previous_pdf, emitter_pdf))
            met = throughput * emitter.eval(si, shows) * weight

            active_next = active & si.is_valid() & ((depth + 1 < self.max_depth) | ~is_seen)
            bsdf = si.bsdf()

            # ---- light sampled from here ----------------------------------------------------------------
            is_smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            active_emitter = active_next & is_seen & is_smooth
            if dr.hint(cache is not None, mode="scalar"):
                returns = active_next & is_seen & (depth > 0)
                spread_m += dr.select(returns, spread_of(previous, previous_pdf, si, ray.d), 0.0)
                place = cache.place(si, ray.d, active_next & is_seen)
                cached, is_cached = cache.mean_radiance(
                    si, ray.d, place, spread_m, sampler.next_2d(), returns
                )
                active_emitter &= ~is_cached  # what is cached includes direct light
            ds, radiance = self.sample_emitter(si, sampler, place, active_emitter)
            active_emitter &= ds.pdf != 0.0
            wo = si.to_local(ds.d)

            # ---- the surface: value towards the light, and where the path goes on -------------------------
            value, pdf, bs, bsdf_weight = bsdf.eval_pdf_sample(
                ctx, si, wo, sampler.next_1d(), sampler.next_2d(), active_next
            )
            weight = dr.select(ds.delta, 1.0, power_heuristic(ds.pdf, pdf))
            sampled = dr.select(active_emitter, throughput * value * radiance * weight, 0.0)
            direct += dr.select(depth <= 1, met, 0.0) + dr.select(depth == 0, sampled, 0.0)
            indirect += dr.select(depth <= 1, 0.0, met) + dr.select(depth == 0, 0.0, sampled)

            passes = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            if dr.hint(self._is_hidden_shape is not None, mode="scalar"):
                passes |= ~is_seen
                bsdf_weight = dr.select(is_seen, bsdf_weight, 1.0)
            ends = is_cached & ~passes & (bs.pdf < NARROW_PDF)
            indirect += dr.select(ends, throughput * bsdf_weight * cached, 0.0)
            direction = dr.select(passes, ray.d, si.to_world(bs.wo))
            ray = si.spawn_ray(direction)
            throughput *= bsdf_weight
            # What was crossed is no vertex: the last one keeps its place and density for the MIS weight.
            scatters = active_next & ~passes
            previous = dr.select(scatters, mi.Interaction3f(si), previous)
            previous_pdf = dr.select(scatters, bs.pdf, previous_pdf)
            previous_place = dr.select(scatters, place, previous_place)
            is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            # A narrow lobe that leaves the cache had no shadow ray: lights that it meets count in full.
            previous_is_delta = dr.select(scatters, is_delta | is_cached, previous_is_delta)
            depth = dr.select(scatters, depth + 1, depth)
            num_crossed = dr.select(passes, num_crossed + 1, num_crossed)

            # ---- Russian roulette --------------------------------------------------------------------------
            largest = dr.max(throughput)
            survival = dr.minimum(largest, 0.95)
            plays = scatters & (depth >= self.russian_roulette_depth)
            survives = sampler.next_1d() < survival
            throughput = dr.select(plays, throughput / dr.maximum(survival, 1e-30), throughput)
            active = (
                active_next & ~ends & (~plays | survives) & (largest > 0.0) & (num_crossed < MAX_CROSSINGS)
            )
        return direct, indirect

    def is_hidden(self, si: Any, depth: Array) -> Array:
        """Whether a ray that comes from the camera met a light that the camera does not see."""
        if self._is_hidden_shape is None:
            return mi.Bool(False)
        shape: Any = dr.reinterpret_array(mi.UInt32, si.shape)
        return (depth == 0) & dr.gather(mi.Bool, self._is_hidden_shape, shape, si.is_valid())

    def sample_emitter(self, si: Any, sampler: Any, place: Array, active: Array) -> tuple[Any, Any]:
        """Direction to a light, and its radiance over the density, less what lies between. ``place``: where
        ``si`` lies in the cache of irradiance, or 0."""
        if self.lights is None:
            is_tested = not self._has_transparency
            ds, radiance = self.scene.sample_emitter_direction(si, sampler.next_2d(), is_tested, active)
            if is_tested:
                return ds, radiance
        else:
            ds, radiance = self.lights.sample_emitter(si, place, sampler.next_2d(), sampler.next_1d(), active)
        reaches = active & (ds.pdf != 0.0)
        if self._has_transparency:
            return ds, radiance * self._transmittance(si, ds, reaches)
        is_blocked = self.scene.ray_test(si.spawn_ray_to(ds.p), reaches)
        return ds, dr.select(reaches & ~is_blocked, radiance, 0.0)

    def mixed_pdf(
        self, point: Array, direction: Array, own_pdf: Array, emitter: Array, place: Array
    ) -> Array:
        """Density of :meth:`sample_emitter` towards an emitter, from that of the scene's own sampling."""
        if self.lights is None:
            return own_pdf
        return self.lights.pdf(point, direction, own_pdf, self.lights.index(emitter), place)

    @dr.syntax
    def _transmittance(self, si: Any, ds: Any, active: Array) -> Array:
        """What part of the light of ``ds`` reaches ``si`` through surfaces of partial opacity."""
        ray = si.spawn_ray_to(ds.p)
        left = dr.select(active, mi.Color3f(1.0), mi.Color3f(0.0))
        num_crossed = mi.UInt32(0)
        distance = mi.Float(ray.maxt)
        while active:
            hit = self.scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
            is_hit = active & hit.is_valid()
            left *= dr.select(is_hit, hit.bsdf().eval_null_transmission(hit, is_hit), 1.0)
            distance -= hit.t
            next_ray = hit.spawn_ray(ray.d)
            next_ray.maxt = distance
            ray = next_ray
            num_crossed += 1
            active = is_hit & (dr.max(left) > 0.0) & (distance > 0.0)
            if active & (num_crossed >= MAX_CROSSINGS):
                left = mi.Color3f(0.0)
                active = mi.Bool(False)
        return left

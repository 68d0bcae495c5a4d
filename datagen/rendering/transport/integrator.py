# SPDX-License-Identifier: MIT
"""Light transport: unidirectional path tracing with emitter sampling and multiple importance sampling.

The estimator is that of Mitsuba's ``path`` (tests compare the two), extended by

* lights hidden from the camera, and opacity in shadow rays (:mod:`.emitters`);
* low-discrepancy samples in every pair of dimensions of a pixel (:mod:`.sobol`);
* learned light sampling (:mod:`.light_sampler`) and sampling of the sky through windows (:mod:`.sky_guide`);
* optionally, diffuse light from an irradiance cache after the first bounce (:mod:`.irradiance_cache`).

There is no film; the samples of a pixel are adjacent in one array and are summed in order, so results have
the same bytes for any number of threads. A kernel, recorded once per scene, continues the paths of all lanes
by some segments; between its launches, the paths that have not ended are packed into adjacent lanes.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.sample_budget import PathSums
from datagen.rendering.transport.emitters import SceneEmitters
from datagen.rendering.transport.irradiance_cache import IrradianceCache, spread_of
from datagen.rendering.transport.irradiance_gathering import gather_irradiance
from datagen.rendering.transport.light_sampler import LightSampler, uniform_sampler
from datagen.rendering.transport.recording import undisturbed
from datagen.rendering.transport.sky_guide import SkyGuide, fit_sky_guide
from datagen.rendering.transport.sky_observation import observe_sky
from datagen.rendering.transport.sobol import OwenSobol
from datagen.rendering.transport.vertex import MAX_CROSSINGS, Walk, facing_normal, power_heuristic

if TYPE_CHECKING:
    from datagen.rendering.scene_builder import BuiltScene
    from datagen.rendering.shape_ids import MergedShapeMaterials

Array = Any

MAX_LANES = 1 << 19
"""Maximum number of light paths per launch, of about 300 bytes each; larger views need several launches."""
FIRST_SEGMENTS = 2
"""Number of segments before unfinished paths are first packed; each later launch traces half as many segments
as all earlier ones together."""
MIN_PACKED = 1 << 14
"""Minimum number of unfinished paths that are packed; fewer are traced to their ends in one launch."""
UNLIMITED = 0xFFFFFFFF
MIN_SPECULAR_SURVIVAL = 0.2
"""Minimum probability that a path whose diffuse light is cached continues along the specular lobe."""
TINY = 1e-30
"""Prevents division by 0 for paths without light and surfaces of zero opacity."""

_LIVE: weakref.WeakSet[PathTracer] = weakref.WeakSet()


def forget_recordings() -> None:
    """Drop the recorded kernels of all tracers; required before Dr.Jit's kernel cache is emptied."""
    for tracer in list(_LIVE):
        tracer.forget_recordings()


class PathState:
    """State of one path per lane, passed between the launches that continue the path."""

    DRJIT_STRUCT: ClassVar[dict[str, type]] = dict.fromkeys(
        ("walk", "sampler", "throughput", "direct", "indirect", "spread_m", "active"), object
    )

    def __init__(self, sampler: Any = None, ray: Any = None):
        """Start paths at their camera rays; without arguments, create an object to be filled."""
        num = 1 if ray is None else dr.width(ray)
        self.walk = Walk(ray)  # current segment and previous vertex
        self.sampler = OwenSobol() if sampler is None else sampler
        self.throughput: Any = dr.full(mi.Color3f, 1.0, num)  # product of BSDF weights and roulette factors
        self.direct: Any = dr.zeros(mi.Color3f, num)  # radiance after at most one bounce
        self.indirect: Any = dr.zeros(mi.Color3f, num)  # radiance after two or more bounces
        self.spread_m: Any = dr.zeros(mi.Float, num)  # see irradiance_cache.spread_of
        self.active: Any = dr.full(mi.Bool, True, num)  # whether the path continues


def _gathered(state: Any, lanes: Any) -> Any:
    """Copy of a state with only the given ``lanes`` (mi.UInt32)."""
    if not isinstance(state, PathState | Walk | OwenSobol):
        return dr.gather(type(state), state, lanes)
    result = type(state)()
    for name in state.DRJIT_STRUCT:
        setattr(result, name, _gathered(getattr(state, name), lanes))
    return result


class PathTracer:
    """Traces the light paths of one scene.

    ``max_depth`` is the maximum number of segments from the camera to the light (1: emitters only, 2: direct
    light). Russian roulette is applied from ``russian_roulette_depth`` segments on.
    """

    def __init__(
        self,
        built: BuiltScene,
        materials: MergedShapeMaterials,
        max_depth: int,
        russian_roulette_depth: int,
    ):
        self.scene = built.scene
        self.max_depth, self.russian_roulette_depth = max_depth, russian_roulette_depth
        self.emitters = SceneEmitters(built)
        self.materials = materials
        self.sky_guide: SkyGuide | None = None
        self.irradiance: IrradianceCache | None = None
        # Recorded once, since the Python code of hundreds of materials runs longer than a small pass.
        self._recorded: Any = dr.freeze(self._trace, state_fn=lambda *_: self._tables())
        _LIVE.add(self)

    def _tables(self) -> list[Any]:
        """Arrays that the kernel reads in addition to its arguments."""
        cache = [] if self.irradiance is None else self.irradiance.arrays()
        return [*self.emitters.tables(), *self.materials.tables(), *cache]

    # ---- state shared by all views -------------------------------------------------------------------

    def fit_sky_guide(self, sensors: Iterable[Any], num_samples: int, seed: int) -> None:
        """Estimate a sky guide from ``num_samples`` paths per pixel of ``sensors``; none without a sky."""
        self.use_sky_guide(None)
        if self.scene.environment() is None:
            return
        with dr.suspend_grad():
            rays = (self._rays_of(sensor, num_samples, seed + k) for k, sensor in enumerate(sensors))
            self.use_sky_guide(
                fit_sky_guide(self.scene, observe_sky(self.scene, self.emitters.is_hidden, rays))
            )

    def use_sky_guide(self, guide: SkyGuide | None) -> None:
        """Set the guide of all later samples (None for no guide) and drop the irradiance cache."""
        self.sky_guide, self.irradiance = guide, None
        self.emitters.light_sampler = uniform_sampler(self.scene, guide)
        self.forget_recordings()

    def gather_irradiance(self, sensors: Iterable[Any], seed: int) -> None:
        """Gather the irradiance cache, in which later paths may end, and fit the light sampler."""
        self.use_sky_guide(self.sky_guide)
        if self.scene.emitters():
            with dr.suspend_grad():
                self.irradiance = gather_irradiance(self.emitters, self.materials, sensors, seed)
        if self.irradiance is not None and self.irradiance.light_weights.size:
            weights = self.irradiance.light_weights
            self.emitters.light_sampler = LightSampler(self.scene, self.sky_guide, weights)

    def _rays_of(self, sensor: Any, num_samples: int, seed: int) -> tuple[Any, Any]:
        """Return ``num_samples`` rays through each pixel of a sensor, and the sampler of their paths."""
        from datagen.rendering.plugins import rays_through  # needs a selected variant

        width, height = (int(v) for v in sensor.film().crop_size())
        lane: Any = dr.arange(mi.UInt32, width * height * num_samples)
        pixel: Any = lane // num_samples
        launch: Any = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
        sampler = OwenSobol(lane % num_samples, mi.sample_tea_32(pixel, launch)[0])
        corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
        return rays_through(sensor.view, corner + sampler.next_2d()), sampler

    # ---- images ----------------------------------------------------------------------------------------

    def render(
        self, sensor: Any, num_samples: int, seed: int, *, with_visible_emission: bool = True
    ) -> NDArray[np.float32]:
        """Mean radiance (H, W, 3) of ``num_samples`` paths per pixel, uniformly distributed over the pixel.

        ``with_visible_emission`` False excludes light without a bounce. ``seed`` is taken modulo 2^32.
        """
        return self.accumulate(sensor, num_samples, seed, with_visible_emission=with_visible_emission).mean()

    def accumulate(
        self,
        sensor: Any,
        num_samples: int | NDArray[np.int64],
        seed: int,
        *,
        with_visible_emission: bool = False,
        limit: float = math.inf,
        grid: tuple[int, int] | None = None,
        before: NDArray[np.int64] | int = 0,
    ) -> PathSums:
        """Sums over ``num_samples`` paths per pixel, one number or an array (H, W); see also :meth:`render`.

        If a path's light after two or more bounces exceeds ``limit`` in its largest channel, it is scaled
        down to the limit, and the removed luminance is summed too. Direct light, such as patches of sun, is
        never clamped. ``grid`` (columns, rows) divides the image into larger cells than pixels. ``before`` is
        the number of samples already drawn in each cell with this seed; new ones continue the sequence.
        """
        width, height = grid or tuple(int(v) for v in sensor.film().crop_size())
        wanted = np.broadcast_to(np.asarray(num_samples, np.int64), (height, width)).ravel()
        step = int(np.gcd.reduce(wanted))  # samples per entry of the list of cells
        repeats = wanted // max(step, 1)
        cells = np.repeat(np.arange(wanted.size, dtype=np.uint32), repeats)
        earlier = np.arange(cells.size) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        firsts = np.repeat(np.broadcast_to(before, (height, width)).ravel(), repeats) + step * earlier
        num_per_launch = max(1, MAX_LANES // max(step, 1))
        sums = np.zeros((wanted.size, 4))
        if not self.scene.emitters():  # the image is black; kernels without emitters cannot be recorded
            cells = cells[:0]
        for start in range(0, cells.size, num_per_launch):
            part = slice(start, start + num_per_launch)
            chosen, entries = cells[part], (cells[part], firsts[part].astype(np.uint32))
            values = self._launch(sensor, (width, height), entries, step, seed, with_visible_emission, limit)
            for channel in range(4):  # bincount adds in order, for any number of threads
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
        with_visible_emission: bool,
        limit: float,
    ) -> list[NDArray[np.float64]]:
        """Sum ``count`` samples for each of N entries; return red, green, blue, removed luminance, (N,) each.

        ``entries`` are row-major indices (N,) of cells in an image of ``size`` (columns, rows), and the index
        (N,) of the first sample in each cell's sequence.
        """
        from datagen.rendering.plugins import rays_through  # needs a selected variant

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
            ray = rays_through(sensor.view, (corner + sampler.next_2d()) * cell_px)
            direct, indirect = self.sample(sampler, ray, with_visible_emission)
            kept = dr.minimum(dr.opaque(mi.Float, limit) / dr.maximum(dr.max(indirect), TINY), 1.0)
            channels = [*(direct + indirect * kept), mi.luminance(indirect) * (1.0 - kept)]
            sums = [dr.block_sum(channel, count) for channel in channels]
            dr.eval(sums)
        return [np.array(s).astype(np.float64) for s in sums]

    def sample(self, sampler: Any, ray: Array, with_visible_emission: bool = True) -> tuple[Any, Any]:
        """Trace one path per camera ray; return radiance after at most one bounce, and after more.

        All lanes of a vector take as long as the longest of their paths. Paths that have not ended after
        ``FIRST_SEGMENTS`` segments are therefore packed into adjacent lanes and continued in later launches.
        """
        num_paths = dr.width(ray)
        paths = PathState(sampler, ray)
        direct, indirect = dr.empty(mi.Color3f, num_paths), dr.empty(mi.Color3f, num_paths)
        lanes: Any = dr.arange(mi.UInt32, num_paths)
        num_traced, num_segments = 0, FIRST_SEGMENTS
        while dr.width(lanes):
            if dr.width(lanes) < MIN_PACKED:
                num_segments = UNLIMITED
            count = dr.opaque(mi.UInt32, num_segments)
            dr.make_opaque(paths)
            with undisturbed():
                paths = self._recorded(self.scene, paths, count, with_visible_emission)
            dr.scatter(direct, paths.direct, lanes)
            dr.scatter(indirect, paths.indirect, lanes)
            left: Any = dr.compress(paths.active)
            paths, lanes = _gathered(paths, left), dr.gather(mi.UInt32, lanes, left)
            num_traced += num_segments
            num_segments = max(1, num_traced // 2)
        return direct, indirect

    def forget_recordings(self) -> None:
        """Drop the recorded kernel; the next launch records it again."""
        self._recorded.clear()

    # ---- inside kernels --------------------------------------------------------------------------------

    @dr.syntax
    def _trace(
        self, scene: Any, state: PathState, max_segments: Array, with_visible_emission: bool
    ) -> PathState:
        """Continue paths by at most ``max_segments``.

        Since this is recorded and replayed, everything that differs between launches is an argument.
        """
        from mitsuba_plugins.surface_material import SurfaceLobes  # needs a selected variant

        emitters, materials = self.emitters, self.materials
        cache: Any = self.irradiance
        walk, sampler, throughput = state.walk, state.sampler, state.throughput
        direct, indirect, spread_m, active = state.direct, state.indirect, state.spread_m, state.active
        record = mi.UInt32(0)  # irradiance cache record of this vertex
        segment = mi.UInt32(0)
        while active & (segment < max_segments):
            segment += 1
            si = walk.intersect(scene, active)

            # ---- emission at the end of the segment ----------------------------------------------------
            is_seen = active & ~emitters.is_hidden(si, walk.depth)
            shown = is_seen
            if dr.hint(not with_visible_emission, mode="scalar"):
                shown = is_seen & (walk.depth > 0)  # a new array, since &= would also change is_seen
            emission, weight = emitters.emission(si, walk, is_seen, shown)
            met = throughput * emission * weight

            active_next = active & si.is_valid() & ((walk.depth + 1 < self.max_depth) | ~is_seen)

            # ---- diffuse reflection of cached irradiance -------------------------------------------------
            active_emitter = active_next & is_seen
            channels = materials.reflecting_channels_at(si, active_next)
            is_followed = mi.Bool(True)  # whether the remaining lobes are traced further
            roulette = mi.Float(1.0)  # inverse probability of is_followed
            if dr.hint(cache is not None, mode="scalar"):
                returns = active_next & is_seen & (walk.depth > 0)
                spread = spread_of(walk.previous, walk.previous_pdf, si, walk.ray.d)
                spread_m += dr.select(returns, spread, 0.0)
                record = cache.record(si.p, facing_normal(si, walk.ray.d), active_next & is_seen)
                is_last = walk.depth + 2 >= self.max_depth  # here the cache replaces light of longer paths
                cached, is_cached = cache.mean_radiance(
                    si, walk.ray.d, record, spread_m, is_last, sampler.next_2d(), returns
                )
                reflected = channels.opacity * channels.diffuse_reflectance() * cached
                indirect += dr.select(is_cached, throughput * reflected, 0.0)
                left = dr.select(is_cached, 0.0, channels.diffuse_albedo)
                channels = replace(channels, diffuse_albedo=left)
                # The light of the specular lobe varies with direction; Russian roulette limits its paths.
                probability = dr.clip(dr.max(channels.fresnel(si.wi)), MIN_SPECULAR_SURVIVAL, 1.0)
                is_followed = ~is_cached | (~is_last & (sampler.next_1d() < probability))
                roulette = dr.select(is_cached, 1.0 / probability, 1.0)
                active_emitter &= is_followed

            # ---- emitter sampling ------------------------------------------------------------------------
            ds, radiance = emitters.sample(si, sampler, record, active_emitter)
            active_emitter &= ds.pdf != 0.0
            wo = si.to_local(ds.d)

            # ---- BSDF: value towards the emitter, and sample of the next direction ------------------------
            lobes = SurfaceLobes(channels, si, active_next, materials.has_mapped_normals)
            value, pdf = lobes.eval_pdf(wo)
            choice: Any = sampler.next_1d()
            passes = mi.Bool(False)
            if dr.hint(emitters.has_transparency, mode="scalar"):
                passes = active_next & (choice >= channels.opacity)
                choice = choice / dr.maximum(channels.opacity, TINY)
                value, pdf = value * channels.opacity, pdf * channels.opacity
            if dr.hint(emitters.has_hidden, mode="scalar"):
                passes |= active_next & ~is_seen
            direction, bsdf_pdf, bsdf_weight = lobes.sample(choice, sampler.next_2d())
            radiance = emitters.visible(si, ds, radiance, active_emitter)
            weight = dr.select(ds.delta, 1.0, power_heuristic(ds.pdf, pdf))
            sampled = dr.select(active_emitter, throughput * value * radiance * (weight * roulette), 0.0)
            direct += dr.select(walk.depth <= 1, met, 0.0) + dr.select(walk.depth == 0, sampled, 0.0)
            indirect += dr.select(walk.depth <= 1, 0.0, met) + dr.select(walk.depth == 0, 0.0, sampled)
            ends = ~is_followed & ~passes
            if dr.hint(cache is not None, mode="scalar"):
                indirect += dr.select(is_last & ends, throughput * bsdf_weight * cached, 0.0)

            # ---- next segment ------------------------------------------------------------------------------
            throughput = dr.select(passes, throughput, throughput * bsdf_weight * roulette)
            bounces = active_next & ~passes
            if dr.hint(emitters.has_transparency, mode="scalar"):
                bsdf_pdf = bsdf_pdf * channels.opacity
            walk.advance(si, bounces, passes, si.to_world(direction), bsdf_pdf, record=record)

            # ---- Russian roulette --------------------------------------------------------------------------
            largest = dr.max(throughput)
            survival = dr.minimum(largest, 0.95)
            plays = bounces & (walk.depth >= self.russian_roulette_depth)
            survives = sampler.next_1d() < survival
            throughput = dr.select(plays, throughput / dr.maximum(survival, 1e-30), throughput)
            continues = active_next & ~ends & (~plays | survives)
            active = continues & (largest > 0.0) & (walk.num_crossed < MAX_CROSSINGS)
        result = PathState()
        result.walk, result.sampler, result.throughput = walk, sampler, throughput
        result.direct, result.indirect, result.spread_m, result.active = direct, indirect, spread_m, active
        return result

# SPDX-License-Identifier: MIT
"""Light transport: unidirectional path tracing with emitter sampling and multiple importance sampling.

The estimator is that of Mitsuba's ``path`` (tests compare the two), extended by

* lights hidden from the camera, and opacity in shadow rays (:mod:`.emitters`);
* low-discrepancy samples in every pair of dimensions of a pixel (:mod:`.sobol`);
* learned light sampling (:mod:`.light_sampler`) and a guide through openings (:mod:`.sky_guide`);
* optionally, termination of paths in an irradiance cache after the first bounce (:mod:`.irradiance_cache`).

There is no film; the samples of a pixel are adjacent in one array and are summed in order, so results have
the same bytes for any number of threads. Camera, size, seed, sample count and clamp are arguments of the
kernel, which is recorded once per scene and replayed.
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
from datagen.rendering.transport.emitters import SceneEmitters
from datagen.rendering.transport.irradiance_cache import NARROW_PDF, IrradianceCache, spread_of
from datagen.rendering.transport.irradiance_gathering import gather_irradiance
from datagen.rendering.transport.light_sampler import LightSampler, uniform_sampler
from datagen.rendering.transport.recording import undisturbed
from datagen.rendering.transport.sky_guide import SkyGuide, fit_sky_guide
from datagen.rendering.transport.sky_observation import observe_sky
from datagen.rendering.transport.sobol import OwenSobol
from datagen.rendering.transport.vertex import MAX_CROSSINGS, Walk, facing_normal, power_heuristic

if TYPE_CHECKING:
    from datagen.rendering.scene_builder import BuiltScene
    from mitsuba_plugins.surface_material import SceneMaterials

Array = Any

MAX_LANES = 1 << 24
"""Maximum number of light paths per launch, at 36 bytes each; larger views need several launches."""
TINY = 1e-30
"""Prevents division by 0 in the clamp for paths without light."""

_LIVE: weakref.WeakSet[PathTracer] = weakref.WeakSet()


def forget_recordings() -> None:
    """Drop the recorded kernels of all tracers; must precede any emptying of Dr.Jit's kernel cache."""
    for tracer in list(_LIVE):
        tracer.forget_recordings()


class PathTracer:
    """Traces the light paths of one scene.

    ``max_depth`` is the maximum number of segments from the camera to the light (1: emitters only, 2: direct
    light). Russian roulette is applied from ``russian_roulette_depth`` segments on.
    """

    def __init__(self, built: BuiltScene, max_depth: int, russian_roulette_depth: int):
        self.scene = built.scene
        self.max_depth, self.russian_roulette_depth = max_depth, russian_roulette_depth
        self.emitters = SceneEmitters(built)
        self.sky_guide: SkyGuide | None = None
        self.irradiance: IrradianceCache | None = None
        # Recorded once, since the Python code of hundreds of materials runs longer than a small pass.
        self._recorded: Any = dr.freeze(self._trace, state_fn=lambda *_: self._tables())
        _LIVE.add(self)

    def _tables(self) -> list[Any]:
        """Arrays that the kernel reads in addition to its arguments."""
        cache = [] if self.irradiance is None else self.irradiance.arrays()
        return [*self.emitters.tables(), *cache]

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

    def gather_irradiance(self, materials: SceneMaterials, sensors: Iterable[Any], seed: int) -> None:
        """Estimate the irradiance cache, in which later paths may end, and light sampler from ``sensors``."""
        self.use_sky_guide(self.sky_guide)
        if self.scene.emitters():
            with dr.suspend_grad():
                self.irradiance = gather_irradiance(self.emitters, materials, sensors, seed)
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

        ``with_visible_emission`` False excludes :mod:`.visible_emission`. ``seed`` is taken modulo 2^32.
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
        """Return sums over ``num_samples`` paths per pixel, one number or an array (H, W).

        If a path's light after two or more bounces exceeds ``limit`` in its largest channel, it is scaled
        down to the limit, and the removed luminance is summed too. Direct light, such as patches of sun, is
        never clamped. ``grid`` (columns, rows) replaces the pixels by another division of the image.
        ``before`` is the number of samples that each cell already has with this seed, whose sequence the new
        ones continue.
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

        ``entries`` are the index (N,), row by row, of a cell of an image of ``size`` (columns, rows), and the
        first position (N,) in the cell's sequence of samples.
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
                    self.scene, sampler, sensor.view, corner, cell_px, limit_of_paths, with_visible_emission
                )
            sums = [dr.block_sum(channel, count) for channel in channels]
            dr.eval(sums)
        return [np.array(s).astype(np.float64) for s in sums]

    def forget_recordings(self) -> None:
        """Drop the recorded kernel; the next launch records it again."""
        self._recorded.clear()

    # ---- inside kernels --------------------------------------------------------------------------------

    def _trace(
        self,
        scene: Any,
        sampler: Any,
        view: tuple[Any, ...],
        corner: Array,
        cell_px: Array,
        limit: Array,
        with_visible_emission: bool,
    ) -> list[Array]:
        """Return red, green, blue and removed luminance of one path per lane of ``sampler``.

        Since this is recorded and replayed, everything that differs between launches is an argument.
        """
        from datagen.rendering.plugins import rays_through  # needs a selected variant

        ray = rays_through(view, (corner + sampler.next_2d()) * cell_px)
        direct, indirect = self.sample(sampler, ray, with_visible_emission)
        kept = dr.minimum(limit / dr.maximum(dr.max(indirect), TINY), 1.0)
        return [*(direct + indirect * kept), mi.luminance(indirect) * (1.0 - kept)]

    @dr.syntax
    def sample(self, sampler: Any, ray: Array, with_visible_emission: bool = True) -> tuple[Array, Array]:
        """Trace one path per camera ray; return radiance after at most one bounce, and after more."""
        scene, emitters, ctx = self.scene, self.emitters, mi.BSDFContext()
        cache: Any = self.irradiance
        walk = Walk(ray)  # current segment and previous vertex
        direct = mi.Color3f(0.0)  # radiance after at most one bounce
        indirect = mi.Color3f(0.0)  # radiance after two or more bounces
        throughput = mi.Color3f(1.0)  # product of the BSDF weights and roulette factors of the path
        record = mi.UInt32(0)  # irradiance cache record of this vertex
        spread_m = mi.Float(0.0)  # side in metres of the area over which the path has spread
        is_cached = mi.Bool(False)  # whether the path may end in the cache here
        cached = mi.Color3f(0.0)  # mean incident radiance from the cache
        narrow_pdf: Any = mi.Float(NARROW_PDF)  # density from which on paths do not end in the cache
        active = mi.Bool(True)  # lanes whose path continues
        while active:
            si = walk.intersect(scene, active)

            # ---- emission at the end of the segment ----------------------------------------------------
            is_seen = active & ~emitters.is_hidden(si, walk.depth)
            shown = is_seen
            if dr.hint(not with_visible_emission, mode="scalar"):
                shown = is_seen & (walk.depth > 0)  # a new array, since &= would also change is_seen
            emission, weight = emitters.emission(si, walk, is_seen, shown)
            met = throughput * emission * weight

            active_next = active & si.is_valid() & ((walk.depth + 1 < self.max_depth) | ~is_seen)
            bsdf = si.bsdf()

            # ---- emitter sampling ------------------------------------------------------------------------
            is_smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            active_emitter = active_next & is_seen & is_smooth
            if dr.hint(cache is not None, mode="scalar"):
                returns = active_next & is_seen & (walk.depth > 0)
                spread = spread_of(walk.previous, walk.previous_pdf, si, walk.ray.d)
                spread_m += dr.select(returns, spread, 0.0)
                record = cache.record(si.p, facing_normal(si, walk.ray.d), active_next & is_seen)
                is_last = walk.depth + 2 >= self.max_depth  # the cache includes light of longer paths
                cached, is_cached = cache.mean_radiance(
                    si, walk.ray.d, record, dr.select(is_last, np.inf, spread_m), sampler.next_2d(), returns
                )
                narrow_pdf = dr.select(is_last, np.inf, NARROW_PDF)
            ds, radiance = emitters.sample(si, sampler, record, active_emitter)
            active_emitter &= ds.pdf != 0.0
            wo = si.to_local(ds.d)

            # ---- BSDF: value towards the emitter, and sample of the next direction ------------------------
            value, pdf, bs, bsdf_weight = bsdf.eval_pdf_sample(
                ctx, si, wo, sampler.next_1d(), sampler.next_2d(), active_next
            )
            active_emitter &= ~is_cached | (pdf >= narrow_pdf)  # cached irradiance includes direct light
            weight = dr.select(ds.delta, 1.0, power_heuristic(ds.pdf, pdf))
            sampled = dr.select(active_emitter, throughput * value * radiance * weight, 0.0)
            direct += dr.select(walk.depth <= 1, met, 0.0) + dr.select(walk.depth == 0, sampled, 0.0)
            indirect += dr.select(walk.depth <= 1, 0.0, met) + dr.select(walk.depth == 0, 0.0, sampled)

            passes = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            if dr.hint(emitters.has_hidden, mode="scalar"):
                passes |= ~is_seen
                bsdf_weight = dr.select(is_seen, bsdf_weight, 1.0)

            # ---- termination in the cache ------------------------------------------------------------------
            ends = is_cached & ~passes & (bs.pdf < narrow_pdf)
            indirect += dr.select(ends, throughput * bsdf_weight * cached, 0.0)

            # ---- next segment ------------------------------------------------------------------------------
            throughput *= bsdf_weight
            bounces = active_next & ~passes
            is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            walk.advance(si, bounces, passes, si.to_world(bs.wo), bs.pdf, is_delta, record)

            # ---- Russian roulette --------------------------------------------------------------------------
            largest = dr.max(throughput)
            survival = dr.minimum(largest, 0.95)
            plays = bounces & (walk.depth >= self.russian_roulette_depth)
            survives = sampler.next_1d() < survival
            throughput = dr.select(plays, throughput / dr.maximum(survival, 1e-30), throughput)
            continues = active_next & ~ends & (~plays | survives)
            active = continues & (largest > 0.0) & (walk.num_crossed < MAX_CROSSINGS)
        return direct, indirect

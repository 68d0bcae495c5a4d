# SPDX-License-Identifier: MIT
"""Views of a configuration: beauty and ground truth, each in a pass of its own, then the denoiser.

The denoiser sees reflected light only. What lights and background send straight to the camera has no noise
but at edges; it is traced as finely as the ground truth and added afterwards. A denoiser that is shown a lamp
changes its radiance by tens of percent and smears it over its dark surroundings.

The scene is built once; a view is another set of camera numbers for the same kernels. Both passes use a
box filter on the same pixels. Paths draw their samples from (configuration seed, view index, half) alone and
are added in a fixed order. Where the sky shines in and how bright surfaces are is found out beforehand from
fixed views, so that a view's bytes do not depend on what was rendered before it or where.

A recipe gives the number of paths, or an error: then passes are added to two independent halves of the image
until the error estimated from them (:mod:`datagen.rendering.sample_budget`) is small enough.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import hashlib
import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import quantized
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import DEFAULT_MAX_DEPTH, RenderRecipe
from datagen.formats.view import RenderRecord
from datagen.foundation.buffers import BUFFERS, GROUND_TRUTH_BUFFERS, RENDERED_BUFFERS
from datagen.foundation.cameras import Camera
from datagen.foundation.color import exposure_for
from datagen.foundation.errors import input_error
from datagen.rendering.denoiser import Denoiser, OidnDenoiser, auxiliary_albedo, make_denoiser
from datagen.rendering.noisy_share import blended, noisy_share
from datagen.rendering.path_depth import depth_for, energy_left, reflectance_met
from datagen.rendering.sample_budget import (
    ErrorEstimate,
    PathSums,
    SampleBudget,
    estimate_error,
)
from datagen.rendering.scene_builder import AssetCaches, BuiltScene, build_scene, sensor_for

if TYPE_CHECKING:
    from datagen.library import Library

HALF_MAX = 65504.0
VIEWS_IN_FLIGHT = 2  # one is traced while another is denoised
COARSE_CELLS = 1024  # of the image whose brightness sets the firefly clamp
COARSE_SAMPLES = 16  # a cell
COARSE_VIEWS = 8  # at most, whose surfaces decide how long paths are, and that look for windows
SKY_SAMPLES = 48  # a pixel of those, of paths that look for windows
IRRADIANCE_VIEWS = 64  # at most, from which paths look for the irradiance of surfaces
_FULL_COVERAGE_SLACK = 1e-5  # a sum of float32 shares that should be 1


class RenderError(RuntimeError):
    """A view came out with NaN or Inf; nothing of it is kept."""


@dataclass
class RenderedView:
    """A finished view: ``buffers`` by registered name (H, W, C), the rest for its JSON and the timing log."""

    index: int
    buffers: dict[str, NDArray]
    instances: dict[str, str]
    materials: dict[str, str]
    render: RenderRecord
    seconds: dict[str, float] = field(default_factory=dict)


IsEnough = Callable[[int, NDArray[np.floating], ErrorEstimate], bool]
"""Whether a view may stop above its recipe's error: its index, the image as it is (H, W, 3), its error."""


@dataclass
class _ViewInProgress:
    """A view whose samples are being gathered. Arrays are (H, W, C); ``guides`` are the denoiser's."""

    index: int
    buffers: dict[str, NDArray]
    seen_lights: NDArray[np.float32]
    clamp_limit: float
    seconds: dict[str, float]
    halves: list[PathSums] = field(default_factory=lambda: [PathSums(), PathSums()])
    estimate: ErrorEstimate | None = None
    is_enough: bool = False
    guides: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None


@dataclass
class _InFlight:
    """A view on its way and what it waits for."""

    steps: Generator[Future, None, RenderedView]
    future: Future
    result: RenderedView | None = None

    def advance(self) -> None:
        """Take the next step; what it waited for is done."""
        try:
            self.future = next(self.steps)
        except StopIteration as stop:
            self.result = stop.value


def view_seed(configuration_seed: int, view_index: int, purpose: str) -> int:
    """Seed in [0, 2^31) that depends on nothing else than its arguments."""
    text = f"{configuration_seed}:{view_index}:{purpose}".encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:4], "little") >> 1


def release_memory() -> None:
    """Give back what earlier scenes left: Dr.Jit keeps freed arrays and kernels, and glibc keeps freed pages.

    Without it a worker grows by some 15 MB a configuration although nothing is leaked. Kernels that are
    needed again come from Dr.Jit's cache on disk, in milliseconds.
    """
    import drjit as dr

    from datagen.rendering.transport.integrator import forget_recordings

    forget_recordings()
    gc.collect()  # scenes and their materials refer to each other
    dr.flush_malloc_cache()
    dr.flush_kernel_cache()
    with contextlib.suppress(OSError, AttributeError):  # another C library than glibc
        ctypes.CDLL("libc.so.6").malloc_trim(0)


class SceneRenderer:
    """Renders the views of one configuration.

    Selects the recipe's Mitsuba variant. ``caches`` None shares the process's. ``estimator`` denoises the
    halves that the error is estimated from, None: as the view is; ``is_enough`` lets views stop early. Raises
    what :func:`build_scene` raises.
    """

    def __init__(
        self,
        configuration: Configuration,
        library: Library,
        recipe: RenderRecipe,
        caches: AssetCaches | None = None,
        denoiser: Denoiser | None = None,
        estimator: Denoiser | None = None,
        is_enough: IsEnough | None = None,
    ):
        from mitsuba_plugins.variant import select_variant

        start = time.perf_counter()
        self.variant = select_variant(recipe.variant)
        release_memory()
        self.configuration, self.recipe = configuration, recipe
        self.built: BuiltScene = build_scene(configuration, library, caches)
        from datagen.rendering.transport.integrator import PathTracer

        self._budget = (
            SampleBudget(recipe.max_rel_mse, recipe.max_path_samples)
            if recipe.max_rel_mse is not None and recipe.max_path_samples is not None
            else None
        )
        self._denoiser = denoiser or (make_denoiser(self.variant) if recipe.denoise else None)
        self._estimator, self._is_enough = estimator or self._denoiser, is_enough
        self._sensors: dict[tuple[int, int], Any] = {}
        self._materials = self._make_materials()
        self._max_depth, self._energy_left = self._path_depth()
        self._tracer = PathTracer(self.built, self._max_depth, recipe.russian_roulette_depth)
        self.learn()
        self._instances = {str(k): v for k, v in self.built.instance_names.items()}
        self._material_names = {str(k): v for k, v in self.built.material_names.items()}
        self.seconds_to_build = time.perf_counter() - start

    def reseed(self, seed: int) -> None:
        """Render with the samples of another configuration seed from here on, as a renderer of its own would;
        the scene stays built."""
        self.configuration = self.configuration.model_copy(update={"seed": seed})
        self.learn()

    def learn(self) -> None:
        """Find out beforehand what the recipe's paths need to know of the whole scene."""
        self.learn_sky()
        if self.recipe.irradiance_cache:
            self.learn_irradiance()

    def learn_sky(self) -> None:
        """Let some of the views find out where the environment shines in, for all paths from here on."""
        coarse = (self._sensor(camera) for _, camera in self._coarse_cameras())
        self._tracer.learn_sky(coarse, SKY_SAMPLES, self._seed(0, "sky"))

    def learn_irradiance(self) -> None:
        """Let all views together find out how bright surfaces are; paths may end there from here on."""
        cameras = [view.camera() for view in self.configuration.cameras]
        num_pixels = sum(camera.width_px * camera.height_px for camera in cameras)
        chosen = cameras[:: math.ceil(len(cameras) / IRRADIANCE_VIEWS)]
        sensors = (self._sensor(camera) for camera in chosen)
        self._tracer.learn_irradiance(self._materials, sensors, num_pixels, self._seed(0, "irradiance"))

    def _path_depth(self) -> tuple[int, float | None]:
        """Segments of the longest path; with them, where the recipe asks for it, what is left behind."""
        if self.recipe.max_energy_left is None:
            return self.recipe.max_depth or DEFAULT_MAX_DEPTH, None
        reflectance = reflectance_met(list(self._coarse_buffers()))
        depth = depth_for(reflectance, self.recipe.max_energy_left)
        return depth, energy_left(reflectance, depth)

    def _coarse_cameras(self) -> Iterator[tuple[int, Camera]]:
        """Some of the views, by index, as small images."""
        cameras = self.configuration.cameras
        for index in range(0, len(cameras), math.ceil(len(cameras) / COARSE_VIEWS)):
            camera = cameras[index].camera()
            side_px = math.isqrt(camera.width_px * camera.height_px // COARSE_CELLS)
            yield (
                index,
                camera.scaled(*(max(1, px // max(1, side_px)) for px in (camera.width_px, camera.height_px))),
            )

    def _coarse_buffers(self) -> Iterator[dict[str, NDArray]]:
        """Ground truth of some of the views, as small images."""
        from mitsuba_plugins.material_buffers import render_material_buffers

        for index, small in self._coarse_cameras():
            seed = self._seed(index, "depth")
            yield render_material_buffers(self.built.scene, self._sensor(small), 4, seed, self._materials)

    def _make_materials(self) -> Any:
        from datagen.rendering.shape_ids import MergedShapeMaterials

        return MergedShapeMaterials(self.built)

    def render_view(self, index: int) -> RenderedView:
        """Render view ``index``: all of ``RENDERED_BUFFERS``, and ``beauty_noisy`` if the recipe keeps it.

        Raises :class:`RenderError` where a pixel is NaN or Inf.
        """
        (view,) = self.render_views([index])
        return view

    def render_views(self, indices: Iterable[int]) -> Iterator[RenderedView]:
        """Views in the order of ``indices``.

        What follows tracing (estimates of the error, the denoiser) runs in a thread of its own while another
        view is traced, and while the caller does what it does with the one before.
        """
        waiting = iter(indices)
        in_flight: list[_InFlight] = []
        with ThreadPoolExecutor(1, thread_name_prefix="denoise") as pool:
            while True:
                index = next(waiting, None) if len(in_flight) < VIEWS_IN_FLIGHT else None
                if index is not None:
                    steps = self._steps(index, pool)
                    in_flight.append(_InFlight(steps, next(steps)))
                    continue
                if not in_flight:
                    return
                running = [view for view in in_flight if view.result is None]
                wait([view.future for view in running], return_when=FIRST_COMPLETED)
                next(view for view in running if view.future.done()).advance()
                while in_flight and (result := in_flight[0].result) is not None:
                    in_flight.pop(0)
                    yield result

    def _steps(self, index: int, pool: ThreadPoolExecutor) -> Generator[Future, None, RenderedView]:
        """The way of a view: traces, and yields whenever what it needs next is being made by ``pool``."""
        view = self._begin(index)
        if self._budget is None:
            self._add_pass(view, self.recipe.path_samples or 0)
        else:
            camera = self.configuration.cameras[index].camera()
            counts = self._budget.first_counts((camera.height_px, camera.width_px))
            while counts.any():
                self._add_pass(view, counts)
                future = pool.submit(self._estimate, view)
                yield future
                view.estimate = future.result()
                if view.is_enough:
                    break
                counts = self._budget.next_counts(view.halves[0].counts, view.estimate)
        finishing = pool.submit(self._finish, view)
        yield finishing
        return finishing.result()

    def close(self) -> None:
        """Release the scene and the denoiser; shared caches keep their meshes and textures."""
        denoisers = [self._denoiser] + [self._estimator] * (self._estimator is not self._denoiser)
        self._denoiser = self._estimator = None
        for denoiser in denoisers:
            if isinstance(denoiser, OidnDenoiser):
                denoiser.close()
        self._sensors.clear()
        release_memory()

    def _sensor(self, camera: Camera) -> Any:
        size = (camera.width_px, camera.height_px)
        if size not in self._sensors:
            self._sensors[size] = sensor_for(camera)
        self._sensors[size].set_camera(camera)
        return self._sensors[size]

    def _begin(self, index: int) -> _ViewInProgress:
        """Ground truth of a view, and what its paths may bring at most."""
        from mitsuba_plugins.material_buffers import render_material_buffers

        if not 0 <= index < len(self.configuration.cameras):
            raise input_error(
                f"configuration {self.configuration.id}",
                "view",
                index,
                f"0 ... {len(self.configuration.cameras) - 1}",
            )
        sensor = self._sensor(self.configuration.cameras[index].camera())
        start = time.perf_counter()
        traced = render_material_buffers(
            self.built.scene,
            sensor,
            self.recipe.auxiliary_samples,
            self._seed(index, "buffers"),
            self._materials,
        )
        buffers = {name: traced[name] for name in GROUND_TRUTH_BUFFERS}
        seen_lights = self._seen_lights(sensor, buffers["surface_mask"], index)
        seconds = {"buffers": time.perf_counter() - start}
        return _ViewInProgress(index, buffers, seen_lights, self._clamp_limit(sensor, index), seconds)

    def _seed(self, index: int, purpose: str) -> int:
        return view_seed(self.configuration.seed, index, purpose)

    def _clamp_limit(self, sensor: Any, index: int) -> float:
        """Radiance that a path may bring by two or more reflections: so many times the exposed white.

        The exposure is that of a coarse image of reflected light, traced without a clamp beforehand. Infinite
        where the recipe clamps nothing, or where less than a twentieth of the image is lit.
        """
        if self.recipe.firefly_clamp is None:
            return math.inf
        width, height = (int(v) for v in sensor.film().crop_size())
        cell_px = max(1, math.isqrt(width * height // COARSE_CELLS))
        grid = (math.ceil(width / cell_px), math.ceil(height / cell_px))
        coarse = self._tracer.add_up(sensor, COARSE_SAMPLES, self._seed(index, "exposure"), grid=grid)
        image = coarse.radiance / COARSE_SAMPLES
        if np.count_nonzero(image.any(axis=-1)) < 0.05 * image[..., 0].size:
            return math.inf
        return self.recipe.firefly_clamp / exposure_for(image)

    def _add_pass(self, view: _ViewInProgress, counts: int | NDArray[np.int64]) -> None:
        """Trace ``counts`` more samples a pixel, (H, W) or one number; with a budget, for each half."""
        start = time.perf_counter()
        sensor = self._sensor(self.configuration.cameras[view.index].camera())
        purposes = ["path"] if self._budget is None else ["path/a", "path/b"]
        for half, purpose in enumerate(purposes):
            seed, before = self._seed(view.index, purpose), view.halves[half].counts
            sums = self._tracer.add_up(sensor, counts, seed, limit=view.clamp_limit, before=before)
            view.halves[half] = view.halves[half] + sums
        view.seconds["path"] = view.seconds.get("path", 0.0) + time.perf_counter() - start

    def _seen_lights(self, sensor: Any, mask: NDArray[np.float32], index: int) -> NDArray[np.float32]:
        """Light that reaches the camera straight from lights and background, (H, W, 3).

        It is traced only where something other than surface shows, and as finely as the other buffers.
        """
        image = np.zeros((mask.size, 3), np.float32)
        pixels = np.flatnonzero(mask.ravel() < 1.0 - _FULL_COVERAGE_SLACK).astype(np.uint32)
        if pixels.size:
            image[pixels] = self._tracer.render_seen_lights(
                sensor, pixels, self.recipe.auxiliary_samples, self._seed(index, "lights")
            )
        return image.reshape(*mask.shape[:2], 3)

    def _denoise(
        self, view: _ViewInProgress, noisy: NDArray[np.float32], denoiser: Denoiser | None
    ) -> NDArray[np.float32]:
        """Reflected light without its noise; ``noisy`` itself without a denoiser."""
        if denoiser is None:
            return noisy
        if view.guides is None:
            buffers = view.buffers
            albedo = auxiliary_albedo(
                buffers["diffuse_albedo"], buffers["specular_albedo"], buffers["surface_mask"]
            )
            normal = buffers["normal_world"]
            if denoiser.wants_camera_normals:
                camera = self.configuration.cameras[view.index].camera()
                normal = normal @ camera.world_from_camera[:3, :3].astype(np.float32)
            view.guides = (albedo, normal)
        return denoiser.denoise(noisy, *view.guides)

    def _estimate(self, view: _ViewInProgress) -> ErrorEstimate:
        """Error of the view as it would be finished now."""
        start = time.perf_counter()
        a, b = (half.mean() for half in view.halves)
        self._check_finite(view.index, {"beauty_noisy": a + b, **view.buffers})
        clean_a, clean_b = (self._denoise(view, half, self._estimator) for half in (a, b))
        if self._estimator is not None:
            share = noisy_share((a, b), 0.5 * (clean_a + clean_b), view.seen_lights)
            clean_a, clean_b = blended(clean_a, a, share), blended(clean_b, b, share)
        removed = (view.halves[0].removed_mean(), view.halves[1].removed_mean())
        estimate = estimate_error((a, b), (clean_a, clean_b), view.seen_lights, removed)
        if self._is_enough is not None:
            image = 0.5 * (clean_a + clean_b) + view.seen_lights
            view.is_enough = self._is_enough(view.index, image, estimate)
        view.seconds["estimate"] = view.seconds.get("estimate", 0.0) + time.perf_counter() - start
        return estimate

    def _finish(self, view: _ViewInProgress) -> RenderedView:
        start = time.perf_counter()
        sums = view.halves[0] + view.halves[1]
        noisy = sums.mean()
        self._check_finite(view.index, {"beauty_noisy": noisy, "lights": view.seen_lights, **view.buffers})
        reflected = self._denoise(view, noisy, self._denoiser)
        if self._budget is not None and self._denoiser is not None:
            halves = (view.halves[0].mean(), view.halves[1].mean())
            reflected = blended(reflected, noisy, noisy_share(halves, reflected, view.seen_lights))
        beauty = reflected + view.seen_lights
        self._check_finite(view.index, {"beauty": beauty})
        buffers = dict(view.buffers)
        buffers["beauty"] = np.minimum(beauty, HALF_MAX)
        names = list(RENDERED_BUFFERS)
        if self.recipe.keep_noisy:
            buffers["beauty_noisy"] = np.minimum(noisy + view.seen_lights, HALF_MAX)
            names.append("beauty_noisy")
        record = RenderRecord(
            variant=self.variant,
            seed=self._seed(view.index, "path"),
            path_samples=quantized(sums.mean_samples, 4),
            auxiliary_samples=self.recipe.auxiliary_samples,
            max_depth=self._max_depth,
            russian_roulette_depth=self.recipe.russian_roulette_depth,
            denoiser=self._denoiser.name if self._denoiser is not None else "none",
            clipped_pixels=int(np.count_nonzero((beauty > HALF_MAX).any(axis=-1))),
            **self._budget_record(view, sums),
        )
        view.seconds["denoise"] = time.perf_counter() - start
        ordered = {
            name: buffers[name].reshape(*noisy.shape[:2], BUFFERS[name].num_channels) for name in names
        }
        return RenderedView(view.index, ordered, self._instances, self._material_names, record, view.seconds)

    def _budget_record(self, view: _ViewInProgress, sums: PathSums) -> dict[str, Any]:
        """What the record says about error, clamp and depth."""
        fields: dict[str, Any] = {}
        if self._energy_left is not None:
            fields["max_energy_left"] = quantized(self._energy_left, 4)
        if self._tracer.irradiance is not None:
            fields["irradiance_cell_m"] = quantized(self._tracer.irradiance.cells.side_m, 4)
        if self._budget is not None and view.estimate is not None:
            fields["estimated_rel_mse"] = quantized(view.estimate.rel_mse, 4)
            fields["at_ceiling"] = not self._budget.is_met(view.estimate)
            fields["most_path_samples"] = int(sums.counts.max())
        if math.isfinite(view.clamp_limit):
            fields["firefly_clamp_radiance"] = quantized(view.clamp_limit, 6)
            fields["clamped_energy"] = quantized(sums.removed_share(), 4)
        return fields

    def _check_finite(self, index: int, buffers: dict[str, NDArray]) -> None:
        for name, array in buffers.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                bad = ~np.isfinite(array).all(axis=-1)
                row, column = (int(v) for v in np.argwhere(bad)[0])
                raise RenderError(
                    f"configuration {self.configuration.id}, "
                    f"view {self.configuration.cameras[index].name}: {int(bad.sum())} pixels of {name} are "
                    f"NaN or Inf, the first at row {row}, column {column}"
                )

# SPDX-License-Identifier: MIT
"""Renders one view: ground truth, passes of light paths, error estimate, denoising and record.

Only reflected light is denoised, since the denoiser would change the radiance of a visible lamp by tens of
per cent and spread it over its dark surroundings. Visible emission has no noise except at edges; it is traced
with as many samples as the ground truth, more at edges, and added after denoising.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import quantized
from datagen.formats.view import RenderRecord
from datagen.foundation.buffers import BUFFERS, GROUND_TRUTH_BUFFERS, RENDERED_BUFFERS
from datagen.foundation.color import exposure_for, luminance
from datagen.foundation.errors import input_error
from datagen.rendering.clamped_light import restored_share
from datagen.rendering.denoiser import Denoiser, auxiliary_albedo
from datagen.rendering.noisy_share import blended, noisy_share
from datagen.rendering.prepared_scene import COARSE_CELLS, PreparedScene
from datagen.rendering.sample_budget import (
    BIAS_PER_SPREAD,
    QUICK_BIAS_PER_SPREAD,
    ErrorEstimate,
    PathSums,
    SampleBudget,
    estimate_error,
)
from datagen.rendering.schedule import Steps

HALF_MAX = 65504.0
COARSE_SAMPLES = 16
"""Paths per pixel of the coarse image whose exposure sets the firefly clamp."""
MIN_LIT = 0.05
"""Minimum share of lit pixels in the coarse image for fireflies to be clamped."""
EDGE_PX, EDGE_SAMPLES = 2, 8
"""Distance from partly uncovered pixels within which emission is traced, since ground-truth samples miss thin
gaps; and factor on the number of samples there, since a single sample that hits the sky may be a hundred
times as bright as the pixel."""
QUICK_SAMPLES = 16
"""Maximum mean samples per pixel for ``quick_denoiser``. For the same error, it requires a quarter more
samples; up to this maximum, tracing them takes less time than the better denoiser."""
_FULL_COVERAGE_SLACK = 1e-5  # rounding error of a sum of float32 shares


class RenderError(RuntimeError):
    """Raised for a view with NaN or Inf, which is discarded."""


@dataclass
class RenderedView:
    """A finished view with ``buffers`` (H, W, C) by name, names of instances and materials by id, its record,
    and ``seconds`` by stage.
    """

    index: int
    buffers: dict[str, NDArray]
    instances: dict[str, str]
    materials: dict[str, str]
    render: RenderRecord
    seconds: dict[str, float] = field(default_factory=dict)


IsEnough = Callable[[int, NDArray[np.floating], ErrorEstimate], bool]
"""Function that returns whether a view may stop above its target error; its arguments are the view's index,
image (H, W, 3) and error."""


@dataclass(frozen=True)
class Finishing:
    """Denoisers and stopping criteria of views.

    If ``budget`` is None, the recipe's number of samples is used. ``is_enough`` may stop a view above its
    target error. Up to ``QUICK_SAMPLES`` samples, halves are denoised by ``quick_denoiser`` to estimate the
    error; a view that stops there is the mean of these halves. All others are denoised by ``denoiser``.
    """

    denoiser: Denoiser | None
    quick_denoiser: Denoiser | None
    budget: SampleBudget | None
    is_enough: IsEnough | None


class ViewJob:
    """Renders a view by accumulating samples, in two independent ``halves`` if there is a budget.

    Raises :class:`InputError` if the configuration has no view ``index``.
    """

    def __init__(self, scene: PreparedScene, finishing: Finishing, index: int):
        configuration = scene.configuration
        if not 0 <= index < len(configuration.cameras):
            expected = f"0 ... {len(configuration.cameras) - 1}"
            raise input_error(f"configuration {configuration.id}", "view", index, expected)
        self.scene, self.index = scene, index
        self.denoiser, self.quick_denoiser = finishing.denoiser, finishing.quick_denoiser
        self.budget, self._stop_criterion = finishing.budget, finishing.is_enough
        self.seconds: dict[str, float] = {}
        self.halves = [PathSums(), PathSums()]
        self.estimate: ErrorEstimate | None = None
        self._reflected: NDArray[np.float32] | None = None  # mean of quickly denoised halves, if final
        self.is_enough = False
        self._guides: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        with self._timed("buffers"):
            self.buffers = self._ground_truth()
            self.visible_emission = self._trace_visible_emission()
        self.clamp_limit = self._clamp_limit()

    def steps(self, pool: ThreadPoolExecutor) -> Steps[RenderedView]:
        """Run the job in steps, denoising in ``pool``; yield the futures to await, and return the view."""
        if self.budget is None:
            self.add_pass(self.scene.recipe.path_samples or 0)
        else:
            camera = self.scene.camera(self.index)
            counts = self.budget.first_counts((camera.height_px, camera.width_px))
            while counts.any():
                self.add_pass(counts)
                future = pool.submit(self.estimate_error)
                yield future
                estimate = future.result()
                if self.is_enough:
                    break
                counts = self.budget.next_counts(self.halves[0].counts, estimate)
        finishing = pool.submit(self.finish)
        yield finishing
        return finishing.result()

    def add_pass(self, counts: int | NDArray[np.int64]) -> None:
        """Trace ``counts`` more samples per pixel, (H, W) or one number; with a budget, for each half."""
        with self._timed("path"):
            sensor = self._sensor()
            for half, purpose in enumerate(["path"] if self.budget is None else ["path/a", "path/b"]):
                seed, before = self.scene.seed(self.index, purpose), self.halves[half].counts
                accumulate = self.scene.tracer.accumulate
                self.halves[half] += accumulate(sensor, counts, seed, limit=self.clamp_limit, before=before)

    def estimate_error(self) -> ErrorEstimate:
        """Estimate the view's error from its samples so far, and set ``is_enough``.

        Raises :class:`RenderError` if a pixel is NaN or Inf.
        """
        with self._timed("estimate"):
            a, b = (half.mean() for half in self.halves)
            self._check_finite({"beauty_noisy": a + b, **self.buffers})
            quick = self.quick_denoiser
            is_quick = quick is not None and self.halves[0].mean_samples <= QUICK_SAMPLES / 2
            denoiser = quick if is_quick else self.denoiser
            clean_a, clean_b = self._cleaned([a, b], denoiser)
            removed = (self.halves[0].removed_mean(), self.halves[1].removed_mean())
            prior = QUICK_BIAS_PER_SPREAD if is_quick else BIAS_PER_SPREAD
            self.estimate = estimate_error((a, b), (clean_a, clean_b), self.visible_emission, removed, prior)
            middle = 0.5 * (clean_a + clean_b)
            if self._stop_criterion is not None:
                image = middle + self.visible_emission
                self.is_enough = self._stop_criterion(self.index, image, self.estimate)
            is_met = self.budget is not None and self.budget.is_met(self.estimate)
            self._reflected = middle if is_quick and (is_met or self.is_enough) else None
            return self.estimate

    def finish(self) -> RenderedView:
        """Return the view of all samples so far, denoised, with its record.

        Raises :class:`RenderError` if a pixel is NaN or Inf.
        """
        start = time.perf_counter()
        recipe = self.scene.recipe
        sums = self.halves[0] + self.halves[1]
        noisy = sums.mean()
        self._check_finite({"beauty_noisy": noisy, "lights": self.visible_emission, **self.buffers})
        denoiser = self.denoiser
        if self._reflected is not None:
            denoiser, reflected = self.quick_denoiser, self._reflected
        else:
            (reflected,) = self._cleaned([noisy], denoiser)
        share = restored_share(luminance(reflected), np.broadcast_to(sums.removed_mean(), noisy.shape[:2]))
        reflected = (reflected * (1.0 + share[..., None])).astype(np.float32)
        beauty = reflected + self.visible_emission
        self._check_finite({"beauty": beauty})
        buffers = {**self.buffers, "beauty": np.minimum(beauty, HALF_MAX)}
        names = list(RENDERED_BUFFERS)
        if recipe.keep_noisy:
            buffers["beauty_noisy"] = np.minimum(noisy + self.visible_emission, HALF_MAX)
            names.append("beauty_noisy")
        record = RenderRecord(
            variant=self.scene.variant,
            seed=self.scene.seed(self.index, "path"),
            path_samples=quantized(sums.mean_samples, 4),
            auxiliary_samples=recipe.auxiliary_samples,
            max_depth=self.scene.max_depth,
            russian_roulette_depth=recipe.russian_roulette_depth,
            denoiser=denoiser.name if denoiser is not None else "none",
            clipped_pixels=int(np.count_nonzero((beauty > HALF_MAX).any(axis=-1))),
            **self._quality_record(sums),
        )
        shape = noisy.shape[:2]
        ordered = {name: buffers[name].reshape(*shape, BUFFERS[name].num_channels) for name in names}
        built = self.scene.built
        instances, materials = (
            {str(k): name for k, name in names_of.items()}
            for names_of in (built.instance_names, built.material_names)
        )
        self.seconds["denoise"] = time.perf_counter() - start
        return RenderedView(self.index, ordered, instances, materials, record, self.seconds)

    def _cleaned(
        self, images: list[NDArray[np.float32]], denoiser: Denoiser | None
    ) -> list[NDArray[np.float32]]:
        """Denoise ``images`` (H, W, 3); with a budget, keep noisy pixels where these are more accurate."""
        clean = [self.denoise(image, denoiser) for image in images]
        if self.budget is None or denoiser is None:
            return clean
        halves = (self.halves[0].mean(), self.halves[1].mean())
        share = noisy_share(halves, np.mean(clean, axis=0), self.visible_emission)
        return [blended(denoised, image, share) for denoised, image in zip(clean, images, strict=True)]

    def denoise(self, noisy: NDArray[np.float32], denoiser: Denoiser | None) -> NDArray[np.float32]:
        """Denoise reflected light ``noisy`` (H, W, 3); return it unchanged if ``denoiser`` is None."""
        if denoiser is None:
            return noisy
        if self._guides is None:
            names = ("diffuse_albedo", "specular_albedo", "surface_mask")
            albedo = auxiliary_albedo(*(self.buffers[name] for name in names))
            normal = self.buffers["normal_world"]
            if denoiser.wants_camera_normals:
                world_from_camera = self.scene.camera(self.index).world_from_camera
                normal = normal @ world_from_camera[:3, :3].astype(np.float32)
            self._guides = (albedo, normal)
        return denoiser.denoise(noisy, *self._guides)

    def _sensor(self) -> Any:
        return self.scene.sensor(self.scene.camera(self.index))

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    def _ground_truth(self) -> dict[str, NDArray]:
        from mitsuba_plugins.material_buffers import render_material_buffers

        scene = self.scene
        samples, seed = scene.recipe.auxiliary_samples, scene.seed(self.index, "buffers")
        traced = render_material_buffers(scene.built.scene, self._sensor(), samples, seed, scene.materials)
        return {name: traced[name] for name in GROUND_TRUTH_BUFFERS}

    def _trace_visible_emission(self) -> NDArray[np.float32]:
        """Trace visible emission (H, W, 3) in and near pixels not entirely covered by reflecting surface."""
        from scipy import ndimage

        from datagen.rendering.transport.visible_emission import render_visible_emission

        mask = self.buffers["surface_mask"][..., 0]
        around = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1))
        is_near = ndimage.binary_dilation(mask < 1.0 - _FULL_COVERAGE_SLACK, around)
        is_inside = ndimage.binary_erosion(mask == 0, around, border_value=1)
        image = np.zeros((*mask.shape, 3), np.float32)
        num_samples = self.scene.recipe.auxiliary_samples
        seed, emitters = self.scene.seed(self.index, "lights"), self.scene.tracer.emitters
        for chosen, num in ((is_inside, num_samples), (is_near & ~is_inside, EDGE_SAMPLES * num_samples)):
            pixels = np.flatnonzero(chosen).astype(np.uint32)
            if pixels.size:
                image[chosen] = render_visible_emission(emitters, self._sensor(), pixels, num, seed)
        return image

    def _clamp_limit(self) -> float:
        """Maximum radiance of paths of two or more bounces: ``firefly_clamp`` in units of the exposed white.

        The exposure is that of a coarse image of reflected light, traced beforehand without a clamp. The
        limit is infinite if the recipe has no clamp or less than ``MIN_LIT`` of the image is lit.
        """
        if self.scene.recipe.firefly_clamp is None:
            return math.inf
        sensor = self._sensor()
        width, height = (int(v) for v in sensor.film().crop_size())
        cell_px = max(1, math.isqrt(width * height // COARSE_CELLS))
        grid = (math.ceil(width / cell_px), math.ceil(height / cell_px))
        seed = self.scene.seed(self.index, "exposure")
        image = self.scene.tracer.accumulate(sensor, COARSE_SAMPLES, seed, grid=grid).radiance
        image = image / COARSE_SAMPLES
        if np.count_nonzero(image.any(axis=-1)) < MIN_LIT * image[..., 0].size:
            return math.inf
        return self.scene.recipe.firefly_clamp / exposure_for(image)

    def _quality_record(self, sums: PathSums) -> dict[str, Any]:
        """Fields of the record that describe error, clamp, irradiance cache and truncation."""
        fields: dict[str, Any] = {}
        if self.scene.truncation is not None:
            fields["max_energy_left"] = quantized(self.scene.truncation, 4)
        if self.scene.tracer.irradiance is not None:
            fields["irradiance_cell_m"] = quantized(self.scene.tracer.irradiance.cells.side_m, 4)
        if self.budget is not None and self.estimate is not None:
            fields["estimated_rel_mse"] = quantized(self.estimate.bound, 4)
            fields["at_ceiling"] = not self.budget.is_met(self.estimate)
            fields["most_path_samples"] = int(sums.counts.max())
        if math.isfinite(self.clamp_limit):
            fields["firefly_clamp_radiance"] = quantized(self.clamp_limit, 6)
            fields["clamped_energy"] = quantized(sums.removed_share(), 4)
        return fields

    def _check_finite(self, buffers: dict[str, NDArray]) -> None:
        configuration = self.scene.configuration
        for name, array in buffers.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                bad = ~np.isfinite(array).all(axis=-1)
                row, column = np.argwhere(bad)[0]
                raise RenderError(
                    f"configuration {configuration.id}, "
                    f"view {configuration.cameras[self.index].name}: {int(bad.sum())} pixels of {name} are "
                    f"NaN or Inf, the first at row {row}, column {column}"
                )

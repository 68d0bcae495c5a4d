# SPDX-License-Identifier: MIT
"""Views of a configuration: beauty and ground truth, each in a pass of its own, then the denoiser.

The denoiser sees reflected light only. What lights and background send straight to the camera has no noise
but at edges; it is traced as finely as the ground truth and added afterwards. A denoiser that is shown a lamp
changes its radiance by tens of percent and smears it over its dark surroundings.

The scene is built once; a view is another set of camera numbers for the same kernels. Both passes use a
box filter on the same pixels. The path pass draws its samples from (configuration seed, view index) alone
and adds them in a fixed order, so that a view's bytes do not depend on what was rendered before it or where.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import hashlib
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from datagen.buffers import BUFFERS, RENDERED_BUFFERS
from datagen.cameras import Camera
from datagen.errors import input_error
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import DEFAULT_MAX_DEPTH, DEFAULT_PATH_SAMPLES, RenderRecipe
from datagen.formats.view import RenderRecord
from datagen.rendering.denoiser import Denoiser, OidnDenoiser, auxiliary_albedo, make_denoiser
from datagen.rendering.scene_builder import AssetCaches, BuiltScene, build_scene, sensor_for

if TYPE_CHECKING:
    from datagen.library import Library

HALF_MAX = 65504.0
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

    gc.collect()  # scenes and their materials refer to each other
    dr.flush_malloc_cache()
    dr.flush_kernel_cache()
    with contextlib.suppress(OSError, AttributeError):  # another C library than glibc
        ctypes.CDLL("libc.so.6").malloc_trim(0)


class SceneRenderer:
    """Renders the views of one configuration.

    Selects the recipe's Mitsuba variant. ``caches`` None shares the process's. Raises what
    :func:`build_scene` raises.
    """

    def __init__(
        self,
        configuration: Configuration,
        library: Library,
        recipe: RenderRecipe,
        caches: AssetCaches | None = None,
        denoiser: Denoiser | None = None,
    ):
        from mitsuba_plugins.variant import select_variant

        start = time.perf_counter()
        self.variant = select_variant(None if recipe.variant == "auto" else recipe.variant)
        release_memory()
        self.configuration, self.recipe = configuration, recipe
        self.built: BuiltScene = build_scene(configuration, library, caches)
        from datagen.rendering.path_tracer import PathTracer

        self._max_depth = recipe.max_depth or DEFAULT_MAX_DEPTH
        self._num_samples = recipe.path_samples or recipe.max_path_samples or DEFAULT_PATH_SAMPLES
        self._tracer = PathTracer(self.built, self._max_depth, recipe.russian_roulette_depth)
        self._denoiser = denoiser or (make_denoiser(self.variant) if recipe.denoise else None)
        self._sensors: dict[tuple[int, int], Any] = {}
        self._materials = self._make_materials()
        self._instances = {str(k): v for k, v in self.built.instance_names.items()}
        self._material_names = {str(k): v for k, v in self.built.material_names.items()}
        self.seconds_to_build = time.perf_counter() - start

    def _make_materials(self) -> Any:
        from datagen.rendering.shape_ids import MergedShapeMaterials

        return MergedShapeMaterials(self.built)

    def render_view(self, index: int) -> RenderedView:
        """Render view ``index``: all of ``RENDERED_BUFFERS``, and ``beauty_noisy`` if the recipe keeps it.

        Raises :class:`RenderError` where a pixel is NaN or Inf.
        """
        return self._finish(*self._trace(index))

    def render_views(self, indices: Iterable[int]) -> Iterator[RenderedView]:
        """Views in the order of ``indices``.

        A view is denoised in a thread of its own while the next one is traced, and while the caller does what
        it does with the one before.
        """
        with ThreadPoolExecutor(1, thread_name_prefix="denoise") as pool:
            pending: Future[RenderedView] | None = None
            for index in indices:
                following = pool.submit(self._finish, *self._trace(index))
                if pending is not None:
                    yield pending.result()
                pending = following
            if pending is not None:
                yield pending.result()

    def close(self) -> None:
        """Release the scene and the denoiser; shared caches keep their meshes and textures."""
        denoiser, self._denoiser = self._denoiser, None
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

    def _trace(self, index: int) -> tuple[int, NDArray[np.float32], dict[str, NDArray], dict[str, float]]:
        """Noisy beauty and ground truth of a view, with the seconds of each pass."""
        from mitsuba_plugins.material_buffers import render_material_buffers

        if not 0 <= index < len(self.configuration.cameras):
            raise input_error(
                f"configuration {self.configuration.id}",
                "view",
                index,
                f"0 ... {len(self.configuration.cameras) - 1}",
            )
        sensor = self._sensor(self.configuration.cameras[index].camera())
        seed = self.configuration.seed
        start = time.perf_counter()
        noisy = self._tracer.render(
            sensor, self._num_samples, view_seed(seed, index, "path"), with_seen_lights=False
        )
        traced = time.perf_counter()
        buffers = render_material_buffers(
            self.built.scene,
            sensor,
            self.recipe.auxiliary_samples,
            view_seed(seed, index, "buffers"),
            self._materials,
        )
        buffers.pop("position_world", None)
        buffers["seen_lights"] = self._seen_lights(sensor, buffers["surface_mask"], index)
        seconds = {"path": traced - start, "buffers": time.perf_counter() - traced}
        return index, noisy, buffers, seconds

    def _seen_lights(self, sensor: Any, mask: NDArray[np.float32], index: int) -> NDArray[np.float32]:
        """Light that reaches the camera straight from lights and background, (H, W, 3).

        It is traced only where something other than surface shows, and as finely as the other buffers.
        """
        image = np.zeros((mask.size, 3), np.float32)
        pixels = np.flatnonzero(mask.ravel() < 1.0 - _FULL_COVERAGE_SLACK).astype(np.uint32)
        if pixels.size:
            seed = view_seed(self.configuration.seed, index, "lights")
            image[pixels] = self._tracer.render_seen_lights(
                sensor, pixels, self.recipe.auxiliary_samples, seed
            )
        return image.reshape(*mask.shape[:2], 3)

    def _finish(
        self,
        index: int,
        noisy: NDArray[np.float32],
        buffers: dict[str, NDArray],
        seconds: dict[str, float],
    ) -> RenderedView:
        start = time.perf_counter()
        self._check_finite(index, {"beauty_noisy": noisy, **buffers})
        seen_lights = buffers.pop("seen_lights")
        beauty = noisy + seen_lights
        if self._denoiser is not None:
            albedo = auxiliary_albedo(
                buffers["diffuse_albedo"], buffers["specular_albedo"], buffers["surface_mask"]
            )
            normal = buffers["normal_world"]
            if self._denoiser.wants_camera_normals:
                camera = self.configuration.cameras[index].camera()
                normal = normal @ camera.world_from_camera[:3, :3].astype(np.float32)
            beauty = self._denoiser.denoise(noisy, albedo, normal) + seen_lights
            self._check_finite(index, {"beauty": beauty})
        clipped = int(np.count_nonzero((beauty > HALF_MAX).any(axis=-1)))
        buffers["beauty"] = np.minimum(beauty, HALF_MAX)
        names = list(RENDERED_BUFFERS)
        if self.recipe.keep_noisy:
            buffers["beauty_noisy"] = np.minimum(noisy + seen_lights, HALF_MAX)
            names.append("beauty_noisy")
        record = RenderRecord(
            variant=self.variant,
            seed=view_seed(self.configuration.seed, index, "path"),
            path_samples=self._num_samples,
            auxiliary_samples=self.recipe.auxiliary_samples,
            max_depth=self._max_depth,
            russian_roulette_depth=self.recipe.russian_roulette_depth,
            denoiser=self._denoiser.name if self._denoiser is not None else "none",
            clipped_pixels=clipped,
        )
        seconds["denoise"] = time.perf_counter() - start
        ordered = {
            name: buffers[name].reshape(*noisy.shape[:2], BUFFERS[name].num_channels) for name in names
        }
        return RenderedView(index, ordered, self._instances, self._material_names, record, seconds)

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

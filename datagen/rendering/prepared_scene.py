# SPDX-License-Identifier: MIT
"""A configuration's scene with the path tracer, materials, path depth and sensors shared by its views.

Sky guide and irradiance cache are estimated from a fixed set of views, so the bytes of a view do not depend
on the views rendered before it or on the process.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import hashlib
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from datagen.formats.configuration import Configuration
from datagen.formats.recipe import DEFAULT_MAX_DEPTH, RenderRecipe
from datagen.foundation.cameras import Camera
from datagen.rendering.path_depth import depth_for, rms_reflectance, truncation
from datagen.rendering.scene_builder import AssetCaches, BuiltScene, build_scene, sensor_for

if TYPE_CHECKING:
    from datagen.library import Library

COARSE_CELLS = 1024
"""Approximate number of pixels of coarse images for path depth, sky guide and the clamp's exposure."""
MAX_COARSE_VIEWS = 8
"""Maximum number of views used for path depth and sky guide."""
COARSE_MAP_SAMPLES = 4
"""Ground-truth samples per pixel of coarse images."""
SKY_SAMPLES = 48
"""Paths per pixel of coarse images from which the sky guide is estimated."""
MAX_IRRADIANCE_VIEWS = 64
"""Maximum number of views from which irradiance is gathered."""


def view_seed(configuration_seed: int, view_index: int, purpose: str) -> int:
    """Hash the arguments to a seed in [0, 2^31)."""
    text = f"{configuration_seed}:{view_index}:{purpose}".encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:4], "little") >> 1


def release_memory() -> None:
    """Release memory of earlier scenes that Dr.Jit (arrays and kernels) and glibc (pages) keep for reuse.

    Otherwise a worker's memory grows by about 15 MB per configuration. Kernels that are needed again are
    loaded from Dr.Jit's cache on disk within milliseconds.
    """
    import drjit as dr

    from datagen.rendering.transport.integrator import forget_recordings

    forget_recordings()
    gc.collect()  # scenes and their materials form reference cycles
    dr.flush_malloc_cache()
    dr.flush_kernel_cache()
    with contextlib.suppress(OSError, AttributeError):  # a C library other than glibc
        ctypes.CDLL("libc.so.6").malloc_trim(0)


class PreparedScene:
    """A built scene with the data shared by its views. Selects the recipe's Mitsuba variant.

    Raises the errors of :func:`select_variant` and :func:`build_scene`.
    """

    def __init__(
        self,
        configuration: Configuration,
        library: Library,
        recipe: RenderRecipe,
        caches: AssetCaches | None = None,
    ):
        from mitsuba_plugins.variant import select_variant

        self.variant = select_variant(recipe.variant)
        release_memory()
        self.configuration, self.recipe = configuration, recipe
        self.built: BuiltScene = build_scene(configuration, library, caches)
        from datagen.rendering.shape_ids import MergedShapeMaterials
        from datagen.rendering.transport.integrator import PathTracer

        self._sensors: dict[tuple[int, int], Any] = {}
        self.materials = MergedShapeMaterials(self.built)
        self.max_depth, self.truncation = self._path_depth()
        self.tracer = PathTracer(self.built, self.materials, self.max_depth, recipe.russian_roulette_depth)
        self.prepare_paths()

    def reseed(self, seed: int) -> None:
        """Replace the configuration's seed, and estimate sky guide and irradiance cache again."""
        self.configuration = self.configuration.model_copy(update={"seed": seed})
        self.prepare_paths()

    def prepare_paths(self) -> None:
        """Estimate the sky guide and, if the recipe enables it, gather the irradiance cache."""
        coarse = (self.sensor(camera) for _, camera in self._coarse_cameras())
        self.tracer.fit_sky_guide(coarse, SKY_SAMPLES, self.seed(0, "sky"))
        if not self.recipe.irradiance_cache:
            return
        cameras = [view.camera() for view in self.configuration.cameras]
        chosen = cameras[:: math.ceil(len(cameras) / MAX_IRRADIANCE_VIEWS)]
        sensors = (self.sensor(camera) for camera in chosen)
        self.tracer.gather_irradiance(sensors, self.seed(0, "irradiance"))

    def seed(self, index: int, purpose: str) -> int:
        """Return :func:`view_seed` for this configuration's seed."""
        return view_seed(self.configuration.seed, index, purpose)

    def camera(self, index: int) -> Camera:
        """Camera of the view ``index``."""
        return self.configuration.cameras[index].camera()

    def sensor(self, camera: Camera) -> Any:
        """Mitsuba sensor of ``camera``, valid until the next call since cameras of equal size share one."""
        size = (camera.width_px, camera.height_px)
        if size not in self._sensors:
            self._sensors[size] = sensor_for(camera)
        self._sensors[size].set_camera(camera)
        return self._sensors[size]

    def coarse_maps(self) -> Iterator[dict[str, NDArray]]:
        """Yield the low-resolution ground truth, (H, W, C) by buffer, of up to ``MAX_COARSE_VIEWS`` views."""
        from mitsuba_plugins.material_buffers import render_material_buffers

        for index, small in self._coarse_cameras():
            seed = self.seed(index, "depth")
            yield render_material_buffers(
                self.built.scene, self.sensor(small), COARSE_MAP_SAMPLES, seed, self.materials
            )

    def close(self) -> None:
        """Release the sensors and, by :func:`release_memory`, unused memory."""
        self._sensors.clear()
        release_memory()

    def _path_depth(self) -> tuple[int, float | None]:
        """Return the maximum path depth and, if the recipe bounds the truncation, its value, else None."""
        if self.recipe.max_energy_left is None:
            return self.recipe.max_depth or DEFAULT_MAX_DEPTH, None
        reflectance = rms_reflectance(list(self.coarse_maps()))
        depth = depth_for(reflectance, self.recipe.max_energy_left)
        return depth, truncation(reflectance, depth)

    def _coarse_cameras(self) -> Iterator[tuple[int, Camera]]:
        """Pairs (view index, camera at low resolution) of up to ``MAX_COARSE_VIEWS`` views."""
        cameras = self.configuration.cameras
        for index in range(0, len(cameras), math.ceil(len(cameras) / MAX_COARSE_VIEWS)):
            camera = cameras[index].camera()
            side_px = math.isqrt(camera.width_px * camera.height_px // COARSE_CELLS)
            sides_px = (max(1, px // max(1, side_px)) for px in (camera.width_px, camera.height_px))
            yield index, camera.scaled(*sides_px)

# SPDX-License-Identifier: MIT
"""References for the tradeoff: converged views of a configuration, rendered once and stored.

For each view, a reference contains two independent images (whose noise hardly affects the expectation of
errors, see ``datagen.rendering.error``), maps from many samples, and statistics over all views. The
statistics use the denoised mean of the two images, traced visibility and the maximum number of best views.
The name of a reference is a hash of everything that affects it, so it is never reused for another library,
configuration, resolution, sample count or renderer.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import canonical_json, sha256_hex
from datagen.formats.configuration import Configuration, ViewCamera
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.buffers import BUFFERS, MATERIAL_MAPS
from datagen.foundation.color import exposure_for
from datagen.foundation.durable import publish
from datagen.foundation.versions import pixel_versions
from datagen.library import Library
from datagen.multiview.statistics import StatisticsOptions, StatisticsView, compute_statistics
from datagen.multiview.visibility import VisibilityOptions
from datagen.rendering.denoiser import auxiliary_albedo, make_denoiser
from datagen.rendering.renderer import SceneRenderer

SAMPLES_PER_CHUNK = 64
MAX_SAMPLES = 65536
"""Maximum number of samples of an image, and offset between the seeds of the two images."""
MAX_DEPTH = 32
RUSSIAN_ROULETTE_DEPTH = 8
MAP_SAMPLES = 1024
BEST_VIEWS = 24
MAPS = (*MATERIAL_MAPS, "normal_world", "depth_z_m", "surface_mask")
STATISTICS = ("color_min", "color_median", "color_max")


def sized(configuration: Configuration, size: tuple[int, int], num_views: int) -> Configuration:
    """Copy a configuration with resolution ``size`` (width, height) and ``num_views`` evenly spaced views."""
    total = len(configuration.cameras)
    count = min(num_views, total)
    chosen = [configuration.cameras[k * total // count] for k in range(count)]
    cameras = tuple(ViewCamera.from_camera(c.name, c.camera().scaled(*size)) for c in chosen)
    return configuration.model_copy(update={"cameras": cameras})


def reference_key(configuration: Configuration, samples: int) -> str:
    """Hash everything that affects a reference, including the asset hashes in the configuration."""
    parts = {
        "configuration": configuration.model_dump(mode="json"),
        "samples": samples,
        "depths": (MAX_DEPTH, RUSSIAN_ROULETTE_DEPTH),
        "maps": MAP_SAMPLES,
        "best_views": BEST_VIEWS,
        "versions": pixel_versions(),
    }
    return sha256_hex(canonical_json(parts))[:16]


@dataclass(frozen=True)
class Reference:
    """Converged views in ``folder``, as files ``view_000.npz`` and so on, and ``statistics.npz``."""

    folder: Path
    num_views: int

    def view_path(self, index: int) -> Path:
        return self.folder / f"view_{index:03}.npz"

    @property
    def statistics_path(self) -> Path:
        return self.folder / "statistics.npz"

    @property
    def num_made(self) -> int:
        """Number of finished views."""
        return sum(self.view_path(k).is_file() for k in range(self.num_views))

    @property
    def is_complete(self) -> bool:
        return self.num_made == self.num_views and self.statistics_path.is_file()

    def halves(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The two independent images (H, W, 3) of view ``index``."""
        with np.load(self.view_path(index)) as data:
            return data["first"], data["second"]

    def maps(self, index: int) -> dict[str, NDArray[np.float32]]:
        """Ground-truth maps (H, W, C) of view ``index`` by buffer name."""
        with np.load(self.view_path(index)) as data:
            return {name: data[name] for name in MAPS}

    def statistics(self, index: int) -> dict[str, NDArray[np.float32]]:
        """Colour statistics (H, W, 3) of view ``index`` by buffer name."""
        with np.load(self.statistics_path) as data:
            return {name: data[f"{name}_{index}"] for name in STATISTICS}

    def exposure(self, index: int) -> float:
        """Exposure factor of view ``index``, which scales errors of radiance."""
        first, second = self.halves(index)
        return exposure_for(0.5 * (first + second))


def write_arrays(path: Path, arrays: dict[str, NDArray]) -> None:
    """Write ``arrays`` to an ``npz`` file atomically."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial.npz")
    np.savez(partial, **arrays)
    publish(partial, path)


def make_reference(
    configuration: Configuration, library: Library, reference: Reference, samples: int
) -> None:
    """Render and store the missing parts of ``reference`` with ``samples`` paths per pixel and image."""
    reference.folder.mkdir(parents=True, exist_ok=True)
    recipe = RenderRecipe(
        variant="auto",
        path_samples=1,
        auxiliary_samples=MAP_SAMPLES,
        max_depth=MAX_DEPTH,
        russian_roulette_depth=RUSSIAN_ROULETTE_DEPTH,
        denoise=False,
    )
    renderer = SceneRenderer(configuration, library, recipe)
    for index in range(reference.num_views):
        if reference.view_path(index).is_file():
            continue
        buffers = renderer.render_view(index).buffers
        halves = [_converged(renderer, index, samples, half) for half in (0, 1)]
        maps = {name: buffers[name].astype(BUFFERS[name].dtype).astype(np.float32) for name in MAPS}
        write_arrays(reference.view_path(index), {"first": halves[0], "second": halves[1], **maps})
    if not reference.statistics_path.is_file():
        write_arrays(reference.statistics_path, _statistics(renderer, configuration, reference))
    renderer.close()


def _converged(renderer: Any, index: int, samples: int, half: int) -> NDArray[np.float32]:
    """Mean radiance (H, W, 3) of ``samples`` paths per pixel; seeds differ between ``half`` 0 and 1."""
    sensor = renderer.sensor(renderer.configuration.cameras[index].camera())
    total, done = np.zeros((1, 1, 3)), 0
    while done < samples:
        count = min(SAMPLES_PER_CHUNK, samples - done)
        seed = 0x5EED0000 + MAX_SAMPLES * half + done
        total = total + renderer.tracer.render(sensor, count, seed).astype(np.float64) * count
        done += count
    return (total / samples).astype(np.float32)


def _statistics(
    renderer: Any, configuration: Configuration, reference: Reference
) -> dict[str, NDArray[np.float32]]:
    """Statistics of the converged and denoised colours of all views, by name ``BUFFER_VIEW``."""
    denoiser = make_denoiser(renderer.variant)
    views = []
    for index, camera in enumerate(configuration.cameras):
        maps, halves = reference.maps(index), reference.halves(index)
        mean = 0.5 * (halves[0] + halves[1])
        albedo = auxiliary_albedo(maps["diffuse_albedo"], maps["specular_albedo"], maps["surface_mask"])
        normal = maps["normal_world"]
        if denoiser.wants_camera_normals:
            normal = normal @ camera.camera().world_from_camera[:3, :3].astype(np.float32)
        # denoising impairs visible lights, but their pixels have no statistics
        color = denoiser.denoise(mean, albedo, normal)
        views.append(StatisticsView.from_buffers(camera.camera(), {**maps, "beauty": color}))
    options = StatisticsOptions(best_views=BEST_VIEWS, visibility=VisibilityOptions(mode="trace"))
    found = compute_statistics(views, options, scene=renderer.built.scene)
    return {f"{name}_{k}": result[name] for k, result in enumerate(found) for name in STATISTICS}

# SPDX-License-Identifier: MIT
"""Measures one setting on one configuration: seconds by stage, errors against the reference, bytes per view.

Stages run one after the other so that their seconds can be measured separately; in production they overlap,
and a view takes about their processor seconds divided by the number of cores. The first view is rendered
twice, which excludes compilation times. Seconds are medians over views, plus a view's share of the seconds to
prepare sky guide and irradiance cache (stage ``learn``).

* ``rel_mse``: mean over views of the exposed relMSE of the stored beauty (``datagen.rendering.error``);
* ``maps_error``: mean absolute error of D, S, R and the normal, over surface pixels;
* ``statistics_error``: mean absolute error of minimum, median and maximum colour at the view's exposure.
"""

from __future__ import annotations

import statistics as stats
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.configuration import Configuration
from datagen.foundation.buffers import BUFFERS, MATERIAL_MAPS
from datagen.foundation.exr import decode_view, encode_channels, encode_view, to_storage
from datagen.library import Library
from datagen.multiview.statistics import StatisticsOptions, StatisticsView, compute_statistics
from datagen.multiview.visibility import VisibilityOptions
from datagen.rendering.denoiser import OidnDenoiser
from datagen.rendering.error import relative_mse
from datagen.rendering.geometry import MeshCache
from datagen.rendering.renderer import SceneRenderer
from datagen.rendering.scene_builder import AssetCaches
from datagen.rendering.textures import TextureCache
from datagen.tradeoff.reference import STATISTICS, Reference, sized
from datagen.tradeoff.settings import Setting

ERROR_MAPS = (*MATERIAL_MAPS, "normal_world")
STAGES = ("learn", "render", "statistics", "compress")


class Stopwatch:
    """Measures wall-clock and processor seconds by stage, one entry per view."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[tuple[float, float]]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the seconds spent in this context as an entry of stage ``name``."""
        cpu, wall = time.process_time(), time.perf_counter()
        yield
        entry = (time.perf_counter() - wall, time.process_time() - cpu)
        self.seconds.setdefault(name, []).append(entry)

    def medians(self) -> dict[str, dict[str, float]]:
        """Medians ``wall_s`` and ``cpu_s`` of each stage over its entries, and their sums as ``total``."""
        kinds = ("wall_s", "cpu_s")
        found = {
            name: dict(zip(kinds, map(stats.median, zip(*entries, strict=True)), strict=True))
            for name, entries in self.seconds.items()
        }
        found["total"] = {kind: sum(stage[kind] for stage in found.values()) for kind in kinds}
        return found


@dataclass(frozen=True)
class Trial:
    """Result of a setting on a configuration, with errors and seconds as defined by this module.

    ``passes_wall_s``: seconds by pass of the renderer; ``build_cpu_s``: processor seconds to build the scene.
    """

    configuration: str
    setting: dict[str, Any]
    rel_mse: float
    rel_mse_by_view: list[float]
    maps_error: float
    map_errors: dict[str, float]
    statistics_error: float
    bytes_a_view: int
    path_samples: float
    cpu_s: float
    wall_s: float
    stages: dict[str, dict[str, float]]
    passes_wall_s: dict[str, float]
    build_cpu_s: float
    num_views: int


def measure(configuration: Configuration, library: Library, reference: Reference, setting: Setting) -> Trial:
    """Render, process and store every view with ``setting``, and compare it with the reference."""
    at_size = configuration
    if setting.image_scale != 1.0:
        width, height = configuration.cameras[0].width_px, configuration.cameras[0].height_px
        size = round(width * setting.image_scale), round(height * setting.image_scale)
        at_size = sized(configuration, size, reference.num_views)
    caches = AssetCaches(MeshCache(), TextureCache(shrink=setting.texture_shrink))
    start = time.process_time()
    renderer = SceneRenderer(at_size, library, setting.recipe(), caches, _denoiser(setting))
    build_cpu_s = time.process_time() - start
    preparing, watch = Stopwatch(), Stopwatch()
    with preparing.stage("learn"):  # repeated, since the first preparation included compilation
        renderer.prepare_paths()
    renderer.render_view(0)
    rendered = []
    for index in range(reference.num_views):
        with watch.stage("render"):
            rendered.append(renderer.render_view(index))
    stored = [
        {name: to_storage(BUFFERS[name], array) for name, array in view.buffers.items()} for view in rendered
    ]
    gathered = list(_gather(at_size, stored, setting, renderer.built.scene, watch))
    num_bytes = []
    for index, (view, found) in enumerate(zip(rendered, gathered, strict=True)):
        buffers = {**view.buffers, **found}
        with watch.stage("compress"):
            data = encode(buffers, setting)
        num_bytes.append(len(data))
        stored[index] = decode_view(data) if setting.storage == "half" else buffers
    renderer.close()
    errors = [_errors(reference, index, buffers) for index, buffers in enumerate(stored)]
    seconds = watch.medians()
    total = seconds.pop("total")
    seconds["learn"] = {kind: spent / len(rendered) for kind, spent in preparing.medians()["learn"].items()}
    total = {kind: spent + seconds["learn"][kind] for kind, spent in total.items()}
    passes = sorted({name for view in rendered for name in view.seconds})
    map_errors = {name: float(np.mean([e[name] for e in errors])) for name in ERROR_MAPS}
    return Trial(
        configuration=configuration.id,
        setting=asdict(setting),
        rel_mse=float(np.mean([e["rel_mse"] for e in errors])),
        rel_mse_by_view=[e["rel_mse"] for e in errors],
        maps_error=float(np.mean(list(map_errors.values()))),
        map_errors=map_errors,
        statistics_error=float(np.mean([e["statistics"] for e in errors])),
        bytes_a_view=int(stats.median(num_bytes)),
        path_samples=float(np.mean([view.render.path_samples for view in rendered])),
        cpu_s=total["cpu_s"],
        wall_s=total["wall_s"],
        stages=seconds,
        passes_wall_s={name: stats.median(v.seconds.get(name, 0.0) for v in rendered) for name in passes},
        build_cpu_s=build_cpu_s,
        num_views=len(rendered),
    )


def _denoiser(setting: Setting) -> OidnDenoiser | None:
    """Create the OIDN denoiser of a setting; None keeps the renderer's default."""
    if setting.denoiser in ("none", "optix", "high"):
        return None
    is_guided = setting.denoiser != "unguided"
    return OidnDenoiser(quality=setting.denoiser if is_guided else "high", is_guided=is_guided)


def _gather(
    configuration: Configuration,
    stored: list[dict[str, NDArray]],
    setting: Setting,
    scene: Any,
    watch: Stopwatch,
) -> Iterator[dict[str, NDArray]]:
    """Yield the statistics of each view by buffer name; a first, untimed run compiles the kernels."""
    views = [
        StatisticsView.from_buffers(camera.camera(), buffers, camera.name)
        for camera, buffers in zip(configuration.cameras, stored, strict=True)
    ]
    visibility = VisibilityOptions(mode="trace" if setting.visibility == "trace" else "depth")
    options = StatisticsOptions(best_views=setting.best_views, visibility=visibility)
    next(iter(compute_statistics(views, options, scene=scene)))
    results = iter(compute_statistics(views, options, scene=scene))
    for _ in views:
        with watch.stage("statistics"):
            result = next(results)
        yield result


def encode(buffers: Mapping[str, NDArray], setting: Setting) -> bytes:
    """Encode a view as an EXR file, either as in shards or with float channels in single precision."""
    if setting.storage == "half":
        return encode_view(buffers, setting.compression)
    channels = {}
    for name, array in buffers.items():
        dtype = np.uint32 if BUFFERS[name].pixel_type == "uint" else np.float32
        for k, channel in enumerate(BUFFERS[name].exr_channels):
            channels[channel] = array[..., k].astype(dtype)
    return encode_channels(channels, setting.compression)


def _errors(reference: Reference, index: int, buffers: dict[str, NDArray]) -> dict[str, float]:
    """Errors of the stored ``buffers`` of view ``index`` against the reference, by name."""
    first, second = reference.halves(index)
    size = (first.shape[1], first.shape[0])
    found = {"rel_mse": relative_mse(_at_size(buffers["beauty"], size), first, second, exposed=True)}
    maps = reference.maps(index)
    is_surface = maps["surface_mask"][..., 0] > 0.5
    for name in ERROR_MAPS:
        difference = np.abs(_at_size(buffers[name], size) - maps[name])[is_surface]
        found[name] = float(difference.mean()) if difference.size else 0.0
    exposure, expected = reference.exposure(index), reference.statistics(index)
    found["statistics"] = float(
        np.mean([np.abs(_at_size(buffers[n], size) - expected[n]).mean() * exposure for n in STATISTICS])
    )
    return found


def _at_size(array: NDArray, size: tuple[int, int]) -> NDArray[np.float32]:
    """Resample ``array`` (H, W, C) to ``size`` (width, height)."""
    image = array.astype(np.float32)
    if image.shape[1::-1] == size:
        return image
    import cv2

    enlarged = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.float32)
    return enlarged.reshape(size[1], size[0], -1)

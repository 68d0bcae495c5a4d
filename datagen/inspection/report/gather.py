# SPDX-License-Identifier: MIT
"""Processes one shard: counts its pixels, draws thumbnails, writes pixels for the viewer.

Results are stored in the report's folder under a key of the shard's content and the options, so a repeated or
interrupted report reuses them.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import canonical_json, sha256_hex, write_bytes_atomically
from datagen.formats.configuration import Configuration
from datagen.formats.lights import Light
from datagen.formats.shard import ShardReader, ShardRecord, View
from datagen.formats.view import StatisticsRecord, ViewRecord
from datagen.foundation.buffers import MATERIAL_MAPS, surface_pixels
from datagen.foundation.color import clipped_share, luminance, photographic_exposure
from datagen.foundation.errors import input_error
from datagen.foundation.images import encode_jpeg, shown_bytes
from datagen.inspection.contact_sheet import COLUMNS
from datagen.inspection.report.figures import NUM_COVERAGE_BINS, PIXEL_AXES, count_metal_and_gloss, count_view
from datagen.inspection.report.tiles import write_script, write_tile
from datagen.multiview.statistics import StatisticsOptions, StatisticsView, choose_for_pixels
from datagen.multiview.visibility import PackedViews, VisibilityOptions
from mitsuba_plugins.variant import select_variant

REVISION = 4
"""Part of the key of stored results, to be increased when the format of results or tiles changes."""
SHOWN_BUFFERS = tuple(name for name, _ in COLUMNS)
"""Buffers offered by the viewer, in this order."""
_NEEDED = ("beauty", *MATERIAL_MAPS, "normal_world", "depth_z_m", "surface_mask")
_LOOKED_UP = ("surface_mask", "instance_id", "material_id")
_THUMBNAIL_WIDTH_PX = 320
NO_VIEW = 65535
"""Value of the unused entries at the end of a pixel's list of view indices."""


@dataclass(frozen=True)
class GatherJob:
    """A shard to process; ``with_pixels`` requests tiles of buffers, ``with_sources`` of source views too."""

    shard: Path
    record: ShardRecord
    out: Path
    with_pixels: bool
    with_sources: bool

    @property
    def key(self) -> str:
        """Hash of everything on which the result depends."""
        parts = [REVISION, self.record.sha256, self.with_pixels, self.with_pixels and self.with_sources]
        return sha256_hex(canonical_json(parts))

    @property
    def cache_path(self) -> Path:
        return self.out / "gathered" / f"{self.record.configuration}.json"

    @property
    def tiles(self) -> Path:
        """Folder of the configuration's tiles."""
        return self.out / "tiles" / self.record.configuration


def cached(work: Callable[[Any], dict[str, Any]]) -> Callable[[Any], dict[str, Any]]:
    """Decorator: store the results of ``work`` in a job's ``cache_path`` under its ``key``, and reuse them.

    Before ``work``, the job's folder ``tiles`` is removed.
    """

    @wraps(work)
    def result_of(job: Any) -> dict[str, Any]:
        key = job.key
        with suppress(OSError, ValueError):
            earlier = json.loads(job.cache_path.read_bytes())
            if isinstance(earlier, dict) and earlier.get("key") == key:
                return earlier
        if job.tiles.is_dir():  # left by an earlier report with other options
            shutil.rmtree(job.tiles)
        result = {"key": key, **work(job)}
        write_bytes_atomically(job.cache_path, canonical_json(result), parents=True)
        return result

    return result_of


@cached
def gather_shard(job: GatherJob) -> dict[str, Any]:
    """Measure one shard; return plain data, and write thumbnails, tiles and the viewer's data (JavaScript).

    Raises :class:`InputError` if the shard is damaged or a view lacks a buffer.
    """
    identity = job.record.configuration
    reader = ShardReader(job.shard)
    configuration = reader.configuration()
    counts = {name: np.zeros(len(axis.edges) - 1, np.int64) for name, axis in PIXEL_AXES.items()}
    coverage = np.zeros((NUM_COVERAGE_BINS, NUM_COVERAGE_BINS), np.int64)
    materials: Counter[str] = Counter()
    views, records, geometry = [], [], []
    tile_bytes = 0
    for view in reader:
        record = view.record
        if lacking := [name for name in _NEEDED if name not in view.buffers]:
            got = f"no {', '.join(lacking)}"
            raise input_error(f"{job.shard}:{record.name}", "", got, "a whole view", "make the shard again")
        histograms, cells = count_view(view.buffers)
        for name, found in histograms.items():
            counts[name] += found
        coverage += cells
        materials += _pixels_by_material(view)
        views.append(_view_figures(view))
        records.append(record)
        _write_thumbnail(job.out / "thumbnails" / identity / f"{record.name}.jpg", view)
        if job.with_pixels:
            tile_bytes += _write_tiles(job.tiles / record.name, view)
            if job.with_sources and record.statistics is not None:
                geometry.append(_geometry(view))
    if job.with_pixels and job.with_sources and len(geometry) == len(records) > 0:
        tile_bytes += _write_sources(job.tiles, records, geometry)
    _write_configuration(job.out / "configurations" / f"{identity}.js", configuration, records)
    return {
        "id": identity,
        "split": job.record.split,
        "has_pixels": job.with_pixels,
        "tile_bytes": tile_bytes,
        "counts": {name: found.tolist() for name, found in counts.items()},
        "coverage": coverage.tolist(),
        "materials": materials,
        "views": views,
        "placed": [
            {"asset": p.asset, "materials": sorted({m.asset for m in p.materials.values() if m.asset})}
            for p in (configuration.environment, *configuration.objects)
        ],
        "lights": [light_intensity(light) for light in configuration.lights],
        "rejections": configuration.rejections,
    }


def light_intensity(light: Light) -> dict[str, Any]:
    """Type of a light, and luminance and unit of its emission or, for a sky or image, its scale factor."""
    units = {"intensity": "W/sr", "irradiance": "W/m^2", "radiance": "W/(m^2 sr)"}
    if light.type == "sky":
        return {"type": "sky", "unit": "times the model's", "value": light.sky_scale}
    if light.type == "environment" and light.image is not None:
        return {"type": "environment image", "unit": "times the image's", "value": light.scale}
    field = next(name for name in units if hasattr(light, name))
    value = float(luminance(np.array(getattr(light, field), dtype=np.float64)))
    return {"type": light.type, "unit": units[field], "value": value}


def _pixels_by_material(view: View) -> Counter[str]:
    found: Counter[str] = Counter()
    if "material_id" in view.buffers:
        ids, pixels = np.unique(view.buffers["material_id"][surface_pixels(view.buffers)], return_counts=True)
        for identity, count in zip(ids.tolist(), pixels.tolist(), strict=True):
            if (name := view.record.materials.get(str(identity))) is not None:
                found[name] += count
    return found


def _view_figures(view: View) -> dict[str, Any]:
    """Measured values of one view that the page displays or sorts by."""
    record, buffers = view.record, view.buffers
    camera = record.camera.camera()
    mask = surface_pixels(buffers)
    forward = camera.forward
    counts = buffers.get("observation_count", np.zeros((*mask.shape, 0)))[mask]
    counts = counts[np.isfinite(counts)]
    beauty = buffers["beauty"].astype(np.float32)
    shown = photographic_exposure(beauty, mask)
    return {
        "name": record.name,
        "samples": record.render.path_samples,
        "rel_mse": record.render.estimated_rel_mse,
        "clipped_pixels": record.render.clipped_pixels,
        "exposure": record.exposure,
        "clipped_share": round(clipped_share(beauty, shown, mask), 5),
        **count_metal_and_gloss(buffers),
        "height_m": round(float(camera.position_m[2]), 4),
        "pitch_deg": round(float(np.degrees(np.arcsin(np.clip(forward[2], -1, 1)))), 2),
        "heading_deg": round(float(np.degrees(np.arctan2(forward[1], forward[0]))) % 360, 2),
        "fov_x_deg": round(float(np.degrees(camera.fov_x_rad)), 2),
        "surface_share": round(float(mask.mean()), 4),
        "mean_count": round(float(counts.mean()), 3) if counts.size else None,
    }


def _write_thumbnail(path: Path, view: View) -> None:
    from PIL import Image

    beauty = view.buffers["beauty"].astype(np.float32)
    beauty = np.where(np.isfinite(beauty), beauty, 0)
    height, width = beauty.shape[:2]
    shown = min(_THUMBNAIL_WIDTH_PX, width)
    size = (shown, max(1, round(height * shown / width)))
    exposure = photographic_exposure(beauty, surface_pixels(view.buffers))
    screen = shown_bytes(beauty, exposure)
    small = np.asarray(Image.fromarray(screen).resize(size, Image.Resampling.BOX))
    write_bytes_atomically(path, encode_jpeg(small, 82), parents=True)


def _write_tiles(folder: Path, view: View) -> int:
    stem = f"{view.record.configuration}/{view.record.name}"
    return sum(
        write_tile(folder / f"{name}.html", f"{stem}/{name}", view.buffers[name])
        for name in (*SHOWN_BUFFERS, *_LOOKED_UP)
        if name in view.buffers
    )


def options_of(record: StatisticsRecord) -> StatisticsOptions:
    """Options of recorded statistics, but always with depth-buffer visibility, since no mesh is loaded."""
    visibility = VisibilityOptions(mode="depth")
    return StatisticsOptions(record.best_views, record.include_self, visibility=visibility)


def source_views(views: Sequence[StatisticsView], options: StatisticsOptions) -> Iterator[NDArray[np.uint16]]:
    """Yield for each view the indices (H, W, k) of the views that each pixel's statistics use.

    The best view comes first; :data:`NO_VIEW` fills the rest. Raises :class:`InputError` if LLVM is missing.
    """
    select_variant()
    import drjit as dr
    import mitsuba as mi

    packed = PackedViews([view.camera for view in views], [view.depth_z_m for view in views])
    for index, view in enumerate(views):
        _, _, selection = choose_for_pixels(view, index, packed, options)
        count = selection.num_chosen
        rows = [
            dr.select(mi.UInt32(j) < count, selection.views[mi.UInt32(j)], mi.UInt32(NO_VIEW))
            for j in range(options.best_views)
        ]
        dr.eval(rows)
        shape = (view.camera.height_px, view.camera.width_px, options.best_views)
        yield np.stack([row.numpy() for row in rows], axis=-1).astype(np.uint16).reshape(shape)


def _geometry(view: View) -> Any:
    # source views do not depend on colours
    buffers: dict[str, NDArray] = {**view.buffers, "beauty": np.zeros((0,))}
    return StatisticsView.from_buffers(view.record.camera.camera(), buffers, view.record.name)


def _write_sources(folder: Path, records: list[ViewRecord], geometry: list[Any]) -> int:
    assert records[0].statistics is not None
    written = 0
    options = options_of(records[0].statistics)
    for record, chosen in zip(records, source_views(geometry, options), strict=True):
        key = f"{record.configuration}/{record.name}/sources"
        written += write_tile(folder / record.name / "sources.html", key, chosen)
    return written


def _write_configuration(path: Path, configuration: Configuration, records: list[ViewRecord]) -> None:
    """Write a configuration's script for the viewer: cameras, exposures, names by id, render records."""
    tables: list[dict[str, dict[str, str]]] = []
    views = []
    for record in records:
        table = {"instances": record.instances, "materials": record.materials}
        if table not in tables:
            tables.append(table)
        views.append(
            {
                "name": record.name,
                "camera": record.camera.model_dump(mode="json"),
                "exposure": record.exposure,
                "buffers": record.buffers,
                "names": tables.index(table),
                "render": record.render.model_dump(mode="json"),
                "statistics": record.statistics.model_dump(mode="json") if record.statistics else None,
            }
        )
    data = {"id": configuration.id, "views": views, "names": tables}
    write_script(path, "configuration(", data, ");")

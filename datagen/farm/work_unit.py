# SPDX-License-Identifier: MIT
"""Runs a unit, from its configuration to its committed shard, interruptible and resumable at any point.

Stages communicate only through files: ``render`` writes views, ``stats`` writes views with statistics, and
``pack`` writes the shard and its manifest. Every file is written atomically, the manifest last, by
``os.link``. If two processes run a unit, the first to finish commits it, and the second has no effect.
"""

from __future__ import annotations

import shutil
import socket
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from datagen.farm.folder import DatasetFolder, PlannedUnit, UnitManifest, ViewTiming, unit_key
from datagen.formats.base import (
    canonical_json,
    quantized,
    read_json,
    sha256_file,
    sha256_hex,
    write_bytes_atomically,
)
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import Recipe
from datagen.formats.shard import write_shard
from datagen.formats.view import StatisticsRecord, ViewRecord
from datagen.foundation.buffers import BUFFERS
from datagen.foundation.color import exposure_for
from datagen.foundation.durable import make_folder, publish, publish_first
from datagen.foundation.errors import InputError, input_error
from datagen.foundation.exr import decode_view, encode_view, to_storage
from datagen.foundation.peak_memory import process_peak_mb
from datagen.foundation.versions import pixel_versions
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from datagen.library import Library
from datagen.multiview.statistics import StatisticsOptions, StatisticsView, compute_statistics
from datagen.multiview.visibility import VisibilityOptions
from datagen.rendering.capture_geometry import configuration_geometry
from datagen.rendering.renderer import SceneRenderer
from mitsuba_plugins.variant import select_variant

if TYPE_CHECKING:
    from datagen.light.view_light import ViewLight


class Interrupted(Exception):
    """Raised when a signal has stopped the unit; all finished views are on disk."""


@dataclass
class UnitRun:
    """State of one attempt to run a unit. ``report(stage, done, total)`` is called after each view.

    ``should_stop`` is called between views; if it returns true, :class:`Interrupted` is raised.
    """

    folder: DatasetFolder
    unit: PlannedUnit
    recipe: Recipe
    library: Library
    versions: dict[str, str]
    variant: str
    report: Callable[[str, int, int], None] = lambda stage, done, total: None
    should_stop: Callable[[], bool] = lambda: False
    seconds: dict[str, float] = field(default_factory=dict)
    attempt: str = field(default_factory=lambda: uuid.uuid4().hex[:12])

    def __post_init__(self) -> None:
        self.work = self.folder.work_path(self.unit)
        self.rendered_path, self.complete_path = self.work / "rendered", self.work / "complete"
        # touched by a running attempt, so that datagen.farm.status recognises it
        self.heartbeat_path = self.work / "running"

    def progress(self, stage: str, done: int, total: int) -> None:
        """Report progress and touch the heartbeat."""
        self.heartbeat_path.touch()
        self.report(stage, done, total)

    def check_stop(self) -> None:
        """Raise :class:`Interrupted` if ``should_stop`` returns true."""
        if self.should_stop():
            raise Interrupted(self.unit.id)

    # ------------------------------------------------------------------ views on disk

    def read_record(self, folder: Path, view: str) -> ViewRecord | None:
        """Read the record of a finished view; None if it is missing or does not match its EXR file."""
        with suppress(InputError, OSError):  # a view that is unfinished or damaged is rendered again
            record = read_json(ViewRecord, folder / f"{view}.json")
            if sha256_file(folder / f"{view}.exr") == record.exr_sha256:
                return record
        return None

    def publish(
        self, folder: Path, record: ViewRecord, buffers: dict[str, NDArray], compression: str
    ) -> None:
        """Write a view's EXR file, then the JSON file that marks it as complete."""
        data = encode_view(buffers, compression)
        write_bytes_atomically(folder / f"{record.name}.exr", data)
        record = record.model_copy(update={"exr_sha256": sha256_hex(data), "buffers": tuple(sorted(buffers))})
        write_bytes_atomically(folder / f"{record.name}.json", canonical_json(record))


def run_unit(run: UnitRun, stages: Iterable[str] = ("render", "stats", "pack")) -> bool:
    """Run ``stages`` of a unit; return False if an earlier or concurrent run has committed it.

    Raises :class:`Interrupted`, :class:`InputError`, or any error of the renderer; finished views are kept.
    """
    if run.folder.is_done(run.unit):
        return False
    configuration = run.folder.read_configuration(run.unit)
    _check_planned(run, configuration)
    try:
        run.work.mkdir(parents=True, exist_ok=True)
        for stage in stages:
            STAGES[stage](run, configuration)
    except (OSError, InputError):
        if run.folder.is_done(run.unit):  # another process has committed it and cleaned up meanwhile
            return False
        raise
    finally:
        run.heartbeat_path.unlink(missing_ok=True)
        # even if another process has committed the unit, since this one may have written files afterwards
        if run.folder.is_done(run.unit):
            shutil.rmtree(run.work, ignore_errors=True)
    return True


def _check_planned(run: UnitRun, configuration: Configuration) -> None:
    """Raise :class:`InputError` if files or software versions have changed since planning."""
    where = run.folder.configuration_path(run.unit.id)
    versions = pixel_versions(has_light=run.recipe.statistics.light)
    if run.versions != versions:
        differing = {name for name, _ in set(run.versions.items()) ^ set(versions.items())}
        got = ", ".join(f"{name} {versions.get(name)}" for name in sorted(differing))
        planned = ", ".join(f"{name} {run.versions.get(name)}" for name in sorted(differing))
        remedy = "use the environment in which it was planned, or plan again in another folder"
        raise input_error(run.folder.plan_path, "versions", got, f"{planned} as planned", remedy)
    key = unit_key(configuration, run.recipe, run.variant, run.versions)
    if key != run.unit.key:
        got = "not what was planned: this file or recipe.yaml has changed"
        raise input_error(where, "", got, f"the unit with the key {run.unit.key[:12]}", "restore both files")


def _render(run: UnitRun, configuration: Configuration) -> None:
    """Render the missing views and publish each as soon as it is finished."""
    start = time.perf_counter()
    names = [camera.name for camera in configuration.cameras]
    run.rendered_path.mkdir(parents=True, exist_ok=True)
    missing = [i for i, name in enumerate(names) if run.read_record(run.rendered_path, name) is None]
    run.progress("render", len(names) - len(missing), len(names))
    if not missing:
        return
    run.check_stop()
    renderer = SceneRenderer(configuration, run.library, run.recipe.render)
    done = len(names) - len(missing)
    for view in renderer.render_views(missing):
        camera = configuration.cameras[view.index]
        stored = {name: to_storage(BUFFERS[name], array) for name, array in view.buffers.items()}
        exposure = exposure_for(stored["beauty"].astype(np.float32), stored["surface_mask"][..., 0] > 0.5)
        record = ViewRecord(
            configuration=configuration.id,
            name=camera.name,
            index=view.index,
            split=configuration.split,
            camera=camera,
            exposure=quantized(exposure),
            buffers=(),
            instances=view.instances,
            materials=view.materials,
            render=view.render,
            versions=run.versions,
            exr_sha256="",
        )
        run.publish(run.rendered_path, record, stored, "none")
        write_bytes_atomically(
            run.rendered_path / f"{camera.name}.timing",
            canonical_json(ViewTiming(view=camera.name, seconds=view.seconds)),
        )
        done += 1
        run.seconds["render"] = round(time.perf_counter() - start, 3)
        run.progress("render", done, len(names))
        run.check_stop()


def _gather_statistics(run: UnitRun, configuration: Configuration) -> None:
    """Compute the multi-view statistics of all views, and publish the views with them."""
    start = time.perf_counter()
    names = [camera.name for camera in configuration.cameras]
    run.complete_path.mkdir(parents=True, exist_ok=True)
    if all(run.read_record(run.complete_path, name) is not None for name in names):
        return
    records: list[ViewRecord] = []
    stored: list[dict[str, NDArray]] = []
    for name in names:
        record = run.read_record(run.rendered_path, name)
        if record is None:
            raise _missing_view(run.rendered_path / f"{name}.exr", run, "render")
        records.append(record)
        stored.append(decode_view(run.rendered_path / f"{name}.exr"))
    select_variant(run.variant)
    settings = run.recipe.statistics
    scene = None
    if settings.visibility == "trace":
        from datagen.rendering.scene_builder import build_scene

        scene = build_scene(configuration, run.library).scene
    views = [
        StatisticsView.from_buffers(record.camera.camera(), buffers, record.name)
        for buffers, record in zip(stored, records, strict=True)
    ]
    visibility = VisibilityOptions(mode=settings.visibility)
    options = StatisticsOptions(settings.best_views, settings.include_self, visibility=visibility)
    statistics_record = StatisticsRecord(num_views=len(views), **settings.model_dump())
    run.progress("stats", 0, len(names))
    light = light_of_views(run, configuration, views) if settings.light else None
    for index, statistics in enumerate(compute_statistics(views, options, scene=scene)):
        record = records[index].model_copy(update={"statistics": statistics_record})
        buffers = {**stored[index], **statistics}
        if light is not None:
            buffers |= light.buffers(index, statistics["color_median"])
        run.publish(run.complete_path, record, buffers, run.recipe.output.compression)
        run.seconds["stats"] = round(time.perf_counter() - start, 3)
        run.progress("stats", index + 1, len(names))
        run.check_stop()


def light_of_views(run: UnitRun, configuration: Configuration, views: Sequence[StatisticsView]) -> ViewLight:
    """Estimate the light in a configuration's room from the views' images and cameras and the room's mesh.

    Raises :class:`InputError` if the views show too little surface.
    """
    from datagen.light.view_light import ViewLight

    geometry, _ = configuration_geometry(configuration, run.library)
    traced = TracedGeometry(geometry)
    seen = [
        TracedView(
            view.camera,
            view.color.astype(np.float32),
            traced.trace_view(view.camera),
            np.ones(view.color.shape[:2], dtype=bool),
            view.name,
        )
        for view in views
    ]
    try:
        return ViewLight(seen, traced, geometry.emitter_mask())
    except ValueError as error:
        where = run.folder.configuration_path(run.unit.id)
        expected = "views that show enough surface for statistics.light"
        remedy = "choose other cameras, or leave statistics.light out"
        raise input_error(where, "cameras", str(error), expected, remedy) from None


def _missing_view(path: Path, run: UnitRun, stage: str) -> InputError:
    remedy = f"run `datagen run {run.folder.root} --only {stage}` first"
    return input_error(path, "", "missing", "every view of the configuration", remedy)


def _pack(run: UnitRun, configuration: Configuration) -> None:
    """Write the views with statistics to a shard, and commit it by its manifest."""
    start = time.perf_counter()
    run.heartbeat_path.touch()
    names = [camera.name for camera in configuration.cameras]
    for name in names:
        if run.read_record(run.complete_path, name) is None:
            raise _missing_view(run.complete_path / f"{name}.exr", run, "stats")
    members = [
        (f"{configuration.id}/{name}.{suffix}", run.complete_path / f"{name}.{suffix}")
        for name in names
        for suffix in ("exr", "json")
    ]
    for folder in (run.folder.shards_path, run.folder.units_path):
        make_folder(folder)
    partial = run.folder.shards_path / f".{configuration.id}.{run.attempt}.partial"
    try:
        with partial.open("wb") as file:
            write_shard(file, canonical_json(configuration), members)
        digest = sha256_file(partial)
        shard = run.folder.shards_path / f"{configuration.id}-{digest[:16]}.tar"
        num_bytes = partial.stat().st_size
        run.heartbeat_path.touch()  # prevents removal of the shard, which no manifest names yet
        publish(partial, shard)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(partial)
        raise
    timings = []
    for name in names:
        try:
            timings.append(read_json(ViewTiming, run.rendered_path / f"{name}.timing"))
        except InputError:
            timings.append(ViewTiming(view=name, seconds={}))  # an attempt was killed before writing it
    run.seconds["pack"] = round(time.perf_counter() - start, 3)
    manifest = UnitManifest(
        key=run.unit.key,
        id=run.unit.id,
        shard=shard.relative_to(run.folder.root).as_posix(),
        sha256=digest,
        num_bytes=num_bytes,
        num_views=len(names),
        attempt=run.attempt,
        host=socket.gethostname(),
        seconds=run.seconds,
        views=tuple(timings),
        peak_memory_mb=round(process_peak_mb(), 1),
    )
    commit_manifest(run, manifest)


def commit_manifest(run: UnitRun, manifest: UnitManifest) -> None:
    """Publish a unit's manifest unless another attempt has published a valid one."""
    path = run.folder.manifest_path(run.unit)
    partial = path.with_name(f".{path.name}.{run.attempt}.partial")
    write_bytes_atomically(partial, canonical_json(manifest))
    try:
        publish_first(partial, path)
    except FileExistsError:
        other = None
        with suppress(InputError):
            other = run.folder.read_manifest(run.unit)
        is_wrong = other is not None and other.shard == manifest.shard and other.sha256 != manifest.sha256
        if other is None or is_wrong or not run.folder.is_done(run.unit):  # it is damaged or lacks its shard
            publish(partial, path)
        elif other.shard != manifest.shard:
            (run.folder.root / manifest.shard).unlink(missing_ok=True)
    finally:
        partial.unlink(missing_ok=True)


STAGES = {"render": _render, "stats": _gather_statistics, "pack": _pack}
"""Functions that run the stages, by name."""

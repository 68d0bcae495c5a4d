# SPDX-License-Identifier: MIT
"""The whole way from a capture to an asset: trace, statistics, prediction, merge, fill, export.

OUT/state.json      what the work belongs to: a hash over checkpoint, cameras, geometry and options
OUT/views/          predicted maps, one EXR a view; a run that was stopped continues after them
OUT/atlas/          the merged maps as PNG and EXR, and mask.png (255 seen, 128 filled in, 0 no surface)
OUT/asset/          the asset package; OUT/NAME.glb and OUT/mitsuba/scene.xml for others
OUT/check/          what the check of mesh against photographs found, with pictures
OUT/report.json     unwrap, size, coverage, warnings, seconds by stage

Everything appears whole or not at all, and ``report.json`` last.
"""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from datagen.errors import InputError, input_error
from datagen.formats.base import canonical_json, sha256_hex, write_bytes_atomically
from datagen.formats.capture import Capture, CaptureGeometry, CaptureView, ColorImage
from datagen.formats.exr import decode_view, encode_view
from datagen.multiview.statistics import StatisticsOptions, StatisticsView, compute_statistics
from datagen.multiview.visibility import VisibilityOptions
from mitsuba_plugins.variant import select_variant
from model.reconstruction.check import Look, check_looks, view_warnings
from model.reconstruction.fill import atlas_size, fill_unseen
from model.reconstruction.geometry import (
    TracedGeometry,
    ViewGeometry,
    face_normals,
    seen_sides,
    smooth_regions,
)
from model.reconstruction.merge import MAP_CHANNELS, Atlas, MapMerger, MapView, MergeOptions, empty_atlas
from model.reconstruction.texels import TexelSurface
from model.reconstruction.uv import UvReport, unwrapped

MAP_NAMES = tuple(MAP_CHANNELS)
Progress = Callable[[str, int, int], None]
MEMORY_ATLAS = 4096
"""Atlases up to this side are held in memory, larger ones in files beside the result while they are made."""


@dataclass(frozen=True)
class InferOptions:
    """``atlas`` is the side in texels, or "auto" from the density of the views' pixels. ``use_truth`` merges
    the capture's own ground truth instead of predictions: what the rest of the way loses. ``is_checked``:
    whether the mesh is compared with the photographs first."""

    atlas: int | Literal["auto"] = "auto"
    visibility: Literal["depth", "trace"] = "depth"
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    batch: int = 4
    is_filtered: bool = True
    device: str = "cpu"
    use_truth: bool = False
    has_exr: bool = True
    is_checked: bool = True
    jobs: int = 2

    def __post_init__(self) -> None:
        if self.atlas != "auto" and not 16 <= self.atlas <= 16384:
            raise input_error("infer", "atlas", self.atlas, "auto, or a side in [16, 16384]", "correct it")


@dataclass(frozen=True)
class GivenMaps:
    """Maps of a capture's views from elsewhere than a checkpoint: ``read`` gives each view's by name, (H, W,
    3 or 1) in [0, 1]; ``identity`` tells them from others."""

    identity: str
    read: Callable[[Capture, Sequence[StatisticsView]], list[dict[str, NDArray]]]


@dataclass
class InferReport:
    """What was done. ``seconds`` by stage; ``warnings`` name views where they concern one."""

    name: str = ""
    num_views: int = 0
    num_triangles: int = 0
    atlas_size: int = 0
    seen_share: float = 0.0
    exposure: float = 0.0
    unwrap: dict[str, Any] = field(default_factory=dict)
    precision: str = ""
    is_filtered: bool = False
    gltf_error: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time inside to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def table(self) -> str:
        """The stages and their seconds, for the end of a run."""
        total = sum(self.seconds.values())
        rows = [*self.seconds.items(), ("total", total)]
        return "\n".join(
            f"{name:<12}{seconds:>9.1f} s{seconds / max(total, 1e-9):>8.0%}" for name, seconds in rows
        )


@dataclass
class _Seen:
    """Views as read and traced."""

    statistics: list[StatisticsView]
    geometry: list[ViewGeometry]
    valid_masks: list[NDArray[np.bool_]]


def infer(
    capture: Capture,
    out: Path,
    checkpoint: Path | None,
    options: InferOptions | None = None,
    progress: Progress | None = None,
    given: GivenMaps | None = None,
) -> InferReport:
    """Make an asset of ``capture`` in ``out``, from a checkpoint's maps, the capture's own truth
    (``use_truth``) or ``given`` ones.

    Raises :class:`InputError` where the input is bad, no view sees the mesh, or ``out`` holds other work.
    """
    options = options or InferOptions()
    given = TRUTH if options.use_truth else given
    if checkpoint is None and given is None:
        raise input_error("infer", "checkpoint", "none", "a checkpoint", "name one with --checkpoint")
    source = given if given is not None else checkpoint
    assert source is not None
    try:
        return _infer(capture, out, source, options, progress or (lambda stage, done, total: None))
    except OSError as error:
        if error.filename is None and error.errno:  # a full disk does not say which file it was
            raise OSError(error.errno, error.strerror, str(out)) from error
        raise


def _infer(
    capture: Capture, out: Path, maps_from: Path | GivenMaps, options: InferOptions, tell: Progress
) -> InferReport:
    if isinstance(maps_from, Path):
        from model.checkpoint import read_card
        from model.devices import parse_device

        read_card(maps_from)  # before hours of work, and before OUT belongs to it
        parse_device(options.device)
    select_variant()
    report = InferReport(capture.name, len(capture.views), len(capture.geometry.mesh.faces))
    report.notes += capture.notes
    _claim(out, capture, maps_from, options)
    with report.stage("trace"):
        traced = TracedGeometry(capture.geometry)
        seen = _look(capture, traced, tell)
    if options.is_checked:
        with report.stage("check"):
            _check(capture, seen, out, report)
    else:
        for view, statistics, geometry in zip(capture.views, seen.statistics, seen.geometry, strict=True):
            report.warnings += view_warnings(view.name, statistics.color, geometry)
    if isinstance(maps_from, GivenMaps):
        with report.stage("read maps"):
            maps = maps_from.read(capture, seen.statistics)
    else:
        maps = _predict(capture, seen, traced, out, maps_from, options, report, tell)
    with report.stage("unwrap"):
        sides = seen_sides(seen.geometry, report.num_triangles)
        mesh, unwrap = unwrapped(traced.mesh, options.jobs)
        report.unwrap = asdict(unwrap)
        report.atlas_size = _choose_size(capture, seen, unwrap, options)
        report.unwrap["texels_per_m"] = report.atlas_size / unwrap.metres_per_side
        report.notes += unwrap.notes
    with _atlas_memory(report.atlas_size, out) as atlas:
        with report.stage("merge"):
            _merge(capture, seen, traced, maps, (mesh, sides), atlas, options, tell)
            report.seen_share = _seen_share(atlas)
        with report.stage("fill"):
            fill_unseen(atlas, mesh)
        with report.stage("export"):
            _export(Capture(capture.name, capture.views, CaptureGeometry(mesh, capture.geometry.parts),
                            capture.lights, capture.notes), atlas, out, options, report)  # fmt: skip
    write_bytes_atomically(out / "report.json", canonical_json(asdict(report)))
    return report


def _claim(out: Path, capture: Capture, maps_from: Path | GivenMaps, options: InferOptions) -> None:
    """Bind ``out`` to this work: continue what is the same, refuse what is not."""
    mesh = capture.geometry.mesh
    geometry = hashlib.sha256(mesh.positions.tobytes() + mesh.faces.tobytes()).hexdigest()
    cameras = [
        [v.name, v.camera.width_px, v.camera.height_px, v.camera.fx_px, v.camera.fy_px, v.camera.cx_px,
         v.camera.cy_px, v.camera.world_from_camera.tolist()]
        for v in capture.views
    ]  # fmt: skip
    if isinstance(maps_from, GivenMaps):
        weights = maps_from.identity
    else:
        weights = hashlib.sha256(_read(maps_from)).hexdigest()
    decides_maps = {"precision": options.precision, "is_filtered": options.is_filtered}
    work = {
        "name": capture.name,
        "geometry": geometry,
        "cameras": cameras,
        "weights": weights,
        **decides_maps,
    }
    state = canonical_json({"format": "scene-materials/inference", "work": sha256_hex(canonical_json(work))})
    path = out / "state.json"
    if path.is_file() and path.read_bytes() != state:
        expected = "the capture, checkpoint and options that it was started with"
        raise input_error(out, "state.json", "other work", expected, "choose another --out or remove it")
    (out / "views").mkdir(parents=True, exist_ok=True)
    write_bytes_atomically(path, state)


def _read(checkpoint: Path) -> bytes:
    try:
        return checkpoint.read_bytes()
    except OSError as error:
        raise input_error(
            checkpoint, "", str(error), "a checkpoint (.safetensors)", "check the path"
        ) from None


def _look(capture: Capture, traced: TracedGeometry, tell: Progress) -> _Seen:
    """Read and trace every view."""
    seen = _Seen([], [], [])
    for number, view in enumerate(capture.views, start=1):
        image = view.read()
        geometry = traced.trace_view(view.camera, image.valid_mask)
        seen.geometry.append(geometry)
        seen.statistics.append(
            StatisticsView(
                view.camera,
                image.color,
                geometry.depth_z_m,
                geometry.normal_world,
                geometry.surface_mask,
                view.name,
            )
        )
        seen.valid_masks.append(image.valid_mask)
        tell("trace", number, len(capture.views))
    if not any(geometry.surface_mask.any() for geometry in seen.geometry):
        expected = "cameras that look at the mesh"
        remedy = "check that mesh and cameras share their frame, axes and unit"
        raise input_error(capture.name, "geometry", "no view sees the mesh", expected, remedy)
    return seen


def _check(capture: Capture, seen: _Seen, out: Path, report: InferReport) -> None:
    """Check the capture and keep what was found beside the result; refuse a mesh in the wrong frame."""
    looks = [
        Look(view.name, view.camera, ColorImage(statistics.color, valid_mask), geometry)
        for view, statistics, valid_mask, geometry in zip(
            capture.views, seen.statistics, seen.valid_masks, seen.geometry, strict=True
        )
    ]
    found = check_looks(capture, looks, out / "check")
    if found.better:
        remedy = "do that, or leave the check out with --no-check"
        raise input_error(capture.name, "mesh", found.warnings[-1], "a mesh in the cameras' frame", remedy)
    report.warnings += found.all_warnings


def _truth(view: CaptureView) -> dict[str, NDArray]:
    maps = view.source.read_maps(MAP_NAMES)
    if set(maps) != set(MAP_NAMES):
        expected = "a rendered capture"
        raise input_error(view.name, "ground truth", "none", expected, "leave --truth out")
    return {name: np.clip(values.astype(np.float32), 0, 1) for name, values in maps.items()}


TRUTH = GivenMaps("truth", lambda capture, _: [_truth(view) for view in capture.views])


def _predict(
    capture: Capture,
    seen: _Seen,
    traced: TracedGeometry,
    out: Path,
    checkpoint_path: Path,
    options: InferOptions,
    report: InferReport,
    tell: Progress,
) -> list[dict[str, NDArray]]:
    """Maps of all views: those on disk, and the rest predicted and written there."""
    from model.checkpoint import load_checkpoint
    from model.reconstruction.predict import PredictOptions, Predictor, capture_exposure, view_tensors

    with report.stage("predict"):
        checkpoint = load_checkpoint(checkpoint_path, options.device)
        report.exposure = capture_exposure(seen.statistics)
        predict_options = PredictOptions(
            options.precision, options.batch, options.is_filtered, options.device
        )
        predictor = Predictor(checkpoint, report.exposure, predict_options)
    report.precision = str(predictor.dtype).removeprefix("torch.")
    report.is_filtered = predictor.is_filtered
    if options.is_filtered and not predictor.is_filtered:
        report.notes.append("the checkpoint has no confidence networks: maps are not filtered")
    maps: list[dict[str, NDArray] | None] = [_stored(out, view) for view in capture.views]
    batches = _batches(capture, options.batch)
    pending = [batch for batch in batches if any(maps[index] is None for index in batch)]
    statistics = compute_statistics(
        seen.statistics,
        StatisticsOptions(visibility=VisibilityOptions(mode=options.visibility)),
        traced.scene if options.visibility == "trace" else None,
        only=[index for batch in pending for index in batch],
    )
    for batch in pending:
        tensors = []
        for index in batch:
            with report.stage("statistics"):
                gathered = next(statistics)
            tensors.append(view_tensors(capture.views[index].camera, seen.statistics[index], gathered))
        with report.stage("predict"):
            predicted = predictor.predict(tensors)
        with report.stage("write maps"):
            for index, view_maps in zip(batch, predicted, strict=True):
                if maps[index] is None:
                    write_bytes_atomically(_map_path(out, capture.views[index]), encode_view(view_maps))
                    maps[index] = _halves(view_maps)
        tell("predict", sum(m is not None for m in maps), len(maps))
    return [view_maps for view_maps in maps if view_maps is not None]


def _batches(capture: Capture, size: int) -> list[list[int]]:
    """Views of one size in a row, at most ``size`` of them. They do not depend on what was done before: in
    another company a view's maps would round differently."""
    batches: list[list[int]] = []
    for index, camera in enumerate(capture.cameras):
        last = capture.cameras[batches[-1][-1]] if batches else None
        fits = last is not None and (last.width_px, last.height_px) == (camera.width_px, camera.height_px)
        if fits and len(batches[-1]) < size:
            batches[-1].append(index)
        else:
            batches.append([index])
    return batches


def _halves(maps: dict[str, NDArray]) -> dict[str, NDArray]:
    """As they are stored, so that a continued run equals an uninterrupted one."""
    return {name: values.astype(np.float16) for name, values in maps.items()}


def _map_path(out: Path, view: CaptureView) -> Path:
    return out / "views" / f"{view.name}.exr"


def _stored(out: Path, view: CaptureView) -> dict[str, NDArray] | None:
    path = _map_path(out, view)
    if not path.is_file():
        return None
    try:
        maps = decode_view(path, MAP_NAMES)
    except InputError:
        return None  # damaged: predicted again
    shape = (view.camera.height_px, view.camera.width_px)
    return maps if all(values.shape[:2] == shape for values in maps.values()) else None


def _choose_size(capture: Capture, seen: _Seen, unwrap: UvReport, options: InferOptions) -> int:
    if options.atlas != "auto":
        return options.atlas
    return atlas_size(list(zip(capture.cameras, seen.geometry, strict=True)), unwrap.metres_per_side)


@contextmanager
def _atlas_memory(size: int, out: Path) -> Iterator[Atlas]:
    """Room for an atlas, in memory or in files that are removed afterwards."""
    if size <= MEMORY_ATLAS:
        yield empty_atlas(size)
        return
    with tempfile.TemporaryDirectory(prefix=".atlas-", dir=out) as folder:
        yield empty_atlas(size, Path(folder))


def _merge(
    capture: Capture,
    seen: _Seen,
    traced: TracedGeometry,
    maps: list[dict[str, NDArray]],
    oriented: tuple[Any, NDArray[np.float32]],
    atlas: Atlas,
    options: InferOptions,
    tell: Progress,
) -> None:
    mesh, sides = oriented
    views = [
        MapView(
            view.camera,
            view_maps,
            np.where(geometry.surface_mask > 0, geometry.depth_z_m, 0),
            geometry.face,
            view.name,
        )
        for view, view_maps, geometry in zip(capture.views, maps, seen.geometry, strict=True)
    ]
    merge_options = MergeOptions(visibility=VisibilityOptions(mode=options.visibility))
    scene = traced.scene if options.visibility == "trace" else None
    merger = MapMerger(views, merge_options, scene, smooth_regions(traced.mesh))
    surface = TexelSurface(mesh, face_normals(mesh, sides), atlas.size)
    merger.merge(surface, atlas, lambda done, total: tell("merge", done, total))


def _seen_share(atlas: Atlas) -> float:
    covered = seen = 0
    for top in range(0, atlas.size, 1024):
        covered += int((atlas.face[top : top + 1024] >= 0).sum())
        seen += int((atlas.count[top : top + 1024] > 0).sum())
    return seen / max(covered, 1)


def _export(capture: Capture, atlas: Atlas, out: Path, options: InferOptions, report: InferReport) -> None:
    from model.reconstruction.atlas_images import write_atlas_images
    from model.reconstruction.export import Reconstruction, write_asset, write_mitsuba_scene
    from model.reconstruction.gltf_export import write_glb

    reconstruction = Reconstruction(capture, capture.geometry.mesh, atlas, out / "atlas")
    write_atlas_images(out / "atlas", atlas, has_exr=options.has_exr)
    write_asset(out / "asset", reconstruction, f"{capture.name}-reconstruction").close()
    report.gltf_error = asdict(write_glb(out / f"{capture.name}.glb", reconstruction))
    write_mitsuba_scene(out / "mitsuba", reconstruction)

# SPDX-License-Identifier: MIT
"""The whole way from a capture to an asset: trace, statistics, prediction, level, merge, fill, export.

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
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import canonical_json, sha256_hex, write_bytes_atomically
from datagen.formats.capture import Capture, CaptureGeometry, CaptureView, ColorImage
from datagen.foundation.errors import input_error
from datagen.multiview.statistics import StatisticsView
from datagen.multiview.visibility import VisibilityOptions
from mitsuba_plugins.variant import select_variant
from model.reconstruction.atlas.atlas import MAP_NAMES, Atlas, empty_atlas
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.check.capture_check import Look, check_looks, view_warnings
from model.reconstruction.geometry.traced import (
    TracedGeometry,
    ViewGeometry,
    face_normals,
    seen_sides,
    smooth_regions,
)
from model.reconstruction.infer_options import GivenMaps, InferOptions, InferReport, Progress
from model.reconstruction.level.albedo_level import clipped_share, find_level
from model.reconstruction.level.radiance_cache import RadianceView
from model.reconstruction.merge.fill import atlas_size, fill_unseen
from model.reconstruction.merge.merger import MapMerger, MapView, MergeOptions
from model.reconstruction.unwrap.uv import UvReport, unwrapped

__all__ = ["MAP_NAMES", "GivenMaps", "InferOptions", "InferReport", "infer"]
MEMORY_ATLAS = 4096
"""Atlases up to this side are held in memory, larger ones in files beside the result while they are made."""


@dataclass
class Seen:
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
        seen = look(capture, traced, tell)
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
        # torch is not needed for given maps
        from model.reconstruction.predict.view_maps import predicted_maps

        maps = predicted_maps(capture, seen.statistics, traced, out, maps_from, options, report, tell)
        if options.is_leveled:
            with report.stage("level"):
                _level(capture, seen, traced, maps, report)
    with report.stage("unwrap"):
        sides = seen_sides(seen.geometry, report.num_triangles)
        mesh, unwrap = unwrapped(traced.mesh, options.jobs)
        report.unwrap = asdict(unwrap)
        report.atlas_size = _choose_size(capture, seen, unwrap, options)
        report.unwrap["texels_per_m"] = report.atlas_size / unwrap.metres_per_side
        report.notes += unwrap.notes
    with _atlas_memory(report.atlas_size, out) as atlas:
        with report.stage("merge"):
            seen.statistics.clear()  # images and normals are not needed any more; the merge is large
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


def look(capture: Capture, traced: TracedGeometry, tell: Progress) -> Seen:
    """Read and trace every view."""
    seen = Seen([], [], [])
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


def _check(capture: Capture, seen: Seen, out: Path, report: InferReport) -> None:
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


def _level(
    capture: Capture, seen: Seen, traced: TracedGeometry, maps: list[dict[str, NDArray]], report: InferReport
) -> None:
    """Correct the level of the views' diffuse albedo; what lies on disk stays as it was predicted."""
    views = [
        RadianceView(view.camera, statistics.color, geometry, valid_mask)
        for view, statistics, geometry, valid_mask in zip(
            capture.views, seen.statistics, seen.geometry, seen.valid_masks, strict=True
        )
    ]
    region_of_face = smooth_regions(traced.mesh)
    level = find_level(views, maps, traced, region_of_face, clipped_share(capture, seen.statistics))
    report.albedo_level = asdict(level.report)
    if not level.report.is_applied:
        report.notes.append(f"the level of diffuse albedo is the networks': {level.report.reason}")
        return
    for view_maps, geometry in zip(maps, seen.geometry, strict=True):
        region = np.where(geometry.face >= 0, region_of_face[np.maximum(geometry.face, 0)], -1)
        view_maps["diffuse_albedo"] = level.corrected(view_maps["diffuse_albedo"], region)


def _truth(view: CaptureView) -> dict[str, NDArray]:
    maps = view.source.read_maps(MAP_NAMES)
    if set(maps) != set(MAP_NAMES):
        expected = "a rendered capture"
        raise input_error(view.name, "ground truth", "none", expected, "leave --truth out")
    return {name: np.clip(values.astype(np.float32), 0, 1) for name, values in maps.items()}


TRUTH = GivenMaps("truth", lambda capture, _: [_truth(view) for view in capture.views])


def _choose_size(capture: Capture, seen: Seen, unwrap: UvReport, options: InferOptions) -> int:
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
    seen: Seen,
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
            view_maps.get("confidence"),
        )
        for view, view_maps, geometry in zip(capture.views, maps, seen.geometry, strict=True)
    ]
    merge_options = MergeOptions(
        visibility=VisibilityOptions(mode=options.visibility), weights=options.weights
    )
    scene = traced.scene if options.visibility == "trace" else None
    merger = MapMerger(views, merge_options, scene, smooth_regions(traced.mesh))
    views.clear()
    maps.clear()  # the merger holds what it needs of them
    seen.geometry.clear()
    surface = TexelSurface(mesh, face_normals(mesh, sides), atlas.size)
    merger.merge(surface, atlas, lambda done, total: tell("merge", done, total))


def _seen_share(atlas: Atlas) -> float:
    covered = seen = 0
    for top in range(0, atlas.size, 1024):
        covered += int((atlas.face[top : top + 1024] >= 0).sum())
        seen += int((atlas.count[top : top + 1024] > 0).sum())
    return seen / max(covered, 1)


def _export(capture: Capture, atlas: Atlas, out: Path, options: InferOptions, report: InferReport) -> None:
    from model.reconstruction.export.asset import Reconstruction, write_asset, write_mitsuba_scene
    from model.reconstruction.export.atlas_images import write_atlas_images
    from model.reconstruction.export.gltf import write_glb

    reconstruction = Reconstruction(capture, capture.geometry.mesh, atlas, out / "atlas")
    write_atlas_images(out / "atlas", atlas, has_exr=options.has_exr)
    write_asset(out / "asset", reconstruction, f"{capture.name}-reconstruction").close()
    report.gltf_error = asdict(write_glb(out / f"{capture.name}.glb", reconstruction))
    write_mitsuba_scene(out / "mitsuba", reconstruction)

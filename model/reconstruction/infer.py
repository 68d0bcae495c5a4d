# SPDX-License-Identifier: MIT
"""The pipeline from a capture to an asset: mend the mesh; trace, check and complete the views (equalise
exposures, estimate clipped pixels); predict maps, correct them by the recorded light and merge them in an
atlas; fill in unobserved texels; balance the lights to the photographs; export.

OUT/state.json      hash of checkpoint, views, geometry and options; a run resumes only with an equal hash
OUT/views/          predicted maps, one EXR per view, which a resumed run reads
OUT/atlas/          the merged maps as PNG and EXR, and mask.png (255 observed, 128 filled in, 0 no surface)
OUT/asset/          the asset package; also exported as OUT/NAME.glb, OUT/mitsuba/scene.xml and OUT/NAME.usdz
OUT/check/          findings and contact sheets of the check of the mesh against the photographs
OUT/report.html     the report as a page
OUT/report.json     unwrap, size, coverage, warnings, seconds and memory by stage, lights

Every file appears whole or not at all, ``report.json`` last. A stage returns only the data that later stages
need, so photographs are freed before the maps are packed, maps before they are merged, and packed maps before
the atlas is filled.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import canonical_json, sha256_hex, write_bytes_atomically
from datagen.formats.capture import Capture, CaptureGeometry
from datagen.foundation.errors import input_error
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import TracedGeometry, face_normals, seen_sides, smooth_regions
from datagen.geometry.views import TracedCapture, trace_capture, visible_faces
from datagen.multiview.visibility import VisibilityOptions
from mitsuba_plugins.variant import select_variant
from model.reconstruction.albedo_level import leveled
from model.reconstruction.atlas.atlas import Atlas, empty_atlas, put_confidence
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.check.capture_check import check_traced, view_warnings
from model.reconstruction.export.asset import write_asset
from model.reconstruction.export.atlas_images import write_atlas_images
from model.reconstruction.export.balance import balanced
from model.reconstruction.export.gltf import write_glb
from model.reconstruction.export.mitsuba_scene import write_mitsuba_scene
from model.reconstruction.export.slots import Reconstruction
from model.reconstruction.export.usd import require_usd, write_usdz
from model.reconstruction.infer_options import InferOptions, InferReport, Progress
from model.reconstruction.light.map_stage import lit
from model.reconstruction.merge.fill import fill_unseen
from model.reconstruction.merge.merger import MapMerger, MapView, MergeOptions, map_views
from model.reconstruction.mesh.smoothing import mended_mesh
from model.reconstruction.poses import mended
from model.reconstruction.radiometry.completed import completed
from model.reconstruction.report_page import report_html
from model.reconstruction.stages import Estimate, Found, MapSource, MapStage, Run
from model.reconstruction.unwrap.repacked import PixelDensity, atlas_size, pixel_density, repacked
from model.reconstruction.unwrap.uv import unwrapped

__all__ = ["InferOptions", "InferReport", "infer"]
MEMORY_ATLAS = 4096
"""Maximum side in texels of an atlas in memory; larger ones are in temporary files in the output folder."""
MAX_NAME = 185
"""Maximum length of a capture's name in the id of its asset, which is at most 200 characters long."""


@dataclass(frozen=True)
class FinalViews:
    """The views with their final maps.

    ``sides`` (M,): the side of each triangle that most pixels show, 1 for the front, -1 for the back.
    ``density``: pixels per metre of the surface in the views. ``can_be_seen`` (M,): mask of the triangles
    visible in a view or from a surface visible in a view. ``found``: results other than maps.
    """

    views: list[MapView]
    geometry: TracedGeometry
    sides: NDArray[np.float32]
    density: PixelDensity
    can_be_seen: NDArray[np.bool_]
    found: Found


def infer(
    capture: Capture,
    out: Path,
    source: MapSource,
    options: InferOptions | None = None,
    progress: Progress | None = None,
) -> InferReport:
    """Make an asset of ``capture`` in the folder ``out`` from the maps of ``source`` (``predict.sources``).

    Raises :class:`InputError` if the input is invalid, no view shows the mesh, or ``out`` contains the work
    of another capture, source or options.
    """
    report = InferReport(capture.name, len(capture.views), len(capture.geometry.mesh.faces))
    run = Run(out, options or InferOptions(), report, progress or (lambda stage, done, total: None))
    try:
        if run.options.has_usd:
            require_usd()
        source.prepare(run.options)  # raises before the capture is read and ``out`` is claimed
        select_variant()
        report.notes += capture.notes
        if run.options.mends_mesh:
            capture = mended_mesh(capture, run)
        with ExitStack() as files:
            atlas, mesh, found = _merged(capture, source, run, files)
            with run.stage("fill") as advance:
                fill_unseen(atlas, mesh, advance)
            capture = replace(capture, geometry=CaptureGeometry(mesh, capture.geometry.parts))
            _export(Reconstruction(capture, mesh, atlas, out / "atlas", found.lights), found, run)
        write_bytes_atomically(out / "report.html", report_html(report, found.pictures).encode())
        write_bytes_atomically(out / "report.json", canonical_json(asdict(report)))
    except OSError as error:
        if error.filename is None and error.errno:  # the error of a full disk does not name the file
            raise OSError(error.errno, error.strerror, str(out)) from error
        raise
    return report


def map_stages(source: MapSource, options: InferOptions) -> list[MapStage]:
    """The stages between prediction and merge, in order; none for maps that are not predicted."""
    if not source.is_predicted:
        return []
    stages: list[MapStage] = [leveled] if options.is_leveled else []
    return stages if options.materials == "network" else [*stages, lit]


def _claim(traced: TracedCapture, source: MapSource, run: Run) -> None:
    """Record the run's inputs in ``run.out``. Raises :class:`InputError` if others are recorded there."""
    mesh, options = traced.capture.geometry.mesh, run.options
    views = [
        [v.name, v.camera.width_px, v.camera.height_px, v.camera.fx_px, v.camera.fy_px, v.camera.cx_px,
         v.camera.cy_px, v.camera.world_from_camera.tolist(), sha256_hex(v.color.tobytes())]
        for v in traced.views
    ]  # fmt: skip
    work = {
        "name": traced.capture.name,
        "geometry": sha256_hex(mesh.positions.tobytes() + mesh.faces.tobytes()),
        "views": views,
        "weights": source.identity,
        "precision": options.precision,
        "visibility": options.visibility,
        "is_filtered": options.is_filtered,
        "is_evened": options.is_evened,
        "mends_poses": options.mends_poses,
    }
    state = canonical_json({"format": "scene-materials/inference", "work": sha256_hex(canonical_json(work))})
    path = run.out / "state.json"
    if path.is_file() and path.read_bytes() != state:
        expected = "the capture, checkpoint and options that it was started with"
        raise input_error(run.out, "state.json", "other work", expected, "choose another --out or remove it")
    (run.out / "views").mkdir(parents=True, exist_ok=True)
    write_bytes_atomically(path, state)
    (run.out / "report.json").unlink(missing_ok=True)  # it may be of a run with other options


def _final_views(capture: Capture, source: MapSource, run: Run) -> FinalViews:
    """Trace, check and complete the capture, predict its maps, and correct them."""
    with run.stage("trace") as advance:
        traced = trace_capture(capture, advance)
    _claim(traced, source, run)
    _check(traced, run)
    doubt_at = None
    if source.is_predicted:
        traced, doubt_at = completed(traced, run)
        traced = mended(traced, run) if run.options.mends_poses else traced
    estimate = Estimate(source.maps(traced, run), doubt_at)
    for stage in map_stages(source, run.options):
        estimate = stage(traced, estimate, run)
    sides = seen_sides([view.geometry for view in traced.views], run.report.num_triangles)
    density = pixel_density((view.camera, view.geometry) for view in traced.views)
    views = map_views(traced.views, estimate.maps)
    return FinalViews(views, traced.geometry, sides, density, visible_faces(traced), estimate.found)


def _check(traced: TracedCapture, run: Run) -> None:
    """Report faults of the capture. Raises :class:`InputError` if the mesh fits the photographs better in
    another coordinate frame, such as one with another up axis.
    """
    if not run.options.is_checked:
        for view in traced.views:
            run.report.warnings += view_warnings(view)
        return
    with run.stage("check") as advance:
        found = check_traced(traced, run.out / "check", advance)
    if found.better:
        remedy = f"use {found.better}, or skip the check with --no-check"
        got, expected = found.warnings[-1], "a mesh in the cameras' frame"
        raise input_error(traced.capture.name, "mesh", got, expected, remedy)
    run.report.warnings += found.all_warnings


def _packed(final: FinalViews, run: Run) -> tuple[MapMerger, Mesh, TexelSurface]:
    """Unwrap the mesh, and pack the views' maps for the merge; return the mesh and its texels too."""
    report, options = run.report, run.options
    with run.stage("unwrap") as advance:
        mesh, unwrap = unwrapped(final.geometry.mesh, advance)
        if unwrap.source != "mesh" or not options.keeps_uvs:
            mesh, unwrap = repacked(mesh, unwrap, final.density)
        size = options.atlas
        if size == "auto":
            size = atlas_size(final.density.footprint_m, unwrap.metres_per_side)
        report.atlas_size = size
        report.unwrap = {**asdict(unwrap), "texels_per_m": size / unwrap.metres_per_side}
        report.notes += unwrap.notes
    run.tell("pack", 0, 1)
    with report.stage("merge"):
        merge_options = MergeOptions(
            visibility=VisibilityOptions(mode=options.visibility), weights=options.weights
        )
        scene = final.geometry.scene if options.visibility == "trace" else None
        merger = MapMerger(final.views, merge_options, scene, smooth_regions(final.geometry.mesh))
        surface = TexelSurface(mesh, face_normals(mesh, final.sides), size)
    run.tell("pack", 1, 1)
    return merger, mesh, surface


def _merged(capture: Capture, source: MapSource, run: Run, files: ExitStack) -> tuple[Atlas, Mesh, Found]:
    """Merge the maps in an atlas, in memory or in files that exist until ``files`` is closed.

    Also return the unwrapped mesh, and the results of earlier stages other than maps.
    """
    final = _final_views(capture, source, run)
    merger, mesh, surface = _packed(final, run)
    can_be_seen, found = final.can_be_seen, final.found
    del final  # frees the maps
    memory = _atlas_memory(surface.size, run.out, has_confidence=found.confidence_at is not None)
    atlas = files.enter_context(memory)
    with run.stage("merge") as advance:
        merger.merge(surface, atlas, advance)
        if found.confidence_at is not None:
            put_confidence(atlas, surface, found.confidence_at)
        run.report.seen_share, run.report.seen_of_visible = _seen_share(atlas, can_be_seen)
    return atlas, mesh, found


@contextmanager
def _atlas_memory(size: int, out: Path, *, has_confidence: bool) -> Iterator[Atlas]:
    """An empty atlas, in memory or, above :data:`MEMORY_ATLAS`, in temporary files."""
    if size <= MEMORY_ATLAS:
        yield empty_atlas(size, has_confidence=has_confidence)
        return
    for left in out.glob(".atlas-*"):  # by a run that was killed
        shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=".atlas-", dir=out) as folder:
        yield empty_atlas(size, Path(folder), has_confidence=has_confidence)


def _seen_share(atlas: Atlas, can_be_seen: NDArray[np.bool_]) -> tuple[float, float]:
    """Observed share of the texels on the surface, and of those on visible triangles."""
    covered = visible = seen = 0
    for top in range(0, atlas.size, 1024):
        face = atlas.face[top : top + 1024]
        is_seen = atlas.count[top : top + 1024] > 0
        covered += int((face >= 0).sum())
        visible += int(((face >= 0) & (is_seen | can_be_seen[np.maximum(face, 0)])).sum())
        seen += int(is_seen.sum())
    return seen / max(covered, 1), seen / max(visible, 1)


def _balanced(reconstruction: Reconstruction, found: Found, run: Run) -> Reconstruction:
    """Balance the lights to the photographed radiance, and add their gains to the report."""
    if found.samples is None:
        return reconstruction
    with run.stage("lights"):
        balance = balanced(reconstruction, found.samples)
    if balance is None:
        return reconstruction
    run.report.light["balance"] = {"loss_before": balance.loss_before, "loss_after": balance.loss_after}
    for row in run.report.light["lights"]:
        row["gain"] = list(balance.gains[row["slot"]])
    return replace(reconstruction, lights=balance.lights)


def _export(reconstruction: Reconstruction, found: Found, run: Run) -> None:
    out, name = run.out, reconstruction.capture.name
    with run.stage("images") as advance:
        write_atlas_images(
            reconstruction.images, reconstruction.atlas, has_exr=run.options.has_exr, progress=advance
        )
    reconstruction = _balanced(reconstruction, found, run)
    with run.stage("export") as advance:
        asset_id = f"{name[:MAX_NAME]}-reconstruction"
        write_asset(out / "asset", reconstruction, asset_id).close()
        advance(1, 4)
        glb = out / f"{name}.glb"
        error = write_glb(glb, reconstruction, has_punctual=run.options.has_punctual)
        advance(2, 4)
        write_mitsuba_scene(out / "mitsuba", reconstruction)
        advance(3, 4)
        usdz = out / f"{name}.usdz"
        if run.options.has_usd:
            write_usdz(usdz, reconstruction)
        else:
            usdz.unlink(missing_ok=True)  # it would show earlier maps
    run.report.gltf_error = asdict(error)

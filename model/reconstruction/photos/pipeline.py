# SPDX-License-Identifier: MIT
"""``materials photos``: photographs → cameras and mesh → asset → turntable, in one folder.

OUT/photos.json     record of the photographs or capture, options and checkpoint
OUT/colmap/         cameras and mesh from COLMAP, unless the input has cameras (``colmap_run``)
OUT/...             output of ``materials infer``
OUT/turntable.gif   animation along a path through the room under the recovered lights
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from datagen.formats.base import canonical_json, sha256_hex, write_bytes_atomically
from datagen.formats.capture import Capture
from datagen.foundation.errors import InputError, Problem, input_error
from datagen.foundation.meshes.mesh import Mesh
from model.reconstruction.captures.brackets import BracketSource
from model.reconstruction.captures.mesh_file import load_mesh
from model.reconstruction.captures.photograph_files import (
    HEIC_SUFFIXES,
    KNOWN_SUFFIXES,
    can_read,
    is_raw,
    unread_problems,
)
from model.reconstruction.captures.photographs import PhotographSource
from model.reconstruction.captures.read import has_cameras, read_capture, refuse_unused
from model.reconstruction.infer import infer
from model.reconstruction.infer_options import InferReport, Progress
from model.reconstruction.photos.colmap_run import ColmapRun
from model.reconstruction.photos.options import PhotosOptions
from model.reconstruction.render.relight import RelightOptions
from model.reconstruction.render.turntable import TurntableOptions, write_turntable
from model.reconstruction.stages import MapSource

MIN_PHOTOGRAPHS = 3
TURNTABLE = "turntable.gif"


@dataclass(frozen=True)
class PhotosResult:
    """``report`` of the inference, None if the asset existed before, and path of the ``turntable``."""

    report: InferReport | None
    turntable: Path


def photographs_in(folder: Path) -> list[Path]:
    """List the photographs in a folder, sorted by name.

    Raises :class:`InputError` for fewer than three, and for raw, HEIC and other unsupported formats.
    """
    if not folder.is_dir():
        raise input_error(folder, "", "no such folder", "a folder of photographs", "check the path")
    found = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in KNOWN_SUFFIXES]
    for file in found:
        if is_raw(file) or file.suffix.lower() in HEIC_SUFFIXES:  # Debian's COLMAP reads neither
            got = "a raw photograph" if is_raw(file) else "HEIC"
            remedy = (
                "convert all with equal settings to JPEG in another folder, or give a capture with cameras"
            )
            raise input_error(folder, file.name, got, "photographs that COLMAP reads", remedy)
    unread = [file for file in found if not can_read(file)]
    if unread:
        raise InputError(*unread_problems(folder, unread))
    if len(found) < MIN_PHOTOGRAPHS:
        expected = f"at least {MIN_PHOTOGRAPHS} overlapping photographs, or a capture with cameras"
        raise input_error(folder, "photographs", len(found), expected, "check the path, or add photographs")
    return found


def make_asset(
    folder: Path,
    out: Path,
    source: MapSource,
    options: PhotosOptions,
    tell: Progress,
    echo: Callable[[str], None],
) -> PhotosResult:
    """Make an asset in ``out`` from the photographs or capture ``folder``, without repeating finished steps.

    Raises :class:`InputError` if the input is invalid, a program is missing or fails, or ``out`` contains the
    results of other photographs.
    """
    given = None
    if has_cameras(folder):
        refuse_unused(folder, options.reading)
        given = read_capture(folder, options.reading)
    photographs = [] if given else photographs_in(folder)
    run = ColmapRun(options.program, folder, photographs, out / "colmap", echo)
    if not given and not run.has_cameras and shutil.which(options.program) is None:
        echo(run.commands())
        remedy = "install it and run the same command again, or run the commands above first"
        raise InputError(Problem(options.program, "", "no such program", "COLMAP 3.7 or later", remedy))
    own_mesh = options.reading.mesh
    content = _content(given) if given else _of_mesh(load_mesh(own_mesh)) if own_mesh else []
    _claim(out, folder, photographs, [repr(options), source.identity, *content])
    inference = options.inference
    capture = given
    if not capture:
        cameras = run.cameras()
        reading = replace(options.reading, mesh=own_mesh or run.mesh(), images=folder)
        if reading.up == "auto":
            reading = replace(reading, up="cameras")
        if own_mesh is None:
            # COLMAP's surface is in the cameras' frame, but lacks most edges of the room, which the check
            # compares; sparse points are accurate, and the wide triangles between them are not noise
            inference = replace(inference, is_checked=False, mends_mesh=not run.has_sparse_mesh)
        capture = read_capture(cameras, reading)
    report = None
    if not (out / "report.json").is_file():
        registered = len(capture.views)
        if registered < len(photographs):
            echo(f"COLMAP found the poses of {registered} of {len(photographs)} photographs")
        report = infer(replace(capture, name="room"), out, source, inference, tell)
    turntable = out / TURNTABLE
    if not turntable.is_file():
        relight = RelightOptions(samples=options.samples)
        write_turntable(
            out / "asset", turntable, TurntableOptions(frames=options.frames, render=relight), tell, echo
        )
    return PhotosResult(report, turntable)


def _content(capture: Capture) -> list[str]:
    """Describe the views, photographs and geometry of a capture, to recognise changes."""
    files: list[Path] = []
    for view in capture.views:
        match view.source:
            case PhotographSource():
                files.append(view.source.path)
            case BracketSource():
                files += [photograph.path for photograph in view.source.photographs]
    stamps = [f"{file.stat().st_size} {file.stat().st_mtime_ns}" for file in files]
    return [*(repr(view) for view in capture.views), *stamps, *_of_mesh(capture.geometry.mesh)]


def _of_mesh(mesh: Mesh) -> list[str]:
    return [sha256_hex(mesh.positions.tobytes() + mesh.faces.tobytes())]


def _claim(out: Path, folder: Path, photographs: list[Path], settings: list[str]) -> None:
    """Assign ``out`` to ``photographs``; if ``settings`` have changed, remove the report and the turntable.

    Raises :class:`InputError` if ``out`` is assigned to other photographs.
    """
    files = [[file.name, file.stat().st_size] for file in photographs]
    work: dict[str, Any] = {
        "format": "scene-materials/photos",
        "folder": folder.resolve().name,
        "files": files,
    }
    state = canonical_json({**work, "options": sha256_hex(canonical_json(settings))})
    path = out / "photos.json"
    before = path.read_bytes() if path.is_file() else None
    if before is not None and before != state:
        import json

        if {key: json.loads(before).get(key) for key in work} != work:
            expected = "the photographs that it was started with"
            raise input_error(out, "photos.json", "other work", expected, "choose another --out or remove it")
        for name in ("report.json", TURNTABLE):
            (out / name).unlink(missing_ok=True)
    out.mkdir(parents=True, exist_ok=True)
    write_bytes_atomically(path, state)

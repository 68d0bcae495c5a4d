# SPDX-License-Identifier: MIT
"""Detects the format of a capture and reads it.

A calibration format is an entry of ``FORMATS`` and a module with two functions: ``find(path)`` returns the
file or folder to read, or None; ``read(found, images, budget)`` returns a :class:`Calibration`. Photographs
also require a mesh file; ``CaptureOptions`` defines the axes and units of cameras and mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from datagen.formats.base import problems_of, read_json
from datagen.formats.capture import (
    CAPTURE_FILE,
    Capture,
    CaptureFile,
    CaptureGeometry,
    CaptureView,
    GeometryPart,
    MeshRecord,
    PhotographRecord,
)
from datagen.formats.configuration import ViewCamera
from datagen.foundation.axes import affine
from datagen.foundation.budget import Budget
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.naming import slug, unique
from datagen.foundation.paths import fault_of
from model.reconstruction.captures import (
    bundler,
    colmap,
    metashape,
    mitsuba_sensors,
    openmvg,
    realitycapture,
    transforms_json,
)
from model.reconstruction.captures.brackets import with_brackets
from model.reconstruction.captures.frames import (
    estimated_unit,
    estimated_up,
    level_rotation,
    up_of,
    z_up_from,
)
from model.reconstruction.captures.mesh_file import find_mesh, load_mesh, sound_mesh
from model.reconstruction.captures.options import Axis, CaptureOptions
from model.reconstruction.captures.package import is_package, read_package
from model.reconstruction.captures.photographs import PhotographSource, exposure_scales, upright_pose
from model.reconstruction.captures.posed import Calibration, ImageFinder
from model.reconstruction.captures.rendered import library_of, read_shard

Finder = Callable[[Path], Path | None]
Reader = Callable[[Path, Path | None, Budget], Calibration]
MIN_UNIT_M, MAX_UNIT_M = 1e-6, 1e6
"""Bounds of the unit [m]; beyond them, single-precision geometry overflows or vanishes."""
FORMATS: dict[str, tuple[Finder, Reader]] = {
    "OpenMVG": (openmvg.find, openmvg.read),
    "transforms.json": (transforms_json.find, transforms_json.read),
    "Metashape": (metashape.find, metashape.read),
    "RealityCapture CSV": (realitycapture.find_csv, realitycapture.read_csv),
    "COLMAP": (colmap.find, colmap.read),
    "Bundler": (bundler.find, bundler.read),
    "Mitsuba scene": (mitsuba_sensors.find, mitsuba_sensors.read),
    "RealityCapture XMP": (realitycapture.find_xmp, realitycapture.read_xmp),
}
"""Finder and reader of each calibration format, in the order in which they are tried."""


_Kind = Literal["a shard", "capture.json", "an environment package", "cameras with photographs"]
_UNUSED: dict[_Kind, tuple[str, ...]] = {
    "a shard": ("images", "mesh", "mesh_up", "up", "unit_m", "encoding", "exposure"),
    "capture.json": ("library", "mesh_up", "up", "unit_m", "encoding"),
    "an environment package": ("library", "mesh", "mesh_up", "up", "unit_m"),
    "cameras with photographs": ("library",),
}
"""Options that do not apply, by kind of capture, since the capture itself determines them."""


def refuse_unused(path: Path, options: CaptureOptions) -> None:
    """Raise :class:`InputError` for options that are set, although they do not apply to ``path``."""
    kind = _kind_of(path) or "cameras with photographs"
    defaults = CaptureOptions()
    flags = {name: f"--{name.removesuffix('_m').replace('_', '-')}" for name in _UNUSED[kind]}
    raise_problems(
        [
            Problem(path, flag, str(getattr(options, name)), f"no such option for {kind}", "leave it out")
            for name, flag in flags.items()
            if getattr(options, name) != getattr(defaults, name)
        ]
    )


def _kind_of(path: Path) -> _Kind | None:
    """Return the key of ``_UNUSED`` for a capture in a format of this project, else None."""
    if path.suffix == ".tar" or (path / "shards").is_dir():
        return "a shard"
    if (path / CAPTURE_FILE).is_file() or (path.is_file() and path.name.endswith(CAPTURE_FILE)):
        return "capture.json"
    return "an environment package" if is_package(path) else None


def read_capture(path: Path, options: CaptureOptions | None = None) -> Capture:
    """Read the capture at ``path``. Raises :class:`InputError` with its faults, or if its format is unknown.

    Known formats are a shard (.tar) or a dataset folder with one shard, ``capture.json`` or its folder, an
    environment package with cameras, and those of ``FORMATS``.
    """
    options = options or CaptureOptions()
    budget = Budget(path, options.limits)
    kind = _kind_of(path)
    if kind == "a shard":
        return _shrunk(_read_rendered(path, options), options.max_width_px)
    if kind == "capture.json":
        file = path if path.is_file() else path / CAPTURE_FILE
        record = read_json(CaptureFile, file)
        budget.spend("frames", len(record.photographs), "photographs")
        given = [folder.resolve() for folder in (file.parent, options.images, options.mesh) if folder]
        _check_paths(record, file, given)
        if options.mesh and (file.parent / record.mesh.file).resolve() != options.mesh.resolve():
            expected = f"{options.mesh}, which --mesh names"
            raise input_error(
                file, "mesh.file", record.mesh.file, expected, "correct it, or leave --mesh out"
            )
        return open_capture(record, file.parent, options.max_width_px, budget)
    if kind == "an environment package":
        capture = read_package(path, options.images, options.encoding, budget, options.exposure)
        return _shrunk(capture, options.max_width_px)
    record, notes, mesh = _calibrated(path, options, budget)
    capture = open_capture(record, Path(), options.max_width_px, budget, mesh)
    return replace(capture, notes=notes + capture.notes)


def _check_paths(record: CaptureFile, file: Path, given: Sequence[Path]) -> None:
    """Raise :class:`InputError` for files outside the ``given`` folders, since captures are untrusted."""
    problems = []
    for field, name in [
        *((f"photographs[{k}].image", p.image) for k, p in enumerate(record.photographs)),
        ("mesh.file", record.mesh.file),
    ]:
        _, fault = fault_of(file.parent, name, given)
        if fault:
            remedy = "copy it there, or name its folder with --images, or the mesh with --mesh"
            got = f"{name[:200]!r} ({fault})"
            problems.append(Problem(file, field, got, "a file in the capture's folder", remedy))
    raise_problems(problems)


def _read_rendered(path: Path, options: CaptureOptions) -> Capture:
    if path.is_dir():
        shards = sorted((path / "shards").glob("*.tar"))
        if len(shards) != 1:
            expected = "one shard, since a capture is one configuration"
            raise input_error(path / "shards", "shards", len(shards), expected, "name the shard itself")
        path = shards[0]
    if not path.is_file():
        raise input_error(path, "", "no such file", "a shard", "check the path")
    return read_shard(path, library_of(path, options.library))


def _calibrated(
    path: Path, options: CaptureOptions, budget: Budget
) -> tuple[CaptureFile, tuple[str, ...], Mesh | None]:
    """Make the content of ``capture.json``, with absolute paths, for calibrated photographs at ``path``; also
    return notes for the user, and the mesh in its own frame if the unit was estimated from it.
    """
    format_name, found = _format_of(path)
    try:
        calibration = FORMATS[format_name][1](found, options.images, budget)
    except ValidationError as error:  # invalid cameras or lenses
        raise InputError(*problems_of(found, error)) from None
    if options.images is None and calibration.folder.is_symlink():
        got = f"a link to {calibration.folder.resolve()}"
        raise input_error(calibration.folder, "", got, "a folder", "name it with --images")
    mesh = options.mesh.resolve() if options.mesh is not None else find_mesh(path)
    where = found.relative_to(path).as_posix() if found != path and found.is_relative_to(path) else found.name
    kind = "" if where == format_name else f" ({format_name})"
    notes = [f"{len(calibration.images)} cameras in {where}{kind}", *calibration.notes]
    finder = ImageFinder(calibration.folder)
    files = [finder.find(image.file) for image in calibration.images]
    rotation, up_notes = _rotation(options.up, [image.camera for image in calibration.images], files)
    notes += up_notes
    loaded, unit_m = None, options.unit_m
    if unit_m is None:
        loaded = load_mesh(mesh, budget)
        size = np.ptp(loaded.positions, axis=0) if len(loaded.positions) else np.zeros(3)
        unit_m, note = estimated_unit(float(np.linalg.norm(size)))
        notes.append(note)
    elif not MIN_UNIT_M <= unit_m <= MAX_UNIT_M:
        expected = f"metres per unit, in [{MIN_UNIT_M:g}, {MAX_UNIT_M:g}]"
        raise input_error("--unit", "", unit_m, expected, "correct it")
    names: set[str] = set()
    photographs, problems = [], []
    missing: list[str] = []
    for image, file in zip(calibration.images, files, strict=True):
        if file is None:
            missing.append(image.file)
            continue
        root = calibration.folder.resolve()
        below = file.relative_to(root) if file.is_relative_to(root) else Path(file.name)
        name = unique(slug(below.with_suffix("").as_posix()), names)
        names.add(name)
        pose = affine(
            rotation @ image.camera.world_from_camera[:3, :3], unit_m * rotation @ image.camera.position_m
        )
        try:
            camera = ViewCamera.from_camera(name, replace(image.camera, world_from_camera=pose))
        except ValidationError as error:
            problems += problems_of(f"{found}: {image.file}", error)
            continue
        photographs.append(PhotographRecord(camera=camera, image=str(file), distortion=image.distortion))
    problems += finder.absent(path, missing, "name its folder with --images")
    raise_problems(problems)
    scales = exposure_scales([Path(photograph.image) for photograph in photographs], options.exposure)
    mesh_rotation = rotation if options.mesh_up == "same" else z_up_from(options.mesh_up)
    matrix = affine(unit_m * mesh_rotation)
    rows = tuple(tuple(float(v) for v in row) for row in matrix)
    record = CaptureFile(
        name=slug(path.resolve().name.removesuffix(".json") or "capture"),
        encoding=options.encoding,
        photographs=tuple(
            photograph.model_copy(update={"exposure_scale": scale})
            for photograph, scale in zip(photographs, scales, strict=True)
        ),
        mesh=MeshRecord(file=str(mesh), world_from_mesh=rows),  # type: ignore[arg-type]
    )
    return record, tuple(notes), loaded


def _rotation(
    up: Literal["auto", "cameras", Axis], cameras: Sequence[Camera], files: Sequence[Path | None]
) -> tuple[NDArray[np.float64], list[str]]:
    """Return the rotation (3, 3) that maps ``up`` to +z, and notes if it is estimated from the poses of
    ``cameras`` with their photographs ``files`` turned upright.
    """
    if up != "auto" and up != "cameras":
        return z_up_from(up), []
    upright = [
        replace(camera, world_from_camera=upright_pose(camera, file)) if file else camera
        for camera, file in zip(cameras, files, strict=True)
    ]
    if up == "cameras":
        return level_rotation(upright), []
    axis, note = estimated_up(upright)
    return z_up_from(axis), [note]


def has_cameras(path: Path) -> bool:
    """Return whether ``path`` has a known capture format; its content is not checked."""
    return _kind_of(path) is not None or any(find(path) is not None for find, _ in FORMATS.values())


def _format_of(path: Path) -> tuple[str, Path]:
    for name, (find, _) in FORMATS.items():
        found = find(path)
        if found is not None:
            return name, found
    expected = f"a shard, capture.json, an environment package or {', '.join(FORMATS)}"
    got = "no known format" if path.exists() else "no such file or folder"
    raise input_error(path, "", got, expected, "check the path")


def open_capture(
    record: CaptureFile, base: Path, max_width_px: int, budget: Budget, mesh_in_its_frame: Mesh | None = None
) -> Capture:
    """Open the capture of ``record``, with paths relative to ``base``; read the mesh unless it is passed.

    Raises :class:`InputError` with all missing photographs, or for an unusable mesh.
    """
    problems = [
        Problem(base / p.image, "", "no such file", "the view's image", "correct capture.json")
        for p in record.photographs
        if not (base / p.image).is_file()
    ]
    raise_problems(problems)
    views = []
    for photograph in record.photographs:
        calibrated = photograph.camera.camera()
        decoding = photograph.distortion, record.encoding, photograph.exposure_scale
        source = PhotographSource(base / photograph.image, calibrated, *decoding)
        views.append(CaptureView(photograph.camera.name, calibrated, source))
    file = base / record.mesh.file
    raw = load_mesh(file, budget) if mesh_in_its_frame is None else mesh_in_its_frame
    mesh, notes = sound_mesh(raw, np.asarray(record.mesh.world_from_mesh), file)
    geometry = CaptureGeometry(mesh, (GeometryPart("mesh", 0, len(mesh.faces)),))
    merged, bracket_notes = with_brackets(views)
    mesh_up = up_of(record.mesh.world_from_mesh)
    capture = Capture(record.name, merged, geometry, record.lights, notes + bracket_notes, mesh_up)
    return _shrunk(capture, max_width_px)


def _shrunk(capture: Capture, max_width_px: int) -> Capture:
    views = tuple(replace(v, camera=shrunk_camera(v.camera, max_width_px)) for v in capture.views)
    return replace(capture, views=views)


def shrunk_camera(camera: Camera, max_width_px: int) -> Camera:
    """Scale the camera down to a longer side of at most ``max_width_px``, with sides in whole pixels."""
    longer = max(camera.width_px, camera.height_px)
    if longer <= max_width_px:
        return camera
    width, height = (
        max(1, round(side * max_width_px / longer)) for side in (camera.width_px, camera.height_px)
    )
    return camera.scaled(width, height)

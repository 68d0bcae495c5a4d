# SPDX-License-Identifier: MIT
"""Reads captures of every form: ``capture.json``, own shards, COLMAP, transforms.json, Mitsuba scenes.

:func:`read_capture` looks at what it is given and calls the reader of that form. Photographs come with a
mesh file in the frame of the cameras; ``CaptureOptions`` says how either differs from metres with Z up.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from datagen.cameras import Camera
from datagen.errors import InputError, Problem, input_error
from datagen.formats.base import canonical_json, read_json, write_bytes_atomically
from datagen.formats.capture import (
    CAPTURE_FILE,
    Capture,
    CaptureFile,
    CaptureGeometry,
    CaptureView,
    Encoding,
    GeometryPart,
    MeshRecord,
    PhotographRecord,
)
from datagen.formats.configuration import ViewCamera
from datagen.importers.common import asset_from_source, slug, unique
from datagen.meshes import Mesh, inspect_mesh, read_ply, without_degenerate
from model.reconstruction.colmap import PosedImage, is_colmap_model, read_colmap
from model.reconstruction.photographs import PhotographSource, relative_exposure
from model.reconstruction.transforms_json import read_transforms

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".gltf")
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff")
DEFAULT_MAX_WIDTH_PX = 640


@dataclass(frozen=True)
class CaptureOptions:
    """How to read a capture. ``library`` and nothing else concerns rendered ones.

    ``up`` is the up axis of the cameras' world, ``unit_m`` its unit; ``mesh_up`` that of the mesh where it
    differs. Views wider than ``max_width_px`` are shrunk: the networks learn from views of 640 pixels.
    ``exposure`` "exif" evens out exposures that the cameras recorded.
    """

    mesh: Path | None = None
    images: Path | None = None
    up: Literal["y", "z"] = "z"
    unit_m: float = 1.0
    mesh_up: Literal["same", "y", "z"] = "same"
    encoding: Encoding = "auto"
    exposure: Literal["common", "exif"] = "common"
    max_width_px: int = DEFAULT_MAX_WIDTH_PX
    library: tuple[Path, ...] = ()


def read_capture(path: Path, options: CaptureOptions | None = None) -> Capture:
    """The capture at ``path``. Raises :class:`InputError` where nothing known lies there, or with its faults.

    Known: a shard (.tar) or a dataset folder of one shard; ``capture.json`` or its folder;
    ``transforms.json`` or its folder; a folder with a COLMAP model in it, in ``sparse`` or in ``sparse/0``;
    a Mitsuba scene (.xml).
    """
    options = options or CaptureOptions()
    if path.suffix == ".tar" or (path / "shards").is_dir():
        return _shrunk(_read_rendered(path, options), options.max_width_px)
    if (path / CAPTURE_FILE).is_file() or (path.is_file() and path.name.endswith(CAPTURE_FILE)):
        file = path if path.is_file() else path / CAPTURE_FILE
        return open_capture(read_json(CaptureFile, file), file.parent, options.max_width_px)
    record, base = capture_file(path, options)
    return open_capture(record, base, options.max_width_px)


def _read_rendered(path: Path, options: CaptureOptions) -> Capture:
    from model.reconstruction.rendered import library_of, read_shard

    if path.is_dir():
        shards = sorted((path / "shards").glob("*.tar"))
        if len(shards) != 1:
            expected = "one; a capture is one configuration"
            raise input_error(path / "shards", "shards", len(shards), expected, "name the shard itself")
        path = shards[0]
    if not path.is_file():
        raise input_error(path, "", "no such file", "a shard", "check the path")
    return read_shard(path, library_of(path, options.library))


def capture_file(path: Path, options: CaptureOptions) -> tuple[CaptureFile, Path]:
    """A calibration of photographs as ``capture.json`` has it, and the folder that its paths start from."""
    posed, images = _posed_images(path, options)
    mesh = _find_mesh(path, options)
    world_from_source = asset_from_source(options.up, options.unit_m)
    mesh_up = options.up if options.mesh_up == "same" else options.mesh_up
    names: set[str] = set()
    photographs, problems = [], []
    for image in posed:
        file = _find_image(image.file, images)
        if file is None:
            expected = f"this image in {images}"
            problems.append(Problem(path, image.file, "not found", expected, "name its folder with --images"))
            continue
        name = unique(slug(Path(image.file).with_suffix("").as_posix()), names)
        names.add(name)
        camera = ViewCamera.from_camera(name, _in_world(image.camera, world_from_source, options.unit_m))
        photographs.append(PhotographRecord(camera=camera, image=str(file), distortion=image.distortion))
    if problems:
        raise InputError(*problems)
    matrix = asset_from_source(mesh_up, options.unit_m)
    rows = tuple(tuple(float(v) for v in row) for row in matrix)
    record = CaptureFile(
        name=slug(path.resolve().name.removesuffix(".json") or "capture"),
        encoding=options.encoding,
        photographs=tuple(_with_exposures(photographs) if options.exposure == "exif" else photographs),
        mesh=MeshRecord(file=str(mesh), world_from_mesh=rows),  # type: ignore[arg-type]
    )
    return record, Path()


def write_capture(folder: Path, record: CaptureFile) -> Path:
    """Write ``capture.json``; paths below ``folder`` are made relative to it."""
    folder.mkdir(parents=True, exist_ok=True)

    def relative(name: str) -> str:
        target = Path(name).resolve()
        return target.relative_to(folder.resolve()).as_posix() if _is_below(target, folder) else str(target)

    photographs = tuple(
        photograph.model_copy(update={"image": relative(photograph.image)})
        for photograph in record.photographs
    )
    mesh = record.mesh.model_copy(update={"file": relative(record.mesh.file)})
    path = folder / CAPTURE_FILE
    updated = record.model_copy(update={"photographs": photographs, "mesh": mesh})
    write_bytes_atomically(path, canonical_json(updated))
    return path


def _is_below(target: Path, folder: Path) -> bool:
    return os.path.commonpath([target, folder.resolve()]) == str(folder.resolve())


def open_capture(record: CaptureFile, base: Path, max_width_px: int = DEFAULT_MAX_WIDTH_PX) -> Capture:
    """A capture of photographs, its mesh read and its images checked to be there."""
    problems = [
        Problem(base / p.image, "", "no such file", "the view's image", "correct capture.json")
        for p in record.photographs
        if not (base / p.image).is_file()
    ]
    if problems:
        raise InputError(*problems)
    views = []
    for photograph in record.photographs:
        calibrated = photograph.camera.camera()
        source = PhotographSource(
            base / photograph.image,
            calibrated,
            photograph.distortion,
            record.encoding,
            photograph.exposure_scale,
        )
        views.append(CaptureView(photograph.camera.name, calibrated, source))
    mesh, notes = read_mesh(base / record.mesh.file, np.asarray(record.mesh.world_from_mesh))
    geometry = CaptureGeometry(mesh, (GeometryPart("mesh", 0, len(mesh.faces)),))
    return _shrunk(Capture(record.name, tuple(views), geometry, record.lights, notes), max_width_px)


def _shrunk(capture: Capture, max_width_px: int) -> Capture:
    views = tuple(replace(v, camera=shrunk_camera(v.camera, max_width_px)) for v in capture.views)
    return replace(capture, views=views)


def shrunk_camera(camera: Camera, max_width_px: int) -> Camera:
    """The camera at a longer side of at most ``max_width_px``, its aspect kept to the nearest pixel."""
    longer = max(camera.width_px, camera.height_px)
    if longer <= max_width_px:
        return camera
    width, height = (
        max(1, round(side * max_width_px / longer)) for side in (camera.width_px, camera.height_px)
    )
    return camera.scaled(width, height)


def read_mesh(path: Path, world_from_mesh: np.ndarray) -> tuple[Mesh, tuple[str, ...]]:
    """A mesh file in the world, without triangles of zero area, and notes on its faults.

    Raises :class:`InputError` for an unreadable or unusable mesh.
    """
    mesh = _load_mesh(path)
    faults = inspect_mesh(mesh)
    if faults.is_unusable:
        raise input_error(path, "", str(faults), "finite triangles", "repair the mesh and export it again")
    notes = []
    for count, what in (
        (faults.degenerate, "triangles of zero area were left out"),
        (faults.non_manifold_edges, "edges have more than two triangles"),
        (faults.inconsistent_edges, "edges join triangles of opposite winding"),
    ):
        if count:
            notes.append(f"{path.name}: {count} {what}")
    return without_degenerate(mesh).transformed(world_from_mesh), tuple(notes)


def _load_mesh(path: Path) -> Mesh:
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES or not path.is_file():
        got = suffix if path.is_file() else "no such file"
        raise input_error(path, "", got, f"a mesh ({', '.join(MESH_SUFFIXES)})", "name it with --mesh")
    if suffix == ".ply":
        return read_ply(path)
    if suffix == ".obj":
        from datagen.importers.obj import read_obj

        return read_obj(path)
    import trimesh

    try:
        loaded = trimesh.load_scene(path).to_mesh()
        uv = getattr(loaded.visual, "uv", None)
        return Mesh(
            np.asarray(loaded.vertices, np.float32),
            np.asarray(loaded.faces, np.int32),
            None,
            None if uv is None or len(uv) != len(loaded.vertices) else np.asarray(uv, np.float32),
        )
    except Exception as error:  # trimesh raises whatever its parsers meet
        raise input_error(path, "", repr(error)[:200], "a readable glTF file", "export it again") from None


def _posed_images(path: Path, options: CaptureOptions) -> tuple[list[PosedImage], Path]:
    """The calibration at ``path`` and the folder of its images."""
    if path.suffix == ".json" or (path / "transforms.json").is_file():
        file = path if path.suffix == ".json" else path / "transforms.json"
        return read_transforms(file), options.images or file.parent
    if path.suffix == ".xml":
        return _mitsuba_sensors(path), options.images or path.parent
    for model in (path, path / "sparse", path / "sparse" / "0"):
        if is_colmap_model(model):
            return read_colmap(model), options.images or path / "images"
    expected = "a shard, capture.json, transforms.json, a COLMAP model or a Mitsuba scene"
    got = "nothing known in it" if path.exists() else "no such file or folder"
    raise input_error(path, "", got, expected, "check the path")


def _mitsuba_sensors(path: Path) -> list[PosedImage]:
    """Sensors of a Mitsuba scene in the scene's own frame; an image bears its sensor's id as its name."""
    from datagen.importers.common import Findings
    from datagen.importers.mitsuba_lights import camera_of
    from datagen.importers.mitsuba_scene import parse_scene

    posed = []
    for number, node in enumerate(parse_scene(path).all_of("sensor")):
        made = camera_of(node, number, np.eye(4), Findings())
        matrix = np.array(made.asset_from_camera, dtype=np.float64)
        camera = Camera(made.width_px, made.height_px, made.fx_px, made.fy_px, made.cx_px, made.cy_px, matrix)
        posed.append(PosedImage(made.name, camera, None))
    if not posed:
        raise input_error(path, "sensor", "none", "at least one sensor", "add the cameras to the scene")
    return posed


def _find_image(name: str, folder: Path) -> Path | None:
    candidates = [Path(name)] if Path(name).is_absolute() else [folder / name]
    if candidates[0].suffix.lower() not in _IMAGE_SUFFIXES:
        candidates = [Path(f"{candidates[0]}{suffix}") for suffix in _IMAGE_SUFFIXES]
    return next((c.resolve() for c in candidates if c.is_file()), None)


def _find_mesh(path: Path, options: CaptureOptions) -> Path:
    if options.mesh is not None:
        return options.mesh.resolve()
    folder = path if path.is_dir() else path.parent
    found = (
        [f for f in sorted(folder.iterdir()) if f.suffix.lower() in MESH_SUFFIXES] if folder.is_dir() else []
    )
    if len(found) != 1:
        got = ", ".join(f.name for f in found) or "no mesh beside the cameras"
        raise input_error(path, "mesh", got, "one mesh in the cameras' frame", "name it with --mesh")
    return found[0].resolve()


def _in_world(camera: Camera, world_from_source: np.ndarray, unit_m: float) -> Camera:
    rigid = np.eye(4)
    rigid[:3, :3] = world_from_source[:3, :3] / unit_m @ camera.world_from_camera[:3, :3]
    rigid[:3, 3] = world_from_source[:3, :3] @ camera.position_m
    return replace(camera, world_from_camera=rigid)


def _with_exposures(photographs: Sequence[PhotographRecord]) -> list[PhotographRecord]:
    """Scales that undo the recorded exposures, 1 at their median. Raises where any photograph has none."""
    gathered = [relative_exposure(Path(p.image)) for p in photographs]
    problems = [
        Problem(p.image, "EXIF", "no exposure time, aperture or ISO", "all three", "use --exposure common")
        for p, value in zip(photographs, gathered, strict=True)
        if value is None
    ]
    if problems:
        raise InputError(*problems)
    values = np.array(gathered, dtype=np.float64)
    middle = float(np.median(values))
    return [
        p.model_copy(update={"exposure_scale": middle / value})
        for p, value in zip(photographs, values, strict=True)
    ]

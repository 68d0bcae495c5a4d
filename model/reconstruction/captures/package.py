# SPDX-License-Identifier: MIT
"""Reads captures from environment packages, with photographs next to the package.

The Blender add-on exports such packages, so a scene modelled from photographs needs no other export. Each
photograph has the name of its camera.
"""

from __future__ import annotations

from pathlib import Path

from datagen.formats.asset import ASSET_FILE, EnvironmentAsset
from datagen.formats.base import IDENTITY4
from datagen.formats.capture import Capture, CaptureView
from datagen.formats.configuration import PlacedAsset
from datagen.formats.package import open_package
from datagen.foundation.budget import Budget
from datagen.foundation.cameras import Camera
from datagen.foundation.encodings import Encoding
from datagen.foundation.errors import InputError, Problem, input_error
from datagen.foundation.naming import slug, unique
from datagen.rendering.capture_geometry import package_geometry, without_lamps
from model.reconstruction.captures.options import Exposure
from model.reconstruction.captures.photograph_files import unread_problems
from model.reconstruction.captures.photographs import PhotographSource, exposure_scales
from model.reconstruction.captures.posed import ImageFinder

_FOLDERS = ("photographs", "images")


def is_package(path: Path) -> bool:
    """Return whether ``path`` is an asset package: a folder with ``asset.json``, or a zip."""
    return (path / ASSET_FILE).is_file() or path.suffix == ".zip"


def read_package(
    path: Path, images: Path | None, encoding: Encoding, budget: Budget, exposure: Exposure = "common"
) -> Capture:
    """Read a capture of the package's cameras that have a photograph.

    ``images`` is by default the folder ``photographs`` or ``images`` in the package or next to it. Raises
    :class:`InputError` if no camera has a photograph.
    """
    with open_package(path, budget) as package:
        asset = package.asset
        budget.spend("frames", len(getattr(asset, "cameras", ())), "cameras")
        if not isinstance(asset, EnvironmentAsset) or not asset.cameras:
            got = f"{asset.kind} with {len(getattr(asset, 'cameras', ()))} cameras"
            remedy = "export the scene with its cameras as an environment"
            raise input_error(path, ASSET_FILE, got, "an environment with cameras", remedy)
        placed = PlacedAsset(name="environment", asset=asset.id, world_from_asset=IDENTITY4)
        geometry, notes = package_geometry(package, placed)
    folder = images or next(
        (parent / name for parent in (path, path.parent) for name in _FOLDERS if (parent / name).is_dir()),
        path.parent,
    )
    finder = ImageFinder(folder)
    found: list[tuple[str, Camera, Path]] = []
    missing: list[str] = []
    names: set[str] = set()
    for item in asset.cameras:
        image = finder.find(item.name)
        if image is None:
            missing.append(item.name)
            continue
        name = unique(slug(item.name), names)
        names.add(name)
        found.append((name, item.camera(), image))
    others = finder.unread(missing)
    if others:
        raise InputError(*unread_problems(path, list(others.values())))
    if not found:
        expected = f"images in {folder} named after the cameras, such as {asset.cameras[0].name}.jpg"
        raise InputError(Problem(path, "photographs", "none", expected, "name their folder with --images"))
    scales = exposure_scales([image for *_, image in found], exposure)
    views = [
        CaptureView(name, camera, PhotographSource(image, camera, None, encoding, scale))
        for (name, camera, image), scale in zip(found, scales, strict=True)
    ]
    if missing:
        notes = (*notes, f"no photographs for {len(missing)} cameras: {', '.join(missing[:8])}")
    return Capture(asset.id, tuple(views), geometry, without_lamps(asset.lights), notes)

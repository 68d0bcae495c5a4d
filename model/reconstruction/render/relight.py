# SPDX-License-Identifier: MIT
"""Renders an asset from its cameras, under its lights or others, optionally with inserted objects.

The package is converted to a configuration for ``datagen``'s renderer.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import EnvironmentAsset, ObjectAsset, Part, Provenance, SlotMaterial
from datagen.formats.base import matrix4, write_bytes_atomically
from datagen.formats.configuration import Configuration, PlacedAsset, ViewCamera, configuration_of
from datagen.formats.lights import EnvironmentLight, Light, PointLight
from datagen.formats.package import FileSource, Package, open_package, write_package
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.axes import affine
from datagen.foundation.cameras import Camera
from datagen.foundation.color import luminance, photographic_exposure
from datagen.foundation.errors import input_error
from datagen.foundation.exr import encode_channels
from datagen.foundation.images import encode_png, read_radiance, shown_bytes
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import encode_ply
from datagen.foundation.progress import Progress
from datagen.library import Library
from datagen.rendering.renderer import SceneRenderer

SKY_ID = "relight-sky"
_DARK = 1e-3  # mean luminance of an unlit view, relative to the sky's


@dataclass(frozen=True)
class Insertion:
    """An object package that is placed at ``position_m`` and rotated about the vertical by ``yaw_rad``."""

    package: Path
    position_m: tuple[float, float, float]
    yaw_rad: float = 0.0


@dataclass(frozen=True)
class Lamp:
    """A point light with an ``intensity`` in W/sr per channel."""

    position_m: tuple[float, float, float]
    intensity: tuple[float, float, float] = (5.0, 5.0, 5.0)


@dataclass(frozen=True)
class RelightOptions:
    """Options for rendering an asset.

    ``sky`` (an environment map in EXR, or a constant radiance) and ``lamps`` replace the asset's lights.
    ``views`` are names of the asset's cameras, empty for all; ``cameras`` replace the asset's cameras and are
    named ``frame-000`` etc. ``samples`` are light paths per pixel, of at most ``max_depth`` segments.
    ``compensation`` multiplies the exposure of PNG images and animations.
    """

    sky: Path | tuple[float, float, float] | None = None
    insertions: tuple[Insertion, ...] = ()
    views: tuple[str, ...] = ()
    samples: int = 16
    max_depth: int = 8
    denoise: bool = True
    seed: int = 0
    lamps: tuple[Lamp, ...] = ()
    cameras: tuple[Camera, ...] = ()
    compensation: float = 1.0


@dataclass(frozen=True)
class RenderedImage:
    """Name and linear image (H, W, 3) of a rendered view."""

    name: str
    color: NDArray[np.float32]


def render_asset(path: Path, options: RelightOptions) -> Iterator[RenderedImage]:
    """Render the views of an environment package one by one.

    Raises :class:`InputError` for unknown views, missing lights and invalid packages.
    """
    with ExitStack() as opened:
        package, *inserted = (
            opened.enter_context(open_package(given))
            for given in (path, *(i.package for i in options.insertions))
        )
        sky = opened.enter_context(_sky_package(options.sky))
        configuration, names = _configuration(package, inserted, options, sky)
        packages = [package, *inserted, *([sky] if sky else [])]
        library = opened.enter_context(Library([package.path for package in packages]))
        recipe = RenderRecipe(
            path_samples=options.samples,
            auxiliary_samples=max(4, min(64, options.samples)),
            max_depth=options.max_depth,
            denoise=options.denoise,
        )
        renderer = SceneRenderer(configuration, library, recipe)
        opened.callback(renderer.close)
        chosen = [k for k, name in enumerate(names) if not options.views or name in options.views]
        for view in renderer.render_views(chosen):
            yield RenderedImage(names[view.index], view.buffers["beauty"].astype(np.float32))


def _configuration(
    package: Package, inserted: Sequence[Package], options: RelightOptions, sky: Package | None
) -> tuple[Configuration, list[str]]:
    base = configuration_of(package, options.seed)
    assert isinstance(package.asset, EnvironmentAsset)
    names = [camera.name for camera in package.asset.cameras]
    cameras = base.cameras
    if options.cameras:
        names = [f"frame-{k:03d}" for k in range(len(options.cameras))]
        cameras = tuple(
            ViewCamera.from_camera(name, camera) for name, camera in zip(names, options.cameras, strict=True)
        )
    unknown = sorted(set(options.views) - set(names))
    if unknown:
        shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
        raise input_error(package.path, "views", ", ".join(unknown), f"cameras of the asset: {shown}")
    lights: tuple[Light, ...] = base.lights
    emission = {}
    if options.sky is not None or options.lamps:
        lights = tuple(
            PointLight(name=f"lamp-{k}", position_m=lamp.position_m, intensity=lamp.intensity)
            for k, lamp in enumerate(options.lamps)
        )
        if options.sky is not None:
            lights = (
                EnvironmentLight(name="sky", image="sky.exr", asset=SKY_ID)
                if isinstance(options.sky, Path)
                else EnvironmentLight(name="sky", radiance=options.sky),
                *lights,
            )
        lamps = [slot for slot, m in package.asset.materials.items() if m.emission is not None]
        emission = {slot: (0.0, 0.0, 0.0) for slot in lamps}
    elif not lights and not any(m.emission for m in package.asset.materials.values()):
        raise input_error(package.path, "lights", "none", "a light", "give one with --lamp or --sky")
    assets = dict(base.assets)
    objects = []
    for number, (insertion, item) in enumerate(zip(options.insertions, inserted, strict=True)):
        if not isinstance(item.asset, ObjectAsset):
            raise input_error(insertion.package, "kind", item.asset.kind, "an object package")
        assets[item.id] = item.sha256
        c, s = np.cos(insertion.yaw_rad), np.sin(insertion.yaw_rad)
        matrix = affine([[c, -s, 0], [s, c, 0], [0, 0, 1]], insertion.position_m)
        objects.append(
            PlacedAsset(name=f"inserted-{number}", asset=item.id, world_from_asset=matrix4(matrix))
        )
    if sky is not None:
        assets[SKY_ID] = sky.sha256
    environment = base.environment.model_copy(update={"emission": emission})
    changes = {
        "environment": environment,
        "lights": lights,
        "objects": tuple(objects),
        "assets": assets,
        "cameras": cameras,
    }
    return base.model_copy(update=changes), names


@contextmanager
def _sky_package(sky: Path | tuple[float, float, float] | None) -> Iterator[Package | None]:
    """Open a temporary package with the environment map, since configurations refer only to packages."""
    if not isinstance(sky, Path):
        yield None
        return
    if not sky.is_file():
        raise input_error(sky, "", "no such file", "an environment map (.exr)", "check the path")
    read_radiance(sky)  # errors of the renderer would name the temporary copy
    speck = Mesh(np.eye(3, dtype=np.float32) * 1e-3, np.array([[0, 1, 2]], np.int32))
    asset = EnvironmentAsset(
        id=SKY_ID,
        title="Sky",
        provenance=Provenance(license="LicenseRef-unstated"),
        materials={"speck": SlotMaterial()},
        parts=(Part(name="speck", mesh="speck.ply", material="speck"),),
        lights=(EnvironmentLight(name="sky", image="sky.exr"),),
    )
    with tempfile.TemporaryDirectory(prefix="sky-") as folder:
        files: dict[str, FileSource] = {"speck.ply": encode_ply(speck), "sky.exr": sky}
        yield write_package(Path(folder) / "package", asset, files)


def lit_images(
    path: Path, options: RelightOptions, warn: Callable[[str], None] = lambda text: None
) -> Iterator[RenderedImage]:
    """Render as :func:`render_asset` does, with other lights if the room would be dark.

    If no light from the sky reaches the first view, the asset's lights replace the sky. An asset without
    lights gets a lamp in the middle of its cameras. ``warn`` is called with an explanation in both cases.
    """
    asset = environment_of(path)
    has_lights = bool(asset.lights) or any(any(m.emission or ()) for m in asset.materials.values())
    if options.sky is None and not options.lamps and not has_lights:
        options = _with_own_lamp(options, asset)
        warn(f"the asset has no light: {_OWN_LAMP}")
    images = render_asset(path, options)
    first = next(images, None)
    if first is None:
        return
    if _is_unlit(first.color, options):
        options = replace(options, sky=None) if has_lights else _with_own_lamp(options, asset)
        instead = "its own lights are used" if has_lights else _OWN_LAMP
        warn(f"no light from the sky reaches {first.name}: the room is closed; {instead}")
        images = render_asset(path, options)
        first = next(images)
    yield first
    yield from images


_OWN_LAMP = "a lamp in the middle of its cameras is used (--lamp X,Y,Z sets others)"


def environment_of(path: Path) -> EnvironmentAsset:
    """Read the asset of a package. Raises :class:`InputError` unless it is an environment with cameras."""
    with open_package(path) as package:
        asset = package.asset
    if not isinstance(asset, EnvironmentAsset) or not asset.cameras:
        expected = "an environment with cameras"
        raise input_error(path, "kind", asset.kind, expected, "name an output of `materials infer`")
    return asset


def _with_own_lamp(options: RelightOptions, asset: EnvironmentAsset) -> RelightOptions:
    """Add a lamp in the middle of the cameras to the options."""
    x, y, z = (float(v) for v in np.mean([c.camera().position_m for c in asset.cameras], axis=0))
    return replace(options, lamps=(Lamp((x, y, z)),))


def _is_unlit(color: NDArray[np.float32], options: RelightOptions) -> bool:
    """Return whether the only light is a sky and a view of radiance ``color`` (H, W, 3) is almost black."""
    if options.sky is None or options.lamps:
        return False
    return float(luminance(color).mean()) < _DARK * _sky_luminance(options.sky)


@lru_cache(maxsize=4)
def _sky_luminance(sky: Path | tuple[float, float, float]) -> float:
    if isinstance(sky, Path):
        return float(luminance(read_radiance(sky).mean(axis=(0, 1), dtype=np.float64)))
    return float(luminance(np.array(sky, dtype=np.float64)))


def write_renders(
    path: Path,
    out: Path,
    options: RelightOptions | None = None,
    warn: Callable[[str], None] = lambda text: None,
    progress: Progress = lambda stage, done, total: None,
) -> list[Path]:
    """Render an asset to ``NAME.exr`` (linear) and ``NAME.png`` (sRGB, at the first view's exposure) in the
    folder ``out``; return the paths. ``warn`` is called if lights are replaced (:func:`lit_images`).
    """
    options = options or RelightOptions()
    if out.is_file():
        raise input_error(out, "--out", "a file", "a folder", "choose another --out")
    total = len(set(options.views) or environment_of(path).cameras)
    written: list[Path] = []
    exposure = 0.0
    for image in lit_images(path, options, warn):
        out.mkdir(parents=True, exist_ok=True)
        exposure = exposure or options.compensation * photographic_exposure(image.color)
        file = out / f"{image.name}.exr"
        write_bytes_atomically(file, encode_channels({"RGB": image.color}))
        write_bytes_atomically(out / f"{image.name}.png", encode_png(shown_bytes(image.color, exposure)))
        written += [file, out / f"{image.name}.png"]
        progress("render", len(written) // 2, total)
    return written
